"""Optimal transport by POT, called from compiled code."""

from __future__ import annotations

import functools

import jax
import numpy as np
from jaxtyping import Array, Float


def sinkhorn_plan(
    cost: Float[Array, "rows columns"], weight: Float[Array, " columns"], epsilon: float, iterations: int
) -> Float[Array, "rows columns"]:
    """The plan `M` that makes `sum_ij M_ij C_ij + epsilon sum_ij M_ij log M_ij` least (Cuturi 2013).

    Each row holds the same mass and column `j` the share `weight_j`, which is 0 for padding. After `iterations` rounds the sums
    of the rows are exact, those of the columns near; POT stops earlier where they are exact to 1e-9. No gradient flows through
    the plan.
    """
    import ot  # here, on the thread that traces: the one that calls back must not be the first to load it

    solve = functools.partial(_solve, ot.sinkhorn, epsilon, iterations)
    like = jax.ShapeDtypeStruct(cost.shape, cost.dtype)
    given = jax.lax.stop_gradient((cost, weight))
    return jax.pure_callback(solve, like, *given, vmap_method="sequential")


def _solve(sinkhorn, epsilon: float, iterations: int, cost: Array, weight: Array) -> np.ndarray:
    """By NumPy alone, for JAX may be waiting for this; in float64, where `exp(-cost / epsilon)` vanishes at 745 only."""
    exact, share = np.asarray(cost, np.float64), np.asarray(weight, np.float64)
    held = share > 0
    plan = np.zeros(cost.shape, np.float32)
    mass = np.full(len(exact), 1 / len(exact)), share[held] / share.sum()
    plan[:, held] = sinkhorn(*mass, exact[:, held], epsilon, numItermax=iterations, warn=False)
    return plan
