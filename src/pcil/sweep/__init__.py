"""`pcil sweep`: every run of a file, as tasks of Ray. What is done and what is left is read from the run folders alone."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import runpy
import secrets
import shlex
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from pcil import bench, files
from pcil.errors import InputError, shown
from pcil.sweep.plans import Job, Plan, read
from pcil.training.progress import Signals, time_left

STARTS = 3
"""How often a cluster of our own is tried to start: Ray gives its parts 15 seconds, which may be too few on a busy machine."""
RETRIES = 8
"""How often a run is taken up again after its worker died."""
PATIENCE_SECONDS = 60.0
"""How long it then waits for the old worker to let go of the folder: on a node that is cut off it lives a little longer."""

TOPOLOGY = Path("/sys/devices/system/cpu")
"""Where Linux says which cores are two threads of one."""
VISIBLE_SECONDS = 15.0
"""How long a finished run's DONE is waited for."""


def sweep(file: Path, out: Path, limit: int | None, address: str | None, console: Console, trust: Sequence[str] = ()) -> int:
    """Finish every run of a file, at most `limit` at a time; 1 where some failed, 130 or 143 where a signal stopped them.

    `trust` are the modules that the file may name.
    """

    def say(text: str) -> None:
        console.print("\n".join(map(shown, text.split("\n"))), highlight=False, markup=False, soft_wrap=True)

    plan = read(file, out, trust)
    left = sum(job.state != "done" for job in plan.jobs)
    say(f"{left} of {len(plan.jobs)} runs are left to do.")
    signals = Signals(lambda: say("Each run stops after its episode; Ctrl-C again stops at once."))
    screen = console if console.is_terminal else Console(quiet=True)
    if left:
        with (
            _cluster(plan, limit, address) as ray,
            _heard(out / "ray.log"),
            signals,
            Live(console=screen, auto_refresh=False, redirect_stdout=False) as live,
        ):
            began, before = time.monotonic(), sum(job.frames for job in plan.jobs)
            for text in _train_all(ray, plan, limit, signals):
                if text:
                    say(text)
                speed = (sum(job.frames for job in plan.jobs) - before) / (time.monotonic() - began)
                live.update(picture(plan.jobs, speed, screen.height - 4), refresh=True)
    if signals.number:
        say("Stopped; every run is saved, and the same command goes on from here.")
        return 128 + signals.number
    failed = sum(job.state == "failed" for job in plan.jobs)
    say(f"{len(plan.jobs) - failed} of {len(plan.jobs)} runs are done.")
    return int(failed > 0)


@contextlib.contextmanager
def _cluster(plan: Plan, limit: int | None, address: str | None) -> Iterator[Any]:
    """Ray at an address, or in a cluster of our own: this machine's loopback device, behind a token that nobody else has."""
    workers = {"OMP_NUM_THREADS": str(plan.cores), "OPENBLAS_NUM_THREADS": "1"} | (
        {} if plan.gpus else {"JAX_PLATFORMS": "cpu"}
    )
    if plan.cores == 1:
        workers["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {bench.SINGLE_THREAD}".strip()
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
    options: dict[str, Any] = {"address": address}
    if address is None:
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32), "RAY_worker_niceness": "0"}
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # Ray's switch for "this machine alone", on every system
        options = {"address": "local", "num_cpus": limit and limit * plan.cores, "include_dashboard": False}
        options["object_store_memory"] = 100_000_000  # what the runs have to say is in their folders
    try:
        import ray
    except ImportError as error:
        raise InputError("pcil sweep needs Ray; pip install '.[sweep]' in a clone brings it.") from error
    if address and ":" in address:
        try:
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=20).close()  # Ray itself would try for many minutes
        except (OSError, ValueError) as error:
            raise InputError(f"Nothing answers at {address} ({error}); give the HOST:PORT of a Ray cluster's head.") from error
    with contextlib.ExitStack() as stack:
        if address is None:
            options["_temp_dir"] = stack.enter_context(_private_folder())
        for attempts_left in range(0 if address else STARTS - 1, -1, -1):
            try:
                with contextlib.ExitStack() as attempt:
                    attempt.enter_context(_ended(ray))
                    with contextlib.chdir(Path.cwd().anchor):  # Ray's workers look there first for every module
                        ray.init(**options, runtime_env={"env_vars": workers}, log_to_driver=False, logging_level=logging.ERROR)
                    stack.push(attempt.pop_all())
                break
            except Exception as error:  # Ray has no one type for an address where no cluster is, or none that takes us
                if not attempts_left:
                    reason = [*str(error).strip().splitlines(), ""][0]  # what follows is a traceback
                    raise InputError(f"Ray can't be had at {address or 'this machine'} ({reason}).") from error
        if not (_room(ray, plan) or (address and limit)):  # with both, a cluster that grows is waited for
            raise InputError(f"Ray has no room for a run of {plan.cores} cores and {plan.gpus} GPUs; lower cores or gpus.")
        yield ray


@contextlib.contextmanager
def _private_folder() -> Iterator[str]:
    """A new folder for Ray's files below one that no other user can open, for Ray opens its own to all.

    The paths of its sockets, which are 64 bytes longer, have at most 103 bytes on some systems.
    """
    place = tempfile.gettempdir()
    short = os.name == "nt" or len(os.fsencode(place)) <= 20
    with tempfile.TemporaryDirectory(prefix="pcil-", dir=place if short else "/tmp", ignore_cleanup_errors=True) as folder:
        yield str(Path(folder) / "r")


@contextlib.contextmanager
def _ended(ray: Any) -> Iterator[None]:
    """Ends Ray and every process that it has started, also those of a start that failed, of which Ray itself knows nothing."""
    import psutil  # comes with Ray

    me = psutil.Process()
    before = me.children(recursive=True)
    try:
        yield
    finally:
        started = [process for process in me.children(recursive=True) if process not in before]
        with contextlib.suppress(Exception):
            ray.shutdown()
        for process in started:
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(started, timeout=10)


@contextlib.contextmanager
def _heard(log: Path) -> Iterator[None]:
    """What Ray prints of workers and nodes goes to a file, and not into the table."""
    try:
        log.parent.mkdir(parents=True, exist_ok=True)
        file = log.open("a")
    except OSError as error:
        raise InputError(f"The folder {log.parent} can't be written ({error.strerror}); give --out another one.") from error
    with file, contextlib.redirect_stdout(file):
        yield


def _room(ray: Any, plan: Plan) -> int:
    """How many runs the nodes that there are now have room for."""
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    wanted = {"CPU": plan.cores, "GPU": plan.gpus}
    return sum(min(int(node.get(kind, 0) // amount) for kind, amount in wanted.items() if amount) for node in nodes)


def _train_all(ray: Any, plan: Plan, limit: int | None, signals: Signals) -> Iterator[str]:
    """Hand the jobs to Ray, as many at a time as there is room for, until all have ended or a signal has stopped them.

    Yields what there is to say: how a job ended, and nothing every second.
    """
    task = ray.remote(num_cpus=plan.cores, num_gpus=plan.gpus, max_retries=RETRIES, max_calls=1)(_train)
    running, asked = {}, False
    while running or (not signals.number and any(job.state == "waiting" for job in plan.jobs)):
        waiting = [job for job in plan.jobs if job.state == "waiting" and not signals.number]
        for job in waiting[: max((limit or _room(ray, plan)) - len(running), 0)]:
            job.state = "running"
            running[task.options(name=job.name).remote(job.words, job.log, Path.cwd(), plan.cores)] = job
        if signals.number and not asked:
            asked = True
            for ref in running:
                ray.cancel(ref)  # a Ctrl-C in the worker: the run ends after its episode and saves itself
        ended, _ = ray.wait(list(running), timeout=1.0) if running else ([], time.sleep(1.0))
        for job in running.values():
            job.look()
        yield ""
        for ref in ended:
            job = running.pop(ref)
            job.state, text = _outcome(ray, ref, job)
            yield text


def _outcome(ray: Any, ref: Any, job: Job) -> tuple[str, str]:
    """The state of a job that has ended, and what to say of it."""
    death = []
    try:
        code = ray.get(ref)
    except ray.exceptions.TaskCancelledError:
        code = 130
    except ray.exceptions.RayError as error:  # its worker died more often than it is tried again
        code, death = 1, [str(error).strip().splitlines()[0]]
    if code in (130, 143):
        return "waiting", f"stopped {job.name} at {job.frames:,} frames"
    if code == 0 and not _appears(job.folder / "DONE"):
        code, death = 1, [f"It ended well, but {job.folder} has no DONE here: give --out a path on storage that all nodes see."]
    if code == 0:
        return "done", f"done    {job.name}: return {job.last_return:.1f}"
    end = job.log.read_text(errors="replace").splitlines()[-12:] if job.log.exists() else []
    return "failed", "\n    ".join([f"failed  {job.name}; the end of {job.log}:", *end, *death])


def _appears(file: Path) -> bool:
    """Whether a file that another node may have written is there; shared storage can take some seconds to show it."""
    until = time.monotonic() + VISIBLE_SECONDS
    while not file.exists() and time.monotonic() < until:
        time.sleep(0.5)
    return file.exists()


def picture(jobs: list[Job], speed: float, room: int) -> Group:
    """A row a run and one bar over all; where there is no room for every row, those of running runs come first."""
    table = Table("run", "task", "method", "seed", "", "frames", "return", "frames/s", "time left", box=None)
    for job in jobs if len(jobs) <= room else sorted(jobs, key=lambda job: job.state != "running")[: max(room, 1)]:
        row = [job.folder.parent.name, job.run.task, job.run.method, str(job.run.seed), job.state]
        row += [f"{job.frames:,}/{job.run.frames:,}", f"{job.last_return:.1f}" if job.frames else ""]
        if job.state == "running":
            row += [f"{job.rate:,.0f}", time_left(job.run.frames - job.frames, job.rate)]
        table.add_row(*(Text(shown(word, 60)) for word in row))
    done, total = sum(min(job.frames, job.run.frames) for job in jobs), sum(job.run.frames for job in jobs)
    count = f"{sum(job.state == 'done' for job in jobs)}/{len(jobs)} runs"
    bar = Table.grid(padding=(0, 1))
    bar.add_row(count, ProgressBar(total, done, 40), f"{done / total:.0%}", f"{time_left(total - done, speed)} left")
    return Group(table, bar)


def _train(words: list[str], log: Path, home: Path, cores: int) -> int:
    """In a worker of Ray, which becomes `python -m pcil train ...`, so that whatever kills it leaves no process behind.

    What is printed goes to the end of `log`. Returns the exit code.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    print(f"{socket.gethostname()}, process {os.getpid()}: pcil train {shlex.join(words)}", flush=True)
    with contextlib.suppress(OSError):
        os.chdir(home)  # paths of demonstrations and modules of rewards are relative to where the sweep was started
    _wait_until_free(log.with_suffix("") / ".lock")
    held = _own_cores(cores)
    sys.argv = ["pcil", "train", *words]
    try:
        runpy.run_module("pcil", run_name="__main__")
    except SystemExit as end:
        return int(end.code or 0)
    except Exception:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        held.close()
    return 1


def _own_cores(count: int) -> contextlib.ExitStack:
    """Bind this process to so many cores that no other run of a sweep has on this machine, until what it returns is closed.

    A core is whose socket has its name, in the namespace that all users of a Linux machine share and that no file is in; a
    killed run frees its own. Second threads of a core are taken last. Without as many free ones, or where the system can't
    bind, nothing is bound: a run that wanders between cores is slower, and its result the same.
    """
    names, cores = contextlib.ExitStack(), set()
    with contextlib.suppress(AttributeError):
        for core in sorted(os.sched_getaffinity(0), key=lambda core: (_is_second_thread(core), core)):
            with contextlib.ExitStack() as attempt, contextlib.suppress(OSError):
                attempt.enter_context(socket.socket(socket.AF_UNIX)).bind(f"\0pcil-core-{core}")
                names.push(attempt.pop_all())
                cores.add(core)
            if len(cores) == count:
                os.sched_setaffinity(0, cores)
                return names
    names.close()
    return names


def _is_second_thread(core: int) -> bool:
    try:
        threads = (TOPOLOGY / f"cpu{core}" / "topology" / "thread_siblings_list").read_text()
    except OSError:
        return False
    return int(re.split("[-,]", threads)[0]) != core


def _wait_until_free(lock: Path) -> None:
    """Give the worker that this one replaces time to die; `pcil train` says what is wrong with a lock that is never free."""
    until = time.monotonic() + PATIENCE_SECONDS
    with contextlib.suppress(InputError):
        while lock.exists() and time.monotonic() < until:
            with files.locked(lock) as free:
                if free:
                    return
            time.sleep(0.5)
