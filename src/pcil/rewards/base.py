"""The interface of rewards: frozen settings with pure methods. Everything that changes is in the state, a pytree."""

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
from pcil.types import Batch

Metrics = dict[str, Float[Array, ""]]
Inputs = Literal["state", "state-action", "transition"]
"""What a reward is a function of: the state a step led to, the state with the action taken in it, or both states."""
Embed = Callable[[Float[Array, "*batch obs"]], Float[Array, "*batch features"]]
"""The agent's features of an observation, without gradient. It is a pytree, so a reward's state may hold it."""


def select(inputs: Inputs, batch: Batch, embed: Embed) -> Float[Any, "*steps inputs"]:
    """The features of the steps' `inputs`; actions are appended unchanged."""
    if inputs == "state":
        return embed(batch.next_obs)
    other = batch.action if inputs == "state-action" else embed(batch.next_obs)
    return jnp.concatenate([embed(batch.obs), other], axis=-1)


def only(inputs: Inputs, batch: Batch) -> Batch:
    """The steps with just those arrays that are `inputs`; the others have no columns."""
    read = {"state": {"next_obs"}, "state-action": {"obs", "action"}, "transition": {"obs", "next_obs"}}[inputs]
    return Batch(*(getattr(batch, name)[..., : None if name in read else 0] for name in ("obs", "action", "next_obs")))


class SlowFeatures(eqx.Module):
    """A copy of the agent's features that is renewed only every N updates."""

    embed: Embed
    updates: Int[Array, ""]

    @classmethod
    def init(cls, embed: Embed) -> SlowFeatures:
        return cls(jax.tree.map(jnp.copy, embed), jnp.int32(0))

    def update(self, embed: Embed, every: int) -> SlowFeatures:
        """The copy one update later, renewed if its turn has come."""
        updates = self.updates + 1
        newer = jax.tree.map(lambda old, new: jnp.where(updates % every == 0, new, old), self.embed, embed)
        return SlowFeatures(newer, updates)


@dataclass(frozen=True)
class Reward(abc.ABC):
    """An imitation reward, learned from demonstrations and from the agent's experience.

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
    """Number of expert steps in an update, and of agent steps."""
    subsampling: int = 1
    """Use every N-th step of each demonstration only, beginning with step i modulo N in the i-th one, as GAIL and PWIL did."""

    def __post_init__(self) -> None:
        check_kinds(self)
        check_ranges(self, task_weight=(-inf, inf), batch_size=(0, inf), subsampling=(1, inf))

    @property
    def needs_actions(self) -> bool:
        """Whether actions of demonstrations are read: by a reward whose `inputs` are state and action, or where the replay
        begins with demonstrations.

        A reward that reads them in another way overrides this; where it is False, demonstrations may have no actions, and those
        that it is given are 0.
        """
        return getattr(self, "inputs", None) == "state-action" or self.prefill[0] > 0

    @property
    def trunk(self) -> Literal["critic", "actor"]:
        """Whether `embed` is the trunk of the critic or of the actor."""
        return "critic"

    @property
    def span(self) -> int:
        """Minimum length of the windows that `update` is given."""
        return 1

    @property
    def prefill(self) -> tuple[int, float]:
        """The number of expert steps that the replay starts with, and the reward stored for each of them."""
        return 0, 0.0

    def subsampled(self, demos: Sequence[Batch]) -> list[Batch]:
        """Every `subsampling`-th step of each demonstration, and at least one."""
        every = self.subsampling
        return [Batch(*(array[min(i % every, len(array) - 1) :: every] for array in demo[:3])) for i, demo in enumerate(demos)]

    @abc.abstractmethod
    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> Any:
        """The state before the first update; `demos` are the steps `[T]` of each demonstration.

        It is compiled, so it computes with JAX.
        """

    @abc.abstractmethod
    def update(self, state: Any, expert: Batch, agent: Batch, embed: Embed, *, key: PRNGKeyArray) -> tuple[Any, Metrics]:
        """One gradient step on `batch_size` windows of the expert and as many of the agent, each of at least `span` steps."""

    @abc.abstractmethod
    def reward(self, state: Any, batch: Batch, embed: Embed, *, key: PRNGKeyArray) -> Float[Array, " T"]:
        """The learned reward of `T` steps."""

    def after_episode(self, state: Any, batch: Batch, embed: Embed, *, key: PRNGKeyArray) -> Any:
        """The state once an episode has ended and before it is labelled, where `scope` is "episode".

        All arguments are those that `reward` is given next for the same episode, the key among them.
        """
        del batch, embed, key
        return state

    def representation(self, state: Any, batch: Batch, embed: Embed) -> Float[Array, "T dim"] | None:
        """The representation of `T` steps, if the reward learns one."""
        del state, batch, embed
        return None

    def total(self, learned: Float[Any, "*steps"], task_reward: Float[Any, "*steps"]) -> Float[Any, "*steps"]:
        """The reward that the agent is trained on: the learned reward plus the weighted reward of the environment."""
        return learned + self.task_weight * task_reward if self.task_weight else learned  # 0 * NaN would be NaN


def label(
    settings: Reward,
    state: Any,
    batch: Batch,
    task_reward: Float[Array, "*steps"],
    embed: Embed,
    *,
    key: PRNGKeyArray,
) -> Float[Array, "*steps"]:
    """The `total` reward of the steps; leading axes are flattened, so that `reward` is given rows of steps only."""
    rows = Batch(*(array.reshape(-1, array.shape[-1]) for array in batch[:3]))
    learned = settings.reward(state, rows, embed, key=key)
    return settings.total(learned.reshape(task_reward.shape), task_reward)
