"""Transitions of expert and agent in the representation that a run's reward has learned."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pcil import compilation, envs, modules, seeds
from pcil.errors import InputError
from pcil.files import flat
from pcil.report.embedding import project
from pcil.report.load import Collection, EvalRow, Source, Track, TransitionRow, named, quietly, sort_key
from pcil.rewards import Reward
from pcil.seeds import Stream
from pcil.training import learner, runs, state
from pcil.training.callbacks import Callback
from pcil.training.collect import play
from pcil.training.config import Run, run_of_file
from pcil.types import Batch, Episode

EXPERT_STEPS, AGENT_STEPS = 128, 256
"""The numbers of transitions in the paper's Figure 4."""
NUMBERS = 2**28
"""The largest number of parameters of a run that are restored: 1 GiB."""


def add(found: Collection, trust: Sequence[str] = (), track: Track = quietly) -> None:
    """Add rows to `found.transitions` for every run with a representation, and a note about runs whose networks can't be read.

    `trust` are the modules that the runs' files may name; `track` shows the progress.
    """
    try:
        compilation.use_cache()
    except InputError as error:
        found.notes.append(f"The representations are left out: {error}")
        return
    refused: list[str] = []
    for name, source in track(list(found.sources.items()), "Representations"):
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
    run = run_of_file(f"The run in {source.folder}", source.settings, trust)
    if type(run.reward).representation is Reward.representation:
        return []
    modules.admit(f"The run in {source.folder}", modules.of_task(run.task, run.env_kwargs), trust)
    demos = runs.demonstrations(run)
    assert demos is not None
    with envs.opened(run.task, env_kwargs=run.env_kwargs) as env:
        fresh = jax.eval_shape(lambda: state.start(run, envs.spec(env), demos.episodes).learner)
        if (numbers := sum(leaf.size for leaf in jax.tree.leaves(fresh))) > NUMBERS:
            raise InputError(
                f"The run in {source.folder} has networks of {numbers:,} numbers; at most {NUMBERS:,} are restored."
            )
        restored, _ = state.resume(run, source.folder, state.start(run, envs.spec(env), demos.episodes), Callback())
        if not restored.counters.episodes:
            raise InputError(f"{source.folder} holds no checkpoint that can be read.")
        rng = seeds.rng(run.seed, Stream.SAMPLE, restored.counters.episodes)
        frames = restored.counters.frames
        played = play(run, [env], envs.spec(env), restored, learn=False)
    embed = learner.frozen_embed(run.learner, restored.learner.agent)
    embeddings = []
    for episodes, rows in ((demos.episodes, EXPERT_STEPS), (played, AGENT_STEPS)):
        batch, reward = _steps(run, episodes, rows, rng)
        embedded = run.reward.representation(restored.learner.reward, batch, embed)
        embeddings.append((np.asarray(embedded), reward))
    (expert, _), (agent, reward) = embeddings
    return project(expert, agent, reward, row._replace(frames=frames))


def with_defaults(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings by dotted names, completed with the defaults of those that are missing; unchanged if they fit no run."""
    try:
        return flat(Run.from_json(settings).to_json())
    except Exception:  # the settings are from a file that may hold anything
        return settings


def _steps(run: Run, episodes: Sequence[Episode], rows: int, rng: np.random.Generator) -> tuple[Batch, np.ndarray]:
    """Random distinct steps, and the environment's reward of each."""
    episodes = [state.absorbed(run, episode) for episode in episodes]
    columns = zip(*((*Batch.of(episode.obs, episode.action)[:3], episode.reward) for episode in episodes), strict=True)
    chosen = rng.permutation(sum(map(len, episodes)))[:rows]
    *steps, reward = (np.concatenate(arrays)[chosen] for arrays in columns)
    return Batch(*map(jnp.asarray, steps)), reward
