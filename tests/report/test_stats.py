"""Statistics compared with published numbers, second implementations and exact enumeration, and their properties."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import ttest_1samp

from fake_runs import fake_run
from pcil.report import stats
from pcil.report.load import read_run
from pcil.report.stats import Interval

law = settings(deadline=None, derandomize=True, max_examples=50)
RUNS_BY_TASKS = np.array([[1, 2], [2, 2], [1, 1], [2, 1]], float)
OTHERS = np.array([[1, 1], [2, 2], [3, 3]], float)
scores = arrays.arrays(np.float64, st.integers(2, 9), elements=st.integers(-50, 50).map(float))
tasks = st.lists(scores, min_size=1, max_size=3)


def naive_iqm(values: list[float]) -> float:
    """Sort, remove the lowest and the highest quarter (rounded down), and average the rest."""
    cut = len(values) // 4
    kept = sorted(values)[cut : len(values) - cut]
    return sum(kept) / len(kept)


def naive_probability(ours: list[np.ndarray], theirs: list[np.ndarray]) -> float:
    """Count pairs, task by task."""
    chances = []
    for x, y in zip(ours, theirs, strict=True):
        pairs = [1.0 if a > b else 0.5 if a == b else 0.0 for a in x for b in y]
        chances.append(sum(pairs) / len(pairs))
    return sum(chances) / len(chances)


def test_the_published_numbers() -> None:
    """Agarwal et al. 2021 test their library with these."""
    assert stats.interval(stats.iqm, list(RUNS_BY_TASKS.T)).value == 1.5
    assert stats.probability_of_improvement(list(RUNS_BY_TASKS.T), list(OTHERS.T)).value == pytest.approx(1 / 3)


@law
@given(tasks)
def test_the_iqm_is_the_naive_one(strata: list[np.ndarray]) -> None:
    assert stats.iqm(*strata) == pytest.approx(naive_iqm([value for task in strata for value in task.tolist()]))


@law
@given(scores, st.floats(0.1, 5), st.floats(-5, 5))
def test_the_iqm_moves_with_its_scores_and_lies_among_them(x: np.ndarray, scale: float, shift: float) -> None:
    assert stats.iqm(scale * x + shift) == pytest.approx(scale * stats.iqm(x) + shift, abs=1e-9)
    assert x.min() <= stats.iqm(x) <= x.max()
    assert len(x) > 3 or stats.iqm(x) == pytest.approx(x.mean())


def test_the_iqm_does_not_see_one_outlier() -> None:
    assert stats.iqm(np.array([1.0, 2.0, 3.0, 1e9])) == 2.5


@settings(law, max_examples=15)
@given(st.data())
def test_the_probability_is_the_naive_one_and_complements(data: st.DataObject) -> None:
    ours = data.draw(tasks)
    theirs = [data.draw(scores) for _ in ours]
    interval = stats.probability_of_improvement(ours, theirs)
    assert interval.value == pytest.approx(naive_probability(ours, theirs))
    assert interval.value + stats.probability_of_improvement(theirs, ours).value == pytest.approx(1)
    assert 0 <= interval.low <= interval.high <= 1
    bent = stats.probability_of_improvement([np.arctan(x) for x in ours], [np.arctan(y) for y in theirs])
    assert bent == pytest.approx(interval), "only the order of the scores counts"


# --- Student's interval ---


@law
@given(scores.filter(lambda x: np.ptp(x) > 0))
def test_the_interval_of_the_mean_is_scipys(x: np.ndarray) -> None:
    oracle = ttest_1samp(x, 0).confidence_interval(0.95)
    assert stats.mean_interval(x) == pytest.approx((x.mean(), *oracle))


def test_three_seeds_by_hand() -> None:
    """t(0.975, 2) = 4.302653; the standard deviation of 100, 200, 300 is 100."""
    assert stats.mean_interval([100.0, 200.0, 300.0]) == pytest.approx((200, 200 - 248.414, 200 + 248.414), abs=1e-3)
    assert stats.student(964.2, 24.2, 3) == pytest.approx((964.2, 904.084, 1024.316), abs=1e-3)


def test_it_covers_the_truth_as_often_as_it_says() -> None:
    draws = np.random.default_rng(0).normal(5, 2, (3000, 3))
    covered = np.mean([i.low <= 5 <= i.high for i in map(stats.mean_interval, draws)])
    assert 0.94 < covered < 0.96


def test_one_seed_has_no_interval() -> None:
    for interval in (stats.mean_interval([7.0]), stats.interval(stats.iqm, [np.array([7.0])])):
        assert interval.value == 7 and math.isnan(interval.low) and math.isnan(interval.high)
    alone = stats.probability_of_improvement([np.array([7.0])], [np.array([1.0, 2.0])])
    assert alone.value == 1 and math.isnan(alone.low)


def test_overlap() -> None:
    one = Interval(2, 1, 3)
    assert one.overlaps(Interval(5, 3, 7)) and Interval(5, 3, 7).overlaps(one) and one.overlaps(Interval(2, 1.9, 2.1))
    assert one.overlaps(Interval(5, 3.01, 7)) is False and Interval(5, 3.01, 7).overlaps(one) is False
    assert one.overlaps(Interval(2, math.nan, math.nan)) is None


# --- The bootstrap ---


def test_the_bootstrap_draws_seeds_within_their_task() -> None:
    """Without strata the IQM of these would vary from 0 to 100."""
    apart = [np.zeros(5), np.full(5, 100.0)]
    assert stats.interval(stats.iqm, apart) == (50, 50, 50)


def test_the_bootstrap_is_that_of_all_possible_draws() -> None:
    """Compared with an enumeration of all 3^3 x 2^2 equally likely draws."""
    strata = [np.array([1.0, 4.0, 10.0]), np.array([20.0, 50.0])]
    draws = itertools.product(itertools.product(strata[0], repeat=3), itertools.product(strata[1], repeat=2))
    exact = np.array([naive_iqm([*a, *b]) for a, b in draws])
    value, low, high = stats.interval(stats.iqm, strata)
    assert value == pytest.approx(naive_iqm([1, 4, 10, 20, 50]))
    for end, level in ((low, 0.025), (high, 0.975)):  # up to the error of 2000 random draws of the 108
        assert np.mean(exact < end - 1e-9) - 0.01 < level < np.mean(exact <= end + 1e-9) + 0.01
    assert stats.interval(stats.iqm, strata) == stats.interval(stats.iqm, strata), "the same numbers give the same interval"


def test_each_column_of_a_curve_has_its_own_interval() -> None:
    strata = [np.random.default_rng(i).normal(size=(4, 6)) for i in range(3)]
    low, high = stats.bootstrap(stats.iqm, strata)
    for k in range(6):
        alone = stats.interval(stats.iqm, [x[:, k] for x in strata])
        assert (low[k], high[k]) == pytest.approx(alone[1:], abs=0.05)
        assert alone.value == pytest.approx(stats.iqm(*strata)[k])
    assert all(np.isnan(end).all() and end.shape == (6,) for end in stats.bootstrap(stats.iqm, [strata[0], strata[1][:1]]))


# --- Against the expert ---


def test_the_way_to_a_share_of_the_expert_is_the_first_evaluation_there(tmp_path: Path) -> None:
    run = read_run(fake_run(tmp_path / "run", [0, 390, 450, 300, 640], expert=800))
    reached = [stats.first_reach(run, share) for share in (0.5, 0.8, 0.9)]
    assert [row and (row.frames, row.seconds) for row in reached] == [(2000, 60.0), (4000, 120.0), None]


@pytest.mark.parametrize("expert", [None, 0.0, -100.0])
def test_where_the_expert_has_nothing_there_is_no_share(expert: float | None, tmp_path: Path) -> None:
    run = read_run(fake_run(tmp_path / "run", [-200, -50], expert=expert))
    assert stats.first_reach(run, 0.5) is None
    assert stats.share_of_expert([run], np.array([[1.0, 2.0]])) is None


def test_each_seed_is_measured_by_its_own_expert(tmp_path: Path) -> None:
    runs = [read_run(fake_run(tmp_path / str(expert), [1], expert=expert)) for expert in (100.0, 200.0)]
    share = stats.share_of_expert(runs, np.array([[50.0, 100.0], [50.0, 100.0]]))
    assert share is not None and share.tolist() == [[0.5, 1.0], [0.25, 0.5]]


# --- Comparisons ---


def test_welchs_test_by_hand() -> None:
    """Of 1, 2, 3 and 5, 9: difference -5, variances 1/3 and 8/2, so t = -5 / sqrt(13/3) with 1.170 degrees of freedom."""
    between, chance = stats.difference(np.array([1.0, 2.0, 3.0]), np.array([5.0, 9.0]))
    error, freedom = (1 / 3 + 4) ** 0.5, (1 / 3 + 4) ** 2 / ((1 / 3) ** 2 / 2 + 4**2 / 1)
    assert chance == pytest.approx(2 * scipy.stats.t.cdf(-5 / error, freedom))
    half = scipy.stats.t.ppf(0.975, freedom) * error
    assert between == (-5, pytest.approx(-5 - half), pytest.approx(-5 + half))


@pytest.mark.parametrize(("ours", "theirs"), [([1.0], [2.0, 3.0]), ([1.0, 2.0], [3.0]), ([1.0, 1.0], [2.0, 2.0])])
def test_too_little_for_a_test_gives_none(ours: list[float], theirs: list[float]) -> None:
    between, chance = stats.difference(np.array(ours), np.array(theirs))
    assert np.isnan(chance) and np.isnan(between[1:]).all() and between.value == np.mean(ours) - np.mean(theirs)


def test_holms_correction_by_hand() -> None:
    """Of .01, .04, .03 and .005: .005 * 4, .01 * 3, .03 * 2, and .04 * 1, which is raised to the .06 before it."""
    assert stats.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert stats.holm([0.9, 0.8]) == [1, 1] and stats.holm([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holms_correction_is_the_naive_one(chances: list[float]) -> None:
    """A test is rejected at a level if it, and each with a smaller p-value, is at most the level over the number left."""

    def rejected(level: float) -> set[int]:
        found: set[int] = set()
        for number, i in enumerate(sorted(range(len(chances)), key=chances.__getitem__)):
            if chances[i] > level / (len(chances) - number):
                break
            found.add(i)
        return found

    adjusted = stats.holm(chances)
    for level in (0.01, 0.05, 0.3):
        assert rejected(level * (1 - 1e-9)) <= {i for i, p in enumerate(adjusted) if p <= level} <= rejected(level * (1 + 1e-9))


def test_the_area_is_the_mean_height_of_the_curve() -> None:
    """0, 1, 1 at 0, 1000, 4000: a triangle of 500 and a rectangle of 3000, over 4000 frames."""
    frames = np.array([0, 1000, 4000])
    assert stats.area(frames, np.array([[0.0, 1.0, 1.0], [2.0, 2.0, 2.0]])) == pytest.approx([3500 / 4000, 2])
    assert stats.area(frames[:1], np.array([[0.3], [0.4]])).tolist() == [0.3, 0.4]


def test_a_profile_is_the_share_of_runs_at_each_level() -> None:
    """One task of two seeds with 0.5 and 1, one of three with 0, 0.5 and 0.9; the mean over tasks."""
    found = stats.profile([np.array([0.5, 1.0]), np.array([0.0, 0.5, 0.9])], np.array([0.0, 0.5, 0.6, 1.0]))
    assert found.center == pytest.approx([1, (1 + 2 / 3) / 2, (1 / 2 + 1 / 3) / 2, (1 / 2 + 0) / 2])
    assert (found.low <= found.center).all() and (found.center <= found.high).all() and found.low[0] == found.high[0] == 1
