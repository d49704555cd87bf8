"""`pcil sweep`: every run of a file, as tasks of Ray. What is done and what is left is read from the run folders alone."""

from __future__ import annotations

import contextlib
import fcntl
import itertools
import json
import logging
import os
import re
import runpy
import secrets
import shlex
import socket
import sys
import time
import tomllib
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table

from pcil import arguments, bench, envs, metrics, runs
from pcil.config import Run
from pcil.errors import InputError
from pcil.progress import Signals, time_left

PRODUCT: dict[str, Any] = {
    "tasks": ["walker_walk"],
    "methods": ["pcil"],
    "seeds": [1, 2],
    "preset": "default",
    "frames": 200_000,
    "settings": {},
    "variants": {"name": {}},
}
"""What a product of runs may say, by example: the file itself, and each of its [[runs]]."""
FILE = PRODUCT | {"cores": 1, "gpus": 0.5, "runs": [{}]}
STARTS = 3
"""How often a cluster of our own is tried to start: Ray gives its parts 15 seconds, which may be too few on a busy machine."""
RETRIES = 8
"""How often a run is taken up again after its worker died."""
PATIENCE_SECONDS = 60.0
"""How long it then waits for the old worker to let go of the folder: on a node that is cut off it lives a little longer."""


@dataclass
class Job:
    """One run of a sweep, and how it stands."""

    name: str
    folder: Path
    words: list[str]
    """Those of `pcil train`."""
    run: Run
    log: Path
    """What the run prints."""
    state: str = "waiting"
    """waiting, running, done or failed."""
    frames: int = 0
    rate: float = 0.0
    """Frames a second."""
    last_return: float = 0.0
    """Mean of the last evaluation."""

    def look(self) -> None:
        """Read the folder; a file that is not there yet, or half written, changes nothing."""
        if (self.folder / "DONE").exists():
            self.state = "done"
        with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
            with (self.folder / "train.jsonl").open("rb") as file:
                file.seek(max(file.seek(0, os.SEEK_END) - 10_000, 0))
                last = json.loads(file.read().split(b"\n")[-2])
            self.frames, self.rate = last["frames"], last["frames_per_second"]
            table = metrics.read_evaluations(self.folder)
            self.last_return = float(table["return"][table["frames"] == table["frames"][-1]].mean())


class Plan(NamedTuple):
    """What a file asks for."""

    jobs: list[Job]
    cores: int
    gpus: float | int


def sweep(file: Path, out: Path, limit: int | None, address: str | None, console: Console) -> int:
    """Finish every run of a file, at most `limit` at a time; 1 where some failed, 130 or 143 where a signal stopped them."""

    def say(text: str) -> None:
        console.print(text, highlight=False, markup=False, soft_wrap=True)

    plan = read(file, out)
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


def read(file: Path, out: Path) -> Plan:
    """The runs of a file, each checked as `pcil train` checks it, and how they stand. Nothing is written."""
    try:
        table = tomllib.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{file} can't be read as TOML ({error}).") from error
    _check(str(file), table, FILE)
    plan = Plan([], table.get("cores", 1), table.get("gpus", 0))
    if plan.cores < 1 or plan.gpus < 0:
        raise InputError(f"{file} gives a run {plan.cores} cores and {plan.gpus} GPUs; it needs at least 1 core and 0 GPUs.")
    for where, product in _products(str(file), table):
        for name, words in _combinations(where, product):
            if any(job.name == name for job in plan.jobs):
                raise InputError(f"{where} has the run {name} a second time; give one of them a name under variants.")
            folder, found = out.absolute() / name, []
            words.append(f"--out={folder}")
            try:
                arguments.train(words, lambda run, out, found=found: found.append(run) or 0)
                runs.check(found[0], folder)
            except InputError as error:
                raise InputError(f"{where}, {name}: {error}") from error
            plan.jobs.append(Job(name, folder, words, found[0], folder.with_name(f"{folder.name}.log")))
            plan.jobs[-1].look()
    if not plan.jobs:
        raise InputError(f"{file} has no runs; give it tasks, methods and seeds, or [[runs]] with them.")
    return plan


def _products(file: str, table: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The file's own product, where it has tasks, and its [[runs]]: these have from the file what they don't give."""
    if "tasks" in table:
        yield file, table
    shared = {key: table[key] for key in PRODUCT if key in table and key != "variants"}
    for number, product in enumerate(table.get("runs", []), start=1):
        where = f"{file}, [[runs]] {number}"
        _check(where, product, PRODUCT)
        yield where, {**shared, **product, "settings": _flat(shared.get("settings", {})) | _flat(product.get("settings", {}))}


def _combinations(where: str, product: dict[str, Any]) -> Iterator[tuple[str, list[str]]]:
    """Folder and words of each run: variants x methods x tasks x seeds. A variant with a method of its own takes no other."""

    def axis(key: str) -> list[Any]:
        if not product.get(key):
            raise InputError(f"{where} gives no {key}.")
        return product[key]

    base = {key: product[key] for key in ("preset", "frames") if key in product} | _flat(product.get("settings", {}))
    for variant, changes in (product.get("variants") or {"": {}}).items():
        settings = base | _flat(changes)
        for key in {"task", "seed", "out", "help"} & settings.keys():
            raise InputError(f"{where} has {key!r} among its settings; there are the lists tasks and seeds, and --out.")
        own = settings.get("reward", settings.get("method"))
        for method, task, seed in itertools.product([own] if own else axis("methods"), axis("tasks"), axis("seeds")):
            arm = variant if own and variant else f"{method}-{variant}" if variant else method
            name = "/".join(re.sub(r"[^\w-]+", "-", part) for part in (envs.task_name(task), arm, str(seed)))
            options = settings if own else {"method": method} | settings
            yield name, [task, f"--seed={seed}", *(f"--{key}={value}" for key, value in options.items())]


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested tables as dotted names: in TOML a dotted name without quotes is a nested table."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat


def _check(where: str, table: dict[str, Any], examples: dict[str, Any]) -> None:
    for key, value in table.items():
        if key not in examples:
            raise InputError(f"{where} has {key!r}, which means nothing here; it may have {', '.join(examples)}.")
        if not _alike(value, examples[key]):
            raise InputError(f"{where} has {key} = {value!r}; it must look like {examples[key]!r}.")


def _alike(value: Any, example: Any) -> bool:
    """Whether two values of TOML have one type, and so have their parts; a whole number does for any number."""
    if type(value) is not type(example):
        return (type(value), type(example)) == (int, float)
    value, example = ([*v.values()] if isinstance(v, dict) else v for v in (value, example))
    return not isinstance(example, list) or not example or all(_alike(part, example[0]) for part in value)


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
        raise InputError("pcil sweep needs Ray; pip install 'pcil[sweep]' brings it.") from error
    if address and ":" in address:
        try:
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=20).close()  # Ray itself would try for many minutes
        except (OSError, ValueError) as error:
            raise InputError(f"Nothing answers at {address} ({error}); give the HOST:PORT of a Ray cluster's head.") from error
    for attempts_left in range(0 if address else STARTS - 1, -1, -1):
        try:
            ray.init(**options, runtime_env={"env_vars": workers}, log_to_driver=False, logging_level=logging.ERROR)
            break
        except Exception as error:  # Ray has no one type for an address where no cluster is, or none that takes us
            if not attempts_left:
                raise InputError(f"Ray can't be had at {address or 'this machine'} ({str(error).strip()}).") from error
    try:
        if not (_room(ray, plan) or (address and limit)):  # with both, a cluster that grows is waited for
            raise InputError(f"Ray has no room for a run of {plan.cores} cores and {plan.gpus} GPUs; lower cores or gpus.")
        yield ray
    finally:
        ray.shutdown()


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
            running[task.options(name=job.name).remote(job.words, job.log, Path.cwd())] = job
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
    if code == 0:
        return "done", f"done    {job.name}: return {job.last_return:.1f}"
    end = job.log.read_text(errors="replace").splitlines()[-12:] if job.log.exists() else []
    return "failed", "\n    ".join([f"failed  {job.name}; the end of {job.log}:", *end, *death])


def picture(jobs: list[Job], speed: float, room: int) -> Group:
    """A row a run and one bar over all; where there is no room for every row, those of running runs come first."""
    table = Table("run", "task", "method", "seed", "", "frames", "return", "frames/s", "time left", box=None)
    for job in jobs if len(jobs) <= room else sorted(jobs, key=lambda job: job.state != "running")[: max(room, 1)]:
        row = [job.folder.parent.name, job.run.task, job.run.method, str(job.run.seed), job.state]
        row += [f"{job.frames:,}/{job.run.frames:,}", f"{job.last_return:.1f}" if job.frames else ""]
        if job.state == "running":
            row += [f"{job.rate:,.0f}", time_left(job.run.frames - job.frames, job.rate)]
        table.add_row(*row)
    done, total = sum(min(job.frames, job.run.frames) for job in jobs), sum(job.run.frames for job in jobs)
    count = f"{sum(job.state == 'done' for job in jobs)}/{len(jobs)} runs"
    bar = Table.grid(padding=(0, 1))
    bar.add_row(count, ProgressBar(total, done, 40), f"{done / total:.0%}", f"{time_left(total - done, speed)} left")
    return Group(table, bar)


def _train(words: list[str], log: Path, home: Path) -> int:
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
    sys.argv = ["pcil", "train", *words]
    try:
        runpy.run_module("pcil", run_name="__main__")
    except SystemExit as end:
        return int(end.code or 0)
    except Exception:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
    return 1


def _wait_until_free(lock: Path) -> None:
    """Give the worker that this one replaces time to die; of one that never does, `pcil train` will tell."""
    until = time.monotonic() + PATIENCE_SECONDS
    while lock.exists() and time.monotonic() < until:
        with lock.open("a") as file, contextlib.suppress(BlockingIOError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        time.sleep(0.5)
