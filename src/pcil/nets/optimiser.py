"""Adam, the one optimiser that everything here uses (paper Table of hyperparameters)."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import optax
from jaxtyping import Array, Int

Network = TypeVar("Network")
OptState = Any
"""Adam's running means, a pytree."""


def adam_init(network: Any) -> OptState:
    """The opt_state before the first step."""
    return optax.adam(0.0).init(network)


def adam_step(network: Network, gradient: Any, opt_state: OptState, learning_rate: float) -> tuple[Network, OptState]:
    """The network after one step against the gradient, and the opt_state to go on with; default betas, no decay."""
    with jax.numpy_dtype_promotion("standard"):  # optax raises a float to its integer count
        change, opt_state = optax.adam(learning_rate).update(gradient, opt_state)
    moved: Any = optax.apply_updates(network, change)  # pyright: ignore[reportArgumentType]
    return moved, opt_state


def adam_count(opt_state: OptState) -> Int[Array, ""]:
    """How many steps were taken with these opt_state."""
    return optax.tree.get(opt_state, "count")
