"""Values that environments may return, and the one-sentence errors for others, which name environment, value and place."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from odd import Odd, raising
from pcil import demos, envs
from pcil.errors import InputError, RunError
from pcil.training.evaluate import evaluate
from pcil.types import Spec

ACTION = np.zeros(1, np.float32)


@pytest.fixture(autouse=True)
def all_are_closed() -> Iterator[None]:
    Odd.open_copies.clear()
    yield
    assert not Odd.open_copies, "every environment must be closed"


@pytest.fixture
def task() -> Iterator[Any]:
    """Registers an odd environment under an id, with or without Gymnasium's time limit."""

    def register(limit: int | None = 10, **wrong: Any) -> str:
        gymnasium.register("pcil_test/odd-v0", Odd, max_episode_steps=limit, kwargs=wrong)
        return "pcil_test/odd-v0"

    yield register
    gymnasium.registry.pop("pcil_test/odd-v0", None)


def third_step(task: str) -> tuple[Any, ...]:
    """The result of the third step."""
    with envs.opened(task) as env:
        env.reset(seed=7)
        return [env.step(ACTION) for _ in range(3)][-1]


@pytest.mark.parametrize("obs", [[1, 2], (1, 2), np.array([1, 2], np.float16), np.array([1, 2]), np.ma.array([1.0, 2.0])])
def test_observations_are_taken_where_they_are_real_numbers_of_the_right_shape(obs: Any, task: Any) -> None:
    row = third_step(task(obs=obs))[0]
    assert row.dtype == np.float32 and row.tolist() == [1, 2]


def test_values_outside_the_bounds_of_the_box_are_fine(task: Any) -> None:
    assert third_step(task(obs=np.array([50.0, -50.0])))[0].tolist() == [50, -50]


@pytest.mark.parametrize("reward", [2, 2.0, np.float32(2), np.array(2.0), np.array([2.0]), np.array([[2]]), [2.0], np.int8(2)])
def test_rewards_are_taken_where_they_are_one_number(reward: Any, task: Any) -> None:
    taken = third_step(task(reward=reward))[1]
    assert type(taken) is float and taken == 2


@pytest.mark.parametrize("flag", [True, np.True_, np.array(True), np.array([True]), [[True]], 1])
@pytest.mark.parametrize("name", ["terminated", "truncated"])
def test_ends_are_taken_where_they_are_one_bool(flag: Any, name: str, task: Any) -> None:
    taken = third_step(task(**{name: flag}))[2:4]
    assert taken == (name == "terminated", name == "truncated") and [type(value) for value in taken] == [bool, bool]


class Strange:
    """A value that is neither a number nor a list of numbers."""


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"obs": None}, r"returned None as observation, .*; it must be real numbers of shape \(2,\)"),
        ({"obs": np.zeros(3)}, r"an array of shape \(3,\) and dtype float64 as observation"),
        ({"obs": np.zeros((2, 1))}, r"an array of shape \(2, 1\)"),
        ({"obs": np.array(["1", "2"])}, r"an array of shape \(2,\) and dtype <U1"),
        ({"obs": np.array([None, 1.0])}, "dtype object"),
        ({"obs": np.zeros(2, complex)}, "dtype complex128"),
        ({"obs": [[1.0], [2.0, 3.0]]}, r"returned \[\[1.0\], \[2.0, 3.0\]\] as observation"),
        ({"obs": np.ma.array([1.0, 2.0], mask=[True, False])}, r"an array of shape \(2,\)"),
        ({"obs": {"a": 1.0}}, r"returned \{'a': 1.0\} as observation"),
        ({"obs": Strange()}, "an object of class test_checked.Strange as observation"),
        ({"reward": None}, "returned None as reward, .*; it must be a number"),
        ({"reward": "1.0"}, "returned '1.0' as reward"),
        ({"reward": 1j}, "returned 1j as reward"),
        ({"reward": 10**400}, r"returned 1000.*\.\.\..*000 as reward"),
        ({"reward": np.zeros(2)}, r"an array of shape \(2,\) and dtype float64 as reward"),
        ({"reward": np.ma.masked}, "as reward"),
        ({"terminated": "nan"}, "returned 'nan' as termination, .*; it must be True or False"),
        ({"terminated": float("nan")}, "returned nan as termination"),
        ({"truncated": np.array([True, False])}, r"an array of shape \(2,\) and dtype bool as truncation"),
        ({"truncated": None}, "returned None as truncation"),
        ({"terminated": 2}, "returned 2 as termination"),
    ],
)
def test_all_else_is_one_sentence(wrong: dict[str, Any], said: str, task: Any) -> None:
    with pytest.raises(InputError, match=rf"'pcil_test/odd-v0' .*{said}") as error:
        third_step(task(**wrong))
    assert "in step 3 of episode 1 (seed 7)" in str(error.value)
    assert error.value.exit_code == 2 and len(str(error.value)) < 250 and "\n" not in str(error.value)


STEPS = [((np.zeros(2), 0.0, False, {}), "4"), ((np.zeros(2), 0.0), "2"), (None, "None"), (np.zeros(2), "2"), (7, "7|int")]


@pytest.mark.parametrize("limit", [None, 10])
@pytest.mark.parametrize(("step", "said"), STEPS)
def test_a_step_returns_five_things(step: Any, said: str, limit: int | None, task: Any) -> None:
    """With a time limit, a Gymnasium wrapper unpacks them first; the first of `STEPS` is the result of a step in old Gym."""
    with pytest.raises(InputError, match=said) as error:
        third_step(task(limit, step=step))
    expected = ["'pcil_test/odd-v0'", "(observation, reward, terminated, truncated, info)", "in step 3 of episode 1 (seed 7)"]
    assert all(part in str(error.value) for part in expected) and error.value.exit_code == 2


@pytest.mark.parametrize("reset", [np.zeros(2), [0.0, 0.0], None, (np.zeros(2),), (np.zeros(2), {}, {}), (np.zeros(2), 1.0)])
def test_a_reset_returns_observation_and_info(reset: Any, task: Any) -> None:
    with pytest.raises(InputError, match=r"from reset, at the start of episode 1 .*\(observation, info\)"):
        third_step(task(reset=reset))


def test_an_absent_info_is_no_matter(task: Any) -> None:
    assert third_step(task(reset=(np.zeros(2), None), info=None))[4] == {}


class Seedless(Odd):
    """An environment whose reset takes no seed, as before Gym 0.26."""

    def reset(self) -> Any:  # type: ignore
        return np.zeros(2)


def test_a_reset_that_takes_no_seed_is_told(task: Any) -> None:
    with pytest.raises(InputError, match=r"can't be reset with a seed .*'seed'"), envs.opened(Seedless) as env:
        env.reset(seed=1)


NAN, INF = float("nan"), float("inf")
WIDE = spaces.Box(-9.0, 9.0, (20,), np.float32)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"obs": np.array([0.0, NAN])}, "returned an observation whose entry 1 is nan, in step 3 of episode 1"),
        ({"obs": np.array([INF, NAN])}, "entry 0 is inf"),
        ({"obs": np.array([0.0, 1e300])}, "entry 1 is 1e.300, too large for float32"),
        ({"obs": np.array([0.0, -INF], np.float32)}, "entry 1 is -inf"),
        ({"space": WIDE, "obs": np.array([NAN] + [0.0] * 19, np.float32)}, "entry 0 is nan"),
        ({"reset": (np.array([NAN, 0.0]), {})}, "entry 0 is nan, at the start of episode 1"),
        ({"reward": NAN}, "returned a reward that is nan, in step 3"),
        ({"reward": np.float32(INF)}, "returned a reward that is inf"),
        ({"reward": np.array([NAN])}, "returned a reward that is nan"),
        ({"reward": 1e39}, "a reward that is 1e.39, too large for float32"),
    ],
)
def test_what_is_not_finite_is_told_with_its_place(wrong: dict[str, Any], said: str, task: Any) -> None:
    with pytest.raises(RunError, match=rf"'pcil_test/odd-v0' .*{said}") as error:
        third_step(task(**wrong))
    assert "(seed 7)" in str(error.value) and error.value.exit_code == 1


def test_large_finite_values_are_taken(task: Any) -> None:
    """Even if their squares are infinite in float32."""
    obs, reward, *_ = third_step(task(obs=np.array([3e38, -3e38]), reward=3e38))
    assert obs.tolist() == np.array([3e38, -3e38], np.float32).tolist() and reward == 3e38
    gymnasium.registry.pop("pcil_test/odd-v0")
    assert third_step(task(space=WIDE, obs=np.full(20, 3e38, np.float32)))[0].min() == np.float32(3e38)


ONE = spaces.Box(-9.0, 9.0, (1,), np.float64)
MATRIX = spaces.Box(-9.0, 9.0, (2, 2), np.float32)
SPACES = [
    spaces.Dict({"observation": ONE, "goal": spaces.Dict({"slide": ONE})}),
    spaces.Tuple([MATRIX, spaces.Dict({"z": ONE, "a": spaces.Tuple([ONE, MATRIX])})]),
    spaces.Dict({"z": ONE, "a": ONE}, sort_keys=False),
    spaces.Box(-9.0, 9.0, (), np.float64),
    MATRIX,
    spaces.Box(0, 255, (4,), np.uint8),
    spaces.Dict({"none": spaces.Box(0, 1, (0,)), "one": ONE}),
]


@pytest.mark.parametrize("space", SPACES, ids=str)
def test_nested_spaces_are_flattened_as_gymnasium_does_it(space: spaces.Space, task: Any) -> None:
    with envs.opened(task(space=space)) as env:
        obs, raw = env.reset(seed=1)[0], env.unwrapped._observation()
        assert envs.spec(env) == Spec(spaces.flatdim(space), 1, 1)
        assert obs.dtype == np.float32 and obs.tolist() == spaces.flatten(space, raw).astype(np.float32).tolist()
        assert obs.shape == env.observation_space.shape and (
            len(set(obs.tolist())) > 1 or obs.size == 1 or space.dtype == np.uint8
        )


@pytest.mark.parametrize(
    ("obs", "said"),
    [
        ({"observation": np.zeros(1)}, "without 'goal' as observation, .*a dict with the keys 'goal', 'observation'"),
        ({"observation": np.zeros(1), "goal": {}}, r"without 'slide' as observation\['goal'\]"),
        ({"observation": np.zeros(1), "goal": np.zeros(1)}, r"as observation\['goal'\], .*a dict"),
        ({"observation": np.zeros(1), "goal": {"slide": np.zeros(2)}}, r"shape \(2,\).*as observation\['goal'\]\['slide'\]"),
        ({"observation": np.zeros(1), "goal": {"slide": [NAN]}}, r"an observation\['goal'\]\['slide'\] whose entry 0 is nan"),
        (np.zeros(2), "as observation, .*a dict"),
    ],
)
def test_parts_of_nested_observations_are_named(obs: Any, said: str, task: Any) -> None:
    with pytest.raises(InputError, match=said):
        third_step(task(space=SPACES[0], obs=obs))


def test_further_keys_are_left_out_and_tuples_have_their_length(task: Any) -> None:
    obs = {"observation": np.ones(1), "goal": {"slide": np.zeros(1)}, "pixels": None}
    assert third_step(task(space=SPACES[0], obs=obs))[0].tolist() == [0, 1]
    gymnasium.registry.pop("pcil_test/odd-v0")
    with pytest.raises(InputError, match=r"as observation, .*a tuple of 2"):
        third_step(task(space=SPACES[1], obs=(np.zeros((2, 2)),)))


@pytest.mark.parametrize(
    "space",
    [
        spaces.MultiBinary(3),
        spaces.MultiDiscrete([2, 2]),
        spaces.Text(5),
        spaces.Tuple([ONE, spaces.Discrete(2)]),
        spaces.Dict({"a": spaces.Dict({"b": spaces.Discrete(2)})}),
        spaces.Dict({}),
        spaces.Box(0, 1, (0,)),
    ],
    ids=str,
)
def test_other_spaces_are_refused_and_what_was_made_is_closed(space: spaces.Space, task: Any) -> None:
    with pytest.raises(InputError, match="The observations of 'pcil_test/odd-v0' must be a Box or a Dict of Boxes"):
        envs.make(task(space=space))


@pytest.mark.parametrize(
    "error", [RuntimeError("the motor is hot.\nStop."), OSError(5, "lost"), ZeroDivisionError(), SystemExit(3)]
)
def test_what_an_environment_raises_is_told_and_kept_as_the_cause(error: BaseException, task: Any) -> None:
    with pytest.raises(
        RunError, match=rf"'pcil_test/odd-v0' raised {type(error).__name__}.*, in step 3 of episode 1"
    ) as raised:
        third_step(task(step=raising(error)))
    assert raised.value.__cause__ is error and raised.value.exit_code == 1 and "\n" not in str(raised.value)
    gymnasium.registry.pop("pcil_test/odd-v0")
    with pytest.raises(RunError, match="at the start of episode 1"):
        third_step(task(reset=raising(error)))


def test_a_close_that_raises_is_only_told(task: Any) -> None:
    with envs.opened(task()) as env:
        close, env.unwrapped.close = env.unwrapped.close, raising(OSError("the port is gone"))
        with pytest.warns(UserWarning, match=r"'pcil_test/odd-v0' raised OSError \(the port is gone\) when it was closed"):
            env.close()
        env.unwrapped.close = close


@pytest.mark.parametrize(
    ("action", "said"),
    [
        (np.zeros(2), r"The action for 'pcil_test/odd-v0' is an array of shape \(2,\) .*of shape \(1,\)"),
        (np.zeros((1, 1)), r"shape \(1, 1\)"),
        (0.0, "is 0.0, in step 1"),
        (None, "is None, in step 1"),
        (np.array(["left"]), "dtype <U4"),
        (np.array([NAN]), "was to be given an action whose entry 0 is nan, in step 1 of"),
        (np.array([INF], np.float32), "an action whose entry 0 is inf"),
        (np.array([1e300]), "1e.300, too large|is inf"),
    ],
)
def test_actions_are_checked_too(action: Any, said: str, task: Any) -> None:
    """Those of a recorded controller, and those of an evaluated policy."""
    with envs.opened(task()) as env:
        with pytest.raises(InputError, match=said):
            demos.record(lambda obs: action, env, 1, task="odd", seed=0, info={})
        if np.shape(action) == (1,) and "e.300" not in said:
            with pytest.raises(InputError, match=said):
                evaluate(lambda obs: np.stack([action] * len(obs)), [env], seed=0)


def test_errors_say_which_episode_of_what(task: Any) -> None:
    with envs.opened(task(obs=np.array([NAN, 0.0]), episode=2)) as env:
        with pytest.raises(RunError, match=r"in step 3 of recorded episode 2 \(seed \d+\)"):
            demos.record(lambda obs: ACTION, env, 3, task="odd", seed=0, info={})
        env.unwrapped.episodes = 0
        with pytest.raises(RunError, match=r"in step 3 of evaluation episode 2 \(seed \d+\)"):
            evaluate(lambda obs: np.zeros((len(obs), 1)), [env], seed=0, episodes=3)


def test_a_plain_environment_is_checked_where_it_is_recorded_or_evaluated() -> None:
    env = Odd(reward=np.array([0.5]))
    assert demos.record(lambda obs: ACTION, env, 1, task="odd", seed=0, info={}).episodes[0].reward[2] == 0.5
    assert evaluate(lambda obs: np.zeros((len(obs), 1)), [Odd(), env], seed=0).lengths.tolist() == [10, 10]
    for copy in list(Odd.open_copies):
        copy.close()


def test_an_observation_is_a_copy(task: Any) -> None:
    with envs.opened(task(space=spaces.Box(-9, 9, (2,), np.float32))) as env:
        buffer = np.zeros(2, np.float32)
        env.unwrapped._observation = lambda: buffer
        obs, _ = env.reset()
        buffer += 1
        assert obs.tolist() == [0, 0]


def test_functions_and_objects_make_environments() -> None:
    with envs.opened(Odd) as env:
        assert env.reset(seed=0)[0].shape == (2,) and envs.task_name(Odd) == "function odd.Odd"
    mine = Odd()
    with envs.opened(mine) as env:
        assert env.unwrapped is mine and envs.task_name(mine) == "object odd.Odd"
    assert Odd.open_copies == [mine], "its owner closes it"
    mine.close()
    with pytest.raises(
        InputError, match=r"The function .* returned an array of shape \(3,\) .*; it must return a gymnasium.Env"
    ):
        envs.make(lambda: np.zeros(3))
    with pytest.raises(InputError, match=r"can't be made \(ZeroDivisionError"):
        envs.make(lambda: 1 // 0)
    with pytest.raises(InputError, match="was given in Python"):
        envs.make("function odd.Odd")
    with pytest.raises(InputError, match=r"The task is an array of shape \(9999,\)"):
        envs.make(np.zeros(9999))
