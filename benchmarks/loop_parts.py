"""Where the time of the loop goes, part by part, on one thread: `python benchmarks/loop_parts.py [TASK]`.

A part takes longer here than alone (`pcil bench`): each update leaves the processor's caches full of its own numbers.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

from pcil import bench

bench.use_one_thread()

import jax

from pcil import envs, learner, loop, networks, presets, replay, runs

EPISODES = range(4, 14)
"""Those that are measured; compiling is over by then."""


class Watch(runs.Silent):
    """Starts the measurement when the first episodes are over, and stops the run after the last."""

    def __init__(self) -> None:
        self.seconds: defaultdict[str, float] = defaultdict(float)
        self.calls, self.ends = Counter[str](), []

    def put_on(self, owner: Any, name: str) -> None:
        """Time every call of `owner.name`, until what it computes is there."""
        original = getattr(owner, name)

        def timed(*arguments: Any, **named: Any) -> Any:
            start = time.perf_counter()
            result = jax.block_until_ready(original(*arguments, **named))
            self.seconds[name] += time.perf_counter() - start
            self.calls[name] += 1
            return result

        setattr(owner, name, timed)

    def episode(self, run: Any, frames: int, total_reward: float) -> None:
        self.ends.append(time.perf_counter())
        if len(self.ends) == EPISODES.start:
            self.seconds.clear()
            self.calls.clear()

    def stop(self) -> bool:
        return len(self.ends) == EPISODES.stop


def main(task: str = "walker_walk") -> None:
    """A row a part: microseconds for each update, of one call, and the share."""
    run, watch = presets.make(task), Watch()
    env = envs.make(run.task)
    for owner, name in (
        (learner, "update"),
        (type(env.unwrapped), "step"),
        (networks.Actor, "__call__"),
        (replay.Replay, "sample"),
        (loop, "on_host"),
        (learner, "label_episode"),
    ):
        watch.put_on(owner, name)
    try:
        with tempfile.TemporaryDirectory() as folder:
            runs.execute(run, Path(folder) / "run", watch)
    except loop.Stopped:
        pass
    total, updates = watch.ends[-1] - watch.ends[EPISODES.start - 1], watch.calls["update"]
    watch.seconds["all else"] = total - sum(watch.seconds.values())
    print(f"{'part':<16}{'us an update':>14}{'us a call':>12}{'share':>8}")
    for name, seconds in sorted(watch.seconds.items(), key=lambda part: -part[1]):
        each = f"{seconds / watch.calls[name] * 1e6:12.0f}" if watch.calls[name] else " " * 12
        print(f"{name:<16}{seconds / updates * 1e6:14.0f}{each}{seconds / total:8.1%}")


if __name__ == "__main__":
    main(*sys.argv[1:])
