"""Sinkhorn rewards compared with a naive second computation; their scale, and the critic's updates."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import logsumexp

from pcil.nets.networks import MLP, Trunk
from pcil.rewards.sil import POTIL, SIL, Demos, SinkhornReward, SinkhornState, step_weights
from pcil.training import learner
from pcil.training.config import Run
from pcil.types import Batch, Episode, Spec
from small import batches, narrow, random_batch, small_run, staying

TRUNKS = [Trunk.init(3, 6, key=jax.random.key(seed)) for seed in range(4)]
DEMOS = [random_batch(steps, 3, 2, seed) for seed, steps in enumerate((20, 12, 17))]
EPISODE = random_batch(15, 3, 2, 9)
KEY = jax.random.key(0)


@functools.partial(jax.jit, static_argnames="settings")
def reward(settings: SinkhornReward, state: SinkhornState, batch: Batch, embed: Trunk, key: jax.Array) -> jax.Array:
    return settings.reward(state, batch, embed, key=key)


def naive_costs(x: np.ndarray, y: np.ndarray, epsilon: float = 0.01, rounds: int = 100) -> np.ndarray:
    """Each step's part of the transport cost, by cosines and in the log domain, in float64."""
    x, y = (np.asarray(z, np.float64) / np.linalg.norm(z, axis=1, keepdims=True) for z in (x, y))
    cost = 1 - x @ y.T
    log_u, log_v = np.zeros(len(x)), np.zeros(len(y))
    for _ in range(rounds):
        log_v = -np.log(len(y)) - logsumexp(log_u[:, None] - cost / epsilon, axis=0)
        log_u = -np.log(len(x)) - logsumexp(log_v[None] - cost / epsilon, axis=1)
    return np.sum(np.exp(log_u[:, None] + log_v[None] - cost / epsilon) * cost, axis=1)


def mlp(network: MLP, x: np.ndarray) -> np.ndarray:
    return network(x, np)


@pytest.mark.parametrize("inputs", ["state", "state-action"])
def test_sil_pays_minus_the_cost_to_one_random_demonstration(inputs: Any) -> None:
    """Every demonstration is drawn at some time, and each is compared as a whole, without its padding."""
    sil = SIL(inputs=inputs)
    state = sil.init(DEMOS, TRUNKS[0], key=KEY)

    def space(batch: Batch) -> np.ndarray:
        z = TRUNKS[0](batch.obs, np)
        return state.space.critic(np.concatenate([z, batch.action], axis=1) if inputs == "state-action" else z, np)

    expected = [-naive_costs(space(EPISODE), space(demo)) for demo in DEMOS]
    met = set()
    for seed in range(12):
        got = np.asarray(reward(sil, state, EPISODE, TRUNKS[0], jax.random.key(seed)))
        (which,) = (i for i, costs in enumerate(expected) if np.allclose(got, costs, rtol=1e-3, atol=1e-6))
        met.add(which)
    assert met == {0, 1, 2}
    assert sil.trunk == "critic"


@pytest.mark.parametrize("near", [0, 1, 2])
def test_potil_pays_minus_the_cost_to_the_nearest_demonstration(near: int) -> None:
    """The nearest as a whole: the largest sum of rewards, not the largest reward at each step."""
    potil = POTIL()
    state = potil.init(DEMOS, TRUNKS[0], key=KEY)
    episode = staying(DEMOS[near].obs[:10] + 0.1, DEMOS[near].action[:10])
    costs = [naive_costs(TRUNKS[0](episode.obs, np), TRUNKS[0](demo.obs, np)) for demo in DEMOS]
    assert int(np.argmin([cost.sum() for cost in costs])) == near
    got = reward(potil, state, episode, TRUNKS[1], KEY)
    assert np.allclose(got, -costs[near], rtol=1e-3, atol=1e-6)
    assert potil.trunk == "actor"


def test_an_episode_that_is_the_demonstration_costs_almost_nothing() -> None:
    state = POTIL().init(DEMOS, TRUNKS[0], key=KEY)
    same, other = (float(jnp.sum(reward(POTIL(), state, batch, TRUNKS[0], KEY))) for batch in (DEMOS[1], EPISODE))
    assert other < -0.05 < -0.005 < same <= 1e-6


def run_of(method: str, **reward: Any) -> Run:
    return small_run(method, reward=reward)


def episode_of(batch: Batch) -> Episode:
    obs = np.concatenate([batch.obs, batch.obs[:1]])
    return Episode(obs, batch.action.copy(), np.zeros(len(batch.action), np.float32))


@pytest.mark.parametrize("method", ["sil", "potil"])
def test_the_first_episode_fixes_the_scale_of_all(method: str) -> None:
    """Its own rewards sum to -10; the next episode has the same scale."""
    run = run_of(method)
    first, second = (episode_of(random_batch(steps, 2, 2, seed)) for steps, seed in ((20, 1), (25, 2)))
    fresh = learner.init(run.learner, Spec(2, 2, 1), [random_batch(30, 2, 2, 5), random_batch(20, 2, 2, 6)], 0)
    unscaled = learner.label_episode(run.learner, fresh, second, 1)
    state = learner.close_episode(run.learner, fresh, first, 0)
    assert learner.label_episode(run.learner, state, first, 0).sum() == pytest.approx(-10, rel=1e-4)
    scale = float(state.reward.scale)
    state = learner.close_episode(run.learner, state, second, 1)
    assert float(state.reward.scale) == scale != 1
    assert np.allclose(learner.label_episode(run.learner, state, second, 1), unscaled * scale, rtol=1e-4)


@pytest.mark.parametrize("method", ["sil", "potil"])
def test_episodes_of_many_lengths_share_one_compilation(method: str) -> None:
    run = run_of(method)
    state = learner.init(run.learner, Spec(2, 2, 1), [random_batch(30, 2, 2, 5)], 0)
    for steps in (20, 30, 40):
        episode = episode_of(random_batch(steps, 2, 2, steps))
        state = learner.close_episode(run.learner, state, episode, 0)
        assert learner.label_episode(run.learner, state, episode, 0).shape == (steps,)
        if steps == 20:
            compiled = learner._label_rows._cache_size(), learner._after_rows._cache_size()
    assert (learner._label_rows._cache_size(), learner._after_rows._cache_size()) == compiled


def test_steps_share_the_mass_and_rows_behind_them_have_none() -> None:
    action = jnp.array([[0.1, 0.2], [0.3, 0.4], [jnp.nan, jnp.nan], [0.5, 0.6], [jnp.nan, jnp.nan]])
    assert np.allclose(step_weights(action), [1 / 3, 1 / 3, 0, 1 / 3, 0])


class Free(POTIL):
    """Every episode has a cost of 0."""

    def costs(self, state: Any, batch: Any, embed: Any, *, key: Any) -> jax.Array:
        return jnp.zeros(len(batch.obs))


def test_a_first_episode_that_costs_nothing_leaves_a_finite_scale() -> None:
    """The scale is that of a cost of one millionth."""
    state = SinkhornState(Demos.of(DEMOS), jnp.zeros(()), None)
    after = Free().after_episode(state, EPISODE, TRUNKS[0], key=KEY)
    assert float(after.scale) == pytest.approx(10 / 1e-6)


def test_without_a_first_sum_rewards_stay_unscaled() -> None:
    run = run_of("potil", first_sum=0.0)
    state = learner.init(run.learner, Spec(2, 2, 1), [random_batch(30, 2, 2, 5)], 0)
    episode = episode_of(random_batch(20, 2, 2, 1))
    closed = learner.close_episode(run.learner, state, episode, 0)
    before, after = (learner.label_episode(run.learner, s, episode, 0) for s in (state, closed))
    assert np.array_equal(before, after)


def test_a_reward_of_single_steps_takes_no_note_of_episodes() -> None:
    run = small_run("dac")
    state = learner.init(run.learner, Spec(2, 2, 1), [random_batch(30, 2, 2, 5)], 0)
    assert learner.close_episode(run.learner, state, episode_of(random_batch(20, 2, 2, 1)), 0) is state


def test_the_critics_gradient_is_that_of_the_cost_with_the_plan_held_fixed() -> None:
    """Compared with finite differences in float64, along random directions of all weights together."""
    rng = np.random.default_rng(0)
    critic = MLP.init((6, 16, 16, 5), key=KEY)
    x, y, plan = rng.standard_normal((9, 6)), rng.standard_normal((9, 6)), rng.random((9, 9))
    given = [jnp.asarray(array, jnp.float32) for array in (x, y, plan)]
    gradient = jax.grad(SIL().loss)(critic, *given)

    def cost(network: MLP) -> float:
        f, g = (z / np.linalg.norm(z, axis=1, keepdims=True) for z in (mlp(network, x), mlp(network, y)))
        return -float(np.sum(plan * (1 - f @ g.T)))

    exact: MLP = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), critic)
    for _ in range(3):
        way = jax.tree.map(lambda leaf: rng.standard_normal(leaf.shape), exact)
        ends = [cost(jax.tree.map(lambda leaf, d, s=s: leaf + s * d, exact, way)) for s in (1e-6, -1e-6)]
        slope = sum(float(np.sum(np.asarray(g) * d)) for g, d in zip(*map(jax.tree.leaves, (gradient, way)), strict=True))
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-3)


def pair(rows: int = 32) -> tuple[Batch, Batch]:
    """An expert and an agent whose states are apart, but not far."""
    expert, agent = random_batch(rows + 1, 3, 2, 1), random_batch(rows + 1, 3, 2, 2)
    return batches(staying(expert.obs + 1, expert.action)), batches(agent)


@functools.partial(jax.jit, static_argnames="settings")
def update(
    settings: SinkhornReward, state: SinkhornState, expert: Batch, agent: Batch, embed: Trunk
) -> tuple[SinkhornState, Any]:
    return settings.update(state, expert, agent, embed, key=KEY)


def test_the_critic_makes_the_cost_large_and_steps_only_when_it_is_due() -> None:
    sil = narrow(SIL(every=3, learning_rate=1e-2), every=3)
    state = sil.init(DEMOS, TRUNKS[0], key=KEY)
    costs, moved = [], []
    for _ in range(60):
        before = state.space.critic
        state, metrics = update(sil, state, *pair(), TRUNKS[0])
        costs.append(float(metrics["transport_cost"]))
        moved.append(not np.array_equal(before.weights[0], state.space.critic.weights[0]))
    assert moved == [i % 3 == 0 for i in range(60)]
    assert costs[:3] == [costs[0]] * 3 and costs[-1] > 1.3 * costs[0]
    f, g = (state.space.critic(TRUNKS[0](w.next_obs[:, 0], np), np) for w in reversed(pair()))
    assert naive_costs(f, g).sum() > 1.3 * costs[0]


def test_the_first_reported_cost_is_the_naive_one() -> None:
    sil = narrow(SIL())
    state = sil.init(DEMOS, TRUNKS[0], key=KEY)
    f, g = (state.space.critic(TRUNKS[0](w.next_obs[:, 0], np), np) for w in reversed(pair()))
    _, metrics = update(sil, state, *pair(), TRUNKS[0])
    assert float(metrics["transport_cost"]) == pytest.approx(naive_costs(f, g).sum(), rel=1e-4)


def test_slow_features_are_refreshed_when_it_is_their_turn() -> None:
    potil = POTIL(refresh=2)
    nothing = Batch(*(array[:0] for array in batches(EPISODE)))
    state = potil.init(DEMOS, TRUNKS[0], key=KEY)
    for updates, slow in enumerate([0, 0, 2, 2]):
        if updates:
            state, _ = update(potil, state, nothing, nothing, TRUNKS[updates])
        assert np.array_equal(state.space.embed.weight, TRUNKS[slow].weight)


class Unit(POTIL):
    """Each step of every episode costs 2."""

    def costs(self, state: Any, batch: Any, embed: Any, *, key: Any) -> jax.Array:
        return jnp.full(len(batch.obs), 2.0)


def test_a_scale_below_1_counts_as_one_above() -> None:
    """15 steps that cost 2 each sum to -1 with a scale of 1/30."""
    settings = Unit(first_sum=-1.0)
    state = settings.after_episode(SinkhornState(Demos.of(DEMOS), jnp.zeros(()), None), EPISODE, TRUNKS[0], key=KEY)
    assert float(state.scale) == pytest.approx(1 / 30)
    assert np.allclose(settings.reward(state, EPISODE, TRUNKS[0], key=KEY), np.full(15, -1 / 15))
    assert settings.after_episode(state, random_batch(5, 3, 2, 1), TRUNKS[0], key=KEY).scale == state.scale


def test_rows_without_mass_cost_nothing_although_they_are_not_finite() -> None:
    """Rows behind an episode's end have actions that are not numbers, and so have their costs."""
    x, y = (np.random.default_rng(seed).normal(size=(6, 3)).astype(np.float32) for seed in (1, 2))
    mass = jnp.full(6, 1 / 6)
    alone = POTIL().match(jnp.asarray(x), jnp.asarray(y), mass, mass)
    padded = jnp.asarray(np.concatenate([x, np.full((2, 3), np.nan, np.float32)]))
    got = POTIL().match(padded, jnp.asarray(y), jnp.concatenate([mass, jnp.zeros(2)]), mass)
    assert np.allclose(got, [*alone, 0, 0], atol=1e-6)
