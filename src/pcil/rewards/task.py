"""The environment's own reward, through the same seam: how experts are trained and the agent is checked alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pcil.errors import check_ranges
from pcil.rewards.base import Embed, Metrics, Reward
from pcil.types import Batch


@dataclass(frozen=True)
class TaskReward(Reward):
    """Nothing is learned: every step is paid the environment's reward, and a constant if there is one."""

    needs_demos: ClassVar[bool] = False

    task_weight: float = 1.0
    """Weight of the environment's own reward."""
    constant: float = 0.0
    """What every step is paid besides. Alone, with `task_weight` 0, it is the control for survival bias: it says what an agent
    earns that only tries to survive (Kostrikov et al. 2019, section 4.2)."""
    batch_size: int = 0
    """No expert steps are drawn."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, constant=(-inf, inf))

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> None:
        del demos, embed, key

    def update(self, state: None, expert: Batch, agent: Batch, embed: Embed, *, key: PRNGKeyArray) -> tuple[None, Metrics]:
        del state, expert, agent, embed, key
        return None, {}

    def reward(self, state: None, batch: Batch, embed: Embed, *, key: PRNGKeyArray) -> Float[Array, " T"]:
        del state, embed, key
        return jnp.full(batch.obs.shape[0], self.constant, batch.obs.dtype)
