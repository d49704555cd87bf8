"""A film shows an episode of the policy, picture by picture; if nothing can be shown, a message says so."""

from __future__ import annotations

import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
import pytest
from PIL import Image

from fake_runs import fake_run
from pcil.nets.networks import Actor
from pcil.policy import Policy
from pcil.report import film
from pcil.report.load import collect


class Clock(gymnasium.Env):
    """Ends after ten steps; the brightness of a picture is the number of steps."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012  as gymnasium.Env declares it
    observation_space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.time = 0
        return np.zeros(3, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert action.shape == (2,)
        self.time += 1
        return np.zeros(3, np.float32), 0.0, False, self.time == 10, {}

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
