"""What a person sees of a run: a `rich` progress bar, and how to stop it well."""

from __future__ import annotations

import signal
import time
from types import FrameType
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text

from pcil.config import Run
from pcil.evaluate import Evaluation


class _TimeLeft(ProgressColumn):
    """Time left at the speed since the bar began; a resumed run's head start does not count as speed."""

    def render(self, task: Task) -> Text:
        rate = task.fields["rate"]
        if not rate or task.total is None:
            return Text("--:-- left", style="progress.remaining")
        left = max(int((task.total - task.completed) / rate), 0)  # the last episode may go past the end
        return Text(f"{left // 60:d}:{left % 60:02d} left", style="progress.remaining")


def compared(value: float, expert: float) -> str:
    """A return beside the expert's; the share is said only where returns are positive, since elsewhere it means nothing."""
    share = f"{value / expert:.0%} of " if expert > 0 else ""
    return f"{share}the expert's {expert:.1f}"


class Bar:
    """Reports a run to the terminal. Ctrl-C or SIGTERM ends it after the episode at hand; a second Ctrl-C at once."""

    def __init__(self, console: Console, expert_return: float | None) -> None:
        self.signal: int | None = None
        self.evaluations: list[tuple[int, float]] = []
        self._expert = expert_return
        self._began: tuple[float, int] | None = None
        self._progress = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[amount]}"),
            TimeElapsedColumn(),
            _TimeLeft(),
            TextColumn("{task.fields[returns]}"),
            console=console,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("starting", total=None, amount="", returns="", rate=0.0)

    def __enter__(self) -> Bar:
        self._before = {number: signal.signal(number, self._ask) for number in (signal.SIGINT, signal.SIGTERM)}
        self._progress.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._progress.stop()
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def episode(self, run: Run, frames: int, total_reward: float) -> None:
        """Advance the bar; the speed is measured from the first episode of this session, compilation left out."""
        now = time.perf_counter()
        self._began = self._began or (now, frames)
        seconds = now - self._began[0]
        rate = (frames - self._began[1]) / seconds if seconds > 0 else 0.0
        amount = f"{frames:,}/{run.frames:,} frames  {rate:,.0f}/s"
        self._update(run, frames, rate=rate, amount=amount, returns=self._returns(total_reward))

    def evaluation(self, run: Run, frames: int, result: Evaluation) -> None:
        """One line for each evaluation, beside the expert's return."""
        self.evaluations.append((frames, result.mean))
        against = f" ({compared(result.mean, self._expert)})" if self._expert is not None else ""
        low, high = result.returns.min(), result.returns.max()
        self.say(f"{frames:>9,} frames  return {result.mean:7.1f}  [{low:.1f}, {high:.1f}]{against}")
        self._update(run, frames)

    def say(self, text: str) -> None:
        """Print above the bar."""
        self._progress.console.print(text, highlight=False, markup=False, soft_wrap=True)

    def stop(self) -> bool:
        """Whether a signal has asked to stop."""
        return self.signal is not None

    def _update(self, run: Run, frames: int, **fields: Any) -> None:
        name = f"{run.task} {run.method}"
        self._progress.update(self._task, description=name, completed=frames, total=run.frames, **fields)

    def _returns(self, total_reward: float) -> str:
        last = f"return {total_reward:.0f}"
        return f"{last} of {self._expert:.0f}" if self._expert is not None else last

    def _ask(self, number: int, frame: FrameType | None) -> None:
        del frame
        if self.signal is not None and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.signal = number
        self.say("Stopping after this episode; Ctrl-C again stops at once and loses what came since the last checkpoint.")
