"""Each method's update beside its matrix products alone, on one thread: `python benchmarks/update_step.py [TASK]`."""

from __future__ import annotations

import sys

from pcil import bench

bench.use_one_thread()

from pcil import envs
from pcil.training import presets


def main(task: str = "walker_walk") -> None:
    """Milliseconds of an update and of its floor, and their ratio, for each method and preset."""
    spec = envs.spec(envs.make(task))
    print(f"{task:<22}{'update, ms':>12}{'products, ms':>14}{'ratio':>8}")
    for preset in ("default", "paper", "released"):
        for method in presets.METHODS:
            setup = bench.Setup(presets.make(task, method, preset), spec)
            took = bench.medians({"update_ms": setup.update, "floor_ms": setup.floor}, seconds=3)
            ratio = took["update_ms"] / took["floor_ms"]
            print(f"{preset + ' ' + method:<22}{took['update_ms']:>12.2f}{took['floor_ms']:>14.2f}{ratio:>8.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
