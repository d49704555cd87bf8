"""A film shows episodes of the policy, picture by picture; if nothing can be shown, a message says so."""

from __future__ import annotations

import dataclasses
import io
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import imageio_ffmpeg
import jax
import numpy as np
import pytest
from PIL import Image

from fake_runs import fake_run
from pcil import cli, demos
from pcil.demos import Demonstrations
from pcil.envs import make
from pcil.nets.networks import Actor
from pcil.policy import Policy
from pcil.report import film
from pcil.report.load import collect
from pcil.seeds import Stream, episode_seed


class Clock(gymnasium.Env):
    """Ends after ten steps; the brightness of a picture is the number of steps."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012  as gymnasium.Env declares it
    observation_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    seeds: list[int | None] = []  # noqa: RUF012  of all of them
    cameras: list[Any] = []  # noqa: RUF012

    def __init__(self, render_mode: str | None = None, camera_id: Any = 0) -> None:
        self.render_mode = render_mode
        self.cameras.append(camera_id)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.time = 0
        return np.zeros(3, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert action.shape == (2,)
        self.time += 1
        return np.zeros(3, np.float32), self.time - 1.0, False, self.time == 10, {}

    def render(self) -> np.ndarray:
        return np.full((24, 32, 3), 20 * self.time, np.uint8)


@pytest.fixture
def clock() -> Iterator[str]:
    gymnasium.register(name := "test/clock-v0", Clock, disable_env_checker=True)
    yield name
    del gymnasium.registry[name]


def with_policy(folder: Path, task: str) -> Path:
    Policy(Actor.init(3, 2, 4, 8, key=jax.random.key(0)), task, {"seed": 1}).save(folder / "policy")
    return folder


def test_a_film_has_a_picture_for_every_so_many_steps(tmp_path: Path, clock: str) -> None:
    """Steps 0, 4 and 8 of the ten; 4 steps at 20 steps per second are 200 ms."""
    animation = Image.open(io.BytesIO(film.film(with_policy(tmp_path / "run", clock))))
    assert (animation.format, animation.size, animation.n_frames, animation.info["loop"]) == ("WEBP", (32, 24), 3, 0)
    shades = []
    for number in range(3):
        animation.seek(number)
        animation.load()
        shades.append(int(np.asarray(animation.convert("RGB")).mean()))
        assert animation.info["duration"] == 200
    assert shades == pytest.approx([0, 80, 160], abs=3)


def test_a_film_is_short(tmp_path: Path, clock: str) -> None:
    animation = Image.open(io.BytesIO(film.film(with_policy(tmp_path / "run", clock), steps=6, every=2)))
    assert animation.n_frames == 3


def test_the_first_seed_of_each_method_is_shown_and_the_rest_is_said(tmp_path: Path, clock: str) -> None:
    """Point mass has no pictures, and a run may have no policy yet."""
    for seed in (2, 1):
        with_policy(fake_run(tmp_path / f"clock-{seed}", [1.0], clock, seed=seed), clock)
    with_policy(fake_run(tmp_path / "mass", [1.0], "toy/point_mass-v0"), "toy/point_mass-v0")
    fake_run(tmp_path / "young", [1.0], clock, "dac")
    found = collect([tmp_path])
    films = film.films(found)
    assert list(films) == ["test/clock-v0, pcil, default, seed 1"]
    (note,) = found.notes
    assert note.startswith("2 of 3 animations are left out: ") and "holds no policy" in note


# --- pcil film ---


def brightness(image: Image.Image) -> int:
    return int(np.asarray(image.convert("RGB")).mean().round())


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The sentence with which the command refuses; it leaves no file."""
    before = sorted(Path.cwd().rglob("*"))
    assert cli.main(words) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("pcil: ") and err.count("\n") == 1 and "Traceback" not in err
    assert sorted(Path.cwd().rglob("*")) == before
    return err


def shades_of(path: Path) -> tuple[list[int], list[float]]:
    """The brightness of each picture of a GIF, and how long it is shown in milliseconds."""
    with Image.open(path) as animation:
        shades, durations = [], []
        for number in range(animation.n_frames):
            animation.seek(number)
            shades.append(brightness(animation))
            durations.append(animation.info["duration"])
    return shades, durations


def test_a_gif_shows_every_step_of_every_episode(tmp_path: Path, clock: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Two episodes of ten steps at 20 steps per second; each step makes a picture brighter by 20."""
    with_policy(tmp_path / "run", clock)
    assert cli.main(["film", "run", "--out", "new/film.gif", "--episodes", "2", "--fps", "20"]) == 0
    assert capsys.readouterr().out == f"{clock}: {Path('new') / 'film.gif'}, 20 pictures, return 45.0  45.0\n"
    shades, durations = shades_of(tmp_path / "new" / "film.gif")
    assert shades == pytest.approx([20 * step for step in range(10)] * 2, abs=2) and durations == [50] * 20
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["film.gif"]


@pytest.mark.parametrize(("fps", "every"), [("50", 1), ("10", 2), ("5", 4), ("0.1", 200)])
def test_a_film_shows_real_time(fps: str, every: int, tmp_path: Path, clock: str) -> None:
    with_policy(tmp_path / "run", clock)
    assert cli.main(["film", "run", "--out", "film.gif", "--fps", fps]) == 0
    shades, durations = shades_of(tmp_path / "film.gif")
    assert shades == pytest.approx([20 * step for step in range(0, 10, every)], abs=2)
    assert set(durations) <= {50 * every} or len(durations) == 1


def decoded(path: Path, width: int, height: int) -> np.ndarray:
    """The pictures `[count, height, width, 3]` of a film, which ffmpeg can only return if they have this size."""
    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-loglevel",
        "error",
        "-i",
        str(path),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    content = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(content, np.uint8).reshape(-1, height, width, 3)


def test_an_mp4_can_be_read_again(tmp_path: Path, clock: str) -> None:
    """Pictures of 32 x 24 are scaled to 65 x 41, and lose the last column and row, for H.264 needs even sizes."""
    with_policy(tmp_path / "run", clock)
    assert cli.main(["film", "run", "--out", "film.mp4", "--size", "65", "41"]) == 0
    shades = decoded(tmp_path / "film.mp4", 64, 40).mean(axis=(1, 2, 3))
    assert shades.tolist() == pytest.approx([20 * step for step in range(10)], abs=6)


def test_the_sentence_says_what_ffmpeg_says(
    tmp_path: Path, clock: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "ffmpeg"
    program.write_text("#!/bin/sh\necho no codec >&2; exit 3\n")
    program.chmod(0o755)
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(program))
    with_policy(tmp_path / "run", clock)
    assert "can't be written (ffmpeg: no codec)" in refused(["film", "run", "--out", "film.mp4"], capsys)


def test_a_gif_of_another_size_is_scaled(tmp_path: Path, clock: str) -> None:
    with_policy(tmp_path / "run", clock)
    assert cli.main(["film", "run", "--out", "film.gif", "--size", "64", "48"]) == 0
    with Image.open(tmp_path / "film.gif") as animation:
        assert animation.size == (64, 48)


def test_the_camera_is_an_argument_of_the_environment(tmp_path: Path, clock: str) -> None:
    with_policy(tmp_path / "run", clock)
    for camera, value in (("2", 2), ("side", "side")):
        assert cli.main(["film", "run", "--out", "film.gif", "--camera", camera]) == 0
        assert Clock.cameras[-1] == value


def test_the_film_is_of_the_episodes_of_the_evaluation(tmp_path: Path, clock: str) -> None:
    with_policy(tmp_path / "run", clock)
    Clock.seeds.clear()
    assert cli.main(["film", "run", "--out", "film.gif", "--episodes", "3", "--seed", "5"]) == 0
    assert Clock.seeds == [episode_seed(5, Stream.EVALUATE, i) for i in range(3)]


REFUSED = [
    ("run --out film.avi", "ends in .gif or .mp4"),
    ("run --out film", "ends in .gif or .mp4"),
    ("run --out film.gif --episodes 0", "--episodes is 0"),
    ("run --out film.gif --fps 0", "--fps is 0; it must be from 0.1"),
    ("run --out film.gif --fps nan", "--fps is nan"),
    ("run --out film.gif --size 5 100", "--size is 5; it must be at least 16"),
    ("run --out film.gif --size 100 100000", "at most 4,096"),
    ("nowhere --out film.gif", "nowhere holds no policy"),
    ("mass --out film.gif", "has no pictures"),
]


@pytest.mark.parametrize(("words", "why"), REFUSED)
def test_a_film_that_can_not_be_made_is_refused(
    words: str, why: str, tmp_path: Path, clock: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with_policy(tmp_path / "run", clock)
    Policy(Actor.init(2, 2, 4, 8, key=jax.random.key(0)), "toy/point_mass-v0").save(tmp_path / "mass")
    assert why in refused(["film", *words.split()], capsys)


@pytest.mark.parametrize(
    ("picture", "why"),
    [
        (None, "gave None as a picture"),
        (np.zeros((4, 4, 3)), "dtype float64"),
        (np.zeros((4, 4), np.uint8), "shape (4, 4)"),
        (RuntimeError("no context"), "can't be drawn (RuntimeError: no context); where it is MuJoCo's, pcil doctor"),
    ],
)
def test_an_environment_that_gives_no_picture_is_named(
    picture: Any, why: str, tmp_path: Path, clock: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def render(self: Clock) -> Any:
        if isinstance(picture, Exception):
            raise picture
        return picture

    monkeypatch.setattr(Clock, "render", render)
    with_policy(tmp_path / "run", clock)
    for kind in (".gif", ".mp4"):
        assert why in refused(["film", "run", "--out", f"film{kind}"], capsys)


@pytest.mark.parametrize(("set_to", "found", "used"), [(None, "EGL", "egl"), (None, None, None), ("osmesa", "EGL", "osmesa")])
def test_the_renderer_of_gymnasiums_own_environments_needs_no_display(
    set_to: str | None, found: str | None, used: str | None, tmp_path: Path, clock: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr(Clock, "close", lambda self: seen.append(os.environ.get("MUJOCO_GL")), raising=False)
    monkeypatch.setattr("ctypes.util.find_library", lambda name: found)
    monkeypatch.setenv("MUJOCO_GL", set_to or "")
    with_policy(tmp_path / "run", clock)
    assert cli.main(["film", "run", "--out", "film.gif"]) == 0
    assert seen == [used or ""]


@pytest.mark.parametrize("kind", [".gif", ".mp4"])
def test_a_film_that_breaks_off_leaves_the_one_that_was_there(
    kind: str, tmp_path: Path, clock: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Clock.render

    def render(self: Clock) -> Any:
        if self.time > 6:
            raise RuntimeError("lost context")
        return real(self)

    monkeypatch.setattr(Clock, "render", render)
    with_policy(tmp_path / "run", clock)
    (tmp_path / f"film{kind}").write_text("earlier")
    assert "lost context" in refused(["film", "run", "--out", f"film{kind}"], capsys)
    assert (tmp_path / f"film{kind}").read_text() == "earlier"


def test_a_missing_package_is_named(
    tmp_path: Path, clock: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with_policy(tmp_path / "run", clock)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    said = refused(["film", "run", "--out", "film.mp4"], capsys)
    assert "A film needs imageio_ffmpeg, which pip install '.[film]'" in said and ".gif needs only Pillow" in said
    assert cli.main(["film", "run", "--out", "film.gif"]) == 0


def test_a_task_of_deepmind_control_is_filmed_or_the_sentence_says_what_is_missing(tmp_path: Path) -> None:
    """In a new process, which finds a renderer as users' processes do: EGL or OSMesa, without a display."""
    words = ["film", "pendulum_swingup", "--out", "film.mp4", "--fps", "0.1", "--size", "160", "120", "--camera", "0"]
    hidden = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    command = [sys.executable, "-m", "pcil", *words, "--env-kwargs", '{"action_repeat": 50}']
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode == 0:
        assert decoded(tmp_path / "film.mp4", 160, 120).std() > 1
    else:
        assert done.returncode == 2 and "MUJOCO_GL" in done.stderr and done.stderr.startswith("pcil: "), done.stderr
        assert not (tmp_path / "film.mp4").exists()


# --- pcil demos --film ---


class Runner(Clock):
    """Its observation is the sum of the actions and `drift`, beginning with a random number."""

    drift = 0.0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-0.1, 0.1, 3).astype(np.float32)
        return self.place.copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        _, reward, terminated, truncated, info = super().step(action)
        self.place = (self.place + 0.05 * action.sum() + (self.drift if self.time > 3 else 0)).astype(np.float32)
        return self.place.copy(), reward, terminated, truncated, info


@pytest.fixture
def runs_recorded(tmp_path: Path) -> Iterator[str]:
    """Two recorded episodes of random actions."""
    gymnasium.register("test/runner-v0", Runner, disable_env_checker=True)
    rng = np.random.default_rng(0)
    act = lambda obs: rng.uniform(-1, 1, 2).astype(np.float32)  # noqa: E731
    demos.record(act, make("test/runner-v0"), 2, task="test/runner-v0", seed=5, info={}).save(tmp_path / "demos")
    yield "test/runner-v0"
    del gymnasium.registry["test/runner-v0"]


def test_recorded_episodes_are_filmed_again(runs_recorded: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The recorded actions lead from the recorded seeds through the recorded states, picture by picture."""
    assert cli.main(["demos", "demos", "--film", "film.gif", "--film-episodes", "2"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "Film: film.gif, 10 pictures of 2 of 2 episodes"
    assert shades_of(Path("film.gif"))[0] == pytest.approx([0, 40, 80, 120, 160] * 2, abs=2)


def test_an_episode_ends_where_the_environment_leaves_the_recorded_states(
    runs_recorded: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Runner, "drift", 0.5)
    assert cli.main(["demos", "demos", "--film", "film.gif"]) == 0
    said = capsys.readouterr().out.splitlines()[-2:]
    assert said[0] == f"Episode 0 is filmed until step 4 of 10, where {runs_recorded} leaves the recorded states."
    assert shades_of(Path("film.gif"))[0] == pytest.approx([0, 40], abs=2)


def test_what_can_not_be_filmed_again_is_said(runs_recorded: str, capsys: pytest.CaptureFixture[str]) -> None:
    held = Demonstrations.load("demos")
    Demonstrations.from_arrays(obs=[e.obs for e in held.episodes]).save("states")
    unseeded = tuple(dataclasses.replace(episode, seed=None) for episode in held.episodes)
    dataclasses.replace(held, episodes=unseeded).save("unseeded")
    film_of = lambda name: ["demos", name, "--env", runs_recorded, "--film", "film.gif"]  # noqa: E731
    assert "no actions" in refused(film_of("states"), capsys)
    assert "Episode 0 has no seed" in refused(film_of("unseeded"), capsys)
    assert "ends in .gif or .mp4" in refused(["demos", "demos", "--film", "film.avi"], capsys)
    assert "--film are about one dataset" in refused(["demos", "--film", "film.gif"], capsys)
