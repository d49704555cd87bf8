"""Labels of whole episodes, and the reports of values that are not finite, by hand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_learner import SPEC, Recorder, Scribe, draw, marked

from pcil import seeds
from pcil.rewards import Reward
from pcil.seeds import Stream
from pcil.training import learner
from pcil.training.config import Algorithm
from pcil.training.learner import Learner
from pcil.types import Batch, Episode, Spec
from small import random_batch


@dataclass(frozen=True)
class Listener(Reward):
    """A reward of whole episodes that notes rows, sums and a draw at the end; a step's reward combines its row and the note."""

    scope: ClassVar[Literal["step", "episode"]] = "episode"
    padded: bool = False
    batch_size: int = 0

    @property
    def takes_padding(self) -> bool:
        return self.padded

    @property
    def trunk(self) -> Literal["critic", "actor"]:
        return "actor"

    def init(self, demos: Any, embed: Any, *, key: Any) -> Any:
        return {"rows": jnp.int32(0), "sum": jnp.float32(0), "draw": jnp.float32(0), "features": jnp.float32(0)}

    def update(self, state: Any, expert: Any, agent: Any, embed: Any, *, key: Any) -> Any:
        return state, {}

    def after_episode(self, state: Any, batch: Batch, embed: Any, *, key: Any) -> Any:
        there = ~jnp.isnan(batch.action[:, 0])
        total = jnp.sum(jnp.where(there, batch.next_obs[:, 0], 0))
        return {"rows": jnp.int32(len(batch.obs)), "sum": total, "draw": draw(key), "features": embed.weight[0, 0]}

    def reward(self, state: Any, batch: Batch, embed: Any, *, key: Any) -> Any:
        return jnp.where(draw(key) == state["draw"], batch.next_obs[:, 0] + state["sum"], -1.0)


def episode(steps: int) -> Episode:
    """An episode with observation `t` in step `t` and reward `100 t`."""
    obs = np.stack([np.arange(steps + 1), np.zeros(steps + 1)], axis=1).astype(np.float32)
    return Episode(obs, np.full((steps, 2), 0.25, np.float32), 100.0 * np.arange(steps))


def started(reward: Reward, label: Literal["sampled", "stored"] = "stored") -> tuple[Algorithm, Learner]:
    method = Algorithm(Scribe(), reward, label)
    return method, learner.init(method, SPEC, [random_batch(5, 2, 2)], 3)


STEPWISE = Recorder()


@pytest.mark.parametrize(
    ("reward", "steps", "rows"),
    [
        *((STEPWISE, steps, rows) for steps, rows in ((1, 256), (255, 256), (256, 256), (257, 512))),
        (Listener(padded=True), 50, 256),
        (Listener(padded=False), 50, 50),
    ],
    ids=str,
)
def test_an_episode_is_lengthened_where_that_makes_no_difference(reward: Reward, steps: int, rows: int) -> None:
    """It is padded with its last state, NaN actions and rewards of 0."""
    given = episode(steps)
    obs, action, paid = learner._padded(started(reward)[0], given)
    assert obs.shape == (rows + 1, 2) and action.shape == (rows, 2) and paid.shape == (rows,)
    assert np.array_equal(obs[: steps + 1], given.obs) and (obs[steps:, 0] == steps).all()
    assert np.array_equal(action[:steps], given.action) and np.isnan(action[steps:]).all()
    assert np.array_equal(paid[:steps], given.reward) and not paid[steps:].any()
    assert obs.dtype == action.dtype == paid.dtype == np.float32


def test_the_labels_of_an_episode_are_as_many_as_its_steps_and_drawn_from_its_own_key() -> None:
    method, state = started(Recorder(task_weight=0.5))
    for count in (0, 7):
        got = learner.label_episode(method, state, episode(5), count)
        drawn = float(draw(seeds.key(jax.random.key(3), Stream.LABEL, count)))
        assert got.shape == (5,) and got.dtype == np.float32
        assert np.allclose(got, np.array([0, 0, drawn, 0, 0]) + 0.5 * 100 * np.arange(5))


@pytest.mark.parametrize("padded", [False, True])
def test_a_reward_takes_note_of_an_episode_before_it_is_labelled_with_the_same_rows_and_key(padded: bool) -> None:
    method, state = started(Listener(padded=padded))
    state = Learner({**state.agent, "actor": marked(4)}, state.reward, state.root, state.totals)
    after = learner.close_episode(method, state, episode(5), 7)
    drawn = draw(seeds.key(jax.random.key(3), Stream.LABEL, 7))
    assert after.reward["rows"] == (256 if padded else 5) and after.reward["draw"] == drawn and after.reward["features"] == 4
    assert after.reward["sum"] == 1 + 2 + 3 + 4 + 5, "the states that the steps led to"
    assert after.agent is state.agent and after.root is state.root and after.totals is state.totals
    assert learner.label_episode(method, after, episode(5), 7).tolist() == [16, 17, 18, 19, 20]
    assert (learner.label_episode(method, after, episode(5), 8) == -1).all(), "each episode has its own key"


def test_a_reward_that_takes_no_note_leaves_the_learner_as_it_is() -> None:
    method, state = started(STEPWISE)
    assert learner.close_episode(method, state, episode(5), 0) is state


# --- The first state ---


@dataclass(frozen=True)
class Watcher(Scribe):
    """Records the rows that it observes, and has separate trunks for critic and actor."""

    def init(self, spec: Spec, *, key: Any) -> dict[str, Any]:
        return super().init(spec, key=key) | {"told": jnp.float32(0), "rows": jnp.int32(0)}

    def observe(self, state: Any, obs: Any) -> Any:
        return state | {"told": state["told"] + jnp.sum(obs), "rows": state["rows"] + len(obs)}

    def update(self, state: Any, window: Any, *, step: Any, key: Any) -> Any:
        after, metrics = super().update(state, window, step=step, key=key)
        return after | {"told": state["told"], "rows": state["rows"]}, metrics

    def trunk(self, state: Any, whose: Literal["critic", "actor"]) -> Any:
        return marked(5 if whose == "critic" else 6).trunk


def test_an_agent_is_told_of_every_state_of_the_demonstrations_and_then_of_the_first_ones_of_each_window() -> None:
    method, demos = Algorithm(Watcher(), STEPWISE, "stored"), [random_batch(5, 2, 2, 1), random_batch(8, 2, 2, 2)]
    state = learner.init(method, SPEC, demos, 0)
    total = sum(float(demo.obs.sum()) for demo in demos)
    assert state.agent["rows"] == 13 and np.isclose(state.agent["told"], total, atol=1e-5)
    nobody = learner.init(method, SPEC, [], 0)
    assert nobody.agent["rows"] == 0
    window = learner._zeros(SPEC, 6, 1)._replace(obs=jnp.stack([jnp.full((6, 2), 1.0), jnp.full((6, 2), 9.0)], axis=1))
    expert = learner._zeros(SPEC, 3, 1)
    after, _ = learner.update(method, nobody, window, expert, None, np.int32(0), np.int32(0))
    assert after.agent["rows"] == 6 and after.agent["told"] == 12


def test_the_features_are_of_whom_the_reward_asks_for_and_have_no_gradient() -> None:
    for reward, mark in ((STEPWISE, 5), (Listener(), 6)):
        embed = learner.frozen_embed(Algorithm(Watcher(), reward, "stored"), {})
        assert float(embed.weight[0, 0]) == mark

    def through(weight: Any) -> Any:
        agent = {"actor": jax.tree.map(lambda leaf: leaf * weight, marked(1))}
        return jnp.sum(learner.frozen_embed(Algorithm(Scribe(), STEPWISE, "stored"), agent).weight)

    assert through(2.0) != 0 and jax.grad(through)(2.0) == 0


def test_a_learner_begins_with_keys_of_its_seed_and_with_zeros_for_each_metric() -> None:
    _, state = started(STEPWISE)
    root = jax.random.key(3)
    assert np.array_equal(state.root, jax.random.key_data(root))
    assert state.agent["draw"] == draw(seeds.key(root, Stream.INIT_AGENT, 0))
    assert state.reward["draw"] == draw(seeds.key(root, Stream.INIT_REWARD, 0))
    assert state.totals.keys() == {"agent/was", "reward/was", "updates", "finite"}
    assert state.totals["finite"].tolist() == [0] * 5 and all(not np.any(total) for total in state.totals.values())


# --- Values that are not finite ---


def test_checks_are_in_the_order_of_an_update() -> None:
    names = ["updates", "agent/b", "finite", "reward/z", "agent/a", "reward/c", "actor", "rewards", "features"]
    ordered = ["features", "reward/c", "reward/z", "rewards", "agent/a", "agent/b", "actor"]
    assert learner.checks(names) == learner.checks(ordered) == ordered
    assert learner.checks([]) == ["features", "rewards", "actor"]


def test_the_largest_of_a_tree_is_by_size_and_is_not_finite_where_any_is_not() -> None:
    tree = {"a": jnp.array([1.0, -7.0]), "b": jnp.array([[3.0]])}
    assert learner._largest(tree) == 7
    for bad in (jnp.nan, jnp.inf, -jnp.inf):
        assert not np.isfinite(learner._largest(tree | {"b": jnp.array([bad, 0.0])}))
        assert not np.isfinite(learner._largest({"c": jnp.array(bad)} | tree))


def counted(updates: int, finite: list[int], agent: Any = 1.0) -> Learner:
    """A learner whose checks are features, reward/a, reward/b, rewards, agent/c, agent/d and actor."""
    names = ["reward/a", "reward/b", "agent/c", "agent/d"]
    totals = {name: jnp.zeros(()) for name in names} | {
        "updates": jnp.float32(updates),
        "finite": jnp.array(finite, jnp.float32),
    }
    return Learner({"w": jnp.float32(agent), "count": jnp.int32(1)}, {"v": jnp.zeros(2)}, jnp.zeros(2, jnp.uint32), totals)


@pytest.mark.parametrize(
    ("finite", "found"),
    [
        ([5, 5, 5, 5, 5, 5, 5], None),
        ([5, 5, 5, 5, 5, 5, 4], ("the actor's parameters", 4)),
        ([5, 5, 5, 5, 2, 5, 4], ("agent/c", 2)),
        ([5, 5, 5, 5, 2, 2, 2], ("agent/c and agent/d", 2)),
        ([5, 3, 3, 3, 3, 3, 3], ("reward/a and reward/b", 3)),
        ([5, 5, 5, 0, 0, 0, 0], ("the rewards of the batch", 0)),
        ([3, 3, 3, 3, 3, 3, 3], ("the agent's parameters", 2)),
        ([3, 5, 5, 5, 5, 5, 5], ("the agent's parameters", 2)),
    ],
)
def test_what_was_first_is_named_and_losses_of_one_part_together(finite: list[int], found: Any) -> None:
    """Features that are not finite were caused by the previous update."""
    assert learner.first_not_finite(counted(5, finite)) == found


def test_parameters_are_named_where_nothing_else_was_wrong() -> None:
    for bad in (np.nan, np.inf):
        assert learner.first_not_finite(counted(5, [5] * 7, bad)) == ("the parameters agent.w", 4)
    assert learner.first_not_finite(counted(5, [5, 5, 5, 5, 2, 5, 5], np.nan)) == ("agent/c", 2)


def test_the_updates_before_the_first_that_was_not_finite_are_counted() -> None:
    """Later updates do not count, finite or not."""
    method, state = started(Recorder(batch_size=3), "stored")
    window, expert = learner._zeros(SPEC, 6, 1), learner._zeros(SPEC, 3, 1)
    rewards = [0.0, 1.0, np.nan, 0.0, np.inf]
    got = []
    for i, reward in enumerate(rewards):
        given = window._replace(reward=jnp.full((6, 1), reward))
        state, _ = learner.update(method, state, given, expert, None, np.int32(i), np.int32(i))
        got.append(dict(zip(learner.checks(state.totals), state.totals["finite"].tolist(), strict=True)))
    assert [counts["rewards"] for counts in got] == [1, 2, 2, 2, 2]
    assert all(counts["features"] == counts["actor"] == counts["agent/was"] == i + 1 for i, counts in enumerate(got))
    assert state.totals["updates"] == 5 and learner.first_not_finite(state) == ("the rewards of the batch", 2)


def test_a_copy_outlives_the_update_that_overwrites_the_learner() -> None:
    method, state = started(STEPWISE)
    kept = learner.copied(state)
    before = [np.asarray(leaf) for leaf in map(np.array, jax.tree.leaves(kept))]
    learner.update(method, state, learner._zeros(SPEC, 6, 1), learner._zeros(SPEC, 3, 1), None, np.int32(0), np.int32(0))
    assert all(np.array_equal(a, b) for a, b in zip(before, jax.tree.leaves(kept), strict=True))


def test_without_demonstrations_drawn_the_reward_is_given_no_rows_of_them() -> None:
    method, state = started(Listener())
    shapes: list[Any] = []

    class Noting(Listener):
        def update(self, state: Any, expert: Any, agent: Any, embed: Any, *, key: Any) -> Any:
            shapes.append((expert.obs.shape, agent.obs.shape))
            return state, {}

    method = Algorithm(Scribe(), Noting(batch_size=2), "stored")
    state = learner.init(method, SPEC, [random_batch(5, 2, 2)], 3)
    learner.update(method, state, learner._zeros(SPEC, 6, 1), None, None, np.int32(0), np.int32(0))
    assert shapes[-1] == ((0, 1, 2), (2, 1, 2))


def test_batches_of_nothing_have_the_shapes_of_real_ones() -> None:
    zeros = learner._zeros(Spec(3, 2, 1), 4, 5)
    assert [array.shape for array in zeros] == [(4, 6, 3), (4, 5, 2), (4, 5), (4, 5), (4,)]
    assert not any(np.any(array) for array in zeros) and isinstance(random_batch(2, 3, 2), Batch)
