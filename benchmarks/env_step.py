"""An environment step and the physics alone: `python benchmarks/env_step.py [TASK ...]`, by default for all ten tasks."""

from __future__ import annotations

import shared  # isort: skip
import sys

from pcil.bench.environment import measure_env
from pcil.envs import TASKS


def main(*tasks: str) -> None:
    """Print microseconds per agent step (two control steps) and their ratio."""
    shared.print_row("task", "env step, us", "physics, us", "ratio")
    for task in tasks or TASKS:
        measured = measure_env(task)
        cells = (f"{measured['env_step_us']:.1f}", f"{measured['physics_us']:.1f}", f"{measured['ratio']:.2f}")
        shared.print_row(task, *cells)


if __name__ == "__main__":
    main(*sys.argv[1:])
