"""Sweeps: a file gives the runs it describes; interrupted runs end like uninterrupted ones; a failed run affects no other."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import itertools
import os
import re
import secrets
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rich.console import Console
from test_loop import StopAfter, finish, same_run

from pcil import cli, envs, sweep
from pcil.envs import TASKS
from pcil.errors import InputError
from pcil.rewards import REWARDS
from pcil.sweep import executors, plans
from pcil.training import checkpoint, loop, progress, runs
from small import POINT_MASS, save_point_mass_demos, small_run

ROOT = Path(__file__).parent.parent.parent
ARMS = "toy-point_mass-v0"
NARROW = """
seed_frames = 100
random_frames = 100
evaluate_episodes = 2
evaluate_every = 100
cloning_updates = 20
agent.hidden = 16
agent.feature_dim = 8
agent.noise.steps = 1000
"agent.batch_size" = 32
reward.hidden = 16
reward.batch_size = 32
"""
"""`small.small_run` as settings, so that both share one compilation; dotted names with and without quotes."""
PRODUCT = f"tasks = ['{POINT_MASS}']\nmethods = ['pcil']\nseeds = [1, 2]\nframes = 300\n"


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> str:
    return save_point_mass_demos(tmp_path_factory.mktemp("demos"))


def plan(text: str, out: str = "out", trust: Sequence[str] = ()) -> plans.Plan:
    """The plan of a file with this text."""
    Path("sweep.toml").write_text(text)
    return plans.read(Path("sweep.toml"), Path(out), trust)


ANY_LABEL = sorted(name for name, kind in REWARDS.items() if kind.scope == "step")
"""Methods that accept both values of `label`."""

# --- The file ---


@settings(max_examples=15, deadline=None)
@given(
    tasks=st.lists(st.sampled_from(TASKS), min_size=1, max_size=2, unique=True),
    methods=st.lists(st.sampled_from(ANY_LABEL), min_size=1, max_size=2, unique=True),
    seeds=st.lists(st.integers(0, 2**31 - 1), min_size=1, max_size=2, unique=True),
    labels=st.lists(st.sampled_from(["stored", "sampled"]), max_size=2, unique=True),
)
def test_the_file_gives_every_combination_once(
    tasks: list[str], methods: list[str], seeds: list[int], labels: list[str]
) -> None:
    """Compared with four plain loops; the folder determines the run."""
    text = f"tasks = {tasks}\nmethods = {methods}\nseeds = {seeds}\n"
    text += "".join(f"[variants.{label}_]\nlabel = '{label}'\n" for label in labels)
    with mock.patch.object(runs, "check"):
        jobs = plan(text).jobs
    expected = set()
    for label, method, task, seed in itertools.product(labels or [None], methods, tasks, seeds):
        expected.add((f"{task}/{method}{'' if label is None else f'-{label}_'}/{seed}", task, method, seed, label or "sampled"))
    assert {(job.name, job.run.task, job.run.method, job.run.seed, job.run.label) for job in jobs} == expected
    assert len(jobs) == len(expected)
    assert all(job.folder == Path.cwd() / "out" / job.name for job in jobs)


def test_every_setting_reaches_its_run(demos: str) -> None:
    jobs = plan(f"{PRODUCT}[settings]\ndemos = '{demos}'\n{NARROW}").jobs
    assert [job.run for job in jobs] == [small_run(demos=demos, seed=seed) for seed in (1, 2)]
    assert [job.name for job in jobs] == [f"{ARMS}/pcil/1", f"{ARMS}/pcil/2"]


def test_arguments_of_the_environment_are_a_table_of_the_file() -> None:
    text = "tasks = ['pendulum_swingup']\nmethods = ['expert']\nseeds = [1]\n[settings]\nenv_kwargs = {action_repeat = 4}\n"
    text += "[variants.plain]\n[variants.slow]\nenv_kwargs.action_repeat = 8\n"
    assert [job.run.env_kwargs for job in plan(text).jobs] == [{"action_repeat": 4}, {"action_repeat": 8}]


def test_variants_multiply_and_one_with_a_method_of_its_own_stands_alone() -> None:
    text = "tasks = ['pendulum_swingup']\nmethods = ['pcil', 'dac']\nseeds = [1]\n[settings]\nagent.gamma = 0.9\n"
    text += "[variants.stored]\nlabel = 'stored'\nagent.gamma = 0.8\n[variants.oracle]\nmethod = 'expert'\npreset = 'paper'\n"
    found = {job.name.split("/")[1]: job.run for job in plan(text).jobs}
    assert list(found) == ["pcil-stored", "dac-stored", "oracle"]
    assert [run.method for run in found.values()] == ["pcil", "dac", "expert"]
    assert [run.agent.gamma for run in found.values()] == [0.8, 0.8, 0.9]
    assert [(run.label, run.preset) for run in found.values()] == [("stored", "default")] * 2 + [("stored", "paper")]


def test_further_runs_have_from_the_file_what_they_do_not_give() -> None:
    text = "tasks = ['pendulum_swingup']\nmethods = ['expert']\nseeds = [1]\nframes = 5000\n[settings]\nagent.gamma = 0.9\n"
    text += "agent.tau = 0.5\n[[runs]]\ntasks = ['finger_spin']\nseeds = [7]\nsettings = {agent.gamma = 0.8}\n"
    _, job = plan(text).jobs
    assert (job.name, job.run.frames, job.run.agent.gamma, job.run.agent.tau) == ("finger_spin/expert/7", 5000, 0.8, 0.5)


def test_the_examples_of_the_docs_are_sweeps() -> None:
    first, second = re.findall(r"^```toml\n(.*?)^```$", (ROOT / "docs" / "sweeps.md").read_text(), re.MULTILINE | re.DOTALL)
    names = [job.name for job in plan(first).jobs]
    assert len(names) == 2 * 2 * 2 * 3 + 1 and names[-1] == "pendulum_swingup/expert/1"
    assert [job.name.split("/")[1] for job in plan(second).jobs] == ["pcil-plain"] * 3 + ["oracle"] * 3


def test_a_file_may_hold_nothing_but_further_runs() -> None:
    (job,) = plan("[[runs]]\ntasks = ['pendulum_swingup']\nmethods = ['expert']\nseeds = [3]").jobs
    assert job.name == "pendulum_swingup/expert/3"


WHOLE = "tasks = ['pendulum_swingup']\nmethods = ['pcil']\nseeds = [1]\n"
BAD = [
    # the file, text that the message must contain
    ("tasks = [", "can't be read as TOML"),
    ("", "has no runs"),
    ("frames = 5000", "has no runs"),
    (WHOLE + "sedes = [2]", "'sedes', which means nothing here; it may have tasks, methods, seeds"),
    (WHOLE.replace("[1]", "1"), r"seeds = 1; it must look like \[1, 2\]"),
    (WHOLE.replace("[1]", "[true]"), r"seeds = \[True\]"),
    (WHOLE.replace("['pcil']", "'pcil'"), "methods = 'pcil'"),
    (WHOLE.replace("[1]", "[]"), "gives no seeds"),
    (WHOLE.replace("methods", "frames = 5000 #"), "gives no methods"),
    (WHOLE.replace("[1]", "[1, 1]"), "the run pendulum_swingup/pcil/1 a second time"),
    (WHOLE + "[[runs]]\nframes = 5000", r"\[\[runs\]\] 1 has the run pendulum_swingup/pcil/1 a second time"),
    (WHOLE + "[[runs]]\ncores = 2", r"\[\[runs\]\] 1 has 'cores'"),
    (
        WHOLE.replace("pendulum_swingup", "pendulum_swingpu"),
        "no environment 'pendulum_swingpu'.*did you mean 'pendulum_swingup'",
    ),
    (WHOLE.replace("pcil", "gial"), "no method 'gial'; the methods are"),
    (WHOLE + "preset = 'best'", "no preset 'best'"),
    (WHOLE + "preset = ['paper']", r"preset = \['paper'\]"),
    (WHOLE + "frames = 'many'", "frames = 'many'; it must look like 200000"),
    (WHOLE + "frames = 100", "100 frames"),
    (WHOLE.replace("[1]", "[-1]"), "seed is -1"),
    (WHOLE + "cores = 0", "0 cores"),
    (WHOLE + "gpus = -1", "-1 GPUs"),
    (WHOLE + "gpus = nan", "nan GPUs"),
    (WHOLE.replace("pendulum_swingup", "--help"), "no environment '--help'"),
    (WHOLE + "[settings]\nagent.gama = 0.9", "DrQV2 has no setting 'gama'"),
    (WHOLE + "[settings]\nagent.batch_size = 0", "batch_size is 0; it must be at least 1"),
    (WHOLE + "[settings]\nseed = 3", "'seed' among its settings"),
    (WHOLE + "[settings]\nhelp = true", "'help' among its settings"),
    (WHOLE + "[settings]\ndemos = 'nowhere'", "'nowhere'"),
    (WHOLE + "[variants.odd]\npreset = 'odd'", "no preset 'odd'"),
    (WHOLE + "[variants]\nodd = 1", "variants = {'odd': 1}"),
]


@pytest.mark.parametrize(("text", "said"), BAD, ids=[said for _, said in BAD])
def test_a_bad_file_is_one_sentence_and_nothing_starts(text: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("sweep.toml").write_text(text)
    assert cli.main(["sweep", "sweep.toml", "--out", "out"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("pcil: sweep.toml") and err.count("\n") == 1 and not re.search(r"[.!?] [A-Z]", err)
    assert re.search(said, err), err
    assert [path.name for path in Path.cwd().iterdir()] == ["sweep.toml"]


def test_a_file_that_is_not_there_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["sweep", "nowhere.toml", "--out", "out"]) == 2
    assert "nowhere.toml can't be read" in capsys.readouterr().err


def test_a_folder_with_other_settings_is_refused_even_if_it_is_done(demos: str) -> None:
    (job, _) = plan(text := f"{PRODUCT}[settings]\ndemos = '{demos}'\n{NARROW}").jobs
    finish(job.run, job.folder)
    with pytest.raises(InputError, match=r"pcil/1: .*another run: frames was 300, now 250"):
        plan(text.replace("frames = 300", "frames = 250"))
    assert [job.state for job in plan(text.replace("frames = 300", "frames = 400")).jobs] == ["waiting"] * 2


# --- Without a file ---


def planned(*words: str) -> list[plans.Job]:
    """The plan of `pcil sweep` with these arguments."""
    with mock.patch.object(sweep, "sweep", return_value=0) as started:
        assert cli.main(["sweep", *words, "--out", "out"]) == 0
    return started.call_args.args[0].jobs


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            "finger_spin hopper_hop --methods expert dac --seeds 4 2 --frames 6000 --preset paper",
            "tasks = ['finger_spin', 'hopper_hop']\nmethods = ['expert', 'dac']\nseeds = [4, 2]\n"
            "frames = 6000\npreset = 'paper'",
        ),
        ("finger_spin", "tasks = ['finger_spin']\nmethods = ['pcil']\nseeds = [1, 2, 3]"),
        ("sweep.toml", WHOLE),
    ],
)
def test_tasks_without_a_file_are_the_runs_of_a_file_that_says_the_same(words: str, text: str) -> None:
    expected = [(job.name, job.folder, job.run) for job in plan(text).jobs]
    assert [(job.name, job.folder, job.run) for job in planned(*words.split())] == expected


def test_a_module_that_a_person_names_as_a_task_needs_no_trust() -> None:
    Path("typed_task.py").write_text("import pcil.envs.toy")
    task = f"typed_task:{POINT_MASS}"
    assert [job.run.task for job in planned(task, "--methods", "expert")] == [task] * 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "Nothing is named; give a FILE.toml, or tasks"),
        (["sweep.toml", "finger_spin"], "finger_spin is given beside sweep.toml"),
        (["sweep.toml", "--seeds", "1"], "--seeds is given beside sweep.toml"),
        (["sweep.toml", "--preset=default"], "--preset is given beside sweep.toml"),
        (["finger_spin", "--seeds"], "The command gives no seeds"),
        (["finger_spin", "--seeds", "1", "1"], "The command has the run finger_spin/pcil/1 a second time"),
        (["finger_spin", "--methods", "gial"], "no method 'gial'"),
        (["fingerspin"], "no environment 'fingerspin'"),
    ],
)
def test_words_that_name_no_runs_are_one_sentence(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("sweep.toml").write_text(WHOLE)
    assert cli.main(["sweep", *words, "--out", "out"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("pcil: ") and said in err and err.count("\n") == 1
    assert not Path("out").exists()


# --- The state of the runs, as read from the folders and shown ---


def test_the_folder_says_how_a_run_stands(demos: str) -> None:
    text = f"{PRODUCT}[settings]\ndemos = '{demos}'\n{NARROW}"
    stopped, _ = plan(text).jobs
    with contextlib.suppress(loop.Stopped):
        runs.execute(stopped.run, stopped.folder, [StopAfter(4)])
    with (stopped.folder / "train.jsonl").open("a") as file:
        file.write('{"frames": 99')  # an incomplete line
    stopped, untouched = plan(text).jobs
    assert (untouched.state, untouched.frames) == ("waiting", 0)
    assert (stopped.state, stopped.frames) == ("waiting", 200) and stopped.rate > 0
    last = [float(line.split(",")[2]) for line in (stopped.folder / "eval.csv").read_text().splitlines()[-2:]]
    assert stopped.last_return == np.mean(last)
    finish(stopped.run, stopped.folder)
    stopped.look()
    assert (stopped.state, stopped.frames) == ("done", 300)


def test_a_finished_sweep_starts_nothing(
    demos: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for job in plan(f"{PRODUCT}[settings]\ndemos = '{demos}'\n{NARROW}").jobs:
        finish(job.run, job.folder)
    monkeypatch.setattr(executors, "Local", None)
    assert cli.main(["sweep", "sweep.toml", "--out", "out"]) == 0
    assert capsys.readouterr().out == "0 of 2 runs are left to do.\n2 of 2 runs are done.\n"


def test_the_table_says_where_every_run_is() -> None:
    jobs = plan("[[runs]]\ntasks = ['pendulum_swingup']\nmethods = ['expert']\nseeds = [1, 2]\nframes = 4000").jobs
    jobs[0].state, jobs[0].frames, jobs[0].rate, jobs[0].last_return = "running", 1000, 50.0, 12.25
    jobs[1].state, jobs[1].frames, jobs[1].last_return = "done", 4000, 800.0
    screen = Console(file=io.StringIO(), width=120)
    screen.print(sweep.progress_table(jobs, speed=10.0, room=9))
    title, first, second, total = (" ".join(line.split()) for line in screen.file.getvalue().splitlines())
    assert title == "run task method seed frames return frames/s time left"
    assert first == "expert pendulum_swingup expert 1 running 1,000/4,000 12.2 50 0:01:00"
    assert second == "expert pendulum_swingup expert 2 done 4,000/4,000 800.0"
    assert re.fullmatch(r"1/2 runs ━+.* 62% 0:05:00 left", total)


def test_names_in_the_table_are_no_markup() -> None:
    (job,) = plan("[[runs]]\ntasks = ['pendulum_swingup']\nmethods = ['expert']\nseeds = [1]").jobs
    job.run = dataclasses.replace(job.run, task="[/red]\x1b[2J")
    screen = Console(file=io.StringIO(), width=120)
    screen.print(sweep.progress_table([job], speed=0.0, room=2))
    assert "[/red]\\x1b[2J" in screen.file.getvalue()


def test_where_room_is_short_the_running_runs_are_shown() -> None:
    jobs = plan("[[runs]]\ntasks = ['pendulum_swingup']\nmethods = ['expert']\nseeds = [1, 2, 3, 4, 5]").jobs
    jobs[3].state = "running"
    screen = Console(file=io.StringIO(), width=120)
    screen.print(sweep.progress_table(jobs, speed=0.0, room=2))
    assert [line.split()[3:5] for line in screen.file.getvalue().splitlines()[1:3]] == [["4", "running"], ["1", "waiting"]]


# --- The interface of executors ---

HARMLESS = "[[runs]]\ntasks = ['pendulum_swingup']\nmethods = ['expert']\nseeds = [1, 2, 3, 4, 5]\nframes = 4000"


class Pretended:
    """An executor without processes. A run ends with each of its seed's `ends` in turn, and then successfully, with a DONE."""

    def __init__(self, room: int, ends: dict[int, list[int | str]] | None = None) -> None:
        self.running: list[plans.Job] = []
        self.stopped: list[plans.Job] = []
        self.most, self.begun = 0, []
        self._room, self._ends = room, ends or {}

    def room(self) -> int:
        return self._room

    def submit(self, job: plans.Job) -> int:
        assert job.state == "waiting" and job not in self.running, "no run is started twice"
        if (ends := self._ends.get(job.run.seed)) and ends[0] == "no process":
            raise OSError("no process")
        self.running.append(job)
        self.begun.append(job.run.seed)
        self.most = max(self.most, len(self.running))
        return id(job)

    def poll(self, handle: int) -> int | str | None:
        (job,) = (job for job in self.running if id(job) == handle)
        ends = self._ends.get(job.run.seed, [])
        if job is not self.running[-1] or (ends == ["when stopped"] and job not in self.stopped):
            return None
        self.running.remove(job)
        if ends and ends != ["when stopped"]:
            return ends.pop(0)
        job.folder.mkdir(parents=True, exist_ok=True)
        (job.folder / "DONE").touch()
        return 0

    def stop(self, handle: int) -> None:
        self.stopped += [job for job in self.running if id(job) == handle]


def train_all(executor: Pretended, jobs: list[plans.Job], limit: int | None = None, stop: bool = False) -> list[str]:
    """The messages; if `stop`, a signal arrives once as many runs have been started as possible."""
    signals, said = progress.Signals(lambda: None), []
    with mock.patch.object(sweep, "PAUSE_SECONDS", 0.0), mock.patch.object(sweep, "VISIBLE_SECONDS", 0.0):
        for text in sweep._train_all(executor, jobs, limit, signals):
            signals.number = signal.SIGTERM if stop else None
            said.append(text)
    assert executor.running == []
    return [text for text in said if text]


@pytest.mark.parametrize(("room", "limit", "most"), [(2, None, 2), (2, 4, 4), (9, 3, 3), (9, None, 5)])
def test_as_many_runs_train_at_a_time_as_there_is_room_for_or_a_limit_says(room: int, limit: int | None, most: int) -> None:
    executor = Pretended(room)
    said = train_all(executor, jobs := plan(HARMLESS).jobs, limit)
    assert executor.most == most and sorted(executor.begun) == [1, 2, 3, 4, 5]
    assert [job.state for job in jobs] == ["done"] * 5
    assert sorted(said) == [f"done    pendulum_swingup/expert/{seed}: return 0.0" for seed in (1, 2, 3, 4, 5)]


def test_a_killed_run_is_taken_up_again_a_failed_one_is_not_and_neither_harms_another() -> None:
    killed: list[int | str] = ["signal 9"] * sweep.RETRIES
    executor = Pretended(2, {1: list(killed), 2: [*killed, "signal 9"], 3: [1], 4: ["no process"], 5: [143]})
    jobs = plan(HARMLESS).jobs
    jobs[2].log.parent.mkdir(parents=True)
    jobs[2].log.write_text("".join(f"line {number}\n" for number in range(30)))
    said = train_all(executor, jobs)
    assert [job.state for job in jobs] == ["done", "failed", "failed", "failed", "done"]
    assert [executor.begun.count(seed) for seed in (1, 2, 3, 4, 5)] == [sweep.RETRIES + 1, sweep.RETRIES + 1, 1, 0, 2]
    assert said.count("again   pendulum_swingup/expert/1: signal 9") == sweep.RETRIES
    assert "failed  pendulum_swingup/expert/4: it can't be started (no process)" in said
    assert "stopped pendulum_swingup/expert/5 at 0 frames" in said
    second, third = (next(text for text in said if text.startswith(f"failed  {job.name};")) for job in jobs[1:3])
    assert second.endswith(":\n    signal 9")
    assert third.splitlines()[1:] == [f"    line {number}" for number in range(18, 30)]


@pytest.mark.parametrize("end", [129, 130, 143, "signal 15"])
def test_a_signal_stops_what_runs_and_starts_nothing_more(end: int | str) -> None:
    executor = Pretended(2, {1: [end], 2: ["when stopped"]})
    said = train_all(executor, jobs := plan(HARMLESS).jobs, stop=True)
    assert executor.begun == [1, 2] and executor.stopped == jobs[:2]
    assert [job.state for job in jobs] == ["waiting", "done", "waiting", "waiting", "waiting"]
    assert "stopped pendulum_swingup/expert/1 at 0 frames" in said


def test_a_run_that_ended_where_nobody_sees_it_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a node whose storage is not shared."""
    monkeypatch.setattr(sweep, "VISIBLE_SECONDS", 0.0)
    job = plan(HARMLESS).jobs[0]
    state, said = sweep._outcome(job, 0, stopping=False)
    assert state == "failed" and "storage that all nodes see" in said
    job.folder.mkdir(parents=True)
    (job.folder / "DONE").touch()
    assert sweep._outcome(job, 0, stopping=False)[0] == "done"


# --- End to end ---


class Session:
    """Processes in a separate session, which are observed as a whole and ended afterwards."""

    def __init__(self, folder: Path) -> None:
        """Bytecode is cached, because Ray starts a dozen interpreters and allows 15 seconds for some of them."""
        self.environment = dict(os.environ, PYTHONPYCACHEPREFIX=str(folder / "bytecode"))
        self.environment.pop("PYTHONDONTWRITEBYTECODE", None)
        self.leaders: list[subprocess.Popen[str]] = []

    def start(self, *words: str) -> subprocess.Popen[str]:
        """Start Python with these arguments."""
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
        command = [sys.executable, *words]
        self.leaders.append(subprocess.Popen(command, **pipes, text=True, env=self.environment, start_new_session=True))
        return self.leaders[-1]

    def members(self) -> list[int]:
        """All living processes whose session is one of ours."""
        found = []
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):  # it has ended in the meantime
                state, _, _, session = stat.read_text().rpartition(")")[2].split()[:4]
                if state != "Z" and int(session) in [leader.pid for leader in self.leaders]:
                    found.append(int(stat.parent.name))
        return found

    def ends(self) -> bool:
        """Whether all of them end by themselves, with time for a busy machine."""
        end = time.monotonic() + 400
        while self.members() and time.monotonic() < end:
            time.sleep(0.1)
        return not self.members()


@pytest.fixture(scope="module")
def bytecode(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bytecode")


@pytest.fixture
def session(bytecode: Path) -> Iterator[Session]:
    session = Session(bytecode)
    yield session
    for pid in session.members():
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    for leader in session.leaders:
        leader.communicate()


def until(true: Callable[[], bool], process: subprocess.Popen[str], seconds: float = 400) -> None:
    """Wait for a condition while the process runs; if it ends first, fail with its output."""
    end = time.monotonic() + seconds
    while not true():
        if process.poll() is not None or time.monotonic() > end:
            process.kill()
            pytest.fail(f"ended with {process.returncode}: {process.communicate()[0]}")
        time.sleep(0.1)


def episodes(job: plans.Job) -> int:
    log = job.folder / "train.jsonl"
    return log.read_bytes().count(b"\n") if log.exists() else 0


def process_of(job: plans.Job) -> int:
    """The process that trains it."""
    return int(re.findall(r"^\S+, process (\d+): pcil train", job.log.read_text(), re.M)[-1])


@contextlib.contextmanager
def held(jobs: list[plans.Job], process: subprocess.Popen[str]) -> Iterator[None]:
    """Pauses each run after its third episode, or after one more than it has, so that no run ends before all others have
    reached that point."""
    still, wanted = {}, {job.name: max(episodes(job) + 1, 3) for job in jobs}

    def arrived() -> bool:
        for job in jobs:
            if job.name not in still and episodes(job) >= wanted[job.name]:
                os.kill(process_of(job), signal.SIGSTOP)
                still[job.name] = process_of(job)
        return len(still) == len(jobs)

    try:
        until(arrived, process)
        yield
    finally:
        for pid in still.values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)


def contents(job: plans.Job) -> dict[Path, tuple[int, bytes]]:
    """Every file of its folder, with its modification time."""
    files = [path for path in job.folder.rglob("*") if path.is_file()]
    return {path: (path.stat().st_mtime_ns, path.read_bytes()) for path in files}


def saved(job: plans.Job) -> int:
    """Frames of the latest checkpoint."""
    return checkpoint.restore(job.folder / "checkpoint")[1]["counters"]["frames"]


SPY = """
import os
from dataclasses import dataclass
from pcil import Reward

@dataclass(frozen=True)
class Spy(Reward):
    hidden: int = 0
    batch_size: int = 0
    def init(self, demos, embed, *, key):
        raise RuntimeError(*(os.environ.get(name) for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "XLA_FLAGS")))
    def update(self, state, expert, agent, embed, *, key):
        return state, {}
    def reward(self, state, batch, embed, *, key):
        return batch.action[:, 0]
"""


WITHOUT_RAY = "import sys; sys.modules['ray'] = None; from pcil.cli import main; sys.exit(main())"
NODE = """
import sys
from ray.cluster_utils import Cluster
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2, "include_dashboard": False})
print("at", cluster.address, flush=True)
sys.stdin.readline()
cluster.shutdown()
"""


@pytest.fixture
def ray_variables(session: Session) -> None:
    session.environment |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    session.environment |= {"RAY_USAGE_STATS_ENABLED": "0", "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}


@pytest.mark.usefixtures("ray_variables")
@pytest.mark.parametrize("place", ["here", pytest.param("cluster", marks=pytest.mark.slow)])
def test_a_sweep_may_be_stopped_and_repeated_and_a_bad_run_harms_no_other(
    place: str, demos: str, session: Session, tmp_path: Path
) -> None:
    """Four runs: two are stopped by Ctrl-C, one is finished, and one fails. Ray is not needed unless it is requested."""
    Path("spy_reward.py").write_text(SPY)
    text = f"{PRODUCT.replace('300', '15000')}[settings]\ndemos = '{demos}'\n{NARROW.replace('every = 100', 'every = 1000')}"
    text += "[[runs]]\nseeds = [3]\nframes = 300\n[[runs]]\nseeds = [1]\nvariants.spy.reward = 'spy_reward:Spy'\n"
    one, two, done, bad = plan(text, trust=["spy_reward"]).jobs
    finish(done.run, done.folder)
    before = contents(done)
    words = ["-c", WITHOUT_RAY, "sweep", "sweep.toml", "--out", "out", "--jobs", "2", "--trust", "spy_reward"]
    if place == "cluster":
        node = session.start("-c", NODE)
        address = next(line.split()[1] for line in iter(node.stdout.readline, "") if line.startswith("at "))
        words = ["-m", "pcil", *words[2:], "--address", address]

    process = session.start(*words)
    with held([one, two], process):
        os.killpg(process.pid, signal.SIGINT)  # as from a terminal
    printed, _ = process.communicate(timeout=400)
    assert process.returncode == 130 and "the same command goes on from here" in printed
    for job in (one, two):
        job.look()
        assert job.state == "waiting" and saved(job) == job.frames < 15_000
    assert not bad.log.exists()

    process = session.start(*words)
    printed, _ = process.communicate(timeout=400)
    assert process.returncode == 1
    assert re.search(
        rf"^failed  {bad.name}; .*\n(    .*\n)*    RuntimeError: \('1', '1', '.*--xla_cpu_multi_thread", printed, re.M
    )
    assert printed.startswith("3 of 4 runs are left to do.\n") and printed.endswith("3 of 4 runs are done.\n")
    assert sorted(re.findall(r"^done    (\S+): return", printed, re.M)) == [one.name, two.name]
    assert contents(done) == before
    assert all("Resuming at" in job.log.read_text() for job in (one, two))
    finish(one.run, tmp_path / "whole")
    same_run(tmp_path / "whole", one.folder)
    if place == "cluster":
        node.communicate("\n", timeout=200)
    assert session.ends()


NODES = """
import sys
from ray.cluster_utils import Cluster
cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
second = cluster.add_node(num_cpus=1)
print("at", cluster.address, second.all_processes["raylet"][0].process.pid, flush=True)
sys.stdin.readline()
cluster.remove_node(second, allow_graceful=False)
print("removed", flush=True)
sys.stdin.readline()
cluster.shutdown()
"""


@pytest.mark.slow
@pytest.mark.usefixtures("ray_variables")
def test_runs_outlive_their_worker_and_their_node(demos: str, session: Session, tmp_path: Path) -> None:
    """Two nodes with a core each. The worker of one run and then the node of the other are killed; both runs end normally."""
    text = f"{PRODUCT.replace('[1, 2]', '[1, 2, 3]').replace('300', '6000')}[settings]\ndemos = '{demos}'\n"
    jobs = plan(f"{text}checkpoint_seconds = 0.0\n{NARROW.replace('every = 100', 'every = 2000')}").jobs
    nodes = session.start("-c", NODES)
    lines = iter(nodes.stdout.readline, "")
    address, raylet = next(line.split()[1:] for line in lines if line.startswith("at "))
    process = session.start("-m", "pcil", "sweep", "sweep.toml", "--out", "out", "--address", address)
    with held(jobs[:2], process):
        pass
    parents = {job.name: Path(f"/proc/{process_of(job)}/stat").read_text().rpartition(")")[2].split()[1] for job in jobs[:2]}
    (there,) = (job for job in jobs[:2] if parents[job.name] == raylet)
    (here,) = (job for job in jobs[:2] if parents[job.name] != raylet)
    killed = process_of(here)
    os.kill(killed, signal.SIGKILL)
    until(lambda: process_of(here) != killed and "Resuming at" in here.log.read_text(), process)
    lost = process_of(there)
    nodes.stdin.write("\n")
    nodes.stdin.flush()
    assert next(line for line in lines if line == "removed\n")
    printed, _ = process.communicate(timeout=800)
    assert process.returncode == 0, printed
    assert process_of(there) != lost and "Resuming at" in there.log.read_text()
    for job in jobs:
        finish(job.run, tmp_path / str(job.run.seed))
        same_run(tmp_path / str(job.run.seed), job.folder)
    nodes.communicate("\n", timeout=200)
    assert session.ends()


@pytest.mark.slow
def test_whatever_is_killed_the_same_command_finishes_everything(demos: str, session: Session, tmp_path: Path) -> None:
    """Kills a run, then the sweep itself, then all processes at once, as if the machine went down; nothing is left behind."""
    text = f"{PRODUCT.replace('300', '10000')}[settings]\ndemos = '{demos}'\ncheckpoint_seconds = 0.0\n"
    jobs = plan(f"{text}{NARROW.replace('every = 100', 'every = 2000')}").jobs
    words = ["-m", "pcil", "sweep", "sweep.toml", "--out", "out", "--jobs", "2"]

    process = session.start(*words)
    with held(jobs, process):
        killed = process_of(jobs[0])
        os.kill(killed, signal.SIGKILL)
        until(lambda: process_of(jobs[0]) != killed and "Resuming at" in jobs[0].log.read_text(), process)
        process.kill()
    process.communicate()
    assert session.ends(), "the runs end with the sweep"
    assert all("Stopping after this episode" in job.log.read_text() for job in jobs)

    process = session.start(*words)
    with held(jobs, process):
        for pid in session.members():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
    process.communicate()
    assert session.ends()
    assert not any((job.folder / "DONE").exists() for job in jobs)

    process = session.start(*words)
    printed, _ = process.communicate(timeout=1500)
    assert process.returncode == 0 and printed.endswith("2 of 2 runs are done.\n"), printed
    for job in jobs:
        finish(job.run, tmp_path / str(job.run.seed))
        same_run(tmp_path / str(job.run.seed), job.folder)
    assert session.ends()


@pytest.mark.slow
def test_the_smoke_sweep_runs_from_end_to_end(session: Session) -> None:
    process = session.start("-m", "pcil", "sweep", str(ROOT / "experiments" / "smoke.toml"), "--out", "smoke")
    printed, _ = process.communicate(timeout=3000)
    assert process.returncode == 0, printed
    jobs = plans.read(ROOT / "experiments" / "smoke.toml", Path("smoke")).jobs
    assert [job.name for job in jobs] == [f"pendulum_swingup/{method}/{seed}" for method in ("pcil", "dac") for seed in (1, 2)]
    assert all(job.state == "done" and job.frames == 16_000 and f"done    {job.name}: return" in printed for job in jobs)


def test_runs_of_one_task_are_checked_in_one_environment_and_one_is_open_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, counted = envs.opened, []

    @contextlib.contextmanager
    def opened(task: Any, *arguments: Any, **named: Any) -> Any:
        if isinstance(task, str):
            counted.append(f"+{task}")
        with real(task, *arguments, **named) as environment:
            yield environment
        if isinstance(task, str):
            counted.append(f"-{task}")

    monkeypatch.setattr(envs, "opened", opened)
    table = {"tasks": ["pendulum_swingup", "finger_spin"], "methods": ["pcil"], "seeds": [1, 2, 3], "frames": 3000}
    plan = plans.of_table("the command", table, tmp_path, None)
    assert [job.run.seed for job in plan.jobs] == 2 * [1, 2, 3]
    assert counted == ["+pendulum_swingup", "-pendulum_swingup", "+finger_spin", "-finger_spin"]
