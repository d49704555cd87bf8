"""Adversarial imitation: a discriminator of expert and agent states, and DAC's reward, its logit.

Kostrikov et al. 2019 in the form of the authors' code (agent/dac.py): the features of the critic's trunk go in, and actions
only where they are asked for, as in the original.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pcil.errors import check_ranges
from pcil.nets.losses import binary_cross_entropy, gradient_penalty, interpolate
from pcil.nets.networks import MLP
from pcil.nets.optimiser import OptState, adam_init, adam_step
from pcil.rewards.base import Embed, Inputs, Metrics, Reward, select
from pcil.types import Batch


class DiscriminatorState(eqx.Module):
    """The discriminator and the state of its optimiser."""

    discriminator: MLP
    opt_state: OptState


@dataclass(frozen=True)
class DAC(Reward):
    """Settings of DAC's reward, `log D - log(1 - D)`. It equals the discriminator's logit, so no logarithm is computed."""

    inputs: Inputs = "state"
    """Input of the discriminator: the state a step led to, the state with the action taken in it, or both states of a step."""
    penalty: float = 10.0
    """Weight of the gradient penalty on the logit."""
    hidden: int = 256
    """Width of the two hidden layers."""
    learning_rate: float = 1e-4
    """Adam's learning rate."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, batch_size=(1, inf), penalty=(0, inf), hidden=(1, inf), learning_rate=(0, 1))

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> DiscriminatorState:
        width = jax.eval_shape(lambda demo: select(self.inputs, demo, embed), demos[0]).shape[-1]
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
        self, state: DiscriminatorState, expert: Batch, agent: Batch, embed: Embed, *, key: PRNGKeyArray
    ) -> tuple[DiscriminatorState, Metrics]:
        inputs = (select(self.inputs, batch.first, embed) for batch in (expert, agent))
        gradient, metrics = jax.grad(self.loss, has_aux=True)(state.discriminator, *inputs, key=key)
        return DiscriminatorState(*adam_step(state.discriminator, gradient, state.opt_state, self.learning_rate)), metrics

    def reward(self, state: DiscriminatorState, batch: Batch, embed: Embed, *, key: PRNGKeyArray) -> Float[Array, " T"]:
        del key
        return state.discriminator(select(self.inputs, batch, embed))[:, 0]

    def representation(self, state: DiscriminatorState, batch: Batch, embed: Embed) -> Float[Array, "T hidden"]:
        """The discriminator's last hidden layer (paper section 4.3)."""
        whole = state.discriminator
        return jax.nn.relu(MLP(whole.weights[:-1], whole.biases[:-1])(select(self.inputs, batch, embed)))
