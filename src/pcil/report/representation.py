"""Rows of the representations that rewards have learned: the networks of a run folder on transitions of expert and agent."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pcil import compilation, envs, modules, seeds
from pcil.errors import WHOLE, InputError
from pcil.report.embedding import project
from pcil.report.load import Collection, EvalRow, Source, TransitionRow, flat, named, sort_key
from pcil.rewards import Reward
from pcil.seeds import Stream
from pcil.training import learner, loop, presets, runs
from pcil.training.config import REGISTRIES, Run, registered
from pcil.types import Episode

EXPERT_STEPS, AGENT_STEPS = 128, 256
"""As many transitions as the paper's Figure 4 has."""
NUMBERS = 2**28
"""At most so many numbers are restored of a run, as its settings ask for: 1 GiB."""


def add(found: Collection, trust: Sequence[str] = ()) -> None:
    """Rows of every run that has a representation into `found.transitions`, and a note of those that should have and have not.

    `trust` are the modules that the runs' files may name.
    """
    try:
        compilation.use_cache()
    except InputError as error:
        found.notes.append(f"The representations are left out: {error}")
        return
    refused: list[str] = []
    for name, source in found.sources.items():
        last = [row for row in found.rows if row[:4] == name][-1]
        try:
            found.transitions.extend(transitions(source, last, trust))
        except Exception as error:  # whatever a damaged folder or somebody's environment raises
            refused.append(named(source.folder, error))
    found.transitions.sort(key=sort_key)
    if refused:
        found.notes.append(f"The representation of {len(refused)} of {len(found.sources)} runs is left out: {refused[0]}")


def transitions(source: Source, row: EvalRow, trust: Sequence[str] = ()) -> list[TransitionRow]:
    """Random steps of the demonstrations and of the training episode that would come next, by the newest checkpoint's networks.

    Empty where the run's reward has no representation; `InputError` where it can't be restored.
    """
    run = restored(source.settings)
    if type(run.reward).representation is Reward.representation:
        return []
    modules.admit(f"The run in {source.folder}", modules.of_task(run.task, run.env_kwargs), trust)
    demos = runs.demonstrations(run)
    assert demos is not None
    with envs.opened(run.task, env_kwargs=run.env_kwargs) as env:
        fresh = jax.eval_shape(lambda: loop.start(run, envs.spec(env), demos.episodes).learner)
        if (numbers := sum(leaf.size for leaf in jax.tree.leaves(fresh))) > NUMBERS:
            raise InputError(
                f"The run in {source.folder} has networks of {numbers:,} numbers; at most {NUMBERS:,} are restored."
            )
        state, _ = loop.resume(run, source.folder, loop.start(run, envs.spec(env), demos.episodes), lambda text: None)
        if not state.counters.episodes:
            raise InputError(f"{source.folder} holds no checkpoint that can be read.")
        rng = seeds.rng(run.seed, Stream.SAMPLE, state.counters.episodes)
        frames = state.counters.frames
        episode = loop.play(dataclasses.replace(run, update_every=WHOLE), env, envs.spec(env), state)
    embed = learner.frozen_embed(run.learner, state.learner.agent)
    seen = []
    for episodes, rows in ((demos.episodes, EXPERT_STEPS), ([episode], AGENT_STEPS)):
        obs, action, reward = _steps(run, episodes, rows, rng)
        embedded = run.reward.representation(state.learner.reward, jnp.asarray(obs), jnp.asarray(action), embed)
        seen.append((np.asarray(embedded), reward))
    (expert, _), (agent, reward) = seen
    return project(expert, agent, reward, row._replace(frames=frames))


def with_defaults(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings by dotted names with those that they lack at their class's default; as they are where no run has them."""
    try:
        own = {f"{part}.class": registered(part, settings[f"{part}.class"]) for part in REGISTRIES}
        return flat(_made(settings).plain.to_json()) | settings | own
    except Exception:  # presets are made for settings of every kind, here of a file from anywhere
        return settings


def restored(settings: dict[str, Any]) -> Run:
    """The run whose `run.json` has these settings, by dotted names; only our own rewards and agents are ever made."""
    run = _made(settings)
    if flat(run.to_json()) != settings:
        raise InputError(f"the run of {run.task} by {run.method} has settings that this version does not make.")
    return run


def _made(settings: dict[str, Any]) -> Run:
    return presets.make(**{name: value for name, value in settings.items() if not name.endswith(".class")})


def _steps(run: Run, episodes: Sequence[Episode], rows: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """So many random steps, none twice: the states that the reward reads, the actions, the environment's rewards."""
    episodes = [loop.absorbed(run, episode) for episode in episodes]
    part = slice(1, None) if run.reward.reads == "next_obs" else slice(None, -1)
    kinds = zip(*((episode.obs[part], episode.action, episode.reward) for episode in episodes), strict=True)
    chosen = rng.permutation(sum(map(len, episodes)))[:rows]
    return tuple(np.concatenate(arrays)[chosen] for arrays in kinds)
