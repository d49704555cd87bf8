"""Primal Wasserstein imitation: a greedy coupling of the episode with the demonstrations pays each step for its part.

Dadashi et al. 2021, and in the form of the authors' code (agent/pwil.py) on slowly refreshed features of the actor's trunk;
`docs/methods/pwil.md` numbers the differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, sqrt
from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from pcil.errors import check_ranges
from pcil.nets.networks import Normalizer, Scaler
from pcil.rewards.base import Embed, Metrics, Reward, SlowFeatures, select
from pcil.types import Batch


class PWILState(eqx.Module):
    """The demonstrations and how they are measured; only the slow features ever change."""

    atoms: Float[Array, "atoms inputs"]
    """Expert steps, as `PWIL.points` gives them, before they are standardised or embedded."""
    mean: Float[Array, "1 inputs"]
    deviation: Float[Array, "1 inputs"]
    horizon: Int[Array, ""]
    """Steps among which an episode's mass is divided: those of the longest demonstration."""
    slow: SlowFeatures | None


def move(left: Int[Array, " atoms"], distance: Float[Array, " atoms"]) -> tuple[Int[Array, " atoms"], Float[Array, ""]]:
    """Move one step's mass to the nearest atoms that have room left; returns what room is left, and the mean distance moved.

    Mass is counted in units of which a step has as many as there are atoms. Whole numbers lose nothing to rounding.
    """
    distance = jnp.minimum(distance, jnp.finfo(distance.dtype).max)  # infinity is for full atoms, or the loop could not end

    def nearest(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        mass, left, total = carry
        atom = jnp.argmin(jnp.where(left > 0, distance, jnp.inf))
        moved = jnp.minimum(mass, left[atom])
        return mass - moved, left.at[atom].add(-moved), total + moved.astype(total.dtype) * distance[atom]

    atoms = left.shape[0]
    start = jnp.int32(atoms), left, jnp.zeros((), distance.dtype)
    _, left, total = jax.lax.while_loop(lambda carry: carry[0] > 0, nearest, start)
    return left, total / atoms


def greedy_distances(
    atoms: Float[Array, "atoms inputs"], points: Float[Array, "T inputs"], horizon: Int[Array, ""]
) -> Float[Array, " T"]:
    """How far each step's mass moves in the greedy coupling, in the order of time; no step depends on a later one.

    An episode of `horizon` steps fills every atom, with `horizon` units each. A longer one finds them all empty again then.
    """

    def step(left: Array, x: tuple[Array, Array]) -> tuple[Array, Array]:
        time, point = x
        left = jnp.where(time % horizon == 0, horizon, left)
        return move(left, jnp.sqrt(jnp.sum((atoms - point[None]) ** 2, axis=-1)))

    full = jnp.zeros(atoms.shape[0], jnp.int32)
    return jax.lax.scan(step, full, (jnp.arange(points.shape[0]), points))[1]


@dataclass(frozen=True)
class PWIL(Reward):
    """Settings of PWIL's reward, `alpha exp(-sigma c)` with `c` the cost of the step's part of the coupling."""

    scope: ClassVar[Literal["step", "episode"]] = "episode"
    takes_padding: ClassVar[bool] = True

    batch_size: int = 0
    """Nothing is learned, so no steps are drawn."""
    inputs: Literal["state", "state-action", "trunk"] = "state"
    """What is coupled: states or states with actions, standardised, or slow features of the actor's trunk."""
    alpha: float = 5.0
    """The reward of a step that costs nothing."""
    beta: float = 5.0
    """How fast the reward falls: `sigma = beta horizon / sqrt(dimensions)`."""
    refresh: int = 5000
    """Updates between two copies of the actor's trunk; the first copy is the untrained trunk."""
    prefill_steps: int = 0
    """Expert steps, each paid `alpha`, with which the replay begins."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, alpha=(1e-6, inf), beta=(0, inf), refresh=(1, inf), prefill_steps=(0, inf))

    @property
    def trunk(self) -> Literal["critic", "actor"]:
        return "actor"

    @property
    def prefill(self) -> tuple[int, float]:
        return self.prefill_steps, self.alpha

    def points(self, batch: Batch) -> Float[Any, "T inputs"]:
        """What is coupled, in the environment's units."""
        return select("state" if self.inputs == "trunk" else self.inputs, batch, lambda obs: obs)

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> PWILState:
        del key
        atoms = jnp.concatenate([self.points(demo) for demo in self.subsampled(demos)])
        scale = Scaler.init(atoms.shape[1]).update(atoms).normalizer
        slow = SlowFeatures.init(embed) if self.inputs == "trunk" else None
        horizon = jnp.int32(max(len(demo.obs) for demo in demos))
        return PWILState(atoms, scale.mean[None], scale.deviation[None], horizon, slow)

    def update(
        self, state: PWILState, expert: Batch, agent: Batch, embed: Embed, *, key: PRNGKeyArray
    ) -> tuple[PWILState, Metrics]:
        del expert, agent, key
        return replace(state, slow=state.slow and state.slow.update(embed, self.refresh)), {}

    def reward(self, state: PWILState, batch: Batch, embed: Embed, *, key: PRNGKeyArray) -> Float[Array, " T"]:
        """A step has `1 / horizon` of the mass, so `sigma c` is `beta / sqrt(dimensions)` times the mean distance it moves."""
        del embed, key
        both = state.atoms, self.points(batch)
        if state.slow is None:
            atoms, points = map(Normalizer(state.mean[0], state.deviation[0]), both)
            dimensions = batch.obs.shape[-1] + batch.action.shape[-1]
        else:
            atoms, points = (state.slow.embed(x) for x in both)
            dimensions = atoms.shape[-1]
        return self.alpha * jnp.exp(-self.beta / sqrt(dimensions) * greedy_distances(atoms, points, state.horizon))
