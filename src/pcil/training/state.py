"""The state of a run: how it starts, is saved between two episodes, and is taken up again."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from pcil.errors import InputError
from pcil.nets.networks import Actor
from pcil.policy import as_saved, load_policy
from pcil.rewards import states_read
from pcil.training import checkpoint, learner
from pcil.training.config import Run
from pcil.training.learner import Learner
from pcil.training.metrics import LOGS, Clock
from pcil.training.replay import Replay
from pcil.types import Batch, Episode, Spec


@dataclass(frozen=True)
class Counters:
    """Where a run is; with the arrays, all that a checkpoint holds."""

    frames: int = 0
    steps: int = 0
    """Agent steps."""
    episodes: int = 0
    updates: int = 0
    evaluations: int = 0
    seconds: float = 0.0
    """Wall-clock time until now, over all sessions."""
    final_return: float | None = None
    """Mean return of the last evaluation, once there is nothing left to do."""


@dataclass
class State:
    """What the loop carries from episode to episode."""

    learner: Learner
    actor: Actor
    """The actor as it left the last update."""
    replay: Replay
    expert: Replay | None
    """The demonstrations; a checkpoint does not hold them."""
    counters: Counters


def start(run: Run, spec: Spec, demos: Sequence[Episode]) -> State:
    """The state before the first step."""
    demos = [absorbed(run, episode) for episode in demos]
    spec = spec._replace(obs_dim=spec.obs_dim + 1) if run.agent.absorbing else spec
    batches = tuple(Batch(states_read(run.reward, episode.obs), episode.action) for episode in demos)
    fresh = learner.init(run.learner, spec, batches, run.seed)
    replay = Replay(run.replay_steps, spec.obs_dim, spec.action_dim)
    left, reward = run.reward.prefill
    for episode in itertools.cycle(demos):
        if left <= 0:
            break
        paid = run.reward.task_weight * episode.reward if run.reward.task_weight else np.zeros(len(episode))
        replay.add(episode, np.asarray(reward + paid, np.float32))
        left -= len(episode)
    actor = jax.tree.map(jnp.copy, run.agent.actor(fresh.agent))
    return State(fresh, actor, replay, Replay.of(demos) if demos else None, Counters())


def absorbed(run: Run, episode: Episode) -> Episode:
    """The episode as the run learns from it: where there is an absorbing state, an early end has as many steps there as it had
    before, so that half of what a reward sees of it is its end, whatever its length."""
    return episode.absorbed(max(run.agent.n_step, len(episode))) if run.agent.absorbing else episode


def save(folder: Path, state: State, logs: dict[str, str], clock: Clock) -> None:
    """Everything that the rest of the run depends on; a finished run needs no replay, and an offline agent's is empty."""
    counters = replace(state.counters, seconds=clock.total())
    arrays = checkpoint.flatten("learner", state.learner)
    arrays |= checkpoint.flatten("actor", state.actor)  # made again from the learner it may differ in the last bit
    if counters.final_return is None and state.replay.num_episodes:
        arrays |= {f"replay.{name}": array for name, array in state.replay.state().items()}
    checkpoint.save(folder / "checkpoint", counters.frames, arrays, {"counters": asdict(counters), "logs": logs})


def resume(run: Run, folder: Path, fresh: State, say: Callable[[str], None]) -> tuple[State, dict[str, str]]:
    """The state of the newest whole checkpoint and what its logs held; `fresh` and no logs where there is none."""
    arrays, meta, complaints = checkpoint.restore(folder / "checkpoint")
    for complaint in complaints:
        say(complaint)
    if arrays is None:
        if any((folder / name).exists() for name in LOGS):
            say(f"There is no whole checkpoint in {folder}, so the run begins again.")
        return fresh, {}
    arrays = checkpoint.flatten("learner.totals", fresh.learner.totals) | arrays  # all are 0, and older versions have fewer
    try:
        restored = checkpoint.unflatten("learner", fresh.learner, arrays)
        known = checkpoint.flatten("actor", fresh.actor).keys() <= arrays.keys()  # older ones have no scale of observations
        actor = checkpoint.unflatten("actor", fresh.actor, arrays) if known else run.agent.actor(restored.agent)
        counters = Counters(**meta["counters"])
    except (ValueError, TypeError) as error:
        raise InputError(
            f"The checkpoint in {folder} is of another version ({error}); go on with that one, or give another --out."
        ) from error
    if counters.final_return is None:
        if held := {name[7:]: array for name, array in arrays.items() if name.startswith("replay.")}:
            fresh.replay.load(held)
        say(f"Resuming at {counters.frames:,} of {run.frames:,} frames.")
    logs = meta.get("logs") or {name: _beginning(folder / name, length, say) for name, length in meta["positions"].items()}
    return State(restored, actor, fresh.replay, fresh.expert, counters), logs


def _beginning(log: Path, length: int, say: Callable[[str], None]) -> str:
    """So many bytes of a log, whose checkpoint, of an older version, does not hold them."""
    content = log.read_bytes()[:length] if log.exists() else b""
    if len(content) < length:
        say(f"{log} has lost {length - len(content):,} of the {length:,} bytes that it had at the checkpoint.")
    return content.decode(errors="replace")


def unfinished(folder: Path, final_return: float) -> str | None:
    """What is wrong with a folder whose DONE has this final return, in a sentence, or None; its last checkpoint mends it.

    `InputError` where the policy is damaged and there is no checkpoint that could.
    """
    arrays, meta, _ = checkpoint.restore(folder / "checkpoint")
    try:
        load_policy(folder)
        damage = None if as_saved(folder / "policy") else f"{folder / 'policy' / 'policy.json'} is not what the run had written"
    except InputError as error:
        damage = str(error).partition(";")[0]
    if arrays is None:
        if damage:
            raise InputError(f"{damage}, and no checkpoint has it; delete {folder / 'DONE'} to train it again.")
        return None
    counters = Counters(**meta["counters"])
    if counters.final_return is None:
        return f"{folder / 'DONE'} is there, but the last whole checkpoint is at {counters.frames:,} frames; the run goes on."
    if counters.final_return != final_return:
        damage = f"{folder / 'DONE'} has another return than the last checkpoint"
    for name, log in meta.get("logs", {}).items():
        if not (folder / name).is_file() or (folder / name).read_bytes() != log.encode():
            damage = f"{folder / name} is not what the run had written"
    return damage and f"{damage}; it is written again from the last checkpoint."
