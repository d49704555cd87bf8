"""Share of the loop's time in the update, and frames a second, on one thread: `python benchmarks/loop.py [TASK ...]`."""

from __future__ import annotations

import sys

from pcil import bench

bench.use_one_thread()

from pcil import envs
from pcil.training import presets


def main(tasks: list[str]) -> None:
    """A row a task, for PCIL and for the agent alone."""
    print(f"{'task':<20}{'method':<8}{'in the update':>14}{'frames/s':>10}")
    for task in tasks or envs.TASKS:
        for method in ("pcil", "expert"):
            share, speed = bench.loop_share(presets.make(task, method), seconds=5)
            print(f"{task:<20}{method:<8}{share:>14.1%}{speed:>10.0f}")


if __name__ == "__main__":
    main(sys.argv[1:])
