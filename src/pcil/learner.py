"""What learns, and `update`, the one compiled step: first the reward, then the agent."""

from __future__ import annotations

import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray

from pcil import seeds
from pcil.config import Method
from pcil.losses import pearson
from pcil.networks import Actor
from pcil.rewards import label
from pcil.seeds import Stream
from pcil.types import Batch, Spec, Window


class Learner(eqx.Module):
    """Everything that the compiled step changes."""

    agent: Any
    reward: Any
    root: PRNGKeyArray
    """Key data; every key is folded from it and a counter."""
    totals: dict[str, Array]
    """Sums of the metrics since they were last read, and under "updates" how many."""


@functools.partial(jax.jit, static_argnames=("method", "spec"))
def init(method: Method, spec: Spec, demos: Batch, seed: int | Array) -> Learner:
    """The state before the first update."""
    root = jax.random.key_data(jax.random.key(seed))
    key = jax.random.wrap_key_data(root)
    agent = method.agent.init(spec, key=seeds.key(key, Stream.INIT_AGENT, 0))
    reward = method.reward.init(demos, frozen_embed(method, agent), key=seeds.key(key, Stream.INIT_REWARD, 0))
    learner = Learner(agent, reward, root, {})
    n, rows = method.agent.n_step, method.agent.batch_size
    shapes = (n + 1, spec.obs_dim), (n, spec.action_dim), (n,), (n,)
    window = Window(*(jnp.zeros((rows, *shape)) for shape in shapes))
    expert = Batch(*(jnp.zeros((method.reward.batch_size, size)) for size in (spec.obs_dim, spec.action_dim)))
    metrics = jax.eval_shape(functools.partial(_step, method), learner, window, expert, jnp.int32(0), jnp.int32(0))[1]
    return eqx.tree_at(lambda s: s.totals, learner, {name: jnp.zeros(()) for name in [*sorted(metrics), "updates"]})


def frozen_embed(method: Method, agent: Any) -> Any:
    """The agent's features of an observation, through which no gradient flows."""
    return lambda obs: jax.lax.stop_gradient(method.agent.embed(agent, obs))


@functools.partial(jax.jit, static_argnames="method", donate_argnames="learner")
def update(method: Method, learner: Learner, window: Window, expert: Batch, step: Array, count: Array) -> tuple[Learner, Actor]:
    """One update of the reward, then of the agent; `step` counts agent steps and `count` updates, both from 0.

    The second result is a copy of the actor that stays valid while the next update overwrites the learner in place.
    """
    learner, metrics = _step(method, learner, window, expert, step, count)
    totals = {name: learner.totals[name] + value for name, value in {**metrics, "updates": 1.0}.items()}
    learner = eqx.tree_at(lambda s: s.totals, learner, totals)
    return learner, jax.tree.map(jnp.copy, method.agent.actor(learner.agent))


def _step(
    method: Method, learner: Learner, window: Window, expert: Batch, step: Array, count: Array
) -> tuple[Learner, dict[str, Array]]:
    key = seeds.key(jax.random.wrap_key_data(learner.root), Stream.UPDATE, count)
    reward_key, label_key, agent_key = jax.random.split(key, 3)
    embed = frozen_embed(method, learner.agent)
    rows = expert.obs.shape[0]
    seen = Batch(window.obs[:rows, 0], window.action[:rows, 0])
    reward_state, reward_metrics = method.reward.update(learner.reward, expert, seen, embed, key=reward_key)
    if method.label == "sampled":
        fresh = label(method.reward, reward_state, window.obs, window.action, window.reward, embed, key=label_key)
        window = window._replace(reward=fresh)
    agent_state, agent_metrics = method.agent.update(learner.agent, window, step=step, key=agent_key)
    metrics = {f"reward/{name}": value for name, value in reward_metrics.items()}
    metrics |= {f"agent/{name}": value for name, value in agent_metrics.items()}
    return Learner(agent_state, reward_state, learner.root, learner.totals), metrics


@functools.partial(jax.jit, static_argnames="method")
def label_episode(
    method: Method, learner: Learner, obs: Array, action: Array, task_reward: Array, count: Array
) -> tuple[Array, Array]:
    """The reward of each step of one whole episode, and its correlation with the environment's: the method's health."""
    key = seeds.key(jax.random.wrap_key_data(learner.root), Stream.LABEL, count)
    embed = frozen_embed(method, learner.agent)
    learned = label(method.reward, learner.reward, obs, action, task_reward, embed, key=key)
    return learned, pearson(learned, task_reward)
