"""Time-contrastive embeddings in the place of policy-contrastive ones: the paper's ablation (section 4.4, Appendix C).

Sermanet et al. 2018, as the paper words it: states that are near in time are drawn together, others pushed apart, and nothing
says which are the expert's. `docs/methods/tcn.md` numbers what the paper leaves open.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from pcil.errors import check_ranges
from pcil.nets.losses import contrast, off_diagonal
from pcil.nets.networks import MLP, unit_sphere
from pcil.rewards.base import Embed, Metrics, Reward, only
from pcil.rewards.embedding import EmbeddingState, Head, advance, embedding, embedding_reward, init_embedding
from pcil.types import Batch


@dataclass(frozen=True)
class TCN(Reward):
    """Settings of the time-contrastive reward; `batch_size` anchors are the expert's and as many the agent's."""

    temperature: float = 0.07
    """Divides the cosines inside the InfoNCE loss."""
    window: int = 1
    """Maximum number of steps between an anchor and its positive."""
    negatives: Literal["batch", "rollout"] = "batch"
    """An anchor's negatives: the positives of all other anchors, or states of the same rollout that are far in time."""
    margin: int = 10
    """Minimum number of steps between an anchor and negatives of the same rollout; the maximum is twice that."""
    compare: Literal["random", "mean"] = "random"
    """The similarity reward's expert: a random sample or the mean embedding."""
    head: Head = "similarity"
    """The reward: similarity to the expert, or the logit of a linear classifier of embeddings ("gail")."""
    hidden: int = 256
    """Width of the three hidden layers; the embedding has a quarter of it."""
    learning_rate: float = 1e-4
    """Adam's learning rate."""

    def __post_init__(self) -> None:
        super().__post_init__()
        nearest = self.window + 1 if self.negatives == "rollout" else 1
        check_ranges(self, temperature=(1e-6, inf), window=(1, inf), margin=(nearest, inf), hidden=(4, inf))
        check_ranges(self, learning_rate=(0, 1), batch_size=(2, inf))

    @property
    def span(self) -> int:
        return 2 * self.margin if self.negatives == "rollout" else self.window

    def init(self, demos: Sequence[Batch], embed: Embed, *, key: PRNGKeyArray) -> EmbeddingState:
        sizes: Any = {"hidden": self.hidden, "batch_size": self.batch_size, "head": self.head}
        return init_embedding(self.subsampled(demos), embed, "state", **sizes, key=key)

    def loss(
        self,
        encoder: MLP,
        near: Float[Array, "2 rows features"],
        far: Float[Array, "rows far features"],
        real: Bool[Array, "rows far"],
    ) -> tuple[Float[Array, ""], Metrics]:
        """InfoNCE of anchors `near[0]` and their positives `near[1]`; `far` states are negatives of their own row alone.

        Where a rollout ended before a `far` state was reached, `real` is False and the state counts as opposite to its anchor:
        a constant cosine of -1, which at small temperatures is nothing.
        """
        raw = encoder(near)
        anchor, positive = unit_sphere(raw)
        if self.negatives == "batch":
            cosine = anchor @ positive.T
            loss, metrics = contrast(jnp.diagonal(cosine), off_diagonal(cosine), self.temperature)
        else:
            cosine = jnp.where(real, jnp.einsum("rd,rfd->rf", anchor, unit_sphere(encoder(far))), -1.0)
            loss, metrics = contrast(jnp.sum(anchor * positive, axis=-1), cosine, self.temperature)
        return loss, metrics | {"contrast_loss": loss, "embedding_norm": jnp.mean(jnp.linalg.norm(raw, axis=-1))}

    def update(
        self, state: EmbeddingState, expert: Batch, agent: Batch, embed: Embed, *, key: PRNGKeyArray
    ) -> tuple[EmbeddingState, Metrics]:
        both = expert, agent
        obs = jnp.concatenate([jnp.concatenate([b.obs[:, :1], b.next_obs[:, : self.span]], axis=1) for b in both])
        assert expert.discount is not None and agent.discount is not None
        goes_on = jnp.concatenate([expert.discount[:, : self.span], agent.discount[:, : self.span]]) > 0
        rows, (first, last) = len(obs), (self.margin, 2 * self.margin + 1)
        step = jax.random.randint(key, (rows,), 1, self.window + 1)
        near = embed(jnp.stack([obs[:, 0], obs[jnp.arange(rows), step]]))  # behind an end, windows repeat its state
        far, real = embed(obs[:, first:last]), goes_on[:, first - 2 : last - 2]  # the end itself is real: hence the 2
        gradient, metrics = jax.grad(self.loss, has_aux=True)(state.encoder, near, far, real)
        anchors = jnp.split(near[0], [len(expert.obs)])
        state, more = advance(state, gradient, only("state", expert.first), anchors, self.learning_rate)
        return state, metrics | more

    def reward(self, state: EmbeddingState, batch: Batch, embed: Embed, *, key: Any) -> Float[Array, " T"]:
        del key
        return embedding_reward(state, batch, embed, "state", self.compare)

    def representation(self, state: EmbeddingState, batch: Batch, embed: Embed) -> Float[Array, "T dim"]:
        return embedding(state, batch, embed, "state")
