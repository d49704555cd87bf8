"""The loop is reproducible, and a run that was stopped anywhere equals an uninterrupted one, bit for bit."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from pcil import envs
from pcil.demos import Demonstrations
from pcil.errors import InputError, RunError
from pcil.nets.noise import LinearSchedule
from pcil.policy import load_policy
from pcil.training import checkpoint, collect, learner, loop, presets, runs
from pcil.training.callbacks import Callback, History
from pcil.training.config import Run
from pcil.training.evaluate import Evaluation
from pcil.training.state import WALL_CLOCK, start
from pcil.types import Spec
from small import POINT_MASS, random_batch, save_point_mass_demos, small_run, windows


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> str:
    return save_point_mass_demos(tmp_path_factory.mktemp("demos"))


class StopAfter(Callback):
    """Asks to stop after a number of episodes; remembers messages."""

    def __init__(self, episodes: int) -> None:
        self.left, self.said = episodes, []

    def stop(self) -> bool:
        self.left -= 1
        return self.left == 0

    def message(self, text: str) -> None:
        self.said.append(text)


def rows(folder: Path) -> tuple[list[list[str]], list[dict[str, Any]]]:
    """`eval.csv` and `train.jsonl` without their wall-clock columns."""
    table = [line.split(",")[:-1] for line in (folder / "eval.csv").read_text().splitlines()]
    lines = [json.loads(line) for line in (folder / "train.jsonl").read_text().splitlines()]
    return table, [{name: value for name, value in line.items() if name not in WALL_CLOCK} for line in lines]


def same_run(one: Path, two: Path) -> None:
    """Logs, policy and everything learned are equal, bit for bit."""
    assert rows(one) == rows(two)
    first, second = (checkpoint.restore(folder / "checkpoint")[0] for folder in (one, two))
    assert first is not None and second is not None and first.keys() == second.keys()
    assert all(np.array_equal(first[name], second[name]) for name in first)
    obs = random_batch(5, 2, 2).obs
    assert np.array_equal(load_policy(one)(obs), load_policy(two)(obs))


def finish(run: Run, folder: Path, stops: tuple[int, ...] = ()) -> None:
    """Run to the end, stopping after the given numbers of episodes in the sessions before the last."""
    for episodes in stops:
        with pytest.raises(loop.Stopped):
            runs.execute(run, folder, [StopAfter(episodes)])
    runs.execute(run, folder)


CASES = [
    ("pcil", "sampled", {}),
    ("pcil", "stored", {}),
    ("dac", "sampled", {}),
    ("expert", "stored", {}),
    ("tcn", "sampled", {"negatives": "rollout", "margin": 5}),  # draws its own windows of ten steps
    ("pcil-gail", "stored", {"penalty_every": 3, "stages": 2}),
    ("tcn-gail", "sampled", {}),
    *((name, "stored", {}) for name in ("pwil", "sil", "potil")),
    ("bc", "sampled", {}),
]


@pytest.mark.parametrize(("method", "label", "reward"), CASES)
def test_a_stopped_run_equals_an_uninterrupted_one(
    method: str, label: str, reward: dict[str, Any], demos: str, tmp_path: Path
) -> None:
    run = small_run(method, label=label, demos=demos, reward=reward)
    if run.agent.offline:  # five passes
        run = dataclasses.replace(run, frames=2300, seed_frames=0, evaluate_every=1000)
    finish(run, tmp_path / "whole")
    finish(run, tmp_path / "stopped", stops=(1, 2, 1))
    same_run(tmp_path / "whole", tmp_path / "stopped")


def test_a_run_that_clones_begins_with_the_clone_and_resumes_exactly(
    demos: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The updates of cloning before the first of all are made once, also where a session ends before them. They and each later
    one have as many rows of the demonstrations as of the replay."""
    cloned: list[Any] = []
    real = learner.clone

    def cloning(algorithm: Any, held: learner.Learner, window: Any, rows: Any) -> learner.Learner:
        assert not held.totals["updates"] and len(window.obs) == len(rows.obs) == 32
        cloned.append(rows)
        return real(algorithm, held, window, rows)

    monkeypatch.setattr(learner, "clone", cloning)
    agent = dataclasses.replace(small_run().agent, cloning=True, averaging_rate=0.1)
    run = small_run(demos=demos, agent=agent, cloning_updates=40)
    finish(run, tmp_path / "whole")
    assert len(cloned) == 40
    policy = json.loads((tmp_path / "whole" / "train.jsonl").read_text().splitlines()[-1])
    assert policy["agent/cloning_error"] > 0
    finish(run, tmp_path / "stopped", stops=(1, 2, 1))
    assert len(cloned) == 80
    same_run(tmp_path / "whole", tmp_path / "stopped")


def test_a_clone_acts_from_the_first_update_on(demos: str, tmp_path: Path) -> None:
    """A clone of the optimal policy reaches most of its return as soon as updates begin; an untrained actor does not."""
    shares = []
    for cloning in (False, True):
        agent = dataclasses.replace(
            small_run().agent, cloning=cloning, cloning_weight=LinearSchedule(1000.0, 1000.0), learning_rate=1e-3
        )
        run = small_run(demos=demos, agent=agent, cloning_updates=1000, seed_frames=100, frames=101, evaluate_every=1000)
        finish(run, tmp_path / str(cloning))
        last = [float(row[2]) for row in rows(tmp_path / str(cloning))[0][1:] if row[0] != "0"]
        shares.append(np.mean(last) / Demonstrations.load(demos).return_mean)
    assert shares[0] < 0.5 < 0.75 < shares[1]


def test_the_averaged_actor_is_evaluated_and_saved(demos: str, tmp_path: Path) -> None:
    """An average that hardly follows the actor has the same returns throughout; the actor, which learns, has not."""
    returns = {}
    for rate in (1e-20, 1.0):
        agent = dataclasses.replace(small_run().agent, averaging_rate=rate, normalize_observations=False, learning_rate=1e-2)
        agent = dataclasses.replace(agent, cloning=False)
        finish(small_run(demos=demos, agent=agent), tmp_path / str(rate))
        table = rows(tmp_path / str(rate))[0][1:]
        returns[rate] = {tuple(row[2] for row in table if row[0] == frames) for frames in ("0", "300")}
    assert len(returns[1e-20]) == 1 and len(returns[1.0]) == 2
    held, saved = checkpoint.restore(tmp_path / "1e-20" / "checkpoint")[0], load_policy(tmp_path / "1e-20").actor
    assert held is not None and np.array_equal(held["learner.agent.averaged.trunk.weight"], saved.trunk.weight)


def test_whether_to_clone_is_decided_by_the_actions_of_the_demonstrations(demos: str, tmp_path: Path) -> None:
    given = Demonstrations.load(demos)
    bare = Demonstrations.from_arrays([episode.obs for episode in given.episodes], task=POINT_MASS)
    run = dataclasses.replace(small_run(), agent=dataclasses.replace(small_run().agent, cloning=None))
    for source, decided in ((given, True), (bare, False)):
        said: list[str] = []
        got = runs.prepared(run, said.append, read=lambda _, source=source: source)[0]
        assert got.agent.clones is decided
        assert any("no actions" in text for text in said) == (not decided)
    asked = dataclasses.replace(run, agent=dataclasses.replace(run.agent, cloning=True))
    with pytest.raises(InputError, match=r"agent.cloning needs the actions of demonstrations, and these have none"):
        runs.prepared(asked, read=lambda _: bare)
    expert = dataclasses.replace(small_run("expert"), agent=run.agent)
    assert runs.prepared(expert)[0].agent.clones is False


def test_another_seed_gives_another_run(demos: str, tmp_path: Path) -> None:
    for seed in (1, 2):
        finish(small_run(seed=seed, demos=demos), tmp_path / str(seed))
    assert rows(tmp_path / "1") != rows(tmp_path / "2")


def test_what_came_after_the_checkpoint_is_done_again(demos: str, tmp_path: Path) -> None:
    """A crash loses the episodes since the checkpoint; their rows are removed and written again, not duplicated."""
    run = small_run(demos=demos)
    finish(run, tmp_path / "whole")

    class PowerCut(BaseException):
        pass

    class Crash(Callback):
        """Raises at the end of its second episode."""

        episodes = 0

        def episode(self, row: dict[str, Any]) -> None:
            self.episodes += 1
            if self.episodes == 2:
                raise PowerCut

    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "crashed", [StopAfter(2)])
    with pytest.raises(PowerCut):
        runs.execute(run, tmp_path / "crashed", [Crash()])
    assert len(rows(tmp_path / "crashed")[1]) == 4, "two episodes more than the checkpoint has"
    finish(run, tmp_path / "crashed")
    same_run(tmp_path / "whole", tmp_path / "crashed")


def test_a_callback_that_fails_ends_the_run_saved_and_is_named(demos: str, tmp_path: Path) -> None:
    """The episode that it was informed of is not lost: the same command continues with the next one."""
    run = small_run(demos=demos)
    finish(run, tmp_path / "whole")

    class Broken(Callback):
        """A logger whose server is unavailable."""

        def episode(self, row: dict[str, Any]) -> None:
            if row["episode"] == 3:
                raise ConnectionError("no server")

    with pytest.raises(RunError, match=r"Broken raised ConnectionError \(no server\) in episode"):
        runs.execute(run, tmp_path / "broken", [Broken()])
    assert [row["episode"] for row in rows(tmp_path / "broken")[1]] == [1, 2, 3]
    told = StopAfter(-1)
    runs.execute(run, tmp_path / "broken", [told])
    assert "Resuming at 150 of 300 frames." in told.said
    same_run(tmp_path / "whole", tmp_path / "broken")


def test_callbacks_are_told_every_row_and_every_evaluation_and_what_was_logged_before(demos: str, tmp_path: Path) -> None:
    """A user's own logger gets what the files get, in the same order, and on resuming their previous content."""

    class Logger(Callback):
        def __init__(self) -> None:
            self.told: list[Any] = []

        def begin(self, run: Run, folder: Path, history: History) -> None:
            self.told.append(("begin", folder, [row["episode"] for row in history.episodes], len(history.evaluations)))

        def episode(self, row: dict[str, Any]) -> None:
            self.told.append(row)

        def evaluation(self, frames: int, seconds: float, result: Evaluation) -> None:
            self.told.append((frames, result.returns.tolist()))

        def end(self) -> None:
            self.told.append("end")

    run, first, second = small_run(demos=demos), Logger(), Logger()
    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "run", [StopAfter(3), first])
    runs.execute(run, tmp_path / "run", [second])
    assert first.told[0] == ("begin", tmp_path / "run", [], 0) and second.told[0] == ("begin", tmp_path / "run", [1, 2, 3], 4)
    assert first.told[-1] == second.told[-1] == "end"
    told = [*first.told[1:-1], *second.told[1:-1]]
    lines = [json.loads(line) for line in (tmp_path / "run" / "train.jsonl").read_text().splitlines()]
    assert [row for row in told if isinstance(row, dict)] == lines and len(lines) == 6
    table = [line.split(",") for line in (tmp_path / "run" / "eval.csv").read_text().splitlines()[1:]]
    evaluations = [entry for entry in told if isinstance(entry, tuple)]
    assert [float(row[2]) for row in table] == [value for _, returns in evaluations for value in returns]
    assert [frames for frames, _ in evaluations] == [0, 100, 200, 300]


@pytest.mark.parametrize("num_envs", [2, 3])
def test_several_environments_are_played_side_by_side_and_resume_exactly(num_envs: int, demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos, num_envs=num_envs, random_frames=200)
    finish(run, tmp_path / "whole")
    _, lines = rows(tmp_path / "whole")
    assert [line["episode"] for line in lines] == [1, 2, 3, 4, 5, 6]
    assert [line["frames"] for line in lines] == [50 * num_envs * ((i // num_envs) + 1) for i in range(6)]
    assert [line["return"] for line in lines[:num_envs]] == [line["return"] for line in one_by_one(demos, tmp_path)[:num_envs]]
    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "stopped", [StopAfter(1)])
    runs.execute(run, tmp_path / "stopped")
    same_run(tmp_path / "whole", tmp_path / "stopped")


def one_by_one(demos: str, folder: Path) -> list[dict[str, Any]]:
    """The rows of the same run in one environment; its first episodes are the same, since their actions are random."""
    finish(small_run(demos=demos, random_frames=200), folder / "single")
    return rows(folder / "single")[1]


def test_a_damaged_checkpoint_is_passed_over_and_said(demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos, checkpoint_seconds=0.0)
    finish(run, tmp_path / "whole")
    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "torn", [StopAfter(4)])
    newest = max((tmp_path / "torn" / "checkpoint").iterdir(), key=lambda path: int(path.name))
    (newest / "meta.json").write_bytes((newest / "meta.json").read_bytes()[:-20])
    listener = StopAfter(-1)
    runs.execute(run, tmp_path / "torn", [listener])
    assert any("damaged" in text for text in listener.said) and any("Resuming at 150" in text for text in listener.said)
    same_run(tmp_path / "whole", tmp_path / "torn")


def test_kill_9_at_any_moment_loses_nothing(demos: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same command, repeated and killed three times, ends like the uninterrupted run."""
    words = f"train {POINT_MASS} --demos {demos} --frames 1500 --seed-frames 100 --random-frames 100 --evaluate-every 300"
    words += " --agent.hidden 16 --reward.hidden 16 --agent.batch-size 32 --reward.batch-size 32 --checkpoint-seconds 0 --out "
    command = [sys.executable, "-m", "pcil", *words.split()]
    monkeypatch.delenv("XLA_FLAGS")  # a single run uses all cores, and must be exact with these too
    subprocess.run([*command, "whole"], check=True, stdout=subprocess.DEVNULL)
    whole_rows = len(rows(tmp_path / "whole")[1])
    for episodes in (1, 9, 17):
        process = subprocess.Popen([*command, "killed"], stdout=subprocess.DEVNULL)
        log = tmp_path / "killed" / "train.jsonl"
        while process.poll() is None and not (log.exists() and log.read_bytes().count(b"\n") >= episodes):
            time.sleep(0.01)
        assert process.poll() is None, "the run must still be training when it is killed"
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run([*command, "killed"], check=True, stdout=subprocess.DEVNULL)
    assert whole_rows == 30
    same_run(tmp_path / "whole", tmp_path / "killed")


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_stop_cleanly_and_say_how_to_go_on(number: int, code: int, demos: str, tmp_path: Path) -> None:
    words = (
        f"train {POINT_MASS} --demos {demos} --frames 1000000 --seed-frames 100 --agent.hidden 16 --reward.hidden 16 --out run"
    )
    process = subprocess.Popen([sys.executable, "-m", "pcil", *words.split()], stdout=subprocess.PIPE, text=True)
    log = tmp_path / "run" / "train.jsonl"
    while process.poll() is None and not (log.exists() and log.read_bytes().count(b"\n") >= 3):
        time.sleep(0.02)
    process.send_signal(number)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == code
    assert "same command goes on" in output
    assert list((tmp_path / "run" / "checkpoint").iterdir())


def test_a_finished_run_says_so_and_trains_no_more(demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos)
    finish(run, tmp_path / "run")
    before = {path: path.read_bytes() for path in (tmp_path / "run").glob("*.*")}
    result = runs.execute(run, tmp_path / "run")
    assert {path: path.read_bytes() for path in (tmp_path / "run").glob("*.*")} == before
    assert result.final_return == np.mean([float(row[2]) for row in rows(tmp_path / "run")[0][-2:]])


def test_a_kill_between_the_last_checkpoint_and_done_changes_nothing(demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos)
    finish(run, tmp_path / "run")
    before = rows(tmp_path / "run"), (tmp_path / "run" / "DONE").read_text()
    (tmp_path / "run" / "DONE").unlink()
    finish(run, tmp_path / "run")
    assert (rows(tmp_path / "run"), (tmp_path / "run" / "DONE").read_text()) == before


def without_policy(folder: Path) -> None:
    shutil.rmtree(folder / "policy")


def half_a_policy(folder: Path) -> None:
    (folder / "policy" / "policy.json").unlink()


def damaged_policy(folder: Path) -> None:
    path = folder / "policy" / "policy.safetensors"
    path.write_bytes(path.read_bytes()[:-5] + b"12345")


def another_digit_in_the_policy(folder: Path) -> None:
    path = folder / "policy" / "policy.json"
    path.write_text(path.read_text().replace('"seed": 1', '"seed": 7'))


def lost_rows(folder: Path) -> None:
    path = folder / "eval.csv"
    path.write_bytes(path.read_bytes()[:-20])


def no_log(folder: Path) -> None:
    (folder / "train.jsonl").unlink()


def another_return(folder: Path) -> None:
    (folder / "DONE").write_text('{"final_return": 1e9}')


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (without_policy, "holds no policy"),
        (half_a_policy, "holds no policy"),
        (damaged_policy, "is damaged"),
        (another_digit_in_the_policy, "policy.json is not what the run had written"),
        (lost_rows, "eval.csv is not what the run had written"),
        (no_log, "train.jsonl is not what the run had written"),
        (another_return, "DONE has another return than the last checkpoint"),
    ],
)
def test_a_finished_run_that_lost_a_part_is_whole_again(damage: Any, said: str, demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos)
    finish(run, tmp_path / "run")
    damage(tmp_path / "run")
    listener = StopAfter(-1)
    runs.execute(run, tmp_path / "run", [listener])
    assert said in " ".join(listener.said)
    finish(run, tmp_path / "whole")
    same_run(tmp_path / "whole", tmp_path / "run")
    assert (tmp_path / "run" / "DONE").read_text() == (tmp_path / "whole" / "DONE").read_text()
    for name in ("policy.json", "policy.safetensors"):
        assert (tmp_path / "run" / "policy" / name).read_bytes() == (tmp_path / "whole" / "policy" / name).read_bytes()
    finish(run, tmp_path / "run")


def test_a_done_that_comes_before_the_end_is_noticed(demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos)
    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "run", [StopAfter(5)])
    (tmp_path / "run" / "DONE").write_text('{"final_return": 1.0}')
    listener = StopAfter(-1)
    runs.execute(run, tmp_path / "run", [listener])
    assert "DONE is there, but the last whole checkpoint is at 250 frames; the run goes on." in " ".join(listener.said)
    finish(run, tmp_path / "whole")
    same_run(tmp_path / "whole", tmp_path / "run")


def test_a_finished_run_without_checkpoint_and_policy_is_refused(demos: str, tmp_path: Path) -> None:
    run, folder = small_run(demos=demos), tmp_path / "run"
    finish(run, folder)
    shutil.rmtree(folder / "checkpoint")
    finish(run, folder)  # the policy alone is enough
    shutil.rmtree(folder / "policy")
    with pytest.raises(InputError, match=r"holds no policy .*, and no checkpoint has it; delete .*DONE to train it again"):
        runs.execute(run, folder)


def test_a_run_whose_checkpoint_has_only_the_lengths_of_its_logs_goes_on(demos: str, tmp_path: Path) -> None:
    """As in checkpoints of versions that did not store the logs."""
    run = small_run(demos=demos)
    finish(run, tmp_path / "whole")
    for name, size in (("old", 10**6), ("short", 30)):
        with pytest.raises(loop.Stopped):
            runs.execute(run, tmp_path / name, [StopAfter(4)])
        arrays, meta, _ = checkpoint.restore(tmp_path / name / "checkpoint")
        assert arrays is not None
        meta["positions"] = {file: len(text) for file, text in meta.pop("logs").items()}
        checkpoint.save(tmp_path / name / "checkpoint", meta["counters"]["frames"], arrays, meta)
        log = tmp_path / name / "eval.csv"
        log.write_bytes(log.read_bytes()[:size])
        listener = StopAfter(-1)
        runs.execute(run, tmp_path / name, [listener])
        lost = [text for text in listener.said if "has lost" in text]
        assert bool(lost) == (name == "short")
    same_run(tmp_path / "whole", tmp_path / "old")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"seed": 2}, "seed was 1, now 2"),
        ({"frames": 250}, "frames was 300, now 250"),
        ({"agent": "gamma"}, "agent.gamma was 0.99, now 0.9"),
        ({"num_demos": 2}, "num_demos was None, now 2"),
    ],
)
def test_a_changed_setting_is_refused_with_the_difference(
    change: dict[str, Any], said: str, demos: str, tmp_path: Path
) -> None:
    run = small_run(demos=demos)
    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "run", [StopAfter(1)])
    if change == {"agent": "gamma"}:
        change = {"agent": dataclasses.replace(run.agent, gamma=0.9)}
    with pytest.raises(InputError, match=said):
        runs.execute(dataclasses.replace(run, **change), tmp_path / "run")


def test_a_run_of_before_a_setting_was_there_goes_on(demos: str, tmp_path: Path) -> None:
    run, folder = small_run(demos=demos), tmp_path / "run"
    with pytest.raises(loop.Stopped):
        runs.execute(run, folder, [StopAfter(1)])
    about = json.loads((folder / "run.json").read_text())
    assert about["run"]["agent"].pop("noise_correlation") == 0.0
    (folder / "run.json").write_text(json.dumps(about))
    other = dataclasses.replace(run, agent=dataclasses.replace(run.agent, noise_correlation=0.5))
    with pytest.raises(InputError, match=r"another run: agent.noise_correlation was 0.0, now 0.5; "):
        runs.execute(other, folder)
    runs.execute(run, folder)
    assert (folder / "DONE").exists()


def test_how_often_to_save_may_change(demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos)
    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "run", [StopAfter(1)])
    runs.execute(dataclasses.replace(run, checkpoint_seconds=1.0), tmp_path / "run")
    assert (tmp_path / "run" / "DONE").exists()


def test_other_demonstrations_under_the_same_name_are_refused(tmp_path: Path) -> None:
    path = save_point_mass_demos(tmp_path, episodes=2)
    run = small_run(demos=path)
    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "run", [StopAfter(1)])
    Path(path).rename(tmp_path / "old")
    save_point_mass_demos(tmp_path, episodes=3)
    with pytest.raises(InputError, match=r"demos.hash was"):
        runs.execute(run, tmp_path / "run")


def test_folders_that_cannot_be_used_are_refused(demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="can't be written"):
        runs.execute(run, tmp_path / "file")
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match=r"holds something else \(thesis.tex\)"):
        runs.execute(run, tmp_path / "full")
    (tmp_path / "odd").mkdir()
    (tmp_path / "odd" / "run.json").write_text("[]")
    with pytest.raises(InputError, match="can't be read"):
        runs.execute(run, tmp_path / "odd")
    assert [path.read_text() for path in (tmp_path / "full").iterdir()] == ["mine"]


def test_two_processes_never_share_a_folder(demos: str, tmp_path: Path) -> None:
    class Intruder(Callback):
        """Starts the same run inside the run."""

        def stop(self) -> bool:
            with pytest.raises(InputError, match="Another process is training"):
                runs.execute(small_run(demos=demos), tmp_path / "run")
            return True

    with pytest.raises(loop.Stopped):
        runs.execute(small_run(demos=demos), tmp_path / "run", [Intruder()])


def test_a_full_disk_stops_the_run_and_keeps_the_last_checkpoint(
    demos: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = small_run(demos=demos, checkpoint_seconds=0.0)
    finish(run, tmp_path / "whole")
    save, left = checkpoint.save, [2]

    def save_until_full(*arguments: Any) -> None:
        if not left[0]:
            raise OSError(28, os.strerror(28))
        left[0] -= 1
        save(*arguments)

    monkeypatch.setattr(checkpoint, "save", save_until_full)
    with pytest.raises(InputError, match="disk is full"):
        runs.execute(run, tmp_path / "full")
    monkeypatch.undo()
    finish(run, tmp_path / "full")
    same_run(tmp_path / "whole", tmp_path / "full")


def test_updates_come_when_they_are_due(demos: str, tmp_path: Path) -> None:
    """300 steps: no updates in the first 100, then one every fourth step."""
    finish(small_run(demos=demos, update_every=4), tmp_path / "run")
    _, lines = rows(tmp_path / "run")
    assert [line["updates"] for line in lines] == [0, 0, 13, 25, 38, 50]
    assert "agent/critic_loss" not in lines[1] and np.isfinite(lines[2]["agent/critic_loss"])


def test_evaluations_come_when_they_are_due(demos: str, tmp_path: Path) -> None:
    finish(small_run(demos=demos), tmp_path / "run")
    table, _ = rows(tmp_path / "run")
    assert [row[0] for row in table[1:]] == ["0", "0", "100", "100", "200", "200", "300", "300"]


def _update_once(label: str, task_reward: float) -> Any:
    """The agent's part after one update on a fixed window whose stored rewards are all `task_reward`."""
    run = small_run(label=label)
    spec, demos, n = Spec(2, 2, 1), random_batch(50, 2, 2), run.agent.n_step
    state = learner.init(run.learner, spec, [demos], 0)
    window = windows(random_batch(32 + n, 2, 2, seed=1), n)
    window = window._replace(reward=np.full_like(window.reward, task_reward))
    expert = windows(random_batch(33, 2, 2))
    state, _ = learner.update(run.learner, state, window, expert, None, np.int32(0), np.int32(0))
    return np.asarray(state.agent.critic.heads[0].weights[0])


def test_sampled_labels_replace_what_is_stored_and_stored_ones_do_not() -> None:
    assert np.array_equal(_update_once("sampled", 0.0), _update_once("sampled", 5.0))
    assert not np.array_equal(_update_once("stored", 0.0), _update_once("stored", 5.0))


def test_the_actor_that_update_returns_outlives_the_next_update() -> None:
    """The learner is overwritten in place; the actor in use must not be."""
    run = small_run("expert")
    state = learner.init(run.learner, Spec(2, 2, 1), (), 0)
    window = windows(random_batch(35, 2, 2), 3)
    state, actor = learner.update(run.learner, state, window, None, None, np.int32(0), np.int32(0))
    host = learner.on_host(actor)
    before = host.head.weights[0].copy()
    assert np.array_equal(before, state.agent.actor.head.weights[0])
    state, newer = learner.update(run.learner, state, window, None, None, np.int32(1), np.int32(1))
    assert np.array_equal(host.head.weights[0], before)
    assert not np.array_equal(learner.on_host(newer).head.weights[0], before)


@pytest.mark.slow
def test_pcil_learns_to_walk_from_demonstrations(tmp_path: Path) -> None:
    """After 40k frames with the default preset, it is better than the untrained policy from every start (sign test: 2^-10)."""
    run = presets.make("walker_walk", frames=40_000, evaluate_every=40_000)
    finish(run, tmp_path / "run")
    table, _ = rows(tmp_path / "run")
    first, last = ([float(row[2]) for row in table[1:] if row[0] == frames] for frames in ("0", "40000"))
    assert len(first) == len(last) == 10
    assert all(after > before for before, after in zip(first, last, strict=True))


class Reused(gymnasium.Env):
    """Counts its steps in one array that it always returns; truncated after four."""

    observation_space = gymnasium.spaces.Box(0, 9, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self._obs = np.zeros(1, np.float32)
        return self._obs, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._obs += 1
        return self._obs, 0.0, False, False, {}


@pytest.fixture
def reused() -> Iterator[str]:
    gymnasium.register("pcil_test/reused-v0", Reused, max_episode_steps=4)
    yield "pcil_test/reused-v0"
    del gymnasium.registry["pcil_test/reused-v0"]


def test_an_episode_holds_each_observation_although_the_environment_reuses_its_buffer(reused: str) -> None:
    run, env = small_run("expert", reused), envs.make(reused)
    (episode,) = collect.play(run, [env], envs.spec(env), start(run, envs.spec(env), ()))
    assert episode.obs.tolist() == [[0], [1], [2], [3], [4]]


def test_episodes_too_short_for_a_window_are_refused_when_updates_are_due(reused: str, tmp_path: Path) -> None:
    agent = dataclasses.replace(small_run("expert").agent, n_step=5)
    with pytest.raises(InputError, match=r"Every episode of pcil_test/reused-v0 so far is cut before the 5 steps"):
        runs.execute(small_run("expert", reused, agent=agent), tmp_path / "run")
    assert [line["frames"] for line in rows(tmp_path / "run")[1]][-1] == 96, "refused at the first episode after 100 frames"


def test_demonstrations_too_short_for_a_window_are_refused(demos: str, tmp_path: Path) -> None:
    run = small_run("tcn", demos=demos, reward={"negatives": "rollout", "margin": 30})
    with pytest.raises(InputError, match="are all shorter than the 60 steps that an update draws"):
        runs.execute(run, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("rows", [60, 1000])
def test_prefill_counts_the_steps_that_went_in_and_pays_them_alpha(rows: int, demos: str) -> None:
    """At least 120 steps are three demonstrations of 50; a replay of 60 rows keeps the last of them."""
    run = small_run("pwil", demos=demos, replay_steps=rows, reward={"prefill_steps": 120, "alpha": 3.0, "task_weight": 0.5})
    spec, episodes = envs.spec(envs.make(run.task)), runs.demonstrations(run).episodes
    held = start(run, spec, episodes).replay.state()
    assert held["segments"][:, 3].tolist() == ([2] if rows == 60 else [0, 1, 2])
    assert np.allclose(held["reward"][-51:-1], 3 + 0.5 * episodes[2].reward)


def test_pwil_pays_alpha_for_every_step_of_a_copy_of_the_only_demonstration(demos: str) -> None:
    """The same states of each step are compared for expert and agent."""
    run = small_run("pwil", demos=demos, num_demos=1, reward={"alpha": 3.0})
    (copy,) = runs.demonstrations(run).episodes
    state = start(run, envs.spec(envs.make(run.task)), [copy])
    assert np.allclose(learner.label_episode(run.learner, state.learner, copy, 0), 3)


def test_without_a_whole_checkpoint_the_run_begins_again_and_says_so(demos: str, tmp_path: Path) -> None:
    run = small_run(demos=demos)
    finish(run, tmp_path / "whole")
    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "lost", [StopAfter(3)])
    shutil.rmtree(tmp_path / "lost" / "checkpoint")
    listener = StopAfter(-1)
    runs.execute(run, tmp_path / "lost", [listener])
    assert any("no whole checkpoint" in text and "begins again" in text for text in listener.said)
    same_run(tmp_path / "whole", tmp_path / "lost")


def test_a_run_of_an_older_version_resumes_exactly(demos: str, tmp_path: Path) -> None:
    """Its arrays and settings had other names, its classes were named by their paths, and its reward stored only states."""
    run, folder = small_run(demos=demos), tmp_path / "older"
    finish(run, tmp_path / "whole")
    with pytest.raises(loop.Stopped):
        runs.execute(run, folder, [StopAfter(4)])
    arrays, meta, _ = checkpoint.restore(folder / "checkpoint")
    assert arrays is not None
    older = {name: array for name, array in arrays.items() if not name.endswith((".reference.obs", ".reference.action"))}
    older = {
        name.replace("opt_state", "moments").replace(".reference.next_obs", ".reference"): array
        for name, array in older.items()
    }
    assert "learner.reward.reference" in older and any("moments" in name for name in older)
    checkpoint.save(folder / "checkpoint", meta["counters"]["frames"], older, meta)
    about = json.loads((folder / "run.json").read_text())
    settings = about["run"]
    settings["agent"]["standardise"] = settings["agent"].pop("normalize_observations")
    settings["agent"]["class"], settings["reward"]["class"] = "pcil.agents.drqv2:DrQV2", "pcil.rewards.pcil:PCIL"
    del settings["num_envs"], settings["reward"]["inputs"]
    (folder / "run.json").write_text(json.dumps(about))
    told = StopAfter(-1)
    runs.execute(run, folder, [told])
    assert "Resuming at 200 of 300 frames." in told.said
    same_run(tmp_path / "whole", folder)


def test_a_checkpoint_of_other_shapes_is_refused(demos: str, tmp_path: Path) -> None:
    """As a checkpoint of another version would be."""
    run, folder = small_run(demos=demos), tmp_path / "run"
    with pytest.raises(loop.Stopped):
        runs.execute(run, folder, [StopAfter(1)])
    other = dataclasses.replace(run, agent=dataclasses.replace(run.agent, hidden=24, absorbing=False, cloning=True))
    about = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(about | {"run": other.to_json()}))
    before = (folder / "train.jsonl").read_bytes()
    with pytest.raises(InputError, match=r"of another version \(learner.agent.*24"):
        runs.execute(other, folder)
    assert (folder / "train.jsonl").read_bytes() == before


def test_a_replay_smaller_than_an_episode_is_refused_before_anything_is_written(reused: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has 4 rows, and an episode of pcil_test/reused-v0 may take 5"):
        runs.execute(small_run("expert", reused, replay_steps=4), tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("stops", [(), (1, 2)])
def test_a_run_ends_when_two_evaluations_in_a_row_reach_the_share(
    stops: tuple[int, ...], demos: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At 95% of 10, the third and fourth of these evaluations are the first two in a row that are good enough."""
    shares = iter([0.96, 0.94, 0.95, 2.0, 0.1, 0.1, 0.1])
    demos_return = Demonstrations.load(demos).return_mean
    assert demos_return is not None and demos_return > 0

    def evaluated(*_: Any, episodes: int, **__: Any) -> Evaluation:
        return Evaluation(np.full(episodes, next(shares) * demos_return), np.full(episodes, 50), 0.0)

    monkeypatch.setattr(loop, "evaluate", evaluated)
    run = small_run(demos=demos, until=0.95, frames=600)
    stop = StopAfter(-1)
    for episodes in stops:
        with pytest.raises(loop.Stopped):
            runs.execute(run, tmp_path, [StopAfter(episodes)])
    result = runs.execute(run, tmp_path, [stop])
    assert result.final_return == pytest.approx(2 * demos_return)
    assert [row[0] for row in rows(tmp_path)[0][1::2]] == ["0", "100", "200", "300"]
    assert rows(tmp_path)[1][-1]["frames"] == 300
    assert "Two evaluations in a row reached 95% of the demonstrations' mean return." in stop.said
    assert load_policy(tmp_path).info["frames"] == 300
    assert runs.execute(run, tmp_path) == result


def test_until_changes_nothing_of_a_run_before_it_ends(demos: str, tmp_path: Path) -> None:
    finish(small_run(demos=demos), tmp_path / "plain")
    finish(small_run(demos=demos, until=1e6), tmp_path / "until")
    assert rows(tmp_path / "plain") == rows(tmp_path / "until")


def test_until_needs_demonstrations_of_positive_return(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"--until is a share of the demonstrations' mean return, .* but expert needs none"):
        runs.execute(small_run("expert", until=0.9), tmp_path / "run")
    assert not (tmp_path / "run" / "run.json").exists()
