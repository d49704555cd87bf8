"""Transitions of expert and agent in the representation that a run's reward has learned."""

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
"""The numbers of transitions in the paper's Figure 4."""
NUMBERS = 2**28
"""The largest number of parameters of a run that are restored: 1 GiB."""


def add(found: Collection, trust: Sequence[str] = ()) -> None:
    """Add rows to `found.transitions` for every run with a representation, and a note about runs whose networks can't be read.

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
        except Exception as error:  # a damaged folder or a user's environment can raise anything
            refused.append(named(source.folder, error))
    found.transitions.sort(key=sort_key)
    if refused:
        found.notes.append(f"The representation of {len(refused)} of {len(found.sources)} runs is left out: {refused[0]}")


def transitions(source: Source, row: EvalRow, trust: Sequence[str] = ()) -> list[TransitionRow]:
    """Embed random steps of the demonstrations and of the next training episode with the networks of the latest checkpoint.

    Empty if the run's reward has no representation; `InputError` if the run can't be restored.
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
    embeddings = []
    for episodes, rows in ((demos.episodes, EXPERT_STEPS), ([episode], AGENT_STEPS)):
        obs, action, reward = _steps(run, episodes, rows, rng)
        embedded = run.reward.representation(state.learner.reward, jnp.asarray(obs), jnp.asarray(action), embed)
        embeddings.append((np.asarray(embedded), reward))
    (expert, _), (agent, reward) = embeddings
    return project(expert, agent, reward, row._replace(frames=frames))


def with_defaults(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings by dotted names, completed with the defaults of those that are missing; unchanged if they fit no run."""
    try:
        own = {f"{part}.class": registered(part, settings[f"{part}.class"]) for part in REGISTRIES}
        return flat(_made(settings).plain.to_json()) | settings | own
    except Exception:  # the settings are from a file that may hold anything
        return settings


def restored(settings: dict[str, Any]) -> Run:
    """The run with these settings, by dotted names; only rewards and agents of this package are created."""
    run = _made(settings)
    if flat(run.to_json()) != settings:
        raise InputError(f"the run of {run.task} by {run.method} has settings that this version does not make.")
    return run


def _made(settings: dict[str, Any]) -> Run:
    return presets.make(**{name: value for name, value in settings.items() if not name.endswith(".class")})


def _steps(run: Run, episodes: Sequence[Episode], rows: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Random distinct steps: the states that the reward reads, the actions, and the environment's rewards."""
    episodes = [loop.absorbed(run, episode) for episode in episodes]
    part = slice(1, None) if run.reward.reads == "next_obs" else slice(None, -1)
    kinds = zip(*((episode.obs[part], episode.action, episode.reward) for episode in episodes), strict=True)
    chosen = rng.permutation(sum(map(len, episodes)))[:rows]
    return tuple(np.concatenate(arrays)[chosen] for arrays in kinds)
