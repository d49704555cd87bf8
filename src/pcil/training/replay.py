"""A ring of raw steps in NumPy that returns n-step windows. It knows nothing about learning.

An episode of `T` steps takes `T + 1` rows: its last row holds the final observation, with action and reward 0, and starts no
window. Rows wrap around the end of the ring; the oldest episodes leave, whole, when their rows are needed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from pcil.errors import InputError
from pcil.types import Episode, Window


class Segment(NamedTuple):
    """Where an episode lies in the ring."""

    start: int
    length: int
    terminated: bool
    episode_id: int
    """Episodes added before it, those that have left included."""

    def starts(self, n: int) -> int:
        """How many windows of `n` steps begin here: those that fit, and, if the episode terminated, every step."""
        return self.length if self.terminated else max(self.length - n + 1, 0)


class Replay:
    """At most `capacity` rows (agent steps plus one for each episode) of float32 steps."""

    def __init__(self, capacity: int, obs_dim: int, action_dim: int) -> None:
        self.capacity = capacity
        self._obs = np.zeros((capacity, obs_dim), np.float32)
        self._action = np.zeros((capacity, action_dim), np.float32)
        self._reward = np.zeros(capacity, np.float32)
        self._segments: deque[Segment] = deque()
        self._next = 0
        self._added = 0
        self._index: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}

    @classmethod
    def of(cls, episodes: Sequence[Episode]) -> Replay:
        """A replay that holds just these episodes."""
        rows = sum(len(episode) + 1 for episode in episodes)
        full = cls(rows, episodes[0].obs.shape[1], episodes[0].action.shape[1])
        for episode in episodes:
            full.add(episode, episode.reward)
        return full

    @property
    def num_steps(self) -> int:
        """Agent steps held."""
        return sum(segment.length for segment in self._segments)

    @property
    def num_episodes(self) -> int:
        """Whole episodes held."""
        return len(self._segments)

    def num_windows(self, n: int, every: int = 1) -> int:
        """How many windows of `n` steps may be drawn; `every` as in `sample`."""
        _, cumulative = self._starts(n, every)
        return int(cumulative[-1]) if len(cumulative) else 0

    def add(self, episode: Episode, reward: np.ndarray) -> None:
        """Append a whole episode, with the `reward [T]` to store for it."""
        rows = len(episode) + 1
        if rows > self.capacity:
            raise InputError(
                f"An episode of {len(episode)} steps does not fit into a replay of {self.capacity} rows; enlarge it."
            )
        while self._segments and self._free() < rows:
            self._segments.popleft()
        index = (self._next + np.arange(rows)) % self.capacity
        self._obs[index] = episode.obs
        self._action[index[:-1]], self._action[index[-1]] = episode.action, 0
        self._reward[index[:-1]], self._reward[index[-1]] = reward, 0
        self._segments.append(Segment(self._next, len(episode), episode.terminated, self._added))
        self._added += 1
        self._next = (self._next + rows) % self.capacity
        self._index = {}

    def sample(self, rng: np.random.Generator, batch: int, n: int, every: int = 1) -> Window:
        """`batch` windows of `n` steps, uniform over all valid starts, with replacement.

        Windows start at every `every`-th step only, beginning with step i modulo `every` of the i-th episode that was added, or
        with the last one that a shorter episode has.
        A window never reaches past a time limit. One that reaches past a termination has discount 0 from that step on, its
        actions and rewards behind it are 0, and its observations repeat the final one.
        """
        table, cumulative = self._starts(n, every)
        total = self.num_windows(n, every)
        if total == 0:
            raise InputError(f"The replay holds no window of {n} steps: every episode in it is shorter.")
        draw = rng.integers(total, size=batch)
        which = np.searchsorted(cumulative, draw, side="right")
        start, length, terminated, episode_id, first, before = table[which].T
        offset = (first + every * (draw - before))[:, None] + np.arange(n + 1)
        row = (start[:, None] + np.minimum(offset, length[:, None])) % self.capacity
        inside = offset[:, :-1] < length[:, None]
        alive = inside & ~((offset[:, :-1] == length[:, None] - 1) & (terminated[:, None] == 1))
        return Window(
            self._obs[row],
            self._action[row[:, :-1]],
            self._reward[row[:, :-1]],
            alive.astype(np.float32),
            episode_id.astype(np.int32),
        )

    def state(self) -> dict[str, np.ndarray]:
        """Everything held, in the order of time, as arrays; `load` restores an equal replay."""
        first = self._segments[0].start if self._segments else self._next
        used = sum(segment.length + 1 for segment in self._segments)
        index = (first + np.arange(used)) % self.capacity
        return {
            "obs": self._obs[index],
            "action": self._action[index],
            "reward": self._reward[index],
            "segments": np.array(self._segments, np.int64).reshape(-1, 4),
            "next": np.array(self._next),
            "added": np.array(self._added),
        }

    def load(self, state: dict[str, np.ndarray]) -> None:
        """Restore what `state` gave; rows return to the places they had."""
        self._segments = deque(Segment(int(s), int(k), bool(t), int(i)) for s, k, t, i in state["segments"])
        self._next, self._added = int(state["next"]), int(state["added"])
        first = self._segments[0].start if self._segments else self._next
        index = (first + np.arange(len(state["obs"]))) % self.capacity
        self._obs[index], self._action[index], self._reward[index] = state["obs"], state["action"], state["reward"]
        self._index = {}

    def _free(self) -> int:
        return self.capacity - sum(segment.length + 1 for segment in self._segments)

    def _starts(self, n: int, every: int) -> tuple[np.ndarray, np.ndarray]:
        """A row `(start, length, terminated, episode_id, first start, valid starts before)` an episode, and the running total
        of valid starts."""
        if (n, every) not in self._index:
            steps = np.array([segment.starts(n) for segment in self._segments], np.int64)
            table = np.array(self._segments, np.int64).reshape(-1, 4)
            first = np.clip(table[:, 3] % every, 0, np.maximum(steps - 1, 0))
            counts = (steps - first + every - 1) // every
            cumulative = np.cumsum(counts)
            self._index[n, every] = np.column_stack([table, first, cumulative - counts]), cumulative
        return self._index[n, every]
