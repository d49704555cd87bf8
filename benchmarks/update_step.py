"""Each method's update compared with its matrix products alone, on one thread: `python benchmarks/update_step.py [TASK]`."""

from __future__ import annotations

import shared  # isort: skip
import sys

from pcil import envs
from pcil.bench import parts
from pcil.training import presets


def main(task: str = "walker_walk") -> None:
    """Print milliseconds of an update and of its matrix products, and their ratio, for each method and preset."""
    with envs.opened(task) as env:
        spec = envs.spec(env)
    shared.print_row(task, "update, ms", "products, ms", "ratio")
    for preset in presets.PRESETS:
        for method in presets.METHODS:
            setup = parts.Setup(presets.make(task, method, preset), spec)
            took = parts.medians({"update_ms": setup.update, "floor_ms": setup.floor}, seconds=3)
            update, floor = took["update_ms"], took["floor_ms"]
            shared.print_row(f"{preset} {method}", f"{update:.2f}", f"{floor:.2f}", f"{update / floor:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
