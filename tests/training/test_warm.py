"""Warm starts: which networks start from an earlier run, and that they are the same functions."""

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from test_loop import StopAfter, finish, rows, same_run

from pcil.errors import InputError
from pcil.policy import load_policy
from pcil.training import checkpoint, loop, runs, state, warm
from pcil.training.config import Run, changed
from pcil.types import Spec
from small import save_point_mass_demos
from small import small_run as default_run

SPEC = Spec(2, 2, 1)


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> str:
    return save_point_mass_demos(tmp_path_factory.mktemp("demos"))


def small_run(method: str = "pcil", **changes: Any) -> Run:
    """A small run that evaluates the actor itself; `default` evaluates its average."""
    run = default_run(method, **changes)
    return changed(run, {"agent.averaging_rate": 1.0} if method != "bc" else {})


@pytest.fixture(scope="module")
def earlier(demos: str, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The folders of finished runs, and of a policy alone."""
    place, bc = tmp_path_factory.mktemp("earlier"), {"seed_frames": 0, "frames": 500, "evaluate_every": 1000}
    settings: dict[str, tuple[Run, dict[str, Any]]] = {
        "pcil": (small_run(demos=demos), {}),
        "raw": (small_run(demos=demos), {"agent.normalize_observations": False}),
        "bc": (small_run("bc", demos=demos, **bc), {"agent.normalize_observations": True}),
        "wide": (small_run(demos=demos), {"agent.hidden": 24}),
        "averaged": (small_run(demos=demos), {"agent.averaging_rate": 0.1}),
    }
    for name, (run, changes) in settings.items():
        finish(changed(run, changes), place / name)
    shutil.copytree(place / "pcil" / "policy", place / "policy")
    return {path.name: path for path in place.iterdir()}


def start(run: Run, demos: str, said: list[str] | None = None) -> state.State:
    """The state of a run before its first step."""
    run, found, _ = runs.prepared(run)
    assert found is not None
    return warm.started(run, state.start(run, SPEC, found.episodes), (said if said is not None else []).append)


OBS = np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32)


@pytest.mark.parametrize("source", ["pcil", "policy", "bc", "raw", "averaged"])
@pytest.mark.parametrize("changes", [{}, {"agent.absorbing": True}, {"agent.averaging_rate": 0.1}])
def test_the_actor_is_the_earlier_function(source: str, changes: dict[str, Any], earlier: dict[str, Path], demos: str) -> None:
    """The one that explores and the one that is evaluated, also with an absorbing state, of which the earlier run had none."""
    run = changed(small_run(demos=demos, init=str(earlier[source])), changes)
    got, expected = start(run, demos), load_policy(earlier[source])(OBS)
    exploring = expected
    if source == "averaged" and "agent.absorbing" not in changes:  # of a whole run, the actor that learns goes on
        held = checkpoint.restore(earlier[source] / "checkpoint")[0]
        assert held is not None
        exploring = np.asarray(checkpoint.unflatten("actor", got.actor, held)(OBS, np))
    assert np.allclose(got.actor(OBS, np), exploring, atol=1e-5)
    if source != "averaged" or changes:
        assert np.allclose(got.saved_actor(run)(OBS, np), expected, atol=1e-5)


def test_new_observations_hardly_change_what_a_policy_is(earlier: dict[str, Path], demos: str) -> None:
    run = small_run(demos=demos, init=str(earlier["bc"]))
    agent = start(run, demos).learner.agent
    later = run.agent.observe(agent, jnp.full((32, 2), 5.0))
    before, after = (np.asarray(run.agent.actor(held)(OBS)) for held in (agent, later))
    assert 0 < np.abs(after - before).max() < 0.1


@pytest.mark.parametrize(("source", "whole"), [("pcil", True), ("raw", False), ("bc", False), ("policy", False)])
def test_a_run_of_the_same_agent_gives_its_critic_too(source: str, whole: bool, earlier: dict[str, Path], demos: str) -> None:
    said: list[str] = []
    run = small_run("dac", demos=demos, init=str(earlier[source]), seed=2)
    held = checkpoint.restore(earlier["pcil"] / "checkpoint")[0]
    got = checkpoint.flatten("learner.agent", start(run, demos, said).learner.agent)
    assert held is not None
    assert all(np.array_equal(array, held[name]) for name, array in got.items()) == whole
    fresh = checkpoint.flatten("learner.agent", start(small_run("dac", demos=demos, seed=2), demos).learner.agent)
    critic = [name for name in got if ".critic" in name]
    assert all(np.array_equal(got[name], fresh[name]) for name in critic) != whole
    which = "Actor and critic start" if whole else "The actor starts"
    assert len(said) == 1 and said[0].startswith(f"{which} from {earlier[source]}; ")


def test_a_warm_run_begins_with_the_earlier_return_and_resumes_without_it(
    earlier: dict[str, Path], demos: str, tmp_path: Path
) -> None:
    source = shutil.copytree(earlier["pcil"], tmp_path / "source")
    run = small_run(demos=demos, init=str(source))
    finish(run, tmp_path / "whole")
    last, first = rows(earlier["pcil"])[0][-2:], rows(tmp_path / "whole")[0][1:3]
    assert [float(row[2]) for row in first] == pytest.approx([float(row[2]) for row in last])
    with pytest.raises(loop.Stopped):
        runs.execute(run, tmp_path / "stopped", [StopAfter(2)])
    shutil.rmtree(source)
    finish(run, tmp_path / "stopped")
    same_run(tmp_path / "whole", tmp_path / "stopped")


@pytest.mark.parametrize(
    ("source", "changes", "said"),
    [
        ("wide", {}, r"can't start from .*wide: its arrays have shapes \[.*24.*\], and those of this run's actor have"),
        (
            "policy",
            {"agent.normalize_observations": False},
            r"it normalizes observations; set agent.normalize_obs",
        ),
        ("nowhere", {}, r"can't start from .*nowhere: .* holds no policy"),
    ],
)
def test_what_does_not_fit_is_refused_and_leaves_nothing(
    source: str, changes: dict[str, Any], said: str, earlier: dict[str, Path], demos: str, tmp_path: Path
) -> None:
    folder = earlier.get(source, tmp_path / source)
    with pytest.raises(InputError, match=said):
        runs.execute(changed(small_run(demos=demos, init=str(folder)), changes), tmp_path / "run")
    assert not (tmp_path / "run" / "run.json").exists()


def test_an_agent_of_ones_own_that_can_not_says_so(earlier: dict[str, Path], demos: str) -> None:
    from test_learner import Scribe

    run = dataclasses.replace(small_run(demos=demos, init=str(earlier["policy"])), agent=Scribe(batch_size=32))
    with pytest.raises(InputError, match=r"The run can't start from .*policy: Scribe starts from no policy"):
        start(run, demos)
