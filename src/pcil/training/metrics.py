"""Metrics of an episode, and how well the learned reward agrees with the environment's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from pcil.types import Episode


def described(episode: Episode, learned: np.ndarray) -> dict[str, Any]:
    """Return and length of an episode, its learned return, and the correlation of the two rewards over its steps."""
    return {
        "return": episode.total_reward,
        "length": len(episode),
        "learned_return": float(learned.sum(dtype=np.float64)),
        "correlation": pearson(learned[: len(episode)], episode.reward),
    }


def pearson(x: np.ndarray, y: np.ndarray) -> float | None:
    """Pearson correlation; None if one of the two is constant."""
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    with np.errstate(invalid="ignore"):  # of values so small that their squares are 0
        value = float(np.corrcoef(x.astype(np.float64), y.astype(np.float64))[0, 1])
    return value if math.isfinite(value) else None
