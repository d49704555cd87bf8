"""An environment step beside its bare physics: `python benchmarks/env_step.py [TASK ...]`, the ten by default."""

from __future__ import annotations

import argparse

from pcil.bench.environment import measure_env
from pcil.envs import TASKS


def main() -> None:
    """Prints microseconds per agent step (two control steps) and their ratio."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("tasks", nargs="*", default=TASKS, metavar="TASK")
    print(f"{'task':<18}{'env step, us':>14}{'physics, us':>14}{'ratio':>8}")
    for task in parser.parse_args().tasks:
        measured = measure_env(task)
        print(f"{task:<18}{measured['env_step_us']:>14.1f}{measured['physics_us']:>14.1f}{measured['ratio']:>8.2f}")


if __name__ == "__main__":
    main()
