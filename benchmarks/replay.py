"""Sampling windows beside the update that they feed, on one thread: `python benchmarks/replay.py [TASK ...]`."""

from __future__ import annotations

import sys

from pcil import bench

bench.use_one_thread()

from pcil import envs
from pcil.training import presets
from pcil.training.replay import Replay


def main(tasks: list[str]) -> None:
    """Microseconds of a sample, its share of PCIL's update, and the memory of a full replay."""
    print(f"{'task':<20}{'sample, us':>12}{'of the update':>15}{'500k steps, MB':>16}")
    for task in tasks or envs.TASKS:
        run, spec = presets.make(task), envs.spec(envs.make(task))
        setup = bench.Setup(run, spec)
        took = bench.medians({"sample_us": setup.sample, "update_ms": setup.update}, seconds=3)
        share = took["sample_us"] / took["update_ms"] / 1e3
        size = Replay(run.replay_steps, spec.obs_dim, spec.action_dim).nbytes / 1e6
        print(f"{task:<20}{took['sample_us']:>12.1f}{share:>15.2%}{size:>16.0f}")


if __name__ == "__main__":
    main(sys.argv[1:])
