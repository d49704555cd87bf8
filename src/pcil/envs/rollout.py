"""Episodes in one or several environments. The caller chooses the actions and does whatever else happens between steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pcil.envs.checked import Checked
from pcil.types import Episode


class Rollout:
    """One episode in each of several environments, which are stepped together until all episodes have ended.

    rollout = Rollout([env], [seed], ["recorded episode 1"])
    while rollout.playing:
        rollout.step([policy(rollout.obs[0])])
    (episode,) = rollout.episodes()
    """

    def __init__(
        self, environments: Sequence[Checked], seeds: Sequence[int], names: Sequence[str], *, keep: bool = True
    ) -> None:
        """Reset each environment with its seed; `names` are the names of the episodes in error messages. `episodes` needs
        `keep`, which stores every step."""
        self._environments = list(environments)
        self._seeds, first = list(seeds), []
        for env, seed, name in zip(environments, seeds, names, strict=True):
            env.episode = name
            first.append(env.reset(seed=seed)[0])
        self._steps: list[list[tuple[np.ndarray, Any, float]]] = [[] for _ in first]
        self._terminated, self._keep = [False] * len(first), keep
        self.returns, self.lengths = np.zeros(len(first)), np.zeros(len(first), np.int64)
        """The return and the length of each episode so far."""
        self.obs = np.stack(first)
        """The latest observation of each episode, `[episodes, obs]`; the final one if the episode has ended."""
        self.info: list[dict[str, Any]] = [{} for _ in first]
        """The `info` of each episode's latest step."""
        self.playing = list(range(len(first)))
        """The indices of the episodes that have not ended."""

    def step(self, actions: Sequence[Any] | np.ndarray) -> None:
        """Step each episode that has not ended with its action; the actions of the others are ignored."""
        obs = self.obs.copy()
        for i in list(self.playing):
            obs[i], reward, self._terminated[i], truncated, self.info[i] = self._environments[i].step(actions[i])
            self.returns[i] += reward
            self.lengths[i] += 1
            if self._keep:
                self._steps[i].append((self.obs[i], actions[i], reward))
            if self._terminated[i] or truncated:
                self.playing.remove(i)
        self.obs = obs

    def episodes(self) -> list[Episode]:
        """The steps of each episode so far."""
        made = []
        for i, steps in enumerate(self._steps):
            obs, action, reward = zip(*steps, strict=True)
            arrays = np.stack([*obs, self.obs[i]]), np.stack(action), np.array(reward, np.float64)
            made.append(Episode(*arrays, self._terminated[i], self._seeds[i]))
        return made
