"""Adversarial imitation: a discriminator of expert and agent states, and DAC's reward, its logit.

Kostrikov et al. 2019 in the form of the authors' code (agent/dac.py): the features of the critic's trunk go in, and actions
only where they are asked for, as in the original.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pcil.errors import check_ranges
from pcil.nets.losses import binary_cross_entropy, gradient_penalty, interpolate
from pcil.nets.networks import MLP
from pcil.nets.optimiser import Moments, adam_init, adam_step
from pcil.rewards.base import Embed, Metrics, Reward
from pcil.types import Batch, Window


class DiscriminatorState(eqx.Module):
    """The discriminator and its optimiser's moments."""

    discriminator: MLP
    moments: Moments


@dataclass(frozen=True)
class DAC(Reward):
    """Settings of DAC's reward: `log D - log(1 - D)`, which is the logit itself, so it is never computed by logarithms."""

    inputs: Literal["state", "state-action"] = "state"
    """What is told apart: the states that steps led to, or states with the actions taken in them."""
    penalty: float = 10.0
    """Weight of the gradient penalty on the logit."""
    hidden: int = 256
    """Width of the two hidden layers."""
    learning_rate: float = 1e-4
    """Adam's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, batch_size=(1, inf), penalty=(0, inf), hidden=(1, inf), learning_rate=(0, 1))

    @property
    def reads(self) -> Literal["obs", "next_obs"]:
        return "obs" if self.inputs == "state-action" else "next_obs"

    def seen(
        self, obs: Float[Array, "batch obs"], action: Float[Array, "batch action"], embed: Embed
    ) -> Float[Array, "batch inputs"]:
        """What the discriminator is given for these steps."""
        return jnp.concatenate([embed(obs), action], axis=-1) if self.inputs == "state-action" else embed(obs)

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> DiscriminatorState:
        width = jax.eval_shape(lambda demo: self.seen(demo.obs, demo.action, embed), demos[0]).shape[-1]
        discriminator = MLP.init((width, self.hidden, self.hidden, 1), key=key)
        return DiscriminatorState(discriminator, adam_init(discriminator))

    def loss(
        self,
        discriminator: MLP,
        expert: Float[Array, "batch inputs"],
        agent: Float[Array, "batch inputs"],
        *,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, ""], Metrics]:
        """Cross-entropy with label 1 for the expert, plus the penalty on the logit's slope between the two."""
        logits = discriminator(jnp.concatenate([expert, agent]))[:, 0]
        expert_logit, agent_logit = jnp.split(logits, [expert.shape[0]])
        entropy = binary_cross_entropy(expert_logit, agent_logit)
        mixed = interpolate(jax.random.uniform(key, (expert.shape[0], 1)), expert, agent[: expert.shape[0]])
        slope = gradient_penalty(lambda x: discriminator(x)[:, 0], mixed) if self.penalty else jnp.zeros(())
        right = jnp.mean(expert_logit > 0, dtype=jnp.float32) + jnp.mean(agent_logit < 0, dtype=jnp.float32)
        metrics = {
            "entropy_loss": entropy,
            "penalty": slope,
            "accuracy": right / 2,
            "expert_logit": jnp.mean(expert_logit),
            "agent_logit": jnp.mean(agent_logit),
        }
        return entropy + self.penalty * slope, metrics

    def update(
        self, state: DiscriminatorState, expert: Window, agent: Window, embed: Embed, *, key: PRNGKeyArray
    ) -> tuple[DiscriminatorState, Metrics]:
        seen = (self.seen(jnp.asarray(w.obs[:, 0]), jnp.asarray(w.action[:, 0]), embed) for w in (expert, agent))
        gradient, metrics = jax.grad(self.loss, has_aux=True)(state.discriminator, *seen, key=key)
        return DiscriminatorState(*adam_step(state.discriminator, gradient, state.moments, self.learning_rate)), metrics

    def reward(
        self,
        state: DiscriminatorState,
        obs: Float[Array, "T obs"],
        action: Float[Array, "T action"],
        embed: Embed,
        *,
        key: PRNGKeyArray,
    ) -> Float[Array, " T"]:
        del key
        return state.discriminator(self.seen(obs, action, embed))[:, 0]

    def representation(
        self, state: DiscriminatorState, obs: Float[Array, "T obs"], action: Float[Array, "T action"], embed: Embed
    ) -> Float[Array, "T hidden"]:
        """The discriminator's last hidden layer (paper section 4.3)."""
        whole = state.discriminator
        return jax.nn.relu(MLP(whole.weights[:-1], whole.biases[:-1])(self.seen(obs, action, embed)))
