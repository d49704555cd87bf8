"""Policy contrastive imitation learning: an expert-centred embedding on the unit sphere and a similarity reward.

Paper sections 3.2, 3.3 and Appendix B. `docs/methods/pcil.md` numbers every point where we differ from the paper or from the
authors' code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from pcil.errors import check_ranges
from pcil.nets.losses import gradient_penalty, group_info_nce, info_nce, interpolate
from pcil.nets.networks import MLP, unit_sphere
from pcil.nets.optimiser import adam_count
from pcil.rewards.base import Embed, Inputs, Metrics, Reward, only, select
from pcil.rewards.embedding import EmbeddingState, Head, advance, embedding, embedding_reward, init_embedding
from pcil.types import Batch


@dataclass(frozen=True)
class PCIL(Reward):
    """Settings of PCIL's reward."""

    inputs: Inputs = "state"
    """Input of the encoder: the state a step led to, the state with the action taken in it, or both states of a step."""
    temperature: float = 1.0
    """Divides the cosines inside the InfoNCE loss."""
    compare: Literal["random", "mean"] = "random"
    """What the reward compares with: a random expert sample, or the mean expert embedding."""
    head: Head = "similarity"
    """The reward: similarity to the expert, or the logit of a linear classifier of embeddings ("gail")."""
    penalty: float = 10.0
    """Weight of the gradient penalty on the similarity reward."""
    penalty_rows: int | None = None
    """Compute the penalty on the first rows of the batch, this many; None: on all of them."""
    penalty_every: int = 1
    """Compute the penalty at every N-th update only, with N times the weight."""
    stages: int = 0
    """Also take agent rows as anchors, with positives from the same one of N stages of training; 0: expert anchors only."""
    stage_weight: float = 1.0
    """Weight of the loss of the agent's anchors."""
    hidden: int = 256
    """Width of the three hidden layers; the embedding has a quarter of it."""
    learning_rate: float = 1e-4
    """Adam's learning rate."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, temperature=(1e-6, inf), penalty=(0, inf), penalty_every=(1, inf), stages=(0, inf))
        if self.penalty_rows is not None:
            check_ranges(self, penalty_rows=(1, self.batch_size))
        check_ranges(self, stage_weight=(0, inf), hidden=(4, inf), learning_rate=(0, 1), batch_size=(2, inf))

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> EmbeddingState:
        sizes: Any = {"hidden": self.hidden, "batch_size": self.batch_size, "head": self.head}
        return init_embedding(self.subsampled(demos), embed, self.inputs, **sizes, key=key)

    def loss(
        self,
        encoder: MLP,
        expert: Float[Array, "batch features"],
        agent: Float[Array, "batch features"],
        partner: Float[Array, "batch features"],
        *,
        key: PRNGKeyArray,
        episode_id: Int[Array, " batch"] | None = None,
        count: int | Array = 0,
    ) -> tuple[Float[Array, ""], Metrics]:
        """InfoNCE with expert anchors and all agent samples as negatives, plus the penalty on the reward's slope.

        An anchor's positive is one random other row of the expert batch. The penalty is taken on the features between an
        expert and an agent row; its scalar is `Phi(mix) . Phi(partner)`, the reward, with the partner's side held fixed.
        `count` updates came before; a lazy penalty is computed at every `penalty_every`-th and then weighs as many times more.
        `episode_id`, that of the agent's rows, is needed for anchors on the agent's stages alone.
        """
        shift_key, mix_key = jax.random.split(key)
        raw = encoder(jnp.concatenate([expert, agent]))
        sphere = unit_sphere(raw)
        anchor, negatives = jnp.split(sphere, [expert.shape[0]])
        positive = anchor[derangement(shift_key, expert.shape[0])]
        loss, diagnostics = info_nce(anchor, positive, negatives, self.temperature)

        def slope() -> Float[Array, ""]:
            rows = self.penalty_rows or expert.shape[0]
            fixed = jax.lax.stop_gradient(unit_sphere(encoder(partner[:rows])))
            u = jax.random.uniform(mix_key, (rows, 1))
            mixed = interpolate(u, expert[:rows], agent[:rows])
            return gradient_penalty(lambda x: jnp.sum(unit_sphere(encoder(x)) * fixed, axis=-1), mixed)

        every = self.penalty_every
        if not self.penalty:
            penalty = jnp.zeros(())
        else:
            penalty = slope() if every == 1 else every * jax.lax.cond(count % every == 0, slope, lambda: jnp.zeros(()))
        metrics = diagnostics | {
            "contrast_loss": loss,
            "penalty": penalty,
            "embedding_norm": jnp.mean(jnp.linalg.norm(raw, axis=-1)),
        }
        loss = loss + self.penalty * penalty
        if self.stages and self.stage_weight:
            assert episode_id is not None
            metrics["stage_loss"] = group_info_nce(negatives, stages(episode_id, self.stages), anchor, self.temperature)
            loss = loss + self.stage_weight * metrics["stage_loss"]
        return loss, metrics

    def update(
        self, state: EmbeddingState, expert: Batch, agent: Batch, embed: Embed, *, key: PRNGKeyArray
    ) -> tuple[EmbeddingState, Metrics]:
        features = [select(self.inputs, batch, embed) for batch in (expert.first, agent.first, state.reference)]
        others: Any = {"episode_id": agent.episode_id, "count": adam_count(state.opt_state), "key": key}
        gradient, metrics = jax.grad(self.loss, has_aux=True)(state.encoder, *features, **others)
        state, more = advance(state, gradient, only(self.inputs, expert.first), features[:2], self.learning_rate)
        return state, metrics | more

    def reward(self, state: EmbeddingState, batch: Batch, embed: Embed, *, key: Any) -> Float[Array, " T"]:
        del key
        return embedding_reward(state, batch, embed, self.inputs, self.compare)

    def representation(self, state: EmbeddingState, batch: Batch, embed: Embed) -> Float[Array, "T dim"]:
        return embedding(state, batch, embed, self.inputs)


def derangement(key: PRNGKeyArray, size: int) -> Array:
    """Random partners, none of them oneself: a random order, shifted by one along itself."""
    order = jax.random.permutation(key, size)
    return jnp.zeros(size, order.dtype).at[order].set(jnp.roll(order, 1))


def stages(episode_id: Int[Array, " batch"], count: int) -> Int[Array, " batch"]:
    """The stage of training, from 0 to `count - 1`, that each row's policy is from, by the row's episode.

    A row of which a share `q` of the batch is from earlier episodes is in stage `floor(count q)`: the stages are quantiles of
    the batch, and rows of one episode, thus of about one policy, are never parted.
    """
    earlier = jnp.sum(episode_id[None, :] < episode_id[:, None], axis=1)
    return earlier * count // len(episode_id)
