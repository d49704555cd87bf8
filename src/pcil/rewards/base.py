"""The reward's seam: a frozen dataclass of settings with pure methods; all that changes is its state, a pytree."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from pcil.errors import check_kinds, check_ranges
from pcil.types import Batch, Window

Metrics = dict[str, Float[Array, ""]]
Embed = Callable[[Float[Array, "*batch obs"]], Float[Array, "*batch features"]]
"""The agent's features of an observation; no gradient flows through them. It is a pytree, so a state may keep it."""


class SlowFeatures(eqx.Module):
    """A copy of the agent's features that stays as it is until so many updates have passed."""

    embed: Embed
    updates: Int[Array, ""]

    @classmethod
    def init(cls, embed: Embed) -> SlowFeatures:
        return cls(jax.tree.map(jnp.copy, embed), jnp.int32(0))

    def update(self, embed: Embed, every: int) -> SlowFeatures:
        """One update later, with the agent's features of now if their turn has come."""
        updates = self.updates + 1
        newer = jax.tree.map(lambda old, new: jnp.where(updates % every == 0, new, old), self.embed, embed)
        return SlowFeatures(newer, updates)


@dataclass(frozen=True)
class Reward(abc.ABC):
    """An imitation reward: learned from demonstrations and from what the agent does.

    `scope` says what `reward` must be given: "step" for any steps in any order, "episode" for one whole episode in the order
    of time. `takes_padding` says of the latter that rows whose actions are NaN, which stand behind the episode's end, change
    nothing. `needs_demos` is False where no demonstrations are used at all.
    """

    scope: ClassVar[Literal["step", "episode"]] = "step"
    takes_padding: ClassVar[bool] = False
    needs_demos: ClassVar[bool] = True

    task_weight: float = 0.0
    """Weight of the environment's own reward, which is added to the learned one."""
    batch_size: int = 128
    """Expert steps in one update, and as many of the agent."""

    def __post_init__(self) -> None:
        check_kinds(self)
        check_ranges(self, task_weight=(-inf, inf), batch_size=(0, inf))

    @property
    def reads(self) -> Literal["obs", "next_obs"]:
        """Which state of a step `reward` is given: the one that the step led to, or the one in which the action was taken,
        which is what a reward of state-action pairs needs."""
        return "next_obs"

    @property
    def needs_actions(self) -> bool:
        """Whether actions of demonstrations are read: by a reward of state-action pairs, or where the replay begins with them.

        A reward that reads them in another way overrides this; where it is False, demonstrations may have no actions, and those
        that it is given are 0.
        """
        return self.reads == "obs" or self.prefill[0] > 0

    @property
    def features(self) -> Literal["critic", "actor"]:
        """Whose trunk `embed` is."""
        return "critic"

    @property
    def span(self) -> int:
        """Least number of steps in the windows that `update` is given."""
        return 1

    @property
    def prefill(self) -> tuple[int, float]:
        """How many expert steps the replay begins with, and the reward stored for each of them."""
        return 0, 0.0

    @abc.abstractmethod
    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> Any:
        """The state before the first update; `demos` has the states that the reward `reads` and the actions of each
        demonstration, in the order of time.

        It is compiled, so it computes with JAX.
        """

    @abc.abstractmethod
    def update(self, state: Any, expert: Window, agent: Window, embed: Embed, *, key: PRNGKeyArray) -> tuple[Any, Metrics]:
        """One gradient step on `batch_size` windows of the expert and as many of the agent."""

    @abc.abstractmethod
    def reward(
        self,
        state: Any,
        obs: Float[Array, "T obs"],
        action: Float[Array, "T action"],
        embed: Embed,
        *,
        key: PRNGKeyArray,
    ) -> Float[Array, " T"]:
        """The reward of `T` steps; which state `obs` holds is said by `reads`."""

    def after_episode(
        self,
        state: Any,
        obs: Float[Array, "T obs"],
        action: Float[Array, "T action"],
        embed: Embed,
        *,
        key: PRNGKeyArray,
    ) -> Any:
        """The state once an episode has ended and before it is labelled, where `scope` is "episode".

        All arguments are those that `reward` is given next for the same episode, the key among them.
        """
        del obs, action, embed, key
        return state

    def representation(
        self, state: Any, obs: Float[Array, "T obs"], action: Float[Array, "T action"], embed: Embed
    ) -> Float[Array, "T dim"] | None:
        """Where the reward has put `T` steps, if it learns a representation; given what `reward` is given."""
        del state, obs, action, embed
        return None


def states_read(settings: Reward, obs: Float[Any, "*batch states obs"]) -> Float[Any, "*batch n obs"]:
    """The states that a reward `reads`, one a step."""
    return obs[..., 1:, :] if settings.reads == "next_obs" else obs[..., :-1, :]


def label(
    settings: Reward,
    state: Any,
    obs: Float[Array, "*batch states obs"],
    action: Float[Array, "*batch n action"],
    task_reward: Float[Array, "*batch n"],
    embed: Embed,
    *,
    key: PRNGKeyArray,
) -> Float[Array, "*batch n"]:
    """What the agent is trained on: the learned reward plus the weighted reward of the environment.

    This is the one place where the two meet. Leading dimensions are flattened, so a reward sees rows of steps only.
    """
    rows, row_actions = states_read(settings, obs).reshape(-1, obs.shape[-1]), action.reshape(-1, action.shape[-1])
    learned = settings.reward(state, rows, row_actions, embed, key=key)
    learned = learned.reshape(task_reward.shape)
    return learned + settings.task_weight * task_reward if settings.task_weight else learned  # 0 * NaN would be NaN
