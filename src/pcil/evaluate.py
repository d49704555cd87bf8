"""Deterministic rollouts: all episodes in lockstep, one batched call of the policy for each step."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from pcil import envs
from pcil.seeds import Stream, episode_seed

LOCKSTEP = 32
"""Episodes that are played at once, at most."""


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


def environments_for(task: str, episodes: int, env_kwargs: dict[str, Any] | None = None) -> list[gymnasium.Env]:
    """What `evaluate` plays so many episodes in: one each, but not more than `LOCKSTEP`, for each takes memory."""
    return [envs.make(task, env_kwargs=env_kwargs) for _ in range(min(episodes, LOCKSTEP))]


def evaluate(
    act: Callable[[np.ndarray], np.ndarray],
    environments: Sequence[gymnasium.Env],
    *,
    seed: int,
    episodes: int | None = None,
) -> Evaluation:
    """So many episodes, by default one in each of `environments`, as many at once as there are of these.

    `act` maps observations `[k, obs]` of those still running to `[k, action]`.

    Episode `i` starts from a seed that depends on `seed` and `i` alone, so every evaluation of a run meets the same starts.
    """
    begin = time.perf_counter()
    episodes = len(environments) if episodes is None else episodes
    returns, lengths = np.zeros(episodes), np.zeros(episodes, np.int64)
    for first in range(0, episodes, len(environments)):
        block = dict(zip(range(first, episodes), environments, strict=False))
        seeds = {i: episode_seed(seed, Stream.EVALUATE, i) for i in block}
        obs = {i: np.array(env.reset(seed=seeds[i])[0], np.float32) for i, env in block.items()}
        while obs:
            for i, action in zip(list(obs), act(np.stack([*obs.values()])), strict=True):
                new, reward, terminated, truncated, _ = block[i].step(action)
                returns[i] += float(reward)
                lengths[i] += 1
                obs[i] = np.array(new, np.float32)
                if terminated or truncated:
                    del obs[i]
    return Evaluation(returns, lengths, time.perf_counter() - begin)
