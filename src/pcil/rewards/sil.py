"""Sinkhorn imitation: the entropic transport between an episode and a demonstration pays each step for its part.

`SIL` learns the space in which costs are taken (Papagiannis and Li 2020), off-policy here. `POTIL` is the one in the authors'
code (agent/potil.py, rewarder.py), which learns nothing. `docs/methods/sil.md` numbers the differences.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from pcil.errors import check_ranges
from pcil.nets.networks import MLP, unit_sphere
from pcil.nets.optimiser import Moments, adam_init, adam_step
from pcil.nets.transport import sinkhorn_plan
from pcil.rewards.base import Embed, Metrics, Reward, SlowFeatures
from pcil.types import Batch, Window


class Demos(eqx.Module):
    """All demonstrations, padded to the longest."""

    obs: Float[Array, "demos steps obs"]
    action: Float[Array, "demos steps action"]
    weight: Float[Array, "demos steps"]
    """One over a demonstration's length, and 0 in its padding."""

    @classmethod
    def of(cls, demos: Sequence[Batch]) -> Demos:
        longest = max(len(demo.obs) for demo in demos)
        weights = [jnp.full((len(demo.obs), 1), 1 / len(demo.obs), jnp.float32) for demo in demos]
        columns = [demo.obs for demo in demos], [demo.action for demo in demos], weights
        obs, action, weight = (jnp.stack([jnp.pad(x, ((0, longest - len(x)), (0, 0))) for x in part]) for part in columns)
        return cls(obs, action, weight[..., 0])


def step_weights(action: Float[Array, "T action"]) -> Float[Array, " T"]:
    """One over the number of steps, and 0 for the rows behind them."""
    steps = (~jnp.isnan(action[:, 0])).astype(jnp.float32)
    return steps / jnp.sum(steps)


class SinkhornState(eqx.Module):
    """What an episode is compared with, in which space, and how rewards are scaled."""

    demos: Demos
    scale: Float[Array, ""]
    """What rewards are multiplied by; 0 before the first episode has fixed it."""
    space: Any
    """Of the features in which costs are taken."""


def cosine_cost(x: Float[Array, "rows dim"], y: Float[Array, "columns dim"]) -> Float[Array, "rows columns"]:
    """`C_ij = 1 - cos(x_i, y_j)`, in [0, 2]."""
    return 1 - unit_sphere(x) @ unit_sphere(y).T


@dataclass(frozen=True)
class SinkhornReward(Reward):
    """What SIL and POTIL share: `r_i = -scale sum_j M_ij C_ij` with the plan `M` between the episode and a demonstration."""

    scope: ClassVar[Literal["step", "episode"]] = "episode"
    takes_padding: ClassVar[bool] = True

    epsilon: float = 0.01
    """Weight of the plan's entropy; costs reach 2, and `exp(-cost / epsilon)` is 0 in float64 beyond 745."""
    iterations: int = 100
    """Rounds of Sinkhorn's algorithm, at most."""
    first_sum: float = -10.0
    """What the first episode's rewards sum to, which fixes the scale of all that follow; 0 leaves rewards unscaled."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, epsilon=(3e-3, inf), iterations=(1, inf), first_sum=(-inf, 0))

    @abc.abstractmethod
    def costs(
        self, state: Any, obs: Float[Array, "T obs"], action: Float[Array, "T action"], embed: Embed, *, key: Any
    ) -> Float[Array, " T"]:
        """Each step's part of the transport cost."""

    def match(
        self,
        x: Float[Array, "T dim"],
        y: Float[Array, "steps dim"],
        x_weight: Float[Array, " T"],
        y_weight: Float[Array, " steps"],
    ) -> Float[Array, " T"]:
        """Each row's part of the transport from `x` to `y`, `sum_j M_ij C_ij`."""
        cost = cosine_cost(x, y)
        plan = sinkhorn_plan(cost, x_weight, y_weight, self.epsilon, self.iterations)
        return jnp.sum(jnp.where(plan > 0, plan * cost, 0.0), axis=-1)

    def reward(
        self, state: Any, obs: Float[Array, "T obs"], action: Float[Array, "T action"], embed: Embed, *, key: Any
    ) -> Float[Array, " T"]:
        return -jnp.where(state.scale > 0, state.scale, 1.0) * self.costs(state, obs, action, embed, key=key)

    def after_episode(
        self, state: Any, obs: Float[Array, "T obs"], action: Float[Array, "T action"], embed: Embed, *, key: Any
    ) -> Any:
        """Fix the scale by the first episode (authors' code: `auto_rew_scale`)."""
        if self.first_sum == 0:
            return state

        def by_this_episode() -> Array:
            total = jnp.sum(self.costs(state, obs, action, embed, key=key))
            return -self.first_sum / jnp.maximum(total, 1e-6)

        scale = jax.lax.cond(state.scale > 0, lambda: state.scale, by_this_episode)
        return SinkhornState(state.demos, scale, state.space)


class Adversary(eqx.Module):
    """The critic, its optimiser's moments, and what it did last."""

    critic: MLP
    moments: Moments
    cost: Float[Array, ""]
    """The transport cost at its last step."""
    updates: Int[Array, ""]


@dataclass(frozen=True)
class SIL(SinkhornReward):
    """Settings of SIL's reward: a critic learns the space, and each episode is compared with a random demonstration."""

    inputs: Literal["state", "state-action"] = "state"
    """What the critic is given: the features of states, or those and the actions taken there."""
    hidden: int = 128
    """Width of the critic's two hidden layers."""
    embedding: int = 30
    """Dimensions of the space."""
    learning_rate: float = 5e-4
    """Adam's."""
    every: int = 10
    """Updates for each step of the critic."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, batch_size=(1, inf), hidden=(1, inf), embedding=(1, inf), learning_rate=(0, 1), every=(1, inf))

    @property
    def reads(self) -> Literal["obs", "next_obs"]:
        return "obs" if self.inputs == "state-action" else "next_obs"

    def seen(
        self, obs: Float[Array, "rows obs"], action: Float[Array, "rows action"], embed: Embed
    ) -> Float[Array, "rows inputs"]:
        """What the critic is given for these steps."""
        return jnp.concatenate([embed(obs), action], axis=-1) if self.inputs == "state-action" else embed(obs)

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> SinkhornState:
        width = jax.eval_shape(lambda demo: self.seen(demo.obs, demo.action, embed), demos[0]).shape[-1]
        critic = MLP.init((width, self.hidden, self.hidden, self.embedding), key=key)
        adversary = Adversary(critic, adam_init(critic), jnp.zeros(()), jnp.int32(0))
        return SinkhornState(Demos.of(demos), jnp.zeros(()), adversary)

    def loss(
        self,
        critic: MLP,
        agent: Float[Array, "batch inputs"],
        expert: Float[Array, "batch inputs"],
        plan: Float[Array, "batch batch"],
    ) -> Float[Array, ""]:
        """Minus the transport cost by a plan that is held fixed: the critic makes the cost as large as it can."""
        return -jnp.sum(plan * cosine_cost(critic(agent), critic(expert)))

    def update(
        self, state: SinkhornState, expert: Window, agent: Window, embed: Embed, *, key: PRNGKeyArray
    ) -> tuple[SinkhornState, Metrics]:
        del key
        old: Adversary = state.space
        x, y = (self.seen(jnp.asarray(w.obs[:, 0]), jnp.asarray(w.action[:, 0]), embed) for w in (agent, expert))

        def learn() -> Adversary:
            cost = cosine_cost(old.critic(x), old.critic(y))
            x_weight, y_weight = (jnp.full(len(rows), 1 / len(rows)) for rows in (x, y))
            plan = sinkhorn_plan(cost, x_weight, y_weight, self.epsilon, self.iterations)
            loss, gradient = jax.value_and_grad(self.loss)(old.critic, x, y, plan)
            critic, moments = adam_step(old.critic, gradient, old.moments, self.learning_rate)
            return Adversary(critic, moments, -loss, old.updates)

        new = jax.lax.cond(old.updates % self.every == 0, learn, lambda: old)
        new = Adversary(new.critic, new.moments, new.cost, old.updates + 1)
        return SinkhornState(state.demos, state.scale, new), {"transport_cost": new.cost}

    def costs(
        self, state: SinkhornState, obs: Float[Array, "T obs"], action: Float[Array, "T action"], embed: Embed, *, key: Any
    ) -> Float[Array, " T"]:
        demos, which = state.demos, jax.random.randint(key, (), 0, len(state.demos.obs))
        both = self.seen(obs, action, embed), self.seen(demos.obs[which], demos.action[which], embed)
        x, y = (state.space.critic(seen) for seen in both)
        return self.match(x, y, step_weights(action), demos.weight[which])


@dataclass(frozen=True)
class POTIL(SinkhornReward):
    """Settings of POTIL's reward: slow features of the actor's trunk, and the demonstration that is nearest to the episode."""

    batch_size: int = 0
    """Nothing is learned, so no steps are drawn."""
    refresh: int = 5000
    """Updates from one copy of the actor's trunk to the next; before the first the trunk is random."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, refresh=(1, inf))

    @property
    def features(self) -> Literal["critic", "actor"]:
        return "actor"

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> SinkhornState:
        del key
        return SinkhornState(Demos.of(demos), jnp.zeros(()), SlowFeatures.init(embed))

    def update(
        self, state: SinkhornState, expert: Window, agent: Window, embed: Embed, *, key: PRNGKeyArray
    ) -> tuple[SinkhornState, Metrics]:
        del expert, agent, key
        return SinkhornState(state.demos, state.scale, state.space.update(embed, self.refresh)), {}

    def costs(
        self, state: SinkhornState, obs: Float[Array, "T obs"], action: Float[Array, "T action"], embed: Embed, *, key: Any
    ) -> Float[Array, " T"]:
        del embed, key
        x, y, steps = state.space.embed(obs), state.space.embed(state.demos.obs), step_weights(action)
        costs = jax.vmap(lambda demo, weight: self.match(x, demo, steps, weight))(y, state.demos.weight)
        return costs[jnp.argmin(jnp.sum(costs, axis=1))]
