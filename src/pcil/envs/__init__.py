"""Environments by name: `make("walker_walk")` or any Gymnasium id, always with flat float32 Boxes as spaces."""

from __future__ import annotations

import contextlib
import difflib
import inspect
import json
from collections.abc import Iterator
from typing import Any, NoReturn

import gymnasium
import numpy as np
from gymnasium import spaces, wrappers

from pcil.envs.checked import Checked, checked
from pcil.errors import InputError, brief, json_object
from pcil.types import Origin, Spec

__all__ = ["TASKS", "Checked", "checked", "ends_early", "make", "opened", "register", "spec", "task_name"]

TASKS = (
    "finger_spin",
    "hopper_stand",
    "pendulum_swingup",
    "walker_stand",
    "walker_walk",
    "acrobot_swingup",
    "cheetah_run",
    "hopper_hop",
    "quadruped_run",
    "walker_run",
)
"""The ten tasks of the paper (Appendix A), all from DeepMind Control."""

LONGEST_EPISODE = 100_000
"""The number of steps after which an episode without a time limit is considered endless."""

BOUNDS = "action-bounds"
"""The name, among the arguments of an environment, of bounds `[low, high]` for actions that have none. It is no keyword."""

_GIVEN = ("object ", "function ")
"""The prefixes of the names of environments that were passed from Python, as an object or as a function."""

SUITES: dict[str, dict[str, tuple[str, dict[str, Any]]]] = {
    "dmc": {task: ("pcil.envs.dmc:DMCEnv", {"task": task}) for task in TASKS},
    "toy": {
        "point_mass": ("pcil.envs.toy:PointMass", {}),
        "reach": ("pcil.envs.toy:Reach", {}),
        "probe_1": ("pcil.envs.toy:ConstantReward", {}),
        "probe_2": ("pcil.envs.toy:ObservedReward", {}),
        "probe_3": ("pcil.envs.toy:DelayedReward", {}),
        "probe_4": ("pcil.envs.toy:ActionReward", {}),
        "probe_5": ("pcil.envs.toy:ObservedActionReward", {}),
    },
}
"""The environments of this package: entry point and keyword arguments of `<suite>/<name>-v0`, by suite and by name."""


def register() -> None:
    """Register the environments of `SUITES` with Gymnasium; those that are registered already stay as they are."""
    for suite, environments in SUITES.items():
        for name, (entry_point, kwargs) in environments.items():
            _register(f"{suite}/{name}-v0", entry_point, **kwargs)


def _register(env_id: str, entry_point: str, **kwargs: Any) -> None:
    """Register one environment so that `gymnasium.make` adds no wrappers."""
    if env_id not in gymnasium.registry:
        gymnasium.register(env_id, entry_point, kwargs=kwargs, disable_env_checker=True, order_enforce=False)


def dmc_id(task: str) -> str:
    """The Gymnasium id of a task of DeepMind Control."""
    return f"dmc/{task}-v0"


def task_name(task: Any) -> str:
    """The short name of a task in results: "walker_walk" for "dmc/walker_walk-v0"; other ids are returned unchanged.

    For an environment, or a function that creates one, the name says so; `make` does not accept such a name.
    """
    if isinstance(task, str):
        return task.removeprefix("dmc/").removesuffix("-v0") if task.startswith("dmc/") else task
    if isinstance(task, gymnasium.Env):
        return f"{_GIVEN[0]}{type(task.unwrapped).__module__}.{type(task.unwrapped).__qualname__}"
    if callable(task):
        named = task if inspect.isroutine(task) or isinstance(task, type) else type(task)
        return f"{_GIVEN[1]}{named.__module__}.{named.__qualname__}"
    raise InputError(f"The task is {brief(task)}; it must be a name, a function that makes an environment, or a gymnasium.Env.")


def make(task: Any, render_mode: str | None = None, *, env_kwargs: dict[str, Any] | None = None) -> Checked:
    """Create the environment of a task, with a flat float32 `Box` observation and a float32 `Box(-1, 1)` action.

    `task` is a task of the DeepMind Control suite ("walker_walk" or "dmc/walker_walk-v0"), a toy ("toy/point_mass-v0"), any
    Gymnasium id, a function that creates an environment, or an environment. `env_kwargs` are passed to `gymnasium.make` or to
    the function, except `action-bounds`, the bounds `[low, high]` of actions that have none. The environment's observations may
    be Boxes, or Dicts and Tuples of Boxes. They are flattened, actions are rescaled, and all return values are checked
    (`pcil.envs.checked:Checked`).
    """
    arguments = dict(env_kwargs or {})
    bounds = arguments.pop(BOUNDS, None)
    env = task if isinstance(task, gymnasium.Env) else _made(task, render_mode, arguments)
    if isinstance(env, Checked):
        return env
    registered = env.spec
    own = registered is not None and registered.namespace in SUITES
    limited = own or (registered is not None and registered.max_episode_steps is not None)
    try:
        return Checked(_flat_actions(env, task_name(task), bounds), task_name(task), None if limited else LONGEST_EPISODE)
    except Exception as error:
        if env is not task:
            env.close()
        if isinstance(error, InputError):
            raise
        raise InputError(f"The environment {task_name(task)!r} can't be used ({type(error).__name__}: {error}).") from error


@contextlib.contextmanager
def opened(task: Any, render_mode: str | None = None, *, env_kwargs: dict[str, Any] | None = None) -> Iterator[Checked]:
    """`make` as a context manager that closes the environment, unless it was passed as an object: then its owner closes it."""
    env = make(task, render_mode, env_kwargs=env_kwargs)
    try:
        yield env
    finally:
        if not isinstance(task, gymnasium.Env):
            env.close()


def _made(task: Any, render_mode: str | None, env_kwargs: dict[str, Any] | None) -> gymnasium.Env:
    """The environment as Gymnasium or the user's function creates it."""
    if not isinstance(task, str):
        return _returned(task, env_kwargs or {})
    if task.startswith(_GIVEN):
        raise InputError(f"The environment of this run was given in Python ({task}), so it can't be made by name.")
    register()
    arguments = json_object("env_kwargs", env_kwargs or {})
    env_id = gymnasium_id(task)
    if render_mode is not None and env_id.startswith("toy/"):
        raise InputError(f"{task!r} has no pictures; render_mode must be None.")
    if "task" in arguments and env_id.startswith("dmc/"):
        raise InputError(f"env_kwargs has the task {arguments['task']!r}; the task is {task!r}, and arguments can't change it.")
    if render_mode is not None:
        arguments["render_mode"] = render_mode
    try:
        return gymnasium.make(env_id, disable_env_checker=True, **arguments)
    except InputError as error:
        raise InputError(f"The environment {task!r} can't be made: {error}") from error
    except (gymnasium.error.DependencyNotInstalled, ImportError) as error:
        robot = str(getattr(gymnasium.registry.get(env_id), "entry_point", "")).startswith("gymnasium.envs.mujoco")
        hint = f'{str(error).removesuffix(".")}; pip install "gymnasium[mujoco]" brings it.' if robot else str(error)
        raise InputError(f"The environment {task!r} needs a package that is not installed: {hint}") from error
    except gymnasium.error.Error as error:
        if env_id.rpartition(":")[2] not in gymnasium.registry:
            _refuse_name(task, error)
        raise InputError(f"Gymnasium cannot make {task!r}: {error}") from error
    except Exception as error:  # the environment may be a user's own and may raise anything
        given = f" with {json.dumps(env_kwargs)}" if env_kwargs else ""
        raise InputError(f"The environment {task!r} can't be made{given} ({type(error).__name__}: {error}).") from error


def _returned(function: Any, env_kwargs: dict[str, Any]) -> gymnasium.Env:
    """The environment that the user's function creates."""
    name = task_name(function)
    try:
        env = function(**env_kwargs)
    except InputError:
        raise
    except Exception as error:
        raise InputError(f"The environment of {name} can't be made ({type(error).__name__}: {error}).") from error
    if not isinstance(env, gymnasium.Env):
        raise InputError(f"The {name} returned {brief(env)}; it must return a gymnasium.Env.")
    return env


def spec(env: gymnasium.Env) -> Spec:
    """The sizes of an environment that `make` has created, and its number of control steps (frames) per step."""
    inner = env.unwrapped
    ours = any(kind.__module__.startswith("pcil.envs.") for kind in type(inner).__mro__)
    action_repeat = getattr(inner, "action_repeat", 1) if ours else 1
    return Spec(spaces.flatdim(env.observation_space), spaces.flatdim(env.action_space), action_repeat)


def ends_early(env: gymnasium.Env) -> bool:
    """Whether an episode may terminate: True unless the environment has an attribute `ends_early` that is False."""
    return bool(getattr(env.unwrapped, "ends_early", True))


def origin(env: gymnasium.Env) -> Origin:
    """The description of `env` that is stored with demonstrations recorded in it."""
    inner, outer = env.unwrapped, env
    while isinstance(outer, gymnasium.Wrapper) and not isinstance(outer, _RescaleAction):
        outer = outer.env
    box = outer.env.action_space if isinstance(outer, _RescaleAction) else env.action_space
    seconds = getattr(inner, "dt", None)
    known = Origin(step_seconds=float(seconds) if isinstance(seconds, float | int) else None)
    if isinstance(box, spaces.Box):
        known = known._replace(action_low=box.low.ravel().tolist(), action_high=box.high.ravel().tolist())
    if inner.spec is None:
        return known
    entry_point = inner.spec.entry_point if isinstance(inner.spec.entry_point, str) else None
    return known._replace(env_id=inner.spec.id, entry_point=entry_point, kwargs=known_arguments(inner.spec.kwargs))


def known_arguments(kwargs: dict[str, Any]) -> dict[str, Any]:
    """The keyword arguments that JSON can represent, without `render_mode`."""
    known = {}
    for name, value in kwargs.items():
        with contextlib.suppress(InputError):
            known |= json_object(name, {name: value}) if name != "render_mode" else {}
    return known


class _RescaleAction(wrappers.RescaleAction):
    """A class of its own, to tell our wrapper from one that the environment was registered with."""


def gymnasium_id(task: str) -> str:
    """The registered id for a name. Tasks of the DeepMind Control suite beyond the ten are registered on demand."""
    name = task_name(task)
    if dmc_id(name) in gymnasium.registry:
        return dmc_id(name)
    if name.isidentifier() and name in _suite_tasks():
        _register(dmc_id(name), "pcil.envs.dmc:DMCEnv", task=name)
        return dmc_id(name)
    return task


def _suite_tasks() -> list[str]:
    """The names of all tasks of the DeepMind Control suite; none if it is not installed. The import takes half a second."""
    from pcil.envs.dmc import import_suite

    try:
        return [f"{domain}_{name}" for domain, name in import_suite().ALL_TASKS]
    except InputError:
        return []


def _refuse_name(task: str, error: Exception) -> NoReturn:
    suite = _suite_tasks()
    near = difflib.get_close_matches(task, [*TASKS, *gymnasium.registry, *suite], n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    hint += "" if suite else " where DeepMind Control is not installed"
    raise InputError(
        f"There is no environment {task!r}{hint}: give one of {', '.join(TASKS)}, another task of DeepMind Control's "
        "suite, or any Gymnasium id."
    ) from error


def _flat_actions(env: gymnasium.Env, task: str, bounds: Any) -> gymnasium.Env:
    space = env.action_space
    if not isinstance(space, spaces.Box) or space.shape in ((), (0,)) or len(space.shape) > 1 or space.dtype.kind != "f":
        raise InputError(f"The actions of {task!r} must be a flat Box of real numbers; they are {space}.")
    if bounds is not None:
        env, space = _bounded(env, space, bounds, task)
    if not space.is_bounded():
        raise InputError(
            f"The actions of {task!r} must have finite bounds; they are {space}, and --action-bounds LOW HIGH gives them some."
        )
    dtype = space.dtype
    if np.any(space.low != -1.0) or np.any(space.high != 1.0):
        one = np.ones(space.shape, dtype)
        env = _RescaleAction(env, -one, one)
    if dtype != np.float32:
        box = spaces.Box(-1.0, 1.0, space.shape, np.float32)
        env = wrappers.TransformAction(env, lambda action: np.asarray(action, dtype), box)
    return env


def _bounded(env: gymnasium.Env, space: spaces.Box, bounds: Any, task: str) -> tuple[gymnasium.Env, spaces.Box]:
    """The environment with actions between `bounds` where they have none, and its box of actions."""
    match bounds:
        case [int() | float() as low, int() | float() as high] if -np.inf < low < high < np.inf:
            pass
        case _:
            raise InputError(f"The bounds of the actions are {brief(bounds)}; they must be two numbers, the lower one first.")
    if space.is_bounded():
        raise InputError(f"The actions of {task!r} are in {space} already; leave out --action-bounds.")
    low = np.where(np.isfinite(space.low), space.low, space.dtype.type(low))
    high = np.where(np.isfinite(space.high), space.high, space.dtype.type(high))
    if np.any(low >= high):
        raise InputError(f"The bounds {bounds} don't fit the actions of {task!r}, which are {space}.")
    box = spaces.Box(low, high, dtype=space.dtype.type)
    return wrappers.TransformAction(env, lambda action: action, box), box


register()
