"""Learning curves as rows of a small CSV: from run folders into `results/`, and from there into figures and tables."""

from __future__ import annotations

import csv
import itertools
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar, get_type_hints

import numpy as np

from pcil.errors import InputError
from pcil.files import parse_json, read_json

OFFLINE = ("bc",)
"""Methods that take no step in the environment; their frames only count updates, two frames each where actions are repeated."""
NO_VARIANT = ("task", "method", "preset", "seed", "checkpoint_seconds", "single_environment")
"""Settings by which two runs may differ and still be seeds, or tasks, of one variant."""


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
    seconds: float | None = None
    """Wall-clock time of the run until then."""
    correlation: float | None = None
    """Of learned and true reward within an episode: mean over the training episodes since the evaluation before in which both
    vary; None where there are none."""


class Dot(NamedTuple):
    """One transition in the representation that a reward has learned; a row of `representation.csv`."""

    task: str
    method: str
    variant: str
    seed: int
    frames: int
    """Training frames of the networks."""
    reward: float | None
    """What the environment paid for it; None for a transition of the expert's."""
    distance: float
    """To the mean of the expert's transitions."""
    silhouette: float
    """Of the two clusters expert and agent, in the representation itself: near 1 inside its own, below 0 in the other."""
    x: float
    y: float
    """Where t-SNE put it."""


Row = TypeVar("Row", Point, Dot)


class Source(NamedTuple):
    """The folder that a curve was read from."""

    folder: Path
    settings: dict[str, Any]
    """Every setting of the run by its dotted name."""
    finished: bool


class Collection(NamedTuple):
    """All that was found below the paths of a report; `sources` goes by the first four values of a row."""

    points: list[Point]
    dots: list[Dot]
    sources: dict[tuple[str, str, str, int], Source]
    notes: list[str]
    """A sentence for each thing that was left out."""


def collect(paths: Sequence[Path], complete: Callable[[dict[str, Any]], dict[str, Any]] = dict) -> Collection:
    """Runs at any depth below folders, and the rows of CSV files; `InputError` where not one run can be read.

    `complete` adds to a run's settings those that are newer than the run.
    """
    points, dots, sources, notes = found = Collection([], [], {}, [])
    folders: dict[Path, Path] = {}
    shown: dict[tuple[Any, ...], Path] = {}
    for path in paths:
        if not path.exists():
            raise InputError(f"{path} does not exist; give run folders, folders that hold some, or files like results/*.csv.")
        rows = read_points(path) if path.is_file() else []
        others = {shown.setdefault((type(row), *row[:4]), path) for row in rows} - {path}
        notes += (f"{path} holds runs that {other} has too; those of the latter are shown." for other in sorted(others))
        rows = [row for row in rows if shown[type(row), *row[:4]] == path]
        points += (row for row in rows if isinstance(row, Point))
        dots += (row for row in rows if isinstance(row, Dot))
        folders |= {file.parent.resolve(): file.parent for file in sorted(path.rglob("run.json"))}
    runs = []
    for folder in folders.values():
        try:
            rows, about = read_run(folder), read_json(folder / "run.json")
            runs.append((rows, Source(folder, complete(flat(about["run"])), (folder / "DONE").exists())))
        except InputError as error:
            notes.append(str(error))
    for (rows, source), variant in zip(runs, _variants([source.settings for _, source in runs]), strict=True):
        name = (*rows[0][:2], variant, rows[0].seed)
        first = sources.setdefault(name, source)
        if first is source:
            points[:] = [point for point in points if point[:4] != name]
            points += (row._replace(variant=variant) for row in rows)
        else:
            notes.append(f"{source.folder} holds the same run as {first.folder}, which is shown.")
    if not points:
        where = ", ".join(map(str, paths)) or "nothing"
        raise InputError([*notes, f"There is no run in {where}; give folders that pcil train made."][0])
    dots.sort(key=place)
    for name, seeds in curves(points).items():
        if not len(matrix(seeds)[0]):
            first = seeds[0][0].seed
            notes.append(f"The seeds of {', '.join(name)} have no frames in common; only seed {first} is shown.")
            points[:] = [point for point in points if point[:3] != name or point.seed == first]
    return found._replace(points=list({point[:5]: point for point in sorted(points, key=place)}.values()))


def place(row: Point | Dot) -> tuple[Any, ...]:
    """Where a row stands among others: by task, method (the paper's first), variant, seed and frames."""
    return (row.task, row.method != "pcil", *row[1:5])


def curves(rows: Iterable[Row]) -> dict[tuple[str, str, str], list[list[Row]]]:
    """The rows of each task, method and variant: a list for each seed."""
    groups: dict[tuple[str, str, str], dict[int, list[Row]]] = {}
    for row in rows:
        groups.setdefault(row[:3], {}).setdefault(row.seed, []).append(row)
    return {name: list(seeds.values()) for name, seeds in groups.items()}


def label(name: tuple[str, str], names: Iterable[tuple[str, str]]) -> str:
    """A method, and its variant unless that is the default preset's and the only one of the method."""
    alone = [method for method, _ in names].count(name[0]) == 1
    return name[0] if alone and name[1] == "default" else ", ".join(name)


def matrix(runs: Sequence[Sequence[Point]], value: str = "return_mean") -> tuple[np.ndarray, np.ndarray]:
    """The frames `[F]` at which every seed has the value, and the values `[seeds, F]`."""
    tables = [{p.frames: getattr(p, value) for p in run if getattr(p, value) is not None} for run in runs]
    frames = sorted(set.intersection(*(set(table) for table in tables)))
    return np.array(frames, np.int64), np.array([[table[f] for f in frames] for table in tables], np.float64)


def read_run(folder: Path, variant: str | None = None) -> list[Point]:
    """The evaluations of a run folder in the order of time. `InputError` where the folder holds no run."""
    try:
        about, columns, log = read_json(folder / "run.json"), read_evaluations(folder), folder / "train.jsonl"
        whole = log.read_text().split("\n")[:-1] if log.exists() else []  # a killed process may leave half a line at the end
        episodes = [episode for line in whole if "correlation" in (episode := parse_json(line))]
        run, expert = about["run"], (about["demos"] or {}).get("return_mean")
        head = {"task": run["task"], "method": run["method"], "variant": variant or run["preset"], "seed": run["seed"]}
        tail = {"expert_return": expert and round(float(expert), 4), "commit": about["commit"] or ""}
        points, before = [], -1.0
        for frames in dict.fromkeys(columns["frames"].tolist()):
            now = columns["frames"] == frames
            mean, low, high = (round(float(f(columns["return"][now])), 2) for f in (np.mean, np.min, np.max))
            fresh = [episode["correlation"] for episode in episodes if before < episode["frames"] <= frames]
            fresh = [correlation for correlation in fresh if correlation]  # null, or 0 in older logs, where one does not vary
            returns = {"return_mean": mean, "return_low": low, "return_high": high}
            seconds, health = float(columns["seconds"][now][0]), round(float(np.mean(fresh)), 4) if fresh else None
            points.append(Point(**head, frames=int(frames), **returns, **tail, seconds=seconds, correlation=health))
            before = frames
    except (OSError, ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        raise InputError(f"{folder} holds no run that can be read ({error}); give folders that pcil train made.") from error
    if not points:
        raise InputError(f"The run in {folder} has no evaluation yet; let it go on for a moment.")
    return points


def read_evaluations(folder: Path) -> dict[str, np.ndarray]:
    """The columns of a run's `eval.csv`, as arrays."""
    with (folder / "eval.csv").open() as file:
        table = csv.DictReader(file)
        rows = list(table)
    return {name: np.array([float(row[name]) for row in rows]) for name in table.fieldnames or ()}


def flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by their dotted names; an environment's arguments are one value."""
    values = {}
    for name, value in settings.items():
        nested = isinstance(value, dict) and name != "env_kwargs"
        values |= flat(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return values


def write_points(path: Path, rows: Sequence[Point] | Sequence[Dot]) -> None:
    """One header and a row a point or a dot; the whole file or, without rows, nothing and `InputError`."""
    if not rows:
        raise InputError(f"There are no rows to write to {path}; it stays as it is.")
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.tmp")
    with partial.open("w", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(rows[0]._fields)
        table.writerows(rows)
    partial.replace(path)


def read_points(path: Path) -> list[Any]:
    """The `Point`s or `Dot`s that `write_points` wrote; columns that a file of an older version lacks are None."""
    try:
        with path.open() as file:
            table = list(csv.DictReader(file))
        kind = Dot if table and "silhouette" in table[0] else Point
        parse = {name: _PARSERS[hint] for name, hint in get_type_hints(kind).items()}
        return [kind(**{name: parse[name](value) for name, value in row.items()}) for row in table]
    except (OSError, ValueError, LookupError, TypeError, csv.Error) as error:
        raise InputError(f"{path} is no file of results ({error}); give one like those in results/.") from error


_PARSERS = {str: str, int: int, float: float, float | None: lambda text: float(text) if text else None}


def _variants(runs: Sequence[dict[str, Any]]) -> list[str]:
    """The preset of each run, and the settings in which runs of its method and preset differ on one task, but for what most
    of these runs have.

    A budget is told only beside another one of the same task: there the usual one goes without, or the longest where the task
    does not have that. Otherwise a task with budgets of its own would part a method's other tasks.
    """
    differing: dict[tuple[str, str], set[str]] = {}
    for one, other in itertools.combinations(runs, 2):
        if all(one[name] == other[name] for name in ("task", "method", "preset")):
            names = {name for name in one | other if one.get(name) != other.get(name)} - set(NO_VARIANT)
            differing.setdefault((one["method"], one["preset"]), set()).update(names)
    usual: dict[tuple[str, str], dict[str, Any]] = {}
    for kind, names in differing.items():
        for name in names:
            values = Counter(str(run.get(name)) for run in runs if (run["method"], run["preset"]) == kind).most_common(2)
            if len(values) == 1 or values[0][1] > values[1][1]:
                usual.setdefault(kind, {})[name] = values[0][0]
    budgets: dict[tuple[str, str, str], set[int]] = {}
    for run in runs:
        budgets.setdefault((run["task"], run["method"], run["preset"]), set()).add(run["frames"])
    labels = []
    for run in runs:
        kind = run["method"], run["preset"]
        there, plain = budgets[run["task"], *kind], dict(usual.get(kind, {}))
        if not any(plain.get("frames") == str(frames) for frames in there):
            plain["frames"] = str(max(there))
        told = [(name, str(run.get(name))) for name in sorted(differing.get(kind, ()))]
        labels.append(", ".join([run["preset"], *(f"{name}={value}" for name, value in told if plain.get(name) != value)]))
    return labels
