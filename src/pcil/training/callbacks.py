"""Callbacks that are told how a run goes: the log files, and what loggers of a user's own subclass."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from pcil.errors import RunError
from pcil.training.config import Run
from pcil.training.evaluate import Evaluation

LOGS = ("eval.csv", "train.jsonl")
EVAL_COLUMNS = ("frames", "episode", "return", "length", "seconds")


class History(NamedTuple):
    """What a run had logged before this session; empty for a new run."""

    episodes: list[dict[str, Any]]
    """The rows of `train.jsonl`."""
    evaluations: list[dict[str, str]]
    """The rows of `eval.csv`."""
    seconds: float
    """Wall-clock time of the run until then."""
    demos_return: float | None
    """Mean return of the demonstrations, where there are any with rewards."""


class Callback:
    """A callback is told how a run goes. Every method does nothing by default.

    To add a logger, subclass it and pass an instance: `pcil.train(..., callbacks=[MyLogger()])`, or on the command line
    `--callbacks my.module:MyLogger`, which is created without arguments. A metrics row is a dict of numbers by name, as in a
    line of `train.jsonl`.
    """

    def begin(self, run: Run, folder: Path, history: History) -> None:
        """The run starts in its folder, or resumes after `history`."""

    def episode(self, row: dict[str, Any]) -> None:
        """An episode has ended, or a pass of an offline agent: its metrics row."""

    def evaluation(self, frames: int, seconds: float, result: Evaluation) -> None:
        """The policy was evaluated after `frames` frames and `seconds` of training."""

    def message(self, text: str) -> None:
        """A message for the user."""

    def stop(self) -> bool:
        """Whether to stop the run here and save it; asked between episodes."""
        return False

    def end(self) -> None:
        """The run has ended or stopped: close what `begin` opened."""


class Callbacks(Callback):
    """Several callbacks as one, called in order. An exception of a user's callback becomes a `RunError` that names it."""

    def __init__(self, callbacks: Sequence[Callback]) -> None:
        self._callbacks = list(callbacks)
        self._begun: list[Callback] = []

    def _tell(self, name: str, *arguments: Any) -> list[Any]:
        return [_call(callback, name, *arguments) for callback in self._callbacks]

    def begin(self, run: Run, folder: Path, history: History) -> None:
        for callback in self._callbacks:
            _call(callback, "begin", run, folder, history)
            self._begun.append(callback)

    def episode(self, row: dict[str, Any]) -> None:
        self._tell("episode", row)

    def evaluation(self, frames: int, seconds: float, result: Evaluation) -> None:
        self._tell("evaluation", frames, seconds, result)

    def message(self, text: str) -> None:
        self._tell("message", text)

    def stop(self) -> bool:
        return any(self._tell("stop"))

    def end(self) -> None:
        """End every callback that has begun, even where the end of another one raises."""
        with contextlib.ExitStack() as stack:
            for callback in reversed(self._begun):
                stack.callback(_call, callback, "end")


def _call(callback: Callback, name: str, *arguments: Any) -> Any:
    try:
        return getattr(callback, name)(*arguments)
    except Exception as error:
        kind = type(callback)
        if kind.__module__.startswith("pcil."):
            raise
        raise RunError(
            f"The callback {kind.__module__}.{kind.__qualname__} raised {type(error).__name__} ({error}) in {name}."
        ) from error


class LogFiles(Callback):
    """Writes `eval.csv` and `train.jsonl`; a row is handed to the operating system before the call returns.

    Checkpoints hold the contents of both files, and a resumed run cuts the files back to them. A file that does not start with
    these contents is written again, with a message to the user.
    """

    def __init__(self, folder: Path, saved: dict[str, str], tell: Callback) -> None:
        """`saved` has the contents of each file at the checkpoint."""
        self._written = {name: [saved[name]] if name in saved else [] for name in LOGS}
        self._files = {name: _rewound(folder / name, saved.get(name), tell) for name in LOGS}
        if not self._written["eval.csv"]:
            self._write("eval.csv", ",".join(EVAL_COLUMNS) + "\n")

    def rows(self) -> dict[str, int]:
        """The number of texts written to each file, for `contents`."""
        return {name: len(texts) for name, texts in self._written.items()}

    def contents(self, rows: dict[str, int] | None = None) -> dict[str, str]:
        """The contents of each file, or its contents after `rows` texts, for a checkpoint."""
        rows = rows or self.rows()
        return {name: "".join(texts[: rows[name]]) for name, texts in self._written.items()}

    def history(self, seconds: float, demos_return: float | None) -> History:
        """The contents as other callbacks get them."""
        held = self.contents()
        rows = [json.loads(line) for line in held["train.jsonl"].splitlines()]
        return History(rows, list(csv.DictReader(io.StringIO(held["eval.csv"]))), seconds, demos_return)

    def last_returns(self) -> list[float]:
        """The return of each episode of the last evaluation."""
        rows = list(csv.DictReader(io.StringIO(self.contents()["eval.csv"])))
        return [float(row["return"]) for row in rows if row["frames"] == rows[-1]["frames"]]

    def episode(self, row: dict[str, Any]) -> None:
        self._write("train.jsonl", json.dumps(row) + "\n")

    def evaluation(self, frames: int, seconds: float, result: Evaluation) -> None:
        """A row an episode; where the environment reports `is_success` from the first evaluation on, it is the last column."""
        held = self._written["eval.csv"]
        if result.success and len(held) == 1 and held[0].count("\n") == 1:
            self._files["eval.csv"].seek(0)
            held.clear()
            self._write("eval.csv", ",".join([*EVAL_COLUMNS, "success"]) + "\n")
        with_success = held[0].partition("\n")[0].endswith(",success")
        success = result.success or [math.nan] * len(result.returns)
        lines = []
        for i, (paid, length, won) in enumerate(zip(result.returns.tolist(), result.lengths.tolist(), success, strict=True)):
            cells = [frames, i, paid, length, f"{seconds:.1f}", *([f"{won:g}"] if with_success else [])]
            lines.append(",".join(map(str, cells)) + "\n")
        self._write("eval.csv", "".join(lines))

    def end(self) -> None:
        for file in self._files.values():
            file.close()

    def _write(self, name: str, text: str) -> None:
        _write(self._files[name], text)
        self._written[name].append(text)


def _rewound(path: Path, log: str | None, tell: Callback) -> io.FileIO:
    """The file, at the end of what it held at the checkpoint; written again, and said, where it does not begin with that."""
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    file, content = io.FileIO(os.open(path, flags, 0o666), "r+"), (log or "").encode()
    if file.read(len(content)) != content:
        tell.message(f"{path} is not what this run had written; it is written again from the checkpoint.")
        file.seek(0)
        _write(file, log or "")
    file.truncate(len(content))
    return file


def _write(file: io.FileIO, text: str) -> None:
    left = memoryview(text.encode())
    while left:  # a disk that gets full takes a part first
        left = left[file.write(left) :]
