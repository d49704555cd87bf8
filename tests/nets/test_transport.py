"""Sinkhorn's plan: its marginals, a naive plan in the log domain, exact transport, and repeated calls from compiled code."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import ot
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import logsumexp

from pcil.errors import InputError
from pcil.nets.transport import sinkhorn_plan
from pcil.rewards import POTIL


def random_cost(rows: int, columns: int, seed: int) -> np.ndarray:
    """One minus the cosines of random vectors, as in the rewards."""
    rng = np.random.default_rng(seed)
    x, y = rng.standard_normal((rows, 3)), rng.standard_normal((columns, 3)) + 0.5
    x, y = (z / np.linalg.norm(z, axis=1, keepdims=True) for z in (x, y))
    return (1 - x @ y.T).astype(np.float32)


def plan_of(cost: np.ndarray, epsilon: float, iterations: int, weight: np.ndarray | None = None) -> np.ndarray:
    weight = np.full(cost.shape[1], 1 / cost.shape[1]) if weight is None else weight
    weights = (jnp.asarray(share, jnp.float32) for share in (np.full(len(cost), 1 / len(cost)), weight))
    return np.asarray(sinkhorn_plan(jnp.asarray(cost), *weights, epsilon, iterations))


def naive_plan(cost: np.ndarray, epsilon: float, rounds: int) -> np.ndarray:
    """In the log domain, starting with potentials of 0: each iteration corrects the columns, then the rows."""
    rows, columns = cost.shape
    kernel = -cost.astype(np.float64) / epsilon
    log_u, log_v = np.zeros(rows), np.zeros(columns)
    for _ in range(rounds):
        log_v = -np.log(columns) - logsumexp(kernel + log_u[:, None], axis=0)
        log_u = -np.log(rows) - logsumexp(kernel + log_v[None], axis=1)
    return np.exp(log_u[:, None] + kernel + log_v[None])


@settings(deadline=None, derandomize=True, max_examples=15)
@given(rows=st.integers(1, 9), columns=st.integers(1, 9), rounds=st.integers(1, 40), seed=st.integers(0, 99))
def test_plan_equals_a_naive_logarithmic_one(rows: int, columns: int, rounds: int, seed: int) -> None:
    """For each number of iterations. The algorithm stops when no error is left; more iterations would change nothing."""
    cost = random_cost(rows, columns, seed)
    assert np.allclose(plan_of(cost, 0.05, rounds), naive_plan(cost, 0.05, rounds), atol=1e-6)


@pytest.mark.parametrize("epsilon", [0.01, 0.1, 1.0])
def test_rows_have_their_mass_exactly_and_columns_nearly(epsilon: float) -> None:
    """`cost / epsilon` is 200 in places: in float32 its exponential would be 0."""
    cost = random_cost(40, 30, 1)
    assert cost.max() > 1.9
    weight = np.arange(1, 31) / np.arange(1, 31).sum()
    plan = plan_of(cost, epsilon, 5000, weight)
    assert (plan >= 0).all()
    assert np.allclose(plan.sum(axis=1), 1 / 40, atol=1e-7)
    assert np.allclose(plan.sum(axis=0), weight, atol=1e-6)


def test_the_least_epsilon_still_moves_all_mass_at_the_largest_cost() -> None:
    least = 3e-3
    with pytest.raises(InputError, match="epsilon"):
        POTIL(epsilon=0.99 * least)
    plan = plan_of(2 - 0.1 * random_cost(30, 20, 2) / 2, POTIL(epsilon=least).epsilon, 100)
    assert np.allclose(plan.sum(axis=1), 1 / 30, atol=1e-7)


def test_cost_falls_to_that_of_the_exact_plan_as_epsilon_shrinks() -> None:
    cost = random_cost(20, 20, 3)
    uniform = np.full(20, 1 / 20)
    exact = float(ot.emd2(uniform, uniform, cost.astype(np.float64)))
    excess = [float((plan_of(cost, epsilon, 20_000) * cost).sum()) - exact for epsilon in (1.0, 0.3, 0.1, 0.03, 0.01)]
    assert all(more > less for more, less in itertools.pairwise(excess))
    assert -1e-5 < excess[-1] < 0.01 < excess[0]


def test_padding_gets_no_mass_and_changes_nothing() -> None:
    """For padded rows and columns, even if the cost there is NaN."""
    cost = random_cost(12, 10, 4)
    padded = np.pad(cost, ((0, 2), (0, 3)), constant_values=np.nan)
    x_weight, y_weight = (jnp.asarray([1 / n] * n + [0.0] * spare, jnp.float32) for n, spare in ((12, 2), (10, 3)))
    plan = np.array(sinkhorn_plan(jnp.asarray(padded), x_weight, y_weight, 0.01, 100))
    assert np.array_equal(plan[:12, :10], plan_of(cost, 0.01, 100))
    plan[:12, :10] = 0
    assert not plan.any()


def test_weights_are_shares_whatever_their_sum() -> None:
    cost, shares = random_cost(4, 6, 0), np.arange(1.0, 7.0)
    np.testing.assert_allclose(plan_of(cost, 0.1, 500, 3 * shares), plan_of(cost, 0.1, 500, shares / 21), atol=1e-7)


def test_many_at_once_are_one_by_one() -> None:
    costs, weights = np.stack([random_cost(8, 6, seed) for seed in range(4)]), (jnp.full(8, 1 / 8), jnp.full((4, 6), 1 / 6))
    together = jax.vmap(lambda c, w: sinkhorn_plan(c, weights[0], w, 0.01, 100))(jnp.asarray(costs), weights[1])
    assert all(np.array_equal(plan, plan_of(cost, 0.01, 100)) for plan, cost in zip(together, costs, strict=True))


def test_no_gradient_flows_through_the_plan() -> None:
    """`d/dC sum M C` with `M` held fixed is `M` itself."""
    cost, weight = jnp.asarray(random_cost(8, 8, 5)), jnp.full(8, 1 / 8)
    gradient = jax.grad(lambda c: jnp.sum(sinkhorn_plan(c, weight, weight, 0.05, 100) * c))(cost)
    assert np.array_equal(gradient, sinkhorn_plan(cost, weight, weight, 0.05, 100))


def test_compiled_code_calls_back_again_and_again_without_waiting_for_itself() -> None:
    """Large costs on the single thread of the tests, inside a condition, all dispatched before the first is finished."""
    cost, weight = jnp.asarray(random_cost(500, 500, 6)), jnp.full(500, 1 / 500)

    @jax.jit
    def step(cost: jax.Array, total: jax.Array) -> tuple[jax.Array, jax.Array]:
        plan = jax.lax.cond(total < 1e9, lambda: sinkhorn_plan(cost, weight, weight, 0.01, 2), lambda: cost)
        return jnp.roll(cost @ jnp.eye(500), 1, axis=0), total + jnp.sum(plan)

    total = jnp.zeros(())
    for _ in range(20):
        cost, total = step(cost, total)
    assert float(total) == pytest.approx(20, rel=1e-4)
