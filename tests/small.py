"""Settings small enough for tests: all tests that use them share one compilation of narrow networks."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from pcil import demos, envs
from pcil.envs.toy import PointMass
from pcil.nets.noise import LinearSchedule
from pcil.training import learner, presets
from pcil.training.config import Run
from pcil.types import Batch, Window

POINT_MASS = "toy/point_mass-v0"


def narrow(settings: Any, **changes: Any) -> Any:
    """An agent's or a reward's settings, reduced to hidden width 16, batches of 32 and short periods where it has these."""
    small = {"hidden": 16, "batch_size": 32, "feature_dim": 8, "noise": LinearSchedule(1.0, 0.1, 1000)}
    small |= {"refresh": 30, "every": 2} | changes
    names = {field.name for field in dataclasses.fields(settings)}
    if "batch_size" in names and settings.batch_size == 0:
        small.pop("batch_size")
    return dataclasses.replace(settings, **{name: value for name, value in small.items() if name in names})


def small_run(method: str = "pcil", task: str = POINT_MASS, reward: dict[str, Any] | None = None, **changes: Any) -> Run:
    """A run of six episodes on the point mass, two of them before the first update."""
    run = presets.make(task, method)
    settings = {
        "frames": 300,
        "seed_frames": 100,
        "random_frames": 100,
        "evaluate_every": 100,
        "evaluate_episodes": 2,
        "cloning_updates": 20,
        "agent": narrow(run.agent),
        "reward": narrow(run.reward, **(reward or {})),
    }
    return dataclasses.replace(run, **{**settings, **changes})


def save_point_mass_demos(folder: Path, episodes: int = 4) -> str:
    """Demonstrations of the optimal policy as a Minari dataset; returns its path."""
    recorded = demos.record(
        lambda obs: PointMass.optimal_action(obs).astype(np.float32),
        envs.make(POINT_MASS),
        episodes,
        task=POINT_MASS,
        seed=7,
        info={"expert": "the optimal policy"},
    )
    return str(recorded.save(folder / "point_mass-v0"))


def random_batch(rows: int, obs_dim: int, action_dim: int, seed: int = 0) -> Batch:
    """Standard normal states and uniform actions."""
    rng = np.random.default_rng(seed)
    obs = rng.standard_normal((rows, obs_dim), dtype=np.float32)
    return staying(obs, rng.uniform(-1, 1, (rows, action_dim)).astype(np.float32))


def staying(obs: np.ndarray, action: np.ndarray) -> Batch:
    """Steps that end in the state in which they begin, so that a test need not distinguish the two."""
    return Batch(obs, action, obs)


def batches(batch: Batch, n: int = 1) -> Batch:
    """`windows` in the form that rewards are given."""
    return learner.steps(windows(batch, n))


def windows(batch: Batch, n: int = 1) -> Window:
    """Every window of `n` steps of these rows, treated as one episode without rewards that ends with the last row."""
    starts = np.arange(len(batch.obs) - n)
    steps = starts[:, None] + np.arange(n + 1)
    ones = np.ones((len(starts), n), np.float32)
    return Window(batch.obs[steps], batch.action[steps[:, :-1]], 0 * ones, ones, np.zeros(len(starts), np.int32))
