"""Whether demonstrations fit a run, and which of its settings they decide."""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import load_env_creator, registry

from pcil import envs
from pcil.demos import Demonstrations
from pcil.demos.arrays import to_unit_box
from pcil.errors import InputError
from pcil.training.config import Run, changed
from pcil.types import Origin


def fitted(run: Run, demos: Demonstrations, env: gymnasium.Env, say: Callable[[str], None]) -> Demonstrations:
    """The demonstrations as the run uses them in `env`, with actions of the environment's width.

    `InputError` where something that the method reads is absent, or where something is of another environment than `env` and
    `run.demos_mismatch` does not accept that. What differs and is accepted, and what is clipped, is told to `say`.
    """
    for part, needed in (("actions", run.needs_actions), ("rewards", run.needs_rewards)):
        if needed and not getattr(demos, f"has_{part}"):
            raise InputError(
                f"The demonstrations of {demos.task} have no {part}, which {run.method} with these settings reads; give "
                "demonstrations that have them, or take a method that reads states alone, such as pcil."
            )
    told: list[str] = []
    demos = _of_this_environment(run, demos, env, told.append)
    if run.clip_actions and demos.has_actions:
        demos = _clipped(demos, told.append)
    if not demos.has_actions:
        width = envs.spec(env).action_dim
        episodes = (dataclasses.replace(e, action=np.zeros((len(e), width), np.float32)) for e in demos.episodes)
        demos = dataclasses.replace(demos, episodes=tuple(episodes))
    demos.validate(envs.spec(env))
    for text in told:
        say(text)
    return demos


def with_absorbing_decided(run: Run, demos: Demonstrations | None, ends_early: bool) -> tuple[Run, str]:
    """The run with `agent.absorbing` decided, and the reason in words; `ends_early` says whether its episodes may terminate.

    Without the absorbing state an early end is worth 0 to the agent: where learned rewards are positive it avoids a goal that
    ends the episode, and where they are negative it gives up early (Kostrikov et al. 2019, section 4.2).
    """
    if run.agent.absorbing is not None:
        return run, "as agent.absorbing says"
    ended = sum(episode.terminated for episode in demos.episodes) if demos else 0
    if run.agent.offline or not run.reward.needs_demos:
        absorbing, why = False, "no reward is learned"
    elif demos and ended:
        absorbing, why = True, f"{ended} of {len(demos.episodes)} demonstrations end early"
    else:
        absorbing = ends_early
        why = f"an episode of {run.task} may end early" if absorbing else f"no episode of {run.task} ends early"
    return changed(run, {"agent.absorbing": absorbing}), why


def with_cloning_decided(run: Run, demos: Demonstrations | None, say: Callable[[str], None]) -> Run:
    """The run with `agent.cloning` decided; `InputError` where it is asked for and there are no actions to clone."""
    actions = demos is not None and demos.has_actions
    if run.agent.clones and not actions:
        raise InputError(
            f"agent.cloning needs the actions of demonstrations, and {'these have none' if demos else 'this run reads none'}; "
            "leave it out."
        )
    if run.agent.clones is not None:
        return run
    if demos and not actions:
        say("The demonstrations have no actions, so the actor learns from the reward alone (agent.cloning False).")
    return changed(run, {"agent.cloning": actions})


def _clipped(demos: Demonstrations, say: Callable[[str], None]) -> Demonstrations:
    beyond = np.abs(demos.action) - 1
    number = int((beyond > 0).sum())
    if number:
        say(f"Clipped {number} of {beyond.size} entries of the demonstrations' actions, by at most {beyond.max():.3g}.")
    return demos.clip()


def _of_this_environment(run: Run, demos: Demonstrations, env: gymnasium.Env, say: Callable[[str], None]) -> Demonstrations:
    """The demonstrations, with actions as `run.demos_mismatch` wants them where their box is another."""
    theirs, ours = demos.origin, envs.origin(env)
    other_box = demos.has_actions and _other_box(theirs, ours)
    arguments = _other_arguments(run, theirs, ours, env)
    told, ways = [], []
    if other_box:
        told.append(f"their actions are in {_box(theirs)}, and here they are in {_box(ours)}")
    if arguments:
        told += [
            f"{name} is {json.dumps(value)} there and {json.dumps(mine)} here" for name, (value, mine) in arguments.items()
        ]
        same = json.dumps(run.env_kwargs | {name: value for name, (value, _) in arguments.items()})
        ways.append(f"--env-kwargs '{same}' trains in the environment of the demonstrations")
    elif theirs.step_seconds and ours.step_seconds and not math.isclose(theirs.step_seconds, ours.step_seconds, rel_tol=1e-6):
        told.append(f"a step takes {theirs.step_seconds:.6g} s there and {ours.step_seconds:.6g} s here")
    if told and run.demos_mismatch == "refuse":
        ways.append("--demos-mismatch scale trains here with their actions scaled from their box to this one")
        ways.append("--demos-mismatch keep trains here with the values of their actions kept")
        if not other_box:
            ways[-2:] = ["--demos-mismatch keep trains here all the same"]
        raise InputError(
            f"The demonstrations of {demos.task} were recorded in another environment than {run.task} is: {'; '.join(told)} "
            f"({', or '.join(ways)})."
        )
    if theirs.env_id and ours.env_id and theirs.env_id != ours.env_id:
        told.insert(0, f"their environment is {theirs.env_id}, this one {ours.env_id}")
    if told:
        say(f"The demonstrations were recorded in another environment: {'; '.join(told)}.")
    return _kept(demos, ours) if other_box and run.demos_mismatch == "keep" else demos


def _other_box(theirs: Origin, ours: Origin) -> bool:
    """Whether two action boxes of one shape are both known and differ by more than rounding."""
    boxes = [theirs.action_low, theirs.action_high, ours.action_low, ours.action_high]
    if None in boxes or len({len(bound or ()) for bound in boxes}) > 1:
        return False
    low, high, our_low, our_high = (np.array(bound) for bound in boxes)
    scale = 1e-5 * (our_high - our_low)
    return bool(((abs(low - our_low) > scale) | (abs(high - our_high) > scale)).any())


def _kept(demos: Demonstrations, ours: Origin) -> Demonstrations:
    """The demonstrations with the recorded values of their actions, measured in our box."""
    low, high, our_low, our_high = (
        np.array(bound) for bound in (demos.origin.action_low, demos.origin.action_high, ours.action_low, ours.action_high)
    )
    episodes = []
    for episode in demos.episodes:
        values = (high + low) / 2 + (high - low) / 2 * episode.action.astype(np.float64)
        action = to_unit_box(values, our_low, our_high).astype(np.float32)
        episodes.append(dataclasses.replace(episode, action=action))
    return dataclasses.replace(demos, episodes=tuple(episodes))


def _other_arguments(run: Run, theirs: Origin, ours: Origin, env: gymnasium.Env) -> dict[str, tuple[Any, Any]]:
    """Arguments of the environment that differ, with their value and ours, as far as both are known.

    Of two environments of different ids only those are compared that one of them was given beyond its registration: what an id
    is registered with is what the id means.
    """
    if theirs.kwargs is None or ours.kwargs is None or env.unwrapped.spec is None:
        return {}
    registered = registry[theirs.env_id].kwargs if theirs.env_id in registry else {}
    same_code = theirs.entry_point == ours.entry_point is not None
    defaults = _defaults(env.unwrapped.spec.entry_point) if same_code else {}
    registered = envs.known_arguments(registered)
    there, here = defaults | registered | theirs.kwargs, defaults | ours.kwargs
    names = here.keys() & there.keys()
    if theirs.env_id != ours.env_id:
        given = {name for name, value in theirs.kwargs.items() if name not in registered or registered[name] != value}
        names &= given | run.env_kwargs.keys()
    return {name: (there[name], here[name]) for name in sorted(names - {"render_mode"}) if there[name] != here[name]}


def _defaults(entry_point: Any) -> dict[str, Any]:
    """What an environment's arguments are where they are not given."""
    try:
        parameters = inspect.signature(
            load_env_creator(entry_point) if isinstance(entry_point, str) else entry_point
        ).parameters
    except (TypeError, ValueError):
        return {}
    given = {name: parameter.default for name, parameter in parameters.items() if parameter.default is not parameter.empty}
    return envs.known_arguments(given)


def _box(origin: Origin) -> str:
    """An action box for a sentence: one pair of bounds where all entries have the same."""
    low, high = (sorted(set(bound or ())) for bound in (origin.action_low, origin.action_high))
    low, high = (bound[0] if len(bound) == 1 else whole for bound, whole in zip((low, high), origin[3:5], strict=True))
    return f"[{low}, {high}]"
