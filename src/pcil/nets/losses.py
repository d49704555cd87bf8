"""The mathematics, one function an equation. Each loss is a mean over the batch; coefficients belong to the caller."""

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
    """How badly each anchor tells its positive from the negatives (PCIL, Eq. 1 with its sign corrected).

    For anchor `a`, positive `p`, negatives `n_j` and `s(x, y) = x . y / temperature` the loss is

        -log( exp s(a, p) / (exp s(a, p) + sum_j exp s(a, n_j)) )  =  -s(a, p) + log( exp s(a, p) + sum_j exp s(a, n_j) )

    The paper prints Eq. 1 with `+ s(a, p)`, which would push expert pairs apart; its Eq. 4 and the authors' code have the
    minus. With all similarities equal the loss is `log(1 + negatives)`; it is never negative. Beside the loss come the mean
    positive and negative cosine and the share of anchors whose positive is nearer than every negative.
    """
    return contrast(jnp.sum(anchor * positive, axis=-1), anchor @ negatives.T, temperature)


def contrast(
    cosine_positive: Float[Array, " batch"], cosine_negative: Float[Array, "batch negatives"], temperature: float
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """InfoNCE and its diagnostics from each anchor's cosines, whoever its negatives are."""
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
    """InfoNCE with every row as anchor: each other row of its group is a positive, rows of other groups and `others` negatives.

    For anchor `i`, `s` as in `info_nce` and the negatives `n` of `i`, a positive `p` costs

        -log( exp s(i, p) / (exp s(i, p) + sum_n exp s(i, n)) )  =  softplus( log sum_n exp s(i, n) - s(i, p) )

    and the loss is the mean over the anchors of the mean over their positives. A row alone in its group adds 0.
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
    """`mean( (|| d scalar_i / d x_i ||_2 - 1)^2 )`: how far the slope is from 1 (Gulrajani et al. 2017; paper Appendix B).

    Row `i` of `scalar` may depend on row `i` of `x` only; then one backward pass of the sum gives every row's gradient.
    """
    gradient = jax.grad(lambda rows: jnp.sum(scalar(rows)))(x)
    norm = jnp.sqrt(jnp.sum(gradient * gradient, axis=-1) + 1e-12)
    return jnp.mean((norm - 1) ** 2)


def interpolate(
    u: Float[Array, "batch 1"], expert: Float[Array, "batch dim"], agent: Float[Array, "batch dim"]
) -> Float[Array, "batch dim"]:
    """Points on the segments between expert and agent, `u = 1` at the expert: where the penalty is taken."""
    return u * expert + (1 - u) * agent


def binary_cross_entropy(expert: Float[Array, " batch"], agent: Float[Array, " batch"]) -> Float[Array, ""]:
    """`-log D` on the expert's logits and `-log(1 - D)` on the agent's, both as means, with `D = sigmoid(logit)`.

    `-log sigmoid(d) = softplus(-d)` and `-log(1 - sigmoid(d)) = softplus(d)`: finite for every logit. The expert has label 1
    (authors' code; the paper's Preliminaries have it the other way round).
    """
    return jnp.mean(jax.nn.softplus(-expert)) + jnp.mean(jax.nn.softplus(agent))


def n_step_target(
    reward: Float[Array, "batch n"],
    discount: Float[Array, "batch n"],
    bootstrap: Float[Array, " batch"],
    gamma: float,
) -> Float[Array, " batch"]:
    """`sum_k gamma^k c_k r_k + gamma^n c_n V`, where `c_k` is the product of the discounts before step `k`.

    `discount` is 0 at a terminating step, so nothing after it counts, and `bootstrap` is the value after the last step.
    """
    target = bootstrap
    for k in reversed(range(reward.shape[1])):
        target = reward[:, k] + gamma * discount[:, k] * target
    return target
