"""Warm starts: the networks of a new run from those of an earlier run or policy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from pcil import files
from pcil.errors import InputError
from pcil.policy import load_policy
from pcil.training import checkpoint
from pcil.training.config import REGISTRIES, Run
from pcil.training.learner import acting
from pcil.training.state import State


def started(run: Run, fresh: State, say: Callable[[str], None]) -> State:
    """The state before the first step, with the networks that `run.init` names; `say` is told what starts from where.

    From a run with the same class of agent, these are all networks with the states of their optimisers; from any other run or
    policy, the actor alone. Reward, replay and exploration always start anew. `InputError` if there is no policy, or one of
    other sizes.
    """
    if run.init is None:
        return fresh
    folder = files.expanded(Path(run.init))
    agent = _whole_agent(run, folder, fresh.learner.agent)
    if agent is not None:
        say(f"Actor and critic start from {folder}; the reward, the replay and exploration start anew.")
    else:
        try:
            agent = run.agent.started_from(fresh.learner.agent, load_policy(folder, run.own_modules).actor)
        except InputError as error:
            raise InputError(f"The run can't start from {run.init}: {error}") from error
        say(
            f"The actor starts from {folder}; everything else starts anew, the critic too, so the actor may get worse at first."
        )
    learner = replace(fresh.learner, agent=agent)
    return replace(fresh, learner=learner, actor=acting(run.learner, learner))


def _whole_agent(run: Run, folder: Path, fresh: Any) -> Any | None:
    """The agent's state in the last checkpoint of a run; None if there is none of this class and these sizes."""
    if not (folder / "run.json").is_file():
        return None
    arrays, _, _ = checkpoint.restore(folder / "checkpoint")
    names = {kind: name for name, kind in REGISTRIES["agent"].items()}
    try:
        theirs = files.read_json(folder / "run.json")["run"]["agent"]["class"]
        if arrays is None or theirs != names[type(run.agent)]:
            return None
        averages = {
            name.replace(".actor.", ".averaged.", 1): array
            for name, array in arrays.items()
            if name.startswith("learner.agent.actor.")
        }
        return checkpoint.unflatten("learner.agent", fresh, averages | arrays)
    except (OSError, ValueError, LookupError, TypeError):
        return None
