"""Losses and targets, one function per equation. Each loss is a mean over the batch; the caller applies coefficients."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


def info_nce(
    anchor: Float[Array, "batch dim"],
    positive: Float[Array, "batch dim"],
    negatives: Float[Array, "negatives dim"],
    temperature: float,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """InfoNCE: the cross-entropy of identifying the positive among the negatives (PCIL, Eq. 1 with its sign corrected).

    For anchor `a`, positive `p`, negatives `n_j` and `s(x, y) = x . y / temperature` the loss is

        -log( exp s(a, p) / (exp s(a, p) + sum_j exp s(a, n_j)) )  =  -s(a, p) + log( exp s(a, p) + sum_j exp s(a, n_j) )

    The paper prints Eq. 1 with `+ s(a, p)`, which would push expert pairs apart; its Eq. 4 and the authors' code have the
    minus. The loss is never negative, and `log(1 + negatives)` if all similarities are equal. The diagnostics are the mean
    positive and negative cosine and the fraction of anchors that are closer to their positive than to every negative.
    """
    return contrast(jnp.sum(anchor * positive, axis=-1), anchor @ negatives.T, temperature)


def contrast(
    cosine_positive: Float[Array, " batch"], cosine_negative: Float[Array, "batch negatives"], temperature: float
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """InfoNCE and its diagnostics from the cosines of each anchor with its positive and its own negatives."""
    logits = jnp.concatenate([cosine_positive[:, None], cosine_negative], axis=-1) / temperature
    loss = jnp.mean(jax.nn.logsumexp(logits, axis=-1) - logits[:, 0])
    diagnostics = {
        "positive_similarity": jnp.mean(cosine_positive),
        "negative_similarity": jnp.mean(cosine_negative),
        "accuracy": jnp.mean(cosine_positive > jnp.max(cosine_negative, axis=-1), dtype=jnp.float32),
    }
    return loss, diagnostics


def off_diagonal(square: Float[Array, "n n"]) -> Float[Array, "n others"]:
    """Each row without its diagonal entry."""
    n = len(square)
    return square.ravel()[1:].reshape(n - 1, n + 1)[:, :-1].reshape(n, n - 1)  # the diagonal is every (n + 1)-th entry


def group_info_nce(
    rows: Float[Array, "batch dim"],
    group: Int[Array, " batch"],
    others: Float[Array, "others dim"],
    temperature: float,
) -> Float[Array, ""]:
    """InfoNCE with every row as anchor: the other rows of its group are positives, rows of other groups and `others` negatives.

    With `s` as in `info_nce`, the loss of anchor `i` with a positive `p` and the negatives `n` is

        -log( exp s(i, p) / (exp s(i, p) + sum_n exp s(i, n)) )  =  softplus( log sum_n exp s(i, n) - s(i, p) )

    This is averaged over the positives of each anchor and then over the anchors. A row that is alone in its group adds 0.
    """
    same = group[:, None] == group[None, :]
    positive = same & ~jnp.eye(len(rows), dtype=bool)
    within = rows @ rows.T / temperature
    negatives = jnp.concatenate([jnp.where(same, -jnp.inf, within), rows @ others.T / temperature], axis=1)
    costs = jax.nn.softplus(jax.nn.logsumexp(negatives, axis=1, keepdims=True) - within)
    num_positives = jnp.sum(positive, axis=1, dtype=costs.dtype)
    return jnp.mean(jnp.sum(costs, axis=1, where=positive) / jnp.maximum(num_positives, 1))


def gradient_penalty(
    scalar: Callable[[Float[Array, "batch dim"]], Float[Array, " batch"]], x: Float[Array, "batch dim"]
) -> Float[Array, ""]:
    """`mean( (|| d scalar_i / d x_i ||_2 - 1)^2 )`: the gradient penalty (Gulrajani et al. 2017; paper Appendix B).

    Row `i` of `scalar(x)` must depend on row `i` of `x` only; then one backward pass through the sum gives all gradients.
    """
    gradient = jax.grad(lambda rows: jnp.sum(scalar(rows)))(x)
    norm = jnp.sqrt(jnp.sum(gradient * gradient, axis=-1) + 1e-12)
    return jnp.mean((norm - 1) ** 2)


def interpolate(
    u: Float[Array, "batch 1"], expert: Float[Array, "batch dim"], agent: Float[Array, "batch dim"]
) -> Float[Array, "batch dim"]:
    """The points at which the gradient penalty is evaluated: on the segments between expert (`u = 1`) and agent (`u = 0`)."""
    return u * expert + (1 - u) * agent


def binary_cross_entropy(expert: Float[Array, " batch"], agent: Float[Array, " batch"]) -> Float[Array, ""]:
    """`-log D` on the expert's logits and `-log(1 - D)` on the agent's, both as means, with `D = sigmoid(logit)`.

    `-log sigmoid(d) = softplus(-d)` and `-log(1 - sigmoid(d)) = softplus(d)`: finite for every logit. The expert has label 1
    (authors' code; the paper's Preliminaries have the labels the other way round).
    """
    return jnp.mean(jax.nn.softplus(-expert)) + jnp.mean(jax.nn.softplus(agent))


def n_step_target(
    reward: Float[Array, "batch n"],
    discount: Float[Array, "batch n"],
    bootstrap: Float[Array, " batch"],
    gamma: float,
) -> Float[Array, " batch"]:
    """`sum_k gamma^k c_k r_k + gamma^n c_n V`, where `c_k` is the product of the discounts before step `k`.

    `discount` is 0 at a terminating step, so later steps add nothing. `bootstrap` is the value `V` after the last step.
    """
    target = bootstrap
    for k in reversed(range(reward.shape[1])):
        target = reward[:, k] + gamma * discount[:, k] * target
    return target
