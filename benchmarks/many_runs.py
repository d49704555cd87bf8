"""What a sweep costs beside its runs: `python benchmarks/many_runs.py [--runs 10000] [--jobs 64]`.

The runs are simulated: each process writes the files of a finished run and ends, which takes a fraction of a second.
Everything else is real: every run's settings are checked, its process is started, polled and awaited. Half-way the sweep is
killed, and the same command must finish the rest. The time of a process alone is measured first.
"""

from __future__ import annotations

import argparse
import itertools
import json
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from pcil.training import presets, runs

TASKS = ["walker_walk", "cheetah_run", "finger_spin", "hopper_hop", "pendulum_swingup"]
METHODS = ["pcil", "dac", "bc", "expert"]
FILE = """
tasks = {tasks}
methods = {methods}
seeds = {seeds}
frames = 200_000
"""
RUN = """
import json, pathlib, sys
folder, _, *argv = sys.argv[1:]
folder, run = pathlib.Path(folder), json.loads(argv[argv.index("--settings") + 1])
about = json.loads((pathlib.Path(__file__).parent / (run["task"] + run["method"])).read_text())
about["run"]["seed"] = run["seed"]
folder.mkdir(parents=True, exist_ok=True)
with (folder / "starts").open("a") as file:
    file.write("x")
(folder / "run.json").write_text(json.dumps(about))
(folder / "eval.csv").write_text("frames,episode,return,length,seconds\\n200000,0,1.0,500,1.0\\n")
(folder / "train.jsonl").write_text('{"frames": 200000, "frames_per_second": 1.0}\\n')
(folder / "DONE").write_text('{"final_return": 1.0}\\n')
"""
SWEEP = """
import sys
from pcil.sweep import executors
executors.WORKER = (sys.executable, "-I", "-S", sys.argv.pop(1))
from pcil.cli import main
sys.exit(main())
"""


def main() -> int:
    """Print the seconds of each part, and the sweep's own time for a run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--jobs", type=int, default=64)
    given = parser.parse_args()
    arms = len(TASKS) * len(METHODS)
    seeds = list(range(-(-given.runs // arms)))
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        (root / "sweep.toml").write_text(FILE.format(tasks=json.dumps(TASKS), methods=json.dumps(METHODS), seeds=seeds))
        (root / "run.py").write_text(RUN)
        for task, method in itertools.product(TASKS, METHODS):
            run, demos, _ = runs.prepared(presets.make(task, method, frames=200_000))
            (root / f"{task}{method}").write_text(json.dumps(runs.described(run, demos)))
        alone = one_process(root)
        command = [sys.executable, "-c", SWEEP, str(root / "run.py"), "sweep", str(root / "sweep.toml")]
        command += ["--out", str(root / "runs"), "--jobs", str(given.jobs)]
        total, began = arms * len(seeds), time.perf_counter()
        with (root / "first.log").open("w") as log, subprocess.Popen(command, stdout=log) as first:
            planned = None
            while (ended := done(root)) < total // 2 and first.poll() is None:
                planned = planned or (time.perf_counter() - began if ended else None)
                time.sleep(0.2)
            first.send_signal(signal.SIGKILL)
        killed, before = time.perf_counter() - began, done(root)
        print(f"{total:,} runs checked in {planned or 0:.0f} s; the sweep is killed after {killed:.0f} s with {before:,} done")
        again = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        second = time.perf_counter() - again
        assert done(root) == total, f"{done(root)} of {total} runs are done"
        repeated = sum(len(file.read_text()) > 1 for file in (root / "runs").rglob("starts"))
        print(f"the same command finishes the other {total - before:,} in {second:.0f} s; {repeated} runs were started twice")
        mean = (killed + second) / total
        print(f"a run takes {1000 * mean:.1f} ms in all; a process alone {1000 * alone:.1f} ms; ratio {mean / alone:.2f}")
    return 0


def done(root: Path) -> int:
    """The number of finished runs."""
    return sum(1 for _ in (root / "runs").glob("*/*/*/DONE"))


def one_process(root: Path, number: int = 50) -> float:
    """The seconds of one simulated run, started by itself, the mean of some."""
    words = [
        sys.executable,
        "-I",
        "-S",
        str(root / "run.py"),
        str(root / "alone"),
        "1",
        "--settings",
        json.dumps({"task": TASKS[0], "method": METHODS[0], "seed": 1}),
    ]
    began = time.perf_counter()
    for _ in range(number):
        subprocess.run(words, check=True)
    return (time.perf_counter() - began) / number


if __name__ == "__main__":
    sys.exit(main())
