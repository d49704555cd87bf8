"""The loop, one function in the order of time. No method is named here."""

from __future__ import annotations

import contextlib
import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from pcil import checkpoint, envs, learner, seeds
from pcil.config import Run
from pcil.errors import InputError, RunError
from pcil.evaluate import Evaluation, environments_for, evaluate
from pcil.learner import Learner, on_host
from pcil.metrics import Clock, MetricWriter, described
from pcil.networks import Actor
from pcil.policy import Policy
from pcil.replay import Replay
from pcil.rewards import states_read
from pcil.seeds import Stream
from pcil.types import Batch, Episode, Spec

OFFLINE_STEPS = 500
"""Updates of an offline agent in one pass of the loop."""


@runtime_checkable
class Reporter(Protocol):
    """Who is told how a run goes: a progress bar, or nobody. `stop` is asked between episodes."""

    def episode(self, run: Run, frames: int, total_reward: float) -> None: ...
    def evaluation(self, run: Run, frames: int, result: Evaluation) -> None: ...
    def say(self, text: str) -> None: ...
    def stop(self) -> bool: ...


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


class Stopped(Exception):
    """The run was asked to stop, and has saved itself."""


def train_loop(run: Run, folder: Path, demos: Sequence[Episode], reporter: Reporter, task: Any = None) -> State:
    """Train until `run.frames`, resuming from the folder's newest whole checkpoint; each pass of the loop is one episode.

    An offline agent has passes of `OFFLINE_STEPS` updates instead. `demos` may be empty where nothing needs them. `task` makes
    the environments, by default `run.task`. Returns the final state, with the final return in its counters. Raises `Stopped`
    where the reporter asks for it, and `InputError` or `RunError` after it has saved the state of before the present pass.
    """
    with contextlib.ExitStack() as stack:
        task, single = run.task if task is None else task, run.single_environment
        copies = environments_for(task, run.evaluate_episodes, run.env_kwargs, training=True, single=single)
        env, *rollout = stack.enter_context(copies)
        rollout, spec = rollout or [env], envs.spec(env)
        state, positions = resume(run, folder, start(run, spec, demos), reporter)
        clock = Clock(state.counters.seconds)
        saved = clock.total()
        log = stack.enter_context(MetricWriter(folder, positions, state.counters.frames))
        while state.counters.frames < run.frames:
            with _saved_on_failure(run, folder, state, log, clock) as refuse_divergence:
                if state.counters.frames >= state.counters.evaluations * run.evaluate_every:
                    _evaluate(run, folder, state, rollout, log, clock, reporter)
                episode = _study(run, spec, state) if run.agent.offline else play(run, env, spec, state)
                refuse_divergence()
                if episode:
                    kept, learned = _labelled(run, state, episode)

            if episode:
                state.replay.add(kept, learned if run.label == "stored" else kept.reward)
                _refuse_short_episodes(run, state)
                _log_pass(state, described(episode, learned), log, clock)
                reporter.episode(run, state.counters.frames, episode.total_reward)
            else:
                _log_pass(state, {}, log, clock)

            stop = reporter.stop()
            if stop or clock.total() - saved >= run.checkpoint_seconds:
                _save(folder, state, log.positions(), clock)
                saved = clock.total()
            if stop:
                raise Stopped

        if state.counters.final_return is None:
            with _saved_on_failure(run, folder, state, log, clock):
                result = _evaluate(run, folder, state, rollout, log, clock, reporter)
            state.counters = replace(state.counters, final_return=result.mean)
            _save(folder, state, log.positions(), clock)
    return state


@contextlib.contextmanager
def _saved_on_failure(run: Run, folder: Path, state: State, log: MetricWriter, clock: Clock) -> Iterator[Callable[[], None]]:
    """Where the environment fails or training diverges, a checkpoint of the state as it is now is left, and no later one.

    What it gives raises `RunError` where an update since has left the finite range.
    """
    before, positions = replace(state, learner=learner.copied(state.learner)), log.positions()

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
        _save(folder, before, positions, clock)
        refuse_divergence()  # it came first, where the actor's actions are not finite any more
        raise


def play(run: Run, env: envs.Checked, spec: Spec, state: State) -> Episode:
    """One episode: act, update (the device works while the environment steps), step."""
    counters = state.counters
    act_rng = seeds.rng(run.seed, Stream.ACT, counters.episodes)
    sample_rng = seeds.rng(run.seed, Stream.SAMPLE, counters.episodes)
    seed = seeds.episode_seed(run.seed, Stream.EPISODE, counters.episodes)
    env.episode = f"training episode {counters.episodes + 1}"
    observations, actions, rewards = [env.reset(seed=seed)[0]], [], []
    explore = run.agent.explorer(spec.action_dim, act_rng)
    host: Actor | None = None
    over = terminated = False
    while not over:
        if counters.frames < run.random_frames:
            action = act_rng.uniform(-1, 1, spec.action_dim).astype(np.float32)
        else:
            host = host or on_host(state.actor)
            action = explore(host, observations[-1], counters.steps)
        if _update_due(run, state.replay, counters):
            counters, host = _update(run, state, state.replay, counters, sample_rng), None
        obs, reward, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
        observations.append(obs)
        actions.append(action)
        rewards.append(reward)
        counters = replace(counters, steps=counters.steps + 1, frames=counters.frames + spec.action_repeat)
    state.counters = replace(counters, episodes=counters.episodes + 1)
    return Episode(np.stack(observations), np.stack(actions), np.array(rewards, np.float64), terminated, seed)


def _update_due(run: Run, replay: Replay, counters: Counters) -> bool:
    return (
        counters.frames >= run.seed_frames
        and counters.steps % run.update_every == 0
        and replay.num_windows(_window_steps(run)) > 0
    )


def _window_steps(run: Run) -> int:
    """Steps of the longest windows that an update draws."""
    return max(run.agent.n_step, run.reward.span)


def _refuse_short_episodes(run: Run, state: State) -> None:
    """Raise `InputError` where updates are due and no window fits into any episode: nothing would ever be learned."""
    if state.counters.frames >= run.seed_frames and not state.replay.num_windows(_window_steps(run)):
        raise InputError(
            f"Every episode of {run.task} so far is cut before the {_window_steps(run)} steps that an update needs; make its "
            "time limit longer, or agent.n_step smaller."
        )


def _labelled(run: Run, state: State, episode: Episode) -> tuple[Episode, np.ndarray]:
    """The episode as the replay keeps it, and the learned reward of each of its steps."""
    kept = absorbed(run, episode)
    state.learner = learner.close_episode(run.learner, state.learner, kept, state.counters.episodes)
    learned = learner.label_episode(run.learner, state.learner, kept, state.counters.episodes)
    if not np.isfinite(learned).all():
        step = int(np.argmin(np.isfinite(learned)))
        where = f"step {step + 1} of training episode {state.counters.episodes} of {run.task}"
        raise RunError(f"The learned reward is {learned[step]} in {where}.")
    return kept, learned


def _study(run: Run, spec: Spec, state: State) -> None:
    """Updates on the demonstrations alone; each counts as the agent step that it takes the place of."""
    assert state.expert is not None
    counters = state.counters
    rng = seeds.rng(run.seed, Stream.SAMPLE, counters.episodes)
    for _ in range(OFFLINE_STEPS):
        if counters.frames < run.frames:
            counters = _update(run, state, state.expert, counters, rng)
            counters = replace(counters, steps=counters.steps + 1, frames=counters.frames + spec.action_repeat)
    state.counters = replace(counters, episodes=counters.episodes + 1)


def _update(run: Run, state: State, replay: Replay, counters: Counters, rng: np.random.Generator) -> Counters:
    """Dispatch one update on draws from the replay and the demonstrations; returns the counters after it."""
    rows, span = run.reward.batch_size, run.reward.span
    window = replay.sample(rng, run.agent.batch_size, run.agent.n_step)
    expert = state.expert.sample(rng, rows, span) if state.expert and rows else None
    seen = replay.sample(rng, rows, span) if span > run.agent.n_step else None
    step, count = np.int32(counters.steps), np.int32(counters.updates)
    state.learner, state.actor = learner.update(run.learner, state.learner, window, expert, seen, step, count)
    return replace(counters, updates=counters.updates + 1)


def _log_pass(state: State, values: dict[str, Any], log: MetricWriter, clock: Clock) -> None:
    """One line for the episode, with the mean of each update's metrics."""
    totals = {name: float(value) for name, value in jax.device_get(state.learner.totals).items() if name != "finite"}
    updates = totals.pop("updates")
    values = {"episode": state.counters.episodes, **values, "updates": state.counters.updates}
    values |= {name: total / updates for name, total in totals.items() if updates}
    values |= {"seconds": round(clock.total(), 2), "frames_per_second": round(clock.rate(state.counters.frames), 1)}
    log.episode(state.counters.frames, values)
    zeros = jax.tree.map(jnp.zeros_like, state.learner.totals)
    state.learner = Learner(state.learner.agent, state.learner.reward, state.learner.root, zeros)


def _evaluate(
    run: Run,
    folder: Path,
    state: State,
    rollout: list[envs.Checked],
    log: MetricWriter,
    clock: Clock,
    reporter: Reporter,
) -> Evaluation:
    """Roll out the mean action, write `eval.csv`, and leave the policy of this moment in the folder."""
    host = on_host(state.actor)
    result = evaluate(lambda obs: host(obs, np), rollout, seed=run.seed, episodes=run.evaluate_episodes)
    log.evaluation(state.counters.frames, clock.total(), result)
    state.counters = replace(state.counters, evaluations=state.counters.evaluations + 1)
    info = {
        "method": run.method,
        "preset": run.preset,
        "seed": run.seed,
        "frames": state.counters.frames,
        "return_mean": result.mean,
        "action_repeat": envs.spec(rollout[0]).action_repeat,
        "env_kwargs": run.env_kwargs,
    }
    Policy(host, envs.task_name(run.task), info).save(folder / "policy")
    reporter.evaluation(run, state.counters.frames, result)
    return result


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


def _save(folder: Path, state: State, positions: dict[str, int], clock: Clock) -> None:
    """Everything that the rest of the run depends on; a finished run needs no replay, and an offline agent's is empty."""
    counters = replace(state.counters, seconds=clock.total())
    arrays = checkpoint.flatten("learner", state.learner)
    arrays |= checkpoint.flatten("actor", state.actor)  # made again from the learner it may differ in the last bit
    if counters.final_return is None and state.replay.num_episodes:
        arrays |= {f"replay.{name}": array for name, array in state.replay.state().items()}
    meta = {"counters": asdict(counters), "positions": positions}
    checkpoint.save(folder / "checkpoint", counters.frames, arrays, meta)


def resume(run: Run, folder: Path, fresh: State, reporter: Reporter) -> tuple[State, dict[str, int]]:
    """The state of the newest whole checkpoint and the lengths its logs had; `fresh` and no lengths where there is none."""
    arrays, meta, complaints = checkpoint.restore(folder / "checkpoint")
    for complaint in complaints:
        reporter.say(complaint)
    if arrays is None:
        if (folder / "train.jsonl").exists():
            reporter.say(f"There is no whole checkpoint in {folder}, so the run begins again.")
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
        reporter.say(f"Resuming at {counters.frames:,} of {run.frames:,} frames.")
    return State(restored, actor, fresh.replay, fresh.expert, counters), meta["positions"]
