"""What a run writes while it goes: `eval.csv`, `train.jsonl` and TensorBoard, all rewound to the checkpoint on resume."""

from __future__ import annotations

import csv
import io
import json
import math
import time
from pathlib import Path
from typing import Any

import numpy as np

from pcil.evaluate import Evaluation
from pcil.types import Episode

EVAL_COLUMNS = ("frames", "episode", "return", "length", "seconds")
WALL_CLOCK = ("seconds", "frames_per_second")
"""Columns that differ between two runs of the same settings; all others are equal."""


class MetricWriter:
    """Appends rows; every row is on disk when the call returns."""

    def __init__(self, folder: Path, positions: dict[str, int], frames: int) -> None:
        """`positions` are the bytes of each file that belong to the checkpoint at `frames`; what follows them is cut off."""
        from tensorboardX import SummaryWriter

        self._files = {name: self._open(folder / name, positions.get(name, 0)) for name in ("eval.csv", "train.jsonl")}
        if not self._files["eval.csv"].tell():
            self._write("eval.csv", ",".join(EVAL_COLUMNS) + "\n")
        self._board = SummaryWriter(str(folder / "tensorboard"), purge_step=frames + 1 if frames else None)

    def positions(self) -> dict[str, int]:
        """Length of each file in bytes, for the checkpoint."""
        return {name: file.tell() for name, file in self._files.items()}

    def evaluation(self, frames: int, seconds: float, result: Evaluation) -> None:
        """One row of `eval.csv` an episode."""
        text = io.StringIO()
        rows = zip(result.returns, result.lengths, strict=True)
        csv.writer(text, lineterminator="\n").writerows(
            (frames, i, repr(float(total)), int(length), f"{seconds:.1f}") for i, (total, length) in enumerate(rows)
        )
        self._write("eval.csv", text.getvalue())
        self._board.add_scalar("evaluation/return", result.mean, frames)

    def episode(self, frames: int, values: dict[str, Any]) -> None:
        """One line of `train.jsonl`, and the same numbers to TensorBoard."""
        self._write("train.jsonl", json.dumps({"frames": frames, **values}) + "\n")
        for name, value in values.items():
            if isinstance(value, float) and np.isfinite(value):
                self._board.add_scalar(name if "/" in name else f"episode/{name}", value, frames)

    def __enter__(self) -> MetricWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Flush everything."""
        self._board.close()
        for file in self._files.values():
            file.close()

    @staticmethod
    def _open(path: Path, position: int) -> io.BufferedRandom:
        file = path.open("r+b" if path.exists() else "w+b")
        file.truncate(file.seek(min(position, path.stat().st_size)))  # a file that lost its end is not filled with zeros
        return file

    def _write(self, name: str, text: str) -> None:
        self._files[name].write(text.encode())
        self._files[name].flush()


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
