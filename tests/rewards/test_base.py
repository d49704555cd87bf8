"""The reward interface, tested with a reward that is the sum of its inputs: defaults, labels and slow features by hand."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pcil.errors import InputError
from pcil.nets.networks import Trunk
from pcil.rewards import Inputs, Reward, label
from pcil.rewards.base import SlowFeatures
from pcil.types import Batch

KEY = jax.random.key(0)
EMBED = Trunk.init(2, 3, key=KEY)


@dataclass(frozen=True)
class Sum(Reward):
    """The sum of the state's number, ten times the observation's first entry and a hundred times the action's first entry."""

    inputs: Inputs = "state"
    begins_with: int = 0

    @property
    def prefill(self) -> tuple[int, float]:
        return self.begins_with, 1.0

    def init(self, demos: Any, embed: Any, *, key: Any) -> Any:
        raise AssertionError

    def update(self, state: Any, expert: Any, agent: Any, embed: Any, *, key: Any) -> Any:
        raise AssertionError

    def reward(self, state: Any, batch: Batch, embed: Any, *, key: Any) -> Any:
        assert embed is EMBED and key is KEY and all(array.ndim == 2 for array in batch[:3])
        obs = batch.next_obs if self.inputs == "state" else batch.obs
        return state + 10 * obs[:, 0] + 100 * batch.action[:, 0]


class Bare(Reward):
    """A reward with only the defaults of the interface."""

    init = update = reward = None  # type: ignore[assignment]


def test_what_a_reward_is_that_says_nothing() -> None:
    bare = Bare()
    assert (bare.scope, bare.takes_padding, bare.needs_demos) == ("step", False, True)
    assert (bare.task_weight, bare.batch_size) == (0, 128)
    assert (bare.trunk, bare.span, bare.prefill) == ("critic", 1, (0, 0.0))
    assert not bare.needs_actions
    state = object()
    batch = Batch.of(jnp.zeros((4, 2)), jnp.zeros((3, 1)))
    assert bare.after_episode(state, batch, EMBED, key=KEY) is state
    assert bare.representation(state, batch, EMBED) is None


def test_actions_are_needed_where_pairs_are_read_or_the_replay_begins_with_them() -> None:
    assert Sum(inputs="state-action").needs_actions and Sum(begins_with=1).needs_actions
    assert Sum(inputs="state-action", begins_with=5).needs_actions
    assert not Sum().needs_actions and not Sum(inputs="transition").needs_actions


def test_settings_that_every_reward_has_are_checked() -> None:
    for changes in ({"batch_size": -1}, {"batch_size": True}, {"task_weight": float("nan")}):
        with pytest.raises(InputError, match=next(iter(changes))):
            dataclasses.replace(Sum(), **changes)
    assert Sum(batch_size=0, task_weight=-3.0).task_weight == -3


def test_the_steps_between_states_begin_in_all_but_the_last_and_lead_to_all_but_the_first() -> None:
    obs, action = np.arange(24, dtype=np.float32).reshape(2, 4, 3), np.zeros((2, 3, 1), np.float32)
    batch = Batch.of(obs, action, 1, 2)
    assert batch.next_obs[..., 0].tolist() == [[3, 6, 9], [15, 18, 21]]
    assert batch.obs[..., 0].tolist() == [[0, 3, 6], [12, 15, 18]]
    assert batch.action is action and batch[3:] == (1, 2)
    assert [array.tolist() for array in batch.first[:3]] == [obs[:, 0].tolist(), [[0], [0]], obs[:, 1].tolist()]


@pytest.mark.parametrize(("inputs", "states"), [("state", [[3, 5], [9, 11]]), ("state-action", [[1, 3], [7, 9]])])
@pytest.mark.parametrize("weight", [0.0, 0.5, -2.0])
def test_labels_by_hand(inputs: Any, states: list[list[float]], weight: float) -> None:
    """Two windows of two steps, whose three states begin with 1, 3, 5 and 7, 9, 11."""
    obs = jnp.arange(1.0, 13).reshape(2, 3, 2)
    action, paid = jnp.array([[[0.1], [0.2]], [[0.3], [0.4]]]), jnp.array([[1.0, 2.0], [3.0, 4.0]])
    got = label(Sum(inputs=inputs, task_weight=weight), jnp.float32(1000), Batch.of(obs, action), paid, EMBED, key=KEY)
    expected = 1000 + 10 * np.array(states) + [[10, 20], [30, 40]] + weight * np.array([[1, 2], [3, 4]])
    assert got.shape == (2, 2) and np.allclose(got, expected)
    flat = label(
        Sum(inputs=inputs, task_weight=weight), jnp.float32(1000), Batch.of(obs[0], action[0]), paid[0], EMBED, key=KEY
    )
    assert np.allclose(flat, expected[0]), "one episode has no dimension before its steps"


def test_slow_features_are_renewed_when_their_turn_has_come_and_not_between() -> None:
    trunks = [jax.tree.map(lambda leaf, i=i: jnp.full_like(leaf, i), EMBED) for i in range(8)]
    slow = SlowFeatures.init(trunks[0])
    held = [(float(slow.embed.weight[0, 0]), int(slow.updates))]
    for trunk in trunks[1:]:
        slow = slow.update(trunk, 3)
        held.append((float(slow.embed.weight[0, 0]), int(slow.updates)))
    assert held == [(0, 0), (0, 1), (0, 2), (3, 3), (3, 4), (3, 5), (6, 6), (6, 7)]
    assert np.array_equal(slow.embed(np.ones((1, 2), np.float32)), trunks[6](np.ones((1, 2), np.float32)))


def test_slow_features_are_a_copy_which_outlives_what_it_was_made_of() -> None:
    first = jax.tree.map(jnp.copy, EMBED)
    slow = SlowFeatures.init(first)
    for leaf in jax.tree.leaves(first):
        leaf.delete()
    assert np.array_equal(slow.embed.weight, EMBED.weight)


def test_every_so_manyth_step_of_each_demonstration_is_used() -> None:
    def demo(steps: int) -> Batch:
        t = jnp.arange(steps, dtype=jnp.float32)[:, None]
        return Batch(t, -t, t + 0.5)

    kept = Sum(subsampling=5).subsampled([demo(12), demo(11), demo(2), demo(2)])
    assert [part.obs[:, 0].tolist() for part in kept] == [[0, 5, 10], [1, 6], [1], [1]]
    assert all(np.array_equal(part.action, -part.obs) and np.array_equal(part.next_obs, part.obs + 0.5) for part in kept)
    assert [len(part.obs) for part in Sum().subsampled([demo(12), demo(3)])] == [12, 3]
