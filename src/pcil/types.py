"""The value types that cross the seams. They check themselves once, when they are made, and never change."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from pcil.errors import InputError


class Spec(NamedTuple):
    """What the networks must know of an environment."""

    obs_dim: int
    action_dim: int
    action_repeat: int
    """Control steps (frames) for each agent step."""


class Origin(NamedTuple):
    """What is known of the environment that demonstrations were recorded in; None where nothing is known."""

    env_id: str | None = None
    """Its Gymnasium id."""
    entry_point: str | None = None
    """Its code, as Gymnasium has it registered."""
    kwargs: dict[str, Any] | None = None
    """The keyword arguments it was made with, those of its registration among them."""
    action_low: list[float] | None = None
    """Lower bounds of the actions as the environment takes them; -1 in the demonstrations stands for these."""
    action_high: list[float] | None = None
    """Upper bounds; 1 stands for these."""
    step_seconds: float | None = None
    """Simulated time of one step."""


class Batch(NamedTuple):
    """Steps, all that a reward is ever given: `action` was taken in `obs` and led to `next_obs`.

    The leading axes are `[T]` for an episode, in the order of time, and `[rows, n]` for windows of `n` steps in a row.
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
        """The steps between `n + 1` states in a row; `windows` are `discount` and `episode_id`."""
        return cls(obs[..., :-1, :], action, obs[..., 1:, :], *windows)

    @property
    def first(self) -> Batch:
        """The first step of each window."""
        return Batch(self.obs[:, 0], self.action[:, 0], self.next_obs[:, 0])


class Window(NamedTuple):
    """`n` consecutive steps from each of `batch` random starts, all within one episode.

    Step `t` leads from `obs[:, t]` by `action[:, t]` to `obs[:, t + 1]` with `reward[:, t]`. `discount[:, t]` is 0 where that
    step terminated the episode and in the padding after it, and 1 elsewhere: a time limit is no termination, and no
    window reaches past one.
    """

    obs: Float[Any, "batch states obs"]
    action: Float[Any, "batch n action"]
    reward: Float[Any, "batch n"]
    discount: Float[Any, "batch n"]
    episode_id: Int[Any, " batch"]
    """Which episode each window is from, counted from 0 over all that were ever added."""


@dataclass(frozen=True, eq=False)
class Episode:
    """One whole episode of `T` agent steps; the arrays are made read-only.

    `obs[t]` is where `action[t]` was taken, `reward[t]` what the environment paid for it. `terminated` says that the task
    ended (no future), otherwise the episode was cut by a time limit. `seed` is what the environment was reset with.
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
        """The same episode with a further entry in each observation, 1 in the absorbing state and 0 elsewhere.

        An episode that terminated ends in the absorbing state (zeros and the 1) in place of its last observation, and takes
        `steps` from there to itself, with action and reward 0; so nothing terminates, and a reward learned on such episodes
        values an early end as it values any other state (Kostrikov et al. 2019, section 4.2). With `n` of them a window of `n`
        steps can begin in the absorbing state, and does so once.
        """
        obs = np.pad(self.obs, ((0, 0), (0, 1)))
        if not self.terminated:
            return Episode(obs, self.action, self.reward, False, self.seed)
        rest = np.zeros((steps + 1, obs.shape[1]), obs.dtype)
        rest[:, -1] = 1
        action, reward = np.pad(self.action, ((0, steps), (0, 0))), np.pad(self.reward, (0, steps))
        return Episode(np.concatenate([obs[:-1], rest]), action, reward, False, self.seed)

    @property
    def total_reward(self) -> float:
        """The return: the undiscounted sum of the environment's rewards."""
        return float(np.sum(self.reward, dtype=np.float64))
