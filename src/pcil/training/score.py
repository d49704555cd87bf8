"""The learned reward of a trained run on demonstrations that it may never have seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pcil import compilation, envs, files, modules
from pcil.demos import Demonstrations
from pcil.errors import InputError
from pcil.training import fit, learner, runs, state
from pcil.training.callbacks import Callback
from pcil.training.config import run_of_file


def scores(folder: Path, demos: Demonstrations, trust: Sequence[str] = ()) -> Float[np.ndarray, " episodes"]:
    """The mean learned reward of a step in each episode, by the networks of the run's last checkpoint.

    It tells good episodes from bad ones as far as the reward does. `trust` are the modules that the run's files may name.
    `InputError` if there is no run that learns a reward, or if the demonstrations do not fit its environment.
    """
    compilation.use_cache()
    path = folder / "run.json"
    if not path.is_file():
        raise InputError(f"{folder} holds no run; give a folder that pcil train made.")
    run = run_of_file(str(path), files.read_json(path)["run"], trust)
    modules.admit(str(path), modules.of_task(run.task, run.env_kwargs), trust)
    if run.agent.offline or not run.reward.needs_demos:
        raise InputError(f"The run in {folder} is one of {run.method}, which learns no reward; give one of pcil, for example.")
    own = runs.demonstrations(run)
    with envs.opened(run.task, env_kwargs=run.env_kwargs) as environment:
        spec, held = envs.spec(environment), fit.fitted(run, demos, environment, lambda text: None)
    fresh = state.start(run, spec, own.episodes if own else ())
    restored, logs = state.resume(run, folder, fresh, Callback())
    if not logs:
        raise InputError(f"{folder} holds no checkpoint that can be read; train the run first.")
    means = []
    for number, episode in enumerate(held.episodes):
        labels = learner.label_episode(run.learner, restored.learner, state.absorbed(run, episode), number)
        means.append(np.mean(labels[: len(episode)]))
    return np.array(means)
