"""Sinkhorn imitation: the entropic transport between an episode and a demonstration pays each step for its part.

`SIL` learns the space in which costs are taken (Papagiannis and Li 2020), off-policy here. `POTIL` is the one in the authors'
code (agent/potil.py, rewarder.py), which learns nothing. `docs/methods/sil.md` numbers the differences.
"""

from __future__ import annotations

import abc
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from pcil.errors import check_ranges
from pcil.nets.networks import MLP, unit_sphere
from pcil.nets.optimiser import OptState, adam_init, adam_step
from pcil.nets.transport import sinkhorn_plan
from pcil.rewards.base import Embed, Inputs, Metrics, Reward, SlowFeatures, select
from pcil.types import Batch


class Demos(eqx.Module):
    """All demonstrations, padded to the longest."""

    steps: Batch
    """`[demos, steps]`."""
    weight: Float[Array, "demos steps"]
    """One over a demonstration's length, and 0 in its padding."""

    @classmethod
    def of(cls, demos: Sequence[Batch]) -> Demos:
        longest = max(len(demo.obs) for demo in demos)
        weights = [jnp.full((len(demo.obs), 1), 1 / len(demo.obs), jnp.float32) for demo in demos]
        columns = *zip(*(demo[:3] for demo in demos), strict=True), weights
        *steps, weight = (jnp.stack([jnp.pad(x, ((0, longest - len(x)), (0, 0))) for x in part]) for part in columns)
        return cls(Batch(*steps), weight[..., 0])

    def __getitem__(self, index: Any) -> Demos:
        return jax.tree.map(lambda array: array[index], self)


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
    def costs(self, state: Any, batch: Batch, embed: Embed, *, key: Any) -> Float[Array, " T"]:
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

    def reward(self, state: Any, batch: Batch, embed: Embed, *, key: Any) -> Float[Array, " T"]:
        return -jnp.where(state.scale > 0, state.scale, 1.0) * self.costs(state, batch, embed, key=key)

    def after_episode(self, state: Any, batch: Batch, embed: Embed, *, key: Any) -> Any:
        """Fix the scale by the first episode (authors' code: `auto_rew_scale`)."""
        if self.first_sum == 0:
            return state

        def by_this_episode() -> Array:
            total = jnp.sum(self.costs(state, batch, embed, key=key))
            return -self.first_sum / jnp.maximum(total, 1e-6)

        scale = jax.lax.cond(state.scale > 0, lambda: state.scale, by_this_episode)
        return replace(state, scale=scale)


class Adversary(eqx.Module):
    """The critic, its optimiser's opt_state, and what it did last."""

    critic: MLP
    opt_state: OptState
    cost: Float[Array, ""]
    """The transport cost at its last step."""
    updates: Int[Array, ""]


@dataclass(frozen=True)
class SIL(SinkhornReward):
    """Settings of SIL's reward: a critic learns the space, and each episode is compared with a random demonstration."""

    inputs: Inputs = "state"
    """What the critic is given: the features of the states that steps led to, of states with the actions taken in them, or of
    both states of a step."""
    hidden: int = 128
    """Width of the critic's two hidden layers."""
    embedding: int = 30
    """Dimensions of the space."""
    learning_rate: float = 5e-4
    """Adam's learning rate."""
    every: int = 10
    """Updates per step of the critic."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, batch_size=(1, inf), hidden=(1, inf), embedding=(1, inf), learning_rate=(0, 1), every=(1, inf))

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> SinkhornState:
        width = jax.eval_shape(lambda demo: select(self.inputs, demo, embed), demos[0]).shape[-1]
        critic = MLP.init((width, self.hidden, self.hidden, self.embedding), key=key)
        adversary = Adversary(critic, adam_init(critic), jnp.zeros(()), jnp.int32(0))
        return SinkhornState(Demos.of(self.subsampled(demos)), jnp.zeros(()), adversary)

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
        self, state: SinkhornState, expert: Batch, agent: Batch, embed: Embed, *, key: PRNGKeyArray
    ) -> tuple[SinkhornState, Metrics]:
        del key
        old: Adversary = state.space
        x, y = (select(self.inputs, batch.first, embed) for batch in (agent, expert))

        def learn() -> Adversary:
            cost = cosine_cost(old.critic(x), old.critic(y))
            x_weight, y_weight = (jnp.full(len(rows), 1 / len(rows)) for rows in (x, y))
            plan = sinkhorn_plan(cost, x_weight, y_weight, self.epsilon, self.iterations)
            loss, gradient = jax.value_and_grad(self.loss)(old.critic, x, y, plan)
            critic, opt_state = adam_step(old.critic, gradient, old.opt_state, self.learning_rate)
            return Adversary(critic, opt_state, -loss, old.updates)

        new = jax.lax.cond(old.updates % self.every == 0, learn, lambda: old)
        new = replace(new, updates=old.updates + 1)
        return replace(state, space=new), {"transport_cost": new.cost}

    def costs(self, state: SinkhornState, batch: Batch, embed: Embed, *, key: Any) -> Float[Array, " T"]:
        demo = state.demos[jax.random.randint(key, (), 0, len(state.demos.weight))]
        x, y = (state.space.critic(select(self.inputs, steps, embed)) for steps in (batch, demo.steps))
        return self.match(x, y, step_weights(batch.action), demo.weight)


@dataclass(frozen=True)
class POTIL(SinkhornReward):
    """Settings of POTIL's reward: slow features of the actor's trunk, and the demonstration that is nearest to the episode."""

    batch_size: int = 0
    """Nothing is learned, so no steps are drawn."""
    refresh: int = 5000
    """Updates between two copies of the actor's trunk; the first copy is the untrained trunk."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, refresh=(1, inf))

    @property
    def trunk(self) -> Literal["critic", "actor"]:
        return "actor"

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> SinkhornState:
        del key
        return SinkhornState(Demos.of(self.subsampled(demos)), jnp.zeros(()), SlowFeatures.init(embed))

    def update(
        self, state: SinkhornState, expert: Batch, agent: Batch, embed: Embed, *, key: PRNGKeyArray
    ) -> tuple[SinkhornState, Metrics]:
        del expert, agent, key
        return replace(state, space=state.space.update(embed, self.refresh)), {}

    def costs(self, state: SinkhornState, batch: Batch, embed: Embed, *, key: Any) -> Float[Array, " T"]:
        del embed, key
        steps, demos = step_weights(batch.action), state.demos.steps
        x, y = (select("state", some, state.space.embed) for some in (batch, demos))
        costs = jax.vmap(lambda demo, weight: self.match(x, demo, steps, weight))(y, state.demos.weight)
        return costs[jnp.argmin(jnp.sum(costs, axis=1))]
