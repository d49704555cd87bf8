"""Policy contrastive imitation learning: an expert-centred embedding on the unit sphere and a similarity reward.

Paper sections 3.2, 3.3 and Appendix B. `docs/methods/pcil.md` numbers every point where we differ from the paper or from the
authors' code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pcil.errors import check_ranges
from pcil.losses import gradient_penalty, info_nce, interpolate
from pcil.networks import MLP, unit_sphere
from pcil.optimiser import Moments, adam_init, adam_step
from pcil.rewards.base import Embed, Metrics, Reward
from pcil.types import Batch, Window


class PCILState(eqx.Module):
    """The encoder, its optimiser's moments, and the expert states that rewards compare with."""

    encoder: MLP
    moments: Moments
    reference: Float[Array, "batch obs"]
    """The last batch of expert states: partners of the penalty and of the similarity reward."""


def similarity(
    embedding: Float[Array, "T dim"], expert: Float[Array, "batch dim"], how: Literal["random", "mean"]
) -> Float[Array, " T"]:
    """The reward `Phi(s) . Phi(s_E)`, in [-1, 1] for unit embeddings (Eq. 2).

    "random" compares step `i` with expert row `i mod batch`, and since the rows are random draws each step meets a random
    expert sample (authors' code: train.py); "mean" compares with the rows' mean (paper, Appendix B: "similar performance").
    """
    if how == "mean":
        return embedding @ jnp.mean(expert, axis=0)
    rows = jnp.arange(embedding.shape[0]) % expert.shape[0]
    return jnp.sum(embedding * expert[rows], axis=-1)


@dataclass(frozen=True)
class PCIL(Reward):
    """Settings of PCIL's reward."""

    temperature: float = 1.0
    """Divides the cosines inside the InfoNCE loss."""
    compare: Literal["random", "mean"] = "random"
    """The reward's expert: a random sample or the mean embedding."""
    penalty: float = 10.0
    """Weight of the gradient penalty on the similarity reward."""
    hidden: int = 256
    """Width of the three hidden layers; the embedding has a quarter of it."""
    learning_rate: float = 1e-4
    """Adam's."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(
            self, temperature=(1e-6, inf), penalty=(0, inf), hidden=(4, inf), learning_rate=(0, 1), batch_size=(2, inf)
        )

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> PCILState:
        encoder_key, reference_key = jax.random.split(key)
        states = jnp.concatenate([demo.obs for demo in demos])
        reference = states[jax.random.randint(reference_key, (self.batch_size,), 0, states.shape[0])]
        features = jax.eval_shape(embed, reference).shape[-1]
        encoder = MLP.init((features, self.hidden, self.hidden, self.hidden, self.hidden // 4), key=encoder_key)
        return PCILState(encoder, adam_init(encoder), reference)

    def loss(
        self,
        encoder: MLP,
        expert: Float[Array, "batch features"],
        agent: Float[Array, "batch features"],
        partner: Float[Array, "batch features"],
        *,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, ""], Metrics]:
        """InfoNCE with expert anchors and all agent samples as negatives, plus the penalty on the reward's slope.

        An anchor's positive is one random other row of the expert batch. The penalty is taken on the features between an
        expert and an agent row; its scalar is `Phi(mix) . Phi(partner)`, the reward, with the partner's side held fixed.
        """
        shift_key, mix_key = jax.random.split(key)
        raw = encoder(jnp.concatenate([expert, agent]))
        sphere = unit_sphere(raw)
        anchor, negatives = jnp.split(sphere, [expert.shape[0]])
        positive = anchor[derangement(shift_key, expert.shape[0])]
        contrast, diagnostics = info_nce(anchor, positive, negatives, self.temperature)

        fixed = jax.lax.stop_gradient(unit_sphere(encoder(partner)))
        u = jax.random.uniform(mix_key, (expert.shape[0], 1))
        mixed = interpolate(u, expert, agent[: expert.shape[0]])
        slope = gradient_penalty(lambda x: jnp.sum(unit_sphere(encoder(x)) * fixed, axis=-1), mixed)
        metrics = diagnostics | {
            "contrast_loss": contrast,
            "penalty": slope,
            "embedding_norm": jnp.mean(jnp.linalg.norm(raw, axis=-1)),
        }
        return contrast + self.penalty * slope, metrics

    def update(
        self, state: PCILState, expert: Window, agent: Window, embed: Embed, *, key: PRNGKeyArray
    ) -> tuple[PCILState, Metrics]:
        states = jnp.asarray(expert.obs[:, 0])
        features = [embed(obs) for obs in (states, jnp.asarray(agent.obs[:, 0]), state.reference)]
        gradient, metrics = jax.grad(self.loss, has_aux=True)(state.encoder, *features, key=key)
        encoder, moments = adam_step(state.encoder, gradient, state.moments, self.learning_rate)
        return PCILState(encoder, moments, states), metrics

    def reward(
        self, state: PCILState, obs: Float[Array, "T obs"], action: Float[Array, "T action"], embed: Embed, *, key: Any
    ) -> Float[Array, " T"]:
        del action, key
        both = unit_sphere(state.encoder(embed(jnp.concatenate([state.reference, obs]))))
        expert, agent = jnp.split(both, [state.reference.shape[0]])
        return similarity(agent, expert, self.compare)

    def representation(
        self, state: PCILState, obs: Float[Array, "T obs"], action: Float[Array, "T action"], embed: Embed
    ) -> Float[Array, "T dim"]:
        """The embedding `Phi(s)`, on the unit sphere."""
        del action
        return unit_sphere(state.encoder(embed(obs)))


def derangement(key: PRNGKeyArray, size: int) -> Array:
    """Random partners, none of them oneself: a random order, shifted by one along itself."""
    order = jax.random.permutation(key, size)
    return jnp.zeros(size, order.dtype).at[order].set(jnp.roll(order, 1))
