"""The time of an environment step compared with its physics alone, in one process so that a busy core affects both."""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from statistics import median
from typing import Any

import numpy as np

from pcil.envs import Checked, opened, spec
from pcil.envs.dmc import DMCEnv, control_step
from pcil.errors import InputError

_BLOCK = 50
"""The number of agent steps in a timed block; blocks of environment and physics alternate, so that load affects both."""


def measure_env(task: str, episodes: int = 3) -> dict[str, float]:
    """Microseconds per agent step of a DeepMind Control task: `env_step_us`, `physics_us`, and their `ratio`.

    `physics_us` is the time of MuJoCo's step functions alone. They run on a copy of the simulation, with the same model and the
    same random actions, and so through the same states. Values are medians over blocks, `ratio` that of the ratios of adjacent
    blocks.
    """
    env_us, physics_us = [], []
    with opened(task) as env:
        inner = env.unwrapped
        if not isinstance(inner, DMCEnv):
            raise InputError(f"Only tasks of DeepMind Control have bare physics to compare with; got {task!r}.")
        for episode in range(episodes):
            actions = np.random.default_rng(episode).uniform(-1.0, 1.0, (10 * _BLOCK, spec(env).action_dim))
            env.reset(seed=episode)
            run_physics = _bare_physics(inner)
            for block in np.split(actions.astype(np.float32), 10):
                env_us.append(_microseconds(lambda block=block: _step_through(env, block)))
                controls = [inner.control_signal(action) for action in block]
                physics_us.append(_microseconds(lambda controls=controls, run=run_physics: run(controls)))
    ratio = median(ours / bare for ours, bare in zip(env_us, physics_us, strict=True))
    return {"env_step_us": median(env_us), "physics_us": median(physics_us), "ratio": ratio}


def _step_through(env: Checked, actions: np.ndarray) -> None:
    for action in actions:
        env.step(action)


def _microseconds(run: Callable[[], None]) -> float:
    start = time.perf_counter_ns()
    run()
    return (time.perf_counter_ns() - start) / 1e3 / _BLOCK


def _bare_physics(env: DMCEnv) -> Callable[[list[np.ndarray]], None]:
    """A function that makes MuJoCo's calls of consecutive agent steps on a copy of the environment's current state."""
    mujoco: Any = importlib.import_module("mujoco")
    model = env.physics.model.ptr
    data = mujoco.MjData(model)
    mujoco.mj_copyData(data, model, env.physics.data.ptr)
    step = control_step(model, data, env.num_substeps)

    def run(controls: list[np.ndarray]) -> None:
        for control in controls:
            data.ctrl[:] = control
            for _ in range(env.action_repeat):
                step()

    return run
