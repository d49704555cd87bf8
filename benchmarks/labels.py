"""Rewards of whole episodes and the update, in milliseconds of processor time: `python benchmarks/labels.py [TASK]`."""

from __future__ import annotations

import shared  # isort: skip
import sys
from typing import Any

from pcil import envs
from pcil.bench import parts
from pcil.demos import Demonstrations
from pcil.training import learner, presets

CASES: tuple[tuple[str, dict[str, Any]], ...] = (
    ("dac", {}),
    ("pcil", {}),
    ("pwil", {}),
    ("pwil", {"reward.inputs": "trunk"}),
    ("potil", {}),
    ("sil", {"reward.every": 1}),
    ("sil", {"reward.every": 10}),
    ("sil", {}),
)


def main(task: str = "walker_walk") -> None:
    """Print the time to label one episode and the time of an update, for each method."""
    episode = Demonstrations.load(task).episodes[0]
    with envs.opened(task) as env:
        spec = envs.spec(env)
    shared.print_row(f"{task}, {len(episode)} steps", "label, ms", "update, ms")
    for method, changes in CASES:
        setup = parts.Setup(run := presets.make(task, method, **changes), spec)

        def label(setup: parts.Setup = setup) -> None:
            learner.label_episode(setup.run.learner, setup.state, episode, 0)

        label()  # compiles
        setup.update(1)
        name = " ".join([run.method, *(f"{field}={value}" for field, value in changes.items())])
        times = shared.processor_ms(label, 5), shared.processor_ms(lambda setup=setup: setup.update(100), 1) / 100
        shared.print_row(name, f"{times[0]:.1f}", f"{times[1]:.2f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
