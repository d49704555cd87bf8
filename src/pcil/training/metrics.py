"""What a run writes while it goes: `eval.csv`, `train.jsonl` and TensorBoard, all rewound to the checkpoint on resume."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import os
import statistics
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from pcil.training.evaluate import Evaluation
from pcil.types import Episode

LOGS = ("eval.csv", "train.jsonl")
EVAL_COLUMNS = ("frames", "episode", "return", "length", "seconds")
WALL_CLOCK = ("seconds", "frames_per_second")
"""Columns that differ between two runs of the same settings; all others are equal."""


class MetricWriter:
    """Appends rows to the logs and TensorBoard; a row of the logs is with the system when the call returns."""

    def __init__(self, folder: Path, logs: dict[str, str], seconds: float, say: Callable[[str], None]) -> None:
        """`logs` are what the files held at the checkpoint that the run goes on from, after `seconds` of training.

        The files are made to hold just that: what follows is cut off, and one that begins otherwise is written again, which
        `say` is told. TensorBoard's files are always written again, from the logs.
        """
        self._written = {name: [logs[name]] if name in logs else [] for name in LOGS}
        self._files = {name: _rewound(folder / name, logs.get(name), say) for name in LOGS}
        self._board = _Board(folder / "tensorboard", time.time() - seconds)
        if not self._written["eval.csv"]:
            self._write("eval.csv", ",".join(EVAL_COLUMNS) + "\n")
        for line in logs.get("train.jsonl", "").splitlines():
            self._board.episode(json.loads(line))
        self._board.evaluations(csv.DictReader(io.StringIO(logs.get("eval.csv", ""))))
        self._board.flush()

    def rows(self) -> dict[str, int]:
        """How many rows were written to each file, for `logs`."""
        return {name: len(texts) for name, texts in self._written.items()}

    def logs(self, rows: dict[str, int] | None = None) -> dict[str, str]:
        """What each file holds, or held after so many rows, for a checkpoint."""
        rows = rows or self.rows()
        return {name: "".join(texts[: rows[name]]) for name, texts in self._written.items()}

    def evaluation(self, frames: int, seconds: float, result: Evaluation) -> None:
        """One row of `eval.csv` an episode."""
        rows = zip(result.returns, result.lengths, strict=True)
        values = [(frames, i, repr(float(total)), int(length), f"{seconds:.1f}") for i, (total, length) in enumerate(rows)]
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(values)
        self._write("eval.csv", text.getvalue())
        self._board.evaluations([dict(zip(EVAL_COLUMNS, map(str, row), strict=True)) for row in values])
        self._board.flush()

    def episode(self, frames: int, values: dict[str, Any]) -> None:
        """One line of `train.jsonl`, and the same numbers to TensorBoard."""
        row = {"frames": frames, **values}
        self._write("train.jsonl", json.dumps(row) + "\n")
        self._board.episode(row)

    def __enter__(self) -> MetricWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the files."""
        for file in (*self._files.values(), self._board):
            file.close()

    def _write(self, name: str, text: str) -> None:
        _write(self._files[name], text)
        self._written[name].append(text)


class _Board:
    """TensorBoard's file of a run, written in this thread, so that a full disk is an error here and not one of a thread."""

    def __init__(self, folder: Path, began: float) -> None:
        """An empty file in place of those that are there; `began` is the wall-clock time of the run's first second."""
        from tensorboardX.record_writer import RecordWriter

        folder.mkdir(exist_ok=True)
        for path in folder.glob("events.out.tfevents.*"):
            path.unlink()
        self._began = began
        self._writer = RecordWriter(str(folder / f"events.out.tfevents.{int(began)}.pcil"))
        self._event(0.0, file_version="brain.Event:2")

    def episode(self, row: dict[str, Any]) -> None:
        """Each float of a line of `train.jsonl`."""
        for name, value in row.items():
            if isinstance(value, float) and math.isfinite(value):
                self._scalar(name if "/" in name else f"episode/{name}", value, row["frames"], row.get("seconds", 0.0))

    def evaluations(self, rows: Iterable[dict[str, str]]) -> None:
        """The mean return of each evaluation among rows of `eval.csv`."""
        for frames, group in itertools.groupby(rows, key=lambda row: row["frames"]):
            episodes = list(group)
            mean = statistics.fmean(float(row["return"]) for row in episodes)
            self._scalar("evaluation/return", mean, int(frames), float(episodes[0]["seconds"]))

    def flush(self) -> None:
        self._writer.flush()

    def close(self) -> None:
        self._writer.close()

    def _scalar(self, name: str, value: float, frames: int, seconds: float) -> None:
        from tensorboardX.summary import scalar

        self._event(seconds, step=frames, summary=scalar(name, value))

    def _event(self, seconds: float, **content: Any) -> None:
        from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue] - protobuf makes it

        self._writer.write(Event(wall_time=self._began + seconds, **content).SerializeToString())


def _rewound(path: Path, log: str | None, say: Callable[[str], None]) -> io.FileIO:
    """The file, at the end of what it held at the checkpoint; written again, and said, where it does not begin with that."""
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    file, content = io.FileIO(os.open(path, flags, 0o666), "r+"), (log or "").encode()
    if file.read(len(content)) != content:
        say(f"{path} is not what this run had written; it is written again from the checkpoint.")
        file.seek(0)
        _write(file, log or "")
    file.truncate(len(content))
    return file


def _write(file: io.FileIO, text: str) -> None:
    left = memoryview(text.encode())
    while left:  # a disk that gets full takes a part first
        left = left[file.write(left) :]


def described(episode: Episode, learned: np.ndarray) -> dict[str, Any]:
    """What an episode brought, what the learned reward made of it, and how the two correlate: the method's health."""
    return {
        "return": episode.total_reward,
        "length": len(episode),
        "learned_return": float(learned.sum(dtype=np.float64)),
        "correlation": pearson(learned[: len(episode)], episode.reward),
    }


def pearson(x: np.ndarray, y: np.ndarray) -> float | None:
    """Pearson correlation; None where one of the two does not vary."""
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    with np.errstate(invalid="ignore"):  # of values so small that their squares are 0
        value = float(np.corrcoef(x.astype(np.float64), y.astype(np.float64))[0, 1])
    return value if math.isfinite(value) else None


class Clock:
    """Wall-clock seconds, going on from where an earlier session stopped."""

    def __init__(self, before: float) -> None:
        self._before, self._begin = before, time.perf_counter()
        self._last: tuple[int, float] | None = None

    def total(self) -> float:
        """Seconds over all sessions."""
        return self._before + time.perf_counter() - self._begin

    def rate(self, frames: int) -> float:
        """Frames a second since the last call."""
        now = self.total()
        before, self._last = self._last, (frames, now)
        return (frames - before[0]) / max(now - before[1], 1e-9) if before else 0.0
