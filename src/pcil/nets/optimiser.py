"""Adam, the only optimiser (paper, table of hyperparameters)."""

from __future__ import annotations

from typing import Any, TypeVar

import jax
import optax
from jaxtyping import Array, Int

Network = TypeVar("Network")
OptState = Any
"""The state of optax's Adam, a pytree."""


def adam_init(network: Any) -> OptState:
    """The initial optimiser state."""
    return optax.adam(0.0).init(network)


def adam_step(network: Network, gradient: Any, opt_state: OptState, learning_rate: float) -> tuple[Network, OptState]:
    """The network and the optimiser state after one Adam step with optax's default betas."""
    with jax.numpy_dtype_promotion("standard"):  # optax computes float ** int
        change, opt_state = optax.adam(learning_rate).update(gradient, opt_state)
    moved: Any = optax.apply_updates(network, change)  # pyright: ignore[reportArgumentType]
    return moved, opt_state


def adam_count(opt_state: OptState) -> Int[Array, ""]:
    """The number of Adam steps so far."""
    return optax.tree.get(opt_state, "count")
