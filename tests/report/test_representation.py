"""Representations of trained runs: the right layer of the right networks on the right transitions; folders are unchanged."""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from pcil import seeds
from pcil.demos import Demonstrations
from pcil.errors import InputError
from pcil.files import flat
from pcil.report import representation
from pcil.report.load import Collection, collect
from pcil.rewards import DAC, PCIL
from pcil.training import learner, runs
from pcil.training.config import Run
from pcil.types import Episode
from small import narrow, random_batch, save_point_mass_demos, small_run, staying


def embed(obs: Any) -> Any:
    """Features that are the observations."""
    return obs


# --- The layer ---


def test_pcils_representation_is_what_its_reward_compares() -> None:
    settings, demos = narrow(PCIL(compare="mean")), random_batch(50, 3, 2)
    state, steps = settings.init([demos], embed, key=jax.random.key(0)), random_batch(40, 3, 2, seed=1)
    seen = settings.representation(state, steps, embed)
    anchors = settings.representation(state, state.reference, embed)
    reward = settings.reward(state, steps, embed, key=jax.random.key(1))
    assert seen.shape == (40, 4) and np.allclose(np.linalg.norm(seen, axis=1), 1, atol=1e-5)
    assert np.allclose(seen @ anchors.mean(axis=0), reward, atol=1e-5)


@pytest.mark.parametrize("inputs", ["state", "state-action"])
def test_dacs_representation_is_one_linear_layer_from_its_logit(inputs: str) -> None:
    settings, demos = narrow(DAC(inputs=inputs)), random_batch(50, 3, 2)
    state, steps = settings.init([demos], embed, key=jax.random.key(0)), random_batch(40, 3, 2, seed=1)
    seen = settings.representation(state, steps, embed)
    last = state.discriminator
    logit = (seen @ last.weights[-1])[:, 0] + last.biases[-1]
    assert seen.shape == (40, 16) and float(seen.min()) == 0 < float(seen.max())
    assert np.allclose(logit, settings.reward(state, steps, embed, key=jax.random.key(1)), atol=1e-5)


# --- Whole runs ---


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of PCIL, one of DAC and one on the task's own reward."""
    root = tmp_path_factory.mktemp("runs")
    demos = save_point_mass_demos(root / "demos")
    for method in ("pcil", "dac", "expert"):
        runs.execute(small_run(method, demos=demos if method != "expert" else None), root / method)
    return root


@pytest.fixture
def found(trained: Path) -> Collection:
    return collect([trained])


def files(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_rows_are_added_for_every_run_that_has_a_representation(trained: Path, found: Collection) -> None:
    """128 transitions of the expert and all 50 of the agent's episode; the task's reward learns no representation."""
    before = files(trained)
    representation.add(found)
    assert files(trained) == before and found.notes == []
    assert [row.method for row in found.transitions] == ["pcil"] * 178 + ["dac"] * 178
    for method in ("pcil", "dac"):
        mine = [row for row in found.transitions if row.method == method]
        assert sum(row.reward is None for row in mine) == 128 and {row.frames for row in mine} == {300}
    again = collect([trained])
    representation.add(again)
    assert again.transitions == found.transitions


def test_the_transitions_are_those_of_the_newest_networks(
    trained: Path, found: Collection, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The distances follow from the state of the finished run; nothing is trained while the episode is played."""
    kept: dict[str, Any] = {}
    plain = representation.play

    def watched(run: Run, environments: Any, spec: Any, state: Any, **options: Any) -> list[Episode]:
        kept["state"], kept["episodes"] = state, plain(run, environments, spec, state, **options)
        return kept["episodes"]

    monkeypatch.setattr(representation, "play", watched)
    monkeypatch.setattr(learner, "update", lambda *arguments: pytest.fail("an update"))
    name = ("toy/point_mass-v0", "pcil", "default", 1)
    rows = representation.transitions(found.sources[name], next(row for row in found.rows if row[:4] == name))
    state, run = kept["state"].learner, small_run(demos=str(trained / "demos" / "point_mass-v0"))
    assert kept["state"].counters.updates == json.loads((trained / "pcil/train.jsonl").read_text().splitlines()[-1])["updates"]

    def look(obs: np.ndarray) -> np.ndarray:
        trunk = learner.frozen_embed(run.learner, state.agent)
        return np.asarray(run.reward.representation(state.reward, staying(obs, np.zeros((len(obs), 2), np.float32)), trunk))

    rng = seeds.rng(run.seed, seeds.Stream.SAMPLE, kept["state"].counters.episodes - 1)
    states = np.concatenate([episode.obs[1:] for episode in Demonstrations.load(run.demos).episodes])
    expert = look(states[rng.permutation(len(states))[:128]])
    order = rng.permutation(50)
    agent = look(kept["episodes"][0].obs[1:][order])
    distances = np.linalg.norm(np.concatenate([expert, agent]) - expert.mean(axis=0), axis=1)
    assert [row.distance for row in rows] == pytest.approx(distances.tolist(), rel=1e-3, abs=1e-5)
    assert [row.reward for row in rows[128:]] == pytest.approx(kept["episodes"][0].reward[order].tolist(), rel=1e-3)


def test_a_run_is_made_again_from_its_description(trained: Path) -> None:
    for method in ("pcil", "dac", "expert"):
        settings = json.loads((trained / method / "run.json").read_text())["run"]
        run = Run.from_json(flat(settings))
        assert run.method == method and json.loads(json.dumps(run.to_json())) == settings


def test_a_run_of_before_a_setting_was_there_is_made_again(trained: Path) -> None:
    settings = flat(json.loads((trained / "pcil" / "run.json").read_text())["run"])
    older = {name: value for name, value in settings.items() if name not in ("agent.noise_correlation", "reward.stages")}
    assert len(older) == len(settings) - 2 and representation.with_defaults(older) == settings


@pytest.mark.parametrize(
    "change",
    [
        {"reward": {"class": "os:system"}},
        {"reward": {"novel": 1}},
        {"agent": {"gamma": 7.0}},
    ],
)
def test_what_is_not_ours_is_never_made(change: dict[str, Any], trained: Path, tmp_path: Path) -> None:
    """A foreign description runs no code: only classes of the registries are made, with settings that they have."""
    folder = Path(shutil.copytree(trained / "pcil", tmp_path / "pcil"))
    about = json.loads((folder / "run.json").read_text())
    for name, value in change.items():
        about["run"][name] = about["run"][name] | value if isinstance(value, dict) else value
    (folder / "run.json").write_text(json.dumps(about))
    found = collect([folder])
    representation.add(found)
    assert found.transitions == [] and len(found.notes) == 1 and "1 of 1 runs is left out" in found.notes[0]


@pytest.mark.parametrize("damage", ["gone", "torn", "narrow"])
def test_a_run_without_its_networks_is_left_out_and_said(damage: str, trained: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(trained / "pcil", tmp_path / "pcil"))
    if damage == "gone":
        shutil.rmtree(folder / "checkpoint")
    elif damage == "torn":
        for file in folder.glob("checkpoint/*/meta.json"):
            file.write_text("1\n{}\n")
    else:
        about = json.loads((folder / "run.json").read_text())
        about["run"]["reward"]["hidden"] = 12
        (folder / "run.json").write_text(json.dumps(about))
    found = collect([folder])
    with contextlib.redirect_stdout(io.StringIO()) as said:
        representation.add(found)
    assert said.getvalue() == "" and found.transitions == []
    assert found.notes[0].startswith("The representation of 1 of 1 runs is left out: ")
    with pytest.raises(InputError):
        representation.transitions(next(iter(found.sources.values())), found.rows[-1])


def test_no_step_is_drawn_twice_and_each_keeps_its_reward() -> None:
    """Two episodes of 4 and 3 steps; states, actions and rewards are numbered."""

    def numbered(first: int, steps: int) -> Episode:
        numbers = np.arange(first, first + steps, dtype=np.float32)
        return Episode(np.arange(first - 1, first + steps, dtype=np.float32)[:, None], numbers[:, None], numbers, False)

    run = small_run()
    batch, reward = representation._steps(run, [numbered(1, 4), numbered(11, 3)], 100, np.random.default_rng(0))
    assert sorted(reward.tolist()) == [1, 2, 3, 4, 11, 12, 13] and reward.tolist() != sorted(reward.tolist())
    assert batch.next_obs[:, 0].tolist() == batch.action[:, 0].tolist() == reward.tolist(), "the state that the step led to"
    assert (batch.obs + 1 == batch.action).all(), "the state in which the action was taken"
    batch, _ = representation._steps(run, [numbered(1, 4)], 2, np.random.default_rng(0))
    assert batch.obs.shape == batch.next_obs.shape == (2, 1)
