"""Where the runs of a sweep are trained: what every such place can do, and this machine."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from pcil import bench
from pcil.errors import InputError
from pcil.sweep import worker
from pcil.sweep.plans import Job, Plan

WORKER = (sys.executable, "-P", "-m", worker.__name__)
"""The command that trains a run; its folder, its number of cores and the words of `pcil train` follow."""
QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""Where Linux says how many microseconds of how many a container may compute."""


@runtime_checkable
class Executor(Protocol):
    """A place that trains runs side by side. A handle stands for one start of a run."""

    def room(self) -> int:
        """How many runs there is room for at a time."""
        ...

    def submit(self, job: Job) -> Any:
        """Start a run, or go on with it, and return its handle."""
        ...

    def poll(self, handle: Any) -> int | str | None:
        """None while it runs, then its exit code; of a run that something killed, what it was, in words."""
        ...

    def stop(self, handle: Any) -> None:
        """Ask a run to end after its episode, saved."""
        ...


class Local:
    """This machine: a process a run. It stops after its episode once its input ends, so also where the sweep is killed.

    It is a context that kills what still runs at its end.
    """

    def __init__(self, plan: Plan, limit: int | None) -> None:
        """`InputError` where there is no room for a run; with a limit there is where there are fewer cores."""
        self._cores, self._environment = plan.cores, environment(plan)
        self._running: dict[subprocess.Popen[bytes], str] = {}
        size, gpus = math.ceil(plan.gpus), _gpus() if plan.gpus else [""]
        self._gpus = [",".join(gpus[i : i + size]) for i in range(0, len(gpus) - size + 1, size)] if size else gpus
        shared = int(1 / plan.gpus) if 0 < plan.gpus < 1 else 1
        self._room = min(cores() // plan.cores, len(self._gpus) * shared if size else sys.maxsize)
        if not (self._room or (limit and self._gpus)):
            here = f"{cores()} cores and {len(gpus) if size else 0} GPUs"
            raise InputError(
                f"A run is to have {plan.cores} cores and {plan.gpus} GPUs, and this machine gives {here}; lower cores or gpus."
            )

    def __enter__(self) -> Local:
        return self

    def __exit__(self, *exception: object) -> None:
        for process in self._running:
            process.kill()
        for process in self._running:
            self.stop(process)
            process.wait()

    def room(self) -> int:
        return self._room

    def submit(self, job: Job) -> subprocess.Popen[bytes]:
        used = Counter(self._running.values())
        gpus = min(self._gpus, key=lambda gpus: used[gpus])
        variables = self._environment | ({"CUDA_VISIBLE_DEVICES": gpus} if gpus else {})
        words = [*WORKER, str(job.folder), str(self._cores), *job.argv]
        job.log.parent.mkdir(parents=True, exist_ok=True)
        with job.log.open("ab") as log:
            # In a process group of its own a terminal's Ctrl-C does not reach it: when it is to stop, the sweep says.
            process = subprocess.Popen(
                words, stdin=subprocess.PIPE, stdout=log, stderr=log, env=os.environ | variables, process_group=0
            )
        self._running[process] = gpus
        return process

    def poll(self, handle: subprocess.Popen[bytes]) -> int | str | None:
        code = handle.poll()
        if code is None:
            return None
        del self._running[handle]
        self.stop(handle)
        return code if code >= 0 else f"process {handle.pid} was ended by signal {-code} ({signal.strsignal(-code)})"

    def stop(self, handle: subprocess.Popen[bytes]) -> None:
        assert handle.stdin is not None
        handle.stdin.close()


def environment(plan: Plan) -> dict[str, str]:
    """Variables of a run's process: as many threads as it has cores, and no GPU where it is given none."""
    variables = {"OMP_NUM_THREADS": str(plan.cores), "OPENBLAS_NUM_THREADS": "1"}
    if not plan.gpus:
        variables["JAX_PLATFORMS"] = "cpu"
    if plan.cores == 1:
        variables["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {bench.SINGLE_THREAD}".strip()
    return variables


def cores() -> int:
    """How many cores this process may use: those it is bound to, or fewer where its container has a quota."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):  # no such file, or no quota: "max 100000"
        quota, period = map(int, QUOTA.read_text().split())
        count = min(count, max(quota // period, 1))
    return count


def _gpus() -> list[str]:
    """The GPUs that CUDA may use here, by names that `CUDA_VISIBLE_DEVICES` takes."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is None:
        command = ["nvidia-smi", "--query-gpu=uuid", "--format=csv,noheader"]
        try:
            given = subprocess.run(command, capture_output=True, text=True, check=True).stdout.replace("\n", ",")
        except (OSError, subprocess.CalledProcessError):
            return []
    return [name.strip() for name in given.split(",") if name.strip() not in ("", "-1")]
