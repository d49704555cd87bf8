"""TCN's loss compared with hand-computed numbers and naive loops, and the states of a window that it compares."""

from __future__ import annotations

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pcil.errors import InputError
from pcil.nets.networks import MLP, unit_sphere
from pcil.nets.optimiser import adam_init
from pcil.rewards.base import only
from pcil.rewards.embedding import EmbeddingState
from pcil.rewards.tcn import TCN
from pcil.types import Batch
from small import batches, narrow, random_batch, staying

SETTINGS = narrow(TCN(temperature=0.5))
ROLLOUT = narrow(TCN(temperature=0.5, negatives="rollout", margin=3, window=2))
ENCODER = MLP.init((6, 16, 16, 16, 4), key=jax.random.key(0))
IDENTITY = MLP((jnp.eye(2),), (jnp.zeros(2),))
KEY = jax.random.key(1)


def itself(obs: jnp.ndarray) -> jnp.ndarray:
    return obs


@functools.partial(jax.jit, static_argnums=0)
def update(settings: TCN, state: EmbeddingState, expert: Batch, agent: Batch, key: Any) -> tuple[EmbeddingState, Any]:
    return settings.update(state, expert, agent, itself, key=key)


def drawn(seed: int, n: int, rows: int = 32) -> Batch:
    """Windows of `n` steps on random states."""
    return batches(random_batch(rows + n, 6, 1, seed), n)


def states(windows: Batch) -> np.ndarray:
    """All states of each window, one more than it has steps."""
    return np.concatenate([windows.obs[:, :1], windows.next_obs], axis=1)


def phi(obs: Any) -> np.ndarray:
    return np.asarray(unit_sphere(ENCODER(jnp.asarray(obs))), np.float64)


def metrics_of(settings: TCN, expert: Batch, agent: Batch, key: Any = KEY) -> dict[str, Any]:
    state = EmbeddingState(ENCODER, adam_init(ENCODER), only("state", staying(jnp.zeros((1, 6)), jnp.zeros((1, 1)))), None)
    return update(settings, state, expert, agent, key)[1]


def naive(anchor: np.ndarray, positive: np.ndarray, negatives: list[np.ndarray], temperature: float) -> float:
    """Cross-entropy, anchor by anchor; `negatives` has a list of rows for each."""
    losses = []
    for a, p, others in zip(anchor, positive, negatives, strict=True):
        top = math.exp(a @ p / temperature)
        losses.append(-math.log(top / (top + sum(math.exp(a @ n / temperature) for n in others))))
    return float(np.mean(losses))


def test_each_state_finds_the_next_one_among_those_of_all_other_rows() -> None:
    """Naive loops over a mixture of 32 expert and 32 agent rows, all of which are anchors."""
    expert, agent = drawn(1, 1), drawn(2, 1)
    obs = np.concatenate([states(expert), states(agent)])
    anchor, positive = phi(obs[:, 0]), phi(obs[:, 1])
    negatives = [np.delete(positive, i, axis=0) for i in range(64)]
    got = metrics_of(SETTINGS, expert, agent)
    assert float(got["contrast_loss"]) == pytest.approx(naive(anchor, positive, negatives, 0.5), rel=1e-5)
    assert float(got["positive_similarity"]) == pytest.approx(np.mean(np.sum(anchor * positive, axis=1)), rel=1e-5)
    assert float(got["negative_similarity"]) == pytest.approx(
        np.mean([a @ np.array(n).T for a, n in zip(anchor, negatives, strict=True)]), rel=1e-4
    )


def test_two_rows_by_hand() -> None:
    """Temperature 0.5, anchors (1, 0) and (0, 1), positives (1, 0) and (0.6, 0.8).

    Anchor 1: positive 2, negative 1.2: -2 + log(e^2 + e^1.2) = 0.371101. Anchor 2: positive 1.6, negative 0:
    -1.6 + log(e^1.6 + 1) = 0.183901. The mean is 0.277501.
    """
    near = jnp.array([[[1.0, 0.0], [0.0, 1.0]], [[1.0, 0.0], [0.6, 0.8]]])
    loss, metrics = SETTINGS.loss(IDENTITY, near, jnp.zeros((2, 0, 2)), jnp.zeros((2, 0), bool))
    assert float(loss) == pytest.approx(0.277501, abs=1e-6)
    assert float(metrics["accuracy"]) == 1.0


def test_a_rollouts_own_negatives_by_hand() -> None:
    """Temperature 0.5, anchor and positive (1, 0), far states (0, 1) and, after the end, (1, 0), which counts as -1.

    -2 + log(e^2 + e^0 + e^-2) = 0.142932.
    """
    near = jnp.array([[[1.0, 0.0]], [[1.0, 0.0]]])
    far, real = jnp.array([[[0.0, 1.0], [1.0, 0.0]]]), jnp.array([[True, False]])
    loss, _ = ROLLOUT.loss(IDENTITY, near, far, real)
    assert float(loss) == pytest.approx(0.142932, abs=1e-6)


def test_negatives_of_the_same_rollout_are_those_from_the_margin_to_twice_the_margin() -> None:
    """Naive loops; with `window = 1` the positive is the next state, and rows of other windows have no effect."""
    settings = narrow(TCN(temperature=0.5, negatives="rollout", margin=3))
    expert, agent = drawn(1, 6), drawn(2, 6)
    obs = np.concatenate([states(expert), states(agent)])
    negatives = [phi(row[3:7]) for row in obs]
    got = metrics_of(settings, expert, agent)
    assert settings.span == 6
    assert float(got["contrast_loss"]) == pytest.approx(naive(phi(obs[:, 0]), phi(obs[:, 1]), negatives, 0.5), rel=1e-5)


@pytest.mark.parametrize("end", [3, 4, 5, 6])
def test_what_lies_behind_a_termination_is_no_negative(end: int) -> None:
    """Windows that terminate with step `end - 1`, so that state `end` is the last: later rows change nothing.

    The last state itself does count.
    """
    expert, agent = drawn(1, 6), drawn(2, 6)
    expert = expert._replace(discount=expert.discount.at[:, end - 1 :].set(0))
    losses = []
    for changed in (None, slice(end + 1, None), slice(end, None)):
        obs = states(expert).copy()
        if changed:
            obs[:, changed] += 1
        moved = Batch.of(obs, expert.action, expert.discount, expert.episode_id)
        losses.append(float(metrics_of(ROLLOUT, moved, agent)["contrast_loss"]))
    assert losses[0] == losses[1] != losses[2]


def test_positives_are_at_most_so_many_steps_away_and_all_of_them_occur() -> None:
    """States turn by 0.5 in each step, so the cosine with the anchor shows the distance to the positive: 1, 2 or 3 steps."""
    angle = np.arange(4, dtype=np.float32) / 2
    obs = np.tile(np.stack([np.cos(angle), np.sin(angle)], axis=1), (500, 1, 1))
    ones = np.ones((500, 3), np.float32)
    window = Batch.of(obs, ones[..., None], ones, np.zeros(500, np.int32))

    def mean_cosine(settings: TCN) -> float:
        reference = only("state", staying(jnp.zeros((1, 2)), jnp.zeros((1, 1))))
        state = EmbeddingState(IDENTITY, adam_init(IDENTITY), reference, None)
        return float(update(settings, state, window, window, KEY)[1]["positive_similarity"])

    assert mean_cosine(narrow(TCN(window=3))) == pytest.approx(np.mean(np.cos([0.5, 1.0, 1.5])), abs=0.05)
    assert mean_cosine(narrow(TCN(window=1))) == pytest.approx(math.cos(0.5), abs=1e-5)


@pytest.mark.parametrize("settings", [SETTINGS, ROLLOUT], ids=["batch", "rollout"])
def test_nothing_says_which_rows_are_the_experts(settings: TCN) -> None:
    """If expert and agent are exchanged the loss is the same. (With a window of one step, so that nothing is drawn.)"""
    settings = narrow(TCN(temperature=0.5, negatives=settings.negatives, margin=3))
    one, two = drawn(1, 6), drawn(2, 6)
    first, second = (metrics_of(settings, *pair) for pair in ((one, two), (two, one)))
    assert float(first["contrast_loss"]) == pytest.approx(float(second["contrast_loss"]), rel=1e-6)


def test_windows_that_are_longer_than_needed_are_cut() -> None:
    """The agent's windows have at least `n_step` steps, the expert's `span`."""
    expert, agent = drawn(1, 1), drawn(2, 3)
    short = Batch(*(array[:, :1] for array in agent[:4]), agent.episode_id)
    one, two = (metrics_of(SETTINGS, expert, other) for other in (agent, short))
    assert {name: float(value) for name, value in one.items()} == {name: float(value) for name, value in two.items()}


@pytest.mark.parametrize("settings", [SETTINGS, ROLLOUT], ids=["batch", "rollout"])
def test_neighbours_in_time_come_closer_than_strangers(settings: TCN) -> None:
    """On random walks: after 100 updates the next state is nearer, by cosine, than a state ten steps later."""
    settings = narrow(settings, learning_rate=1e-2)
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(2, 60, 6))
    walks = [staying(each.cumsum(axis=0).astype(np.float32), np.zeros((60, 1), np.float32)) for each in steps]
    expert, agent = (batches(walk, settings.span) for walk in walks)
    state = settings.init(walks, itself, key=KEY)
    for i in range(100):
        state, metrics = update(settings, state, expert, agent, jax.random.key(i))
    z = np.asarray(unit_sphere(state.encoder(jnp.asarray(walks[1].obs))))
    next_one, later = (np.mean(np.sum(z[:-gap] * z[gap:], axis=1)) for gap in (1, 10))
    assert next_one > later + 0.3
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, metrics)))


def test_the_span_is_what_the_furthest_state_needs() -> None:
    assert (TCN().span, TCN(window=4).span, TCN(negatives="rollout", margin=10).span) == (1, 4, 20)


@pytest.mark.parametrize("margin", [1, 2])
def test_a_margin_within_the_window_is_refused(margin: int) -> None:
    with pytest.raises(InputError, match=rf"TCN.margin is {margin}; it must be at least 3"):
        TCN(negatives="rollout", window=2, margin=margin)
    assert TCN(window=2, margin=margin).margin == margin, "without negatives of the same rollout it has no effect"


def test_the_representation_is_the_embedding_of_the_state_that_a_step_led_to() -> None:
    batch = random_batch(8, 6, 1, 4)
    batch = Batch(batch.obs, batch.action, batch.obs[::-1].copy())
    state = SETTINGS.init([batch], itself, key=KEY)
    raw = np.asarray(state.encoder(jnp.asarray(batch.next_obs)), np.float64)
    got = SETTINGS.representation(state, batch, itself)
    assert np.allclose(got, raw / np.linalg.norm(raw, axis=1, keepdims=True), atol=1e-5)
