"""What a sweep takes on so many cores: python experiments/cost.py FILE.toml [CORES ...]

A run's time is its frames times the median time of a frame of its method in the rows of `results/` (one core each).
The runs are handed out in their order, each to the first core that is free, as a sweep does.
"""

from __future__ import annotations

import heapq
import statistics
import sys
from pathlib import Path

from pcil.cli import exit_code
from pcil.errors import InputError
from pcil.report import tables
from pcil.report.load import EvalRow, read_rows
from pcil.sweep import plans

RESULTS = Path(__file__).parent.parent / "results"


def main(*words: str) -> None:
    """Print the core-hours of each method, and the hours on each number of cores."""
    if not words or not all(word.isdecimal() and int(word) for word in words[1:]):
        raise InputError("Give the TOML file of a sweep, and then numbers of cores.")
    file, *cores = words
    measured = seconds_per_frame()
    plan = plans.read(Path(file), Path("runs/nowhere"))
    took = [job.run.frames * measured[job.run.method] for job in plan.jobs]
    rows = []
    for method in dict.fromkeys(job.run.method for job in plan.jobs):
        own = [seconds for job, seconds in zip(plan.jobs, took, strict=True) if job.run.method == method]
        rows.append((method, len(own), 1e5 * measured[method], sum(own) / 3600))
    rows.append(("all", len(took), None, sum(took) / 3600))
    print(tables.markdown(tables.Table(("method", "runs", "seconds per 100k frames", "core-hours"), rows)))
    hours = [(count, ended(took, count) / 3600, sum(took) / count / 3600) for count in map(int, cores or ("2", "64", "1000"))]
    print(tables.markdown(tables.Table(("cores", "hours", "hours if all were busy to the end"), hours)))


def seconds_per_frame() -> dict[str, float]:
    """The median over runs of at least 100,000 frames, for each method."""
    last: dict[tuple[object, ...], EvalRow] = {}
    for file in RESULTS.glob("*.csv"):
        last |= {(file.name, *row[:4]): row for row in read_rows(file) if isinstance(row, EvalRow) and row.seconds}
    found: dict[str, list[float]] = {}
    for row in last.values():
        if row.frames >= 100_000:
            found.setdefault(row.method, []).append((row.seconds or 0) / row.frames)
    return {method: statistics.median(values) for method, values in found.items()}


def ended(took: list[float], cores: int) -> float:
    """When the last of the runs ends."""
    free = [0.0] * cores
    for seconds in took:
        heapq.heappush(free, heapq.heappop(free) + seconds)
    return max(free)


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(*sys.argv[1:])))
