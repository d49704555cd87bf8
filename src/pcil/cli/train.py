"""`pcil train`."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pcil.cli import arguments

if TYPE_CHECKING:
    from pcil.training.config import Run


def main(words: list[str]) -> int:
    return arguments.train(words, _run)


def _run(run: "Run", out: Path) -> int:
    """Execute with a progress bar; end with a plain statement of how close to the expert it came, and the curve."""
    from pcil import envs
    from pcil.training import loop, progress, runs

    demos = runs.demonstrations(run)
    expert = demos.return_mean if demos else _shipped_return(envs.task_name(run.task))
    with progress.Bar(progress.Screen(), expert) as bar:
        try:
            result = runs.execute(run, out, bar)
        except loop.Stopped:
            bar.say(f"Stopped; the run in {out} is saved, and the same command goes on from here.")
            return 128 + int(bar.signal or 0)
        if not bar.evaluations:
            bar.say(f"The run in {out} is done.")
        share = f", {progress.compared(result.final_return, expert)}" if expert is not None else ""
        bar.say(f"Final return {result.final_return:.1f}{share} (mean of {run.evaluate_episodes} episodes).")
        bar.say(f"Policy: {result.folder / 'policy'}")
        _draw_curve(result.folder, expert, bar)
    return 0


def _draw_curve(out: Path, expert: float | None, bar: Any) -> None:
    from pcil import files

    try:
        from pcil.report import figures
    except ImportError:
        bar.say("No learning curve is drawn without matplotlib; pip install '.[report]' in a clone brings it.")
    else:
        with files.room_for(f"Drawing {out / 'curve.png'}"):
            bar.say(f"Learning curve: {figures.run_curve(out, expert)}")


def _shipped_return(task: str) -> float | None:
    from pcil.demos import shipped

    return {row["task"]: row["return_mean"] for row in shipped()}.get(task)
