"""DrQ-v2 on states: DDPG with n-step returns, a twin critic and scheduled exploration (Yarats et al. 2021).

Facts and sources: the authors' drqv2.py; `docs/methods/drqv2.md` lists where we differ.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from math import inf
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pcil.agents.base import Agent, Explorer, Metrics
from pcil.errors import check_ranges
from pcil.nets.losses import n_step_target
from pcil.nets.networks import Actor, Critic, Scaler, Trunk, scaled, unpacked, unscaled
from pcil.nets.noise import LinearSchedule, add_noise, normal_steps
from pcil.nets.optimiser import OptState, adam_init, adam_step
from pcil.types import Spec, Window


class DrQV2State(eqx.Module):
    """The networks, the target critic (with its trunk), the states of the optimisers, and the statistics of observations."""

    actor: Actor
    """It takes normalized observations, as the critic does; `DrQV2.actor` takes plain ones."""
    critic: Critic
    critic_target: Critic
    actor_opt_state: OptState
    critic_opt_state: OptState
    scaler: Scaler | None
    averaged: Actor | None
    """The exponential average of the actor, if `averaging_rate` is below 1."""


@dataclass(frozen=True)
class DrQV2(Agent):
    """Settings of DrQ-v2."""

    gamma: float = 0.99
    """Discount per agent step."""
    learning_rate: float = 1e-4
    """Adam's learning rate, for actor and critic."""
    tau: float = 0.01
    """Rate at which the target critic follows the critic, per update."""
    feature_dim: int = 50
    """Width of the trunk."""
    hidden: int = 256
    """Width of the two hidden layers of actor and critic."""
    noise: LinearSchedule = field(default_factory=LinearSchedule)
    """Schedule of the standard deviation of the exploration noise, over agent steps."""
    noise_clip: float = 0.3
    """Bound of the noise on actions inside updates; the noise of acting is not clipped."""
    noise_correlation: float = 0.0
    """Correlation of the exploration noise between consecutive steps; 0 is white noise, as in DrQ-v2. Correlated noise pushes
    a joint in one direction for several steps."""
    cloning: bool | None = False
    """Train the actor by behavioural cloning as well, before the first update and in every update. None: if the demonstrations
    have actions. The statistics of observations are then those of the demonstrations and the agent together."""
    cloning_weight: LinearSchedule = field(default_factory=lambda: LinearSchedule(30.0, 30.0, 30_000))
    """Schedule of the weight of the squared error of the cloned actions, over agent steps, if `cloning`; relative to values
    whose slope in the actions has a root mean square of 1."""
    averaging_rate: float = 1.0
    """Rate, per update, at which an average of the actor's parameters follows the actor. The average is evaluated and saved,
    and the actor itself explores and learns. 1: there is no average."""
    normalize_observations: bool = False
    """Normalize observations by their running mean and standard deviation, so that their units make no difference."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, gamma=(0, 1), learning_rate=(0, 1), tau=(0, 1), noise_clip=(0, inf), noise_correlation=(0, 1))
        check_ranges(self, feature_dim=(1, inf), hidden=(1, inf), averaging_rate=(0, 1))

    @property
    def clones(self) -> bool | None:
        return self.cloning

    def init(self, spec: Spec, *, key: PRNGKeyArray) -> DrQV2State:
        actor_key, critic_key = jax.random.split(key)
        actor = Actor.init(spec.obs_dim, spec.action_dim, self.feature_dim, self.hidden, key=actor_key)
        critic = Critic.init(spec.obs_dim, spec.action_dim, self.feature_dim, self.hidden, key=critic_key)
        target = jax.tree.map(jnp.copy, critic)
        scaler = Scaler.init(spec.obs_dim) if self.normalize_observations else None
        averaged = jax.tree.map(jnp.copy, actor) if self.averaging_rate < 1 else None
        return DrQV2State(actor, critic, target, adam_init(actor), adam_init(critic), scaler, averaged)

    def critic_loss(
        self,
        critic: Critic,
        obs: Float[Array, "batch obs"],
        action: Float[Array, "batch action"],
        target: Float[Array, " batch"],
    ) -> tuple[Float[Array, ""], Metrics]:
        """Squared distance of both values to the target, summed over the two, averaged over the batch."""
        first, second = critic(obs, action)
        loss = jnp.mean((first - target) ** 2) + jnp.mean((second - target) ** 2)
        return loss, {"critic_loss": loss, "value": jnp.mean(first), "target": jnp.mean(target)}

    def actor_loss(
        self,
        actor: Actor,
        critic: Critic,
        obs: Float[Array, "batch obs"],
        noise: Float[Array, "batch action"],
        alive: Float[Array, " batch"],
    ) -> Float[Array, ""]:
        """Minus the smaller value of the actor's noisy action (deterministic policy gradient), where `alive` is 1."""
        first, second = critic(obs, add_noise(actor(obs), noise))
        return -jnp.mean(alive * jnp.minimum(first, second))

    def unit_actor_loss(
        self,
        actor: Actor,
        critic: Critic,
        obs: Float[Array, "batch obs"],
        noise: Float[Array, "batch action"],
        alive: Float[Array, " batch"],
    ) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """A loss with the gradient of `actor_loss`, divided by the root mean square of the value's slope in the actions, and
        `actor_loss`. The slope's length is what an action gains, whatever the size of the values."""
        action = add_noise(actor(obs), noise)

        def value(action: Float[Array, "batch action"]) -> Float[Array, ""]:
            return jnp.sum(alive * jnp.minimum(*critic(obs, action)))

        total, slope = jax.value_and_grad(value)(jax.lax.stop_gradient(action))
        size = jnp.sqrt(jnp.mean(jnp.sum(slope**2, axis=-1))) + 1e-6
        return -jnp.mean(jnp.sum(slope * action, axis=-1)) / size, -total / len(obs)

    def cloning_error(self, state: DrQV2State, actor: Actor, cloned: Window) -> Float[Array, ""]:
        """The squared error of the actor's mean actions in states of the demonstrations, summed over the action's entries and
        averaged over the windows that do not begin in the absorbing state."""
        obs, alive = cloned.obs[:, 0], self._alive(cloned.obs[:, 0])
        error = jnp.sum((actor(scaled(state.scaler, obs)) - cloned.action[:, 0]) ** 2, axis=-1)
        return jnp.sum(alive * error) / jnp.maximum(jnp.sum(alive), 1)

    def clone(self, state: DrQV2State, cloned: Window) -> DrQV2State:
        gradient = jax.grad(lambda actor: self.cloning_error(state, actor, cloned))(state.actor)
        actor, opt_state = adam_step(state.actor, gradient, state.actor_opt_state, self.learning_rate)
        averaged = actor if self.averaging_rate < 1 else None
        return dataclasses.replace(state, actor=actor, actor_opt_state=opt_state, averaged=averaged)

    def target(self, state: DrQV2State, window: Window, noise: Float[Array, "batch action"]) -> Float[Array, " batch"]:
        """The n-step double-Q target: `sum_k gamma^k r_k + gamma^n min(Q1', Q2')(s_n, a')`; `a' = 0` in the absorbing one."""
        obs_n = window.obs[:, -1]
        action = add_noise(state.actor(scaled(state.scaler, obs_n)), noise) * self._alive(obs_n)[:, None]
        first, second = state.critic_target(scaled(state.scaler, obs_n), action)
        return n_step_target(window.reward, window.discount, jnp.minimum(first, second), self.gamma)

    def _alive(self, obs: Float[Array, "batch obs"]) -> Float[Array, " batch"]:
        """0 in the absorbing state, 1 elsewhere."""
        return 1 - obs[:, -1] if self.absorbing else jnp.ones(obs.shape[0])

    def observe(self, state: DrQV2State, obs: Float[Array, "rows obs"]) -> DrQV2State:
        return state if state.scaler is None else dataclasses.replace(state, scaler=state.scaler.update(obs))

    def update(
        self, state: DrQV2State, window: Window, *, cloned: Window | None = None, step: Array, key: PRNGKeyArray
    ) -> tuple[DrQV2State, Metrics]:
        alive = self._alive(window.obs[:, 0])
        noise = self.noise(step) * jax.random.normal(key, (2, *window.action[:, 0].shape))
        noise = jnp.clip(noise, -self.noise_clip, self.noise_clip)
        target = jax.lax.stop_gradient(self.target(state, window, noise[0]))

        obs, action = scaled(state.scaler, window.obs[:, 0]), window.action[:, 0]
        gradient, metrics = jax.grad(self.critic_loss, has_aux=True)(state.critic, obs, action, target)
        critic, critic_opt_state = adam_step(state.critic, gradient, state.critic_opt_state, self.learning_rate)

        def loss_of(actor: Actor) -> tuple[Float[Array, ""], Metrics]:
            if cloned is None:
                loss = self.actor_loss(actor, critic, obs, noise[1], alive)
                return loss, {"actor_loss": loss}
            error = self.cloning_error(state, actor, cloned)
            move, loss = self.unit_actor_loss(actor, critic, obs, noise[1], alive)
            return move + self.cloning_weight(step) * error, {"actor_loss": loss, "cloning_error": error}

        gradient, more = jax.grad(loss_of, has_aux=True)(state.actor)
        actor, actor_opt_state = adam_step(state.actor, gradient, state.actor_opt_state, self.learning_rate)

        critic_target = _towards(critic, state.critic_target, self.tau)
        averaged = state.averaged and _towards(actor, state.averaged, self.averaging_rate)
        metrics |= more
        return DrQV2State(actor, critic, critic_target, actor_opt_state, critic_opt_state, state.scaler, averaged), metrics

    def actor(self, state: DrQV2State) -> Actor:
        return self._unscaled(state, state.actor)

    def started_from(self, state: DrQV2State, actor: Actor) -> DrQV2State:
        actor, scaler = unpacked(actor, state.actor, state.scaler, absorbing=bool(self.absorbing))
        averaged = jax.tree.map(jnp.copy, actor) if state.averaged else None
        return dataclasses.replace(state, actor=actor, scaler=scaler, averaged=averaged)

    def averaged(self, state: DrQV2State) -> Actor | None:
        return state.averaged and self._unscaled(state, state.averaged)

    def _unscaled(self, state: DrQV2State, actor: Actor) -> Actor:
        """An actor for observations of the environment, from one for those of an update."""
        trunk = unscaled(actor.trunk, state.scaler)
        return Actor(trunk.without_last() if self.absorbing else trunk, actor.head)

    def trunk(self, state: DrQV2State, whose: Literal["critic", "actor"]) -> Trunk:
        return unscaled(state.critic.trunk if whose == "critic" else state.actor.trunk, state.scaler)

    def explorer(self, action_dim: int, rng: np.random.Generator) -> Explorer:
        noise = normal_steps(rng, action_dim, self.noise_correlation)
        return lambda actor, obs, step: add_noise(actor(obs, np), self.noise(step, np) * next(noise), np)


def _towards(fast: Any, slow: Any, rate: float) -> Any:
    """Parameters that follow others: `slow + rate (fast - slow)`."""
    return jax.tree.map(lambda slow, fast: slow + rate * (fast - slow), slow, fast)
