"""Evaluations and transitions as rows: read from run folders and CSV files, written to CSV files such as `results/*.csv`."""

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
from pcil.files import flat, parse_json, read_json, read_text, write_text
from pcil.report.variants import MAX_NAME_LENGTH, variants

OFFLINE = ("bc",)
"""Methods that take no step in the environment. Their frames count updates: one update is as many frames as one agent step."""
MAX_MAGNITUDE = 1e50
"""The largest magnitude of a number; its square is finite."""
MAX_FILE_BYTES = 2**28
"""The largest size of a log or a file of results, in bytes."""
UNREADABLE = (OSError, ValueError, LookupError, TypeError, ArithmeticError, RecursionError, csv.Error)
"""The exceptions that reading a damaged file can raise."""


Track = Callable[[Sequence[Any], str], Iterable[Any]]
"""Goes through a sequence and shows the progress under a name."""


def quietly(items: Sequence[Any], name: str) -> Iterable[Any]:
    """A `Track` that shows nothing."""
    del name
    return items


class EvalRow(NamedTuple):
    """One evaluation of one run; a row of `results/*.csv`."""

    task: str
    method: str
    variant: str
    """The preset, followed by the settings that were changed from it."""
    seed: int
    frames: int
    return_mean: float
    return_low: float
    return_high: float
    expert_return: float | None
    """Mean return of the demonstrations; None if the run had none."""
    commit: str
    """Commit of the code that made the run, with a "+" if the working tree had changes."""
    seconds: float | None = None
    """Wall-clock time from the start of the run to this evaluation."""
    correlation: float | None = None
    """Correlation of the learned and the true reward within an episode: the mean over the training episodes since the previous
    evaluation in which both rewards vary; None if there are none."""


class TransitionRow(NamedTuple):
    """One transition in the representation that a reward has learned; a row of `transitions.csv`."""

    task: str
    method: str
    variant: str
    seed: int
    frames: int
    """Training frames of the networks."""
    reward: float | None
    """The environment's reward; None for a transition of the expert."""
    distance: float
    """Distance in the representation to the mean of the expert's transitions."""
    silhouette: float
    """Silhouette in the representation, with expert and agent as the two clusters: near 1 deep inside the own cluster, negative
    inside the other."""
    x: float
    y: float
    """Coordinates of the t-SNE plot."""


Row = TypeVar("Row", EvalRow, TransitionRow)
COLUMNS: dict[type, dict[str, Any]] = {kind: get_type_hints(kind) for kind in (EvalRow, TransitionRow)}
"""The name and type of each column of a file of results."""


class Source(NamedTuple):
    """The run folder that rows were read from."""

    folder: Path
    settings: dict[str, Any]
    """Every setting of the run, by its dotted name."""
    finished: bool


class Collection(NamedTuple):
    """Everything found below the paths of a report. The keys of `sources` are the first four values of a row."""

    rows: list[EvalRow]
    transitions: list[TransitionRow]
    sources: dict[tuple[str, str, str, int], Source]
    notes: list[str]
    """One sentence for each thing that was left out."""


def collect(paths: Sequence[Path], complete: Callable[[dict[str, Any]], dict[str, Any]] = dict) -> Collection:
    """Read the runs at any depth below folders, and the rows of CSV files; `InputError` if no run can be read.

    `complete` adds to a run's settings those that were introduced after the run was made.
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
    for name, seeds in by_variant(rows).items():
        if not len(matrix(seeds)[0]):
            seed = seeds[0][0].seed
            notes.append(f"The seeds of {', '.join(name)} have no frames in common; only seed {seed} is shown.")
            rows[:] = [row for row in rows if row[:3] != name or row.seed == seed]
    return found._replace(rows=list({row[:5]: row for row in sorted(rows, key=sort_key)}.values()))


def left_out(where: Path, reason: Any) -> str:
    """The note about a run or file that is left out."""
    if isinstance(reason, OSError) and reason.filename:
        reason = f"{Path(reason.filename).name} can't be read ({reason.strerror})"
    return f"left out: {named(where, reason)}"


def named(where: Path, reason: Any) -> str:
    """A folder and a reason; the folder is not repeated if the reason begins with it."""
    folder, text = shown(str(where), 500), shown(str(reason), 500)
    return text if text.startswith(folder) else f"{folder}, {text}"


def sort_key(row: EvalRow | TransitionRow) -> tuple[Any, ...]:
    """Sort rows by task, method (PCIL first), variant, seed and frames."""
    return (row.task, row.method != "pcil", *row[1:5])


def by_variant(rows: Iterable[Row]) -> dict[tuple[str, str, str], list[list[Row]]]:
    """The rows of each task, method and variant, as one list for each seed."""
    groups: dict[tuple[str, str, str], dict[int, list[Row]]] = {}
    for row in rows:
        groups.setdefault(row[:3], {}).setdefault(row.seed, []).append(row)
    return {name: list(seeds.values()) for name, seeds in groups.items()}


def label(name: tuple[str, str], names: Iterable[tuple[str, str]]) -> str:
    """The name of a method, followed by its variant unless the method has only the variant `default`."""
    alone = [method for method, _ in names].count(name[0]) == 1
    return name[0] if alone and name[1] == "default" else ", ".join(name)


def matrix(runs: Sequence[Sequence[EvalRow]], value: str = "return_mean") -> tuple[np.ndarray, np.ndarray]:
    """The frames `[F]` at which every seed has a value, and the values `[seeds, F]`."""
    tables = [{row.frames: getattr(row, value) for row in run if getattr(row, value) is not None} for run in runs]
    frames = sorted(set.intersection(*map(set, tables)))
    return np.array(frames, np.int64), np.array([[table[f] for f in frames] for table in tables], np.float64)


def read_run(folder: Path, variant: str | None = None) -> list[EvalRow]:
    """The evaluations of a run folder, in chronological order; `InputError` if the folder holds no run."""
    try:
        return _read(folder, variant)[0]
    except UNREADABLE as error:
        raise InputError(f"{folder} holds no run that can be read ({error}); give folders that pcil train made.") from error


def _read(folder: Path, variant: str | None = None) -> tuple[list[EvalRow], dict[str, Any], bool]:
    """The evaluations of a run folder, its settings, and whether its last evaluation was only half written.

    Raises one of `UNREADABLE` if a file is damaged.
    """
    description, (columns, truncated), log = read_json(folder / "run.json"), _evaluations(folder), folder / "train.jsonl"
    kinds = {"run": dict, "demos": dict, "commit": str}
    run, demos, commit = (_typed(description, name, kind, NoneType) for name, kind in kinds.items())
    task, method, preset = (_typed(run, name, str) for name in ("task", "method", "preset"))
    seed, _ = _typed(run, "seed", int), _typed(run, "frames", int, NoneType)
    expert = _typed(demos or {}, "return_mean", int, float, NoneType)
    head, tail = (task, method, variant or preset, seed), (expert and round(expert, 4), commit or "")
    lines = read_text(log, MAX_FILE_BYTES).split("\n")[:-1] if log.exists() else []  # a killed run may leave half a line
    episodes = [episode for line in lines if "correlation" in (episode := parse_json(line))]
    logged = [(_typed(e, "frames", int), _typed(e, "correlation", int, float, NoneType)) for e in episodes]
    rows, previous = [], -1.0
    if np.any(columns["frames"] % 1) or np.any(np.diff(columns["frames"]) < 0):
        raise ValueError("the frames in eval.csv are not whole numbers in increasing order")
    for frames in dict.fromkeys(columns["frames"].tolist()):
        returns, seconds = (columns[name][columns["frames"] == frames] for name in ("return", "seconds"))
        mean, low, high = (round(float(f(returns)), 2) for f in (np.mean, np.min, np.max))
        # a constant reward has no correlation: null, in older logs 0
        correlations = [correlation for end, correlation in logged if previous < end <= frames and correlation]
        correlation = round(float(np.mean(correlations)), 4) if correlations else None
        rows.append(_checked(EvalRow(*head, int(frames), mean, low, high, *tail, float(seconds[0]), correlation)))
        previous = frames
    if not rows:
        raise ValueError("it has no evaluation yet")
    return rows, run, truncated


def _typed(table: Any, name: str, *kinds: type) -> Any:
    """The value of a key, None if the key is missing; `ValueError` if the value has none of these types."""
    value = table.get(name) if isinstance(table, dict) else table
    if not isinstance(table, dict) or type(value) not in kinds:
        raise ValueError(f"its {name} is {brief(value)}")
    return value


def _checked(row: Row) -> Row:
    """Return the row; `ValueError` if a value does not have its column's type.

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
    """The columns of a run's `eval.csv` as arrays; `ValueError` if it holds anything but finite numbers."""
    return _evaluations(folder)[0]


def _evaluations(folder: Path) -> tuple[dict[str, np.ndarray], bool]:
    """The columns of `eval.csv`, and whether its last line is half written; an incomplete last evaluation is then left out."""
    complete, _, rest = read_text(folder / "eval.csv", MAX_FILE_BYTES).rpartition("\n")
    table = csv.DictReader(io.StringIO(complete))
    rows = list(table)
    columns = {name: np.array([float(row[name] or "") for row in rows]) for name in table.fieldnames or ()}
    if missing := {"frames", "return", "seconds"} - set(columns):
        raise ValueError(f"eval.csv has no column {', '.join(sorted(missing))}")
    if any(None in row for row in rows):
        raise ValueError("eval.csv has a line with more values than columns")
    if not all(np.isfinite(column).all() for column in columns.values()):
        raise ValueError("eval.csv holds a number that is not finite")
    first, last = (columns["frames"] == frames for frames in (columns["frames"][:1], columns["frames"][-1:]))
    if rest and last.sum() < first.sum():
        columns = {name: column[~last] for name, column in columns.items()}
    return columns, bool(rest)


def escape_formula(text: str) -> str:
    """Text for a CSV cell that a spreadsheet does not evaluate: a text that looks like a formula gets a leading '."""
    return f"'{text}" if re.match(r"'*[=+\-@\t\r]", text) else text


def write_csv(path: Path, lines: Iterable[Iterable[Any]]) -> None:
    """Write a CSV file completely or not at all, with formulas escaped."""
    text = io.StringIO()
    escaped = ([escape_formula(value) if isinstance(value, str) else value for value in line] for line in lines)
    csv.writer(text, lineterminator="\n").writerows(escaped)
    write_text(path, text.getvalue())


def write_rows(path: Path, rows: Sequence[EvalRow] | Sequence[TransitionRow]) -> None:
    """Write a header and one line for each row; `InputError` if there are no rows, and the file is not touched."""
    if not rows:
        raise InputError(f"There are no rows to write to {path}; it stays as it is.")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_csv(path, [rows[0]._fields, *rows])


def read_rows(path: Path) -> list[Any]:
    """Read what `write_rows` wrote. Columns that a file of an older version lacks are None; `InputError` for any other file."""
    try:
        table = list(csv.DictReader(io.StringIO(read_text(path, MAX_FILE_BYTES))))
        kind: Any = TransitionRow if table and "silhouette" in table[0] else EvalRow
        parse = {name: _PARSERS[hint] for name, hint in COLUMNS[kind].items()}
        columns = set(table[0]) if table else set(parse)
        if wrong := (columns - set(parse)) or (set(parse) - columns - set(kind._field_defaults)):
            raise ValueError(
                f"{shown(str(min(wrong, key=str)), 100)} is {'missing' if wrong <= set(parse) else 'not a column of it'}"
            )
        rows = [_checked(kind(**{name: parse[name](value) for name, value in row.items()})) for row in table]
        for runs in by_variant(row for row in rows if isinstance(row, TransitionRow)).values():
            if any(len({row.reward is None for row in run}) < 2 for run in runs):
                raise ValueError("it has a run without transitions of expert and agent")
        return rows
    except UNREADABLE as error:
        raise InputError(f"{path} is not a file of results ({error}); give one like those in results/.") from error


_PARSERS = {
    str: lambda text: re.sub(r"^'(?='*[=+\-@\t\r])", "", text),
    int: int,
    float: float,
    float | None: lambda text: float(text) if text else None,
}
