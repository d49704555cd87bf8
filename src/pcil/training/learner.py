"""What learns, and `update`, the one compiled step: first the reward, then the agent."""

from __future__ import annotations

import functools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from pcil import seeds
from pcil.agents import Actor
from pcil.rewards import Embed, label
from pcil.seeds import Stream
from pcil.training.config import Algorithm
from pcil.types import Batch, Episode, Spec, Window

UNSAID = {"features": "the agent's parameters", "rewards": "the rewards of the batch", "actor": "the actor's parameters"}
"""What an update checks besides its metrics, and how errors call it."""
LABEL_ROWS = 256
"""Episodes are labelled in multiples of so many rows."""


class Learner(eqx.Module):
    """Everything that the compiled step changes."""

    agent: Any
    reward: Any
    root: PRNGKeyArray
    """Key data; every key is folded from it and a counter."""
    totals: dict[str, Array]
    """Sums of the metrics since they were last read; under "updates" how many, and under "finite" `[checks]` how many before
    each of `checks(totals)` was first not finite."""


@functools.partial(jax.jit, static_argnames=("algorithm", "spec"))
def init(algorithm: Algorithm, spec: Spec, demos: Sequence[Batch], seed: int | Array) -> Learner:
    """The state before the first update; `demos` may be empty where nothing needs them."""
    root = jax.random.key_data(jax.random.key(seed))
    key = jax.random.wrap_key_data(root)
    agent = algorithm.agent.init(spec, key=seeds.key(key, Stream.INIT_AGENT, 0))
    if demos:
        agent = algorithm.agent.observe(agent, jnp.concatenate([demo.next_obs for demo in demos]))
    reward = algorithm.reward.init(demos, frozen_embed(algorithm, agent), key=seeds.key(key, Stream.INIT_REWARD, 0))
    learner = Learner(agent, reward, root, {})
    window = _zeros(spec, algorithm.agent.batch_size, max(algorithm.agent.n_step, algorithm.reward.span))
    expert = _zeros(spec, algorithm.reward.batch_size, algorithm.reward.span)
    cloned = _zeros(spec, algorithm.agent.batch_size, 1) if algorithm.agent.clones else None
    updated = functools.partial(_update, algorithm)
    after, _ = jax.eval_shape(updated, learner, window, expert, expert, jnp.int32(0), jnp.int32(0), cloned)
    return replace(learner, totals={name: jnp.zeros(total.shape) for name, total in after.totals.items()})


def _zeros(spec: Spec, rows: int, n: int) -> Window:
    """Windows with the shapes of real ones."""
    shapes = (n + 1, spec.obs_dim), (n, spec.action_dim), (n,), (n,)
    obs, action, reward, discount = (jnp.zeros((rows, *shape)) for shape in shapes)
    return Window(obs, action, reward, discount, jnp.zeros(rows, jnp.int32))


def frozen_embed(algorithm: Algorithm, agent: Any) -> Embed:
    """The agent's features of an observation, through which no gradient flows."""
    return jax.lax.stop_gradient(algorithm.agent.trunk(agent, algorithm.reward.trunk))


def _update(
    algorithm: Algorithm,
    learner: Learner,
    window: Window,
    expert: Window | None,
    longer: Window | None,
    step: Array,
    count: Array,
    cloned: Window | None = None,
) -> tuple[Learner, Actor]:
    """One update of the reward, then of the agent; `step` counts agent steps and `count` updates, both from 0.

    The reward learns from windows of the `expert`, None where no demonstrations are drawn, and from windows of the agent: from
    those that are `longer` than `window`, if it needs such, else from the first rows of `window`, as in the authors' code. An
    agent that clones also learns from the windows `cloned` of the demonstrations. The second result is a copy of the actor that
    stays valid while the next update overwrites the learner in place.
    """
    key = seeds.key(jax.random.wrap_key_data(learner.root), Stream.UPDATE, count)
    reward_key, label_key, agent_key = jax.random.split(key, 3)
    agent = _observed(algorithm, learner.agent, window, cloned)
    embed = frozen_embed(algorithm, agent)
    both = (
        steps(expert or Window(*(array[:0] for array in window))),
        steps(longer or Window(*(array[: algorithm.reward.batch_size] for array in window))),
    )
    reward_state, reward_metrics = algorithm.reward.update(learner.reward, *both, embed, key=reward_key)
    if algorithm.label == "sampled":
        fresh = label(algorithm.reward, reward_state, steps(window), window.reward, embed, key=label_key)
        window = window._replace(reward=fresh)
    unsaid = {"features": frozen_embed(algorithm, learner.agent), "rewards": window.reward}
    demonstrated = {"cloned": cloned} if algorithm.agent.clones else {}
    agent_state, agent_metrics = algorithm.agent.update(agent, window, **demonstrated, step=step, key=agent_key)
    metrics = {f"reward/{name}": value for name, value in reward_metrics.items()}
    metrics |= {f"agent/{name}": value for name, value in agent_metrics.items()}
    metrics |= {name: _largest(tree) for name, tree in unsaid.items()}
    actor = algorithm.agent.actor(agent_state)
    metrics["actor"] = _largest(actor)
    return Learner(agent_state, reward_state, learner.root, _added(learner.totals, metrics)), jax.tree.map(jnp.copy, actor)


@functools.partial(jax.jit, static_argnames="algorithm", donate_argnames="learner")
def clone(algorithm: Algorithm, learner: Learner, window: Window, cloned: Window) -> Learner:
    """One update of behavioural cloning before the first of `update`; `window` is what the agent has seen until then."""
    agent = _observed(algorithm, learner.agent, window, cloned)
    return replace(learner, agent=algorithm.agent.clone(agent, cloned))


def _observed(algorithm: Algorithm, agent: Any, window: Window, cloned: Window | None) -> Any:
    """The agent with its statistics updated. What it clones counts as much as what it has seen: statistics of the agent alone
    change quickly while it learns, and the cloned actor would become another function."""
    rows = window.obs[:, 0]
    if algorithm.agent.clones and cloned is not None:
        rows = jnp.concatenate([cloned.obs[:, 0], rows])
    return algorithm.agent.observe(agent, rows)


update = jax.jit(_update, static_argnames="algorithm", donate_argnames="learner")


def _added(totals: dict[str, Array], metrics: dict[str, Array]) -> dict[str, Array]:
    """The `totals` after one more update with these metrics; before the first one there may be none."""
    good = jnp.stack([jnp.isfinite(metrics[name]) for name in checks(metrics)])
    before = totals or dict.fromkeys([*metrics, "updates", "finite"], jnp.zeros(()))
    after = {name: before[name] + value for name, value in {**metrics, "updates": 1.0}.items() if name not in UNSAID}
    return after | {"finite": before["finite"] + jnp.where(good & (before["finite"] == before["updates"]), 1.0, 0.0)}


def steps(window: Window) -> Batch:
    """The steps of windows, as rewards are given them."""
    return Batch.of(*map(jnp.asarray, (window.obs, window.action, window.discount, window.episode_id)))


def _largest(tree: Any) -> Float[Array, ""]:
    """The largest absolute value; not finite where any is not."""
    return functools.reduce(jnp.maximum, (jnp.max(jnp.abs(leaf)) for leaf in jax.tree.leaves(tree)), jnp.zeros(()))


def checks(names: Iterable[str]) -> list[str]:
    """What is checked in each update, in the order in which an update computes it; `names` are those of metrics or totals."""
    own = sorted(set(names) - {"updates", "finite", *UNSAID})
    parts = [[name for name in own if name.startswith(part)] for part in ("reward/", "agent/")]
    return ["features", *parts[0], "rewards", *parts[1], "actor"]


def first_not_finite(learner: Learner) -> tuple[str, int] | None:
    """What left the finite range first, and after how many finite updates since the totals were last set to 0; None if all is
    finite. Several losses of one update are named together, and parameters where every loss was still finite."""
    totals = jax.device_get(learner.totals)
    names, counts, updates = checks(totals), totals["finite"].tolist(), int(totals["updates"])
    if (first := int(min(counts))) < updates:
        bad = [name for name, count in zip(names, counts, strict=True) if count == first]
        bad = [name for name in bad if name.partition("/")[0] == bad[0].partition("/")[0]]
        return " and ".join(UNSAID.get(name, name) for name in bad), first - (bad[0] == "features")
    arrays = eqx.filter({"agent": learner.agent, "reward": learner.reward}, eqx.is_inexact_array)
    for path, good in jax.tree_util.tree_flatten_with_path(_are_finite(arrays))[0]:
        if not good:
            return f"the parameters {jax.tree_util.keystr(path, simple=True, separator='.')}", updates - 1
    return None


@jax.jit
def _are_finite(arrays: Any) -> Any:
    return jax.tree.map(lambda array: jnp.isfinite(array).all(), arrays)


def acting(algorithm: Algorithm, learner: Learner) -> Actor:
    """A copy of the actor that stays valid while updates overwrite the learner in place."""
    return jax.tree.map(jnp.copy, algorithm.agent.actor(learner.agent))


def on_host(actor: Actor) -> Actor:
    """The actor's arrays in NumPy; waits until the update that makes them has finished."""
    return jax.tree.map(np.asarray, actor)


@jax.jit
def copied(learner: Learner) -> Learner:
    """A copy that stays valid while updates overwrite the learner in place."""
    return jax.tree.map(jnp.copy, learner)


def close_episode(algorithm: Algorithm, learner: Learner, episode: Episode, count: int) -> Learner:
    """The learner at the end of an episode, before the episode is labelled: a reward of whole episodes may take note of it."""
    if algorithm.reward.scope == "step":
        return learner
    return replace(learner, reward=_after_rows(algorithm, learner, *_padded(algorithm, episode)[:2], np.int32(count)))


@functools.partial(jax.jit, static_argnames="algorithm")
def _after_rows(algorithm: Algorithm, learner: Learner, obs: Array, action: Array, count: Array) -> Any:
    embed, key = frozen_embed(algorithm, learner.agent), _label_key(learner, count)
    return algorithm.reward.after_episode(learner.reward, Batch.of(obs, action), embed, key=key)


def label_episode(algorithm: Algorithm, learner: Learner, episode: Episode, count: int) -> Float[np.ndarray, " T"]:
    """The reward of each step of one whole episode."""
    return np.asarray(_label_rows(algorithm, learner, *_padded(algorithm, episode), np.int32(count)))[: len(episode)]


def _padded(algorithm: Algorithm, episode: Episode) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Observations, actions and true rewards of an episode, so that episodes of many lengths share a few compilations.

    A reward for which rows behind the end make no difference gets a multiple of `LABEL_ROWS` rows, with NaN for the actions
    that are not there; another one gets exactly the episode.
    """
    spare = -len(episode) % LABEL_ROWS if algorithm.reward.scope == "step" or algorithm.reward.takes_padding else 0
    obs = np.pad(episode.obs, ((0, spare), (0, 0)), mode="edge")
    action = np.pad(episode.action, ((0, spare), (0, 0)), constant_values=np.nan)
    return obs, action, np.pad(episode.reward.astype(np.float32), (0, spare))


@functools.partial(jax.jit, static_argnames="algorithm")
def _label_rows(algorithm: Algorithm, learner: Learner, obs: Array, action: Array, task_reward: Array, count: Array) -> Array:
    embed, key = frozen_embed(algorithm, learner.agent), _label_key(learner, count)
    return label(algorithm.reward, learner.reward, Batch.of(obs, action), task_reward, embed, key=key)


def _label_key(learner: Learner, count: Array) -> PRNGKeyArray:
    return seeds.key(jax.random.wrap_key_data(learner.root), Stream.LABEL, count)
