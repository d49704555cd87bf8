"""An executor that trains the runs of a sweep on a Ray cluster."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pcil.errors import InputError
from pcil.sweep import executors, worker
from pcil.sweep.plans import Job, Plan


class Cluster:
    """Trains each run as a Ray task with its own cores and GPUs; the handle is Ray's object reference."""

    def __init__(self, ray: Any, plan: Plan) -> None:
        self._ray, self._plan = ray, plan
        self._task = ray.remote(num_cpus=plan.cores, num_gpus=plan.gpus, max_retries=0, max_calls=1)(_train)

    def room(self) -> int:
        """The number of runs for which the current nodes have resources."""
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        wanted = {"CPU": self._plan.cores, "GPU": self._plan.gpus}
        return sum(min(int(node.get(kind, 0) // amount) for kind, amount in wanted.items() if amount) for node in nodes)

    def submit(self, job: Job) -> Any:
        return self._task.options(name=job.name).remote(job.argv, job.folder, job.log, Path.cwd(), self._plan.cores)

    def poll(self, handle: Any) -> int | str | None:
        if not self._ray.wait([handle], timeout=0)[0]:
            return None
        try:
            return self._ray.get(handle)
        except self._ray.exceptions.TaskCancelledError:
            return 130
        except self._ray.exceptions.RayError as error:  # the worker or its node died
            return [*str(error).strip().splitlines(), type(error).__name__][0]

    def stop(self, handle: Any) -> None:
        self._ray.cancel(handle)  # raises KeyboardInterrupt in the worker


@contextlib.contextmanager
def connected(plan: Plan, limit: int | None, address: str, log: Path) -> Iterator[Cluster]:
    """Connect to the cluster at an address; what Ray prints about workers and nodes goes to the file `log`."""
    os.environ |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_UV_RUN_RUNTIME_ENV": "0"}
    if address == "local":
        raise InputError("--address local names no cluster; without --address the runs are trained on this machine.")
    try:
        import ray
    except ImportError as error:
        raise InputError("--address needs Ray; pip install '.[sweep]' in a clone brings it.") from error
    if ":" in address:
        try:
            host, _, port = address.rpartition(":")
            socket.create_connection((host, int(port)), timeout=20).close()  # Ray itself would retry for minutes
        except (OSError, ValueError) as error:
            raise InputError(f"Nothing answers at {address} ({error}); give the HOST:PORT of a Ray cluster's head.") from error
    options: dict[str, Any] = {"address": address, "runtime_env": {"env_vars": executors.environment(plan)}}
    try:
        try:
            with contextlib.chdir(Path.cwd().anchor):  # Ray's workers search this folder first for modules
                ray.init(**options, log_to_driver=False, logging_level=logging.ERROR)
        except Exception as error:  # Ray raises various types if it can't connect
            reason = [*str(error).strip().splitlines(), ""][0]  # the rest is a traceback
            raise InputError(f"There is no Ray cluster for us at {address} ({reason}).") from error
        cluster = Cluster(ray, plan)
        if not (cluster.room() or limit):  # with a limit, wait for the cluster to grow
            raise InputError(f"Ray has no room for a run of {plan.cores} cores and {plan.gpus} GPUs; lower cores or gpus.")
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("a") as file, contextlib.redirect_stdout(file):
            yield cluster
    finally:
        ray.shutdown()


def _train(argv: list[str], folder: Path, log: Path, cwd: Path, cores: int) -> int:
    """Train a run in this worker process of Ray; its output is appended to `log`."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    with contextlib.suppress(OSError):
        os.chdir(cwd)  # paths of demonstrations and user modules are relative to the working directory of the sweep
    return worker.train(argv, folder, cores)
