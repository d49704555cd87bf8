"""One pass of the loop: episodes played while the agent learns, or, offline, updates on demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from pcil import envs, seeds
from pcil.envs.rollout import Rollout
from pcil.errors import InputError, RunError
from pcil.seeds import Stream
from pcil.training import learner
from pcil.training.config import Run
from pcil.training.metrics import described
from pcil.training.replay import Replay
from pcil.training.state import Counters, State, absorbed
from pcil.types import Episode, Spec

OFFLINE_STEPS = 500
"""Updates of an offline agent in one pass of the loop."""


class Labelled(NamedTuple):
    """A finished episode as the replay stores it, with the learned reward of each step."""

    episode: Episode
    reward: np.ndarray
    row: dict[str, Any]
    """Its metrics."""


def play(run: Run, environments: Sequence[envs.Checked], spec: Spec, state: State, *, learn: bool = True) -> list[Episode]:
    """Play one exploring episode in each environment, side by side: act, update, step. Without `learn`, nothing is updated.

    An update is dispatched between acting and stepping, so that the device works while the environments step.
    """
    counters = state.counters
    numbers = range(counters.episodes, counters.episodes + len(environments))
    act_rngs = [seeds.rng(run.seed, Stream.ACT, number) for number in numbers]
    sample_rng = seeds.rng(run.seed, Stream.SAMPLE, counters.episodes)
    starts = [seeds.episode_seed(run.seed, Stream.EPISODE, number) for number in numbers]
    rollout = Rollout(environments, starts, [f"training episode {number + 1}" for number in numbers])
    explorers = [run.agent.explorer(spec.action_dim, rng) for rng in act_rngs]
    actions = np.zeros((len(environments), spec.action_dim), np.float32)
    actor = None
    while rollout.playing:
        for i in rollout.playing:
            if counters.frames < run.random_frames:
                actions[i] = act_rngs[i].uniform(-1, 1, spec.action_dim)
            else:
                actor = actor or learner.on_host(state.actor)
                actions[i] = explorers[i](actor, rollout.obs[i], counters.steps)
            if learn and _update_due(run, state.replay, counters):
                counters, actor = _update(run, state, state.replay, counters, sample_rng), None
            counters = replace(counters, steps=counters.steps + 1, frames=counters.frames + spec.action_repeat)
        rollout.step(actions.copy())
    state.counters = replace(counters, episodes=numbers.stop)
    return rollout.episodes()


def study(run: Run, spec: Spec, state: State) -> list[Episode]:
    """Updates on the demonstrations alone, each of which counts as an agent step; no episode is played."""
    assert state.expert is not None
    counters = state.counters
    rng = seeds.rng(run.seed, Stream.SAMPLE, counters.episodes)
    for _ in range(OFFLINE_STEPS):
        counters = _update(run, state, state.expert, counters, rng)
        counters = replace(counters, steps=counters.steps + 1, frames=counters.frames + spec.action_repeat)
    state.counters = replace(counters, episodes=counters.episodes + 1)
    return []


def labelled(run: Run, state: State, episode: Episode, number: int) -> Labelled:
    """Label a finished episode with the current reward; `number` counts episodes from 1."""
    kept = absorbed(run, episode)
    state.learner = learner.close_episode(run.learner, state.learner, kept, number)
    reward = learner.label_episode(run.learner, state.learner, kept, number)
    if not np.isfinite(reward).all():
        step = int(np.argmin(np.isfinite(reward)))
        where = f"step {step + 1} of training episode {number} of {run.task}"
        raise RunError(f"The learned reward is {reward[step]} in {where}.")
    return Labelled(kept, reward, described(episode, reward))


def store(run: Run, state: State, ended: Sequence[Labelled]) -> None:
    """Put the episodes of a pass into the replay; `InputError` if updates are due then and no window fits into any episode."""
    for episode, reward, _ in ended:
        state.replay.add(episode, reward if run.label == "stored" else episode.reward)
    if ended and state.counters.frames >= run.seed_frames and not state.replay.num_windows(_window_steps(run)):
        raise InputError(
            f"Every episode of {run.task} so far is cut before the {_window_steps(run)} steps that an update needs; make its "
            "time limit longer, or agent.n_step smaller."
        )


def _update_due(run: Run, replay: Replay, counters: Counters) -> bool:
    return (
        counters.frames >= run.seed_frames
        and counters.steps % run.update_every == 0
        and replay.num_windows(_window_steps(run)) > 0
    )


def _window_steps(run: Run) -> int:
    """Steps of the longest windows that an update draws."""
    return max(run.agent.n_step, run.reward.span)


def _update(run: Run, state: State, replay: Replay, counters: Counters, rng: np.random.Generator) -> Counters:
    """Dispatch one update on samples of the replay and the demonstrations, and return the counters after it.

    Before the first one, an agent that clones is trained by behavioural cloning.
    """
    if run.agent.clones and counters.updates == 0:
        _clone(run, state, replay)
    rows, span = run.reward.batch_size, run.reward.span
    window = replay.sample(rng, run.agent.batch_size, run.agent.n_step)
    expert = state.expert.sample(rng, rows, span, run.reward.subsampling) if state.expert and rows else None
    longer = replay.sample(rng, rows, span) if span > run.agent.n_step else None
    cloned = state.expert.sample(rng, run.agent.batch_size, 1) if state.expert and run.agent.clones else None
    step, count = np.int32(counters.steps), np.int32(counters.updates)
    state.learner, state.actor = learner.update(run.learner, state.learner, window, expert, longer, step, count, cloned)
    return replace(counters, updates=counters.updates + 1)


def _clone(run: Run, state: State, replay: Replay) -> None:
    """Train the actor by behavioural cloning."""
    assert state.expert is not None
    rng = seeds.rng(run.seed, Stream.CLONE, 0)
    for _ in range(run.cloning_updates):
        window = replay.sample(rng, run.agent.batch_size, run.agent.n_step)
        cloned = state.expert.sample(rng, run.agent.batch_size, 1)
        state.learner = learner.clone(run.learner, state.learner, window, cloned)
