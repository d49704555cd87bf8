"""What every competitor of the race shares: the environment, the clock and the evaluation (`experiments/race.py`).

It runs in the environments of all libraries, so it imports NumPy and the package's DeepMind Control environment alone.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from pcil.envs.dmc import DMCEnv

MARKS = (0.25, 0.5, 1, 1.5, 2, 3, 4, 5, 6, 8, 10, 15, 20, 25, 30)
"""Core-minutes after which a policy is evaluated."""


class Finished(Exception):
    """The competitor's time is over."""


class Contest:
    """Stops the clock, evaluates and prints a row whenever training has taken so much processor time, and ends it at the last.

    The clock is the processor time of the process, with that of its imports and compilation and without that of evaluations.
    """

    def __init__(self, request: dict[str, Any]) -> None:
        self.task, self.seed, self.starts = request["task"], request["seed"], request["starts"]
        self._marks = [60 * minutes for minutes in MARKS if minutes <= request["minutes"]]
        self._evaluating = 0.0
        self._env = DMCEnv(self.task)
        with np.load(request["demos"], allow_pickle=False) as arrays:
            self.demos = [(arrays[f"obs_{i}"], arrays[f"action_{i}"]) for i in range(len(arrays) // 2)]

    def show(self, act: Callable[[np.ndarray], np.ndarray], frames: int) -> None:
        """To be called often, with the policy's mean action `[obs] -> [action]` and the frames that it has had until now."""
        seconds = time.process_time() - self._evaluating
        if seconds < self._marks[0]:
            return
        while self._marks and self._marks[0] <= seconds:
            self._marks.pop(0)
        returns = [self._play(act, start) for start in self.starts]
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        print(json.dumps({"seconds": seconds, "frames": frames, "returns": returns, "memory_mb": memory}), flush=True)
        self._evaluating = time.process_time() - seconds
        if not self._marks:
            raise Finished

    def _play(self, act: Callable[[np.ndarray], np.ndarray], start: int) -> float:
        obs, _ = self._env.reset(seed=start)
        total, over = 0.0, False
        while not over:
            obs, reward, terminated, truncated, _ = self._env.step(np.clip(act(obs), -1, 1).astype(np.float32))
            total, over = total + float(reward), terminated or truncated
        return total


def requested() -> dict[str, Any]:
    """What the race asks for, a JSON object on standard input."""
    return json.load(sys.stdin)
