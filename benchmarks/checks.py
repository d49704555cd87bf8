"""The cost of checking an environment: `python benchmarks/checks.py [TASK ...]`.

Blocks of steps with and without `pcil.envs.checked:Checked` alternate in one process, on one environment and with the same
actions. Only the fastest block of each counts, so that other work on the core has little influence.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from pcil.envs import opened, spec

TASKS = ("pendulum_swingup", "finger_spin", "walker_walk", "quadruped_run")
ROUNDS, STEPS = 200, 100


def microseconds(step: Callable[[Any], Any], actions: np.ndarray) -> float:
    start = time.perf_counter_ns()
    for action in actions:
        step(action)
    return (time.perf_counter_ns() - start) / 1e3 / len(actions)


def measure(task: str) -> tuple[float, float]:
    """Microseconds per step without and with the checks."""
    with opened(task) as env:
        actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, spec(env).action_dim)).astype(np.float32)
        plain, checked = [], []
        for round_ in range(ROUNDS):
            env.reset(seed=round_ // 2)
            order = [(plain, env.env.step), (checked, env.step)]
            for times, step in order if round_ % 2 else reversed(order):
                times.append(microseconds(step, actions))
        return min(plain), min(checked)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=TASKS, metavar="TASK")
    print(f"{'task':<18}{'unchecked, us':>15}{'checked, us':>13}{'checks, us':>12}{'share':>8}")
    for task in parser.parse_args().tasks:
        plain, checked = measure(task)
        print(f"{task:<18}{plain:>15.2f}{checked:>13.2f}{checked - plain:>12.2f}{checked / plain - 1:>8.1%}")


if __name__ == "__main__":
    main()
