"""The t-SNE of a learned representation, and two numbers that measure what the plot shows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.stats import spearmanr

from pcil.report.load import EvalRow, TransitionRow


def project(
    expert: Float[np.ndarray, "experts dim"], agent: Float[np.ndarray, "T dim"], reward: Float[np.ndarray, " T"], run: EvalRow
) -> list[TransitionRow]:
    """A row for each transition, the experts' first. `reward` is the environment's, and `run` a row of the agent's run."""
    from sklearn.manifold import TSNE
    from sklearn.metrics import silhouette_samples
    from threadpoolctl import threadpool_limits

    both = np.concatenate([expert, agent]).astype(np.float64)
    distance = np.linalg.norm(both - both[: len(expert)].mean(axis=0), axis=1)
    silhouette = np.asarray(silhouette_samples(both, np.arange(len(both)) < len(expert)))
    with threadpool_limits(1):  # for so few rows, threads that wait for each other on a busy machine take fifty times as long
        positions = TSNE(perplexity=min(30.0, len(both) / 4), init="pca", random_state=0).fit_transform(both)
    rewards = [None] * len(expert) + [_rounded(value) for value in reward]
    rows = np.column_stack([distance, silhouette, positions])
    head = (run.task, run.method, run.variant, run.seed, run.frames)
    return [TransitionRow(*head, paid, *map(_rounded, row)) for paid, row in zip(rewards, rows, strict=True)]


def measures(transitions: Sequence[TransitionRow]) -> tuple[float, float]:
    """Spearman's correlation of distance and reward over the agent's transitions, and the experts' mean silhouette.

    The correlation is NaN if all rewards or all distances are the same.
    """
    agent = np.array([(row.distance, row.reward) for row in transitions if row.reward is not None])
    expert = [row.silhouette for row in transitions if row.reward is None]
    constant = np.ptp(agent, axis=0).min() == 0
    return math.nan if constant else float(np.asarray(spearmanr(*agent.T))[0]), float(np.mean(expert))


def _rounded(value: float) -> float:
    return float(f"{value:.5g}")
