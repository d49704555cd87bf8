"""The interface of agents. An agent learns a policy from windows of experience and a reward, wherever the reward comes from."""

from __future__ import annotations

import abc
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from types import ModuleType
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pcil.errors import InputError, check_kinds, check_ranges
from pcil.types import Spec, Window


@runtime_checkable
class Actor(Protocol):
    """What acts: a pytree of arrays, such as an `equinox.Module`, that maps observations to actions in [-1, 1].

    `pcil.nets.networks:Actor` is ours. Another one has a class method `from_arrays`, for a policy is saved as arrays by their
    paths in the tree: `from_arrays({"weight": ...})` gives back the actor whose field `weight` that was.
    """

    def __call__(self, obs: Float[Any, "*batch obs"], xp: ModuleType = ...) -> Float[Any, "*batch action"]:
        """The mean action, by `jax.numpy` or `numpy`."""
        ...


Metrics = dict[str, Float[Array, ""]]
Explorer = Callable[[Any, np.ndarray, int], np.ndarray]
"""`(actor, obs [obs], agent steps so far) -> action [action]`."""


@dataclass(frozen=True)
class Agent(abc.ABC):
    """Settings of an agent. Everything that changes is in its state, a pytree that methods take and return.

    `offline` is True for one that learns from the demonstrations alone, without a step in the environment.
    """

    offline: ClassVar[bool] = False

    batch_size: int = 128
    """Windows in one update."""
    n_step: int = 3
    """Steps of reward before the target bootstraps: the length of a window."""
    absorbing: bool | None = None
    """Whether a termination leads to an absorbing state, marked by an extra entry of observations, so that the reward decides
    what an early end is worth. None: yes if the reward is learned and episodes can end early."""

    def __post_init__(self) -> None:
        check_kinds(self)
        check_ranges(self, batch_size=(1, inf), n_step=(1, inf))

    @abc.abstractmethod
    def init(self, spec: Spec, *, key: PRNGKeyArray) -> Any:
        """The state before the first update."""

    def observe(self, state: Any, obs: Float[Array, "rows obs"]) -> Any:
        """The state with its statistics of observations updated by these rows; called before any other computation."""
        del obs
        return state

    @abc.abstractmethod
    def update(self, state: Any, window: Window, *, step: Array, key: PRNGKeyArray) -> tuple[Any, Metrics]:
        """One gradient step of every network on one batch; `step` counts agent steps."""

    @property
    def clones(self) -> bool | None:
        """Whether the agent also learns from the actions of the demonstrations; None: if they have any. An agent that does is
        given one-step windows of them, as `cloned`, in each `update` and, before the first one, in calls of `clone`."""
        return False

    def clone(self, state: Any, cloned: Window) -> Any:
        """The state after one gradient step of behavioural cloning; only called if the agent `clones`."""
        del cloned
        return state

    @abc.abstractmethod
    def actor(self, state: Any) -> Actor:
        """The part of the state that acts; nothing else leaves the device between updates."""

    def started_from(self, state: Any, actor: Actor) -> Any:
        """The state before the first update, with the actor of a policy, for a warm start; `InputError` if that can't be."""
        del state, actor
        raise InputError(f"{type(self).__name__} starts from no policy")

    def averaged(self, state: Any) -> Actor | None:
        """The actor that is evaluated and saved in place of the one that explores; None: the same one."""
        del state
        return None

    @abc.abstractmethod
    def trunk(self, state: Any, whose: Literal["critic", "actor"]) -> Callable[[Any], Any]:
        """The features of an observation that imitation rewards are learned on, as a pytree. Rewards do not train them."""

    @abc.abstractmethod
    def explorer(self, action_dim: int, rng: np.random.Generator) -> Explorer:
        """The exploring policy of one episode, with noise from `rng`; it acts on the host."""
