"""Units make no difference: an observation entry in other units, `a x + b`, changes an update only by rounding."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from pcil.envs.toy import PointMass
from pcil.training import learner, presets
from pcil.training.config import Algorithm
from pcil.training.presets import METHODS
from pcil.types import Batch, Episode, Spec, Window
from small import narrow

SPEC = Spec(5, 2, 1)
UPDATES = 3


@cache
def method_of(name: str) -> Algorithm:
    run = presets.make("walker_walk", name)
    return Algorithm(narrow(run.agent), narrow(run.reward), run.label)


@dataclasses.dataclass(frozen=True)
class Units:
    """Units in which entry `i` of an observation `x` is `scale[i] x + offset[i]`, rounded once to float32."""

    scale: np.ndarray
    offset: np.ndarray

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        return (obs.astype(np.float64) * self.scale + self.offset).astype(np.float32)


def draws(method: Algorithm, units: Units) -> tuple[list[Batch], Any, Episode]:
    """Demonstrations, a function that draws windows, and an episode; entry 3 is constant for the expert, entry 4 for both."""
    rng = np.random.default_rng(0)

    def states(*shape: int, still: bool) -> np.ndarray:
        obs = rng.normal(size=(*shape, SPEC.obs_dim)).astype(np.float32)
        obs[..., 3] *= not still
        obs[..., 4] = 0.25
        return units(obs)

    def actions(*shape: int) -> np.ndarray:
        return np.tanh(rng.normal(size=(*shape, SPEC.action_dim))).astype(np.float32)

    def windows(rows: int, n: int, still: bool) -> Window:
        reward = rng.normal(size=(rows, n)).astype(np.float32)
        obs = states(rows, n + 1, still=still)
        return Window(obs, actions(rows, n), reward, np.ones((rows, n), np.float32), np.arange(rows, dtype=np.int32))

    demos = [Batch.of(states(31, still=True), actions(30)) for _ in range(2)]
    episode = Episode(states(21, still=False), actions(20), rng.normal(size=20))
    return demos, windows, episode


def learned(name: str, units: Units) -> dict[str, np.ndarray]:
    """Labels, actions and metrics after several updates."""
    method = method_of(name)
    agent, reward = method.agent, method.reward
    demos, windows, episode = draws(method, units)
    state, actor = learner.init(method, SPEC, demos, 0), None
    for i in range(UPDATES):
        window = windows(agent.batch_size, agent.n_step, False)
        expert = windows(reward.batch_size, reward.span, True) if reward.batch_size else None
        seen = windows(reward.batch_size, reward.span, False) if reward.span > agent.n_step else None
        state, actor = learner.update(method, state, window, expert, seen, np.int32(i), np.int32(i))
    state = learner.close_episode(method, state, episode, 0)
    assert actor is not None
    return {
        "label": learner.label_episode(method, state, episode, 0),
        "action": np.asarray(actor(jnp.asarray(episode.obs))),
        "action on the host": jax.tree.map(np.asarray, actor)(episode.obs, np),
        **{name: np.asarray(total) / UPDATES for name, total in state.totals.items()},
    }


@cache
def in_plain_units(name: str) -> dict[str, np.ndarray]:
    return learned(name, Units(np.ones(SPEC.obs_dim), np.zeros(SPEC.obs_dim)))


entries = st.lists(
    st.tuples(st.floats(-6, 6), st.floats(-1000, 1000)).map(lambda pair: (10 ** pair[0], pair[1] * 10 ** pair[0])),
    min_size=SPEC.obs_dim,
    max_size=SPEC.obs_dim,
)


@pytest.mark.parametrize("name", METHODS)
@settings(max_examples=2, deadline=None, derandomize=True)
@example([(1e-6, 1e-3), (1e6, -1e9), (1.0, 0.0), (1e-6, 0.0), (1e6, 1e9)])
@example([(1.0, 1000.0), (1e-6, 0.0), (1e6, 0.0), (1e6, -1e9), (1.0, 0.0)])
@given(entries)
def test_other_units_change_an_update_by_rounding_alone(name: str, entries: list[tuple[float, float]]) -> None:
    """An offset of 1000 standard deviations costs an entry three of float32's seven digits."""
    scale, offset = np.array(entries).T
    ours, theirs = in_plain_units(name), learned(name, Units(scale, offset))
    for what, value in ours.items():
        np.testing.assert_allclose(theirs[what], value, rtol=5e-3, atol=5e-3, err_msg=what)


UNITS = {
    "plain": Units(np.ones(2), np.zeros(2)),
    "tiny": Units(np.full(2, 1e-4), np.zeros(2)),
    "large": Units(np.full(2, 1e5), np.zeros(2)),
    "far": Units(np.ones(2), np.full(2, 1e6)),
    "mixed": Units(np.array([1e-4, 1.0]), np.array([0.0, 300.0])),
}


@pytest.mark.parametrize("name", UNITS)
def test_cloning_learns_in_any_units_beside_a_huge_constant(name: str) -> None:
    """At an offset of 1e6, float32 has a resolution of 0.06, and no more precision than that is lost."""
    run = presets.make("walker_walk", "bc")
    method = Algorithm(narrow(run.agent, hidden=32, learning_rate=3e-3), run.reward, run.label)
    rng = np.random.default_rng(0)
    state = learner.init(method, Spec(3, 2, 1), [], 0)
    actor = None
    for i in range(600):
        position = rng.uniform(-1, 1, (32, 1, 2)).astype(np.float32)
        obs = np.concatenate([UNITS[name](position), np.full((32, 1, 1), 1e6, np.float32)], axis=-1)
        rows = np.repeat(obs, 2, axis=1)
        action = PointMass.optimal_action(position).astype(np.float32)
        ones = np.ones((32, 1), np.float32)
        window = Window(rows, action, ones, ones, np.zeros(32, np.int32))
        state, actor = learner.update(method, state, window, None, None, np.int32(i), np.int32(i))
    assert actor is not None
    error = float(np.mean((np.asarray(actor(jnp.asarray(obs[:, 0]))) - action[:, 0]) ** 2))
    nothing = float(np.mean(action**2))
    assert error < 0.1 * nothing
