"""PCIL's reward against hand-computed numbers and a naive second implementation."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from pcil.learner import frozen_embed
from pcil.losses import gradient_penalty
from pcil.networks import MLP, unit_sphere
from pcil.rewards.pcil import PCIL, derangement, similarity
from pcil.types import Batch, Spec
from small import narrow, random_batch, small_run, windows


def features(seed: int, rows: int = 32, dim: int = 6) -> jnp.ndarray:
    return jnp.asarray(random_batch(rows, dim, 1, seed).obs)


SETTINGS = narrow(PCIL(), hidden=16)
ENCODER = MLP.init((6, 16, 16, 16, 4), key=jax.random.key(0))


@pytest.mark.parametrize("temperature", [0.07, 1.0])
def test_loss_equals_a_naive_one(temperature: float) -> None:
    """Loops over anchors and negatives in float64, with the very positives and mixtures that the key gives."""
    settings = dataclasses.replace(SETTINGS, temperature=temperature)
    expert, agent, partner, key = features(1), features(2), features(3), jax.random.key(4)
    total, metrics = settings.loss(ENCODER, expert, agent, partner, key=key)

    shift_key, mix_key = jax.random.split(key)
    phi_e, phi_a, phi_p = (np.asarray(unit_sphere(ENCODER(x)), np.float64) for x in (expert, agent, partner))
    positives = phi_e[np.asarray(derangement(shift_key, 32))]
    losses = []
    for i in range(32):
        positive = math.exp(phi_e[i] @ positives[i] / temperature)
        negatives = sum(math.exp(phi_e[i] @ phi_a[j] / temperature) for j in range(32))
        losses.append(-math.log(positive / (positive + negatives)))
    assert float(metrics["contrast_loss"]) == pytest.approx(np.mean(losses), rel=1e-4)

    u = jax.random.uniform(mix_key, (32, 1))
    slopes = []
    for i in range(32):
        mixed = u[i, 0] * expert[i] + (1 - u[i, 0]) * agent[i]
        slope = jax.grad(lambda x, i=i: jnp.dot(unit_sphere(ENCODER(x)), jnp.asarray(phi_p[i], jnp.float32)))(mixed)
        slopes.append((float(jnp.linalg.norm(slope)) - 1) ** 2)
    assert float(metrics["penalty"]) == pytest.approx(np.mean(slopes), rel=1e-3)
    assert float(total) == pytest.approx(np.mean(losses) + 10 * np.mean(slopes), rel=1e-3)


def test_no_gradient_flows_into_the_partner() -> None:
    """The penalty's gradient is that of a penalty whose partner embedding is a constant."""
    settings, key = dataclasses.replace(SETTINGS, penalty=1.0), jax.random.key(4)
    expert, agent, partner = features(1), features(2), features(3)
    fixed = unit_sphere(ENCODER(partner))
    u = jax.random.uniform(jax.random.split(key)[1], (32, 1))
    mixed = u * expert + (1 - u) * agent

    def penalty(encoder: MLP) -> jnp.ndarray:
        return gradient_penalty(lambda x: jnp.sum(unit_sphere(encoder(x)) * fixed, axis=-1), mixed)

    with_penalty = jax.grad(lambda e: settings.loss(e, expert, agent, partner, key=key)[0])(ENCODER)
    bare = dataclasses.replace(settings, penalty=0.0)
    without = jax.grad(lambda e: bare.loss(e, expert, agent, partner, key=key)[0])(ENCODER)
    got = jax.tree.map(jnp.subtract, with_penalty, without)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(jax.grad(penalty)(ENCODER)), strict=True):
        assert np.allclose(a, b, atol=1e-5)


def test_gradients_against_finite_differences() -> None:
    """The contrast alone, and the penalty with its partner as the constant that the loss makes of it."""
    with jax.enable_x64(True):
        double = lambda tree: jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), tree)  # noqa: E731
        encoder, expert, agent, fixed = double((ENCODER, features(1, 8), features(2, 8), features(3, 8, dim=4)))
        settings, key = dataclasses.replace(SETTINGS, penalty=0.0), jax.random.key(4)

        def contrast(e: MLP) -> jnp.ndarray:
            return settings.loss(e, expert, agent, expert, key=key)[0]

        def penalty(e: MLP) -> jnp.ndarray:
            return gradient_penalty(lambda x: jnp.sum(unit_sphere(e(x)) * fixed, axis=-1), expert)

        for loss in (contrast, penalty):
            check_grads(jax.jit(loss), (encoder,), order=1, modes=["rev"], eps=1e-6, atol=1e-5, rtol=1e-5)


def test_similarity_by_hand() -> None:
    """Two expert rows, three steps: "random" meets rows 0, 1, 0; "mean" meets their mean."""
    expert = jnp.array([[1.0, 0.0], [0.0, 1.0]])
    steps = jnp.array([[1.0, 0.0], [1.0, 0.0], [0.6, 0.8]])
    assert np.allclose(similarity(steps, expert, "random"), [1.0, 0.0, 0.6])
    assert np.allclose(similarity(steps, expert, "mean"), [0.5, 0.5, 0.7])


@pytest.mark.parametrize("compare", ["random", "mean"])
def test_reward_lies_between_minus_one_and_one(compare: str) -> None:
    settings = dataclasses.replace(SETTINGS, compare=compare)
    batch = random_batch(300, 6, 1)
    state = settings.init([batch], lambda obs: obs * 50, key=jax.random.key(0))
    got = settings.reward(state, jnp.asarray(batch.obs), jnp.asarray(batch.action), lambda obs: obs * 50, key=jax.random.key(1))
    assert np.abs(got).max() <= 1 + 1e-6 and np.std(got) > 0


def test_embedding_has_a_quarter_of_the_width_and_four_layers() -> None:
    """256-256-256-64 at the paper's width (Appendix B)."""
    state = PCIL(hidden=256).init([random_batch(9, 50, 1)], lambda obs: obs, key=jax.random.key(0))
    assert [weight.shape for weight in state.encoder.weights] == [(50, 256), (256, 256), (256, 256), (256, 64)]


def test_an_update_draws_experts_together_and_pushes_the_agent_away() -> None:
    """The sign of Eq. 1 as corrected: the margin between positive and negative similarity grows."""
    settings = dataclasses.replace(SETTINGS, learning_rate=1e-2, penalty=0.0)
    demo, agent = random_batch(33, 6, 1, 1), windows(random_batch(33, 6, 1, 2))
    demo = Batch(demo.obs + 0.5, demo.action)
    expert = windows(demo)
    state = settings.init([demo], lambda obs: obs, key=jax.random.key(0))
    margins = []
    for i in range(50):
        state, metrics = settings.update(state, expert, agent, lambda obs: obs, key=jax.random.key(i))
        margins.append(float(metrics["positive_similarity"] - metrics["negative_similarity"]))
    assert margins[-1] > margins[0] + 0.5


def test_reference_is_the_last_expert_batch() -> None:
    expert, agent = windows(random_batch(33, 6, 1, 1)), windows(random_batch(33, 6, 1, 2))
    state = SETTINGS.init([random_batch(99, 6, 1, 3)], lambda obs: obs, key=jax.random.key(0))
    after, _ = SETTINGS.update(state, expert, agent, lambda obs: obs, key=jax.random.key(1))
    assert np.array_equal(after.reference, expert.obs[:, 0]) and not np.array_equal(state.reference, expert.obs[:, 0])


def test_no_anchor_is_its_own_positive() -> None:
    for seed in range(50):
        partner = np.asarray(derangement(jax.random.key(seed), 7))
        assert sorted(partner) == list(range(7)) and not (partner == np.arange(7)).any()


def test_nothing_flows_into_the_agents_features() -> None:
    """Encoder updates stop at the features, as in the authors' agent/pcil.py: the loop's embed blocks the gradient."""
    run = small_run()
    agent = run.agent.init(Spec(6, 1, 1), key=jax.random.key(0))
    batch = random_batch(32, 6, 1)

    def loss(trained: object) -> jnp.ndarray:
        embed = frozen_embed(run.learner, trained)
        state = SETTINGS.init([batch], embed, key=jax.random.key(0))
        return jnp.sum(SETTINGS.reward(state, jnp.asarray(batch.obs), jnp.asarray(batch.action), embed, key=jax.random.key(1)))

    assert not any(np.any(leaf) for leaf in jax.tree.leaves(jax.grad(loss, allow_int=True)(agent)) if leaf.dtype == np.float32)
