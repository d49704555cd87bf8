"""`pcil sweep`: train many runs in parallel. The state of each run is read from its folder alone."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from pcil.errors import InputError, shown
from pcil.sweep import cluster, executors
from pcil.sweep.plans import Job, Plan
from pcil.training.progress import Signals, time_left

RETRIES = 8
"""How often a run is resumed after its process was killed."""
PAUSE_SECONDS = 0.5
"""The interval at which runs are polled."""
VISIBLE_SECONDS = 15.0
"""How long to wait for the DONE file of a finished run."""


def sweep(plan: Plan, out: Path, limit: int | None, address: str | None, console: Console) -> int:
    """Finish every run of a plan, at most `limit` at a time, on this machine or on the Ray cluster at `address`.

    Returns the exit code: 1 if a run failed, 130 or 143 if a signal stopped the sweep.
    """

    def say(text: str) -> None:
        console.print("\n".join(map(shown, text.split("\n"))), highlight=False, markup=False, soft_wrap=True)

    left = sum(job.state != "done" for job in plan.jobs)
    say(f"{left} of {len(plan.jobs)} runs are left to do.")
    signals = Signals(lambda: say("Each run stops after its episode; Ctrl-C again stops at once."))
    screen = console if console.is_terminal else Console(quiet=True)
    if left:
        with (
            _executor(plan, out, limit, address) as executor,
            signals,
            Live(console=screen, auto_refresh=False, redirect_stdout=False) as live,
        ):
            began, before = time.monotonic(), sum(job.frames for job in plan.jobs)
            for text in _train_all(executor, plan.jobs, limit, signals):
                if text:
                    say(text)
                speed = (sum(job.frames for job in plan.jobs) - before) / (time.monotonic() - began)
                live.update(progress_table(plan.jobs, speed, screen.height - 4), refresh=True)
    if signals.number:
        say("Stopped; every run is saved, and the same command goes on from here.")
        return 128 + signals.number
    failed = sum(job.state == "failed" for job in plan.jobs)
    say(f"{len(plan.jobs) - failed} of {len(plan.jobs)} runs are done.")
    return int(failed > 0)


@contextlib.contextmanager
def _executor(plan: Plan, out: Path, limit: int | None, address: str | None) -> Iterator[executors.Executor]:
    """The executor of the runs; `InputError` if the folder `out` can't be created."""
    context = executors.Local(plan, limit) if address is None else cluster.connected(plan, limit, address, out / "ray.log")
    with context as executor:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"The folder {out} can't be made ({error.strerror}); give --out another one.") from error
        yield executor


def _train_all(executor: executors.Executor, jobs: list[Job], limit: int | None, signals: Signals) -> Iterator[str]:
    """Train the jobs, as many at a time as there is room for, until all have ended or a signal has stopped them.

    Yields a message when a job ends, and an empty text in every polling interval.
    """
    running: dict[Any, Job] = {}
    stopping = False
    while running or (not signals.number and any(job.state == "waiting" for job in jobs)):
        waiting = [job for job in jobs if job.state == "waiting" and not signals.number]
        for job in waiting[: max((limit or executor.room()) - len(running), 0)]:
            try:
                running[executor.submit(job)] = job
                job.state = "running"
            except OSError as error:
                job.state = "failed"
                yield f"failed  {job.name}: it can't be started ({error})"
        if signals.number and not stopping:
            stopping = True
            for handle in running:
                executor.stop(handle)
        yield ""
        time.sleep(PAUSE_SECONDS)
        for handle, job in list(running.items()):
            end = executor.poll(handle)
            job.look()
            if end is not None:
                del running[handle]
                job.state, text = _outcome(job, end, stopping)
                yield text


def _outcome(job: Job, end: int | str, stopping: bool) -> tuple[str, str]:
    """The new state of a job whose process has ended, and a message; `end` is its exit code, or what killed it."""
    if end in (129, 130, 143) or (stopping and isinstance(end, str)):
        return "waiting", f"stopped {job.name} at {job.frames:,} frames"
    if isinstance(end, str) and job.deaths < RETRIES:
        job.deaths += 1
        return "waiting", f"again   {job.name}: {end}"
    if end == 0 and _appears(job.folder / "DONE"):
        return "done", f"done    {job.name}: return {job.last_return:.1f}"
    if end == 0:
        end = f"It ended well, but {job.folder} has no DONE here: give --out a path on storage that all nodes see."
    last = job.log.read_text(errors="replace").splitlines()[-12:] if job.log.exists() else []
    last += [end] if isinstance(end, str) else []
    return "failed", "\n    ".join([f"failed  {job.name}; the end of {job.log}:", *last])


def _appears(file: Path) -> bool:
    """Whether a file exists, with some patience: shared storage can take seconds to show a file that another node wrote."""
    until = time.monotonic() + VISIBLE_SECONDS
    while not file.exists() and time.monotonic() < until:
        time.sleep(0.5)
    return file.exists()


def progress_table(jobs: list[Job], speed: float, room: int) -> Group:
    """One row per run and a progress bar for all; if there are too many rows, only the first ones, running runs first."""
    table = Table("run", "task", "method", "seed", "", "frames", "return", "frames/s", "time left", box=None)
    for job in jobs if len(jobs) <= room else sorted(jobs, key=lambda job: job.state != "running")[: max(room, 1)]:
        row = [job.folder.parent.name, job.run.task, job.run.method, str(job.run.seed), job.state]
        row += [f"{job.frames:,}/{job.run.frames:,}", f"{job.last_return:.1f}" if job.frames else ""]
        if job.state == "running":
            row += [f"{job.rate:,.0f}", time_left(job.run.frames - job.frames, job.rate)]
        table.add_row(*(Text(shown(cell, 60)) for cell in row))
    done, total = sum(min(job.frames, job.run.frames) for job in jobs), sum(job.run.frames for job in jobs)
    count = f"{sum(job.state == 'done' for job in jobs)}/{len(jobs)} runs"
    bar = Table.grid(padding=(0, 1))
    bar.add_row(count, ProgressBar(total, done, 40), f"{done / total:.0%}", f"{time_left(total - done, speed)} left")
    return Group(table, bar)
