"""The loop, one function in the order of time. No method is named here."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from pcil import envs, seeds
from pcil.errors import InputError, RunError
from pcil.nets.networks import Actor
from pcil.policy import Policy
from pcil.seeds import Stream
from pcil.training import learner
from pcil.training.config import Run
from pcil.training.evaluate import Evaluation, environments_for, evaluate
from pcil.training.learner import Learner, on_host
from pcil.training.metrics import Clock, MetricWriter, described
from pcil.training.replay import Replay
from pcil.training.state import Counters, State, absorbed, resume, save, start
from pcil.types import Episode, Spec

OFFLINE_STEPS = 500
"""Updates of an offline agent in one pass of the loop."""


@runtime_checkable
class Reporter(Protocol):
    """Who is told how a run goes: a progress bar, or nobody. `stop` is asked between episodes."""

    def episode(self, run: Run, frames: int, total_reward: float) -> None: ...
    def evaluation(self, run: Run, frames: int, result: Evaluation) -> None: ...
    def say(self, text: str) -> None: ...
    def stop(self) -> bool: ...


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
        state, logs = resume(run, folder, start(run, spec, demos), reporter.say)
        clock = Clock(state.counters.seconds)
        saved = clock.total()
        log = stack.enter_context(MetricWriter(folder, logs, clock.total(), reporter.say))
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
                save(folder, state, log.logs(), clock)
                saved = clock.total()
            if stop:
                raise Stopped

        if state.counters.final_return is None:
            with _saved_on_failure(run, folder, state, log, clock):
                result = _evaluate(run, folder, state, rollout, log, clock, reporter)
            state.counters = replace(state.counters, final_return=result.mean)
            save(folder, state, log.logs(), clock)
        else:
            _save_policy(run, folder, state, spec, state.counters.final_return)
    return state


@contextlib.contextmanager
def _saved_on_failure(run: Run, folder: Path, state: State, log: MetricWriter, clock: Clock) -> Iterator[Callable[[], None]]:
    """Where the environment fails or training diverges, a checkpoint of the state as it is now is left, and no later one.

    What it gives raises `RunError` where an update since has left the finite range.
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
        save(folder, before, log.logs(rows), clock)
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
    _save_policy(run, folder, state, envs.spec(rollout[0]), result.mean)
    reporter.evaluation(run, state.counters.frames, result)
    return result


def _save_policy(run: Run, folder: Path, state: State, spec: Spec, return_mean: float) -> None:
    info = {
        "method": run.method,
        "preset": run.preset,
        "seed": run.seed,
        "frames": state.counters.frames,
        "return_mean": return_mean,
        "action_repeat": spec.action_repeat,
        "env_kwargs": run.env_kwargs,
    }
    Policy(on_host(state.actor), envs.task_name(run.task), info).save(folder / "policy")
