"""Behavioural cloning: its likelihood by SciPy, its gradient by differences, and a run without environment steps."""

from __future__ import annotations

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats
from jax.test_util import check_grads

from pcil import envs
from pcil.agents import BC
from pcil.policy import load_policy
from pcil.training import loop, presets, runs
from pcil.training.config import Run, changed
from pcil.types import Spec
from small import POINT_MASS, narrow, random_batch, save_point_mass_demos, windows

AGENT = narrow(BC(), hidden=16)


def small_bc(demos: str, **changes: object) -> Run:
    run = presets.make(POINT_MASS, "bc", demos=demos, frames=1200, evaluate_every=600, evaluate_episodes=2)
    return changed(run, {"agent": narrow(run.agent, learning_rate=1e-3), **changes})


def test_the_loss_is_scipys_negative_log_likelihood() -> None:
    batch, state = random_batch(7, 3, 2), AGENT.init(Spec(3, 2, 1), key=jax.random.key(0))
    loss, metrics = AGENT.loss(state.actor, jnp.asarray(batch.obs), jnp.asarray(batch.action))
    mean = np.asarray(state.actor(jnp.asarray(batch.obs)), np.float64)
    naive = -scipy.stats.norm.logpdf(batch.action, mean, AGENT.deviation).sum(axis=1).mean()
    assert float(loss) == pytest.approx(naive, rel=1e-5)
    assert float(metrics["squared_error"]) == pytest.approx(((mean - batch.action) ** 2).sum(axis=1).mean(), rel=1e-5)


def test_the_loss_has_the_derivative_that_differences_show() -> None:
    with jax.enable_x64(True):
        double = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tree)  # noqa: E731
        state, batch = double(AGENT.init(Spec(3, 2, 1), key=jax.random.key(0))), double(random_batch(5, 3, 2))
        loss = jax.jit(lambda actor: AGENT.loss(actor, batch.obs, batch.action)[0])
        check_grads(loss, (state.actor,), order=1, modes=["rev"], eps=1e-6, atol=1e-5, rtol=1e-5)


def test_an_update_uses_the_first_step_of_a_window_and_nothing_else() -> None:
    state, window = AGENT.init(Spec(3, 2, 1), key=jax.random.key(0)), windows(random_batch(40, 3, 2))
    other = window._replace(reward=window.reward + 5, discount=0 * window.discount, obs=window.obs.copy())
    other.obs[:, 1] += 1
    update = jax.jit(lambda w: AGENT.update(state, w, step=jnp.int32(0), key=jax.random.key(1))[0])
    one, two = update(window), update(other)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True))


def test_a_run_clones_the_optimal_policy_without_a_step_in_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The environment is stepped only in evaluations; after 1200 updates the actions are close to the expert's."""
    demos = save_point_mass_demos(tmp_path)
    played = []
    monkeypatch.setattr(loop, "play", lambda *_: played.append(1))
    result = runs.execute(small_bc(demos), tmp_path / "run")
    assert not played and (tmp_path / "run" / "eval.csv").read_text().count("\n") == 1 + 3 * 2
    recorded = runs.Demonstrations.load(demos)
    error = load_policy(tmp_path / "run")(recorded.obs) - recorded.action
    untrained = AGENT.init(envs.spec(envs.make(POINT_MASS)), key=jax.random.key(0)).actor(jnp.asarray(recorded.obs))
    assert np.mean(error**2) < 0.1 * np.mean((np.asarray(untrained) - recorded.action) ** 2)
    assert result.demos_return == recorded.return_mean


def test_an_update_reads_the_first_step_of_a_window_and_no_other() -> None:
    """The following steps and the length of the window have no effect."""
    key, batch = jax.random.key(0), random_batch(40, 3, 2)
    state = AGENT.init(Spec(3, 2, 1), key=key)
    one, three = windows(batch, 1), windows(batch, 3)
    first = one._replace(**{name: value[: len(three.obs)] for name, value in one._asdict().items()})
    updated = [
        AGENT.update(state, jax.tree.map(jnp.asarray, window), step=jnp.int32(0), key=key)[0] for window in (first, three)
    ]
    for a, b in zip(*map(jax.tree.leaves, updated), strict=True):
        np.testing.assert_array_equal(a, b)


def test_it_acts_without_noise() -> None:
    state = AGENT.init(Spec(3, 2, 1), key=jax.random.key(0))
    actor = jax.tree.map(np.asarray, AGENT.actor(state))
    obs = random_batch(1, 3, 2).obs[0]
    np.testing.assert_array_equal(AGENT.explorer(2, np.random.default_rng(0))(actor, obs, 7), actor(obs, np))
