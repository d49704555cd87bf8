"""Rows of a representation: distances, silhouettes and positions compared with naive computations and known properties."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcil.report.embedding import measures, project
from pcil.report.load import EvalRow, TransitionRow

law = settings(deadline=None, derandomize=True, max_examples=25)
RUN = EvalRow("walker_run", "pcil", "paper", 2, 5000, 0.0, 0.0, 0.0, None, "abc")
RNG = np.random.default_rng(0)
EXPERT, AGENT = RNG.normal(size=(12, 3)), RNG.normal(size=(20, 3)) + 4
REWARD = RNG.random(20)


def naive_silhouette(i: int, rows: np.ndarray, mine: np.ndarray) -> float:
    """Rousseeuw 1987: how much nearer a row's own cluster is than the other one."""
    distance = [float(np.linalg.norm(rows[i] - row)) for row in rows]
    own = np.mean([d for k, d in enumerate(distance) if mine[k] == mine[i] and k != i])
    other = np.mean([d for k, d in enumerate(distance) if mine[k] != mine[i]])
    return (other - own) / max(own, other)


def test_each_transition_is_a_row() -> None:
    transitions = project(EXPERT, AGENT, REWARD, RUN)
    assert {row[:5] for row in transitions} == {("walker_run", "pcil", "paper", 2, 5000)}
    assert [row.reward for row in transitions[:12]] == [None] * 12
    assert [row.reward for row in transitions[12:]] == pytest.approx(REWARD.tolist(), rel=1e-4)


def test_distances_and_silhouettes_are_the_naive_ones() -> None:
    transitions = project(EXPERT, AGENT, REWARD, RUN)
    rows, mine = np.concatenate([EXPERT, AGENT]), np.arange(32) < 12
    assert [row.distance for row in transitions] == pytest.approx(
        [math.dist(row, EXPERT.mean(axis=0)) for row in rows.tolist()], rel=1e-4
    )
    assert [row.silhouette for row in transitions] == pytest.approx(
        [naive_silhouette(i, rows, mine) for i in range(32)], rel=1e-3
    )


def test_what_is_apart_is_drawn_apart() -> None:
    """The nearest neighbour of a point is in the same cluster, and the same rows give the same picture."""
    transitions = project(EXPERT, AGENT + 50, REWARD, RUN)
    places = np.array([(row.x, row.y) for row in transitions])
    gaps = np.linalg.norm(places[:, None] - places[None], axis=2) + np.diag(np.full(32, np.inf))
    assert ((gaps.argmin(axis=1) < 12) == (np.arange(32) < 12)).all()
    assert project(EXPERT, AGENT + 50, REWARD, RUN) == transitions


def transitions_of(
    distances: list[float], rewards: list[float], silhouettes: tuple[float, ...] = (0.5, 0.25)
) -> list[TransitionRow]:
    head = RUN[:5]
    experts = [TransitionRow(*head, None, 0.0, value, 0.0, 0.0) for value in silhouettes]
    pairs = zip(distances, rewards, strict=True)
    return experts + [TransitionRow(*head, reward, distance, -1.0, 0.0, 0.0) for distance, reward in pairs]


@law
@given(st.lists(st.integers(0, 100).map(float), min_size=3, max_size=20, unique=True))
def test_distance_that_tells_all_has_rank_correlation_minus_one(distances: list[float]) -> None:
    """For every decreasing function of the distance; the agent's silhouettes do not count."""
    assert measures(transitions_of(distances, [math.exp(-d / 50) for d in distances])) == pytest.approx((-1, 0.375))
    assert measures(transitions_of(distances, [d**3 for d in distances]))[0] == pytest.approx(1)


def test_a_reward_that_never_varies_tells_nothing() -> None:
    assert math.isnan(measures(transitions_of([1.0, 2.0, 3.0], [5.0, 5.0, 5.0]))[0])
    assert math.isnan(measures(transitions_of([1.0, 1.0, 1.0], [5.0, 6.0, 7.0]))[0])


def test_ties_share_their_rank() -> None:
    """Ranks 1, 2.5, 2.5, 4 against 4, 3, 2, 1: -4.5 / sqrt(4.5 x 5)."""
    assert measures(transitions_of([1.0, 2.0, 2.0, 3.0], [9.0, 8.0, 7.0, 6.0]))[0] == pytest.approx(-4.5 / math.sqrt(22.5))
