"""The same runs with one job and with two, and the ratio of their throughputs: `python benchmarks/sweep.py`.

The ratio is computed for the whole commands, which include the imports of each run, and for the training alone (`eval.csv`).
"""

from __future__ import annotations

import argparse
import statistics
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
    """Print seconds and frames per second with one job and with two, and the ratios."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--frames", type=int, default=30_000)
    parser.add_argument("--task", default="pendulum_swingup")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        sweep(Path(folder) / "compiled", given.task, [0], 2500, jobs=1)  # fills the compilation cache
        seconds = []
        for jobs in (1, 2):
            seconds.append(sweep(Path(folder) / str(jobs), given.task, list(range(given.runs)), given.frames, jobs))
            whole, each = seconds[-1]
            rates = f"{given.runs * given.frames / whole:,.0f} frames/s, {given.frames / each:,.0f} in training"
            print(f"--jobs {jobs}: {given.runs} runs in {whole:.1f} s, {each:.1f} s of training each; {rates}", flush=True)
    (one, alone), (two, beside) = seconds
    print(f"ratio {one / two:.2f}; of training {2 * alone / beside:.2f}")


def sweep(folder: Path, task: str, seeds: list[int], frames: int, jobs: int) -> tuple[float, float]:
    """The seconds that the command takes, and the mean training time of its runs in seconds."""
    folder.mkdir()
    (folder / "sweep.toml").write_text(FILE.format(task=task, seeds=seeds, frames=frames))
    words = ["sweep", str(folder / "sweep.toml"), "--out", str(folder / "runs"), "--jobs", str(jobs)]
    began = time.perf_counter()
    subprocess.run([sys.executable, "-m", "pcil", *words], check=True, stdout=subprocess.DEVNULL)
    took = time.perf_counter() - began
    logs = (folder / "runs").rglob("eval.csv")
    return took, statistics.mean(float(log.read_text().split()[-1].rpartition(",")[2]) for log in logs)


if __name__ == "__main__":
    main()
