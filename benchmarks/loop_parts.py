"""Where the time of the loop goes, part by part, on one thread: `python benchmarks/loop_parts.py [TASK]`.

A part takes longer here than alone (`pcil bench`): each update leaves the processor's caches full of its own numbers.
"""

from __future__ import annotations

import sys

from pcil import bench

bench.use_one_thread()

from pcil import envs
from pcil.nets import networks
from pcil.training import learner, loop, presets, replay


def main(task: str = "walker_walk") -> None:
    """A row a part: microseconds for each update, of one call, and the share."""
    run = presets.make(task)
    env = envs.make(run.task)
    parts = [
        (learner, "update"),
        (type(env.unwrapped), "step"),
        (networks.Actor, "__call__"),
        (replay.Replay, "sample"),
        (loop, "on_host"),
        (learner, "label_episode"),
    ]
    timing = bench.time_loop(run, 20, parts)
    seconds = timing.inside | {"all else": timing.seconds - sum(timing.inside.values())}
    print(f"{'part':<16}{'us an update':>14}{'us a call':>12}{'share':>8}")
    for name, total in sorted(seconds.items(), key=lambda part: -part[1]):
        each = f"{total / timing.calls[name] * 1e6:12.0f}" if name in timing.calls else " " * 12
        print(f"{name:<16}{total / timing.calls['update'] * 1e6:14.0f}{each}{total / timing.seconds:8.1%}")


if __name__ == "__main__":
    main(*sys.argv[1:])
