"""Adam, the one optimiser that everything here uses (paper Table of hyperparameters)."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import optax
from jaxtyping import Array, Int

Network = TypeVar("Network")
Moments = Any
"""Adam's running means, a pytree."""


def adam_init(network: Any) -> Moments:
    """The moments before the first step."""
    return optax.adam(0.0).init(network)


def adam_step(network: Network, gradient: Any, moments: Moments, learning_rate: float) -> tuple[Network, Moments]:
    """The network after one step against the gradient, and the moments to go on with; default betas, no decay."""
    with jax.numpy_dtype_promotion("standard"):  # optax raises a float to its integer count
        change, moments = optax.adam(learning_rate).update(gradient, moments)
    moved: Any = optax.apply_updates(network, change)  # pyright: ignore[reportArgumentType]
    return moved, moments


def adam_count(moments: Moments) -> Int[Array, ""]:
    """How many steps were taken with these moments."""
    return optax.tree.get(moments, "count")
