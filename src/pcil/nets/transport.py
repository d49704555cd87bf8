"""Optimal transport with POT, called from compiled code."""

from __future__ import annotations

import functools

import jax
import numpy as np
from jaxtyping import Array, Float


def sinkhorn_plan(
    cost: Float[Array, "rows columns"],
    x_weight: Float[Array, " rows"],
    y_weight: Float[Array, " columns"],
    epsilon: float,
    iterations: int,
) -> Float[Array, "rows columns"]:
    """The transport plan `M` that minimises `sum_ij M_ij C_ij + epsilon sum_ij M_ij log M_ij` (Cuturi 2013).

    The marginals are `x_weight` and `y_weight`, normalised to 1. Padding has weight 0, and its costs are ignored. After
    `iterations` iterations the row sums are exact and the column sums approximate; POT stops early once their error is below
    1e-9. No gradient flows through the plan.
    """
    import ot  # imported while tracing: it must not be imported for the first time in the callback's thread

    solve = functools.partial(_solve, ot.sinkhorn, epsilon, iterations)
    like = jax.ShapeDtypeStruct(cost.shape, cost.dtype)
    given = jax.lax.stop_gradient((cost, x_weight, y_weight))
    return jax.pure_callback(solve, like, *given, vmap_method="sequential")


def _solve(sinkhorn, epsilon: float, iterations: int, cost: Array, *weights: Array) -> np.ndarray:
    """The callback. It uses NumPy only, since JAX may be blocked meanwhile; in float64, `exp(-cost / epsilon)` underflows only
    at 745."""
    marginals = [np.asarray(weight, np.float64) for weight in weights]
    present = np.ix_(*(marginal > 0 for marginal in marginals))
    masses = [marginal[marginal > 0] / marginal.sum() for marginal in marginals]
    plan = np.zeros(cost.shape, np.float32)
    plan[present] = sinkhorn(*masses, np.asarray(cost, np.float64)[present], epsilon, numItermax=iterations, warn=False)
    return plan
