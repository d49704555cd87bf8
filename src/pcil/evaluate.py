"""Deterministic rollouts: all episodes in lockstep, one batched call of the policy for each step."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gymnasium
import numpy as np

from pcil.seeds import Stream, episode_seed


@dataclass(frozen=True)
class Evaluation:
    """What `episodes` rollouts of the mean action gave."""

    returns: np.ndarray
    """Sum of the environment's rewards, one number an episode, float64."""
    lengths: np.ndarray
    """Agent steps, one number an episode."""
    seconds: float
    """Wall-clock time of all of them."""

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))


def evaluate(act: Callable[[np.ndarray], np.ndarray], environments: Sequence[gymnasium.Env], *, seed: int) -> Evaluation:
    """One episode in each of `environments`; `act` maps observations `[k, obs]` of those still running to `[k, action]`.

    Episode `i` starts from a seed that depends on `seed` and `i` alone, so every evaluation of a run meets the same starts.
    """
    begin = time.perf_counter()
    num = len(environments)
    returns, lengths = np.zeros(num), np.zeros(num, np.int64)
    obs = np.stack([env.reset(seed=episode_seed(seed, Stream.EVALUATE, i))[0] for i, env in enumerate(environments)])
    running = np.arange(num)
    while len(running):
        over = np.zeros(len(running), bool)
        for k, (i, action) in enumerate(zip(running.tolist(), act(obs[running]), strict=True)):
            obs[i], reward, terminated, truncated, _ = environments[i].step(action)
            returns[i] += float(reward)
            lengths[i] += 1
            over[k] = terminated or truncated
        running = running[~over]
    return Evaluation(returns, lengths, time.perf_counter() - begin)
