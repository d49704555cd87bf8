"""Optimal transport by POT, called from compiled code."""

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
    """The plan `M` that makes `sum_ij M_ij C_ij + epsilon sum_ij M_ij log M_ij` least (Cuturi 2013).

    Row `i` holds the share `x_weight_i` of the mass and column `j` the share `y_weight_j`; those of padding are 0, and what the
    cost is there makes no difference. After `iterations` rounds the sums of the rows are exact, those of the columns near; POT
    stops earlier where they are exact to 1e-9. No gradient flows through the plan.
    """
    import ot  # here, on the thread that traces: the one that calls back must not be the first to load it

    solve = functools.partial(_solve, ot.sinkhorn, epsilon, iterations)
    like = jax.ShapeDtypeStruct(cost.shape, cost.dtype)
    given = jax.lax.stop_gradient((cost, x_weight, y_weight))
    return jax.pure_callback(solve, like, *given, vmap_method="sequential")


def _solve(sinkhorn, epsilon: float, iterations: int, cost: Array, *weights: Array) -> np.ndarray:
    """By NumPy alone, for JAX may be waiting for this; in float64, where `exp(-cost / epsilon)` vanishes at 745 only."""
    shares = [np.asarray(weight, np.float64) for weight in weights]
    held = np.ix_(*(share > 0 for share in shares))
    mass = [share[share > 0] / share.sum() for share in shares]
    plan = np.zeros(cost.shape, np.float32)
    plan[held] = sinkhorn(*mass, np.asarray(cost, np.float64)[held], epsilon, numItermax=iterations, warn=False)
    return plan
