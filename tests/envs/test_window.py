"""`pcil play` shows every state of the policy's episodes, and says what is missing where no window can be opened."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import jax
import mujoco.viewer
import numpy as np
import pytest

from pcil import cli
from pcil.envs import dmc, window
from pcil.nets.networks import Actor
from pcil.policy import Policy
from pcil.seeds import Stream, episode_seed


class Shown(gymnasium.Env):
    """Ends after three steps of reward 2, and notes how it is used in `seen`."""

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 20}  # noqa: RUF012  as gymnasium.Env declares it
    observation_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    seen: list[Any] = []  # noqa: RUF012  by all of them

    def __init__(self, render_mode: str | None = None, fails_at: int | None = None) -> None:
        self.render_mode, self.fails_at = render_mode, fails_at
        self.seen.append(render_mode)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.time = 0
        self.draw()
        self.seen.append(seed)
        return np.zeros(3, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.time += 1
        self.draw()
        return np.zeros(3, np.float32), 2.0, False, self.time == 3, {}

    def draw(self) -> None:
        if self.time == self.fails_at:
            raise RuntimeError("No available video device")

    def close(self) -> None:
        self.seen.append("closed")


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[str]:
    """The task, of which `run` has a policy. There is a display, which the environment does not use."""
    gymnasium.register(name := "test/shown-v0", Shown, disable_env_checker=True)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(Shown, "seen", [])
    Policy(Actor.init(3, 2, 4, 8, key=jax.random.key(0)), name).save(tmp_path / "run")
    yield name
    del gymnasium.registry[name]


def test_an_environment_shows_itself(shown: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["play", "run", "--episodes", "2", "--seed", "4"]) == 0
    assert capsys.readouterr().out == f"{shown}: episode 1, return 6.0\n{shown}: episode 2, return 6.0\n"
    assert Shown.seen == ["human", *(episode_seed(4, Stream.EVALUATE, i) for i in range(2)), "closed"]


@pytest.mark.usefixtures("shown")
def test_a_window_that_the_environment_can_not_open_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["play", "run", "--env-kwargs", '{"fails_at": 0}']) == 2
    out, err = capsys.readouterr()
    assert out == "" and "No window can be opened: " in err and "pcil film makes a film" in err
    assert "raised RuntimeError (No available video device)" in err and err.count("\n") == 1


@pytest.mark.usefixtures("shown")
def test_an_environment_that_fails_in_its_window_has_failed(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["play", "run", "--env-kwargs", '{"fails_at": 2}']) == 1
    err = capsys.readouterr().err
    assert "raised RuntimeError (No available video device)" in err and "No window" not in err and err.count("\n") == 1


NO_DISPLAY = ("DISPLAY", "WAYLAND_DISPLAY")


@pytest.mark.skipif(sys.platform in ("darwin", "win32"), reason="there is always a display")
@pytest.mark.parametrize("policy", ["run", "walker_walk"])
@pytest.mark.usefixtures("shown")
def test_without_a_display_the_sentence_names_the_film(
    policy: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in NO_DISPLAY:
        monkeypatch.delenv(name, raising=False)
    assert cli.main(["play", policy]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and Shown.seen == []
    assert "there is no display here" in err and "pcil film makes a film of the policy without one" in err


@pytest.mark.parametrize(("words", "why"), [("nowhere", "holds no policy"), ("run --episodes 0", "--episodes is 0")])
@pytest.mark.usefixtures("shown")
def test_bad_input_opens_no_window(words: str, why: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["play", *words.split()]) == 2 and why in capsys.readouterr().err and Shown.seen == []


# --- MuJoCo's viewer ---


class Viewer:
    """Stands in for MuJoCo's: notes each shown time, and is closed by the user after `last` of them."""

    def __init__(self, last: int) -> None:
        self.last, self.times, self.closed, self.opened = last, [], 0, 0

    def launch(self, model: Any, data: Any, **options: Any) -> Any:
        assert isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData)
        self.data, self.opened = data, self.opened + 1
        return SimpleNamespace(sync=self.sync, is_running=lambda: len(self.times) < self.last, close=self.close)

    def sync(self) -> None:
        self.times.append(round(self.data.time, 3))

    def close(self) -> None:
        self.closed += 1


@pytest.fixture
def viewer(monkeypatch: pytest.MonkeyPatch) -> Viewer:
    """A display and a viewer that are none, and time that does not pass while one sleeps."""
    dmc.import_suite()
    made = Viewer(last=1000)
    glfw = pytest.importorskip("glfw")
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(glfw, "init", lambda: True)
    monkeypatch.setattr(mujoco.viewer, "launch_passive", made.launch)
    monkeypatch.setattr(window.time, "sleep", lambda seconds: None)
    return made


REPEAT = '{"action_repeat": 250}'


def test_the_viewer_shows_every_state(viewer: Viewer, capsys: pytest.CaptureFixture[str]) -> None:
    """A pendulum's episode of 1000 control steps of 0.02 s is four actions of 250: five states."""
    assert cli.main(["play", "pendulum_swingup", "--episodes", "2", "--env-kwargs", REPEAT]) == 0
    assert capsys.readouterr().out.count("episode") == 2
    assert viewer.times == [0, 5, 10, 15, 20] * 2 and (viewer.opened, viewer.closed) == (1, 1)


def test_closing_the_viewer_ends_the_command(viewer: Viewer, capsys: pytest.CaptureFixture[str]) -> None:
    viewer.last = 7
    assert cli.main(["play", "pendulum_swingup", "--env-kwargs", REPEAT]) == 0
    assert len(viewer.times) == 7 and viewer.closed == 1 and capsys.readouterr().out.count("episode") == 1


def test_states_are_shown_in_real_time(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock is moved by sleeping, and where the policy is slow. After a second, one step is hurried, and not ten."""
    clock = SimpleNamespace(now=100.0, slept=[])

    def sleep(seconds: float) -> None:
        clock.slept.append(round(seconds, 6))
        clock.now += seconds

    monkeypatch.setattr(window, "time", SimpleNamespace(sleep=sleep, monotonic=lambda: clock.now))
    with window.opened("pendulum_swingup", {"action_repeat": 5}) as (env, refresh):
        env.reset(seed=0)
        for delay in (0.0, 0.04, 1.0, 0.0, 0.0):
            clock.now += delay
            refresh()
    assert clock.slept == [0.1, 0.06, 0.0, 0.0, 0.1]
    assert viewer.opened == 1


def test_an_episode_with_a_new_model_opens_the_window_again(viewer: Viewer) -> None:
    with window.opened("lqr_lqr_2_1", {}) as (env, refresh):
        for seed in (1, 2):
            env.reset(seed=seed)
            refresh(), refresh()
    assert (viewer.opened, viewer.closed) == (2, 2)


def test_what_glfw_says_is_in_the_sentence(viewer: Viewer, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr("glfw.init", lambda: False)
    assert cli.main(["play", "pendulum_swingup"]) == 2
    assert "GLFW can't use the display" in capsys.readouterr().err and viewer.opened == 0


def test_what_macos_needs_is_in_the_sentence(viewer: Viewer, monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    def launch(*_: Any, **__: Any) -> Any:
        raise RuntimeError("it requires `mjpython`")

    monkeypatch.setattr(mujoco.viewer, "launch_passive", launch)
    assert cli.main(["play", "pendulum_swingup"]) == 2 and "requires `mjpython`" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform in ("darwin", "win32"), reason="there is always a display")
def test_an_unusable_display_is_no_crash() -> None:
    """In a new process, with MuJoCo's own viewer and GLFW."""
    dmc.import_suite()
    environment = {**os.environ, "DISPLAY": ":no-such-display"}
    environment.pop("WAYLAND_DISPLAY", None)
    command = [sys.executable, "-m", "pcil", "play", "pendulum_swingup"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2 and "pcil: No window can be opened: GLFW can't use the display" in done.stderr, done.stderr
