"""Statistics of a few seeds: means and interquartile means with 95% intervals, probability of improvement, sample efficiency.

`strata` are the scores of one method: an array for each task, with the seeds along the first axis. The bootstrap is
stratified: it draws seeds with replacement within each task (Agarwal et al. 2021).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from pcil.report.load import EvalRow, by_variant, matrix

LEVEL = 0.95
RESAMPLES = 2000


class Interval(NamedTuple):
    """A value and the bounds of its 95% interval, which are NaN if there is only one seed."""

    value: float
    low: float
    high: float

    def overlaps(self, other: Interval) -> bool | None:
        """Whether the intervals overlap; None if a bound is unknown."""
        if any(map(math.isnan, (*self, *other))):
            return None
        return self.low <= other.high and other.low <= self.high


class Curve(NamedTuple):
    """A line over frames and the bounds of its interval, all `[frames]`; unknown bounds are NaN."""

    frames: np.ndarray
    center: np.ndarray
    low: np.ndarray
    high: np.ndarray


def mean_interval(scores: Sequence[float] | np.ndarray) -> Interval:
    """The mean over seeds and Student's t interval, which is valid for few seeds if their scores are normally distributed."""
    deviation = float(np.std(scores, ddof=1)) if len(scores) > 1 else math.nan
    return student(float(np.mean(scores)), deviation, len(scores))


def student(mean: float, deviation: float, seeds: int) -> Interval:
    """Student's t interval from a mean and a sample standard deviation over seeds, as papers report them."""
    half = float(stats.t.ppf((1 + LEVEL) / 2, seeds - 1)) * deviation / math.sqrt(seeds) if seeds > 1 else math.nan
    return Interval(mean, mean - half, mean + half)


def iqm(*strata: np.ndarray, axis: int = 0) -> np.ndarray:
    """Interquartile mean of the pooled scores: the mean without the lowest and the highest quarter. Of three it is the mean."""
    return np.asarray(stats.trim_mean(np.concatenate(strata, axis=axis), 0.25, axis=axis))


def interval(statistic: Callable[..., Any], strata: Sequence[np.ndarray]) -> Interval:
    """`statistic(*strata)` of final scores `[seeds]`, with its bootstrap interval."""
    return Interval(float(statistic(*strata)), *map(float, bootstrap(statistic, strata)))


def probability_of_improvement(ours: Sequence[np.ndarray], theirs: Sequence[np.ndarray]) -> Interval:
    """Probability that a run of ours beats a run of theirs on the same task, averaged over tasks; a tie counts one half."""

    def chance(*strata: np.ndarray, axis: int = 0) -> np.ndarray:
        moved = [np.moveaxis(scores, axis, -1) for scores in strata]
        pairs = zip(moved[: len(ours)], moved[len(ours) :], strict=True)
        wins = [(1 + np.sign(x[..., :, None] - y[..., None, :])).mean(axis=(-2, -1)) / 2 for x, y in pairs]
        return np.asarray(np.mean(wins, axis=0))

    return interval(chance, [*ours, *theirs])


def difference(ours: np.ndarray, theirs: np.ndarray) -> tuple[Interval, float]:
    """The difference of the means of two methods' seeds with Welch's 95% interval, and the p-value of Welch's t-test.

    Both are NaN where a method has one seed, or where neither varies.
    """
    middle = float(np.mean(ours) - np.mean(theirs))
    if min(len(ours), len(theirs)) < 2 or np.ptp(ours) == np.ptp(theirs) == 0:
        return Interval(middle, math.nan, math.nan), math.nan
    test: Any = stats.ttest_ind(ours, theirs, equal_var=False)
    low, high = test.confidence_interval(LEVEL)
    return Interval(middle, float(low), float(high)), float(test.pvalue)


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's (1979) adjusted p-values of a family of tests, in their order: the i-th smallest of m is multiplied by m - i + 1,
    and is at least the one before it and at most 1."""
    order = np.argsort(p_values, kind="stable")
    factors = np.arange(len(order), 0, -1)
    adjusted = np.empty(len(order))
    adjusted[order] = np.minimum(np.maximum.accumulate(factors * np.asarray(p_values, float)[order]), 1)
    return adjusted.tolist()


def area(frames: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The mean height of each curve `[seeds, F]` over its frames, by the trapezoidal rule: the area under it per frame."""
    if len(frames) < 2:
        return values[:, -1]
    return np.trapezoid(values, frames, axis=1) / (frames[-1] - frames[0])


def profile(shares: Sequence[np.ndarray], levels: np.ndarray) -> Curve:
    """A performance profile (Agarwal et al. 2021): the share of runs whose score is at least each of the `levels`, averaged
    over tasks, with a bootstrap interval. `shares` are the scores `[seeds]` of each task."""
    reached = [(scores[:, None] >= levels).astype(float) for scores in shares]
    return Curve(levels, mean_of_tasks(*reached), *bootstrap(mean_of_tasks, reached))


def mean_of_tasks(*strata: np.ndarray, axis: int = 0) -> np.ndarray:
    """The mean over seeds, averaged over tasks."""
    return np.asarray(np.mean([scores.mean(axis=axis) for scores in strata], axis=0))


def bootstrap(statistic: Callable[..., Any], strata: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of the percentile interval of `statistic(*strata, axis=...)`, for each index of the trailing axes.

    The draws are the same in every call. The bounds are NaN if a task has only one seed.
    """
    if min(map(len, strata)) < 2:
        nothing = np.full(strata[0].shape[1:], math.nan)
        return nothing, nothing
    options = {"n_resamples": RESAMPLES, "confidence_level": LEVEL, "method": "percentile", "rng": np.random.default_rng(0)}
    low, high = stats.bootstrap(strata, statistic, vectorized=True, axis=0, **options).confidence_interval
    return np.asarray(low), np.asarray(high)


def share_of_expert(runs: Sequence[Sequence[EvalRow]], scores: np.ndarray) -> np.ndarray | None:
    """Scores, with one row for each run, divided by the demonstrations' return; None if that is unknown or not positive."""
    experts = np.array([run[-1].expert_return or 0 for run in runs])
    return None if experts.min() <= 0 else (scores.T / experts).T


def curve(runs: Sequence[Sequence[EvalRow]], value: str = "return_mean") -> Curve:
    """The mean over seeds at the frames that all have, with Student's 95% interval; the bounds of a single seed are NaN."""
    frames, values = matrix(runs, value)
    return Curve(frames, *np.array([mean_interval(column) for column in values.T]).reshape(-1, 3).T)


Shares = dict[tuple[str, str], tuple[Curve, int]]
"""A curve over all tasks of a method and variant, and the number of tasks."""


def share_curves(rows: Iterable[EvalRow]) -> Shares:
    """Of each method and variant: the IQM over seeds and tasks of the share of the expert's return, at the frames that all of
    them have, with a bootstrap interval, and the number of tasks whose expert is known."""
    strata: dict[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]] = {}
    for name, runs in by_variant(rows).items():
        frames, returns = matrix(runs)
        if (share := share_of_expert(runs, returns)) is not None:
            strata.setdefault(name[1:], []).append((frames, share))
    found = {}
    for name, tasks in strata.items():
        frames = functools.reduce(np.intersect1d, [own for own, _ in tasks])
        scores = [share[:, np.isin(own, frames)] for own, share in tasks]
        found[name] = Curve(frames, iqm(*scores), *bootstrap(iqm, scores)), len(tasks)
    return found


def first_reach(run: Sequence[EvalRow], share: float) -> EvalRow | None:
    """The first evaluation at which a run reaches this share of its expert's return; None if there is none."""
    reached = (row for row in run if row.return_mean >= share * (row.expert_return or math.inf) > 0)
    return next(reached, None)
