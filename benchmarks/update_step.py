"""Updates on one thread, compared with their matrix products alone: `python benchmarks/update_step.py [TASK]`.

The core's peak is the rate of a product of two 1024 x 1024 matrices, measured in turn with the update.

With settings, PCIL's `default` update is compared with the same update with them, one more in each row, in one process:
`python benchmarks/update_step.py walker_walk reward.penalty_rows=32 agent.cloning=true`.
"""

from __future__ import annotations

import shared  # isort: skip
import json
import sys

from pcil import envs
from pcil.bench import parts
from pcil.training import presets
from pcil.types import Spec


def main(task: str = "walker_walk", *changes: str) -> None:
    """Print milliseconds of an update, and ratios, for each method and preset, or for `changes` of PCIL's default."""
    with envs.opened(task) as env:
        spec = envs.spec(env)
    if changes:
        return compare(task, spec, changes)
    shared.print_row(task, "update, ms", "products, ms", "ratio", "of the peak", "its products")
    for preset in presets.PRESETS:
        for method in presets.METHODS:
            setup = parts.Setup(presets.make(task, method, preset), spec)
            timed = {"update_ms": setup.update, "floor_ms": setup.floor, "large_ms": parts.large_product}
            update, floor, large = parts.medians(timed, seconds=3).values()
            peak = setup.flops * large / (2 * parts.LARGE**3)  # the time of as many FLOPs in the large product
            shares = f"{peak / update:.2f}", f"{peak / floor:.2f}"
            shared.print_row(f"{preset} {method}", f"{update:.2f}", f"{floor:.2f}", f"{update / floor:.2f}", *shares)
    return None


def compare(task: str, spec: Spec, changes: tuple[str, ...]) -> None:
    """Each row has one more setting than the row before, a value in JSON; the parts take turns."""
    settings = [(name, json.loads(value.lower())) for name, _, value in (change.partition("=") for change in changes)]
    runs = [presets.make(task, **dict(settings[:count])) for count in range(len(settings) + 1)]
    took = parts.medians({f"{i}_ms": parts.Setup(run, spec).update for i, run in enumerate(runs)}, seconds=10 * len(runs))
    shared.print_row(task, "update, ms", "ratio")
    for name, value in zip(["default", *changes], took.values(), strict=True):
        shared.print_row(name, f"{value:.2f}", f"{value / took['0_ms']:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
