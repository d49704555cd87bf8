"""The command line: bad input gives one sentence and exit code 2 and writes nothing; valid commands work from end to end."""

from __future__ import annotations

import contextlib
import dataclasses
import html
import io
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import pcil
from pcil import cli
from pcil.cli import arguments
from pcil.demos import Demonstrations, shipped_tasks
from pcil.envs import TASKS
from pcil.envs.toy import PointMass
from pcil.policy import load_policy
from pcil.report import figures
from pcil.training import presets
from pcil.training.config import changed
from small import POINT_MASS, save_point_mass_demos, small_run

NARROW = """
    --frames 300 --seed-frames 100 --random-frames 100 --evaluate-every 100 --evaluate-episodes 2 --cloning-updates 20
    --agent.hidden 16 --agent.feature-dim 8 --agent.batch-size 32 --agent.noise.steps 1000 --reward.hidden 16
    --reward.batch-size 32
"""
"""`small.small_run` as command-line arguments, so that both share one compilation."""
reset = PointMass.reset


def narrow_run(demos: str, out: str | Path) -> list[str]:
    """The command that trains it."""
    return ["train", POINT_MASS, "--demos", demos, *NARROW.split(), "--out", str(out)]


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> str:
    return save_point_mass_demos(tmp_path_factory.mktemp("demos"))


@pytest.fixture(scope="module")
def trained(demos: str, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A finished run, and the output of its training."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    with contextlib.redirect_stdout(io.StringIO()) as output:
        assert cli.main(narrow_run(demos, folder)) == 0
    return folder, output.getvalue()


@pytest.fixture
def run(trained: tuple[Path, str], tmp_path: Path) -> Path:
    """A copy of the finished run that a test may damage, as `run` in the current folder."""
    return Path(shutil.copytree(trained[0], tmp_path / "run"))


def files(folder: Path) -> dict[str, bytes | None]:
    """The content of every file below `folder`; the value of a folder is None."""
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


def refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The message with which the command refuses: one sentence, only on standard error. No file is changed."""
    before = files(Path.cwd())
    assert cli.main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("pcil: ") and err.endswith(".\n") and err.count("\n") == 1, err
    assert not re.search(r"[.!?] [A-Z]|Traceback|[─│╭]", err), "one sentence, no box"
    assert files(Path.cwd()) == before
    return err


# --- Bad input ---


def test_an_unknown_command_names_the_commands(capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(["trian", "walker_walk"], capsys)
    assert "'trian'" in said and all(name in said for name in cli.COMMANDS)


def test_an_unknown_task_names_the_ten(capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(["train", "walker_wlak", "--out", "new"], capsys)
    assert "'walker_wlak'" in said and all(task in said for task in TASKS) and "did you mean 'walker_walk'?" in said


def test_an_unknown_method_names_the_methods(capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(["train", "walker_walk", "--method", "gial", "--out", "new"], capsys)
    assert "'gial'" in said and all(name in said for name in presets.METHODS)


def test_an_unknown_preset_names_the_presets(capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(["train", "walker_walk", "--preset=best", "--out", "new"], capsys)
    assert "'best'" in said and all(name in said for name in presets.PRESETS)


TRAIN = [
    # arguments after `train`, text that the message must contain
    ("--out new", "The task is missing"),
    ("walker_walk", "Missing from pcil train: --out PATH"),
    ("walker_walk --out", "Missing value for argument '--out'"),
    ("walker_walk walker_run --out new", "Unrecognized options"),
    ("walker_walk --out new --frames many", "Error parsing --frames: .*'many'; it takes --frames INT"),
    ("walker_walk --out new --frames 1e5", "--frames INT"),
    ("walker_walk --out new --agent.noise.start=high", "--agent.noise.start FLOAT"),
    ("walker_walk --out new --framse 5000", "--framse, 5000; perhaps you meant --frames INT"),
    ("walker_walk --out new --xyz", "Unrecognized options: --xyz"),
    ("Pendulum-v1 --out new --demos nowhere --replay-steps 200", "has 200 rows, and an episode of Pendulum-v1 may take 201"),
    ("walker_walk --out new --label often", "'often' .*'sampled', 'stored'"),
    ("walker_walk --out new --frames 1000", "1000 frames .* --frames more than 2000"),
    ("walker_walk --out new --frames=-1", "-1 frames"),
    ("walker_walk --out new --seed -1", "seed is -1"),
    ("walker_walk --out new --evaluate-episodes 0", "evaluate_episodes is 0"),
    ("walker_walk --out new --agent.batch-size 64", "at most agent.batch_size"),
    ("walker_walk --out new --num-demos 0", "0 demonstrations of walker_walk"),
    ("walker_walk --out new --num-demos 99", "99 demonstrations of walker_walk .* 1 to 10"),
    ("walker_walk --out new --demos nowhere", "'nowhere'"),
    ("pendulum_swingup --out new --demos walker_walk", "obs of shape .* in this environment"),
    (f"{POINT_MASS} --out new --demos walker_walk", "obs of shape .* in this environment"),
    (f"{POINT_MASS} --out new", f"no Minari dataset .*'{POINT_MASS}'"),
    ("CartPole-v1 --out new", "actions of 'CartPole-v1' must be"),
    ("walker_walk --out new --reward nonsense", "'nonsense' can't be loaded .* my.module:MyReward"),
    ("walker_walk --out new --reward=no.such.module:Mine", "ModuleNotFoundError"),
    ("walker_walk --out new --reward .mine:Mine", "can't be loaded"),
    ("walker_walk --out new --reward pcil.rewards:Missing", "has no attribute 'Missing'"),
    ("walker_walk --out new --reward pcil.rewards:Reward", "abstract"),
    ("walker_walk --out new --reward json:JSONDecoder", "no subclass of pcil.Reward"),
    ("walker_walk --out new --reward", "'' can't be loaded"),
]


@pytest.mark.parametrize(("words", "said"), TRAIN, ids=[words for words, _ in TRAIN])
def test_train_refuses(words: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert re.search(said, refused(["train", *words.split()], capsys))


OTHERS = [
    ("evaluate", "Missing from pcil evaluate: PATH"),
    ("evaluate nowhere", "nowhere holds no policy"),
    ("evaluate run --episodes 0", "--episodes is 0; it must be at least 1"),
    ("evaluate run --seed -1", "--seed is -1; it must be at least 0"),
    ("evaluate run --episodes two", "it takes --episodes INT"),
    ("record run", "Missing from pcil record: --out PATH"),
    ("record nowhere --out new", "nowhere holds no policy"),
    ("record run --out new --episodes 0", "--episodes is 0"),
    ("record run --out new --seed -1", "--seed is -1"),
    ("record run --out run", "exists already"),
    ("record run --out run/run.json/new", "can not be written"),
    ("record run --out new --episodes 1 --minimum-return 1000", "Only 0 of 10 episodes"),
    ("report", "Missing from pcil report: --out PATH"),
    ("report --out new", "There is no run in nothing"),
    ("report nowhere --out new", "nowhere does not exist"),
    ("report run/tensorboard --out new", "There is no run in run/tensorboard; give folders that pcil train made"),
    ("report run/run.json --out new", r"left out: run/run\.json is not a file of results"),
    ("report run --out run/run.json/new", "can't be written"),
    ("demos walker_walk cheetah_run", "Unrecognized options: cheetah_run"),
    ("bench --preset best", "'best'"),
    ("bench --seconds nan", "--seconds is nan"),
    ("report run --out run", "run holds something other than a report"),
    ("record run --out new --minimum-return nan", "minimum return is nan"),
    ("doctor --json", "Unrecognized options: --json"),
]


@pytest.mark.usefixtures("run")
@pytest.mark.parametrize(("words", "said"), OTHERS, ids=[words for words, _ in OTHERS])
def test_other_commands_refuse(words: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert re.search(said, refused(words.split(), capsys))


@pytest.mark.parametrize("words", [["evaluate", "run"], ["record", "run", "--out", "new"]])
@pytest.mark.parametrize("name", ["policy.safetensors", "policy.json"])
def test_a_damaged_policy_is_refused(name: str, words: list[str], run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = run / "policy" / name
    path.write_bytes(path.read_bytes()[:-20])
    assert "is damaged" in refused(words, capsys)


def test_a_folder_with_another_run_is_refused(run: Path, demos: str, capsys: pytest.CaptureFixture[str]) -> None:
    words = [*narrow_run(demos, run), "--seed", "2", "--agent.gamma", "0.9"]
    said = refused(words, capsys)
    assert "seed was 1, now 2" in said and "agent.gamma was 0.99, now 0.9" in said


def test_a_folder_with_something_else_is_refused(demos: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "thesis.tex").write_text("mine")
    assert "thesis.tex" in refused(narrow_run(demos, "thesis"), capsys)


def test_a_folder_that_cannot_be_made_is_refused(demos: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("mine")
    assert "file/run can't be written" in refused(narrow_run(demos, "file/run"), capsys)


def test_a_reward_whose_module_is_broken_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "broken_reward.py").write_text("class Mine(:\n")
    assert "SyntaxError" in refused(["train", "walker_walk", "--out", "new", "--reward", "broken_reward:Mine"], capsys)


def test_recording_never_overwrites_a_dataset(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    save_point_mass_demos(tmp_path)
    said = refused(["record", str(run), "--episodes", "1", "--out", "point_mass-v0"], capsys)
    assert "exists already" in said


@pytest.mark.parametrize(("encoding", "columns"), [("utf-8", "200"), ("utf-8", "40"), ("ascii", "40")])
def test_a_refusal_is_the_same_on_every_terminal(encoding: str, columns: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """tyro draws a box that depends on the terminal's width, encoding and colours; these must not affect the message."""

    class Terminal(io.TextIOWrapper):
        def isatty(self) -> bool:
            return True

    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(sys, "stdout", Terminal(io.BytesIO(), encoding=encoding))
    monkeypatch.setattr(sys, "stderr", err := io.StringIO())
    assert cli.main(["train", "walker_walk", "--out", "x", "--framse", "5"]) == 2
    options = "Unrecognized options: --framse, 5; perhaps you meant --frames INT"
    assert err.getvalue() == f"pcil: {options}; pcil train --help tells more.\n"


# --- What the arguments mean ---


def test_options_are_seen_before_they_are_parsed() -> None:
    words = ["--seed", "-1", "walker_walk", "--method=dac", "--reward.hidden", "16", "--preset", "paper"]
    given = {"seed": "-1", "task": "walker_walk", "method": "dac", "reward.hidden": "16", "preset": "paper"}
    assert arguments.peek(words) == given


def test_an_option_is_taken_out_with_its_value() -> None:
    words = ["a", "--reward", "x:Y", "--reward.hidden", "1", "--reward=z:Y", "b"]
    assert arguments.without(words, "reward") == ["a", "--reward.hidden", "1", "b"]


# --- Help ---


def test_help_is_an_overview_without_any_heavy_import() -> None:
    command = [sys.executable, "-X", "importtime", "-m", "pcil", "--help"]
    result = subprocess.run(command, capture_output=True, text=True, check=True)
    imported = {line.rsplit("|", 1)[-1].strip().partition(".")[0] for line in result.stderr.splitlines()}
    assert all(f"  {name}" in result.stdout for name in cli.COMMANDS)
    assert "pcil" in imported and not imported & {"jax", "numpy", "gymnasium", "tyro", "rich", "dm_control", "matplotlib"}


def test_no_words_are_a_call_for_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 0
    assert capsys.readouterr().out.startswith("usage: pcil COMMAND")


def test_the_version_is_that_of_the_package() -> None:
    command = [sys.executable, "-m", "pcil", "--version"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == f"pcil {pcil.__version__}\n"


@pytest.mark.parametrize("command", list(cli.COMMANDS))
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([command, "--help"]) == 0
    out, err = capsys.readouterr()
    assert f"usage: pcil {command}" in out and cli.COMMANDS[command].rstrip(".") in out and err == ""


@pytest.mark.parametrize(
    ("method", "shown", "hidden"),
    [
        ("pcil", ["--reward.temperature", "--reward.penalty"], []),
        ("dac", ["--reward.penalty"], ["--reward.temperature"]),
        ("expert", ["--reward.task-weight"], ["--reward.penalty", "--reward.temperature"]),
    ],
)
def test_train_help_shows_the_settings_of_the_method(
    method: str, shown: list[str], hidden: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["train", "hopper_hop", "--method", method, "--preset", "paper", "--help"]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "(default: hopper_hop)" in out and f"(default: {method})" in out and "2000000" in out
    assert all(option in out for option in shown) and not any(option in out for option in hidden)


def test_a_reward_of_ones_own_brings_its_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A reward that needs whole episodes is accepted with `--label stored`, and refused with the default label."""
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    (tmp_path / "reward_of_mine.py").write_text(
        "from dataclasses import dataclass\n"
        "from pcil.rewards import TaskReward\n"
        "@dataclass(frozen=True)\n"
        "class Mine(TaskReward):\n"
        "    scope = 'episode'\n"
        "    strength: float = 0.25\n"
    )
    words = ["train", POINT_MASS, "--reward", "reward_of_mine:Mine"]
    assert "use --label stored" in refused([*words, "--out", "new"], capsys)
    assert cli.main([*words, "--label", "stored", "--help"]) == 0
    assert "--reward.strength" in capsys.readouterr().out


# --- End to end ---


def test_training_ends_with_a_plain_statement(trained: tuple[Path, str], demos: str) -> None:
    folder, printed = trained
    final = json.loads((folder / "DONE").read_text())["final_return"]
    expert = Demonstrations.load(demos).return_mean
    *progress, statement, policy, curve = printed.splitlines()
    assert statement == f"Final return {final:.1f}, {final / expert:.0%} of the expert's {expert:.1f} (mean of 2 episodes)."
    assert policy == f"Policy: {folder / 'policy'}" and (folder / "policy" / "policy.safetensors").exists()
    assert curve == f"Learning curve: {folder / 'curve.png'}" and (folder / "curve.png").exists()
    assert [line.split()[0] for line in progress] == ["Absorbing", "0", "100", "200", "300"]
    assert progress[0] == f"Absorbing state: off; no episode of {POINT_MASS} ends early."


def test_the_curve_is_drawn_anew_at_each_evaluation_after_the_first(
    demos: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From all evaluations until then, of two episodes each."""
    drawn: list[int] = []

    def draw(folder: Path, expert: float | None) -> Path:
        drawn.append(len((folder / "eval.csv").read_text().splitlines()) - 1)
        return folder / "curve.png"

    monkeypatch.setattr(figures, "run_curve", draw)
    assert cli.main(narrow_run(demos, tmp_path / "run")) == 0
    assert drawn == [4, 6, 8, 8]


def test_the_same_command_again_says_that_it_is_done(run: Path, demos: str, capsys: pytest.CaptureFixture[str]) -> None:
    logs = {name: data for name, data in files(run).items() if name != "curve.png"}
    assert cli.main(narrow_run(demos, run)) == 0
    out = capsys.readouterr().out
    assert out.startswith(f"The run in {run} is done.\nFinal return ")
    assert {name: data for name, data in files(run).items() if name != "curve.png"} == logs


def test_the_command_line_and_python_mean_the_same_run(run: Path, demos: str) -> None:
    assert (
        json.loads((run / "run.json").read_text())["run"]
        == changed(small_run(demos=demos), {"agent.absorbing": False, "agent.cloning": True}).to_json()
    )


def test_the_settings_of_another_run_train_the_same_run(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From its `run.json`, and from the content of that file as an argument; in the run's own folder, it is finished."""
    assert cli.main(["train", "--settings", str(run / "run.json"), "--out", str(run)]) == 0
    assert "is done" in capsys.readouterr().out
    settings = json.dumps(json.loads((run / "run.json").read_text())["run"])
    assert cli.main(["train", "--settings", settings, "--out", "again"]) == 0
    assert (tmp_path / "again" / "policy" / "policy.json").read_bytes() == (run / "policy" / "policy.json").read_bytes()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ("nothing.json", "nothing.json holds no settings of a run"),
        ("{}", "--settings holds no settings of a run"),
        ('{"agent": {"class": "drqv2"}, "reward": {"class": "pcil"}, "task": "toy/point_mass-v0", "speed": 3}', "speed"),
        ('{"agent": {"class": "nobody:Agent"}, "reward": {"class": "pcil"}, "task": "walker_walk"}', "--trust nobody"),
    ],
)
def test_settings_that_make_no_run_are_refused(settings: str, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert said in refused(["train", "--settings", settings, "--out", "new"], capsys)


def test_a_setting_by_its_older_name_is_taken_and_its_name_of_today_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = []
    monkeypatch.setattr("pcil.cli.train._run", lambda run, out, callbacks: runs.append(run) or 0)
    for words in (["--agent.standardise", "False"], ["--agent.normalize-observations=False"]):
        assert cli.main(["train", "walker_walk", *words, "--out", "new"]) == 0
    assert runs[0] == runs[1] and not runs[0].agent.normalize_observations
    assert capsys.readouterr().err == "pcil: --agent.standardise is now called --agent.normalize-observations.\n"


def test_a_logger_of_ones_own_is_told_from_the_command_line(demos: str, tmp_path: Path) -> None:
    (tmp_path / "my_logger.py").write_text(
        "from pathlib import Path\n"
        "from pcil import Callback\n"
        "class Logger(Callback):\n"
        "    def episode(self, row):\n"
        "        with Path('told.txt').open('a') as file:\n"
        "            file.write(f\"{row['episode']} {row['frames']}\\n\")\n"
    )
    assert cli.main([*narrow_run(demos, tmp_path / "run"), "--callbacks", "my_logger:Logger"]) == 0
    assert (tmp_path / "told.txt").read_text().splitlines() == [f"{i} {50 * i}" for i in range(1, 7)]


def test_a_long_name_of_a_task_is_its_short_one(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = []
    monkeypatch.setattr("pcil.cli.train._run", lambda run, out, callbacks: runs.append(run) or 0)
    assert cli.main(["train", "dmc/walker_walk-v0", "--out", "new"]) == 0
    assert cli.main(["train", "--out", "new", "walker_walk"]) == 0
    assert runs[0] == runs[1] == presets.make("walker_walk")


def test_evaluate_prints_json_and_nothing_else(run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["evaluate", str(run), "--episodes", "3", "--seed", "5"]
    assert cli.main([*words, "--json"]) == 0
    row = json.loads(capsys.readouterr().out)
    assert list(row) == ["task", "episodes", "seed", "return_mean", "return_std", "return_min", "returns"]
    assert (row["task"], row["episodes"], row["seed"]) == (POINT_MASS, 3, 5)
    assert len(row["returns"]) == 3 and len(set(row["returns"])) == 3
    assert np.isclose(row["return_mean"], np.mean(row["returns"])) and np.isclose(row["return_std"], np.std(row["returns"]))

    assert cli.main(words) == 0
    assert capsys.readouterr().out.startswith(
        f"{POINT_MASS}: return {row['return_mean']:.1f} +- {row['return_std']:.1f} over 3"
    )


class Heavy(PointMass):
    """A point mass at which the same action moves less, and which says whether it came near."""

    def __init__(self, speed: float = 0.05) -> None:
        super().__init__()
        self.SPEED = speed

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        *result, _ = super().step(action)
        return *result, {"is_success": bool(result[1] > 0.5)}


@pytest.fixture
def heavy() -> Iterator[str]:
    gymnasium.register(name := "test/heavy-v0", Heavy, disable_env_checker=True)
    yield name
    del gymnasium.registry[name]


def evaluated(capsys: pytest.CaptureFixture[str], *words: str) -> dict[str, Any]:
    assert cli.main(["evaluate", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_another_environment_has_its_own_arguments(run: Path, heavy: str, capsys: pytest.CaptureFixture[str]) -> None:
    """With the speed of the point mass it pays the same, and half of it pays something else; the policy's own stay away."""
    policy = load_policy(run)
    dataclasses.replace(policy, info=policy.info | {"env_kwargs": {"max_episode_steps": 7}}).save(run / "policy")
    plain = evaluated(capsys, "run", "--episodes", "3", "--env", POINT_MASS)
    same = evaluated(capsys, "run", "--episodes", "3", "--env", heavy, "--env-kwargs", '{"speed": 0.1}')
    slow = evaluated(capsys, "run", "--episodes", "3", "--env", heavy)
    assert same["returns"] == plain["returns"] != slow["returns"]
    assert same.pop("success_rate") in (0, 1 / 3, 2 / 3, 1) and "success_rate" not in plain
    known = ["task", "episodes", "seed", "return_mean", "return_std", "return_min", "returns", "trained_on"]
    assert list(same) == list(plain) == known and (slow["task"], slow["trained_on"]) == (heavy, POINT_MASS)
    assert cli.main(["evaluate", "run", "--env", heavy]) == 0
    assert capsys.readouterr().out.startswith(f"{heavy}: return ")
    assert "but in the environment created here" in refused(["evaluate", "run", "--env", "toy/probe_1-v0"], capsys)
    assert "There is no environment 'nothing'" in refused(["evaluate", "run", "--env", "nothing"], capsys)


@pytest.mark.usefixtures("run")
def test_noise_changes_the_returns_and_is_the_same_each_time(capsys: pytest.CaptureFixture[str]) -> None:
    exact, noisy, again, single = (
        evaluated(capsys, "run", "--episodes", "3", *words.split())
        for words in ("--noise 0", "--noise 0.3", "--noise 0.3", "--noise 0.3 --single-environment")
    )
    assert noisy == again == single and noisy["noise"] == 0.3
    assert "noise" not in exact and not set(noisy["returns"]) & set(exact["returns"])
    for value in ("-0.1", "nan", "inf"):
        assert "it must be at least 0" in refused(["evaluate", "run", f"--noise={value}"], capsys)


def test_an_expert_that_ships_is_found_by_its_task(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    row = evaluated(capsys, "pendulum_swingup", "--episodes", "1")
    assert row["task"] == "pendulum_swingup" and row["return_mean"] > 300
    assert pcil.load_policy("walker_walk").info["method"] == "expert"
    assert cli.main(["record", "pendulum_swingup", "--episodes", "1", "--out", "mine/p-v0"]) == 0
    capsys.readouterr()
    run.rename(tmp_path / "walker_walk")  # a folder of this name comes first
    assert pcil.load_policy("walker_walk").task == POINT_MASS
    said = refused(["evaluate", "walker_wlak"], capsys)
    assert "holds no policy" in said and all(task in said for task in TASKS)


def test_what_is_recorded_can_be_trained_from(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["record", str(run), "--episodes", "4", "--seed", "3", "--out", "mine/point-v0"]) == 0
    recorded = Demonstrations.load("mine/point-v0")
    returns = f"{recorded.return_mean:.1f} +- {recorded.return_std:.1f}"
    assert capsys.readouterr().out == f"4 episodes of {POINT_MASS}, return {returns}: {tmp_path / 'mine' / 'point-v0'}\n"
    assert recorded.task == POINT_MASS and len(recorded.episodes) == 4
    assert recorded.info["expert"] == "pcil, 300 frames, seed 1" and recorded.info["run"]["agent"]["hidden"] == 16

    assert cli.main(narrow_run("mine/point-v0", "second")) == 0
    assert f"the expert's {recorded.return_mean:.1f}" in capsys.readouterr().out
    about = json.loads((tmp_path / "second" / "run.json").read_text())
    assert about["demos"] == {"hash": recorded.hash, "episodes": 4, "return_mean": recorded.return_mean}


def test_a_report_of_a_run_is_a_page(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The page includes its representation, and says that the point mass has no pictures. The run is not changed."""
    before = files(run)
    assert cli.main(["report", str(run), "--out", "report"]) == 0
    note, said = capsys.readouterr().out.splitlines()
    assert note.startswith("1 of 1 animations are left out: ") and said == f"Report: {Path('report') / 'index.html'}"
    text = html.unescape((tmp_path / "report" / "index.html").read_text())
    assert "Probability" not in text and "No animation" in text and "reward.hidden: 16" in text and note in text
    rows = (tmp_path / "report" / "tables" / "transitions.csv").read_text().splitlines()
    assert len(rows) == 1 + 128 + 50 and (tmp_path / "report" / "figures" / "representation.pdf").exists()
    assert files(run) == before


def test_a_report_without_rollouts_needs_files_alone(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(run / "checkpoint")
    shutil.rmtree(run / "policy")
    assert cli.main(["report", str(run), "--out", "report", "--no-rollouts"]) == 0
    assert capsys.readouterr().out == f"Report: {Path('report') / 'index.html'}\n"
    assert not (tmp_path / "report" / "tables" / "transitions.csv").exists()


def test_arguments_of_the_environment_go_with_the_policy(
    trained: tuple[Path, str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What `evaluate` and `record` take from it, and what replaces these values."""
    run = load_policy(trained[0])
    dataclasses.replace(run, info=run.info | {"env_kwargs": {"max_episode_steps": 7}}).save(tmp_path / "policy")
    made: list[dict[str, Any]] = []
    make = gymnasium.make
    monkeypatch.setattr(gymnasium, "make", lambda name, **kwargs: made.append(kwargs) or make(name, **kwargs))
    for words in (["evaluate", "policy", "--episodes=1"], ["record", "policy", "--episodes=1", "--out"]):
        for limit in (7, 9):
            given = [] if limit == 7 else ["--env-kwargs", '{"max_episode_steps": 9}']
            out = [f"out-{limit}"] if words[0] == "record" else []
            assert cli.main([*words, *out, *given]) == 0
            assert {kwargs["max_episode_steps"] for kwargs in made} == {limit}
            made.clear()
    assert Demonstrations.load("out-9").num_steps == 9 and Demonstrations.load("out-7").num_steps == 7
    assert "env-kwargs '{\"max_episode_steps\": 9}'" in Demonstrations.load("out-9").info["command"]
    capsys.readouterr()
    assert "JSON object" in refused(["evaluate", "policy", "--env-kwargs", "[1]"], capsys)
    assert "speed" in refused(["evaluate", "policy", "--env-kwargs", '{"speed": 1}'], capsys)


def test_demonstrations_without_rewards_leave_the_expert_out_of_every_sentence(
    demos: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = Demonstrations.load(demos)
    states = Demonstrations.from_arrays([episode.obs for episode in whole.episodes], task=POINT_MASS).save(tmp_path / "states")
    assert cli.main(narrow_run(str(states), "run")) == 0
    said = capsys.readouterr().out
    assert "Final return" in said and "expert" not in said and "nan" not in said and "None" not in said
    assert cli.main(["report", "run", "--no-rollouts", "--out", "report"]) == 0
    capsys.readouterr()
    words = ["train", POINT_MASS, "--method", "bc", "--demos", str(states), "--frames", "300", "--out", "bc"]
    assert "no actions, which bc" in refused(words, capsys)


def test_demos_prints_json_and_nothing_else(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["demos", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["task"] for row in rows] == shipped_tasks()
    for row in rows:
        told = {"task", "episodes", "steps", "return_mean", "return_std", "return_min", "return_max", "expert", "hash"}
        assert told <= set(row) and row["return_min"] <= row["return_mean"] <= row["return_max"]
        assert row["steps"] in (500 * row["episodes"], 1000 * row["episodes"]) and len(row["hash"]) == 64


def test_demos_is_a_table_for_people(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Text from a dataset is shown literally: brackets are not markup."""
    monkeypatch.setenv("COLUMNS", "300")
    row = {
        "task": "mine",
        "observation_dim": 2,
        "action_dim": 2,
        "episodes": 3,
        "return_mean": 41.26,
        "return_std": 0.5,
        "return_min": 40.7,
        "return_max": 42.25,
        "steps": 9,
    }
    shown = row | {"expert": "me [/bold] [red]", "frames": None, "seeds_tried": None, "hash": "0123456789abcdef"}
    monkeypatch.setattr("pcil.demos.inspect.shipped", lambda: [shown])
    assert cli.main(["demos"]) == 0
    out = capsys.readouterr().out
    assert "me [/bold] [red]" in out and re.search(r"41\.3 \+- 0\.5 +40\.7 +42\.2 ", out) and "01234567 " in out


# --- Stopping ---


@pytest.mark.parametrize(("name", "said"), [("train", "stopped; the same command goes on"), ("evaluate", "pcil: stopped.")])
def test_interrupts_exit_with_130(
    name: str, said: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt(words: list[str]) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(f"pcil.cli.{name}.main", interrupt)
    assert cli.main([name]) == 130
    assert said in capsys.readouterr().err


def test_whoever_stops_reading_stops_no_training(demos: str, tmp_path: Path) -> None:
    """As in `pcil train ... | head -1`."""
    command, pipes = (
        [sys.executable, "-m", "pcil", *narrow_run(demos, "run")],
        {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE},
    )
    with subprocess.Popen(command, **pipes) as process:
        assert process.stdout is not None and process.stderr is not None
        assert b"Absorbing state: off" in process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == b"" and process.wait() == 0
    assert (tmp_path / "run" / "DONE").exists()


@pytest.mark.parametrize("words", [["demos"], ["--help"]])
def test_a_closed_pipe_is_no_error_worth_words(words: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-m", "pcil", *words], stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")


def test_a_full_disk_under_standard_output_is_one_sentence() -> None:
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "pcil", "--version"], stdout=full, stderr=subprocess.PIPE, check=False, text=True
        )
    assert done.returncode == 2 and done.stderr == "pcil: standard output can't be read or written (No space left on device).\n"


def test_what_an_environment_prints_is_no_part_of_the_json(
    run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(PointMass, "reset", lambda self, **options: print("loud") or reset(self, **options))
    assert cli.main(["evaluate", str(run), "--episodes", "1", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["episodes"] == 1 and "loud" in err


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"final_return": null}'])
def test_a_damaged_end_is_refused(text: str, run: Path, demos: str, capsys: pytest.CaptureFixture[str]) -> None:
    (run / "DONE").write_text(text)
    assert "DONE can't be read" in refused(narrow_run(demos, run), capsys)
