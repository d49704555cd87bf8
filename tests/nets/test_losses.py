"""The losses: hand-computed numbers, naive second implementations in float64, and derivatives."""

from __future__ import annotations

import math

import hypothesis.extra.numpy as arrays
import jax
import jax.numpy as jnp
import jax.test_util
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import Array, Float

from pcil.nets import losses

law = settings(deadline=None, derandomize=True, max_examples=30)
info_nce = jax.jit(losses.info_nce, static_argnums=3)
info_nce_slopes = jax.jit(jax.grad(losses.info_nce, (1, 2), has_aux=True), static_argnums=3)
gradient_penalty = jax.jit(losses.gradient_penalty, static_argnums=0)
group_info_nce = jax.jit(losses.group_info_nce, static_argnums=3)
interpolate = jax.jit(losses.interpolate)
binary_cross_entropy = jax.jit(losses.binary_cross_entropy)
n_step_target = jax.jit(losses.n_step_target, static_argnums=3)
SHAPES = ((1, 1, 2), (4, 3, 5), (3, 8, 2))
"""Batch, negatives, dimensions; only a few, because each is compiled."""


def unit_rows(rng: np.random.Generator, rows: int, dim: int) -> np.ndarray:
    x = rng.normal(size=(rows, dim))
    return x / np.linalg.norm(x, axis=-1, keepdims=True)


@st.composite
def embeddings(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Anchors, positives and negatives on the unit sphere, in float64; rows may be equal."""
    batch, negatives, dim = draw(st.sampled_from(SHAPES))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    pool = unit_rows(rng, 1 + draw(st.integers(0, 20)), dim)
    return tuple(pool[rng.integers(len(pool), size=rows)] for rows in (batch, batch, negatives))


def circle(*cosines: float) -> Float[Array, "rows 2"]:
    """Unit vectors in the plane with given cosines with (1, 0)."""
    return jnp.array([[c, math.sqrt(1 - c * c)] for c in cosines])


# --- The contrastive loss ---


def naive_info_nce(anchor: np.ndarray, positive: np.ndarray, negatives: np.ndarray, temperature: float) -> float:
    """Eq. 1 with its sign corrected, written out: for each anchor, one exponential after the other."""
    losses = []
    for a, p in zip(anchor, positive, strict=True):
        numerator = math.exp(sum(x * y for x, y in zip(a, p, strict=True)) / temperature)
        others = [math.exp(sum(x * y for x, y in zip(a, n, strict=True)) / temperature) for n in negatives]
        losses.append(-math.log(numerator / (numerator + sum(others))))
    return sum(losses) / len(losses)


@pytest.mark.parametrize("cosine", [1.0, 0.0, -1.0])
def test_info_nce_of_equal_cosines_is_the_log_of_the_number_of_candidates(cosine: float) -> None:
    anchor, other = jnp.tile(circle(1.0), (128, 1)), jnp.tile(circle(cosine), (128, 1))
    loss, _ = info_nce(anchor, other, other, 0.07)
    assert float(loss) == pytest.approx(math.log(129), abs=1e-5)
    assert float(loss) == pytest.approx(4.860, abs=5e-4)  # log(1 + 128)


def test_info_nce_at_temperature_1_cannot_fall_below_its_floor() -> None:
    anchor = jnp.tile(circle(1.0), (128, 1))
    loss, _ = info_nce(anchor, anchor, -anchor, 1.0)
    assert float(loss) == pytest.approx(math.log(1 + 128 * math.exp(-2)), abs=1e-5)
    assert float(loss) == pytest.approx(2.908, abs=5e-4)  # log(1 + 128 e^-2)


def test_info_nce_of_two_anchors_by_hand() -> None:
    """Temperature 1/2. Anchor 1: positive 1.2, negatives 2 and 0, so -1.2 + log(e^1.2 + e^2 + 1) = 1.260373.

    Anchor 2: positive 2, negatives 0 and -2, so -2 + log(e^2 + 1 + e^-2) = 0.142932. The mean is 0.701653.
    """
    anchor, positive = jnp.array([[1.0, 0.0], [0.0, 1.0]]), jnp.array([[0.6, 0.8], [0.0, 1.0]])
    negatives = jnp.array([[1.0, 0.0], [0.0, -1.0]])
    loss, diagnostics = info_nce(anchor, positive, negatives, 0.5)
    assert float(loss) == pytest.approx(0.701653, abs=1e-6)
    assert float(diagnostics["positive_similarity"]) == pytest.approx((0.6 + 1) / 2)
    assert float(diagnostics["negative_similarity"]) == pytest.approx((1 + 0 + 0 - 1) / 4, abs=1e-7)
    assert float(diagnostics["accuracy"]) == 0.5  # the first anchor is nearer to a negative than to its positive
    assert set(diagnostics) == {"positive_similarity", "negative_similarity", "accuracy"}


def test_accuracy_is_the_share_of_anchors_whose_positive_beats_every_negative() -> None:
    """Only the first positive does: the second ties with a negative, and the third and the fourth are beaten by one."""
    positive = jnp.array([0.5, 0.2, 0.9, -0.5])
    negative = jnp.array([[0.4, -1.0], [0.2, 0.0], [0.8, 0.95], [-0.6, 0.3]])
    assert float(losses.contrast(positive, negative, 1.0)[1]["accuracy"]) == 0.25


@law
@given(embeddings(), st.sampled_from([0.07, 1.0]))
def test_info_nce_equals_the_equation_written_out(rows: tuple, temperature: float) -> None:
    with jax.enable_x64(True):
        loss, diagnostics = info_nce(*map(jnp.asarray, rows), temperature)
    anchor, positive, negatives = rows
    assert float(loss) == pytest.approx(naive_info_nce(*rows, temperature), rel=1e-9, abs=1e-12)
    assert float(loss) >= 0
    assert float(diagnostics["positive_similarity"]) == pytest.approx(np.mean(np.sum(anchor * positive, axis=1)))
    assert float(diagnostics["negative_similarity"]) == pytest.approx(np.mean(anchor @ negatives.T), abs=1e-12)
    assert 0 <= float(diagnostics["accuracy"]) <= 1


@law
@given(embeddings(), st.randoms(use_true_random=False))
def test_info_nce_does_not_depend_on_the_order_of_the_negatives(rows: tuple, random) -> None:
    anchor, positive, negatives = rows
    order = list(range(len(negatives)))
    random.shuffle(order)
    with jax.enable_x64(True):
        first, _ = info_nce(*map(jnp.asarray, rows), 0.07)
        second, _ = info_nce(jnp.asarray(anchor), jnp.asarray(positive), jnp.asarray(negatives[order]), 0.07)
    assert float(first) == pytest.approx(float(second), rel=1e-12, abs=1e-15)


def test_info_nce_falls_as_the_positive_and_rises_as_a_negative_comes_nearer() -> None:
    anchor, grid = circle(1.0), np.linspace(-1, 1, 21)
    by_positive = [info_nce(anchor, circle(c), circle(0.3, -0.2), 0.5)[0] for c in grid]
    by_negative = [info_nce(anchor, circle(0.3), circle(c, -0.2), 0.5)[0] for c in grid]
    assert np.all(np.diff(by_positive) < 0)
    assert np.all(np.diff(by_negative) > 0)


@law
@given(st.integers(0, 2**32), st.sampled_from([0.07, 1.0]))
def test_a_step_against_the_gradient_draws_the_positive_in_and_pushes_every_negative_away(
    seed: int, temperature: float
) -> None:
    """This sign is wrong in the paper's Eq. 1."""
    rng = np.random.default_rng(seed)
    with jax.enable_x64(True):
        anchor, positive, negatives = (jnp.asarray(unit_rows(rng, rows, 4)) for rows in (1, 1, 6))
        (to_positive, to_negatives), _ = info_nce_slopes(anchor, positive, negatives, temperature)
        assert float(anchor[0] @ -to_positive[0]) > 0
        assert np.all(np.asarray(-to_negatives @ anchor[0]) < 0)


@pytest.mark.parametrize(
    ("positive", "negative", "expected"),
    [(1.0, -1.0, 0.0), (-1.0, 1.0, 2e4 + math.log(128)), (1.0, 1.0, math.log(129)), (-1.0, -1.0, math.log(129))],
)
def test_info_nce_is_right_at_logits_of_ten_thousand(positive: float, negative: float, expected: float) -> None:
    anchor = jnp.tile(circle(1.0), (128, 1))
    rows = anchor, positive * anchor, negative * anchor
    (loss, _), gradient = jax.value_and_grad(info_nce, has_aux=True)(*rows, 1e-4)
    assert float(loss) == pytest.approx(expected, rel=1e-6, abs=1e-3)  # float32 has steps of 1e-3 at 1e4
    assert np.isfinite(gradient).all()


def test_info_nce_has_the_derivative_that_differences_show() -> None:
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        rows = tuple(jnp.asarray(unit_rows(rng, n, 4)) for n in (3, 3, 5))
        assert info_nce(*rows, 0.5)[0].dtype == jnp.float64
        jax.test_util.check_grads(lambda *r: info_nce(*r, 0.5)[0], rows, order=1)


def naive_group_info_nce(rows: np.ndarray, group: np.ndarray, others: np.ndarray, temperature: float) -> float:
    """For each anchor and each positive, the loss with the negatives of that anchor."""
    of_anchors = []
    for i, anchor in enumerate(rows):
        negatives = np.concatenate([rows[group != group[i]], others])
        partners = [j for j in range(len(rows)) if j != i and group[j] == group[i]]
        costs = [naive_info_nce(anchor[None], rows[j][None], negatives, temperature) for j in partners]
        of_anchors.append(sum(costs) / len(costs) if costs else 0.0)
    return sum(of_anchors) / len(of_anchors)


@law
@given(st.integers(0, 2**32), st.integers(1, 4), st.sampled_from([0.07, 1.0]))
def test_the_loss_of_groups_equals_a_naive_one(seed: int, groups: int, temperature: float) -> None:
    rng = np.random.default_rng(seed)
    rows, group, others = unit_rows(rng, 6, 3), rng.integers(groups, size=6), unit_rows(rng, 4, 3)
    with jax.enable_x64(True):
        loss = group_info_nce(jnp.asarray(rows), jnp.asarray(group), jnp.asarray(others), temperature)
    assert float(loss) == pytest.approx(naive_group_info_nce(rows, group, others, temperature), rel=1e-9, abs=1e-12)


def test_the_loss_of_groups_by_hand() -> None:
    """Two rows at (1, 0) in one group, one at (0, 1) alone in another, one other row at (-1, 0); temperature 1.

    Each of the two: positive 1, negatives 0 and -1, so -1 + log(e + 1 + 1/e) = 0.407606. The third adds 0; the mean is
    0.271737.
    """
    rows = jnp.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
    loss = group_info_nce(rows, jnp.array([7, 2, 7]), jnp.array([[-1.0, 0.0]]), 1.0)
    assert float(loss) == pytest.approx(0.271737, abs=1e-6)


def test_with_one_group_it_is_info_nce_averaged_over_all_partners() -> None:
    rng = np.random.default_rng(0)
    rows, others = (jnp.asarray(unit_rows(rng, n, 3), jnp.float32) for n in (5, 4))
    by_shift = [float(info_nce(rows, jnp.roll(rows, shift, axis=0), others, 0.5)[0]) for shift in range(1, 5)]
    loss = group_info_nce(rows, jnp.zeros(5, jnp.int32), others, 0.5)
    assert float(loss) == pytest.approx(np.mean(by_shift), rel=1e-6)


def test_the_loss_of_groups_has_the_derivative_that_differences_show_and_no_infinite_one() -> None:
    rng, group = np.random.default_rng(0), jnp.array([0, 1, 0, 1, 2])
    with jax.enable_x64(True):
        rows, others = (jnp.asarray(unit_rows(rng, n, 3)) for n in (5, 4))
        jax.test_util.check_grads(lambda r, o: group_info_nce(r, group, o, 0.5), (rows, others), order=1)
    sharp = jax.grad(lambda r: group_info_nce(r, group, -r, 1e-4))(jnp.tile(circle(1.0), (5, 1)))
    assert np.isfinite(sharp).all()


def test_off_the_diagonal_is_all_but_the_diagonal() -> None:
    square = jnp.arange(16.0).reshape(4, 4)
    assert losses.off_diagonal(square).tolist() == [[1, 2, 3], [4, 6, 7], [8, 9, 11], [12, 13, 14]]


# --- The gradient penalty ---


@pytest.mark.parametrize(("slope", "penalty"), [((0.6, 0.8), 0.0), ((0.0, 3.0), 4.0), ((0.3, 0.4), 0.25), ((0.0, 0.0), 1.0)])
def test_the_penalty_of_a_plane_is_how_far_its_slope_is_from_1(slope: tuple[float, float], penalty: float) -> None:
    x = jnp.asarray(np.random.default_rng(0).normal(size=(7, 2)), jnp.float32)
    assert float(gradient_penalty(lambda rows: rows @ jnp.array(slope), x)) == pytest.approx(penalty, abs=1e-5)


def test_the_penalty_of_a_flat_function_has_a_finite_gradient() -> None:
    x = jnp.ones((3, 2))
    gradient = jax.grad(lambda slope: gradient_penalty(lambda rows: rows @ slope, x))(jnp.zeros(2))
    assert np.isfinite(gradient).all()


def tanh_network(x: Float[Array, "*batch 3"], weights: list[np.ndarray]) -> Float[Array, "*batch"]:
    first, second, last = weights
    return jnp.tanh(jnp.tanh(x @ first) @ second) @ last


@jax.jit
def network_penalty(weights: list[np.ndarray], x: Float[Array, "rows 3"]) -> Float[Array, ""]:
    return losses.gradient_penalty(lambda rows: tanh_network(rows, weights), x)


@jax.jit
def slope_of_each_row(weights: list[np.ndarray], x: Float[Array, "rows 3"]) -> Float[Array, "rows 3"]:
    return jax.vmap(jax.grad(tanh_network), (0, None))(x, weights)


def network_weights(seed: int) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(3, 6)), rng.normal(size=(6, 6)), rng.normal(size=6)]


@law
@given(st.integers(0, 2**32), st.sampled_from([1, 5]))
def test_the_penalty_equals_one_gradient_a_row(seed: int, rows: int) -> None:
    weights, x = network_weights(seed), np.random.default_rng(seed + 1).normal(size=(rows, 3))
    with jax.enable_x64(True):
        slope = slope_of_each_row(weights, jnp.asarray(x))
        penalty = network_penalty(weights, jnp.asarray(x))
    naive = [(math.sqrt(sum(g * g for g in row)) - 1) ** 2 for row in np.asarray(slope).tolist()]
    assert float(penalty) == pytest.approx(sum(naive) / rows, rel=1e-6, abs=1e-10)


def test_the_penalty_is_the_mean_of_its_rows() -> None:
    weights, x = network_weights(3), np.random.default_rng(4).normal(size=(6, 3))
    with jax.enable_x64(True):
        alone = [float(network_penalty(weights, jnp.asarray(row)[None])) for row in x]
        together = float(network_penalty(weights, jnp.asarray(x)))
    assert together == pytest.approx(np.mean(alone), rel=1e-12)
    assert np.std(alone) > 0.01


def test_the_penalty_has_the_derivative_that_differences_show() -> None:
    with jax.enable_x64(True):
        weights = [jnp.asarray(w) for w in network_weights(5)]
        x = jnp.asarray(np.random.default_rng(6).normal(size=(4, 3)))
        assert network_penalty(weights, x).dtype == jnp.float64
        jax.test_util.check_grads(network_penalty, (weights, x), order=1)


def test_interpolation_is_the_expert_at_1_the_agent_at_0_and_the_middle_at_one_half_row_by_row() -> None:
    rng = np.random.default_rng(0)
    expert, agent = (jnp.asarray(rng.normal(size=(3, 4)), jnp.float32) for _ in range(2))
    mixed = np.asarray(interpolate(jnp.array([[1.0], [0.0], [0.5]]), expert, agent))
    np.testing.assert_array_equal(mixed[0], expert[0])
    np.testing.assert_array_equal(mixed[1], agent[1])
    np.testing.assert_allclose(mixed[2], (np.asarray(expert[2]) + np.asarray(agent[2])) / 2, rtol=1e-6)


# --- The discriminator's loss ---


@pytest.mark.parametrize(
    ("expert", "agent", "loss"),
    [
        ([0.0], [0.0], 2 * math.log(2)),
        ([math.log(3)], [math.log(3)], math.log(4 / 3) + math.log(4)),  # D = 3/4: -log(3/4) - log(1/4)
        ([0.0, math.log(3)], [-math.log(3), 0.0], math.log(2) + math.log(4 / 3)),
    ],
)
def test_cross_entropy_by_hand(expert: list[float], agent: list[float], loss: float) -> None:
    assert float(binary_cross_entropy(jnp.array(expert), jnp.array(agent))) == pytest.approx(loss, rel=1e-6)


logits = arrays.arrays(np.float64, 5, elements=st.floats(-30, 30))


@law
@given(logits, logits)
def test_cross_entropy_equals_the_logarithms_of_the_sigmoid(expert: np.ndarray, agent: np.ndarray) -> None:
    with jax.enable_x64(True):
        loss = float(binary_cross_entropy(jnp.asarray(expert), jnp.asarray(agent)))
    naive = np.mean(-np.log(1 / (1 + np.exp(-expert)))) + np.mean(-np.log(1 / (1 + np.exp(agent))))
    assert loss == pytest.approx(naive, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize(("expert", "agent", "loss"), [(1e4, -1e4, 0), (-1e4, -1e4, 1e4), (1e4, 1e4, 1e4), (-1e4, 1e4, 2e4)])
def test_cross_entropy_is_exact_at_logits_of_ten_thousand(expert: float, agent: float, loss: float) -> None:
    rows = jnp.array([expert]), jnp.array([agent])
    value, gradient = jax.value_and_grad(binary_cross_entropy, (0, 1))(*rows)
    assert float(value) == loss
    assert np.isfinite(gradient).all()


def test_the_expert_has_label_1() -> None:
    expert, agent = jax.grad(binary_cross_entropy, (0, 1))(jnp.array([0.3, -2.0]), jnp.array([0.3, -2.0]))
    assert np.all(np.asarray(expert) < 0)  # a gradient descent step raises the expert's logits
    assert np.all(np.asarray(agent) > 0)


def test_cross_entropy_has_the_derivative_that_differences_show() -> None:
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        rows = jnp.asarray(rng.normal(size=4)), jnp.asarray(rng.normal(size=4))
        assert binary_cross_entropy(*rows).dtype == jnp.float64
        jax.test_util.check_grads(binary_cross_entropy, rows, order=1)


# --- The n-step target ---


def naive_n_step_target(reward: list[float], discount: list[float], bootstrap: float, gamma: float) -> float:
    """Forwards in time: the discounted reward of each step, until the episode terminates."""
    total, worth = 0.0, 1.0
    for r, alive in zip(reward, discount, strict=True):
        total += worth * r
        worth *= gamma * alive
    return total + worth * bootstrap


def test_one_step_is_the_reward_and_the_discounted_value() -> None:
    target = n_step_target(jnp.array([[2.0], [2.0]]), jnp.array([[1.0], [0.0]]), jnp.array([10.0, 10.0]), 0.9)
    np.testing.assert_allclose(target, [2 + 0.9 * 10, 2])


@pytest.mark.parametrize(
    ("discount", "target"),
    [((1, 1, 1), 1 + 2 / 2 + 4 / 4 + 16 / 8), ((1, 1, 0), 1 + 2 / 2 + 4 / 4), ((1, 0, 0), 1 + 2 / 2), ((0, 0, 0), 1)],
)
def test_three_steps_by_hand_with_a_termination_at_each(discount: tuple[int, ...], target: float) -> None:
    """Rewards 1, 2, 4, a bootstrap value of 16 and a discount of 1/2."""
    result = n_step_target(jnp.array([[1.0, 2.0, 4.0]]), jnp.array([discount], jnp.float32), jnp.array([16.0]), 0.5)
    assert float(result[0]) == target


@law
@given(st.sampled_from([1, 3, 5]), st.integers(0, 2**32), st.floats(0, 1))
def test_the_target_equals_the_sum_forwards_in_time(n: int, seed: int, gamma: float) -> None:
    rng = np.random.default_rng(seed)
    reward, bootstrap = rng.normal(size=(4, n)), rng.normal(size=4)
    discount = (rng.random((4, n)) < 0.7).astype(np.float64)
    with jax.enable_x64(True):
        target = n_step_target(jnp.asarray(reward), jnp.asarray(discount), jnp.asarray(bootstrap), gamma)
    rows = zip(reward.tolist(), discount.tolist(), bootstrap.tolist(), strict=True)
    np.testing.assert_allclose(target, [naive_n_step_target(*row, gamma) for row in rows], rtol=1e-12, atol=1e-14)


def test_the_target_has_the_derivative_that_differences_show() -> None:
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        reward, discount, bootstrap = (jnp.asarray(rng.random(shape)) for shape in ((4, 3), (4, 3), (4,)))
        assert n_step_target(reward, discount, bootstrap, 0.9).dtype == jnp.float64
        jax.test_util.check_grads(lambda *x: n_step_target(*x, 0.9), (reward, discount, bootstrap), order=1)
