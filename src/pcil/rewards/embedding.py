"""What PCIL and TCN share: an encoder on the unit sphere, and the two heads that turn it into a reward (paper Table 1)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from pcil.nets.losses import binary_cross_entropy
from pcil.nets.networks import MLP, unit_sphere
from pcil.nets.optimiser import OptState, adam_init, adam_step
from pcil.rewards.base import Embed, Inputs, Metrics, only, select
from pcil.types import Batch

Head = Literal["similarity", "gail"]
"""The reward of an embedding: its cosine to an expert's embedding, or the logit of a linear classifier."""


class Classifier(eqx.Module):
    """A linear classifier of embeddings (expert or agent), and the state of its optimiser."""

    linear: MLP
    opt_state: OptState


class EmbeddingState(eqx.Module):
    """The encoder, the state of its optimiser, the expert steps that rewards compare with, and the learned head, if any."""

    encoder: MLP
    opt_state: OptState
    reference: Batch
    """The last batch of expert steps: partners of PCIL's penalty and of the similarity reward."""
    classifier: Classifier | None


def init_embedding(
    demos: Sequence[Batch], embed: Embed, inputs: Inputs, *, hidden: int, batch_size: int, head: Head, key: PRNGKeyArray
) -> EmbeddingState:
    """Three hidden layers and a quarter of their width as output (256-256-256-64: paper Appendix B); random references."""
    encoder_key, reference_key, head_key = jax.random.split(key, 3)
    steps = [jnp.concatenate(arrays) for arrays in zip(*(only(inputs, demo)[:3] for demo in demos), strict=True)]
    rows = jax.random.randint(reference_key, (batch_size,), 0, steps[0].shape[0])
    reference = Batch(*(array[rows] for array in steps))
    features = jax.eval_shape(lambda: select(inputs, reference, embed)).shape[-1]
    encoder = MLP.init((features, hidden, hidden, hidden, hidden // 4), key=encoder_key)
    linear = MLP.init((hidden // 4, 1), key=head_key) if head == "gail" else None
    return EmbeddingState(encoder, adam_init(encoder), reference, linear and Classifier(linear, adam_init(linear)))


def advance(
    state: EmbeddingState,
    gradient: MLP,
    reference: Batch,
    features: Sequence[Float[Array, "batch features"]],
    learning_rate: float,
) -> tuple[EmbeddingState, Metrics]:
    """One step of the encoder against its gradient, and of the classifier, if there is one.

    The classifier learns from the embeddings of expert and agent `features` as they were before this step, with label 1 for
    the expert. They are its data: no gradient flows through them into the encoder (paper section 4.4).
    """
    encoder, opt_state = adam_step(state.encoder, gradient, state.opt_state, learning_rate)
    if state.classifier is None:
        return EmbeddingState(encoder, opt_state, reference, None), {}
    expert, agent = jnp.split(unit_sphere(state.encoder(jnp.concatenate(features))), [len(features[0])])

    def loss(linear: MLP) -> tuple[Float[Array, ""], Metrics]:
        logits = linear(expert)[:, 0], linear(agent)[:, 0]
        entropy = binary_cross_entropy(*logits)
        return entropy, {"head_loss": entropy, "expert_logit": jnp.mean(logits[0]), "agent_logit": jnp.mean(logits[1])}

    slope, metrics = jax.grad(loss, has_aux=True)(state.classifier.linear)
    classifier = Classifier(*adam_step(state.classifier.linear, slope, state.classifier.opt_state, learning_rate))
    return EmbeddingState(encoder, opt_state, reference, classifier), metrics


def embedding(state: EmbeddingState, batch: Batch, embed: Embed, inputs: Inputs) -> Float[Array, "T dim"]:
    """`Phi` of the steps' inputs, on the unit sphere."""
    return unit_sphere(state.encoder(select(inputs, batch, embed)))


def embedding_reward(
    state: EmbeddingState, batch: Batch, embed: Embed, inputs: Inputs, compare: Literal["random", "mean"]
) -> Float[Array, " T"]:
    """The head's reward: the similarity, or `log D - log(1 - D)`, which is the classifier's logit itself."""
    if state.classifier is not None:
        return state.classifier.linear(embedding(state, batch, embed, inputs))[:, 0]
    both = Batch(*(jnp.concatenate(arrays) for arrays in zip(state.reference[:3], only(inputs, batch)[:3], strict=True)))
    expert, agent = jnp.split(embedding(state, both, embed, inputs), [state.reference.obs.shape[0]])
    return similarity(agent, expert, compare)


def similarity(
    embedded: Float[Array, "T dim"], expert: Float[Array, "batch dim"], how: Literal["random", "mean"]
) -> Float[Array, " T"]:
    """The reward `Phi(s) . Phi(s_E)`, in [-1, 1] for unit embeddings (Eq. 2).

    "random" compares step `i` with expert row `i mod batch`, and since the rows are random draws each step meets a random
    expert sample (authors' code: train.py); "mean" compares with the rows' mean (paper, Appendix B: "similar performance").
    """
    if how == "mean":
        return embedded @ jnp.mean(expert, axis=0)
    rows = jnp.arange(embedded.shape[0]) % expert.shape[0]
    return jnp.sum(embedded * expert[rows], axis=-1)
