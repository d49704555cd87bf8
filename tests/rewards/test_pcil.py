"""PCIL's reward compared with hand-computed numbers and a naive second implementation."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import hypothesis
import hypothesis.extra.numpy as arrays
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.extend import core
from jax.test_util import check_grads

from pcil.nets.losses import gradient_penalty
from pcil.nets.networks import MLP, unit_sphere
from pcil.rewards import label
from pcil.rewards.base import only
from pcil.rewards.embedding import EmbeddingState
from pcil.rewards.pcil import PCIL, derangement, stages
from pcil.training import learner
from pcil.training.learner import frozen_embed
from pcil.types import Batch, Spec
from small import batches, narrow, random_batch, small_run, staying, windows


def features(seed: int, rows: int = 32, dim: int = 6) -> jnp.ndarray:
    return jnp.asarray(random_batch(rows, dim, 1, seed).obs)


SETTINGS = narrow(PCIL(), hidden=16)
ENCODER = MLP.init((6, 16, 16, 16, 4), key=jax.random.key(0))


loss = jax.jit(PCIL.loss, static_argnums=0)


@functools.partial(jax.jit, static_argnums=0)
def update(settings: PCIL, state: EmbeddingState, expert: Batch, agent: Batch, *, key: Any) -> tuple[EmbeddingState, Any]:
    """One update in which the features are the observations."""
    return settings.update(state, expert, agent, lambda obs: obs, key=key)


@pytest.mark.parametrize(("temperature", "rows"), [(0.07, None), (1.0, None), (1.0, 5)])
def test_loss_equals_a_naive_one(temperature: float, rows: int | None) -> None:
    """Loops over anchors and negatives in float64, with the same positives and mixtures that the key gives."""
    settings = dataclasses.replace(SETTINGS, temperature=temperature, penalty_rows=rows)
    expert, agent, partner, key = features(1), features(2), features(3), jax.random.key(5)
    total, metrics = settings.loss(ENCODER, expert, agent, partner, key=key)

    shift_key, mix_key = jax.random.split(key)
    phi_e, phi_a, phi_p = (np.asarray(unit_sphere(ENCODER(x)), np.float64) for x in (expert, agent, partner))
    positives = phi_e[np.asarray(derangement(shift_key, 32))]
    losses = []
    for i in range(32):
        positive = math.exp(phi_e[i] @ positives[i] / temperature)
        negatives = sum(math.exp(phi_e[i] @ phi_a[j] / temperature) for j in range(32))
        losses.append(-math.log(positive / (positive + negatives)))
    assert float(metrics["contrast_loss"]) == pytest.approx(np.mean(losses), rel=1e-5)

    u = jax.random.uniform(mix_key, (rows or 32, 1))
    slopes = []
    for i in range(rows or 32):
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
    """The contrast alone, and the penalty with its partner held constant, as in the loss."""
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


@pytest.mark.parametrize("compare", ["random", "mean"])
def test_reward_lies_between_minus_one_and_one(compare: str) -> None:
    settings = dataclasses.replace(SETTINGS, compare=compare)
    batch = random_batch(300, 6, 1)
    state = settings.init([batch], lambda obs: obs * 50, key=jax.random.key(0))
    got = settings.reward(state, batch, lambda obs: obs * 50, key=jax.random.key(1))
    assert np.abs(got).max() <= 1 + 1e-6 and np.std(got) > 0


def test_embedding_has_a_quarter_of_the_width_and_four_layers() -> None:
    """256-256-256-64 at the paper's width (Appendix B)."""
    state = PCIL(hidden=256).init([random_batch(9, 50, 1)], lambda obs: obs, key=jax.random.key(0))
    assert [weight.shape for weight in state.encoder.weights] == [(50, 256), (256, 256), (256, 256), (256, 64)]


def test_the_representation_is_the_embedding_of_the_states_that_steps_lead_to() -> None:
    steps = random_batch(7, 6, 2)
    state = SETTINGS.init([steps], lambda obs: 2 * obs, key=jax.random.key(0))
    expected = unit_sphere(state.encoder(2 * jnp.asarray(steps.next_obs)))
    assert np.array_equal(SETTINGS.representation(state, steps, lambda obs: 2 * obs), expected) and expected.shape == (7, 4)


def test_an_update_draws_experts_together_and_pushes_the_agent_away() -> None:
    """The sign of Eq. 1 as corrected: the margin between positive and negative similarity grows."""
    settings = dataclasses.replace(SETTINGS, learning_rate=1e-2, penalty=0.0)
    demo, agent = random_batch(33, 6, 1, 1), batches(random_batch(33, 6, 1, 2))
    demo = staying(demo.obs + 0.5, demo.action)
    expert = batches(demo)
    state = settings.init([demo], lambda obs: obs, key=jax.random.key(0))
    margins = []
    for i in range(50):
        state, metrics = settings.update(state, expert, agent, lambda obs: obs, key=jax.random.key(i))
        margins.append(float(metrics["positive_similarity"] - metrics["negative_similarity"]))
    assert margins[-1] > margins[0] + 0.5


def test_reference_is_the_last_expert_batch() -> None:
    expert, agent = batches(random_batch(33, 6, 1, 1)), batches(random_batch(33, 6, 1, 2))
    state = SETTINGS.init([random_batch(99, 6, 1, 3)], lambda obs: obs, key=jax.random.key(0))
    after, _ = SETTINGS.update(state, expert, agent, lambda obs: obs, key=jax.random.key(1))
    assert np.array_equal(after.reference.next_obs, expert.next_obs[:, 0])
    assert not np.array_equal(state.reference.next_obs, expert.next_obs[:, 0])


def test_the_penaltys_partner_is_the_batch_before_and_its_mixtures_are_of_expert_and_agent_rows() -> None:
    """One row's gradient at a time: the partners of the first update are the random references, those of the second its batch.

    `u` is drawn with the second half of the update's key.
    """
    pairs = [[batches(random_batch(33, 6, 1, seed)) for seed in (10 + i, 20 + i)] for i in range(2)]
    state = SETTINGS.init([random_batch(99, 6, 1, 3)], lambda obs: obs, key=jax.random.key(0))

    @jax.jit
    def slopes(encoder: MLP, expert: jnp.ndarray, agent: jnp.ndarray, partner: jnp.ndarray, key: Any) -> jnp.ndarray:
        u = jax.random.uniform(jax.random.split(key)[1], (32, 1))
        similarity = lambda x, other: jnp.dot(unit_sphere(encoder(x)), unit_sphere(encoder(other)))  # noqa: E731
        slope = jax.vmap(jax.grad(similarity))(u * expert + (1 - u) * agent, partner)
        return jnp.mean((jnp.linalg.norm(slope, axis=1) - 1) ** 2)

    for i, (expert, agent) in enumerate(pairs):
        key, before = jax.random.key(5 + i), state
        state, metrics = update(SETTINGS, before, expert, agent, key=key)
        of = functools.partial(slopes, before.encoder, expert.next_obs[:, 0], key=key)
        partner = before.reference.next_obs
        expected = float(of(agent=agent.next_obs[:, 0], partner=partner))
        assert float(metrics["penalty"]) == pytest.approx(expected, rel=1e-4)
        others = (expert.next_obs[:, 0], partner), (agent.next_obs[:, 0], expert.next_obs[:, 0])
        for rows, partner in others:
            assert float(of(agent=rows, partner=partner)) != pytest.approx(expected, rel=1e-3)
        assert np.array_equal(state.reference.next_obs, expert.next_obs[:, 0])


def test_no_anchor_is_its_own_positive() -> None:
    for seed in range(50):
        partner = np.asarray(derangement(jax.random.key(seed), 7))
        assert sorted(partner) == list(range(7)) and not (partner == np.arange(7)).any()


# --- A lazy penalty ---


def test_a_lazy_penalty_comes_at_every_so_many_updates_and_weighs_as_much_more() -> None:
    """With `penalty_every = 3`: the loss with three times the penalty at updates 0, 3, ...; only the contrast in between."""
    lazy, key = dataclasses.replace(SETTINGS, penalty_every=3), jax.random.key(4)
    parts = features(1), features(2), features(3)
    _, usual = loss(SETTINGS, ENCODER, *parts, key=key)
    for count in range(7):
        total, metrics = loss(lazy, ENCODER, *parts, key=key, count=jnp.int32(count))
        penalty = 3 * float(usual["penalty"]) if count % 3 == 0 else 0.0
        assert float(metrics["penalty"]) == pytest.approx(penalty, rel=1e-5)
        assert float(total) == pytest.approx(float(usual["contrast_loss"]) + 10 * penalty, rel=1e-5)


def test_without_a_count_it_is_the_first_update() -> None:
    settings, rows = dataclasses.replace(SETTINGS, penalty_every=2), (features(1), features(2), features(3))
    first, second = (settings.loss(ENCODER, *rows, key=jax.random.key(0), **given)[1] for given in ({}, {"count": 1}))
    assert first["penalty"] > 0 == second["penalty"]


def test_updates_are_counted_by_the_state() -> None:
    lazy = dataclasses.replace(SETTINGS, penalty_every=2)
    expert, agent = batches(random_batch(33, 6, 1, 1)), batches(random_batch(33, 6, 1, 2))
    state = lazy.init([random_batch(99, 6, 1, 3)], lambda obs: obs, key=jax.random.key(0))
    came = []
    for i in range(5):
        state, metrics = update(lazy, state, expert, agent, key=jax.random.key(i))
        came.append(float(metrics["penalty"]) > 0)
    assert came == [True, False, True, False, True]


def products(settings: PCIL) -> tuple[int, int]:
    """The numbers of matrix products in the gradient of the loss that are always computed, and that are inside a `cond`."""
    parts = features(1), features(2), features(3)
    slope = jax.grad(lambda e, count: settings.loss(e, *parts, key=jax.random.key(4), count=count)[0])

    def count(jaxpr: Any, inside: bool) -> np.ndarray:
        total = np.zeros(2, int)
        for equation in jaxpr.eqns:
            total[int(inside)] += equation.primitive.name == "dot_general"
            for inner in core.jaxprs_in_params(equation.params):
                total += count(inner, inside or equation.primitive.name == "cond")
        return total

    always, sometimes = count(jax.make_jaxpr(slope)(ENCODER, jnp.int32(0)).jaxpr, False)
    return always, sometimes


def test_between_its_turns_a_lazy_penalty_costs_no_matrix_product() -> None:
    """The contrast alone has 4 layers and the cosines forwards, and 2 for each backwards except the first layer's input: 14."""
    always, sometimes = products(SETTINGS)
    lazy_always, lazy_sometimes = products(dataclasses.replace(SETTINGS, penalty_every=4))
    assert sometimes == 0, "if the penalty is always computed there is no branch"
    assert lazy_always == 14 and lazy_sometimes == always - 14 > 0


# --- Anchors on the agent's stages ---


def test_stages_are_quantiles_of_the_batch_by_hand() -> None:
    """For rows of episodes 5, 5, 9, 2, the numbers of rows from earlier episodes are 1, 1, 3, 0."""
    number = jnp.array([5, 5, 9, 2])
    assert stages(number, 1).tolist() == [0, 0, 0, 0]
    assert stages(number, 2).tolist() == [0, 0, 1, 0]
    assert stages(number, 4).tolist() == [1, 1, 3, 0]


@given(number=arrays.arrays(np.int32, 12, elements=st.integers(0, 20)), count=st.integers(1, 6))
@hypothesis.settings(deadline=None, derandomize=True, max_examples=50)
def test_stages_follow_the_order_of_episodes_and_part_none(number: np.ndarray, count: int) -> None:
    stage = np.asarray(stages(jnp.asarray(number), count))
    assert stage.min() == 0 and stage.max() < count
    order = np.argsort(number, kind="stable")
    assert (np.diff(stage[order]) >= 0).all(), "a later episode is never in an earlier stage"
    assert all(len(set(stage[number == n])) == 1 for n in number)
    assert np.array_equal(stage, stages(jnp.asarray(3 * number + 7), count)), "only the order counts"
    if len(set(number)) == 12 and 12 % count == 0:
        assert np.array_equal(np.bincount(stage), np.full(count, 12 // count)), "stages are of equal size"


def test_anchors_on_stages_add_their_weighted_loss_and_leave_the_experts_alone() -> None:
    """Naive loops over agent anchors: rows of the same stage attract, other stages and the expert repel; no other change."""
    settings, key = dataclasses.replace(SETTINGS, temperature=0.5, stages=3, stage_weight=0.25), jax.random.key(4)
    parts = features(1), features(2), features(3)
    number = np.random.default_rng(0).integers(0, 9, 32)
    total, metrics = loss(settings, ENCODER, *parts, key=key, episode_id=jnp.asarray(number))
    without, usual = loss(dataclasses.replace(settings, stages=0), ENCODER, *parts, key=key)

    phi_e, phi_a = (np.asarray(unit_sphere(ENCODER(x)), np.float64) for x in parts[:2])
    stage = [3 * sum(other < own for other in number) // 32 for own in number]
    assert len(set(stage)) == 3
    losses = []
    for i in range(32):
        against = [phi_a[j] for j in range(32) if stage[j] != stage[i]] + list(phi_e)
        exponentials = sum(math.exp(phi_a[i] @ other / 0.5) for other in against)
        mates = [math.exp(phi_a[i] @ phi_a[j] / 0.5) for j in range(32) if j != i and stage[j] == stage[i]]
        losses.append(np.mean([-math.log(mate / (mate + exponentials)) for mate in mates]))
    assert float(metrics["stage_loss"]) == pytest.approx(np.mean(losses), rel=1e-5)
    assert float(total) == pytest.approx(float(without) + 0.25 * np.mean(losses), rel=1e-5)
    assert all(float(metrics[name]) == pytest.approx(float(usual[name]), rel=1e-6) for name in usual)


def test_stages_come_from_the_agents_episodes_and_only_where_they_are_asked_for() -> None:
    expert, agent = batches(random_batch(33, 6, 1, 1)), batches(random_batch(33, 6, 1, 2))
    mixed = np.arange(32, dtype=np.int32)

    def encoder_after(settings: PCIL, of_expert: np.ndarray, of_agent: np.ndarray) -> np.ndarray:
        state = settings.init([random_batch(99, 6, 1, 3)], lambda obs: obs, key=jax.random.key(0))
        pair = expert._replace(episode_id=of_expert), agent._replace(episode_id=of_agent)
        return np.asarray(update(settings, state, *pair, key=jax.random.key(1))[0].encoder.weights[0])

    staged = dataclasses.replace(SETTINGS, stages=4)
    assert not np.array_equal(encoder_after(staged, mixed, 0 * mixed), encoder_after(staged, mixed, mixed))
    assert np.array_equal(encoder_after(staged, mixed, mixed), encoder_after(staged, 0 * mixed, mixed))
    assert np.array_equal(encoder_after(SETTINGS, mixed, 0 * mixed), encoder_after(SETTINGS, mixed, mixed))


def test_training_gathers_each_stage_and_parts_it_from_the_others() -> None:
    """Two separate stages of the agent: each becomes a cluster, away from the other and from the expert."""
    settings = dataclasses.replace(SETTINGS, stages=2, learning_rate=1e-2, penalty=0.0)
    demo, rows = random_batch(33, 6, 1, 1), random_batch(33, 6, 1, 2)
    late = np.arange(33) % 2
    agent = batches(staying(rows.obs + np.float32(1.5) * late[:, None].astype(np.float32), rows.action))
    agent = agent._replace(episode_id=late[:32].astype(np.int32))
    state = settings.init([demo], lambda obs: obs, key=jax.random.key(0))
    for i in range(200):
        state, metrics = update(settings, state, batches(demo), agent, key=jax.random.key(i))
    z = np.asarray(unit_sphere(state.encoder(jnp.asarray(agent.next_obs[:, 0]))))
    early, late = (z[late[:32] == which] for which in (0, 1))
    within = (np.mean(early @ early.T) + np.mean(late @ late.T)) / 2
    assert within > np.mean(early @ late.T) + 0.8
    assert float(metrics["negative_similarity"]) < within - 0.8


# --- Demonstrations and a reward ---


def test_with_a_task_weight_the_label_is_a_weighted_sum_by_hand() -> None:
    """The setting of the paper's outlook. The features are the embedding: a step to (3, 4) has cosine 0.6 with (1, 0).

    With a task reward of 2 and weight 0.5, its label is 0.6 + 1.
    """
    encoder = MLP((jnp.eye(2),), (jnp.zeros(2),))
    state = EmbeddingState(encoder, None, only("state", staying(jnp.array([[1.0, 0.0]]), jnp.zeros((1, 1)))), None)
    obs, action, paid = jnp.array([[0.0, 1.0], [3.0, 4.0], [-1.0, 0.0]]), jnp.zeros((2, 1)), jnp.array([2.0, -4.0])
    for weight, expected in ((0.5, [0.6 + 1, -1 - 2]), (0.0, [0.6, -1])):
        settings = dataclasses.replace(SETTINGS, task_weight=weight)
        got = label(settings, state, Batch.of(obs, action), paid, lambda x: x, key=jax.random.key(0))
        assert np.allclose(got, expected, atol=1e-6)


def test_the_agent_is_trained_on_the_weighted_sum() -> None:
    """In the compiled step, the mean of the target increases by exactly weight x reward, discounted over the window."""
    run = small_run(reward={"task_weight": 0.5})
    spec, demos, n = Spec(2, 2, 1), random_batch(50, 2, 2), run.agent.n_step
    window, expert = windows(random_batch(32 + n, 2, 2, seed=1), n), windows(random_batch(33, 2, 2))
    targets = []
    for paid in (0.0, 3.0):
        state = learner.init(run.learner, spec, [demos], 0)
        window = window._replace(reward=np.full_like(window.reward, paid))
        state, _ = learner.update(run.learner, state, window, expert, None, np.int32(0), np.int32(0))
        targets.append(float(state.totals["agent/target"]))
    discounts = sum(run.agent.gamma**k for k in range(n))
    assert targets[1] - targets[0] == pytest.approx(0.5 * 3 * discounts, rel=1e-4)


def test_actions_make_no_difference() -> None:
    """The encoder is a function of the state (section 3.2), although Eq. 1 is written with pairs."""
    demo, seen = random_batch(33, 6, 1, 1), random_batch(33, 6, 1, 2)
    learned = []
    for factor in (1, -1):
        pair = [staying(batch.obs, batch.action * factor) for batch in (demo, seen)]
        state = SETTINGS.init(pair[:1], lambda obs: obs, key=jax.random.key(0))
        state, _ = update(SETTINGS, state, *map(batches, pair), key=jax.random.key(1))
        embed = {"embed": lambda obs: obs, "key": jax.random.key(2)}
        paid = SETTINGS.reward(state, pair[1], **embed)
        learned.append([*jax.tree.leaves(state), paid])
    assert all(np.array_equal(one, other) for one, other in zip(*learned, strict=True))


def test_nothing_flows_into_the_agents_features() -> None:
    """The gradient of encoder updates stops at the features, as in the authors' agent/pcil.py: the loop's `embed` blocks it."""
    run = small_run()
    agent = run.agent.init(Spec(6, 1, 1), key=jax.random.key(0))
    batch = random_batch(32, 6, 1)

    def loss(trained: object) -> jnp.ndarray:
        embed = frozen_embed(run.learner, trained)
        state = SETTINGS.init([batch], embed, key=jax.random.key(0))
        return jnp.sum(SETTINGS.reward(state, batch, embed, key=jax.random.key(1)))

    assert not any(np.any(leaf) for leaf in jax.tree.leaves(jax.grad(loss, allow_int=True)(agent)) if leaf.dtype == np.float32)
