"""The agent: its equations by hand, and five probe environments, each of which detects one class of bug."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from pcil import envs
from pcil.agents import DrQV2
from pcil.envs.toy import PointMass
from pcil.seeds import Stream, episode_seed
from pcil.training import learner, loop, runs
from pcil.types import Spec, Window
from small import narrow, random_batch, small_run

SPEC = Spec(3, 2, 1)
AGENT = narrow(DrQV2())


def make_window(discount: float = 1.0, seed: int = 0) -> Window:
    rng = np.random.default_rng(seed)
    flat = random_batch(32 * 4, 3, 2, seed)
    reward = rng.standard_normal((32, 3), dtype=np.float32)
    obs, action = flat.obs.reshape(32, 4, 3), flat.action.reshape(32, 4, 2)[:, :3]
    return jax.tree.map(
        jnp.asarray, Window(obs, action, reward, np.full((32, 3), discount, np.float32), np.zeros(32, np.int32))
    )


def test_target_is_the_discounted_rewards_and_the_smaller_slow_value() -> None:
    """Naive second computation, without noise: r0 + g r1 + g^2 r2 + g^3 min(Q1', Q2')(s3, mu(s3))."""
    state, window = AGENT.init(SPEC, key=jax.random.key(0)), make_window()
    got = AGENT.target(state, window, jnp.zeros((32, 2)))
    for row in range(32):
        last = window.obs[row, 3]
        values = state.critic_target(last, state.actor(last))
        rewards = sum(AGENT.gamma**k * float(window.reward[row, k]) for k in range(3))
        assert got[row] == pytest.approx(rewards + AGENT.gamma**3 * float(min(values)), abs=1e-5)


def test_nothing_is_bootstrapped_behind_a_termination() -> None:
    state, window = AGENT.init(SPEC, key=jax.random.key(0)), make_window(discount=0.0)
    got = AGENT.target(state, window, jnp.zeros((32, 2)))
    assert np.allclose(got, window.reward[:, 0])


def test_slow_critic_moves_by_tau_and_the_trunk_with_it() -> None:
    state = AGENT.init(SPEC, key=jax.random.key(0))
    after, _ = AGENT.update(state, make_window(), step=jnp.int32(0), key=jax.random.key(1))
    for slow, fast, before in zip(*map(jax.tree.leaves, (after.critic_target, after.critic, state.critic)), strict=True):
        assert np.allclose(slow, 0.99 * before + 0.01 * fast, atol=1e-7)
    assert not np.array_equal(after.critic_target.trunk.weight, state.critic.trunk.weight)


def test_actor_update_leaves_the_critic_alone_and_raises_its_value() -> None:
    """The critic's gradient comes only from its own loss; a small step of the actor raises min(Q1, Q2)."""
    state, window = AGENT.init(SPEC, key=jax.random.key(0)), make_window()
    obs, noise = jnp.asarray(window.obs[:, 0]), jnp.zeros((32, 2))
    loss, gradient = jax.value_and_grad(AGENT.actor_loss)(state.actor, state.critic, obs, noise, jnp.ones(32))
    moved = jax.tree.map(lambda weight, slope: weight - 1e-2 * slope, state.actor, gradient)
    assert AGENT.actor_loss(moved, state.critic, obs, noise, jnp.ones(32)) < loss
    values = state.critic(obs, state.actor(obs))
    assert loss == pytest.approx(-float(jnp.mean(jnp.minimum(*values))), abs=1e-6)


def test_losses_against_finite_differences() -> None:
    with jax.enable_x64(True):
        double = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tree)  # noqa: E731
        state, window = double(AGENT.init(SPEC, key=jax.random.key(0))), double(make_window())
        obs, action = window.obs[:, 0], window.action[:, 0]
        target = jnp.linspace(-1.0, 1.0, 32)
        noise = jnp.zeros((32, 2))
        losses = (
            (lambda critic: AGENT.critic_loss(critic, obs, action, target)[0], state.critic),
            (lambda actor: AGENT.actor_loss(actor, state.critic, obs, noise, jnp.ones(32)), state.actor),
        )
        for loss, network in losses:
            check_grads(jax.jit(loss), (network,), order=1, modes=["rev"], eps=1e-6, atol=1e-5, rtol=1e-5)


def test_update_noise_is_clipped_and_acting_noise_is_not() -> None:
    wild = dataclasses.replace(AGENT, noise_clip=0.0)
    state, window = wild.init(SPEC, key=jax.random.key(0)), make_window()
    one, _ = wild.update(state, window, step=jnp.int32(0), key=jax.random.key(1))
    two, _ = wild.update(state, window, step=jnp.int32(0), key=jax.random.key(2))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True))
    host, rng = learner.on_host(state.actor), np.random.default_rng(0)
    explore = wild.explorer(SPEC.action_dim, rng)
    actions = [explore(host, np.asarray(window.obs[0, 0]), 0) for _ in range(200)]
    assert np.std(actions) > 0.4 and np.abs(actions).max() <= 1


def trained_on(task: str, folder: Path, frames: int = 1200) -> loop.State:
    agent = narrow(DrQV2(), learning_rate=3e-3, hidden=32, tau=0.05)
    run = small_run("expert", task, frames=frames, random_frames=frames, evaluate_every=frames, agent=agent, update_every=1)
    folder.mkdir()
    return loop.train_loop(run, folder, ())


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5])
def test_probe_environments(number: int, tmp_path: Path) -> None:
    """The known values of each probe are learned, and the known best actions if it has any."""
    state = trained_on(f"toy/probe_{number}-v0", tmp_path / "run")
    probe = envs.make(f"toy/probe_{number}-v0").unwrapped
    starts = {1: (0.0,), 2: (-1.0, 1.0), 3: (0.0, 1.0), 4: (0.0,), 5: (-1.0, 1.0)}[number]
    for start in starts:
        obs = jnp.array([[start]])
        action = state.learner.agent.actor(obs)
        values = state.learner.agent.critic(obs, action)
        assert np.allclose(values, probe.value(start, 0.99), atol=0.1), start
        if number >= 4:
            assert float(action[0, 0]) == pytest.approx(probe.optimal_action(start), abs=0.15)


@pytest.mark.slow
def test_the_task_reward_agent_solves_the_point_mass(tmp_path: Path) -> None:
    """Within 10% of the optimal return from the same starts; the trunk's normalisation limits accuracy near the goal."""
    agent = narrow(DrQV2(), hidden=64, learning_rate=1e-3, batch_size=64)
    run = small_run("expert", frames=6000, evaluate_every=6000, evaluate_episodes=10, agent=agent)
    result = runs.execute(run, tmp_path / "run")
    starts = [episode_seed(run.seed, Stream.EVALUATE, i) for i in range(run.evaluate_episodes)]
    best = np.mean([optimal_return(envs.make(run.task), start) for start in starts])
    assert result.final_return > 0.9 * best


def optimal_return(env: gymnasium.Env, seed: int) -> float:
    obs, total, over = env.reset(seed=seed)[0], 0.0, False
    while not over:
        obs, reward, _, over, _ = env.step(PointMass.optimal_action(obs).astype(np.float32))
        total += float(reward)
    return total


# --- Standardised observations, absorbing states ---


def test_the_actor_that_leaves_acts_on_plain_observations() -> None:
    """With large units, far from zero, the network acts on standardised observations."""
    agent = dataclasses.replace(AGENT, normalize_observations=True)
    state, window = agent.init(SPEC, key=jax.random.key(0)), make_window()
    window = window._replace(obs=window.obs * jnp.array([[[1.0, 30.0, 0.01]]]) + jnp.array([[[0.0, -50.0, 2.0]]]))
    seen = window.obs.reshape(-1, SPEC.obs_dim)
    update = jax.jit(lambda s, k: agent.update(agent.observe(s, seen), window, step=jnp.int32(0), key=k)[0])
    for i in range(5):
        state = update(state, jax.random.key(i))
    assert state.scaler is not None
    flat = np.asarray(seen, np.float64)
    scaled = ((np.asarray(window.obs[:, 0]) - flat.mean(axis=0)) / flat.std(axis=0)).astype(np.float32)
    assert np.allclose(agent.actor(state)(window.obs[:, 0]), state.actor(jnp.asarray(scaled)), atol=1e-3)
    assert np.allclose(agent.trunk(state, "critic")(window.obs[:, 0]), state.critic.trunk(jnp.asarray(scaled)), atol=1e-3)


ABSORBING = dataclasses.replace(AGENT, absorbing=True)


def test_the_action_in_the_absorbing_state_is_zero_in_targets() -> None:
    state, window = ABSORBING.init(SPEC, key=jax.random.key(0)), make_window()
    window = window._replace(obs=window.obs.at[:, :, -1].set(0.0).at[0, 3].set(jnp.array([0.0, 0.0, 1.0])))
    got = ABSORBING.target(state, window, jnp.full((32, 2), 0.2))
    for row, action in ((0, jnp.zeros(2)), (1, state.actor(window.obs[1, 3]) + 0.2)):
        values = state.critic_target(window.obs[row, 3], action)
        rewards = sum(AGENT.gamma**k * float(window.reward[row, k]) for k in range(3))
        assert got[row] == pytest.approx(rewards + AGENT.gamma**3 * float(min(values)), abs=1e-5)


def test_the_actor_is_not_trained_in_the_absorbing_state_and_leaves_without_its_entry() -> None:
    state, window = ABSORBING.init(SPEC, key=jax.random.key(0)), make_window()
    window = window._replace(obs=jnp.zeros_like(window.obs).at[:, :, -1].set(1.0))
    after, _ = ABSORBING.update(state, window, step=jnp.int32(0), key=jax.random.key(1))
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(after.actor), jax.tree.leaves(state.actor), strict=True))
    assert not np.array_equal(after.critic.trunk.bias, state.critic.trunk.bias)
    obs = random_batch(5, 2, 2).obs
    padded = np.pad(obs, ((0, 0), (0, 1)))
    assert np.allclose(ABSORBING.actor(state)(jnp.asarray(obs)), state.actor(jnp.asarray(padded)), atol=1e-6)


@pytest.mark.parametrize("first", [0.0, 1.0])
def test_whether_a_window_trains_the_actor_is_said_by_its_first_state(first: float) -> None:
    state, window = ABSORBING.init(SPEC, key=jax.random.key(0)), make_window()
    window = window._replace(obs=window.obs.at[:, 0, -1].set(first).at[:, 1:, -1].set(1 - first))
    after, _ = ABSORBING.update(state, window, step=jnp.int32(0), key=jax.random.key(1))
    same = [np.array_equal(a, b) for a, b in zip(jax.tree.leaves(after.actor), jax.tree.leaves(state.actor), strict=True)]
    assert all(same) if first else not any(same)


# --- Cloning ---


def test_cloning_takes_a_step_towards_the_demonstrated_actions_of_the_actor_alone() -> None:
    agent = dataclasses.replace(AGENT, cloning=True, learning_rate=1e-3)
    state, window = agent.init(SPEC, key=jax.random.key(0)), make_window()
    obs, action = jnp.asarray(window.obs[:, 0]), jnp.asarray(window.action[:, 0])
    error = float(agent.cloning_error(state, state.actor, window))
    assert error == pytest.approx(float(np.mean(np.sum((np.asarray(state.actor(obs)) - action) ** 2, axis=1))), rel=1e-5)
    after = state
    for _ in range(20):
        after = agent.clone(after, window)
    assert agent.cloning_error(after, after.actor, window) < 0.9 * error
    same = [np.array_equal(a, b) for a, b in zip(jax.tree.leaves(after.critic), jax.tree.leaves(state.critic), strict=True)]
    assert all(same)


@pytest.mark.parametrize("cloning", [False, True, None])
def test_whether_it_clones_is_its_setting(cloning: bool | None) -> None:
    assert dataclasses.replace(AGENT, cloning=cloning).clones is cloning


@pytest.mark.parametrize("every", [1, 2, 32, 64])
def test_the_absorbing_state_has_no_action_to_clone(every: int) -> None:
    """If all windows but the last begin in it, the last one alone decides; if all do, there is no error."""
    agent = dataclasses.replace(ABSORBING, cloning=True)
    state, window = agent.init(SPEC, key=jax.random.key(0)), make_window()
    ends = jnp.arange(1, 33) % every != 0
    window = window._replace(obs=window.obs.at[:, 0, -1].set(jnp.where(ends, 1.0, 0.0)))
    alive = window._replace(obs=window.obs[~ends], action=window.action[~ends])
    other = window._replace(action=jnp.where(ends[:, None, None], -window.action, window.action))
    expected = float(agent.cloning_error(state, state.actor, alive))
    assert float(agent.cloning_error(state, state.actor, window)) == pytest.approx(expected, rel=1e-5)
    assert float(agent.cloning_error(state, state.actor, other)) == pytest.approx(expected, rel=1e-5)


# --- The averaged actor ---


def arrays(actor: Any) -> list[np.ndarray]:
    return [np.asarray(leaf, np.float64) for leaf in jax.tree.leaves(actor)]


def test_the_average_is_that_of_the_actors_after_each_update_and_starts_with_the_clone() -> None:
    """By hand: `0.7 average + 0.3 actor` after each update. Nothing that learns depends on it."""
    agent = dataclasses.replace(AGENT, cloning=True, averaging_rate=0.3)
    plain = dataclasses.replace(AGENT, cloning=True)
    state, window = agent.init(SPEC, key=jax.random.key(0)), make_window()
    other = plain.init(SPEC, key=jax.random.key(0))
    state, other = agent.clone(state, window), plain.clone(other, window)
    expected = arrays(state.actor)
    assert all(map(np.array_equal, arrays(state.averaged), expected))
    for i in range(3):
        given = {"cloned": window, "step": jnp.int32(i), "key": jax.random.key(i)}
        state, other = agent.update(state, window, **given)[0], plain.update(other, window, **given)[0]
        expected = [0.7 * average + 0.3 * actor for average, actor in zip(expected, arrays(state.actor), strict=True)]
        assert all(np.allclose(*pair, rtol=1e-5, atol=1e-7) for pair in zip(arrays(state.averaged), expected, strict=True))
        assert all(map(np.array_equal, arrays(state.actor), arrays(other.actor))) and other.averaged is None


def test_the_averaged_actor_takes_the_environments_own_observations() -> None:
    """Without the flag of the absorbing state, and normalized by itself, as the actor that explores does."""
    agent = dataclasses.replace(ABSORBING, averaging_rate=0.5, normalize_observations=True)
    state = agent.init(SPEC, key=jax.random.key(0))
    state = agent.observe(state, jnp.asarray(random_batch(40, SPEC.obs_dim, 2).obs * 3 + 1))
    averaged, obs = agent.averaged(state), random_batch(5, SPEC.obs_dim - 1, 2).obs
    assert averaged is not None and AGENT.averaged(AGENT.init(SPEC, key=jax.random.key(0))) is None
    assert np.array_equal(averaged(obs, np), agent.actor(state)(obs, np)), "before the first update they are equal"


def test_a_warm_start_begins_the_average_too() -> None:
    """With the earlier actor; without an average there is none afterwards either."""
    earlier = AGENT.actor(AGENT.init(SPEC, key=jax.random.key(7)))
    for agent in (AGENT, dataclasses.replace(AGENT, averaging_rate=0.5)):
        state = agent.started_from(agent.init(SPEC, key=jax.random.key(0)), earlier)
        assert all(map(np.array_equal, arrays(state.actor), arrays(earlier)))
        assert (state.averaged is None) == (agent is AGENT)
    assert all(map(np.array_equal, arrays(state.averaged), arrays(earlier)))
