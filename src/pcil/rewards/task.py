"""The environment's own reward, through the same seam: how experts are trained and the agent is checked alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pcil.rewards.base import Embed, Metrics, Reward
from pcil.types import Batch


@dataclass(frozen=True)
class TaskReward(Reward):
    """Nothing is learned: the learned part is 0 and the environment's reward has weight 1."""

    needs_demos: ClassVar[bool] = False

    task_weight: float = 1.0
    """Weight of the environment's own reward."""
    batch_size: int = 0
    """No expert steps are drawn."""

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> None:
        del demos, embed, key

    def update(self, state: None, expert: Batch, agent: Batch, embed: Embed, *, key: PRNGKeyArray) -> tuple[None, Metrics]:
        del state, expert, agent, embed, key
        return None, {}

    def reward(self, state: None, batch: Batch, embed: Embed, *, key: PRNGKeyArray) -> Float[Array, " T"]:
        del state, embed, key
        return jnp.zeros(batch.obs.shape[0], batch.obs.dtype)
