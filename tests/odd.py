"""Small environments with one mistake each, as real environments have."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium import spaces

BOX = spaces.Box(-9.0, 9.0, (2,), np.float64)


class Odd(gymnasium.Env):
    """A point on a line, `[position, goal]`; in step `at` of episode `episode` the values of `wrong` replace its own.

    The keys "obs", "reward", "terminated", "truncated" and "info" of `wrong` replace parts of the result of `step`, "step"
    replaces all of it, and "reset" replaces the result of `reset`. A value that is a function is called, so it may raise.
    """

    open_copies: ClassVar[list[Odd]] = []
    """The environments that were made and not closed."""
    once: ClassVar[bool] = False
    """Whether only one may be open at a time, as for a simulator that binds a port."""

    def __init__(self, space: spaces.Space = BOX, at: int = 3, episode: int = 1, steps: int = 10, **wrong: Any) -> None:
        assert not (self.once and self.open_copies), "this environment can be open once only"
        self.observation_space, self.action_space = space, spaces.Box(-1.0, 1.0, (1,), np.float32)
        self.at, self.episode, self.steps, self.wrong, self.episodes = at, episode, steps, wrong, 0
        self.open_copies.append(self)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        super().reset(seed=seed)
        self.x, self.goal = self.np_random.uniform(-1, 1, 2)
        self.time, self.episodes = 0, self.episodes + 1
        return self._wrong("reset", (self._observation(), {})) if self.episodes == self.episode else (self._observation(), {})

    def step(self, action: np.ndarray) -> Any:
        self.time += 1
        self.x = float(np.clip(self.x + 0.1 * float(action[0]), -2, 2))
        parts = {"obs": self._observation(), "reward": -abs(self.x - self.goal), "terminated": False}
        parts |= {"truncated": self.time >= self.steps, "info": {}}
        if (self.episodes, self.time) == (self.episode, self.at):
            parts = {name: self._wrong(name, value) for name, value in parts.items()}
            return self._wrong("step", tuple(parts.values()))
        return tuple(parts.values())

    def close(self) -> None:
        self.open_copies.remove(self)

    def _observation(self) -> Any:
        values = iter([self.x, self.goal])
        return _filled(self.observation_space, values)

    def _wrong(self, name: str, value: Any) -> Any:
        wrong = self.wrong.get(name, value)
        return wrong() if callable(wrong) else wrong


def _filled(space: spaces.Space, values: Iterator[float]) -> Any:
    """The values arranged in the structure of a space, in order, and zeros when there are no more values."""
    if isinstance(space, spaces.Dict):
        return {key: _filled(part, values) for key, part in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_filled(part, values) for part in space.spaces)
    assert isinstance(space, spaces.Box)
    numbers = [next(values, 0.0) for _ in range(int(np.prod(space.shape)))]
    return np.array(numbers, space.dtype).reshape(space.shape)


def raising(error: BaseException) -> Callable[[], Any]:
    """A function that raises."""

    def function() -> Any:
        raise error

    return function
