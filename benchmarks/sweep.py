"""Runs side by side: the same runs with one job and with two, and the ratio of their speeds: `python benchmarks/sweep.py`."""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

FILE = """
tasks = ["{task}"]
methods = ["pcil"]
seeds = {seeds}
frames = {frames}
settings.evaluate_every = {frames}
"""


def main() -> None:
    """Prints the seconds of the whole command, Ray's start and every run's imports included, and frames a second."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--frames", type=int, default=30_000)
    parser.add_argument("--task", default="pendulum_swingup")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        sweep(Path(folder) / "compiled", given.task, [0], 2500, jobs=1)  # the others find the compiled programs in the cache
        speeds = []
        for jobs in (1, 2):
            seconds = sweep(Path(folder) / str(jobs), given.task, list(range(given.runs)), given.frames, jobs)
            speeds.append(given.runs * given.frames / seconds)
            print(f"--jobs {jobs}: {given.runs} runs in {seconds:.1f} s, {speeds[-1]:,.0f} frames/s", flush=True)
    print(f"ratio {speeds[1] / speeds[0]:.2f}")


def sweep(folder: Path, task: str, seeds: list[int], frames: int, jobs: int) -> float:
    """Seconds that the command takes."""
    folder.mkdir()
    (folder / "sweep.toml").write_text(FILE.format(task=task, seeds=seeds, frames=frames))
    words = ["sweep", str(folder / "sweep.toml"), "--out", str(folder / "runs"), "--jobs", str(jobs)]
    began = time.perf_counter()
    subprocess.run([sys.executable, "-m", "pcil", *words], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


if __name__ == "__main__":
    main()
