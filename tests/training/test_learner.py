"""The order of a step and the schedules of a run, tested with an agent and a reward that only record their inputs.

`Recorder` is a reward and `Scribe` an agent. The state of each counts its updates, so every value computed from a state shows
how old that state was.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pcil import envs, seeds
from pcil.agents import Agent
from pcil.nets.networks import Actor, Trunk
from pcil.rewards import Reward
from pcil.seeds import Stream
from pcil.training import collect, learner, loop
from pcil.training.config import Algorithm, Run
from pcil.training.learner import Learner
from pcil.training.state import State, start
from pcil.types import Batch, Episode, Spec, Window
from small import POINT_MASS, random_batch, small_run, windows

OBS, ACTION = 2, 2
SPEC = Spec(OBS, ACTION, 1)
DEMOS = [Episode(random_batch(21, OBS, ACTION).obs, random_batch(20, OBS, ACTION).action, np.zeros(20))]


def marked(number: Any) -> Actor:
    """An actor whose every weight is `number`."""
    shape = jax.tree.map(jnp.zeros_like, Actor.init(OBS, ACTION, 1, 1, key=jax.random.key(0)))
    return jax.tree.map(lambda x: x + jnp.float32(number), shape)


def draw(key: Any) -> jnp.ndarray:
    return jax.random.uniform(key)


@dataclass(frozen=True)
class Recorder(Reward):
    """Labels each step with the updates of its own state, those of the features, or a random draw, in turn."""

    batch_size: int = 3

    def init(self, demos: Any, embed: Trunk, *, key: Any) -> dict[str, Any]:
        del demos, embed
        expert, agent = (jnp.zeros((self.batch_size, OBS)) for _ in range(2))
        return {"updates": jnp.float32(0), "draw": draw(key), "expert": expert, "agent": agent, "features": jnp.float32(-1)}

    def update(self, state: Any, expert: Batch, agent: Batch, embed: Any, *, key: Any) -> tuple[dict[str, Any], Any]:
        rows = {"expert": expert.obs[:, 0], "agent": agent.obs[:, 0], "features": embed.weight[0, 0]}
        return {"updates": state["updates"] + 1, "draw": draw(key), **rows}, {"was": state["updates"]}

    def reward(self, state: Any, batch: Batch, embed: Any, *, key: Any) -> jnp.ndarray:
        return jnp.resize(jnp.stack([state["updates"], embed.weight[0, 0], draw(key)]), len(batch.obs))


@dataclass(frozen=True)
class Scribe(Agent):
    """All weights of its networks equal the number of its updates; exploration draws `greed` numbers in each step."""

    batch_size: int = 6
    n_step: int = 1
    greed: int = 2
    cloning: bool = False
    acts: ClassVar[list[tuple[int, float, tuple[float, ...]]]] = []
    """Agent steps so far, updates of the actor, and random draws, for each requested action."""

    def init(self, spec: Spec, *, key: Any) -> dict[str, Any]:
        shapes = {"reward": (self.batch_size, self.n_step), "obs": (self.batch_size, self.n_step + 1, OBS)}
        given = {name: jnp.zeros(shape) for name, shape in shapes.items()}
        seen = {"observed": jnp.zeros(()), "cloned": jnp.zeros(())}
        return {"actor": marked(0), "draw": draw(key), "step": jnp.int32(-1), **given, **seen}

    @property
    def clones(self) -> bool:
        return self.cloning

    def observe(self, state: Any, obs: Any) -> Any:
        return {**state, "observed": jnp.sum(obs)}

    def clone(self, state: Any, cloned: Window) -> Any:
        return {**state, "cloned": state["observed"] + 1000 * jnp.sum(cloned.action)}

    def update(self, state: Any, window: Window, *, cloned: Any = None, step: Any, key: Any) -> tuple[dict[str, Any], Any]:
        assert (cloned is not None) == self.cloning
        actor = jax.tree.map(lambda x: x + 1, state["actor"])
        seen = {"reward": jnp.asarray(window.reward), "obs": jnp.asarray(window.obs)}
        after = {**state, "actor": actor, "draw": draw(key), "step": jnp.int32(step), **seen}
        return after, {"was": state["actor"].trunk.bias[0]}

    def actor(self, state: Any) -> Actor:
        return state["actor"]

    def trunk(self, state: Any, whose: Literal["critic", "actor"]) -> Trunk:
        return state["actor"].trunk

    def explorer(self, action_dim: int, rng: np.random.Generator) -> Callable[..., np.ndarray]:
        def act(actor: Actor, obs: np.ndarray, step: int) -> np.ndarray:
            self.acts.append((step, float(actor.trunk.bias[0]), tuple(rng.random(self.greed))))
            return np.full(action_dim, 0.5, np.float32)

        return act


@pytest.fixture(autouse=True)
def _nothing_written_yet() -> None:
    Scribe.acts.clear()


# --- The order of a step ---


def rows(seed: int, number: int, n: int = 1) -> Window:
    window = windows(random_batch(number + n, OBS, ACTION, seed), n)
    return window._replace(reward=np.arange(window.reward.size, dtype=np.float32).reshape(window.reward.shape) + 100)


WINDOW, EXPERT, LONGER = rows(1, 6), rows(2, 3), rows(3, 3)


def after(label: Literal["sampled", "stored"], updates: int = 1, longer: Window | None = None) -> Learner:
    """The learner after some updates on the same windows; update `i` is at agent step `10 i`."""
    method = Algorithm(Scribe(), Recorder(), label)
    state = learner.init(method, SPEC, [random_batch(5, OBS, ACTION)], 0)
    for i in range(updates):
        state, actor = learner.update(method, state, WINDOW, EXPERT, longer, np.int32(10 * i), np.int32(i))
        assert float(actor.trunk.bias[0]) == i + 1, "the returned actor is the one after the update"
    return state


@pytest.mark.parametrize("updates", [1, 2])
def test_labels_are_of_the_reward_after_its_update_and_of_the_features_before_the_agents(updates: int) -> None:
    state = after("sampled", updates)
    labels = np.asarray(state.agent["reward"]).ravel()
    assert labels[0] == labels[3] == updates, "labels use the reward's state after this update"
    assert labels[1] == labels[4] == updates - 1, "and features from before it"
    assert state.reward["features"] == updates - 1, "the reward is trained on these features too"
    assert state.reward["updates"] == state.agent["actor"].trunk.bias[0] == updates
    assert state.agent["step"] == 10 * (updates - 1)


def test_the_agent_learns_from_fresh_labels_or_from_stored_ones_and_from_all_else_as_it_was_drawn() -> None:
    for label in ("sampled", "stored"):
        agent = after(label).agent
        assert np.array_equal(agent["reward"], WINDOW.reward) == (label == "stored")
        assert np.array_equal(agent["obs"], WINDOW.obs)


def test_the_reward_learns_from_the_experts_rows_and_the_first_rows_of_the_window_or_rows_of_its_own() -> None:
    state = after("stored").reward
    assert np.array_equal(state["expert"], EXPERT.obs[:, 0]) and np.array_equal(state["agent"], WINDOW.obs[:3, 0])
    assert np.array_equal(after("stored", longer=LONGER).reward["agent"], LONGER.obs[:, 0])


def test_reward_label_and_agent_draw_from_three_keys_of_the_update_and_no_two_updates_share_one() -> None:
    """The key of update `i` is folded from the root key by stream and counter and split into three."""
    drawn = []
    for updates in (1, 2, 3):
        state = after("sampled", updates)
        key = seeds.key(jax.random.key(0), Stream.UPDATE, updates - 1)
        expected = [float(draw(k)) for k in jax.random.split(key, 3)]
        got = [float(x) for x in (state.reward["draw"], state.agent["reward"].ravel()[2], state.agent["draw"])]
        assert got == expected
        drawn += got
    first = learner.init(Algorithm(Scribe(), Recorder(), "sampled"), SPEC, [random_batch(5, OBS, ACTION)], 0)
    drawn += [float(first.agent["draw"]), float(first.reward["draw"])]
    assert len(set(drawn)) == len(drawn)


def test_metrics_are_summed_under_the_name_of_who_gave_them() -> None:
    totals = {name: float(value) for name, value in after("sampled", 3).totals.items() if name != "finite"}
    assert totals == {"agent/was": 0 + 1 + 2, "reward/was": 0 + 1 + 2, "updates": 3}


@pytest.mark.parametrize("cloning", [False, True])
def test_an_agent_observes_what_it_clones_beside_what_it_has_seen(cloning: bool) -> None:
    """It observes before it learns, in an update and in one of cloning alone, which only the agent takes part in."""
    method, cloned = Algorithm(Scribe(cloning=cloning), Recorder(), "sampled"), rows(4, 6)
    before = learner.init(method, SPEC, [random_batch(5, OBS, ACTION)], 0)
    own, other = float(WINDOW.obs[:, 0].sum()), float(cloned.obs[:, 0].sum())
    given = [cloned] if cloning else []
    after, _ = learner.update(method, before, WINDOW, EXPERT, None, np.int32(0), np.int32(0), *given)
    assert float(after.agent["observed"]) == pytest.approx(own + other * cloning, abs=1e-4)
    if cloning:
        again = learner.clone(method, after, WINDOW, cloned)
        assert float(again.agent["cloned"]) == pytest.approx(own + other + 1000 * cloned.action.sum(), rel=1e-5)
        assert float(again.reward["updates"]) == float(again.totals["updates"]) == 1


# --- Random draws of the loop ---


def recorded(**changes: Any) -> Run:
    settings = {"agent": Scribe(), "reward": Recorder(), "random_frames": 0, "seed_frames": 0, "frames": 1000, **changes}
    return dataclasses.replace(small_run(), **settings)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The windows, expert rows and counters of every update in the loop."""
    updates: list[dict[str, Any]] = []
    real = learner.update

    def update(
        method: Algorithm, state: Learner, window: Any, expert: Any, longer: Any, step: Any, count: Any, cloned: Any
    ) -> Any:
        names = {"window": window, "expert": expert, "longer": longer, "cloned": cloned}
        updates.append({**names, "step": int(step), "count": int(count)})
        return real(method, state, window, expert, longer, step, count, cloned)

    monkeypatch.setattr(learner, "update", update)
    return updates


def play(run: Run, episodes: int = 2, action_repeat: int = 1) -> State:
    """Play and store whole episodes of 50 steps on the point mass, as the loop does."""
    env, spec = envs.make(POINT_MASS), SPEC._replace(action_repeat=action_repeat)
    state = start(run, spec, DEMOS)
    for _ in range(episodes):
        (episode,) = collect.play(run, [env], spec, state)
        state.replay.add(episode, episode.reward)
    return state


def same(one: Window, two: Window) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, two, strict=True))


def test_how_much_an_agent_draws_to_act_changes_nothing_that_is_sampled(drawn: list[dict[str, Any]]) -> None:
    """The actions are the same, and so is the replay; only more numbers are drawn from the generator for acting."""
    sampled = []
    for greed in (0, 2, 7):
        drawn.clear()
        play(recorded(agent=Scribe(greed=greed)))
        sampled.append(list(drawn))
    assert len(sampled[0]) == 25
    for other in sampled[1:]:
        assert all(same(a[name], b[name]) for a, b in zip(sampled[0], other, strict=True) for name in ("window", "expert"))


def test_how_much_is_sampled_changes_nothing_that_is_drawn_to_act(drawn: list[dict[str, Any]]) -> None:
    """With twice as many windows in an update, or with no updates, exploration draws the numbers of its own stream."""
    for changes in ({}, {"agent": Scribe(batch_size=12)}, {"seed_frames": 200}):
        play(recorded(**changes))
        for episode in range(2):
            rng = seeds.rng(1, Stream.ACT, episode)
            expected = [tuple(rng.random(2)) for _ in range(50)]
            assert [draws for _, _, draws in Scribe.acts[50 * episode : 50 * (episode + 1)]] == expected


def test_windows_and_expert_rows_are_drawn_from_the_episodes_own_stream(drawn: list[dict[str, Any]]) -> None:
    run = recorded(update_every=3)
    play(run, episodes=1)
    assert drawn == [], "no window before the first episode is stored"
    state = play(run, episodes=2)
    drawn.clear()
    collect.play(run, [envs.make(POINT_MASS)], SPEC, state)
    rng, expert = seeds.rng(1, Stream.SAMPLE, 2), state.expert
    assert expert is not None and len(drawn) == 16
    for update in drawn:
        assert same(update["window"], state.replay.sample(rng, 6, 1)) and same(update["expert"], expert.sample(rng, 3, 1))
        assert update["longer"] is None and update["cloned"] is None


@pytest.mark.parametrize("repeat", [1, 2])
def test_updates_wait_for_the_seed_frames_and_come_every_so_many_steps(repeat: int, drawn: list[dict[str, Any]]) -> None:
    """Frames are agent steps times the action repeat; the reward's and the agent's counters are the update's number."""
    play(recorded(seed_frames=70 * repeat, update_every=4), episodes=3, action_repeat=repeat)
    assert [update["step"] for update in drawn] == [step for step in range(50, 150) if step >= 70 and step % 4 == 0]
    assert [update["count"] for update in drawn] == list(range(len(drawn)))


@pytest.mark.parametrize("repeat", [1, 2])
def test_actions_are_uniform_for_the_random_frames_and_the_agents_after_them(repeat: int) -> None:
    """The uniform actions come from the stream for acting."""
    state = play(recorded(random_frames=30 * repeat, seed_frames=150 * repeat), episodes=1, action_repeat=repeat)
    assert [step for step, _, _ in Scribe.acts] == list(range(30, 50))
    held, rng = state.replay.state()["action"], seeds.rng(1, Stream.ACT, 0)
    assert np.array_equal(held[:30], np.stack([rng.uniform(-1, 1, ACTION).astype(np.float32) for _ in range(30)]))
    assert (held[30:50] == 0.5).all() and state.counters.frames == 50 * repeat


def test_acting_is_by_the_actor_that_the_last_update_left(drawn: list[dict[str, Any]]) -> None:
    """The update of a step is dispatched after its action was chosen, so it first affects the action of the next step."""
    play(recorded(update_every=2), episodes=2)
    for step, updates, _ in Scribe.acts:
        assert updates == sum(update["step"] < step for update in drawn), step


@pytest.mark.parametrize("label", ["sampled", "stored"])
def test_the_replay_keeps_the_tasks_rewards_or_the_labels_of_when_the_episode_ended(label: str, tmp_path: Path) -> None:
    """A stored label is computed by the networks at the end of its episode, after all of its updates."""
    run = recorded(label=label, frames=150, evaluate_every=150)
    held = loop.train_loop(run, tmp_path, DEMOS).replay.state()
    paid, obs = held["reward"].reshape(3, 51), held["obs"].reshape(3, 51, OBS)
    if label == "sampled":
        assert np.allclose(paid[:, :-1], 1 - np.linalg.norm(obs[:, 1:], axis=-1), atol=1e-5)
    else:
        assert (paid[:, [0, 1, 48, 49]] == np.array([[0], [25], [50]])).all()
