"""Learning curves as rows of a small CSV: from run folders into `results/`, and from there into figures and tables."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import NoneType
from typing import Any, NamedTuple, TypeVar, get_type_hints

import numpy as np

from pcil.errors import InputError, brief, shown
from pcil.files import parse_json, read_json, read_text
from pcil.report.variants import MAX_NAME_LENGTH, variants

OFFLINE = ("bc",)
"""Methods that take no step in the environment; their frames only count updates, two frames each where actions are repeated."""
MAX_MAGNITUDE = 1e50
"""Magnitude of a number, whose square is finite too."""
MAX_FILE_BYTES = 2**28
"""Bytes of a log or a file of results."""
UNREADABLE = (OSError, ValueError, LookupError, TypeError, ArithmeticError, RecursionError, csv.Error)
"""What reading a damaged file may raise."""


class EvalRow(NamedTuple):
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


class TransitionRow(NamedTuple):
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


Row = TypeVar("Row", EvalRow, TransitionRow)
COLUMNS: dict[type, dict[str, Any]] = {kind: get_type_hints(kind) for kind in (EvalRow, TransitionRow)}
"""The name and type of each column of a file of results."""


class Source(NamedTuple):
    """The folder that a curve was read from."""

    folder: Path
    settings: dict[str, Any]
    """Every setting of the run by its dotted name."""
    finished: bool


class Collection(NamedTuple):
    """All that was found below the paths of a report; `sources` goes by the first four values of a row."""

    rows: list[EvalRow]
    transitions: list[TransitionRow]
    sources: dict[tuple[str, str, str, int], Source]
    notes: list[str]
    """A sentence for each thing that was left out."""


def collect(paths: Sequence[Path], complete: Callable[[dict[str, Any]], dict[str, Any]] = dict) -> Collection:
    """The runs at any depth below folders, and the rows of CSV files; `InputError` where no run can be read.

    `complete` adds to a run's settings those that are newer than the run.
    """
    rows, transitions, sources, notes = found = Collection([], [], {}, [])
    folders: dict[Path, Path] = {}
    first_file: dict[tuple[Any, ...], Path] = {}
    for path in paths:
        if not path.exists():
            raise InputError(f"{path} does not exist; give run folders, folders that hold some, or files like results/*.csv.")
        try:
            added = read_rows(path) if path.is_file() else []
        except InputError as error:
            notes.append(left_out(path, error))
            continue
        others = {first_file.setdefault((type(row), *row[:4]), path) for row in added} - {path}
        notes += (f"{path} holds runs that {other} has too; those of the latter are shown." for other in sorted(others))
        kept = (row for row in added if first_file[type(row), *row[:4]] == path)
        (transitions if added and isinstance(added[0], TransitionRow) else rows).extend(kept)
        folders |= {file.parent.resolve(): file.parent for file in sorted(path.rglob("run.json"))}
    runs: list[tuple[list[EvalRow], Source]] = []
    for folder in folders.values():
        try:
            run_rows, run, truncated = _read(folder)
            notes += [left_out(folder, "the end of eval.csv, whose last line is half written")] if truncated else []
            runs.append((run_rows, Source(folder, complete(flat(run)), (folder / "DONE").exists())))
        except UNREADABLE as error:
            notes.append(left_out(folder, error))
    for (run_rows, source), variant in zip(runs, variants([source.settings for _, source in runs]), strict=True):
        name = (*run_rows[0][:2], variant, run_rows[0].seed)
        if (first := sources.setdefault(name, source)) is source:
            rows[:] = [row for row in rows if row[:4] != name] + [row._replace(variant=variant) for row in run_rows]
        else:
            notes.append(f"{source.folder} holds the same run as {first.folder}, which is shown.")
    if not rows:
        where = ", ".join(map(str, paths)) or "nothing"
        reason = f" ({notes[0].removesuffix('.')})" if notes else ""
        raise InputError(f"There is no run in {where}{reason}; give folders that pcil train made.")
    transitions.sort(key=sort_key)
    for name, seeds in curves(rows).items():
        if not len(matrix(seeds)[0]):
            seed = seeds[0][0].seed
            notes.append(f"The seeds of {', '.join(name)} have no frames in common; only seed {seed} is shown.")
            rows[:] = [row for row in rows if row[:3] != name or row.seed == seed]
    return found._replace(rows=list({row[:5]: row for row in sorted(rows, key=sort_key)}.values()))


def left_out(where: Path, reason: Any) -> str:
    """A note of what is not shown."""
    if isinstance(reason, OSError) and reason.filename:
        reason = f"{Path(reason.filename).name} can't be read ({reason.strerror})"
    return f"left out: {named(where, reason)}"


def named(where: Path, reason: Any) -> str:
    """A folder and a reason, which may name it already."""
    folder, text = shown(str(where), 500), shown(str(reason), 500)
    return text if text.startswith(folder) else f"{folder}, {text}"


def sort_key(row: EvalRow | TransitionRow) -> tuple[Any, ...]:
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


def matrix(runs: Sequence[Sequence[EvalRow]], value: str = "return_mean") -> tuple[np.ndarray, np.ndarray]:
    """The frames `[F]` at which every seed has the value, and the values `[seeds, F]`."""
    tables = [{p.frames: getattr(p, value) for p in run if getattr(p, value) is not None} for run in runs]
    frames = sorted(set.intersection(*(set(table) for table in tables)))
    return np.array(frames, np.int64), np.array([[table[f] for f in frames] for table in tables], np.float64)


def read_run(folder: Path, variant: str | None = None) -> list[EvalRow]:
    """The evaluations of a run folder in the order of time. `InputError` where the folder holds no run."""
    try:
        return _read(folder, variant)[0]
    except UNREADABLE as error:
        raise InputError(f"{folder} holds no run that can be read ({error}); give folders that pcil train made.") from error


def _read(folder: Path, variant: str | None = None) -> tuple[list[EvalRow], dict[str, Any], bool]:
    """The evaluations of a run folder, its settings, and whether an evaluation was half written; raises what is among
    `UNREADABLE`."""
    about, (columns, torn), log = read_json(folder / "run.json"), _evaluations(folder), folder / "train.jsonl"
    run, demos, commit = (
        _typed(about, name, kind, NoneType) for name, kind in (("run", dict), ("demos", dict), ("commit", str))
    )
    names = {name: _typed(run, name, str) for name in ("task", "method", "preset")}
    seed, _ = _typed(run, "seed", int), _typed(run, "frames", int, NoneType)
    expert = _typed(demos or {}, "return_mean", int, float, NoneType)
    head = (names["task"], names["method"], variant or names["preset"], seed)
    tail = (expert and round(expert, 4), commit or "")
    whole = read_text(log, MAX_FILE_BYTES).split("\n")[:-1] if log.exists() else []  # a killed process may leave half a line
    episodes = [episode for line in whole if "correlation" in (episode := parse_json(line))]
    ends = [(_typed(e, "frames", int), _typed(e, "correlation", int, float, NoneType)) for e in episodes]
    rows, before = [], -1.0
    if np.any(columns["frames"] % 1) or np.any(np.diff(columns["frames"]) < 0):
        raise ValueError("the frames in eval.csv are no whole numbers that grow")
    for frames in dict.fromkeys(columns["frames"].tolist()):
        returns, seconds = (columns[name][columns["frames"] == frames] for name in ("return", "seconds"))
        mean, low, high = (round(float(f(returns)), 2) for f in (np.mean, np.min, np.max))
        fresh = [correlation for end, correlation in ends if before < end <= frames and correlation]  # null, or 0 in older
        health = round(float(np.mean(fresh)), 4) if fresh else None  # logs, where one of the two does not vary
        rows.append(_checked(EvalRow(*head, int(frames), mean, low, high, *tail, float(seconds[0]), health)))
        before = frames
    if not rows:
        raise ValueError("it has no evaluation yet")
    return rows, run, torn


def _typed(table: Any, name: str, *kinds: type) -> Any:
    """A value of a table, None where it lacks that; `ValueError` where it is of none of these kinds."""
    value = table.get(name) if isinstance(table, dict) else table
    if not isinstance(table, dict) or type(value) not in kinds:
        raise ValueError(f"its {name} is {brief(value)}")
    return value


def _checked(row: Row) -> Row:
    """Return the row; `ValueError` where a value is not of its column's type.

    Text is printable and has at most `MAX_NAME_LENGTH` characters; a number is at most `MAX_MAGNITUDE`.
    """
    for name, hint in COLUMNS[type(row)].items():
        value: Any = getattr(row, name)
        if isinstance(value, str):
            fits = hint is str and value.isprintable() and len(value) <= MAX_NAME_LENGTH and (value or name == "commit")
        elif value is None:
            fits = hint == float | None
        else:
            fits = hint is not str and abs(value) <= MAX_MAGNITUDE and (hint is not int or 0 <= value < 2**53)
        if not fits:
            raise ValueError(f"its {name} is {brief(value)}")
    return row


def read_evaluations(folder: Path) -> dict[str, np.ndarray]:
    """The columns of a run's `eval.csv`, as arrays; `ValueError` where it holds anything else than finite numbers."""
    return _evaluations(folder)[0]


def _evaluations(folder: Path) -> tuple[dict[str, np.ndarray], bool]:
    """The columns without an evaluation whose last line is half written, and whether there was one."""
    whole, _, half = read_text(folder / "eval.csv", MAX_FILE_BYTES).rpartition("\n")
    table = csv.DictReader(io.StringIO(whole))
    rows = list(table)
    columns = {name: np.array([float(row[name] or "") for row in rows]) for name in table.fieldnames or ()}
    if missing := {"frames", "return", "seconds"} - set(columns):
        raise ValueError(f"eval.csv has no column {', '.join(sorted(missing))}")
    if any(None in row for row in rows):
        raise ValueError("eval.csv has a line of more values than columns")
    if not all(np.isfinite(column).all() for column in columns.values()):
        raise ValueError("eval.csv holds a number that is not finite")
    first, last = (columns["frames"] == frames for frames in (columns["frames"][:1], columns["frames"][-1:]))
    if half and last.sum() < first.sum():
        columns = {name: column[~last] for name, column in columns.items()}
    return columns, bool(half)


def flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by their dotted names; an environment's arguments are one value."""
    values = {}
    for name, value in settings.items():
        nested = isinstance(value, dict) and name != "env_kwargs"
        values |= flat(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return values


def escape_formula(text: str) -> str:
    """Text of a CSV file's cell that no spreadsheet takes for a formula: one that looks like one has a ' before it."""
    return f"'{text}" if re.match(r"'*[=+\-@\t\r]", text) else text


def write_csv(path: Path, lines: Iterable[Iterable[Any]]) -> None:
    """Write a CSV file as a whole or not at all; no text in it is a spreadsheet's formula."""
    partial = path.with_name(f"{path.name}.tmp")
    with partial.open("w", newline="", encoding="utf-8") as file:
        escaped = ([escape_formula(value) if isinstance(value, str) else value for value in line] for line in lines)
        csv.writer(file, lineterminator="\n").writerows(escaped)
    partial.replace(path)


def write_rows(path: Path, rows: Sequence[EvalRow] | Sequence[TransitionRow]) -> None:
    """Write a header and a line for each row; without rows the file stays as it is, and `InputError` is raised."""
    if not rows:
        raise InputError(f"There are no rows to write to {path}; it stays as it is.")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_csv(path, [rows[0]._fields, *rows])


def read_rows(path: Path) -> list[Any]:
    """The `EvalRow`s or `TransitionRow`s that `write_rows` wrote; columns that a file of an older version lacks are None."""
    try:
        table = list(csv.DictReader(io.StringIO(read_text(path, MAX_FILE_BYTES))))
        kind: Any = TransitionRow if table and "silhouette" in table[0] else EvalRow
        parse = {name: _PARSERS[hint] for name, hint in COLUMNS[kind].items()}
        columns = set(table[0]) if table else set(parse)
        if wrong := (columns - set(parse)) or (set(parse) - columns - set(kind._field_defaults)):
            raise ValueError(
                f"{shown(str(min(wrong, key=str)), 100)} is {'missing' if wrong <= set(parse) else 'no column of it'}"
            )
        rows = [_checked(kind(**{name: parse[name](value) for name, value in row.items()})) for row in table]
        for runs in curves(row for row in rows if isinstance(row, TransitionRow)).values():
            if any(len({row.reward is None for row in run}) < 2 for run in runs):
                raise ValueError("it has a run without transitions of expert and agent")
        return rows
    except UNREADABLE as error:
        raise InputError(f"{path} is no file of results ({error}); give one like those in results/.") from error


_PARSERS = {
    str: lambda text: re.sub(r"^'(?='*[=+\-@\t\r])", "", text),
    int: int,
    float: float,
    float | None: lambda text: float(text) if text else None,
}
