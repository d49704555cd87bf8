"""Which demonstrations fit a run: boxes, arguments and time step of the environment, clipped actions, and missing data."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import h5py
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file
from test_demos import edit_metadata, forget_checksum, refusal

import pcil.training.fit
from pcil import cli, demos, envs
from pcil.demos import Demonstrations
from pcil.errors import InputError, json_object
from pcil.policy import load_policy
from pcil.rewards import REWARDS
from pcil.training import checkpoint, presets, runs
from pcil.training.config import Run
from pcil.training.state import start
from pcil.types import Episode, Origin
from small import POINT_MASS, save_point_mass_demos, small_run


class Slider(gymnasium.Env):
    """A point that is moved by `skip` times the action, in units of its bound; eight steps."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012  as gymnasium.Env declares it

    def __init__(self, bound: float = 1.0, skip: int = 1, what: str = "plain", render_mode: str | None = None) -> None:
        self.bound, self.skip, self.what, self.render_mode = bound, skip, what, render_mode
        self.dt = 0.1 * skip
        self.observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float32)
        self.action_space = spaces.Box(*((-np.inf, np.inf) if what == "unbounded" else (-bound, bound)), (2,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed, options=options)
        self.steps, self.x = 0, self.np_random.normal(size=1).astype(np.float32)
        return self.x.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.steps += 1
        self.x = self.x + self.skip * (action[:1] / self.bound).astype(np.float32)
        return self.x.copy(), float(-abs(self.x[0])), False, self.steps == 8, {}


@pytest.fixture(autouse=True)
def sliders() -> Iterator[None]:
    """Register the plain environment, and two with arguments in their registration."""
    ids = {"test/slider-v0": {}, "test/wide-v0": {"bound": 10.0}, "test/other-v0": {"what": "other"}}
    ids |= {"test/open-v0": {"what": "unbounded"}}
    for name, kwargs in ids.items():
        gymnasium.register(name, "test_fit:Slider", kwargs=kwargs, max_episode_steps=8)
    yield
    for name in ids:
        del gymnasium.registry[name]


def save(folder: Path, task: str = "test/slider-v0", *, by_us: bool = False, **kwargs: Any) -> str:
    """Save three episodes with actions of 0.7 times the bound, recorded in Gymnasium's environment or in ours."""
    env = envs.make(task, env_kwargs=kwargs) if by_us else gymnasium.make(task, **kwargs)
    push = np.full(2, 0.7 * env.action_space.high[0], np.float32)
    return str(demos.record(lambda obs: push, env, 3, task=task, seed=0, info={}).save(folder / "demos"))


def fit(folder: str, task: str = "test/slider-v0", method: str = "pcil", **changes: Any) -> tuple[Demonstrations, list[str]]:
    """The demonstrations as a run uses them, and the messages."""
    said: list[str] = []
    _, found, _ = runs.prepared(presets.make(task, method, demos=folder, **changes), said.append)
    assert found is not None
    return found, said


# --- Demonstrations from another environment ---


@pytest.mark.parametrize("by_us", [False, True])
@pytest.mark.parametrize(("theirs", "ours", "kept"), [("wide", "slider", 7.0), ("slider", "wide", 0.07)])
def test_another_action_box_is_refused_until_it_is_said_which_holds(
    theirs: str, ours: str, kept: float, by_us: bool, tmp_path: Path
) -> None:
    folder, task = save(tmp_path, f"test/{theirs}-v0", by_us=by_us), f"test/{ours}-v0"
    message = refusal(lambda: fit(folder, task))
    assert "[-10.0, 10.0]" in message and "[-1.0, 1.0]" in message and "--demos-mismatch scale" in message
    scaled, said = fit(folder, task, demos_mismatch="scale")
    np.testing.assert_allclose(scaled.action, 0.7, rtol=1e-6)
    assert len(said) == 1 and "[-10.0, 10.0]" in said[0]
    if kept > 1:
        assert "bounds" in refusal(lambda: fit(folder, task, demos_mismatch="keep"))
        clipped, said = fit(folder, task, demos_mismatch="keep", clip_actions=True)
        assert (clipped.action == 1).all()
        assert said[1] == "Clipped 48 of 48 entries of the demonstrations' actions, by at most 6."
    else:
        np.testing.assert_allclose(fit(folder, task, demos_mismatch="keep")[0].action, kept, rtol=1e-6)


def test_actions_without_bounds_are_given_some_on_the_command_line(tmp_path: Path) -> None:
    """The run, its policy and the demonstrations know the bounds; the demonstrations of other bounds are refused."""
    folder = save(tmp_path, "test/open-v0", by_us=True, **{"action-bounds": [-3.0, 3.0]})
    small = "--frames 40 --seed-frames 16 --random-frames 16 --evaluate-episodes 1 --agent.hidden 16 --agent.batch-size 8"
    words = ["train", "test/open-v0", "--method", "dac", "--demos", folder, "--reward.hidden", "16", "--reward.batch-size", "8"]
    words += [*small.split(), "--action-bounds", "-3", "3", "--out"]
    assert cli.main([*words, str(tmp_path / "run")]) == 0
    policy = load_policy(tmp_path / "run")
    assert policy.env_kwargs == {"action-bounds": [-3.0, 3.0]}
    assert policy.action_bounds is not None and [bound.tolist() for bound in policy.action_bounds] == [[-3, -3], [3, 3]]
    assert cli.main(["evaluate", str(tmp_path / "run"), "--episodes", "1"]) == 0
    words[words.index("-3")] = "-2"
    assert cli.main([*words, str(tmp_path / "other")]) == 2


@settings(max_examples=30, deadline=None)
@given(*[st.tuples(st.floats(-9, 9), st.floats(0.1, 9))] * 2, st.floats(-1, 1))
def test_kept_actions_have_the_value_that_was_recorded(
    theirs: tuple[float, float], ours: tuple[float, float], unit: float
) -> None:
    """Boxes are given as (middle, half the width)."""
    origin, here = (Origin(action_low=[m - h], action_high=[m + h]) for m, h in (theirs, ours))
    episode = Episode(np.zeros((2, 1), np.float32), np.full((1, 1), unit, np.float32), np.zeros(1))
    (kept,) = pcil.training.fit._kept(Demonstrations("x", (episode,), {}, origin), here).episodes
    value = theirs[0] + theirs[1] * float(np.float32(unit))
    assert np.isclose(ours[0] + ours[1] * float(kept.action[0, 0]), value, atol=1e-5)


def test_a_dataset_of_others_has_the_box_of_its_metadata_but_not_of_a_wrapper(tmp_path: Path) -> None:
    folder = Path(save(tmp_path, by_us=True))
    metadata = json.loads((folder / "data" / "metadata.json").read_text())
    spec = json.loads(metadata["env_spec"])
    assert spec["additional_wrappers"]
    edit_metadata(folder / "data", pcil=None)
    assert fit(str(folder), "test/wide-v0")[0].origin.action_low is None
    edit_metadata(folder / "data", env_spec=json.dumps(spec | {"additional_wrappers": []}))
    assert "[-10.0, 10.0]" in refusal(lambda: fit(str(folder), "test/wide-v0"))
    edit_metadata(folder / "data", env_spec=None)
    assert "[-10.0, 10.0]" in refusal(lambda: fit(str(folder), "test/wide-v0"))


@pytest.mark.parametrize("task", ["test/slider-v0", "test/other-v0"])
def test_other_arguments_are_refused_with_those_that_make_them_equal(task: str, tmp_path: Path) -> None:
    folder = save(tmp_path, skip=5)
    message = refusal(lambda: fit(folder, task))
    assert "skip is 5 there and 1 here" in message and """--env-kwargs '{"skip": 5}'""" in message
    found, said = fit(folder, task, env_kwargs={"skip": 5})
    assert found.origin.kwargs == {"skip": 5} and len(said) == (task != "test/slider-v0")
    _, said = fit(folder, task, demos_mismatch="keep")
    assert "skip is 5 there and 1 here" in said[0]


def test_arguments_of_the_run_are_compared_with_the_defaults_of_the_dataset(tmp_path: Path) -> None:
    folder = save(tmp_path)
    assert "skip is 1 there and 3 here" in refusal(lambda: fit(folder, env_kwargs={"skip": 3}))
    assert fit(folder, env_kwargs={"skip": 1, "render_mode": "rgb_array"})[1] == []


def test_another_id_is_said_and_its_own_arguments_are_no_mismatch(tmp_path: Path) -> None:
    _, said = fit(save(tmp_path), "test/other-v0")
    assert len(said) == 1 and "test/slider-v0" in said[0] and "test/other-v0" in said[0]


def test_another_time_step_is_refused_where_the_dataset_tells_it(tmp_path: Path) -> None:
    folder = Path(save(tmp_path))
    own = json.loads((folder / "data" / "metadata.json").read_text())["pcil"]
    assert own["origin"]["step_seconds"] == 0.1
    edit_metadata(folder / "data", pcil=own | {"origin": own["origin"] | {"step_seconds": 0.02}})
    assert "0.02 s there and 0.1 s here" in refusal(lambda: fit(str(folder)))
    assert "0.02 s there" in fit(str(folder), demos_mismatch="keep")[1][0]
    edit_metadata(folder / "data", pcil=own | {"origin": own["origin"] | {"step_seconds": None}})
    assert fit(str(folder))[1] == []


@pytest.mark.parametrize("odd", [{"kwargs": [1]}, {"action_low": ["a", "b"]}, {"step_seconds": "1"}, {"speed": 1}])
def test_an_origin_of_nonsense_is_refused(odd: dict[str, Any], tmp_path: Path) -> None:
    folder = Path(save(tmp_path))
    own = json.loads((folder / "data" / "metadata.json").read_text())["pcil"]
    edit_metadata(folder / "data", pcil=own | {"origin": own["origin"] | odd})
    assert "can not be read" in refusal(lambda: fit(str(folder)))


def test_what_ships_fits_and_another_action_repeat_does_not() -> None:
    assert fit("walker_walk", "walker_walk")[1] == []
    message = refusal(lambda: fit("walker_walk", "walker_walk", env_kwargs={"action_repeat": 4}))
    assert "action_repeat is 2 there and 4 here" in message


def test_a_recording_keeps_its_environment_through_saving(tmp_path: Path) -> None:
    loaded = Demonstrations.load(save(tmp_path, "test/wide-v0", skip=2))
    assert loaded.origin == Origin("test/wide-v0", "test_fit:Slider", {"bound": 10.0, "skip": 2}, [-10] * 2, [10] * 2, 0.2)
    assert Demonstrations.load(loaded.save(tmp_path / "again")).origin == loaded.origin
    spec = json.loads(json.loads((tmp_path / "again" / "data" / "metadata.json").read_text())["env_spec"])
    assert spec["kwargs"] == {"bound": 10.0, "skip": 2}


def test_a_recorded_action_is_measured_in_the_bounds_of_its_environment(tmp_path: Path) -> None:
    """As played: the action in the environment was 7 of 10, however the environment was made."""
    ours, raw = (Demonstrations.load(save(tmp_path / str(k), "test/wide-v0", by_us=k == 1)) for k in range(2))
    np.testing.assert_allclose(ours.action, 0.7, rtol=1e-6)
    assert ours.hash == raw.hash


# --- Out of bounds ---


def loud(folder: Path) -> str:
    """Demonstrations in which the third of 48 entries is out of bounds by 2%."""
    path = Path(save(folder))
    with h5py.File(path / "data" / "main_data.hdf5", "a") as file:
        file["episode_0/actions"][1, 0] = -1.02
    forget_checksum(path / "data")
    return str(path)


def test_actions_out_of_bounds_are_refused_with_the_option_that_clips_them(tmp_path: Path) -> None:
    folder = loud(tmp_path)
    for call in (lambda: fit(folder), lambda: Demonstrations.load(folder)):
        assert "-1.02" in refusal(call) and "--clip-actions" in refusal(call)
    clipped, said = fit(folder, clip_actions=True)
    assert said == ["Clipped 1 of 48 entries of the demonstrations' actions, by at most 0.02."]
    by_hand = Demonstrations.load(folder, bounded=False).clip()
    assert clipped.hash == by_hand.hash and clipped.action.min() == -1
    assert fit(save(tmp_path / "quiet"), clip_actions=True)[1] == []


# --- Missing actions or rewards ---


def stripped(folder: Path, *absent: str, how: str = "from_arrays") -> str:
    """The point mass's demonstrations without some parts, which can be missing in different ways."""
    whole = Demonstrations.load(save_point_mass_demos(folder / "whole"))
    if how == "from_arrays":
        parts = {
            "actions": [episode.action for episode in whole.episodes],
            "rewards": [episode.reward for episode in whole.episodes],
        }
        parts |= dict.fromkeys(absent)
        flags = [episode.terminated for episode in whole.episodes]
        made = Demonstrations.from_arrays(
            [episode.obs for episode in whole.episodes], **parts, terminated=flags, task=POINT_MASS
        )
        return str(made.save(folder / "stripped"))
    with h5py.File(folder / "whole" / "point_mass-v0" / "data" / "main_data.hdf5", "a") as file:
        for group in file.values():
            for key in absent:
                if how == "nan":
                    group[key][...] = np.nan
                else:
                    del group[key]
    forget_checksum(folder / "whole" / "point_mass-v0" / "data")
    return str(folder / "whole" / "point_mass-v0")


READERS = {
    "bc": {},
    "dac": {"reward": {"inputs": "state-action"}},
    "pwil": {"reward": {"inputs": "state-action"}, "label": "stored"},
    "sil": {"reward": {"inputs": "state-action"}, "label": "stored"},
}
PREFILLED = {"reward": {"prefill_steps": 10}, "label": "stored"}


@pytest.mark.parametrize("how", ["from_arrays", "nan", "missing"])
def test_what_is_absent_stays_absent_and_no_one_gets_it(how: str, tmp_path: Path) -> None:
    loaded = Demonstrations.load(stripped(tmp_path, "actions", "rewards", how=how))
    assert not loaded.has_actions and not loaded.has_rewards and loaded.return_mean is None and loaded.return_std is None
    for part in ("action", "returns"):
        assert "have no" in refusal(lambda part=part: getattr(loaded, part))
    again = Demonstrations.load(loaded.save(tmp_path / "again"))
    assert again.hash == loaded.hash and not again.has_actions and not again.has_rewards
    metadata = json.loads((tmp_path / "again" / "data" / "metadata.json").read_text())
    assert metadata["pcil"]["absent"] == ["actions", "rewards"]


@pytest.mark.parametrize("part", ["actions", "rewards"])
def test_a_part_that_only_some_episodes_lack_is_damage(part: str, tmp_path: Path) -> None:
    folder = Path(save_point_mass_demos(tmp_path))
    with h5py.File(folder / "data" / "main_data.hdf5", "a") as file:
        file[f"episode_2/{part}"][...] = np.nan
    assert "Episode 2" in refusal(lambda: Demonstrations.load(folder))


def test_absence_is_part_of_the_hash(tmp_path: Path) -> None:
    whole = Demonstrations.load(save_point_mass_demos(tmp_path))
    quiet = [dataclasses.replace(episode, reward=np.zeros(len(episode))) for episode in whole.episodes]
    variants = [dataclasses.replace(whole, episodes=tuple(quiet), has_rewards=has) for has in (True, False)]
    assert len({variant.hash for variant in variants}) == 2


@pytest.mark.parametrize("method", sorted(REWARDS.keys() - {"expert"}))
def test_methods_of_states_need_neither_actions_nor_rewards(method: str, tmp_path: Path) -> None:
    run = presets.make(POINT_MASS, method, demos=stripped(tmp_path, "actions", "rewards"))
    found = runs.demonstrations(run)
    assert found is not None and found.episodes[0].action.shape == (50, 2)


@pytest.mark.parametrize("method", READERS)
def test_methods_that_read_actions_say_so(method: str, tmp_path: Path) -> None:
    run = small_run(method, demos=stripped(tmp_path, "actions"), **READERS[method])
    assert "no actions" in refusal(lambda: runs.demonstrations(run)) and run.needs_actions
    assert runs.demonstrations(dataclasses.replace(run, demos=stripped(tmp_path / "b", "rewards"))) is not None


def test_a_replay_that_begins_with_demonstrations_reads_them_whole(tmp_path: Path) -> None:
    run = small_run("pwil", demos=stripped(tmp_path, "actions"), **PREFILLED)
    assert "no actions" in refusal(lambda: runs.demonstrations(run))
    without_rewards = dataclasses.replace(run, demos=stripped(tmp_path / "b", "rewards"))
    assert runs.demonstrations(without_rewards) is not None
    paid = dataclasses.replace(without_rewards, reward=dataclasses.replace(run.reward, task_weight=1.0))
    assert "no rewards" in refusal(lambda: runs.demonstrations(paid))


def test_pcil_on_states_alone_is_bit_for_bit_pcil_on_whole_demonstrations(tmp_path: Path) -> None:
    """Without cloning, the actions and rewards have no influence; by default, nothing is cloned where there are no actions."""
    states, whole = stripped(tmp_path / "data", "actions", "rewards"), tmp_path / "data" / "whole" / "point_mass-v0"
    for name, folder in (("states", states), ("whole", str(whole))):
        run = small_run(demos=folder)
        if name == "whole":
            run = dataclasses.replace(run, agent=dataclasses.replace(run.agent, cloning=False))
        result = runs.execute(run, tmp_path / name)
        assert (result.demos_return is None) == (name == "states")
    one, other = (load_policy(tmp_path / name) for name in ("states", "whole"))
    obs = np.random.default_rng(0).normal(size=(64, 2)).astype(np.float32)
    assert one(obs).tobytes() == other(obs).tobytes()
    files = [load_file(tmp_path / name / "policy" / "policy.safetensors") for name in ("states", "whole")]
    assert files[0].keys() == files[1].keys() and all(np.array_equal(files[0][key], files[1][key]) for key in files[0])
    (arrays, *_), (others, *_) = (checkpoint.restore(tmp_path / name / "checkpoint") for name in ("states", "whole"))
    assert arrays is not None and others is not None and arrays.keys() == others.keys()
    assert all(np.array_equal(arrays[name], others[name]) for name in arrays)
    about = json.loads((tmp_path / "states" / "run.json").read_text())
    assert about["demos"]["return_mean"] is None


# --- Plain arrays ---

OBS = [np.arange(8.0).reshape(4, 2), [[1, 2], [3, 4]]]
ACTIONS = [np.zeros((3, 1)), [[0.5]]]
REWARDS_GIVEN = [[1, 2, 3], [4.5]]


def test_arrays_become_demonstrations() -> None:
    made = Demonstrations.from_arrays(OBS, ACTIONS, REWARDS_GIVEN, [True, False], task="mine")
    assert made.validate(None).returns.tolist() == [6, 4.5] and made.num_steps == 4 and made.task == "mine"
    assert [episode.terminated for episode in made.episodes] == [True, False]
    np.testing.assert_array_equal(made.obs, [[0, 1], [2, 3], [4, 5], [1, 2]])
    assert made.action.dtype == made.obs.dtype == np.float32
    loud = Demonstrations.from_arrays(OBS, [a + np.ones(1) for a in map(np.array, ACTIONS)])
    assert "--clip-actions" in refusal(lambda: loud.validate(None)) and loud.clip().validate(None).action.max() == 1


@pytest.mark.parametrize(
    ("call", "expected"),
    [
        (lambda: Demonstrations.from_arrays([]), "no episodes"),
        (lambda: Demonstrations.from_arrays(7), "obs is of type int"),
        (lambda: Demonstrations.from_arrays([[[1, 2], [3]]]), r"obs\[0\] is ragged"),
        (lambda: Demonstrations.from_arrays([[1, 2, 3]]), r"obs\[0\] has shape \(3,\)"),
        (lambda: Demonstrations.from_arrays(np.zeros((4, 2))), r"obs\[0\] has shape \(2,\)"),
        (lambda: Demonstrations.from_arrays([np.zeros((4, 0))]), r"obs\[0\] has shape \(4, 0\)"),
        (lambda: Demonstrations.from_arrays([np.zeros((1, 2))]), r"obs\[0\] has 1 rows"),
        (lambda: Demonstrations.from_arrays([np.zeros((4, 2)), np.zeros((4, 3))]), r"Episode 1.*\(4, 3\)"),
        (lambda: Demonstrations.from_arrays([[["a"], ["b"]]]), r"obs\[0\] holds <U1"),
        (lambda: Demonstrations.from_arrays([np.full((4, 2), np.nan)]), r"obs\[0\] holds NaN"),
        (lambda: Demonstrations.from_arrays([np.full((4, 2), 1e300)]), r"obs\[0\] holds NaN, inf.*too large"),
        (lambda: Demonstrations.from_arrays(OBS, ACTIONS[:1]), "actions has 1 entries, but obs has 2"),
        (lambda: Demonstrations.from_arrays(OBS, [np.zeros((4, 1)), [[0.5]]]), r"actions\[0\] has 4 rows; it must have 3"),
        (lambda: Demonstrations.from_arrays(OBS, [np.zeros(3), [0.5]]), r"actions\[0\] has shape \(3,\)"),
        (lambda: Demonstrations.from_arrays(OBS, [np.zeros((3, 0)), [[]]]), r"actions\[0\] has shape \(3, 0\)"),
        (lambda: Demonstrations.from_arrays(OBS, [np.zeros((3, 1)), [[0.5, 1]]]), r"Episode 1.*\(1, 2\)"),
        (lambda: Demonstrations.from_arrays(OBS, None, [[1, 2, 3], [[4]]]), r"rewards\[1\] has shape \(1, 1\)"),
        (lambda: Demonstrations.from_arrays(OBS, None, [[1, np.inf, 3], [4]]), r"rewards\[0\] holds NaN"),
        (lambda: Demonstrations.from_arrays(OBS, None, None, [True]), "terminated has 1 entries"),
        (lambda: Demonstrations.from_arrays(OBS, None, None, [True, [False]]), r"terminated\[1\] is \[False\]"),
    ],
)
def test_arrays_that_do_not_fit_are_refused(call: Callable[[], object], expected: str) -> None:
    message = refusal(lambda: _with_capital(call))
    assert re.search(expected, message), message


def _with_capital(call: Callable[[], object]) -> None:
    """Allow a message that begins with the name of an argument."""
    try:
        call()
    except InputError as error:
        text = str(error)
        raise InputError(f"'{text}" if text[0].islower() else text) from None


# --- Arguments of the environment, wherever a run's environment is made ---


def test_a_run_and_its_policy_carry_their_arguments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[dict[str, Any]] = []
    make = gymnasium.make
    monkeypatch.setattr(gymnasium, "make", lambda name, **kwargs: made.append(kwargs) or make(name, **kwargs))
    run = small_run(task="test/slider-v0", demos=save(tmp_path, skip=5), env_kwargs={"skip": 5})
    made.clear()
    runs.execute(run, tmp_path / "run")
    assert len(made) >= 4 and all(kwargs.get("skip") == 5 for kwargs in made)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["run"]["env_kwargs"] == {"skip": 5}
    assert load_policy(tmp_path / "run").env_kwargs == {"skip": 5}
    with pytest.raises(InputError, match=r"env_kwargs.skip was 5, now 3"):
        other = dataclasses.replace(run, env_kwargs={"skip": 3}, demos_mismatch="keep")
        runs.execute(other, tmp_path / "run")


def test_an_older_run_had_no_arguments_whatever_is_given_now(tmp_path: Path) -> None:
    folder, run = tmp_path / "run", small_run(demos=save_point_mass_demos(tmp_path))
    runs.execute(run, folder)
    about = json.loads((folder / "run.json").read_text())
    for name in ("env_kwargs", "clip_actions", "demos_mismatch"):
        del about["run"][name]
    (folder / "run.json").write_text(json.dumps(about))
    runs.execute(run, folder)
    with pytest.raises(InputError, match="clip_actions was False, now True"):
        runs.execute(dataclasses.replace(run, clip_actions=True), folder)


@pytest.mark.parametrize("value", [[1], "x", "[1]", {1: 2}, {"a": {1, 2}}, {"a": float("nan")}, "[" * 100_000])
def test_arguments_are_a_json_object(value: Any) -> None:
    message = refusal(lambda: _with_capital(lambda: json_object("env_kwargs", value)))
    assert "JSON object" in message and len(message) < 250


def test_a_run_refuses_arguments_that_json_can_not_hold() -> None:
    with pytest.raises(InputError, match="env_kwargs"):
        presets.make("walker_walk", env_kwargs={"a": float("nan")})


def test_arguments_survive_json() -> None:
    run = presets.make("walker_walk", env_kwargs={"a": (1, 2), "b": {"c": None}})
    assert run == dataclasses.replace(run, env_kwargs=run.to_json()["env_kwargs"]) and isinstance(run, Run)
    assert run.env_kwargs == {"a": [1, 2], "b": {"c": None}}
    plain = presets.make("walker_walk")
    assert len({run, plain, presets.make("walker_walk")}) == 2, "a run can be hashed, and its arguments are part of the hash"


@pytest.mark.parametrize(
    ("task", "kwargs"), [(POINT_MASS, {"speed": 2}), ("walker_walk", {"speed": 2}), ("Pendulum-v1", {"x": 1})]
)
def test_arguments_that_an_environment_does_not_take_are_refused(task: str, kwargs: dict[str, Any]) -> None:
    (name,) = kwargs
    assert name in refusal(lambda: envs.make(task, env_kwargs=kwargs))


def test_arguments_reach_dm_control() -> None:
    env = envs.make("pendulum_swingup", env_kwargs={"action_repeat": 4})
    assert envs.spec(env).action_repeat == 4 and envs.origin(env).step_seconds == pytest.approx(0.08)
    for odd in ({"action_repeat": 2.5}, {"action_repeat": 0}, {"task": "hopper_hop"}):
        with pytest.raises(InputError, match=next(iter(odd))):
            envs.make("pendulum_swingup", env_kwargs=odd)


def test_the_loop_gives_rewards_of_states_no_action_of_absent_ones(tmp_path: Path) -> None:
    run = small_run(demos=stripped(tmp_path, "actions"))
    found = runs.demonstrations(run)
    assert found is not None
    state = start(run, envs.spec(envs.make(POINT_MASS)), found.episodes)
    assert state.expert is not None and not state.expert.sample(np.random.default_rng(0), 8, 1).action.any()
