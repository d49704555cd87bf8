"""Executors: each run has its own threads, cores and GPUs, and ends when its sweep asks or has ended."""

from __future__ import annotations

import fcntl
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from test_sweep import HARMLESS, WHOLE, plan

from pcil import cli
from pcil.errors import InputError
from pcil.sweep import executors, plans, worker

# --- This machine ---

ECHO = """
import os, sys, time
names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "JAX_PLATFORMS", "XLA_FLAGS", "CUDA_VISIBLE_DEVICES")
print(sys.argv[1:], {name: os.environ.get(name) for name in names}, flush=True)
os.read(0, 1)
print("asked", flush=True)
"""


@pytest.fixture
def echo(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replaces a run: it prints its arguments and environment, and ends when its input does."""
    monkeypatch.setattr(executors, "WORKER", (sys.executable, "-c", ECHO))
    for name in ("XLA_FLAGS", "JAX_PLATFORMS", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)


def ended(local: executors.Local, handle: Any) -> int | str:
    while (end := local.poll(handle)) is None:
        time.sleep(0.01)
    return end


def printed(job: plans.Job, wanted: str) -> str:
    while wanted not in (text := job.log.read_text()):
        time.sleep(0.01)
    return text


@pytest.mark.usefixtures("echo")
def test_a_process_has_the_words_and_the_threads_of_its_run_and_its_input_stops_it() -> None:
    job = plan(HARMLESS).jobs[0]
    with executors.Local(plan(f"cores = 3\n{HARMLESS}"), 1) as local:
        handle = local.submit(job)
        words, variables = printed(job, "}\n").split("] ")
        assert words == repr([str(job.folder), "3", *job.argv])[:-1]
        given = {"OMP_NUM_THREADS": "3", "OPENBLAS_NUM_THREADS": "1", "JAX_PLATFORMS": "cpu"}
        assert variables == f"{given | {'XLA_FLAGS': None, 'CUDA_VISIBLE_DEVICES': None}}\n"
        assert local.poll(handle) is None
        assert os.getpgid(handle.pid) != os.getpgrp(), "a terminal's Ctrl-C does not reach it"
        local.stop(handle)
        assert ended(local, handle) == 0 and job.log.read_text().endswith("asked\n")


@pytest.mark.usefixtures("echo")
def test_a_killed_process_is_named_by_its_signal_and_the_end_of_the_sweep_kills_the_others() -> None:
    first, second, *_ = plan(HARMLESS).jobs
    with pytest.raises(KeyboardInterrupt), executors.Local(plan(HARMLESS), 2) as local:
        handles = [local.submit(first), local.submit(second)]
        handles[0].kill()
        assert ended(local, handles[0]) == f"process {handles[0].pid} was ended by signal 9 (Killed)"
        raise KeyboardInterrupt  # a second Ctrl-C
    assert handles[1].returncode == -signal.SIGKILL


@pytest.mark.usefixtures("echo")
@pytest.mark.parametrize(
    ("gpus", "room", "given"),
    [
        (0.5, 4, ["a", "b", "a", "b", "b"]),
        (1, 2, ["a", "b", "a", "b", "b"]),
        (2, 1, ["a,b"] * 5),
        (0.3, 6, ["a", "b", "a", "b", "b"]),
    ],
)
def test_runs_take_the_gpus_in_turn(gpus: float, room: int, given: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Five runs; the second has ended when the fifth begins."""
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "a,b")
    monkeypatch.setattr(executors, "cores", lambda: 100)
    asked = plan(f"gpus = {gpus}\n{HARMLESS}")
    with executors.Local(asked, 5) as local:
        assert local.room() == room
        handles = [local.submit(job) for job in asked.jobs[:4]]
        local.stop(handles[1])
        ended(local, handles[1])
        local.submit(asked.jobs[4])
        found = [
            re.findall(r"'JAX_PLATFORMS': None, .*'CUDA_VISIBLE_DEVICES': '(.*)'", printed(job, "}\n")) for job in asked.jobs
        ]
    assert found == [[gpu] for gpu in given]


def test_gpus_are_those_that_the_driver_names_or_the_shell_leaves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    assert executors._gpus() == []
    (tmp_path / "nvidia-smi").write_text("#!/bin/sh\necho GPU-1\necho GPU-2\n")
    (tmp_path / "nvidia-smi").chmod(0o755)
    assert executors._gpus() == ["GPU-1", "GPU-2"]
    (tmp_path / "nvidia-smi").write_text("#!/bin/sh\necho no driver\nexit 9\n")
    assert executors._gpus() == []
    for given, left in [("", []), ("-1", []), ("1, 0", ["1", "0"])]:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", given)
        assert executors._gpus() == left


def test_room_is_that_of_the_cores_and_of_the_containers_quota(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(7)))
    with executors.Local(plan(f"cores = 2\n{HARMLESS}"), None) as local:
        assert local.room() == 3
    for quota, count in [("max 100000", 7), ("250000 100000", 2), ("5000 100000", 1), ("900000 100000", 7)]:
        (tmp_path / "cpu.max").write_text(f"{quota}\n")
        assert executors.cores() == count


@pytest.mark.parametrize(("text", "limit"), [("cores = 8", None), ("gpus = 1", None), ("gpus = 0.5", 2), ("gpus = 3", 1)])
def test_a_machine_without_room_for_a_run_is_said(text: str, limit: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "cores", lambda: 7)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1" if "3" in text else "")
    with pytest.raises(InputError, match=r"this machine gives 7 cores and [02] GPUs; lower cores or gpus"):
        executors.Local(plan(f"{text}\n{HARMLESS}"), limit)
    executors.Local(plan(f"cores = 8\n{HARMLESS}"), 1)  # slower than necessary, but requested


# --- A run's process ---


def test_a_worker_waits_for_the_one_that_it_replaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    released = []
    holder = (tmp_path / ".lock").open("w")
    fcntl.flock(holder, fcntl.LOCK_EX)
    threading.Timer(0.3, lambda: (released.append(True), holder.close())).start()
    worker._wait_until_free(tmp_path / ".lock")
    assert released
    with (tmp_path / ".lock").open("w") as forever:
        fcntl.flock(forever, fcntl.LOCK_EX)
        monkeypatch.setattr(worker, "PATIENCE_SECONDS", 0.01)
        worker._wait_until_free(tmp_path / ".lock")  # returns after the timeout


def test_runs_of_one_machine_have_cores_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three runs with two cores each on five cores: the third finds only one and is not bound, until a run has ended."""
    bound, machine = [], os.getpid() << 8  # numbers that no real core has
    five = {machine + core for core in range(5)}
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: five)
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cores: bound.append({core - machine for core in cores}))
    first, second, third = (worker.own_cores(2) for _ in range(3))
    assert bound == [{0, 1}, {2, 3}]
    first.close()
    with worker.own_cores(3), worker.own_cores(1):
        assert bound == [{0, 1}, {2, 3}, {0, 1, 4}], "no core is left for the last one"
    second.close()
    third.close()
    monkeypatch.delattr(os, "sched_getaffinity")  # as on macOS
    worker.own_cores(1).close()
    assert len(bound) == 3


@pytest.mark.parametrize("threads", [{0: "0-1", 1: "0-1", 2: "2-3", 3: "2-3"}, {0: "0,2", 2: "0,2", 1: "1,3", 3: "1,3"}])
def test_second_threads_of_a_core_are_taken_last(
    threads: dict[int, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bound: list[set[int]] = []
    monkeypatch.setattr(worker, "TOPOLOGY", tmp_path)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {number(core) for core in threads})
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cores: bound.append(cores))

    def number(core: int) -> int:
        return (os.getpid() << 8) + 16 + core

    for core, siblings in threads.items():
        (tmp_path / f"cpu{number(core)}" / "topology").mkdir(parents=True)
        text = re.sub(r"\d", lambda digit: str(number(int(digit[0]))), siblings)
        (tmp_path / f"cpu{number(core)}" / "topology" / "thread_siblings_list").write_text(f"{text}\n")
    first = [core for core, siblings in threads.items() if siblings.startswith(str(core))]
    with worker.own_cores(1), worker.own_cores(1), worker.own_cores(2):
        assert bound[:2] == [{number(core)} for core in sorted(first)]
        assert bound[2] == {number(core) for core in set(threads) - set(first)}


def test_a_killed_run_frees_its_core(monkeypatch: pytest.MonkeyPatch) -> None:
    """The other process reserves its core in the same way, and then prints a line."""
    core, bound = (os.getpid() << 8) + 7, []
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {core})
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cores: bound.append(cores))
    text = f"import os\nos.sched_getaffinity = lambda _: {{{core}}}\nos.sched_setaffinity = lambda *_: print(flush=True)\n"
    text += "from pcil.sweep import worker\nheld = worker.own_cores(1)\ninput()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", text], **pipes) as other:
        assert other.stdout.readline() == "\n"
        with worker.own_cores(1):
            assert bound == []
        other.kill()
    with worker.own_cores(1):
        assert bound == [{core}]


def test_a_run_finds_no_library_in_the_present_folder() -> None:
    Path("tyro.py").write_text("raise SystemExit(70)")
    command = [*executors.WORKER, "folder", "1", "finger_spin", "--help"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "usage: pcil train" in process.stdout.read()
    assert process.returncode == 0


PARENT = """
import subprocess, sys, time
code = "import time; from pcil.sweep import worker; worker.train = lambda *_: time.sleep(400); worker.main()"
child = subprocess.Popen([sys.executable, "-c", code, "folder", "1"], stdin=subprocess.PIPE)
print(child.pid, flush=True)
time.sleep(400)
"""


def test_a_run_whose_sweep_was_killed_is_asked_to_stop() -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        child = Path(f"/proc/{parent.stdout.readline().strip()}")
        assert child.exists()
        parent.kill()
    until = time.monotonic() + 60
    while child.exists() and child.joinpath("stat").read_text().rpartition(")")[2].split()[0] != "Z":
        assert time.monotonic() < until
        time.sleep(0.05)


# --- A Ray cluster ---


@pytest.mark.parametrize("address", ["127.0.0.1:1", "head:many"])
def test_an_address_where_nothing_is_is_said_at_once(address: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("sweep.toml").write_text(WHOLE)
    assert cli.main(["sweep", "sweep.toml", "--out", "out", "--address", address]) == 2
    assert f"Nothing answers at {address}" in capsys.readouterr().err
    assert not Path("out").exists()


def test_ray_is_needed_for_an_address_alone(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    Path("sweep.toml").write_text(WHOLE)
    words = ["sweep", "sweep.toml", "--out", "out", "--address"]
    assert cli.main([*words, "local"]) == 2
    assert "without --address the runs are trained on this machine" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "ray", None)  # importing it raises ImportError
    assert cli.main([*words, "10.0.0.1:6379"]) == 2
    assert "pip install '.[sweep]' in a clone" in capsys.readouterr().err
