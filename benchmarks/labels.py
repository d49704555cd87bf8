"""What rewards of whole episodes cost beside an update, on one thread: `python benchmarks/labels.py [TASK]`.

Milliseconds of the processor, which other processes on the machine do not stretch.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

from pcil import bench

bench.use_one_thread()

import jax
import numpy as np

from pcil import envs
from pcil.demos import Demonstrations
from pcil.training import learner, presets
from pcil.training.replay import Replay
from pcil.types import Batch

CASES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("dac", {}),
    ("pcil", {}),
    ("pwil", {}),
    ("pwil", {"reward.inputs": "trunk"}),
    ("potil", {}),
    ("sil", {"reward.every": 1}),
    ("sil", {}),
)


def processor_ms(work: Callable[[], Any], times: int) -> float:
    """Mean of so many calls, after one that compiles."""
    work()
    before = time.process_time()
    for _ in range(times):
        work()
    return (time.process_time() - before) / times * 1e3


def main(task: str = "walker_walk") -> None:
    """An episode's label, an update, and Sinkhorn's algorithm with and without logarithms."""
    import ot

    demos, spec = Demonstrations.load(task).episodes, envs.spec(envs.make(task))
    rng, expert = np.random.default_rng(0), Replay.of(demos)
    print(f"{task}: {len(demos)} demonstrations of {len(demos[0])} steps\n{'':<32}{'label, ms':>12}{'update, ms':>12}")
    for method, changes in CASES:
        run = presets.make(task, method, **changes)
        batches = tuple(Batch.of(episode.obs, episode.action) for episode in demos)
        state = learner.init(run.learner, spec, batches, 1)
        label = processor_ms(lambda run=run, state=state: learner.label_episode(run.learner, state, demos[0], 0), 5)
        window = expert.sample(rng, run.agent.batch_size, run.agent.n_step)
        rows = expert.sample(rng, run.reward.batch_size, run.reward.span) if run.reward.batch_size else None
        box = [state]

        def update(run: Any = run, box: Any = box, window: Any = window, rows: Any = rows) -> None:
            box[0], actor = learner.update(run.learner, box[0], window, rows, None, np.int32(0), np.int32(0))
            jax.block_until_ready(actor)

        name = " ".join([method, *(f"{field}={value}" for field, value in changes.items())])
        print(f"{name:<32}{label:>12.1f}{processor_ms(update, 100):>12.2f}", flush=True)
    for size in (128, 500):
        x, y = rng.standard_normal((2, size, 30))
        mass, cost = np.full(size, 1 / size), ot.dist(x, y, metric="cosine")
        for how in ("sinkhorn", "sinkhorn_log"):
            took = processor_ms(lambda m=mass, c=cost, h=how: ot.sinkhorn(m, m, c, 0.01, h, 100, warn=False), 3)
            print(f"{f'POT {how}, {size} x {size}':<32}{took:>12.1f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
