"""The replay: every window that it returns is one that a list of episodes would give, and all are equally likely.

Each row identifies itself: the observation at time t of episode e is `1000 e + t`, which determines action and reward.
"""

from __future__ import annotations

import dataclasses
from collections import Counter

import hypothesis.stateful as stateful
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare

from pcil.errors import InputError
from pcil.training.replay import Replay
from pcil.types import Episode, Window

law = settings(deadline=None, derandomize=True, max_examples=60)


def make_episode(name: int, steps: int, terminated: bool) -> Episode:
    t = np.arange(steps + 1, dtype=np.float32) + 1000 * name
    obs, action = np.stack([t, t + 0.25], axis=1), -t[:-1, None]
    return Episode(obs, action, np.full(steps, np.nan), terminated)  # the stored rewards are not the episode's own


def stored_reward(episode: Episode) -> np.ndarray:
    return episode.obs[:-1, 0].astype(np.float32) + 0.5


class ListOfEpisodes:
    """The second implementation: whole episodes in a list; the oldest are dropped until there are free rows for the next."""

    def __init__(self, capacity: int) -> None:
        self.capacity, self.episodes = capacity, []

    def add(self, episode: Episode) -> None:
        while sum(len(e) + 1 for e in self.episodes) + len(episode) + 1 > self.capacity:
            self.episodes.pop(0)
        self.episodes.append(episode)

    def windows(self, n: int) -> dict[float, tuple[list, list, list, list]]:
        """Every valid window by its first observation: observations, actions, rewards, discounts."""
        return {
            float(episode.obs[start, 0]): self.window(episode, start, n)
            for episode in self.episodes
            for start in range(len(episode))
            if episode.terminated or start + n <= len(episode)
        }

    @staticmethod
    def window(episode: Episode, start: int, n: int) -> tuple[list, list, list, list]:
        end = len(episode)
        obs, action, reward, discount = [episode.obs[start].tolist()], [], [], []
        for t in range(start, start + n):
            obs.append(episode.obs[min(t + 1, end)].tolist())
            action.append(episode.action[t].tolist() if t < end else [0.0])
            reward.append(float(stored_reward(episode)[t]) if t < end else 0.0)
            discount.append(0.0 if t >= end or (episode.terminated and t == end - 1) else 1.0)
        return obs, action, reward, discount


def check(window: Window, expected: dict, batch: int, n: int) -> list[float]:
    """Check that every row is exactly one of the enumerated windows; returns their first observations."""
    assert window.obs.shape == (batch, n + 1, 2) and window.action.shape == (batch, n, 1)
    assert window.reward.shape == window.discount.shape == (batch, n)
    assert all(array.dtype == np.float32 for array in window[:4]) and window.episode_id.dtype == np.int32
    rows = zip(*(array.tolist() for array in window), strict=True)
    for obs, action, reward, discount, number in rows:
        assert number == obs[0][0] // 1000, "episodes are numbered in the order in which they are added"
        true_obs, true_action, true_reward, true_discount = expected[obs[0][0]]
        assert obs == true_obs
        assert action == true_action
        assert reward == true_reward
        assert discount == true_discount
    return window.obs[:, 0, 0].tolist()


def fill(capacity: int, *shapes: tuple[int, bool]) -> tuple[Replay, ListOfEpisodes]:
    replay, naive = Replay(capacity, 2, 1), ListOfEpisodes(capacity)
    for name, (steps, terminated) in enumerate(shapes):
        episode = make_episode(name, steps, terminated)
        replay.add(episode, stored_reward(episode))
        naive.add(episode)
    return replay, naive


class Machine(stateful.RuleBasedStateMachine):
    """All operations on a replay of 24 rows, in any order."""

    capacity = 24

    def __init__(self) -> None:
        super().__init__()
        self.replay, self.naive, self.count = Replay(self.capacity, 2, 1), ListOfEpisodes(self.capacity), 0

    @stateful.rule(steps=st.integers(1, capacity - 1), terminated=st.booleans())
    def add(self, steps: int, terminated: bool) -> None:
        episode = make_episode(self.count, steps, terminated)
        self.replay.add(episode, stored_reward(episode))
        self.naive.add(episode)
        self.count += 1

    @stateful.rule(steps=st.integers(1, 4), terminated=st.booleans())
    def add_short(self, steps: int, terminated: bool) -> None:
        self.add(steps, terminated)

    @stateful.rule(excess=st.integers(0, 5))
    def add_one_that_is_too_long(self, excess: int) -> None:
        episode = make_episode(self.count, self.capacity + excess, False)
        with pytest.raises(InputError):
            self.replay.add(episode, stored_reward(episode))

    @stateful.rule(n=st.integers(1, 5), seed=st.integers(0, 2**32), batch=st.integers(1, 20))
    def sample(self, n: int, seed: int, batch: int) -> None:
        expected = self.naive.windows(n)
        if expected:
            check(self.replay.sample(np.random.default_rng(seed), batch, n), expected, batch, n)
        else:
            with pytest.raises(InputError):
                self.replay.sample(np.random.default_rng(seed), batch, n)

    @stateful.rule()
    def save_and_load(self) -> None:
        restored = Replay(self.capacity, 2, 1)
        restored.load(self.replay.state())
        self.replay = restored

    @stateful.invariant()
    def counts_agree(self) -> None:
        episodes = self.naive.episodes
        assert self.replay.num_episodes == len(episodes)
        assert self.replay.num_steps == sum(map(len, episodes))
        for n in (1, 3):
            assert self.replay.num_windows(n) == len(self.naive.windows(n))


TestAnythingThatMayHappen = Machine.TestCase
TestAnythingThatMayHappen.settings = settings(law, max_examples=40, stateful_step_count=20)


# --- Windows at the ends of an episode ---


@pytest.mark.parametrize("offset", range(5))
def test_a_window_that_meets_a_termination_is_padded_from_there_on(offset: int) -> None:
    """Five steps and windows of three that start at `offset`, by hand instead of with the second implementation."""
    replay, _ = fill(20, (5, True))
    window = replay.sample(np.random.default_rng(0), 200, 3)
    row = next(i for i in range(200) if window.obs[i, 0, 0] == offset)
    alive = [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    reward = [0.5, 1.5, 2.5, 3.5, 4.5, 0.0, 0.0]
    assert window.discount[row].tolist() == alive[offset : offset + 3]
    assert window.reward[row].tolist() == reward[offset : offset + 3]
    assert window.obs[row, :, 0].tolist() == [min(offset + k, 5) for k in range(4)]


@pytest.mark.parametrize("n", range(1, 8))
def test_a_time_limit_is_no_termination_and_no_window_reaches_past_it(n: int) -> None:
    replay, _ = fill(20, (5, False))
    assert replay.num_windows(n) == max(5 - n + 1, 0)
    if n > 5:
        with pytest.raises(InputError, match=f"no window of {n} steps"):
            replay.sample(np.random.default_rng(0), 1, n)
    else:
        window = replay.sample(np.random.default_rng(0), 100, n)
        assert set(window.obs[:, 0, 0].tolist()) == set(range(5 - n + 1))
        assert window.discount.min() == 1
        assert window.obs[:, -1, 0].max() == 5  # the final observation appears as the last of a window


def test_windows_of_one_step_are_all_transitions() -> None:
    replay, naive = fill(40, (5, False), (1, True), (4, True))
    assert replay.num_windows(1) == 10
    drawn = check(replay.sample(np.random.default_rng(0), 300, 1), naive.windows(1), 300, 1)
    assert len(set(drawn)) == 10


# --- Random draws ---


@pytest.mark.parametrize("n", [1, 3])
def test_every_valid_start_is_drawn_and_all_equally_often(n: int) -> None:
    """A chi-square test with a fixed seed, on a full ring buffer that also holds episodes without a window of 3."""
    replay, naive = fill(30, (9, False), (2, False), (7, True), (1, True), (5, False), (2, False), (3, False))
    expected = naive.windows(n)
    drawn = Counter(check(replay.sample(np.random.default_rng(5), 20_000, n), expected, 20_000, n))
    assert len(naive.episodes) < 7
    assert set(drawn) == set(expected)
    assert chisquare(list(drawn.values())).pvalue > 1e-3


@pytest.mark.parametrize("every", [2, 3, 7])
@pytest.mark.parametrize("n", [1, 3])
def test_windows_may_start_at_every_so_manyth_step_only(n: int, every: int) -> None:
    """Each of these starts equally often; the first one is step i modulo `every` of the i-th episode, or its last start."""
    episodes = [make_episode(name, steps, name % 2 == 0) for name, steps in enumerate((9, 4, 5, 12))]
    replay = Replay.of([dataclasses.replace(episode, reward=stored_reward(episode)) for episode in episodes])
    expected = set()
    for name, episode in enumerate(episodes):
        starts = [t for t in range(len(episode)) if episode.terminated or t + n <= len(episode)]
        expected |= {1000.0 * name + t for t in starts[min(name % every, len(starts) - 1) :: every]}
    rng = np.random.default_rng(0)
    drawn = Counter(replay.sample(rng, 200 * len(expected), n, every).obs[:, 0, 0].tolist())
    assert set(drawn) == expected
    assert chisquare(list(drawn.values())).pvalue > 1e-3


def test_the_same_generator_draws_the_same_windows() -> None:
    replay, _ = fill(30, (9, False), (7, True))
    first, second = (replay.sample(np.random.default_rng(3), 50, 3) for _ in range(2))
    other = replay.sample(np.random.default_rng(4), 50, 3)
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a, b)
    assert first.obs.tolist() != other.obs.tolist()


# --- The ring buffer ---


def test_the_oldest_episodes_leave_whole_and_only_when_their_rows_are_needed() -> None:
    """Rows 4 + 5 + 3 = 12 fill the ring buffer; 2 more drop the first episode; 8 more drop the next two."""
    replay, _ = fill(12, (3, True), (4, True), (2, True))
    assert (replay.num_episodes, replay.num_steps) == (3, 9)
    for name, steps, left in ((3, 1, [1, 2, 3]), (4, 7, [3, 4])):
        episode = make_episode(name, steps, True)
        replay.add(episode, stored_reward(episode))
        window = replay.sample(np.random.default_rng(0), 300, 2)
        assert sorted({int(x) // 1000 for x in window.obs[:, 0, 0]}) == left


def test_an_episode_may_wrap_around_the_end_of_the_ring() -> None:
    replay, naive = fill(10, (5, True), (6, True))  # rows 0-5, then 6-9 and 0-2
    assert replay.num_episodes == 1
    drawn = check(replay.sample(np.random.default_rng(0), 200, 4), naive.windows(4), 200, 4)
    assert set(drawn) == {1000.0 + t for t in range(6)}


def test_an_episode_that_fills_the_ring_fits_and_one_row_more_is_refused() -> None:
    replay, naive = fill(10, (4, True), (9, False))
    assert (replay.num_episodes, replay.num_windows(9)) == (1, 1)
    with pytest.raises(InputError, match="An episode of 10 steps does not fit into a replay of 10 rows"):
        replay.add(make_episode(2, 10, False), np.zeros(10))
    check(replay.sample(np.random.default_rng(0), 5, 9), naive.windows(9), 5, 9)  # the refused call changed nothing


def test_a_replay_of_episodes_holds_them_all_with_their_own_rewards_and_no_row_more() -> None:
    bare = [make_episode(name, steps, name == 1) for name, steps in enumerate((5, 3, 7))]
    episodes = [Episode(e.obs, e.action, stored_reward(e), e.terminated) for e in bare]
    replay, reference = Replay.of(episodes), ListOfEpisodes(18)
    assert (replay.capacity, replay.num_episodes, replay.num_steps) == (5 + 3 + 7 + 3, 3, 15)
    for episode in episodes:
        reference.add(episode)
    for n in (1, 4):
        windows = reference.windows(n)
        drawn = check(replay.sample(np.random.default_rng(0), 500, n), windows, 500, n)
        assert set(drawn) == set(windows) and replay.num_windows(n) == len(windows)


def test_a_replay_may_be_of_a_single_episode() -> None:
    episode = make_episode(0, 5, True)
    replay = Replay.of([episode])
    assert (replay.capacity, replay.num_episodes, replay.num_windows(1)) == (6, 1, 5)


def test_an_empty_replay_has_no_window() -> None:
    replay = Replay(10, 2, 1)
    assert (replay.num_windows(1), replay.num_steps, replay.num_episodes) == (0, 0, 0)
    with pytest.raises(InputError, match="no window of 1 steps"):
        replay.sample(np.random.default_rng(0), 1, 1)


def test_writing_into_a_window_changes_no_row() -> None:
    replay, naive = fill(20, (5, True), (6, False))
    for array in replay.sample(np.random.default_rng(0), 50, 3):
        array[:] = -1
    for array in replay.state().values():
        array[...] = 0
    check(replay.sample(np.random.default_rng(0), 50, 3), naive.windows(3), 50, 3)


# --- Saving ---

shapes = st.lists(st.tuples(st.integers(1, 12), st.booleans()), max_size=8)


@law
@given(shapes, shapes, st.sampled_from([1, 3]))
def test_a_restored_replay_goes_on_as_the_first_would_have(before: list, after: list, n: int) -> None:
    """Bit for bit, including padding: the same draws now, and after further episodes."""
    replay, _ = fill(25, *before)
    restored = Replay(25, 2, 1)
    restored.load(replay.state())
    for name, (steps, terminated) in enumerate([*after, (5, True)], start=100):
        if replay.num_windows(n):
            first, second = (r.sample(np.random.default_rng(name), 30, n) for r in (replay, restored))
            for a, b in zip(first, second, strict=True):
                np.testing.assert_array_equal(a, b)
        episode = make_episode(name, steps, terminated)
        for r in (replay, restored):
            r.add(episode, stored_reward(episode))
    for (name, a), b in zip(replay.state().items(), restored.state().values(), strict=True):
        np.testing.assert_array_equal(a, b, err_msg=name)


def test_loading_replaces_all_that_a_replay_held() -> None:
    replay, naive = fill(25, (7, True), (4, False))
    used, _ = fill(25, (3, True), (2, True), (9, False))
    used.sample(np.random.default_rng(0), 5, 3)
    used.load(replay.state())
    assert used.num_windows(3) == len(naive.windows(3))
    drawn = check(used.sample(np.random.default_rng(0), 200, 3), naive.windows(3), 200, 3)
    assert set(drawn) == set(naive.windows(3))


def test_a_state_holds_the_rows_in_use_and_no_others() -> None:
    replay, _ = fill(1000, (5, True), (6, False))
    state = replay.state()
    assert {name: array.shape for name, array in state.items()} == {
        "obs": (13, 2),
        "action": (13, 1),
        "reward": (13,),
        "segments": (2, 4),
        "next": (),
        "added": (),
    }


# --- Size ---


def test_half_a_million_steps_of_walker_take_less_than_150_megabytes() -> None:
    replay = Replay(501_000, 24, 6)
    episode = Episode(np.ones((501, 24), np.float32), np.ones((500, 6), np.float32), np.ones(500))
    for _ in range(1001):
        replay.add(episode, episode.reward)
    assert (replay.num_episodes, replay.num_steps) == (1000, 500_000)
    rows = [array.nbytes for array in vars(replay).values() if isinstance(array, np.ndarray)]
    assert sum(rows) == 501_000 * (24 + 6 + 1) * 4
    assert sum(rows) < 150e6
    assert sum(rows) >= sum(array.nbytes for name, array in replay.state().items() if name in ("obs", "action", "reward"))
