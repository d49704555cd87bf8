"""The policy that is kept: the present reward decides, on starts of its own, and the training does not depend on it."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from test_learner import marked
from test_loop import finish, rows, same_run

from pcil import envs
from pcil.seeds import Stream, episode_seed
from pcil.training import checkpoint, kept, learner
from pcil.training.evaluate import evaluate
from pcil.training.kept import Kept
from pcil.types import Episode
from small import POINT_MASS, save_point_mass_demos, small_run

RUN = dataclasses.replace(small_run(), keep_best=True)
LEARNER = learner.Learner(None, None, jax.random.key_data(jax.random.key(0)), {})


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> str:
    return save_point_mass_demos(tmp_path_factory.mktemp("demos"))


def policy(number: int, *lengths: int) -> Kept:
    """A policy and episodes of these lengths, in all of whose steps the observation is `number`."""
    made = [Episode(np.full((n + 1, 2), number, np.float32), np.zeros((n, 2), np.float32), np.zeros(n)) for n in lengths]
    return Kept(marked(number), tuple(made))


@pytest.mark.parametrize(("now", "before", "better"), [(1, 2, 2), (2, 1, 2), (2, 2, 2), (3, None, 3)])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_present_reward_decides(
    now: int, before: int | None, better: int, sign: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mean over the episodes of the sum over steps; the newer of equal ones. With the opposite reward, the other one."""

    def paid(algorithm: Any, trained: Any, episode: Episode, count: int) -> np.ndarray:
        assert (algorithm, trained, count) == (RUN.learner, LEARNER, 7)
        return sign * episode.obs[1:, 0]

    monkeypatch.setattr(learner, "label_episode", paid)
    one, other = policy(now, 10, 20), before and policy(before, 10, 20)
    assert kept.worth(RUN.learner, LEARNER, one, 7) == sign * now * 15
    got = kept.better(RUN.learner, LEARNER, one, other or None, 7)
    assert got is (one if sign * now >= sign * (before or -9 * sign) else other)
    assert sign < 0 or got.episodes[0].obs[0, 0] == better


def test_policies_play_the_same_starts_which_are_not_those_of_an_evaluation() -> None:
    environments = [envs.make(POINT_MASS) for _ in range(2)]
    actor = learner.on_host(marked(0.0))
    episodes = kept.played(actor, environments, seed=3, episodes=4)
    assert [episode.seed for episode in episodes] == [episode_seed(3, Stream.SELECT, i) for i in range(4)]
    again = kept.played(learner.on_host(marked(1.0)), environments, seed=3, episodes=4)
    assert all(np.array_equal(a.obs[0], b.obs[0]) for a, b in zip(episodes, again, strict=True))
    tested = evaluate(lambda obs: actor(obs, np), environments, seed=3, episodes=4, keep=True).episodes
    assert not any(np.array_equal(a.obs[0], b.obs[0]) for a, b in zip(episodes, tested, strict=True))
    assert [episode.seed for episode in tested] == [episode_seed(3, Stream.EVALUATE, i) for i in range(4)]


@pytest.mark.parametrize("method", ["pcil", "bc", "sil"])
def test_a_run_that_keeps_the_best_learns_the_same_and_resumes_exactly(method: str, demos: str, tmp_path: Path) -> None:
    run = small_run(method, demos=demos, keep_best=False)
    if run.agent.offline:
        run = dataclasses.replace(run, frames=2300, seed_frames=0, evaluate_every=1000)
    best = dataclasses.replace(run, keep_best=True)
    finish(run, tmp_path / "plain")
    finish(best, tmp_path / "whole")
    finish(best, tmp_path / "stopped", stops=(1, 2, 1))
    same_run(tmp_path / "whole", tmp_path / "stopped")
    plain, whole = (checkpoint.restore(tmp_path / name / "checkpoint")[0] for name in ("plain", "whole"))
    assert plain is not None and whole is not None and plain.keys() < whole.keys()
    assert all(np.array_equal(plain[name], whole[name]) for name in plain)
    assert rows(tmp_path / "plain")[1] == rows(tmp_path / "whole")[1]


@pytest.mark.parametrize("first", [130, 200])
def test_it_goes_on_with_more_frames(first: int, demos: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The contest at 130 frames was only due because the run ended, so a longer run has not had it. Here what is kept has the
    episodes of every contest."""

    def newer(algorithm: Any, trained: Any, now: Kept, before: Kept | None, count: int) -> Kept:
        return Kept(now.actor, (*before.episodes, *now.episodes) if before else now.episodes)

    monkeypatch.setattr(kept, "better", newer)
    run = dataclasses.replace(RUN, demos=demos)
    finish(run, tmp_path / "whole")
    finish(dataclasses.replace(run, frames=first), tmp_path / "parts")
    finish(run, tmp_path / "parts")
    same_run(tmp_path / "whole", tmp_path / "parts")


def test_what_is_evaluated_and_saved_is_what_is_kept(demos: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reward by which nothing later is better keeps the first policy, and every evaluation is of it."""
    monkeypatch.setattr(kept, "better", lambda algorithm, trained, now, before, count: before or now)
    finish(dataclasses.replace(RUN, demos=demos), tmp_path / "run")
    finish(dataclasses.replace(RUN, demos=demos, keep_best=False), tmp_path / "plain")
    evaluations, plain = ([row[2] for row in rows(tmp_path / name)[0][1:]] for name in ("run", "plain"))
    assert len(plain) == 8 and evaluations == evaluations[:2] * 4
    assert evaluations[:2] == plain[:2] and evaluations[-2:] != plain[-2:]
