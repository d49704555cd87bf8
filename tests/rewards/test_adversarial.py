"""DAC's discriminator and reward by hand and by a naive second computation."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pcil.nets.networks import MLP
from pcil.rewards.adversarial import DAC, DiscriminatorState
from small import batches, narrow, random_batch, staying

SETTINGS = narrow(DAC())


def test_reward_is_the_logit_even_where_the_sigmoid_saturates() -> None:
    """`log D - log(1 - D)` of a logit of 200 is 200; computed with logarithms in float32 it would be infinite."""
    discriminator = MLP((jnp.ones((1, 1)), jnp.ones((1, 1))), (jnp.zeros(1), jnp.zeros(1)))
    state = DiscriminatorState(discriminator, None)
    obs = jnp.array([[0.0], [3.0], [200.0]])
    assert np.allclose(SETTINGS.reward(state, staying(obs, obs), lambda x: x, key=jax.random.key(0)), [0.0, 3.0, 200.0])


def test_loss_equals_a_naive_one() -> None:
    expert, agent = (jnp.asarray(random_batch(32, 5, 1, seed).obs) for seed in (1, 2))
    discriminator, key = MLP.init((5, 16, 16, 1), key=jax.random.key(0)), jax.random.key(3)
    total, metrics = SETTINGS.loss(discriminator, expert, agent, key=key)
    d_expert, d_agent = (1 / (1 + np.exp(-np.asarray(discriminator(x)[:, 0], np.float64))) for x in (expert, agent))
    entropy = -np.mean(np.log(d_expert)) - np.mean(np.log(1 - d_agent))
    mixed = jax.random.uniform(key, (32, 1)) * (expert - agent) + agent
    slopes = jax.vmap(jax.grad(lambda x: discriminator(x)[0]))(mixed)
    penalty = np.mean((np.linalg.norm(slopes, axis=-1) - 1) ** 2)
    assert float(metrics["entropy_loss"]) == pytest.approx(entropy, rel=1e-4)
    assert float(total) == pytest.approx(entropy + 10 * penalty, rel=1e-3)


def test_penalty_keeps_the_slope_near_one() -> None:
    """Without it the logits of separable data grow without bound."""
    expert, agent = random_batch(33, 5, 1, 1), random_batch(33, 5, 1, 2)
    expert = staying(expert.obs + 3, expert.action)
    gaps = []
    for penalty in (0.0, 10.0):
        settings = dataclasses.replace(SETTINGS, penalty=penalty, learning_rate=1e-2)
        state = settings.init([expert], lambda x: x, key=jax.random.key(0))
        pair = batches(expert), batches(agent)
        update = jax.jit(lambda s, k, settings=settings, pair=pair: settings.update(s, *pair, lambda x: x, key=k))
        for i in range(150):
            state, metrics = update(state, jax.random.key(i))
        gaps.append(float(metrics["expert_logit"] - metrics["agent_logit"]))
    distance = float(np.linalg.norm(expert.obs.mean(0) - agent.obs.mean(0)))
    assert gaps[1] < 2 * distance < gaps[0]


def test_the_accuracy_counts_rows_on_their_side_of_zero() -> None:
    """With the state itself as the logit; a logit of 0 is on neither side."""
    discriminator = MLP((jnp.ones((1, 1)),), (jnp.zeros(1),))
    expert, agent = jnp.array([[0.5], [0.0], [-1.0], [3.0]]), jnp.array([[-0.5], [0.0], [0.0], [0.5]])
    _, metrics = SETTINGS.loss(discriminator, expert, agent, key=jax.random.key(0))
    assert float(metrics["accuracy"]) == (2 / 4 + 1 / 4) / 2


def test_the_representation_is_the_last_hidden_layer() -> None:
    """By a loop over the layers: the logit is linear in it."""
    state = SETTINGS.init([random_batch(8, 5, 1, 1)], lambda x: x, key=jax.random.key(0))
    discriminator, batch = state.discriminator, random_batch(8, 5, 1, 2)
    layer = np.asarray(batch.next_obs)
    for weight, bias in list(zip(discriminator.weights, discriminator.biases, strict=True))[:2]:
        layer = np.maximum(layer @ np.asarray(weight) + np.asarray(bias), 0)
    assert np.allclose(SETTINGS.representation(state, batch, lambda x: x), layer, atol=1e-5)
    logit = layer @ np.asarray(discriminator.weights[2]) + np.asarray(discriminator.biases[2])
    assert np.allclose(SETTINGS.reward(state, batch, lambda x: x, key=jax.random.key(0)), logit[:, 0], atol=1e-5)
