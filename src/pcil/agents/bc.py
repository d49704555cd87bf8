"""Behavioural cloning: the actor of DrQ-v2, fitted to the expert's actions (paper section 4.1; authors' code: agent/bc.py)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from math import inf, log, pi
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pcil.agents.base import Agent, Explorer, Metrics
from pcil.errors import InputError, check_ranges
from pcil.nets.networks import Actor, Scaler, Trunk, scaled, unpacked, unscaled
from pcil.nets.optimiser import OptState, adam_init, adam_step
from pcil.types import Spec, Window


class BCState(eqx.Module):
    """The actor, the state of its optimiser, and the statistics of observations."""

    actor: Actor
    opt_state: OptState
    scaler: Scaler | None


@dataclass(frozen=True)
class BC(Agent):
    """Settings of behavioural cloning."""

    offline: ClassVar[bool] = True

    n_step: int = 1
    """Length of a window; only its first step is used."""
    learning_rate: float = 1e-4
    """Adam's learning rate."""
    deviation: float = 0.1
    """Standard deviation of the Gaussian around the actor's mean action."""
    feature_dim: int = 50
    """Width of the trunk."""
    hidden: int = 256
    """Width of the two hidden layers."""
    normalize_observations: bool = False
    """Normalize observations by their running mean and standard deviation, so that their units make no difference."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.absorbing:
            raise InputError("BC plays no episode that could end, so it has no absorbing states; leave agent.absorbing out.")
        check_ranges(self, learning_rate=(0, 1), deviation=(1e-6, inf), feature_dim=(1, inf), hidden=(1, inf))

    def init(self, spec: Spec, *, key: PRNGKeyArray) -> BCState:
        actor = Actor.init(spec.obs_dim, spec.action_dim, self.feature_dim, self.hidden, key=key)
        return BCState(actor, adam_init(actor), Scaler.init(spec.obs_dim) if self.normalize_observations else None)

    def loss(
        self, actor: Actor, obs: Float[Array, "batch obs"], action: Float[Array, "batch action"]
    ) -> tuple[Float[Array, ""], Metrics]:
        """`-sum_d log N(a_d; mu_d(s), deviation)`, averaged over the batch: the squared error over twice the variance, and a
        constant."""
        error = jnp.mean(jnp.sum((actor(obs) - action) ** 2, axis=-1))
        constant = action.shape[-1] * (log(self.deviation) + log(2 * pi) / 2)
        return error / (2 * self.deviation**2) + constant, {"squared_error": error}

    def observe(self, state: BCState, obs: Float[Array, "rows obs"]) -> BCState:
        return dataclasses.replace(state, scaler=state.scaler and state.scaler.update(obs))

    def update(self, state: BCState, window: Window, *, step: Array, key: PRNGKeyArray) -> tuple[BCState, Metrics]:
        del step, key
        gradient_of = jax.value_and_grad(self.loss, has_aux=True)
        obs = scaled(state.scaler, window.obs[:, 0])
        (loss, metrics), gradient = gradient_of(state.actor, obs, window.action[:, 0])
        actor, opt_state = adam_step(state.actor, gradient, state.opt_state, self.learning_rate)
        return dataclasses.replace(state, actor=actor, opt_state=opt_state), {"loss": loss, **metrics}

    def actor(self, state: BCState) -> Actor:
        return Actor(self.trunk(state, "actor"), state.actor.head)

    def started_from(self, state: BCState, actor: Actor) -> BCState:
        actor, scaler = unpacked(actor, state.actor, state.scaler, absorbing=False)
        return dataclasses.replace(state, actor=actor, scaler=scaler)

    def trunk(self, state: BCState, whose: Literal["critic", "actor"]) -> Trunk:
        del whose
        return unscaled(state.actor.trunk, state.scaler)

    def explorer(self, action_dim: int, rng: np.random.Generator) -> Explorer:
        del action_dim, rng
        return lambda actor, obs, step: actor(obs, np)
