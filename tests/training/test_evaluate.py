"""Evaluation: episodes in lockstep equal episodes played one by one, and each starts from its own seed."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from pcil.errors import InputError
from pcil.seeds import Stream, episode_seed, rng
from pcil.training.evaluate import LOCKSTEP, Evaluation, environments_for, evaluate


class Walk(gymnasium.Env[np.ndarray, np.ndarray]):
    """A random walk of `length` steps, moved by the action; its noise depends on the seed of the reset."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, length: int, *, terminates: bool = False) -> None:
        self.length, self.terminates, self.seeds = length, terminates, []
        self.position, self.left = 0.0, 0

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.seeds.append(seed)
        self.position, self.left = self.np_random.normal(), self.length
        return self.observe(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert self.left > 0, "stepped after its end"
        assert action.shape == (1,)
        self.position += float(action[0]) + self.np_random.normal()
        self.left -= 1
        over = self.left == 0
        return self.observe(), self.position / 3, over and self.terminates, over and not self.terminates, {}

    def observe(self) -> np.ndarray:
        return np.array([self.position, self.left], np.float32)


def policy(obs: np.ndarray) -> np.ndarray:
    return np.tanh(obs[..., :1] * np.float32(-0.7))


def one_by_one(environments: list[Walk], seed: int) -> tuple[list[float], list[int]]:
    """The second implementation: one episode after the other, one observation at a time."""
    returns, lengths = [], []
    for i, env in enumerate(environments):
        obs, _ = env.reset(seed=episode_seed(seed, Stream.EVALUATE, i))
        total, length, over = 0.0, 0, False
        while not over:
            obs, reward, terminated, truncated, _ = env.step(policy(obs))
            total += reward  # in order: since Python 3.12, `sum` corrects rounding errors
            length += 1
            over = terminated or truncated
        returns.append(total)
        lengths.append(length)
    return returns, lengths


def walks(*lengths: int) -> list[Walk]:
    return [Walk(length, terminates=i % 2 == 0) for i, length in enumerate(lengths)]


@pytest.mark.parametrize("lengths", [(3, 1, 5, 5, 2), (4,), (1, 1, 1), (1, 2, 3, 4), (4, 3, 2, 1)])
def test_in_lockstep_as_one_by_one(lengths: tuple[int, ...]) -> None:
    result = evaluate(policy, walks(*lengths), seed=3)
    returns, steps = one_by_one(walks(*lengths), seed=3)
    assert result.returns.dtype == np.float64
    assert result.returns.tolist() == returns
    assert result.lengths.tolist() == steps == list(lengths)
    assert result.mean == np.mean(returns)
    assert result.seconds > 0


def test_an_episode_keeps_its_row_of_the_block_until_all_are_over() -> None:
    """A matrix product with fewer rows may differ in the last bit."""
    asked = []

    def act(obs: np.ndarray) -> np.ndarray:
        asked.append(obs[:, 1].tolist())
        return policy(obs)

    evaluate(act, walks(3, 1, 4), seed=0)
    assert asked == [[3, 1, 4], [2, 0, 3], [1, 0, 2], [0, 0, 1]]  # the remaining steps of each episode
    asked.clear()
    evaluate(act, walks(2), seed=0, episodes=3)
    assert asked == [[2, 0, 0], [1, 0, 0], [0, 2, 0], [0, 1, 0], [0, 0, 2], [0, 0, 1]]


def test_the_same_seed_gives_the_same_episodes_and_another_seed_others() -> None:
    environments = walks(3, 4)
    first, again, other = (evaluate(policy, environments, seed=seed) for seed in (1, 1, 2))
    assert first.returns.tolist() == again.returns.tolist()
    assert not set(first.returns.tolist()) & set(other.returns.tolist())


def test_every_episode_has_a_seed_of_its_own_that_does_not_depend_on_how_many_there_are() -> None:
    few, many = [Walk(2) for _ in range(3)], [Walk(2) for _ in range(10)]
    short, long = evaluate(policy, few, seed=5), evaluate(policy, many, seed=5)
    assert [env.seeds for env in many] == [[episode_seed(5, Stream.EVALUATE, i)] for i in range(10)]
    assert len({env.seeds[0] for env in many}) == len(set(long.returns.tolist())) == 10
    assert short.returns.tolist() == long.returns.tolist()[:3]


def test_a_policy_that_returns_too_few_actions_is_noticed() -> None:
    with pytest.raises(ValueError):
        evaluate(lambda obs: policy(obs)[:-1], walks(2, 2), seed=0)


class Reporting(Walk):
    """Reports at each step its distance, whether it succeeded, and a text."""

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, _ = super().step(action)
        info = {"is_success": np.bool_(self.position > 0), "position": self.position, "note": "text", "pair": [1, 2]}
        return obs, reward, terminated, truncated, info | ({} if self.left else {"only at the end": 1})


def test_the_numbers_of_each_episodes_last_info_are_kept() -> None:
    environments = [Reporting(length) for length in (3, 1, 5)]
    result = evaluate(policy, environments, seed=3)
    ends = [env.position for env in environments]
    assert {name: column.tolist() for name, column in result.info.items()} == {
        "is_success": [float(end > 0) for end in ends],
        "position": ends,
        "only at the end": [1, 1, 1],
    }
    assert result.success == [float(end > 0) for end in ends] and 0 < sum(result.success) < 3
    assert evaluate(policy, [*environments, Walk(2)], seed=3).info == {}, "a key that is missing in one of them is left out"
    assert evaluate(policy, walks(2), seed=3).success is None


def test_the_mean_is_over_episodes() -> None:
    assert Evaluation(np.array([1.0, 2.0, 6.0]), np.array([1, 1, 1]), 0.5).mean == 3.0


def test_fewer_environments_than_episodes_take_them_in_turns() -> None:
    returns, lengths = one_by_one([Walk(3) for _ in range(7)], seed=4)
    turns = walks(3, 3)
    result = evaluate(policy, turns, seed=4, episodes=7)
    assert (result.returns.tolist(), result.lengths.tolist()) == (returns, lengths)
    assert [len(env.seeds) for env in turns] == [4, 3]
    for episodes, single, copies in ((1000, False, LOCKSTEP), (2, False, 2), (2, True, 1)):
        with environments_for("toy/point_mass-v0", episodes, single=single) as (_, made):
            assert len(made) == copies


class Noting(Walk):
    """Notes the actions that it is given."""

    def __init__(self, length: int) -> None:
        super().__init__(length)
        self.actions: list[float] = []

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.actions.append(float(action[0]))
        return super().step(action)


def test_noise_is_gaussian_clipped_and_of_its_episode() -> None:
    """The second implementation draws the noise of an episode at once, from the generator with its number."""
    still, noise = lambda obs: np.full((len(obs), 1), 0.25, np.float32), 0.6
    side_by_side = [Noting(40) for _ in range(5)]
    result = evaluate(still, side_by_side, seed=3, noise=noise)
    for i, env in enumerate(side_by_side):
        drawn = rng(3, Stream.NOISE, i).normal(size=40)
        np.testing.assert_allclose(env.actions, np.clip(0.25 + noise * drawn, -1, 1), atol=1e-6)
        assert max(env.actions) == 1 and min(env.actions) >= -1
    one = Noting(40)
    alone = evaluate(still, [one], seed=3, episodes=5, noise=noise)
    assert one.actions == [action for env in side_by_side for action in env.actions]
    assert alone.returns.tolist() == result.returns.tolist()


def test_without_noise_actions_are_those_of_the_policy() -> None:
    env = Noting(3)
    evaluate(lambda obs: np.full((len(obs), 1), 0.25, np.float32), [env], seed=0, episodes=1, noise=0.0)
    assert env.actions == [0.25] * 3


def test_an_environment_may_reuse_its_buffer() -> None:
    class Reusing(Walk):
        """Returns the same array at every step."""

        buffer = np.zeros(2, np.float32)

        def observe(self) -> np.ndarray:
            self.buffer[:] = super().observe()
            return self.buffer

    plain = evaluate(policy, [Walk(4), Walk(4)], seed=1)
    assert evaluate(policy, [Reusing(4), Reusing(4)], seed=1).returns.tolist() == plain.returns.tolist()


class Odd(Walk):
    """A walk whose `info` is `kind`."""

    kind: Any = None

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Any]:
        return *super().step(action)[:4], self.kind


@pytest.mark.parametrize("kind", [None, {}, {"contacts": [[1], [1, 2]]}, {"name": "x", "two": np.ones(2), 3: 1.0}])
def test_an_info_without_single_numbers_gives_none(kind: Any) -> None:
    env = Odd(3)
    env.kind = kind
    assert evaluate(policy, [env], seed=1, episodes=2).info == {}


def test_an_info_that_is_no_dict_is_refused() -> None:
    env = Odd(3)
    env.kind = [1]
    with pytest.raises(InputError, match=r"as info.*must be a dict"):
        evaluate(policy, [env], seed=1)


def test_an_environment_may_reuse_its_info() -> None:
    class Shared(Walk):
        """A walk that always returns one dict, with one array in it."""

        held: dict[str, Any] = {"left": np.zeros(1), "seeds": 0}  # noqa: RUF012

        def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, Any]:
            result = super().step(action)
            self.held["left"][0] = self.position
            self.held["seeds"] = len(self.seeds)
            return *result[:4], self.held

    result = evaluate(policy, [Shared(3)], seed=1, episodes=3)
    assert result.info["seeds"].tolist() == [1, 2, 3]
    assert len(set(result.info["left"].tolist())) == 3
