"""The progress bar of a run, and signals that stop it."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text

from pcil.errors import shown
from pcil.training.callbacks import Callback, History
from pcil.training.config import Run
from pcil.training.evaluate import Evaluation

WIDE, NARROW = 120, 80
"""Columns that a terminal must have for the whole line, and for all of its numbers but the time elapsed."""
LONGEST_NAME = len("acrobot_swingup expert")
FIELDS = ("description", "fields[amount]", "fields[returns]")


class _TimeLeft(ProgressColumn):
    """Time left at the speed in `rate`."""

    def render(self, task: Task) -> Text:
        left = time_left((task.total or 0) - task.completed, task.fields["rate"])
        return Text(f"{left} left", style="progress.remaining")


def time_left(frames: float | int, rate: float) -> str:
    """How long so many frames take at a speed; the last episode may go past the end, and then it is no time."""
    return f"{timedelta(seconds=int(max(frames, 0) / rate))}" if rate > 0 else "-:--:--"


def compared(value: float, expert: float) -> str:
    """A return beside the expert's; the share is said only where returns are positive, since elsewhere it means nothing."""
    share = f"{value / expert:.0%} of " if expert > 0 else ""
    return f"{share}the expert's {expert:.1f}"


class Screen(Console):
    """A console that falls silent, and stops nothing, once nobody reads it any more: a pipe was closed, a terminal lost."""

    def on_broken_pipe(self) -> None:
        self.quiet = True
        with contextlib.suppress(OSError), open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())  # or Python would complain of it at the end

    def print(self, *objects: Any, **options: Any) -> None:
        try:
            super().print(*objects, **options)
        except OSError:
            self.on_broken_pipe()


class Signals:
    """While it is entered, the first Ctrl-C, SIGTERM or SIGHUP is kept and answered; a second Ctrl-C stops at once.

    A SIGHUP that is ignored, as under nohup, stays ignored. Of other threads than the main one Python takes no handlers, so
    there all stays as it is.
    """

    def __init__(self, answer: Callable[[], None], names: Sequence[str] = ("SIGINT", "SIGTERM", "SIGHUP")) -> None:
        self.number: int | None = None
        self._answer, self._names = answer, names

    def __enter__(self) -> Signals:
        numbers = [signal.Signals[name] for name in self._names if name in signal.Signals.__members__]  # Windows has no SIGHUP
        if threading.current_thread() is not threading.main_thread():
            numbers = []
        taken = [number for number in numbers if number.name != "SIGHUP" or signal.getsignal(number) != signal.SIG_IGN]
        self._before = {number: signal.signal(number, self._ask) for number in taken}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self.number is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.number = number
        self._answer()


class Bar(Callback):
    """Reports a run to the terminal. Ctrl-C or SIGTERM ends it after the episode at hand; a second Ctrl-C at once."""

    def __init__(self, console: Console, expert_return: float | None = None) -> None:
        """`expert_return` is what returns are compared with, unless the run has demonstrations."""
        self._signals = Signals(self._stopping)
        self.evaluations: list[tuple[int, float]] = []
        self.expert_return = expert_return
        self._began: tuple[float, int] | None = None
        self._width = console.width
        name, amount, returns = (TextColumn(f"{{task.{field}}}", markup=False) for field in FIELDS)
        wide = [name, BarColumn(), amount, TimeElapsedColumn(), _TimeLeft(), returns]
        columns = wide if self._width >= WIDE else [name, amount, _TimeLeft(), returns]
        self._progress = Progress(*columns, console=console, disable=not console.is_terminal)
        self._task = self._progress.add_task("starting", total=None, amount="", returns="", rate=0.0)

    def __enter__(self) -> Bar:
        self._signals.__enter__()
        self._progress.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._progress.stop()
        self._signals.__exit__()

    @property
    def signal(self) -> int | None:
        """The one that has asked to stop."""
        return self._signals.number

    def begin(self, run: Run, folder: Path, history: History) -> None:
        self._run = run
        if history.demos_return is not None:
            self.expert_return = history.demos_return

    def episode(self, row: dict[str, Any]) -> None:
        """Advance the bar. The speed is that since the first row of this session with updates, so that neither compilation nor
        the random steps at the start of a run count."""
        frames, total = row["frames"], self._run.frames
        now = time.perf_counter()
        if row.get("updates"):
            self._began = self._began or (now, frames)
        seconds, since = (now - self._began[0], frames - self._began[1]) if self._began else (0.0, 0)
        rate = since / seconds if seconds > 0 else 0.0
        amount = f"{frames:,}/{total:,} frames" if self._width >= WIDE else f"{frames:,}/{total:,}"
        amount = f"{amount}  {rate:,.0f}/s" if self._width >= NARROW else f"{frames // 1000}k/{total // 1000}k"
        returns = {"returns": self._returns(row["return"])} if "return" in row else {}  # an offline agent plays no episode
        self._update(frames, rate=rate, amount=amount, **returns)

    def evaluation(self, frames: int, seconds: float, result: Evaluation) -> None:
        """One line for each evaluation, beside the expert's return."""
        self.evaluations.append((frames, result.mean))
        against = f" ({compared(result.mean, self.expert_return)})" if self.expert_return is not None else ""
        against += f"  success {np.mean(result.success):.0%}" if result.success else ""
        low, high = result.returns.min(), result.returns.max()
        self.message(f"{frames:>9,} frames  return {result.mean:7.1f}  [{low:.1f}, {high:.1f}]{against}")
        self._update(frames)

    def message(self, text: str) -> None:
        """Print above the bar."""
        self._progress.console.print(shown(text), highlight=False, markup=False, soft_wrap=True)

    def stop(self) -> bool:
        """Whether a signal has asked to stop."""
        return self.signal is not None

    def _update(self, frames: int, **fields: Any) -> None:
        name = shown(f"{self._run.task} {self._run.method}", 60)
        name = name if self._width >= WIDE or len(name) <= LONGEST_NAME else f"{name[: LONGEST_NAME - 1]}…"
        self._progress.update(self._task, description=name, completed=frames, total=self._run.frames, **fields)

    def _returns(self, total_reward: float) -> str:
        last = f"return {total_reward:.0f}"
        compared = self.expert_return is not None and self._width >= NARROW
        return f"{last} of {self.expert_return:.0f}" if compared else last

    def _stopping(self) -> None:
        self.message("Stopping after this episode; Ctrl-C again stops at once and loses what came since the last checkpoint.")
