"""All ways to name an environment, and the errors for names and spaces that do not work."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from pcil import cli, envs
from pcil.bench.environment import measure_env
from pcil.demos import shipped_tasks
from pcil.envs import TASKS, make, register, spec, task_name
from pcil.envs.toy import PointMass
from pcil.errors import InputError
from pcil.training import runs
from pcil.types import Spec
from small import small_run

SPECS = {
    "finger_spin": Spec(9, 2, 2),
    "hopper_stand": Spec(15, 4, 2),
    "pendulum_swingup": Spec(3, 1, 2),
    "walker_stand": Spec(24, 6, 2),
    "walker_walk": Spec(24, 6, 2),
    "acrobot_swingup": Spec(6, 1, 2),
    "cheetah_run": Spec(17, 6, 2),
    "hopper_hop": Spec(15, 4, 2),
    "quadruped_run": Spec(78, 12, 2),
    "walker_run": Spec(24, 6, 2),
}


class DictEnv(gymnasium.Env):
    """A dictionary of two boxes, one of them a matrix, and actions with other bounds."""

    def __init__(self, action_space: spaces.Space | None = None, observation_space: spaces.Space | None = None) -> None:
        low, high = np.array([0.0, -2.0]), np.array([1.0, 4.0])
        self.action_space = action_space or spaces.Box(low, high, dtype=np.float64)
        boxes = {"b": spaces.Box(-9.0, 9.0, (2, 2), np.float64), "a": spaces.Box(-9.0, 9.0, (1,), np.float32)}
        self.observation_space = observation_space or spaces.Dict(boxes)
        self.last_action = None

    def _obs(self) -> dict[str, np.ndarray]:
        return {"b": np.array([[1.0, 2.0], [3.0, 4.0]]), "a": np.array([5.0], np.float32)}

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        return self._obs(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict]:
        self.last_action = action
        return self._obs(), 0.0, False, False, {}


@pytest.fixture
def register_env() -> Iterator[Any]:
    """Registers environments as `pcil_test/...` for the duration of a test."""
    yield lambda name, entry_point, **kwargs: gymnasium.register(f"pcil_test/{name}", entry_point, kwargs=kwargs)
    for env_id in [env_id for env_id in gymnasium.registry if env_id.startswith("pcil_test/")]:
        del gymnasium.registry[env_id]


def test_public_names() -> None:
    assert set(envs.__all__) == {"TASKS", "Checked", "checked", "ends_early", "make", "opened", "register", "spec", "task_name"}


@pytest.mark.parametrize("task", TASKS)
def test_the_ten_have_their_sizes_and_no_wrapper(task: str) -> None:
    env = make(task)
    assert spec(env) == SPECS[task]
    assert type(env) is envs.Checked and env.env is env.unwrapped, "only the checks wrap it"
    assert env.spec.id == f"dmc/{task}-v0"
    assert env.observation_space.dtype == env.action_space.dtype == np.float32
    assert np.all(env.action_space.low == -1.0) and np.all(env.action_space.high == 1.0)


def test_a_task_has_one_name() -> None:
    register()
    assert isinstance(gymnasium.make("dmc/walker_walk-v0"), type(make("walker_walk").unwrapped))
    assert make("dmc/walker_walk-v0").spec == make("walker_walk").spec
    assert task_name("dmc/walker_walk-v0") == task_name("walker_walk") == "walker_walk"
    assert task_name("Pendulum-v1") == "Pendulum-v1" and task_name("toy/probe_1-v0") == "toy/probe_1-v0"


@pytest.mark.parametrize("task", ["ball_in_cup_catch", "dmc/humanoid_CMU_run-v0"])
def test_other_tasks_of_the_suite_register_on_demand(task: str) -> None:
    gymnasium.registry.pop(f"dmc/{task_name(task)}-v0", None)
    assert make(task).spec.id == f"dmc/{task_name(task)}-v0"


def test_a_gymnasium_env_is_flattened_and_rescaled(register_env: Any) -> None:
    register_env("Dict-v0", DictEnv)
    env = make("pcil_test/Dict-v0")
    assert spec(env) == Spec(5, 2, 1)
    assert env.observation_space.dtype == env.action_space.dtype == np.float32
    obs, _ = env.reset(seed=0)
    assert obs.dtype == np.float32
    np.testing.assert_array_equal(obs, [5.0, 1.0, 2.0, 3.0, 4.0])  # Gymnasium sorts the names
    for action, received in ((-1.0, [0.0, -2.0]), (0.0, [0.5, 1.0]), (1.0, [1.0, 4.0])):
        env.step(np.full(2, action, np.float32))
        np.testing.assert_allclose(env.unwrapped.last_action, received, atol=1e-15)
        assert env.unwrapped.last_action.dtype == np.float64


@pytest.mark.parametrize(
    ("box", "received"),
    [
        (spaces.Box(-np.inf, np.inf, (2,), np.float64), [[-2.0, -2.0], [3.0, 3.0]]),
        (spaces.Box(np.array([-np.inf, 0.0]), np.array([0.5, np.inf]), dtype=np.float64), [[-2.0, 0.0], [0.5, 3.0]]),
    ],
)
def test_actions_without_bounds_are_given_some(box: spaces.Box, received: list[list[float]], register_env: Any) -> None:
    """Those that have a bound keep it."""
    register_env("Open-v0", DictEnv, action_space=box)
    env = make("pcil_test/Open-v0", env_kwargs={"action-bounds": [-2, 3.0]})
    env.reset(seed=0)
    for sign, expected in zip((-1.0, 1.0), received, strict=True):
        env.step(np.full(2, sign, np.float32))
        np.testing.assert_allclose(env.unwrapped.last_action, expected, atol=1e-15)
    assert envs.origin(env)[3:5] == tuple(received)
    given = make(DictEnv(action_space=box), env_kwargs={"action-bounds": [-2, 3.0]})
    assert envs.origin(given)[3:5] == tuple(received)


@pytest.mark.parametrize("bounds", [[1, 1], [2, 1], [1], "wide", [0, float("inf")], [None, 1], 3])
def test_bounds_are_two_numbers(bounds: Any) -> None:
    env = DictEnv(action_space=spaces.Box(-np.inf, np.inf, (2,)))
    with pytest.raises(InputError, match="must be two numbers, the lower one first"):
        make(env, env_kwargs={"action-bounds": bounds})


def test_bounds_that_do_not_fit_the_actions_are_refused() -> None:
    with pytest.raises(InputError, match="already; leave out --action-bounds"):
        make("Pendulum-v1", env_kwargs={"action-bounds": [-1, 1]})
    with pytest.raises(InputError, match="don't fit the actions"):
        make(DictEnv(action_space=spaces.Box(5.0, np.inf, (2,))), env_kwargs={"action-bounds": [-1, 1]})


def test_a_real_gymnasium_env_works() -> None:
    env = make("Pendulum-v1")
    assert spec(env) == Spec(3, 1, 1)
    env.reset(seed=0)
    obs, _, _, truncated, _ = [env.step(env.action_space.sample()) for _ in range(200)][-1]
    assert obs.dtype == np.float32 and truncated  # its own time limit is kept


def test_an_episode_without_an_end_is_refused(register_env: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """If Gymnasium knows no time limit; the count starts again with each episode."""
    monkeypatch.setattr(envs, "LONGEST_EPISODE", 5)
    register_env("Dict-v0", DictEnv)
    env, action = make("pcil_test/Dict-v0"), np.zeros(2, np.float32)
    for _ in range(2):
        env.reset(seed=0)
        for _ in range(5):
            env.step(action)
    with pytest.raises(InputError, match=r"'pcil_test/Dict-v0' has not ended after 5 steps.*max_episode_steps"):
        env.step(action)
    limited = make("Pendulum-v1")
    limited.reset(seed=0)
    assert [limited.step(limited.action_space.sample())[3] for _ in range(6)] == [False] * 6


@pytest.mark.parametrize(
    ("spaces_given", "message"),
    [
        ({"action_space": spaces.Discrete(2)}, r"actions of 'pcil_test/Bad-v0' must be a flat Box.*Discrete\(2\)"),
        ({"action_space": spaces.Box(-1.0, 1.0, (2, 2))}, "must be a flat Box"),
        ({"action_space": spaces.Box(-np.inf, np.inf, (2,))}, "must have finite bounds.*--action-bounds LOW HIGH"),
        ({"observation_space": spaces.Discrete(2)}, "observations of 'pcil_test/Bad-v0' must be a Box or a Dict"),
        ({"observation_space": spaces.Dict({"a": spaces.Discrete(2)})}, "must be a Box or a Dict of Boxes"),
    ],
)
def test_other_spaces_are_refused(register_env: Any, spaces_given: dict[str, spaces.Space], message: str) -> None:
    register_env("Bad-v0", DictEnv, **spaces_given)
    with pytest.raises(InputError, match=message):
        make("pcil_test/Bad-v0")


@pytest.mark.parametrize("name", ["nonsense", "walker walk!", "dmc/walker_fly-v0", "pcil_test/None-v0", ""])
def test_unknown_names_list_what_there_is(name: str) -> None:
    with pytest.raises(InputError) as error:
        make(name)
    assert all(task in str(error.value) for task in TASKS) and "any Gymnasium id" in str(error.value)


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("walker_wlak", "walker_walk"),
        ("ball_in_cup_cath", "ball_in_cup_catch"),
        ("Pendulm-v1", "Pendulum-v1"),
        ("toy/point_mas-v0", "toy/point_mass-v0"),
    ],
)
def test_near_misses_are_recognised(name: str, meant: str) -> None:
    with pytest.raises(InputError, match=f"did you mean '{meant}'"):
        make(name)


def test_an_environment_of_ones_own_is_found_or_refused_with_its_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    text = "import gymnasium\ngymnasium.register('pcil_test/Own-v0', 'gymnasium.envs.classic_control:PendulumEnv')\n"
    Path("my_own_module.py").write_text(text)
    Path("my_bad_module.py").write_text("raise ValueError('boom')\n")
    assert spec(make("my_own_module:pcil_test/Own-v0")).obs_dim == 3
    del gymnasium.registry["pcil_test/Own-v0"]
    with pytest.raises(InputError, match=r"can't be made \(ValueError: boom\)"):
        make("my_bad_module:pcil_test/Own-v0")


def test_a_missing_package_is_named(register_env: Any) -> None:
    register_env("Missing-v0", "package_that_is_not:Env")
    for name in ("pcil_test/Missing-v0", "package_that_is_not:Env-v0"):
        with pytest.raises(InputError, match="not installed: No module named 'package_that_is_not'"):
            make(name)


def test_a_robot_of_gymnasiums_names_the_packages_that_bring_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("gymnasium.envs.mujoco")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "imageio", None)
    with pytest.raises(InputError, match=r"not installed: .*imageio.*; pip install \"gymnasium\[mujoco\]\" brings it\.$"):
        make("Hopper-v5")


def test_timing_has_bare_physics_only_for_deepmind_control() -> None:
    measured = measure_env("pendulum_swingup", episodes=1)
    assert measured.keys() == {"env_step_us", "physics_us", "ratio"}
    assert measured["env_step_us"] > measured["physics_us"] > 0.0
    with pytest.raises(InputError, match="bare physics"):
        measure_env("toy/point_mass-v0")


@pytest.fixture
def without_dmc(monkeypatch: pytest.MonkeyPatch) -> None:
    """As with a Python version for which dm-control can't be installed."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "dm_control"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "dm_control", None)


@pytest.mark.usefixtures("without_dmc")
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("train walker_walk --out run", "DeepMind Control is not installed here .*pip install"),
        ("train dmc/walker_walk-v0 --out run", "DeepMind Control is not installed here .*pip install"),
        ("train humanoid_walk --out run", "no environment 'humanoid_walk' where DeepMind Control is not installed"),
        ("train Pendulum-v9 --out run", "Pendulum"),
        ("bench", "DeepMind Control is not installed here"),
        ("evaluate POLICIES/walker_walk", "DeepMind Control is not installed here"),
        ("record POLICIES/walker_walk --out new", "DeepMind Control is not installed here"),
    ],
)
def test_without_deepmind_control_its_tasks_say_what_is_missing(
    words: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policies = str(Path(envs.__file__).parent.parent / "data" / "policies")
    assert cli.main(words.replace("POLICIES", policies).split()) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and re.search(said, err) and not list(tmp_path.iterdir())


@pytest.mark.usefixtures("without_dmc")
def test_without_deepmind_control_all_else_works(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Included demonstrations are listed, other environments are made, and a run records its versions."""
    assert cli.main(["demos", "--json"]) == 0
    assert [row["task"] for row in json.loads(capsys.readouterr().out)] == shipped_tasks()
    assert spec(make("toy/point_mass-v0")) and spec(make("Pendulum-v1")) == Spec(3, 1, 1)
    real = metadata.version

    def version(name: str) -> str:
        if name == "dm-control":
            raise metadata.PackageNotFoundError(name)
        return real(name)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(metadata, "version", version)
        runs.execute(small_run("expert", frames=150), tmp_path / "run")
    versions = json.loads((tmp_path / "run" / "run.json").read_text())["versions"]
    assert versions["jax"] == real("jax") and "dm-control" not in versions


def test_an_environment_of_the_package_says_how_many_frames_its_steps_take() -> None:
    class Repeating(PointMass):
        """An environment with an action repeat."""

        action_repeat = 3

    assert envs.spec(envs.make(PointMass)).action_repeat == 1
    assert envs.spec(envs.make(Repeating)).action_repeat == 3


def test_a_suite_is_one_entry_of_the_list(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(envs.SUITES, "grid", {"small": ("pcil.envs.toy:PointMass", {})})
    envs.register()
    try:
        env = envs.make("grid/small-v0")
    finally:
        del gymnasium.registry["grid/small-v0"]
    assert env.spec.id == "grid/small-v0" and isinstance(env.unwrapped, PointMass)
