"""Runs that fail: their files, their messages, and resuming them; and the closing of environments."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import gymnasium
import jax
import numpy as np
import pytest
from test_loop import StopAfter, finish, rows, same_run

import pcil
from odd import Odd, raising
from pcil import cli, demos, envs
from pcil.agents import DrQV2
from pcil.errors import InputError, RunError, check_kinds
from pcil.training import checkpoint, learner, loop, presets, runs
from pcil.training.callbacks import Callback
from pcil.training.config import Run
from pcil.types import Spec
from small import random_batch, small_run, windows

ID = "pcil_test/odd-v0"
NAN = float("nan")


class Flaky(Odd):
    """Has its mistake only while `broken`."""

    broken = True

    def _wrong(self, name: str, value: Any) -> Any:
        return super()._wrong(name, value) if self.broken else value


@pytest.fixture(autouse=True)
def all_are_closed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(Flaky, "broken", True)
    Odd.open_copies.clear()
    yield
    gymnasium.registry.pop(ID, None)
    assert not Odd.open_copies, "every environment must be closed"


def register(**wrong: Any) -> None:
    gymnasium.register(ID, Flaky, max_episode_steps=10, kwargs={"episode": 4, **wrong})


def odd_run(method: str = "expert", **changes: Any) -> Run:
    """Episodes of ten steps; updates start in the third one. Only training and evaluations play episodes."""
    settings = {"frames": 60, "seed_frames": 20, "random_frames": 20, "evaluate_every": 30, "keep_best": False}
    return small_run(method, ID, **{**settings, **changes})


def arrays(folder: Path) -> dict[str, np.ndarray]:
    held = checkpoint.restore(folder / "checkpoint")[0]
    assert held is not None
    return held


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"step": raising(RuntimeError("the motor driver lost its connection"))}, r"RuntimeError \(the motor driver"),
        ({"obs": np.array([NAN, 0.0])}, "an observation whose entry 0 is nan"),
        ({"reward": NAN}, "a reward that is nan"),
    ],
)
def test_a_failure_in_mid_episode_keeps_the_episodes_before_and_the_same_command_goes_on(
    wrong: dict[str, Any], said: str, tmp_path: Path
) -> None:
    register(**wrong)
    folder = tmp_path / "run"
    with pytest.raises(RunError, match=rf"'{ID}' .*{said}.*, in step 3 of training episode 4 \(seed \d+\)") as error:
        runs.execute(odd_run(), folder)
    assert not (folder / "DONE").exists() and "learner.root" in arrays(folder)
    assert all(np.isfinite(array).all() for array in arrays(folder).values())
    assert (folder / "error.txt").exists() == (error.value.__cause__ is not None)
    if "step" in wrong:
        text = (folder / "error.txt").read_text()
        assert "Traceback" in text and "in raising" not in text and "the motor driver lost its connection" in text
        assert f"its traceback is in {folder / 'error.txt'}" in str(error.value)
    Flaky.broken = False
    listener = StopAfter(-1)
    runs.execute(odd_run(), folder, [listener])
    assert "Resuming at 30 of 60 frames." in listener.said and not (folder / "error.txt").exists()
    finish(odd_run(), tmp_path / "whole")
    same_run(tmp_path / "whole", folder)


def test_a_failure_in_an_evaluation_loses_nothing_either(tmp_path: Path) -> None:
    """The first of the two copies for evaluation plays its second episode at frame 30."""
    register(step=raising(OSError("the port is gone")), episode=2)
    with pytest.raises(RunError, match=r"OSError \(the port is gone\), in step 3 of training episode 2"):
        runs.execute(odd_run(), tmp_path / "training")
    gymnasium.registry.pop(ID)
    register(reset=raising(OSError("the port is gone")), episode=1)
    with pytest.raises(RunError, match=r"at the start of evaluation episode 1"):
        runs.execute(odd_run(), tmp_path / "run")
    assert [path.name for path in (tmp_path / "run" / "checkpoint").iterdir()] == ["0"]
    Flaky.broken = False
    runs.execute(odd_run(), tmp_path / "run")
    finish(odd_run(), tmp_path / "whole")
    same_run(tmp_path / "whole", tmp_path / "run")


def test_the_command_line_says_one_sentence_and_exits_with_1(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    register(step=raising(RuntimeError("the motor\nis hot")), episode=1)
    words = f"train {ID} --method expert --frames 60 --seed-frames 20 --random-frames 20 --evaluate-episodes 2 --out run"
    assert cli.main([*words.split(), "--agent.hidden", "16", "--agent.batch-size", "32", "--agent.feature-dim", "8"]) == 1
    out, err = capsys.readouterr()
    assert err.count("\n") == 1
    assert err.startswith(f"pcil: The environment '{ID}' raised RuntimeError (the motor is hot), in step 3")
    assert "Traceback" not in out + err
    Flaky.broken = False
    finish(odd_run(), tmp_path / "done")
    Flaky.broken = True
    for words in (
        f"evaluate {tmp_path / 'done'} --episodes 2",
        f"record {tmp_path / 'done'} --episodes 2 --out {tmp_path / 'data'}",
    ):
        assert cli.main(words.split()) == 1
        assert "raised RuntimeError (the motor is hot), in step 3 of" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


# --- Divergence ---


def updated(reward: list[float], label: str = "stored", obs: list[float] | None = None, **agent: Any) -> learner.Learner:
    """A learner after one update for each of these rewards, or for each factor of the observations."""
    run = small_run("pcil", label=label)
    run = dataclasses.replace(run, agent=dataclasses.replace(run.agent, **agent))
    n = run.agent.n_step
    state = learner.init(run.learner, Spec(2, 2, 1), [random_batch(50, 2, 2)], 0)
    for count, (pay, factor) in enumerate(zip(reward, obs or [1.0] * len(reward), strict=True)):
        window = windows(random_batch(32 + n, 2, 2, seed=count), n)
        window = window._replace(reward=np.full_like(window.reward, pay), obs=window.obs * np.float32(factor))
        step = np.int32(count)
        state, _ = learner.update(run.learner, state, window, windows(random_batch(33, 2, 2)), None, step, step)
    return state


def test_what_left_the_finite_range_first_is_named_with_its_update() -> None:
    assert learner.first_not_finite(updated([0.0, 1.0, 2.0])) is None
    assert learner.first_not_finite(updated([0.0, NAN, 0.0])) == ("the rewards of the batch", 1)
    assert learner.first_not_finite(updated([0.0, 0.0, 1e30, 0.0])) == ("agent/critic_loss", 2)
    what, update = learner.first_not_finite(updated([0.0, 0.0, 0.0], "sampled", obs=[1.0, 1.0, NAN])) or ("", -1)
    assert what.startswith("reward/") and "agent" not in what and update == 2


def test_parameters_are_named_where_every_loss_was_finite() -> None:
    state = updated([0.0, 0.0])
    bad = jax.tree_util.tree_map_with_path(
        lambda path, leaf: leaf.at[0].set(NAN) if "critic_target" in jax.tree_util.keystr(path) and leaf.ndim else leaf, state
    )
    what, update = learner.first_not_finite(bad) or ("", -1)
    assert what.startswith("the parameters agent.critic_target.") and update == 1


def no_value_is_missing(folder: Path) -> None:
    """Check that no file of a run contains a value that is not finite."""
    assert all(np.isfinite(array).all() for array in arrays(folder).values())
    text = (folder / "eval.csv").read_text() + (folder / "train.jsonl").read_text()
    assert not any(word in text for word in ("nan", "NaN", "inf", "Infinity")) and not (folder / "DONE").exists()
    assert np.isfinite(pcil.load_policy(folder)(np.zeros(2, np.float32))).all()


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("offline", [False, True])
def test_a_run_that_diverges_ends_with_one_sentence_and_keeps_what_was_whole(offline: bool, tmp_path: Path) -> None:
    """Rewards of 1e38, whose squares overflow in float32; offline, deviations that make the loss infinite."""
    register(episode=4, reward=1e38)
    run = odd_run("bc" if offline else "expert", frames=200, update_every=1)
    if offline:
        recorded = demos.record(lambda obs: np.ones(1), Odd(), 2, task=ID, seed=0, info={})
        Odd.open_copies[0].close()
        huge = [dataclasses.replace(episode, action=episode.action * np.float32(1e30)) for episode in recorded.episodes]
        with pytest.raises(RunError, match=f"training on {ID} diverged: agent/loss and agent/squared_error became .*update 1,"):
            loop.train_loop(dataclasses.replace(run, seed_frames=0), tmp_path, huge)
    else:
        with pytest.raises(RunError, match=rf"training on {ID} diverged: agent/critic_loss became .* in update \d+,"):
            runs.execute(run, tmp_path)
    no_value_is_missing(tmp_path)


def test_where_an_action_is_not_finite_the_parameters_that_went_first_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """An update makes the parameters NaN although its losses are finite."""
    register()
    update = DrQV2.update

    def broken(self: Any, state: Any, window: Any, *, step: Any, key: Any) -> Any:
        state, metrics = update(self, state, window, step=step, key=key)
        actor = jax.tree.map(lambda leaf: jax.numpy.where(step < 27, leaf, NAN), state.actor)
        return dataclasses.replace(state, actor=actor), metrics

    monkeypatch.setattr(DrQV2, "update", broken)
    run = odd_run(update_every=1)
    run = dataclasses.replace(run, agent=dataclasses.replace(run.agent, tau=0.0123))  # compiled only for this test
    with pytest.raises(RunError, match=r"the actor's parameters became .* in update 8, after frame 20;") as error:
        runs.execute(run, tmp_path)
    assert "an action whose entry 0 is nan, in step 9 of training episode 3" in str(error.value.__context__)
    no_value_is_missing(tmp_path)


def test_a_learned_reward_that_is_not_finite_is_not_stored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    register()
    label = learner.label_episode
    monkeypatch.setattr(learner, "label_episode", lambda *given: np.where(np.arange(10) == 6, np.inf, label(*given)))
    with pytest.raises(RunError, match=rf"The learned reward is inf in step 7 of training episode 1 of {ID}"):
        runs.execute(odd_run(label="stored"), tmp_path / "run")
    no_value_is_missing(tmp_path / "run")


def test_a_checkpoint_of_before_there_was_a_record_of_what_is_finite_goes_on(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    Flaky.broken = False
    register()
    finish(odd_run(), tmp_path / "whole")
    flatten = checkpoint.flatten

    def without(name: str, tree: Any) -> Any:
        return {path: array for path, array in flatten(name, tree).items() if path != "learner.totals['finite']"}

    with monkeypatch.context() as patch, pytest.raises(loop.Stopped):
        patch.setattr(checkpoint, "flatten", without)
        runs.execute(odd_run(), tmp_path / "old", [StopAfter(4)])
    assert "learner.totals['finite']" not in arrays(tmp_path / "old")
    finish(odd_run(), tmp_path / "old")
    same_run(tmp_path / "whole", tmp_path / "old")


# --- One environment ---


def test_a_single_environment_changes_no_result(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    Flaky.broken = False
    register()
    finish(odd_run(evaluate_episodes=5), tmp_path / "many")
    monkeypatch.setattr(Odd, "once", True)
    with pytest.raises(InputError, match=r"can't be made \(AssertionError: this environment can be open once only\)"):
        runs.execute(odd_run(evaluate_episodes=5), tmp_path / "refused")
    single = odd_run(evaluate_episodes=5, single_environment=True)
    finish(single, tmp_path / "single", stops=(3,))
    same_run(tmp_path / "many", tmp_path / "single")
    runs.execute(odd_run(evaluate_episodes=5), tmp_path / "single")  # single_environment is a machine setting


def test_evaluation_in_a_single_environment_gives_the_same_numbers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    Flaky.broken = False
    register()
    finish(odd_run(), tmp_path / "run")
    assert cli.main(["evaluate", str(tmp_path / "run"), "--episodes", "35", "--json"]) == 0
    together = json.loads(capsys.readouterr().out)
    monkeypatch.setattr(Odd, "once", True)
    assert cli.main(["evaluate", str(tmp_path / "run"), "--episodes", "35", "--single-environment", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == together and len(set(together["returns"])) > 30
    assert cli.main(["record", str(tmp_path / "run"), "--episodes", "2", "--out", str(tmp_path / "data")]) == 0


# --- In Python ---

SMALL = {"method": "expert", "frames": 60, "seed_frames": 20, "random_frames": 20, "evaluate_every": 30, "evaluate_episodes": 2}
SMALL |= {f"agent.{name}": value for name, value in {"hidden": 16, "batch_size": 32, "feature_dim": 8}.items()}


def make_env() -> gymnasium.Env:
    return gymnasium.wrappers.TimeLimit(Odd(at=0), 10)


def test_a_function_or_an_environment_is_trained_in_and_named_in_run_json(tmp_path: Path) -> None:
    result = pcil.train(make_env, out=tmp_path / "function", **SMALL)
    mine = make_env()
    pcil.train(mine, out=tmp_path / "object", **SMALL)
    assert [mine.unwrapped] == Odd.open_copies, "its owner closes it"
    mine.close()
    assert np.isfinite(result.final_return) and rows(tmp_path / "function") == rows(tmp_path / "object")
    names = [json.loads((tmp_path / name / "run.json").read_text())["run"]["task"] for name in ("function", "object")]
    assert names == ["function test_failures.make_env", "object odd.Odd"]
    assert pcil.train(make_env, out=tmp_path / "function", **SMALL).final_return == result.final_return
    with pytest.raises(InputError, match="was given in Python"):
        runs.execute(presets.make(names[0], **SMALL), tmp_path / "function")


def test_a_function_that_returns_the_same_environment_twice_is_refused(tmp_path: Path) -> None:
    mine = make_env()
    mine.unwrapped.close = lambda: None
    with pytest.raises(InputError, match="returned the same environment twice"):
        pcil.train(lambda: mine, out=tmp_path / "run", **SMALL)
    Odd.open_copies.clear()


def test_demonstrations_may_be_given_as_they_are_or_by_path(tmp_path: Path) -> None:
    env = envs.make(make_env)
    recorded = demos.record(lambda obs: np.ones(1), env, 2, task="odd", seed=0, info={})
    env.close()
    path = recorded.save(tmp_path / "data")
    changes = {**SMALL, "method": "bc", "seed_frames": 0}
    given = pcil.train(make_env, demos=recorded, out=tmp_path / "given", **changes)
    by_path = pcil.train(make_env, demos=path, out=tmp_path / "path", **changes)
    assert given.final_return == by_path.final_return and given.demos_return == recorded.return_mean
    about = json.loads((tmp_path / "given" / "run.json").read_text())
    assert about["run"]["demos"] == "an object of class pcil.demos.Demonstrations" and about["demos"]["hash"] == recorded.hash
    again = pcil.train(make_env, demos=path.rename(tmp_path / "path_of_it"), out=tmp_path / "given", **changes)
    assert again.final_return == given.final_return, "they are known by what they hold"


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"task": np.zeros(10**6)}, r"The task is an array of shape \(1000000,\)"),
        ({"task": None}, "The task is None; it must be a name, a function"),
        ({"demos": np.zeros(10**6)}, r"demos is an array of shape \(1000000,\) and dtype float64; it must be a shipped task"),
        ({"demos": [np.zeros(10**6)] * 99}, r"demos is \[array"),
        ({"out": None}, "out is None; it must be the path of a folder"),
        ({"method": np.zeros(10**6)}, r"There is no method an array of shape"),
    ],
)
def test_anything_else_is_one_short_sentence(given: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said) as error:
        pcil.train(**{"task": "walker_walk", "out": tmp_path / "run", **given})
    assert len(str(error.value)) < 250 and not (tmp_path / "run").exists()


@dataclasses.dataclass
class Settings:
    """Fields of each kind."""

    text: str = ""
    number: int = 0
    word: Literal["a", "b"] = "a"
    path: Path | None = None


@pytest.mark.parametrize(
    ("field", "value", "said"),
    [
        (
            "number",
            np.zeros(10**6),
            r"is an array of shape \(1000000,\) and dtype float64; it must be a whole",
        ),
        ("word", np.zeros(10**6), r"Settings.word is an array of shape \(1000000,\)"),
        ("text", {"a": np.zeros(10**6)}, r"Settings.text is \{'a': array"),
        ("number", "9" * 10**6, "Settings.number is '9999"),
        ("path", Path, "Settings.path is an object of class builtins.type; it must be of class Path or None"),
    ],
)
def test_settings_of_another_kind_are_shown_shortened(field: str, value: Any, said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        check_kinds(dataclasses.replace(Settings(), **{field: value}))
    assert len(str(error.value)) < 150


class CtrlC(Callback):
    """Presses Ctrl-C at the end of the second episode."""

    episodes = 0

    def episode(self, row: dict[str, Any]) -> None:
        self.episodes += 1
        if self.episodes == 2:
            os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_in_python_saves_the_run_and_raises(tmp_path: Path) -> None:
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        pcil.train(make_env, out=tmp_path / "run", callbacks=[CtrlC()], **SMALL)
    assert signal.getsignal(signal.SIGINT) is before
    assert [path.name for path in (tmp_path / "run" / "checkpoint").iterdir()] == ["20"]
    pcil.train(make_env, out=tmp_path / "run", **SMALL)
    pcil.train(make_env, out=tmp_path / "whole", **SMALL)
    same_run(tmp_path / "whole", tmp_path / "run")


def test_a_second_ctrl_c_stops_at_once(tmp_path: Path) -> None:
    class Twice(CtrlC):
        """Presses Ctrl-C again at once."""

        def episode(self, row: dict[str, Any]) -> None:
            super().episode(row)
            super().episode(row)
            os.kill(os.getpid(), signal.SIGINT)
            raise AssertionError("the second one was not heard")

    with pytest.raises(KeyboardInterrupt):
        pcil.train(make_env, out=tmp_path / "run", callbacks=[Twice()], **SMALL)
    assert not (tmp_path / "run" / "checkpoint").exists()


def test_in_another_thread_no_handler_is_installed(tmp_path: Path) -> None:
    results: list[Any] = []
    thread = threading.Thread(target=lambda: results.append(pcil.train(make_env, out=tmp_path / "run", **SMALL)))
    thread.start()
    thread.join()
    assert len(results) == 1 and np.isfinite(results[0].final_return)
