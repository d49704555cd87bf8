"""The value types that are passed between the packages. They are immutable; `Episode` checks its lengths when it is created."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from pcil.errors import InputError


class Spec(NamedTuple):
    """The properties of an environment that the networks depend on."""

    obs_dim: int
    action_dim: int
    action_repeat: int
    """The number of control steps (frames) per agent step."""


class Origin(NamedTuple):
    """The environment in which demonstrations were recorded; a field is None if it is unknown."""

    env_id: str | None = None
    """Its Gymnasium id."""
    entry_point: str | None = None
    """Its entry point in Gymnasium's registry."""
    kwargs: dict[str, Any] | None = None
    """Its keyword arguments, including those of its registration."""
    action_low: list[float] | None = None
    """The lower bounds of its own action space, to which -1 in the demonstrations corresponds."""
    action_high: list[float] | None = None
    """The upper bounds, to which 1 corresponds."""
    step_seconds: float | None = None
    """The simulated duration of one step."""


class Batch(NamedTuple):
    """Steps, as rewards are given them: `action` was taken in `obs` and led to `next_obs`.

    The leading axes are `[T]` for an episode in temporal order, and `[rows, n]` for windows of `n` consecutive steps.
    """

    obs: Float[Any, "*steps obs"]
    action: Float[Any, "*steps action"]
    next_obs: Float[Any, "*steps obs"]
    discount: Float[Any, "*steps"] | None = None
    """That of `Window`; None where the steps are no windows."""
    episode_id: Int[Any, " rows"] | None = None
    """That of `Window`; None where the steps are no windows."""

    @classmethod
    def of(cls, obs: Float[Any, "*batch states obs"], action: Float[Any, "*batch n action"], *windows: Any) -> Batch:
        """The steps between `n + 1` consecutive states; `windows` are `discount` and `episode_id`."""
        return cls(obs[..., :-1, :], action, obs[..., 1:, :], *windows)

    @property
    def first(self) -> Batch:
        """The first step of each window."""
        return Batch(self.obs[:, 0], self.action[:, 0], self.next_obs[:, 0])


class Window(NamedTuple):
    """`n` consecutive steps from each of `batch` random starts, all within one episode.

    Step `t` leads from `obs[:, t]` by `action[:, t]` to `obs[:, t + 1]` with `reward[:, t]`. `discount[:, t]` is 0 where that
    step terminated the episode and in the padding after it, and 1 elsewhere. A time limit is not a termination, and no window
    extends beyond one.
    """

    obs: Float[Any, "batch states obs"]
    action: Float[Any, "batch n action"]
    reward: Float[Any, "batch n"]
    discount: Float[Any, "batch n"]
    episode_id: Int[Any, " batch"]
    """The episode of each window, counted from 0 over all episodes that were ever added."""


@dataclass(frozen=True, eq=False)
class Episode:
    """A complete episode of `T` agent steps; its arrays are made read-only.

    `action[t]` was taken in `obs[t]`, and `reward[t]` is the environment's reward for it. `terminated` is True if the
    environment terminated the episode, and False if a time limit truncated it. `seed` is the seed of the reset.
    """

    obs: Float[np.ndarray, "states obs"]
    action: Float[np.ndarray, "T action"]
    reward: Shaped[np.ndarray, " T"]
    terminated: bool = False
    seed: int | None = None

    def __post_init__(self) -> None:
        steps = len(self.action)
        if steps == 0 or len(self.obs) != steps + 1 or len(self.reward) != steps:
            raise InputError(
                f"An episode of T actions needs T+1 observations, T rewards and T of at least 1; "
                f"got {steps} actions, {len(self.obs)} observations and {len(self.reward)} rewards."
            )
        for array in (self.obs, self.action, self.reward):
            array.flags.writeable = False

    def __len__(self) -> int:
        return len(self.action)

    def absorbed(self, steps: int = 1) -> Episode:
        """The same episode with an additional entry in each observation: 1 in the absorbing state, 0 elsewhere.

        In a terminated episode, the absorbing state (zeros and the 1) replaces the last observation and is followed by `steps`
        transitions to itself, with action and reward 0. The result is not terminated, so a reward that is learned on such
        episodes assigns a value to an early end as to any other state (Kostrikov et al. 2019, section 4.2). With `steps = n`,
        exactly one window of `n` steps begins in the absorbing state.
        """
        obs = np.pad(self.obs, ((0, 0), (0, 1)))
        if not self.terminated:
            return replace(self, obs=obs)
        rest = np.zeros((steps + 1, obs.shape[1]), obs.dtype)
        rest[:, -1] = 1
        action, reward = np.pad(self.action, ((0, steps), (0, 0))), np.pad(self.reward, (0, steps))
        return replace(self, obs=np.concatenate([obs[:-1], rest]), action=action, reward=reward, terminated=False)

    @property
    def total_reward(self) -> float:
        """The undiscounted return of the environment's rewards."""
        return float(np.sum(self.reward, dtype=np.float64))
