"""Learning curves as rows of a small CSV: from run folders into `results/`, and from there into figures and tables."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcil.errors import InputError


class Point(NamedTuple):
    """One evaluation of one run; a row of `results/*.csv`."""

    task: str
    method: str
    variant: str
    """The preset, or what was changed from it."""
    seed: int
    frames: int
    return_mean: float
    return_low: float
    return_high: float
    expert_return: float | None
    """Mean return of the demonstrations; None where there were none."""
    commit: str
    """Commit of the code that made the run; "+" where files differed from it."""


def read_run(folder: Path, variant: str | None = None) -> list[Point]:
    """The evaluations of a run folder in the order of time. `InputError` where the folder holds no run."""
    try:
        about = json.loads((folder / "run.json").read_text())
        with (folder / "eval.csv").open() as file:
            rows = [(int(row["frames"]), float(row["return"])) for row in csv.DictReader(file)]
        run, expert = about["run"], (about["demos"] or {}).get("return_mean")
        head = {"task": run["task"], "method": run["method"], "variant": variant or run["preset"], "seed": run["seed"]}
        tail = {"expert_return": expert and round(expert, 2), "commit": about["commit"] or ""}
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise InputError(f"{folder} holds no run that can be read ({error}); give folders that pcil train made.") from error
    points = []
    for frames in dict.fromkeys(frame for frame, _ in rows):
        values = np.array([value for frame, value in rows if frame == frames])
        mean, low, high = (round(float(value), 2) for value in (values.mean(), values.min(), values.max()))
        points.append(Point(**head, frames=frames, return_mean=mean, return_low=low, return_high=high, **tail))
    return points


def write_points(path: Path, points: Iterable[Point]) -> None:
    """One header and a row a point."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(Point._fields)
        table.writerows(points)


def read_points(path: Path) -> list[Point]:
    """What `write_points` wrote."""
    kinds = {"seed": int, "frames": int, "return_mean": float, "return_low": float, "return_high": float}
    with path.open() as file:
        rows: list[dict[str, Any]] = list(csv.DictReader(file))
    for row in rows:
        row |= {name: kind(row[name]) for name, kind in kinds.items()}
        row["expert_return"] = float(row["expert_return"]) if row["expert_return"] else None
    return [Point(**row) for row in rows]
