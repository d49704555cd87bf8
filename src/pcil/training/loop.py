"""The loop, one function in the order of time. No method is named here."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pcil import envs
from pcil.training import state as states
from pcil.training import warm
from pcil.training.callbacks import Callback, Callbacks, LogFiles
from pcil.training.collect import labelled, play, store, study
from pcil.training.config import Run
from pcil.training.evaluate import environments_for, evaluate
from pcil.training.loggers import TensorBoard
from pcil.types import Episode


class Stopped(Exception):
    """The run was asked to stop, and has saved itself."""


def train_loop(
    run: Run,
    folder: Path,
    demos: Sequence[Episode],
    callbacks: Sequence[Callback] = (),
    *,
    task: Any = None,
    demos_return: float | None = None,
) -> states.State:
    """Train for `run.frames`, or until the share `run.until` of `demos_return`, resuming from the folder's newest whole
    checkpoint. A pass of the loop is an episode in each of `run.num_envs` environments, or some hundred updates of an offline
    agent.

    `demos` may be empty where nothing needs them. `task` makes the environments, by default `run.task`. Returns the final
    state, with the final return in its counters. Raises `Stopped` where a callback asks for it, and `InputError` or `RunError`
    after it has saved the state of before the present pass.
    """
    with contextlib.ExitStack() as stack:
        training, evaluation = stack.enter_context(
            environments_for(
                run.task if task is None else task,
                run.evaluate_episodes,
                run.env_kwargs,
                training=run.num_envs,
                single=run.single_environment,
            )
        )
        spec = envs.spec(training[0])
        state, logs = states.resume(run, folder, states.start(run, spec, demos), Callbacks(callbacks))
        state = state if logs else warm.started(run, state, Callbacks(callbacks).message)
        clock, log = states.Clock(state.counters.seconds), LogFiles(folder, logs, Callbacks(callbacks))
        told = Callbacks([log, TensorBoard(), *callbacks])
        stack.callback(told.end)
        told.begin(run, folder, log.history(clock.total(), demos_return))

        if state.counters.final_return is not None:
            states.save_policy(run, folder, state, training[0], state.counters.final_return, log.last_returns())
        saved = clock.total()
        while state.counters.final_return is None:
            with states.saved_on_failure(run, folder, state, log, clock) as refuse_divergence:
                if state.counters.frames >= min(state.counters.evaluations * run.evaluate_every, run.frames):
                    if run.keep_best:
                        states.keep_better(run, state, evaluation)
                    result = evaluate(state.policy(run), evaluation, seed=run.seed, episodes=run.evaluate_episodes)
                    told.evaluation(state.counters.frames, clock.total(), result)
                    state.counters = states.evaluated(run, state.counters, result.mean, demos_return)
                    states.save_policy(run, folder, state, training[0], result.mean, log.last_returns())
                    if state.counters.final_return is not None:
                        if state.counters.frames < run.frames:
                            told.message(
                                f"Two evaluations in a row reached {run.until:.0%} of the demonstrations' mean return."
                            )
                        states.save(folder, state, log.contents(), clock, keep_replay=run.keep_replay)
                        break
                first = state.counters.episodes + 1
                episodes = study(run, spec, state) if run.agent.offline else play(run, training, spec, state)
                refuse_divergence()
                kept = [labelled(run, state, episode, number) for number, episode in enumerate(episodes, start=first)]

            store(run, state, kept)
            means = states.take_means(state) | clock.times(state.counters.frames)
            with states.saved_anyway(folder, state, log, clock):
                for number, row in enumerate([episode.row for episode in kept] or [{}], start=first):
                    told.episode({"frames": state.counters.frames, "episode": number, **row, **means})
                stop = told.stop()

            if stop or clock.total() - saved >= run.checkpoint_seconds:
                states.save(folder, state, log.contents(), clock)
                saved = clock.total()
            if stop:
                raise Stopped
    return state
