"""`pcil train`."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcil.cli import arguments

if TYPE_CHECKING:
    from pcil.training.callbacks import Callback
    from pcil.training.config import Run


def main(argv: list[str]) -> int:
    return arguments.train(argv, _run)


def _run(run: "Run", out: Path, callbacks: "Sequence[Callback]") -> int:
    """Train with a progress bar and a learning curve; finally print the return compared with the expert's."""
    from pcil import files
    from pcil.training import loop, progress, runs

    class Curve(progress.Callback):
        """Draws the learning curve anew at every evaluation."""

        def evaluation(self, frames: int, seconds: float, result: Any) -> None:
            del seconds, result
            if frames:
                _draw_curve(files.expanded(out), bar.expert_return)

    with progress.Bar(progress.Screen(), _shipped_return(run)) as bar:
        try:
            result = runs.execute(run, out, [bar, Curve(), *callbacks])
        except loop.Stopped:
            bar.message(f"Stopped; the run in {out} is saved, and the same command goes on from here.")
            return 128 + int(bar.signal or 0)
        if not bar.evaluations:
            bar.message(f"The run in {out} is done.")
        expert = bar.expert_return if result.demos_return is None else result.demos_return
        share = f", {progress.compared(result.final_return, expert)}" if expert is not None else ""
        bar.message(f"Final return {result.final_return:.1f}{share} (mean of {run.evaluate_episodes} episodes).")
        bar.message(f"Policy: {result.folder / 'policy'}")
        if path := _draw_curve(result.folder, expert):
            bar.message(f"Learning curve: {path}")
        else:
            bar.message("No learning curve is drawn without matplotlib; pip install '.[report]' in a clone brings it.")
    return 0


def _draw_curve(out: Path, expert: float | None) -> Path | None:
    """Draw the learning curve of the run, and return its path; None without matplotlib."""
    from pcil import files

    try:
        from pcil.report import figures
    except ImportError:
        return None
    with files.room_for(f"Drawing {out / 'curve.png'}"):
        return figures.run_curve(out, expert)


def _shipped_return(run: "Run") -> float | None:
    """The mean return of the shipped demonstrations of the task, if the run itself does not need demonstrations."""
    from pcil import envs
    from pcil.demos import Demonstrations, shipped_tasks

    task = envs.task_name(run.task)
    return None if run.needs_demos or task not in shipped_tasks() else Demonstrations.load(task).return_mean
