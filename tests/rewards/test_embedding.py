"""The two heads on an embedding: hand-computed numbers, a naive second computation, and no effect on the embedding."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from pcil.nets.networks import MLP, unit_sphere
from pcil.rewards import PCIL, TCN, Reward
from pcil.rewards.base import only
from pcil.rewards.embedding import Classifier, EmbeddingState, embedding_reward, similarity
from pcil.training import presets
from pcil.types import Batch
from small import batches, narrow, random_batch, staying

BOTH = [narrow(PCIL(head="gail")), narrow(TCN(head="gail"))]


def itself(obs: jnp.ndarray) -> jnp.ndarray:
    return obs


@functools.partial(jax.jit, static_argnums=0)
def update(settings: PCIL | TCN, state: EmbeddingState, expert: Batch, agent: Batch, key: Any) -> tuple[EmbeddingState, Any]:
    return settings.update(state, expert, agent, itself, key=key)


def test_similarity_by_hand() -> None:
    """Two expert rows and three steps: "random" compares with rows 0, 1, 0; "mean" compares with their mean."""
    expert = jnp.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    steps = jnp.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.6, 0.8, 0.0]])
    assert np.allclose(similarity(steps, expert, "random"), [1.0, 0.0, 0.6])
    assert np.allclose(similarity(steps, expert, "mean"), [0.5, 0.5, 0.7])


def test_the_logit_is_the_reward_even_where_the_sigmoid_saturates() -> None:
    """Weights (300, 0) and bias -100 at the directions (1, 0), (-1, 0), (0.6, 0.8): 200, -400 and 80.

    With logarithms in float32 the first would be infinite, because `1 - D` is 0.
    """
    encoder = MLP((jnp.eye(2),), (jnp.zeros(2),))
    classifier = Classifier(MLP((jnp.array([[300.0], [0.0]]),), (jnp.array([-100.0]),)), None)
    state = EmbeddingState(encoder, None, only("state", staying(jnp.ones((4, 2)), jnp.ones((4, 1)))), classifier)
    obs = jnp.array([[5.0, 0.0], [-2.0, 0.0], [3.0, 4.0]])
    got = embedding_reward(state, staying(obs, obs), itself, "state", "random")
    assert np.allclose(got, [200.0, -400.0, 80.0], atol=1e-3)


@pytest.mark.parametrize("settings", BOTH, ids=lambda s: type(s).__name__)
def test_the_classifier_takes_a_step_of_cross_entropy_with_label_1_for_the_expert(settings: PCIL | TCN) -> None:
    """With probabilities in float64: `dL/dlogit` is `D - 1` on the expert and `D` on the agent, each averaged over its rows.

    Adam's first moment after one step is a tenth of the gradient.
    """
    expert, agent = batches(random_batch(33, 6, 1, 1)), batches(random_batch(33, 6, 1, 2))
    state = settings.init([random_batch(99, 6, 1, 3)], itself, key=jax.random.key(0))
    after, metrics = update(settings, state, expert, agent, jax.random.key(1))
    first = [
        (w.next_obs if isinstance(settings, PCIL) else w.obs)[:, 0] for w in (expert, agent)
    ]  # the inputs of the encoder's update
    phi_e, phi_a = (np.asarray(unit_sphere(state.encoder(obs)), np.float64) for obs in first)
    weight, bias = np.asarray(state.classifier.linear.weights[0], np.float64)[:, 0], float(state.classifier.linear.biases[0][0])
    d_e, d_a = (1 / (1 + np.exp(-(phi @ weight + bias))) for phi in (phi_e, phi_a))
    assert float(metrics["head_loss"]) == pytest.approx(-np.mean(np.log(d_e)) - np.mean(np.log(1 - d_a)), rel=1e-5)
    slope = ((d_e - 1) @ phi_e + d_a @ phi_a) / 32
    mean = optax.tree.get(after.classifier.opt_state, "mu")
    assert np.allclose(mean.weights[0][:, 0], slope / 10, atol=1e-7)
    assert float(mean.biases[0][0]) == pytest.approx((np.mean(d_e - 1) + np.mean(d_a)) / 10, abs=1e-7)
    moved = np.asarray(after.classifier.linear.weights[0][:, 0]) - weight
    assert np.allclose(moved, -settings.learning_rate * np.sign(slope), rtol=1e-2), "Adam's first step has the rate's size"


@pytest.mark.parametrize("settings", BOTH, ids=lambda s: type(s).__name__)
def test_the_embedding_never_feels_the_head(settings: PCIL | TCN) -> None:
    """Three updates with either head leave the same encoder, bit for bit; only one of the two has a classifier."""
    demos = [random_batch(99, 6, 1, 3)]
    expert, agent = batches(random_batch(33, 6, 1, 1)), batches(random_batch(33, 6, 1, 2))
    ends = []
    for head in ("gail", "similarity"):
        one = dataclasses.replace(settings, head=head)
        state = one.init(demos, itself, key=jax.random.key(0))
        for i in range(3):
            state, _ = update(one, state, expert, agent, jax.random.key(i))
        ends.append(state)
    assert ends[0].classifier is not None and ends[1].classifier is None
    for a, b in zip(*(jax.tree.leaves((end.encoder, end.opt_state)) for end in ends), strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize("preset", presets.PRESETS)
def test_the_four_rows_of_table_1_differ_in_representation_and_head_alone(preset: str) -> None:
    """Agent, schedule, labels and the reward's sizes and learning rates are the same for all four."""
    runs = {method: presets.make("hopper_stand", method, preset) for method in ("pcil", "tcn", "pcil-gail", "tcn-gail")}
    assert len({dataclasses.replace(run, method="", reward=PCIL()) for run in runs.values()}) == 1
    for name, kind in (("pcil", PCIL), ("tcn", TCN)):
        plain: Reward = runs[name].reward
        assert type(plain) is kind and plain.head == "similarity"
        assert runs[f"{name}-gail"].reward == dataclasses.replace(plain, head="gail")
    for name in ("hidden", "learning_rate", "batch_size", "compare", "task_weight"):
        assert getattr(runs["pcil"].reward, name) == getattr(runs["tcn"].reward, name)
    assert runs["tcn"].reward.temperature == 0.07, "Appendix C.1"


@pytest.mark.parametrize("settings", BOTH, ids=lambda s: type(s).__name__)
def test_the_classifier_starts_from_draws_of_its_own(settings: PCIL | TCN) -> None:
    """Independent normal draws: the classifier's initial weights are not proportional to the encoder's."""
    state = settings.init([random_batch(50, 6, 1)], itself, key=jax.random.key(0))
    head, first = (np.asarray(net.weights[0]).ravel() for net in (state.classifier.linear, state.encoder))
    assert abs(np.corrcoef(head, first[: len(head)])[0, 1]) < 0.999
