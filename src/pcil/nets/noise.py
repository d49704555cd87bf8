"""Exploration noise: a linear schedule of the standard deviation, and DrQ-v2's clamped normal distribution."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from pcil.errors import check_ranges

ACTION_MARGIN = 1e-6
"""Sampled actions stay this far inside (-1, 1) (authors' code: utils.py, `TruncatedNormal`)."""


@dataclass(frozen=True)
class LinearSchedule:
    """A value that changes linearly from `start` to `end` over `steps` agent steps and is constant afterwards."""

    start: float = 1.0
    end: float = 0.1
    steps: int = 500_000

    def __post_init__(self) -> None:
        check_ranges(self, start=(0, inf), end=(0, inf), steps=(0, inf))

    def __call__(self, step: Any, xp: ModuleType = jnp) -> Float[Any, ""]:
        mix = xp.minimum(xp.maximum(xp.float32(step) / xp.float32(max(self.steps, 1)), 0.0), 1.0)
        return xp.float32(self.start) * (1 - mix) + xp.float32(self.end) * mix


def normal_steps(rng: np.random.Generator, dim: int, correlation: float) -> Iterator[Float[np.ndarray, " dim"]]:
    """Standard normal vectors, each correlated with the one before: `x' = c x + sqrt(1 - c^2) z`, whose variance stays 1.

    This is the Ornstein-Uhlenbeck noise of DDPG (Lillicrap et al. 2016), started from its stationary distribution.
    """
    fresh = np.float32((1 - correlation**2) ** 0.5)
    steps = rng.standard_normal(dim, dtype=np.float32)
    while True:
        yield steps
        steps = np.float32(correlation) * steps + fresh * rng.standard_normal(dim, dtype=np.float32)


def add_noise(
    mean: Float[Any, "*batch action"], noise: Float[Any, "*batch action"], xp: ModuleType = jnp
) -> Float[Any, "*batch action"]:
    """`mean + noise`, clamped to the action range with a straight-through gradient."""
    raw = mean + noise
    clamped = xp.minimum(xp.maximum(raw, ACTION_MARGIN - 1), 1 - ACTION_MARGIN)
    return clamped if xp is not jnp else raw + jax.lax.stop_gradient(clamped - raw)
