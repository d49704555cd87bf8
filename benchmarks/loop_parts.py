"""Where the time of the training loop goes, part by part, on one thread: `python benchmarks/loop_parts.py [TASK]`.

A part takes longer here than alone (`pcil bench`), because each update leaves the processor's caches full of its own data.
"""

from __future__ import annotations

import shared  # isort: skip
import sys

from pcil import envs
from pcil.bench import parts
from pcil.nets import networks
from pcil.training import learner, presets, replay


def main(task: str = "walker_walk") -> None:
    """Print the microseconds of each part for one update and for one call, and its share of the time."""
    run = presets.make(task)
    with envs.opened(run.task) as env:
        environment = type(env.unwrapped)
    timed = [
        (learner, "update"),
        (environment, "step"),
        (networks.Actor, "__call__"),
        (replay.Replay, "sample"),
        (learner, "on_host"),
        (learner, "label_episode"),
    ]
    timing = parts.time_loop(run, 20, timed)
    seconds = timing.inside | {"all else": timing.seconds - sum(timing.inside.values())}
    shared.print_row("part", "us an update", "us a call", "share")
    for name, total in sorted(seconds.items(), key=lambda part: -part[1]):
        each = f"{total / timing.calls[name] * 1e6:.0f}" if name in timing.calls else ""
        shared.print_row(name, f"{total / timing.calls['update'] * 1e6:.0f}", each, f"{total / timing.seconds:.1%}")


if __name__ == "__main__":
    main(*sys.argv[1:])
