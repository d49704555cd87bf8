"""Locks follow no link, empty no file, end with their process and explain failures; text and JSON are read within limits."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import pcil
from fake_runs import fake_run
from pcil import cli, files
from pcil.errors import InputError, shown
from pcil.training import loop, runs
from pcil.training.callbacks import Callback
from small import save_point_mass_demos, small_run

HOLD = "import sys, time; from pathlib import Path; from pcil import files\nwith files.locked(Path(sys.argv[1])) as free:\n"
HOLD += "    print(free, flush=True)\n    time.sleep(60)\n"
WINDOWS = """
import sys, warnings
for name in ("fcntl", "resource", "termios", "tty", "pty", "pwd", "grp", "readline", "curses"):
    sys.modules[name] = None
import os, signal
for name in ("SIGHUP", "SIGKILL", "SIGSTOP", "SIGCONT", "SIGQUIT", "SIGUSR1", "SIGALRM", "SIGPIPE"):
    delattr(signal, name)
for name in ("sched_getaffinity", "sched_setaffinity", "getuid", "fork", "killpg", "getloadavg", "O_NOFOLLOW", "O_NONBLOCK"):
    delattr(os, name)
import importlib, pkgutil, pcil
for module in pkgutil.walk_packages(pcil.__path__, "pcil."):
    if not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from pcil.training.callbacks import Callback
from pcil.training.progress import Signals
with Signals(lambda: None):
    pass
print("all")
"""


# --- Locks ---


def test_a_lock_is_held_by_one_process_and_freed_when_it_is_killed(tmp_path: Path) -> None:
    lock = tmp_path / ".lock"
    with subprocess.Popen([sys.executable, "-c", HOLD, str(lock)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout and holder.stdout.readline() == "True\n"
        with files.locked(lock) as free:
            assert not free
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    for _ in range(2):
        with files.locked(lock) as free:
            assert free and lock.exists()


def test_what_lies_in_a_locked_file_stays(tmp_path: Path) -> None:
    (tmp_path / ".lock").write_text("keep me\n")
    with files.locked(tmp_path / ".lock") as free:
        assert free
    assert (tmp_path / ".lock").read_text() == "keep me\n"


def test_a_link_is_refused_and_what_it_names_stays_by_every_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """This includes a dangling link, whose target is not created."""
    (tmp_path / "precious.txt").write_text("keep me\n")
    for folder, target in (("linked", "precious.txt"), ("dangling", "nowhere")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / ".lock").symlink_to(tmp_path / target)
        for words in (
            "train toy/point_mass-v0 --method expert --out",
            "train toy/nothing-v0 --out",
            "evaluate",
            "report --out r",
        ):
            assert cli.main([*words.split(), folder]) == 2
            assert capsys.readouterr().err.count("\n") == 1
        with pytest.raises(InputError, match=r"\.lock can't be locked .*it is a link.*delete it"):
            pcil.train("toy/point_mass-v0", method="expert", out=folder)
        assert [path.name for path in (tmp_path / folder).iterdir()] == [".lock"]
    assert (tmp_path / "precious.txt").read_text() == "keep me\n" and not (tmp_path / "nowhere").exists()


def test_a_link_that_comes_between_the_look_and_the_lock_is_not_followed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "precious.txt").write_text("keep me\n")
    (tmp_path / ".lock").symlink_to(tmp_path / "precious.txt")
    monkeypatch.setattr(Path, "is_symlink", lambda _: False)
    with pytest.raises(InputError, match="can't be locked"), files.locked(tmp_path / ".lock"):
        pass
    assert (tmp_path / "precious.txt").read_text() == "keep me\n"


def test_a_folder_behind_a_link_can_be_trained_in(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "runs").symlink_to(tmp_path / "disk")
    with files.locked(tmp_path / "runs" / ".lock") as free:
        assert free and (tmp_path / "disk" / ".lock").is_file()


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EIO])
def test_where_locking_fails_the_reason_is_said_and_not_another_process(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fcntl = pytest.importorskip("fcntl")

    def refuse(*_: Any) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(InputError) as caught:
        pcil.train("toy/point_mass-v0", method="expert", out=tmp_path / "run")
    assert os.strerror(number) in str(caught.value) and "nother process is" not in str(caught.value)
    assert {path.name for path in (tmp_path / "run").iterdir()} <= {".lock"}


@pytest.mark.parametrize("number", [errno.EACCES, errno.EROFS, errno.EISDIR])
def test_where_a_lock_can_not_be_made_the_reason_is_said(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.open

    def refuse(path: Any, *options: Any, **more: Any) -> int:
        if str(path).endswith(".lock"):
            raise OSError(number, os.strerror(number))
        return real(path, *options, **more)

    monkeypatch.setattr(os, "open", refuse)
    with pytest.raises(InputError, match=os.strerror(number)):
        pcil.train("toy/point_mass-v0", method="expert", out=tmp_path / "run")


def test_every_module_imports_without_what_windows_lacks() -> None:
    """Runs in a separate process, without the modules, signals and functions that only Unix has."""
    result = subprocess.run([sys.executable, "-W", "ignore", "-c", WINDOWS], capture_output=True, text=True)
    assert (result.stdout, result.stderr) == ("all\n", "")


# --- Text and JSON ---


def test_text_is_read_up_to_its_limit(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("äöü")
    assert files.read_text(tmp_path / "file", 6) == "äöü"
    with pytest.raises(ValueError, match="larger than 5 bytes"):
        files.read_text(tmp_path / "file", 5)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[" * 100_000 + "]" * 100_000, "nested too deeply"),
        ("[" * 101 + "[]" + "]" * 101, "nested too deeply"),
        ('{"a":' * 101 + "[]" + "}" * 101, "nested too deeply"),
        ("1" * 400, "a number of 400 digits"),
        ("1" * 5000, "a number of 5,000 digits"),
        ("-" + "1" * 400, "digits"),
        ('{"a": ', "Expecting value"),
        ("", "Expecting value"),
        ("\x00", "Expecting value"),
    ],
    ids=lambda text: text[:10],
)
def test_json_that_can_not_be_read_is_a_value_error(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "file.json").write_text(text)
    with pytest.raises(ValueError, match=said):
        files.read_json(tmp_path / "file.json")


def test_what_is_nested_less_deeply_is_read(tmp_path: Path) -> None:
    assert str(files.parse_json("[" * 99 + '{"a": []}' + "]" * 99)).count("[") == 100
    (tmp_path / "file.toml").write_text(f"x{'.x' * 99} = 1")
    assert str(files.read_toml(tmp_path / "file.toml")).count("{") == 100


@pytest.mark.parametrize(
    "text", [f"x{'.x' * 200} = 1", f"x = {'[' * 200}{']' * 200}", f"[{'x.' * 20_000}x]", "x = " + "[" * 9000]
)
def test_toml_that_can_not_be_read_is_a_value_error(text: str, tmp_path: Path) -> None:
    (tmp_path / "file.toml").write_text(text)
    with pytest.raises(ValueError, match=r"nested too deeply|^TOML inline arrays|nvalid"):
        files.read_toml(tmp_path / "file.toml")


def test_json_is_what_it_was() -> None:
    text = '{"a": [1, -2, 3.5, 1e3, true, null, "x", 123456789012345678901234567890], "b": Infinity}'
    assert files.parse_json(text) == {
        "a": [1, -2, 3.5, 1e3, True, None, "x", 123456789012345678901234567890],
        "b": float("inf"),
    }


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run."""
    folder = tmp_path_factory.mktemp("finished")
    runs.execute(small_run(demos=save_point_mass_demos(folder)), folder / "run")
    return folder / "run"


HOSTILE = {
    "deep": lambda path: path.write_text("[" * 100_000 + "]" * 100_000),
    "digits": lambda path: path.write_text('{"final_return": %s}' % ("9" * 400)),
    "large": lambda path: path.write_bytes(b" " * (files.LARGEST + 1) + b"{}"),
    "bytes": lambda path: path.write_bytes(b"\xff\xfe{}"),
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
}
READERS = {
    "run.json": ["record run --out recorded", "report run --out report"],
    "policy/policy.json": ["evaluate run --episodes 1"],
    "sweep.toml": ["sweep run/sweep.toml --out sweep"],
}


@pytest.mark.parametrize("hostile", HOSTILE)
@pytest.mark.parametrize("name", READERS)
def test_a_hostile_file_is_one_sentence(
    name: str, hostile: str, finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(finished, tmp_path / "run")
    (run / name).unlink(missing_ok=True)
    HOSTILE[hostile](run / name)
    for words in READERS[name]:
        assert cli.main(words.split()) == 2
        out, error = capsys.readouterr()
        assert out == "" and error.startswith("pcil: ") and error.count("\n") == 1


@pytest.mark.parametrize("hostile", HOSTILE)
def test_a_hostile_done_says_what_to_do(hostile: str, tmp_path: Path) -> None:
    HOSTILE[hostile](tmp_path / "DONE")
    with pytest.raises(InputError, match=r"DONE can't be read .*; delete it"):
        runs.read_done(tmp_path)


def test_a_policy_of_infinitely_many_layers_is_damaged(finished: Path, tmp_path: Path) -> None:
    run = shutil.copytree(finished, tmp_path / "run")
    header = json.loads((run / "policy" / "policy.json").read_text())
    (run / "policy" / "policy.json").write_text(json.dumps({**header, "layers": float("inf")}))
    with pytest.raises(InputError, match="is damaged"):
        pcil.load_policy(run)


def test_the_lock_of_a_run_is_the_one_that_is_tested(tmp_path: Path) -> None:
    """While the run trains, its lock is taken; afterwards it is free."""
    seen = []

    class Looks(Callback):
        """Tries the lock from another process after each episode."""

        def episode(self, *_: Any) -> None:
            code = "import sys; from pathlib import Path; from pcil import files\n"
            code += "with files.locked(Path(sys.argv[1])) as free: print(free)"
            result = subprocess.run([sys.executable, "-c", code, tmp_path / "run" / ".lock"], capture_output=True, text=True)
            seen.append(result.stdout)

        def stop(self) -> bool:
            return True

    with pytest.raises(loop.Stopped):
        runs.execute(small_run("expert"), tmp_path / "run", [Looks()])
    assert seen == ["False\n"]
    with files.locked(tmp_path / "run" / ".lock") as free:
        assert free


# --- No space left ---


def limited(size: int, words: list[str], **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a command in a process with a limit on file size."""
    code = "import resource, sys; from pcil import cli\n"
    code += f"resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size})); sys.exit(cli.main(sys.argv[1:]))"
    return subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, env={**os.environ, **environment}, timeout=300
    )


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="Windows has no limit on the size of a file")
def test_whatever_can_not_be_written_any_more_is_one_sentence_and_nothing_is_lost(tmp_path: Path) -> None:
    """From the first file to the checkpoint, the curve, a recording and a report; without the limit each then succeeds."""
    train = "train toy/point_mass-v0 --method expert --frames 200 --seed-frames 100 --random-frames 100 --evaluate-every 100"
    train += " --evaluate-episodes 2 --agent.hidden 16 --agent.batch-size 32 --agent.feature-dim 8 --checkpoint-seconds 0"
    commands = {
        f"{train} --out run": (0, 1000, 4000, 20_000),
        "record run --episodes 2 --out data": (0, 30_000),
        "report run --out page": (0, 1000, 10_000),
    }
    cache = {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}  # which can't be written either
    for command, sizes in commands.items():
        for size in sizes:
            done = limited(size, command.split(), **cache)
            assert done.returncode == 2, (command, size, done.stderr)
            assert done.stderr.startswith("pcil: ") and done.stderr.count("\n") == 1, (command, size, done.stderr)
        done = limited(2**40, command.split(), **cache)
        assert (done.returncode, done.stderr) == (0, ""), (command, done.stderr)
    assert limited(2**40, f"{train} --out alone".split(), **cache).returncode == 0
    for name in ("policy/policy.safetensors", "policy/policy.json", "DONE"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes()


def test_a_run_that_is_refused_for_its_size_leaves_its_folder_free(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = "train toy/point_mass-v0 --method expert --frames 5000 --replay-steps 100000000000 --out run"
    assert cli.main(words.split()) == 2
    assert capsys.readouterr().err.startswith("pcil: The run in run stopped: there is not enough memory")
    assert not (tmp_path / "run" / "run.json").exists()


# --- Text that is shown ---


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("walker_walk é 行", "walker_walk é 行"),
        ("\x1b[31mred\x1b]0;title\x07", "\\x1b[31mred\\x1b]0;title\\x07"),
        ("a\r\nb\tc\x00\x7f\x9b", "a\\r\\nb\\tc\\x00\\x7f\\x9b"),
        ("lone \ud800", "lone \\ud800"),
        ("right \u202e left", "right \\u202e left"),
        ("x" * 5000, "x" * 750 + " ... " + "x" * 750),
    ],
    ids=["plain", "escapes", "controls", "surrogate", "direction", "long"],
)
def test_what_is_shown_is_printable_and_short(text: str, said: str) -> None:
    assert shown(text) == said


@pytest.mark.parametrize(
    "words",
    [
        ["train", "\x1b[31mred"],
        ["train", "x" * 5000, "--out", "run"],
        ["\x1b[2Jclear"],
        ["evaluate", "\ud800"],
        ["evaluate", "x" * 5000],
        ["train", "toy/point_mass-v0", "--method", "expert", "--out", "x" * 5000],
        ["train", "toy/point_mass-v0", "--method", "expert", "--out", "~no such user/run"],
        ["report", "~no such user/run", "--out", "new"],
        ["sweep", "\x1b[31m.toml", "--out", "~no such user/run"],
        *(
            [*words.split(), "9" * 400]
            for words in (
                "train toy/point_mass-v0 --method expert --out run --frames",
                "train toy/point_mass-v0 --method expert --out run --evaluate-every",
                "train toy/point_mass-v0 --method expert --out run --agent.noise.steps",
                "evaluate run --episodes",
                "evaluate run --seed",
                "record run --out new --episodes",
                "sweep sweep.toml --out new --jobs",
                "theory --seed",
            )
        ),
        ["bench", "--task", "x" * 5000],
        ["bench", "--preset", "x" * 5000],
        ["record", "run", "--out", "x" * 5000],
        ["demos", "x" * 5000],
        ["doctor", "--" + "x" * 5000],
        ["train", "toy/point_mass-v0", "--method", "\x1b[31mred", "--out", "run"],
    ],
    ids=lambda words: words[0][:8],
)
def test_hostile_arguments_are_one_short_printable_line(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("pcil: ") and err.endswith("\n") and err[:-1].isprintable() and len(err) < 1600


HOSTILE_SWEEPS = [
    "x" * 5000,
    f"tasks = ['{'x' * 5000}']\nmethods = ['pcil']\nseeds = [1]",
    "tasks = ['a\\u0000b']\nmethods = ['pcil']\nseeds = [1]",
    "tasks = ['\\u001B[31m']\nmethods = ['pcil']\nseeds = [1]",
    f"tasks = ['toy/point_mass-v0']\nmethods = ['expert']\nseeds = [{'9' * 400}]",
    f"tasks = ['toy/point_mass-v0']\nmethods = ['expert']\nseeds = [{'9' * 5000}]",
    "tasks = ['toy/point_mass-v0']\nmethods = ['pcil']\nseeds = [1]\n[settings]\ndemos = 'a\\u0000b'",
    f"tasks = ['toy/point_mass-v0']\nmethods = ['expert']\nseeds = [1]\n[settings]\nenv_kwargs = {{a = {'[' * 90}{']' * 90}}}",
    f"tasks = ['toy/point_mass-v0']\nmethods = ['expert']\nseeds = [1]\n[variants.{'x' * 5000}]\nlabel = 'stored'",
    f"tasks = ['toy/point_mass-v0']\nmethods = ['expert']\nseeds = [1]\ncores = {'9' * 400}",
    f"tasks = {'[' * 99}{']' * 99}",
]


@pytest.mark.parametrize("text", HOSTILE_SWEEPS, ids=range(len(HOSTILE_SWEEPS)))
def test_a_hostile_sweep_is_one_short_printable_line(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path("sweep.toml").write_text(text)
    assert cli.main(["sweep", "sweep.toml", "--out", "out"]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("pcil: ") and err.endswith("\n") and err[:-1].isprintable() and len(err) < 1600


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (OSError(errno.EMFILE, "Too many open files"), 1),
        (OSError(errno.ENOMEM, "Cannot allocate memory", "x" * 5000), 1),
        (MemoryError(), 1),
        (RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes."), 1),
        (ValueError("RESOURCE_EXHAUSTED: Error opening"), 1),
        (RuntimeError("can't start new thread"), 1),
        (OSError(errno.ENAMETOOLONG, "File name too long", "x" * 5000), 2),
        (OSError(errno.EDQUOT, "Disk quota exceeded"), 2),
        (OSError(errno.EFBIG, "File too large"), 2),
    ],
    ids=str,
)
def test_what_the_system_refuses_is_one_sentence(
    error: Exception, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def raises(_: list[str]) -> int:
        raise error

    monkeypatch.setattr("pcil.cli.demos.main", raises)
    assert cli.main(["demos"]) == code
    err = capsys.readouterr().err
    assert err.startswith("pcil: ") and err.count("\n") == 1 and len(err) < 700


def test_what_is_none_of_these_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    def raises(_: list[str]) -> int:
        raise RuntimeError("a mistake of ours")

    monkeypatch.setattr("pcil.cli.demos.main", raises)
    with pytest.raises(RuntimeError, match="a mistake of ours"):
        cli.main(["demos"])


@pytest.mark.parametrize("words", ["n 20", "v 1000000"])
def test_limits_that_are_too_low_are_said_before_anything_begins(words: str) -> None:
    train = f"ulimit -{words}; {sys.executable} -m pcil train toy/point_mass-v0 --method expert --out run --frames 5000"
    result = subprocess.run(["sh", "-c", train], capture_output=True, text=True)
    assert result.returncode == 2 and result.stdout == "" and not Path("run", "run.json").exists()
    assert re.fullmatch(r"pcil: This process may have too little \(ulimit.*\n", result.stderr)


def test_a_terminal_that_can_not_show_every_letter_stops_nothing(tmp_path: Path) -> None:
    fake_run(tmp_path / "\u884c", [])
    fake_run(tmp_path / "a", [1.0])
    result = subprocess.run(
        [sys.executable, "-m", "pcil", "report", ".", "--out", "out", "--no-rollouts"],
        capture_output=True,
        text=True,
        env=dict(os.environ, PYTHONIOENCODING="ascii"),
    )
    assert result.returncode == 0 and "left out: \\u884c, it has no evaluation yet" in result.stdout
