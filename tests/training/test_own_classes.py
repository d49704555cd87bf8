"""A user's own classes, outside the package: agents, actors and callbacks, from Python and from the command line."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pcil
from pcil import cli, modules
from pcil.errors import InputError, RunError
from pcil.training.callbacks import Callback, Callbacks, History
from pcil.training.config import Run, run_of_file
from pcil.training.loggers import TensorBoard
from small import POINT_MASS, save_point_mass_demos, small_run

NETS = """
import equinox as eqx, jax, jax.numpy as jnp

class Linear(eqx.Module):
    weight: jax.Array

    def __call__(self, obs, xp=jnp):
        return xp.tanh(obs @ self.weight)

    @classmethod
    def from_arrays(cls, arrays):
        return cls(arrays["weight"])
"""
AGENT = """
from dataclasses import dataclass
from typing import ClassVar
import jax, jax.numpy as jnp, numpy as np
from own_nets import Linear
from pcil import Agent, Callback

@dataclass(frozen=True)
class Cloning(Agent):
    offline: ClassVar[bool] = True
    n_step: int = 1
    learning_rate: float = 0.1

    def init(self, spec, *, key):
        return Linear(jnp.zeros((spec.obs_dim, spec.action_dim)))

    def update(self, state, window, *, step, key):
        loss, slope = jax.value_and_grad(lambda a: jnp.mean((a(window.obs[:, 0]) - window.action[:, 0]) ** 2))(state)
        return jax.tree.map(lambda w, g: w - self.learning_rate * g, state, slope), {"loss": loss}

    def actor(self, state):
        return state

    def trunk(self, state, whose):
        return jax.tree_util.Partial(lambda obs: obs)

    def explorer(self, action_dim, rng):
        return lambda actor, obs, step: actor(obs, np)

class Abstract(Agent):
    pass

class Log(Callback):
    lines = []

    def evaluation(self, frames, seconds, result):
        self.lines.append(frames)

class Second(Log):
    lines = []

class Picky(Callback):
    def __init__(self, path):
        self.path = path
"""


MUTE = NETS.replace('    @classmethod\n    def from_arrays(cls, arrays):\n        return cls(arrays["weight"])\n', "")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two modules of a user, and demonstrations."""
    folder = tmp_path_factory.mktemp("home")
    (folder / "own_nets.py").write_text(NETS)
    (folder / "own_agent.py").write_text(AGENT)
    save_point_mass_demos(folder)
    return folder


@pytest.fixture(autouse=True)
def in_home(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(home))
    monkeypatch.chdir(home)


def words(out: Path, *more: str) -> list[str]:
    given = f"train {POINT_MASS} --method bc --agent own_agent:Cloning --demos point_mass-v0 --frames 300 --evaluate-every 200"
    return [*given.split(), "--evaluate-episodes", "2", "--out", str(out), *more]


def test_several_loggers_are_told_and_none_of_their_names_is_taken_for_the_task(tmp_path: Path) -> None:
    assert cli.main(words(tmp_path / "run", "--callbacks", "own_agent:Log", "own_agent:Second")) == 0
    own: Any = sys.modules["own_agent"]
    assert own.Log.lines == own.Second.lines == [0, 500]
    assert json.loads((tmp_path / "run" / "run.json").read_text())["run"]["task"] == POINT_MASS


def test_an_actor_of_another_module_than_its_agent_makes_no_finished_run_look_damaged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words(tmp_path / "run")) == 0
    before = (tmp_path / "run" / "DONE").stat().st_mtime_ns
    capsys.readouterr()
    assert cli.main(words(tmp_path / "run")) == 0
    assert (tmp_path / "run" / "DONE").stat().st_mtime_ns == before
    assert "names code" not in capsys.readouterr().out
    result = pcil.train(
        POINT_MASS, method="bc", agent="own_agent:Cloning", demos="point_mass-v0", frames=300, evaluate_every=200,
        evaluate_episodes=2, out=tmp_path / "run",
    )  # fmt: skip
    assert set(result.own_modules) == {"own_agent", "own_nets"}
    assert result.policy(np.zeros(2, np.float32)).shape == (2,)


def test_settings_of_a_file_train_the_same_run_where_its_module_is_trusted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words(tmp_path / "first")) == 0
    again = ["train", "--settings", str(tmp_path / "first" / "run.json"), "--out", str(tmp_path / "second")]
    assert cli.main(again) == 2 and "--trust own_agent" in capsys.readouterr().err
    assert cli.main([*again, "--trust", "own_agent", "--callbacks", "own_agent:Log"]) == 0
    arrays = [(tmp_path / name / "policy" / "policy.safetensors").read_bytes() for name in ("first", "second")]
    assert arrays[0] == arrays[1]


def test_a_file_that_names_our_own_classes_by_their_paths_needs_no_trust() -> None:
    run = small_run("bc")
    settings = run.to_json()
    settings["agent"]["class"] = "pcil.agents.bc:BC"
    assert run_of_file("old.json", settings, ()) == Run.from_json(run.to_json())


def test_an_actor_that_could_not_be_loaded_again_is_refused_before_anything_is_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "mute_nets.py").write_text(MUTE)
    (tmp_path / "mute_agent.py").write_text(AGENT.replace("own_nets", "mute_nets"))
    argv = [word.replace("own_agent", "mute_agent") for word in words(tmp_path / "run")]
    assert cli.main(argv) == 2
    assert "needs a class method from_arrays" in capsys.readouterr().err
    assert not (tmp_path / "run" / "policy" / "policy.json").exists()


@pytest.mark.parametrize("changes", [{"task": 5}, {"info": []}, {"info": {"env_kwargs": 3}}, {"format": "x"}, {"sizes": [2]}])
def test_the_header_of_a_policy_of_ones_own_is_checked_like_any_other(changes: dict[str, Any], tmp_path: Path) -> None:
    assert cli.main(words(tmp_path / "run")) == 0
    path = tmp_path / "run" / "policy" / "policy.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
    with pytest.raises(InputError, match="is damaged"):
        pcil.load_policy(tmp_path / "run", ["own_nets"])


def test_an_agent_of_the_package_may_have_an_actor_of_its_own_and_needs_no_trust() -> None:
    assert modules.of_class("pcil.agents.linear:Linear") == []
    assert modules.of_class("pcil_agents:Linear") == ["pcil_agents"]


REFUSED = {
    "--agent own_agent:Abstract": "own_agent:Abstract can't be created without arguments .*abstract method",
    "--callbacks own_agent:Picky": "own_agent:Picky can't be created without arguments .*'path'",
    "--callbacks own_agent:Cloning": "no subclass of pcil.Callback",
}


@pytest.mark.parametrize("option", REFUSED)
def test_a_class_that_can_not_be_created_is_one_sentence(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words(tmp_path / "run", *option.split())) == 2
    assert re.search(REFUSED[option], capsys.readouterr().err)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("callbacks", [[Callback], Callback(), [3], "own_agent:Log"])
def test_callbacks_must_be_a_list_of_callbacks(callbacks: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="must be a list of objects of subclasses of pcil"):
        pcil.train(POINT_MASS, callbacks=callbacks, out=tmp_path / "run")


class Recorder(Callback):
    """Records its calls, and raises on request."""

    def __init__(self, log: list[str], name: str, raises: str = "") -> None:
        self.log, self.name, self.raises = log, name, raises

    def begin(self, run: Run, folder: Path, history: History) -> None:
        self._note("begin")

    def end(self) -> None:
        self._note("end")

    def _note(self, what: str) -> None:
        self.log.append(f"{what} {self.name}")
        if what == self.raises:
            raise OSError(28, "No space left on device")


def test_every_callback_that_has_begun_ends_whatever_another_one_raises(tmp_path: Path) -> None:
    log: list[str] = []
    told = Callbacks([Recorder(log, "a", raises="end"), Recorder(log, "b")])
    told.begin(small_run(), tmp_path, History([], [], 0.0, None))
    with pytest.raises(RunError, match="Recorder raised OSError"):
        told.end()
    assert log == ["begin a", "begin b", "end a", "end b"]


def test_a_callback_that_could_not_begin_is_not_ended(tmp_path: Path) -> None:
    log: list[str] = []
    told = Callbacks([Recorder(log, "a"), Recorder(log, "b", raises="begin"), TensorBoard()])
    with pytest.raises(RunError, match="Recorder raised OSError"):
        told.begin(small_run(), tmp_path, History([], [], 0.0, None))
    told.end()
    assert log == ["begin a", "begin b", "end a"]
