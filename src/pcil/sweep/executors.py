"""Executors train the runs of a sweep: their interface, and the one for this machine."""

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
"""The command that trains a run, followed by its folder, its number of cores and the argv of `pcil train`."""
QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""The file in which Linux gives the CPU quota of a container: microseconds of CPU time per period."""


@runtime_checkable
class Executor(Protocol):
    """Trains runs in parallel. A handle identifies one process of a run."""

    def room(self) -> int:
        """The number of runs that can be trained at the same time."""
        ...

    def submit(self, job: Job) -> Any:
        """Start or resume a run, and return its handle."""
        ...

    def poll(self, handle: Any) -> int | str | None:
        """None while the run is active, then its exit code, or a text that says what killed it."""
        ...

    def stop(self, handle: Any) -> None:
        """Ask a run to stop after its current episode and save a checkpoint."""
        ...


class Local:
    """Trains each run in a process on this machine.

    A run stops after its episode once its standard input is closed, which also happens if the sweep is killed. Leaving this
    context manager kills the processes that are still running.
    """

    def __init__(self, plan: Plan, limit: int | None) -> None:
        """`InputError` if the machine has no room for a run. With a `limit`, runs may share cores."""
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
        command = [*WORKER, str(job.folder), str(self._cores), *job.argv]
        job.log.parent.mkdir(parents=True, exist_ok=True)
        with job.log.open("ab") as log:
            # In its own process group, it gets no Ctrl-C from the terminal; the sweep decides when it stops.
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=log, env=os.environ | variables, process_group=0
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
    """The environment variables of a run's process: as many threads as cores, and no GPU unless the plan assigns one."""
    variables = {"OMP_NUM_THREADS": str(plan.cores), "OPENBLAS_NUM_THREADS": "1"}
    if not plan.gpus:
        variables["JAX_PLATFORMS"] = "cpu"
    if plan.cores == 1:
        variables["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {bench.SINGLE_THREAD}".strip()
    return variables


def cores() -> int:
    """The number of cores that this process may use, according to its affinity and the CPU quota of its container."""
    count = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):  # no file, or no quota ("max 100000")
        quota, period = map(int, QUOTA.read_text().split())
        count = min(count, max(quota // period, 1))
    return count


def _gpus() -> list[str]:
    """The available GPUs, by names that are valid in `CUDA_VISIBLE_DEVICES`."""
    given = os.environ.get("CUDA_VISIBLE_DEVICES")
    if given is None:
        command = ["nvidia-smi", "--query-gpu=uuid", "--format=csv,noheader"]
        try:
            given = subprocess.run(command, capture_output=True, text=True, check=True).stdout.replace("\n", ",")
        except (OSError, subprocess.CalledProcessError):
            return []
    return [name.strip() for name in given.split(",") if name.strip() not in ("", "-1")]
