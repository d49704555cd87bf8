"""What a sweep takes on so many cores: python experiments/cost.py FILE.toml [CORES ...]

A run's time is its frames times the median time of a frame of its method in the rows of `results/` (one core each).
The runs are handed out in their order, each to the first core that is free, as a sweep does.

`savings` is the table of what runs with `--until` took, for the pages of results.
"""

from __future__ import annotations

import heapq
import math
import statistics
import sys
from pathlib import Path
from typing import Any

from pcil.cli import exit_code
from pcil.errors import InputError
from pcil.report import tables
from pcil.report.load import Collection, EvalRow, by_variant, read_rows

RESULTS = Path(__file__).parent.parent / "results"
SHARE = 0.9
"""The share of the demonstrations' return at which the runs of experiments/until-90.toml end."""
PRESETS = "default", "reward-only"
"""The presets that it compares."""


def main(*words: str) -> None:
    """Print the core-hours of each method, and the hours on each number of cores."""
    if not words or not all(word.isdecimal() and int(word) for word in words[1:]):
        raise InputError("Give the TOML file of a sweep, and then numbers of cores.")
    from pcil.sweep import plans  # with JAX, which the table does without

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


def savings(found: Collection) -> tables.Table:
    """What the runs of experiments/until-90.toml took, and the ratio of the two presets' minutes, with its geometric mean.

    A run has reached the share if its last two evaluations have. Of one that has not, all minutes count, so that they are a
    lower bound.
    """
    ends = {(task, variant.partition(",")[0]): runs[0][-2:] for (task, _, variant), runs in by_variant(found.rows).items()}
    rows: list[tuple[Any, ...]] = []
    ratios = []
    for task in dict.fromkeys(task for task, _ in ends):
        cells: list[Any] = [task]
        for preset in PRESETS:
            run = ends[task, preset]
            there = all(row.return_mean >= SHARE * (row.expert_return or math.inf) for row in run)
            cells += [run[-1].frames, tables.cell((run[-1].seconds or math.nan) / 60) + ("" if there else ", not reached")]
        ratios.append((ends[task, PRESETS[0]][-1].seconds or math.nan) / (ends[task, PRESETS[1]][-1].seconds or math.nan))
        rows.append((*cells, ratios[-1]))
    rows.append(("geometric mean", None, None, None, None, statistics.geometric_mean(ratios)))
    return tables.Table(("task", *(f"{word}, {preset}" for preset in PRESETS for word in ("frames", "minutes")), "ratio"), rows)


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(*sys.argv[1:])))
