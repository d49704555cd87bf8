"""Values that are passed between packages: an episode and its absorbing state."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pcil.types import Episode


def make_episode(steps: int, terminated: bool) -> Episode:
    obs = np.arange(1, 2 * (steps + 1) + 1, dtype=np.float32).reshape(steps + 1, 2)
    return Episode(obs, np.ones((steps, 1), np.float32), np.arange(1.0, steps + 1), terminated, seed=3)


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.integers(1, 9), st.booleans(), st.integers(1, 4))
def test_an_absorbed_episode_never_terminates_and_pays_the_same(steps: int, terminated: bool, rest: int) -> None:
    episode = make_episode(steps, terminated)
    after = episode.absorbed(rest)
    assert not after.terminated and after.seed == 3 and after.total_reward == episode.total_reward
    assert len(after) == steps + terminated * rest and after.obs.shape[1] == 3
    real = steps if terminated else steps + 1  # number of observations that are kept
    assert np.array_equal(after.obs[:real, :2], episode.obs[:real]) and not after.obs[:real, 2].any()
    assert np.array_equal(after.action[:steps], episode.action) and np.array_equal(after.reward[:steps], episode.reward)
    if terminated:
        assert np.array_equal(after.obs[steps:], [[0, 0, 1]] * (rest + 1))
        assert not after.action[steps:].any() and not after.reward[steps:].any()
