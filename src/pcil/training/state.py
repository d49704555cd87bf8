"""The state of a run: how it starts, and how it is saved and resumed between episodes."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from pcil import envs
from pcil.agents import Actor
from pcil.errors import InputError, RunError
from pcil.policy import Policy, as_saved, load_policy
from pcil.training import checkpoint, kept, learner
from pcil.training.callbacks import LOGS, Callback, LogFiles
from pcil.training.config import Run
from pcil.training.kept import Kept
from pcil.training.learner import Learner, on_host
from pcil.training.replay import Replay
from pcil.types import Batch, Episode, Spec

WALL_CLOCK = ("seconds", "frames_per_second")
"""Columns of the logs that differ between two runs of the same settings; all others are equal."""


class Clock:
    """Wall-clock time of a run over all its sessions."""

    def __init__(self, before: float) -> None:
        self._before, self._begin = before, time.perf_counter()
        self._last: tuple[int, float] | None = None

    def total(self) -> float:
        """Seconds until now, over all sessions."""
        return self._before + time.perf_counter() - self._begin

    def times(self, frames: int) -> dict[str, float]:
        """The columns `WALL_CLOCK` of a metrics row."""
        return {"seconds": round(self.total(), 2), "frames_per_second": round(self.rate(frames), 1)}

    def rate(self, frames: int) -> float:
        """Frames a second since the last call."""
        now = self.total()
        before, self._last = self._last, (frames, now)
        return (frames - before[0]) / max(now - before[1], 1e-9) if before else 0.0


@dataclass(frozen=True)
class Counters:
    """The counters of a run. A checkpoint holds these, the arrays and the logs."""

    frames: int = 0
    steps: int = 0
    """Agent steps."""
    episodes: int = 0
    updates: int = 0
    evaluations: int = 0
    good_evaluations: int = 0
    """The last evaluations, in a row, that reached the share `until` of the demonstrations' return."""
    seconds: float = 0.0
    """Wall-clock time until now, over all sessions."""
    final_return: float | None = None
    """Mean return of the last evaluation, once the run is finished."""

    @classmethod
    def of(cls, meta: dict[str, Any]) -> Counters:
        """Those of a checkpoint. Some older versions also noted whether the actor had been cloned."""
        return cls(**{name: value for name, value in meta["counters"].items() if name != "cloned"})


@dataclass
class State:
    """What the loop carries from episode to episode."""

    learner: Learner
    actor: Actor
    """The actor after the last update."""
    replay: Replay
    expert: Replay | None
    """The demonstrations; a checkpoint does not hold them."""
    counters: Counters
    kept: Kept | None = None
    """The policy that was evaluated last, if the run keeps the best."""
    before: Kept | None = None
    """The one before it, where the last evaluation was only due because the run ended."""

    def saved_actor(self, run: Run) -> Actor:
        """The actor that is evaluated and saved, with its arrays on the host."""
        return self.kept.actor if self.kept else self.new_actor(run)

    def new_actor(self, run: Run) -> Actor:
        """The actor that the last update left, or its average."""
        return on_host(run.agent.averaged(self.learner.agent) or self.actor)

    def policy(self, run: Run) -> Callable[[np.ndarray], np.ndarray]:
        """Its mean actions `[k, action]` of observations `[k, obs]`; the arrays are copied to the host once, here."""
        actor = self.saved_actor(run)
        return lambda obs: actor(obs, np)


def start(run: Run, spec: Spec, demos: Sequence[Episode]) -> State:
    """The state before the first step."""
    demos = [absorbed(run, episode) for episode in demos]
    spec = spec._replace(obs_dim=spec.obs_dim + 1) if run.agent.absorbing else spec
    batches = tuple(Batch.of(episode.obs, episode.action) for episode in demos)
    fresh = learner.init(run.learner, spec, batches, run.seed)
    replay = Replay(run.replay_steps, spec.obs_dim, spec.action_dim)
    left, reward = run.reward.prefill
    for episode in itertools.cycle(demos):
        if left <= 0:
            break
        learned = np.full(len(episode), reward)
        replay.add(episode, np.asarray(run.reward.total(learned, episode.reward), np.float32))
        left -= len(episode)
    actor = learner.acting(run.learner, fresh)
    return State(fresh, actor, replay, Replay.of(demos) if demos else None, Counters())


def absorbed(run: Run, episode: Episode) -> Episode:
    """The episode as the run learns from it. With an absorbing state, an episode that terminated gets as many absorbing
    steps as it has steps, so that half of what a reward sees of it is its end, whatever its length."""
    return episode.absorbed(max(run.agent.n_step, len(episode))) if run.agent.absorbing else episode


def keep_better(run: Run, state: State, environments: Sequence[envs.Checked]) -> None:
    """Keep the policy of now, if the present reward pays it at least as much as the one kept before."""
    actor = state.new_actor(run)
    episodes = kept.played(actor, environments, seed=run.seed, episodes=run.evaluate_episodes)
    now = Kept(actor, tuple(absorbed(run, episode) for episode in episodes))
    state.before = None if _due(run, state.counters) else state.kept
    state.kept = kept.better(run.learner, state.learner, now, state.kept, state.counters.episodes)


def evaluated(run: Run, counters: Counters, return_mean: float, demos_return: float | None) -> Counters:
    """The counters after an evaluation. It is the last one if the run has all its frames, or if two evaluations in a row have
    reached the share `run.until` of the demonstrations' mean return.

    An evaluation that is only due because the run ends is not counted, so that the run can go on from here with more frames.
    """
    good = run.until is not None and demos_return is not None and return_mean >= run.until * demos_return
    if _due(run, counters):
        number = counters.good_evaluations + 1 if good else 0
        counters = replace(counters, evaluations=counters.evaluations + 1, good_evaluations=number)
    last = counters.frames >= run.frames or _good_enough(run, counters)
    return replace(counters, final_return=return_mean if last else None)


def _due(run: Run, counters: Counters) -> bool:
    """Whether an evaluation is due, also if the run does not end here."""
    return counters.frames >= counters.evaluations * run.evaluate_every


def _good_enough(run: Run, counters: Counters) -> bool:
    return run.until is not None and counters.good_evaluations >= 2


def goes_on(run: Run, counters: Counters) -> bool:
    """Whether a run that had finished has frames left, since it is now given more of them or no `until` any longer."""
    return counters.final_return is not None and counters.frames < run.frames and not _good_enough(run, counters)


def save(folder: Path, state: State, logs: dict[str, str], clock: Clock, *, keep_replay: bool = True) -> None:
    """Everything that the rest of the run depends on; an offline agent's replay is empty."""
    counters = replace(state.counters, seconds=clock.total())
    arrays = checkpoint.flatten("learner", state.learner)
    arrays |= checkpoint.flatten("actor", state.actor)  # made again from the learner it may differ in the last bit
    arrays |= kept.flatten("kept", state.kept) | kept.flatten("before", state.before)
    if keep_replay and state.replay.num_episodes:
        arrays |= {f"replay.{name}": array for name, array in state.replay.state().items()}
    checkpoint.save(folder / "checkpoint", counters.frames, arrays, {"counters": asdict(counters), "logs": logs})


def resume(run: Run, folder: Path, fresh: State, told: Callback) -> tuple[State, dict[str, str]]:
    """The state of the newest whole checkpoint and what its logs held; `fresh` and no logs where there is none."""
    arrays, meta, complaints = checkpoint.restore(folder / "checkpoint")
    for complaint in complaints:
        told.message(complaint)
    if arrays is None:
        if any((folder / name).exists() for name in LOGS):
            told.message(f"There is no whole checkpoint in {folder}, so the run begins again.")
        return fresh, {}
    arrays = checkpoint.flatten("learner.totals", fresh.learner.totals) | arrays  # all are 0, and older versions have fewer
    arrays = {name.replace("moments", "opt_state"): array for name, array in arrays.items()}
    if "learner.reward.reference" in arrays:  # older versions had the states alone
        ours = checkpoint.flatten("learner.reward.reference", fresh.learner.reward.reference)
        arrays |= ours | {"learner.reward.reference.next_obs": arrays["learner.reward.reference"]}
    try:
        restored = checkpoint.unflatten("learner", fresh.learner, arrays)
        known = checkpoint.flatten("actor", fresh.actor).keys() <= arrays.keys()  # older ones have no scale of observations
        actor = checkpoint.unflatten("actor", fresh.actor, arrays) if known else run.agent.actor(restored.agent)
        best, before = (kept.unflatten(name, fresh.actor, arrays) for name in ("kept", "before"))
        counters = Counters.of(meta)
    except (ValueError, TypeError) as error:
        raise InputError(
            f"The checkpoint in {folder} is of another version ({error}); go on with that one, or give another --out."
        ) from error
    logs = meta.get("logs") or {
        name: _beginning(folder / name, length, told.message) for name, length in meta["positions"].items()
    }
    if goes_on(run, counters):
        too_many = counters.frames < (counters.evaluations - 1) * run.evaluate_every  # older versions counted one not due
        counters = replace(counters, final_return=None, evaluations=counters.evaluations - too_many)
        logs["eval.csv"] = _first_evaluations(logs["eval.csv"], counters.evaluations)
        best, before = before or best, None
    if counters.final_return is None:
        if held := {name[7:]: array for name, array in arrays.items() if name.startswith("replay.")}:
            fresh.replay.load(held)
        told.message(f"Resuming at {counters.frames:,} of {run.frames:,} frames.")
    return State(restored, actor, fresh.replay, fresh.expert, counters, best, before), logs


def save_policy(run: Run, folder: Path, state: State, env: envs.Checked, return_mean: float, returns: Sequence[float]) -> None:
    """Write the current policy to the run's folder, with its provenance; `returns` are those of its evaluation."""
    spec, box, demos = envs.spec(env), envs.origin(env), PurePath(run.demos or envs.task_name(run.task))
    info = {
        "method": run.method,
        "preset": run.preset,
        "seed": run.seed,
        "frames": state.counters.frames,
        "return_mean": return_mean,
        "return_std": float(np.std(returns)) if returns else None,
        "return_episodes": len(returns),
        "demos": (demos.name if demos.is_absolute() else str(demos)) if run.needs_demos else None,
        "action_repeat": spec.action_repeat,
        "action_low": box.action_low,
        "action_high": box.action_high,
        "env_kwargs": run.env_kwargs,
    }
    Policy(state.saved_actor(run), envs.task_name(run.task), info, spec).save(folder / "policy")


def take_means(state: State) -> dict[str, Any]:
    """The number of updates until now, and the mean of each metric over those since the last call."""
    totals = {name: float(value) for name, value in jax.device_get(state.learner.totals).items() if name != "finite"}
    updates = totals.pop("updates")
    zeros = jax.tree.map(jnp.zeros_like, state.learner.totals)
    state.learner = replace(state.learner, totals=zeros)
    return {"updates": state.counters.updates} | {name: total / updates for name, total in totals.items() if updates}


@contextlib.contextmanager
def saved_on_failure(run: Run, folder: Path, state: State, log: LogFiles, clock: Clock) -> Iterator[Callable[[], None]]:
    """Save a checkpoint of the state at this point if the environment fails or training diverges inside the context.

    The context's value is a function that raises `RunError` if an update since then has become NaN or infinite.
    """
    before, rows = replace(state, learner=learner.copied(state.learner)), log.rows()

    def refuse_divergence() -> None:
        if found := learner.first_not_finite(state.learner):
            what, updates = found
            raise RunError(
                f"The training on {run.task} diverged: {what} became NaN or infinite in update "
                f"{before.counters.updates + updates + 1:,}, after frame {before.counters.frames:,}; what was learned "
                "before is kept, and a smaller learning rate may help."
            )

    try:
        yield refuse_divergence
    except InputError:
        save(folder, before, log.contents(rows), clock)
        refuse_divergence()  # it came first, where the actor's actions are not finite any more
        raise


@contextlib.contextmanager
def saved_anyway(folder: Path, state: State, log: LogFiles, clock: Clock) -> Iterator[None]:
    """Save a checkpoint of the state if a callback fails inside the context."""
    try:
        yield
    except RunError:
        save(folder, state, log.contents(), clock)
        raise


def _beginning(log: Path, length: int, say: Callable[[str], None]) -> str:
    """The first bytes of a log, for a checkpoint of an older version, which does not hold the log itself."""
    content = log.read_bytes()[:length] if log.exists() else b""
    if len(content) < length:
        say(f"{log} has lost {length - len(content):,} of the {length:,} bytes that it had at the checkpoint.")
    return content.decode(errors="replace")


def _first_evaluations(log: str, number: int) -> str:
    """The first evaluations in `eval.csv`; what the rows of an evaluation have in common are their frames."""
    header, *rows = log.splitlines(keepends=True)
    groups = [list(group) for _, group in itertools.groupby(rows, key=lambda row: row.partition(",")[0])]
    return "".join([header, *itertools.chain.from_iterable(groups[:number])])


def unfinished(folder: Path, run: Run, final_return: float) -> str | None:
    """Why the run in a folder whose DONE has this final return is not finished, in a sentence, or None; its last checkpoint has
    what it takes to finish it.

    `InputError` where the policy is damaged and no checkpoint could mend it, or where `run` goes on and no replay was kept.
    """
    arrays, meta, _ = checkpoint.restore(folder / "checkpoint")
    try:
        load_policy(folder, run.own_modules)
        damage = None if as_saved(folder / "policy") else f"{folder / 'policy' / 'policy.json'} is not what the run had written"
    except InputError as error:
        damage = str(error).partition(";")[0]
    if arrays is None:
        if damage:
            raise InputError(f"{damage}, and no checkpoint has it; delete {folder / 'DONE'} to train it again.")
        return None
    counters = Counters.of(meta)
    if goes_on(run, counters):
        if not run.agent.offline and not any(name.startswith("replay.") for name in arrays):
            raise InputError(
                f"The finished run in {folder} has kept no replay, so it can't go on from {counters.frames:,} to "
                f"{run.frames:,} frames; train anew with another --out."
            )
        return f"The run in {folder} had finished at {counters.frames:,} frames, and goes on."
    if counters.final_return is None:
        return f"{folder / 'DONE'} is there, but the last whole checkpoint is at {counters.frames:,} frames; the run goes on."
    if counters.final_return != final_return:
        damage = f"{folder / 'DONE'} has another return than the last checkpoint"
    for name, log in meta.get("logs", {}).items():
        if not (folder / name).is_file() or (folder / name).read_bytes() != log.encode():
            damage = f"{folder / name} is not what the run had written"
    return damage and f"{damage}; it is written again from the last checkpoint."
