"""Episodes played side by side equal those played one after the other."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcil import envs
from pcil.envs.rollout import Rollout
from pcil.errors import RunError
from pcil.types import Episode


class Walk(gymnasium.Env[np.ndarray, np.ndarray]):
    """A random walk of `length` steps; its noise depends on the seed of the reset."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, length: int, terminates: bool) -> None:
        self.length, self.terminates = length, terminates

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.position, self.left = self.np_random.normal(), self.length
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert self.left > 0, "stepped after its end"
        self.position += float(action[0]) + self.np_random.normal()
        self.left -= 1
        over = self.left == 0
        return self.observe(), self.position / 3, over and self.terminates, over and not self.terminates, {"left": self.left}

    def observe(self) -> np.ndarray:
        return np.array([self.position, self.left], np.float32)


def act(obs: np.ndarray) -> np.ndarray:
    return np.tanh(obs[:1] * np.float32(-0.7))


def alone(length: int, terminates: bool, seed: int) -> tuple[Episode, float]:
    """The second implementation: a plain loop over one environment."""
    env = Walk(length, terminates)
    observations, actions, rewards, over = [env.reset(seed=seed)[0]], [], [], False
    total = 0.0
    while not over:
        actions.append(act(observations[-1]))
        obs, reward, terminated, truncated, _ = env.step(actions[-1])
        observations.append(obs)
        rewards.append(reward)
        total += reward
        over = terminated or truncated
    return Episode(np.stack(observations), np.stack(actions), np.array(rewards), terminates, seed), total


def made(lengths: list[int]) -> list[envs.Checked]:
    return [envs.checked(Walk(length, i % 2 == 0)) for i, length in enumerate(lengths)]


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.lists(st.integers(1, 6), min_size=1, max_size=5))
def test_side_by_side_as_one_after_the_other(lengths: list[int]) -> None:
    rollout = Rollout(made(lengths), range(7, 7 + len(lengths)), [f"episode {i}" for i in range(len(lengths))])
    steps = 0
    while rollout.playing:
        assert rollout.playing == [i for i, length in enumerate(lengths) if length > steps]
        assert rollout.lengths.tolist() == [min(length, steps) for length in lengths]
        rollout.step([act(obs) for obs in rollout.obs])
        steps += 1
    assert steps == max(lengths) and [info["left"] for info in rollout.info] == [0] * len(lengths)
    expected = [alone(length, i % 2 == 0, 7 + i) for i, length in enumerate(lengths)]
    for got, (episode, total), returned, last in zip(rollout.episodes(), expected, rollout.returns, rollout.obs, strict=True):
        assert (got.terminated, got.seed, returned) == (episode.terminated, episode.seed, total)
        assert all(np.array_equal(getattr(got, name), getattr(episode, name)) for name in ("obs", "action", "reward"))
        assert np.array_equal(last, episode.obs[-1])


def test_an_episode_may_be_left_before_its_end() -> None:
    rollout = Rollout(made([5]), [3], ["the first"])
    rollout.step([act(rollout.obs[0])])
    rollout.step([act(rollout.obs[0])])
    (episode,) = rollout.episodes()
    whole, _ = alone(5, True, 3)
    assert rollout.playing == [0] and not episode.terminated
    assert np.array_equal(episode.obs, whole.obs[:3]) and np.array_equal(episode.reward, whole.reward[:2])


def test_what_is_not_kept_is_counted_all_the_same() -> None:
    rollout = Rollout(made([3]), [3], ["the first"], keep=False)
    while rollout.playing:
        rollout.step([act(rollout.obs[0])])
    assert rollout.lengths.tolist() == [3] and rollout.returns.tolist() == [alone(3, True, 3)[1]]
    with pytest.raises(ValueError):
        rollout.episodes()


def test_an_error_names_the_episode() -> None:
    rollout = Rollout(made([3, 3]), [1, 2], ["the first", "the second"])
    with pytest.raises(RunError, match=r"in step 1 of the second \(seed 2\)"):
        rollout.step([np.zeros(1), np.full(1, np.nan)])
