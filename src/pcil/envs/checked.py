"""A wrapper that checks everything an environment returns; training, evaluation, recording and films all step this wrapper."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator, Mapping
from math import isfinite
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from pcil.errors import InputError, RunError, brief

_ARRAY, _FLOAT32 = np.ndarray, np.dtype(np.float32)
_LARGEST = float(np.finfo(np.float32).max)


class Checked(gymnasium.Wrapper):
    """An environment with flat, finite float32 observations, float rewards, and termination and truncation of type bool.

    Dicts and Tuples of Boxes, also nested ones, are flattened in the order of `gymnasium.spaces.flatten`. `InputError` is
    raised if the environment violates its spaces or Gymnasium's interface, and `RunError` if it raises an exception, or if an
    observation, a reward or an action is not finite in float32. Values outside the bounds of a Box are accepted.
    """

    episode: str | None = None
    """The name of the next episode in error messages; set it before `reset`. By default episodes are numbered."""

    def __init__(self, env: gymnasium.Env, name: str, longest: int | None = None) -> None:
        """`name` is used in error messages; an episode of more than `longest` steps is refused as endless."""
        super().__init__(env)
        space = env.observation_space
        if not _is_of_boxes(space) or not spaces.flatdim(space):
            raise InputError(
                f"The observations of {name!r} must be a Box or a Dict of Boxes, or Dicts and Tuples of these, and hold a "
                f"number; they are {space}."
            )
        flat: Any = spaces.flatten_space(space)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*precision lowered by casting")  # the cast to float32 is intended
            self.observation_space = spaces.Box(flat.low, flat.high, flat.shape, np.float32)
        self._name, self._longest, self._inner_space = name, longest, space
        self._shape = space.shape if isinstance(space, spaces.Box) and len(space.shape) == 1 else None
        self._action_shape = env.action_space.shape
        self._steps, self._episodes, self._seed = 0, 0, None

    @property
    def spec(self) -> Any:
        """The spec of the wrapped environment; this wrapper does not add itself to it."""
        return self.env.spec

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        self._steps, self._episodes, self._seed = 0, self._episodes + 1, seed
        try:
            result = self.env.reset(seed=seed, options=options)
        except InputError:
            raise
        except (Exception, SystemExit) as error:  # a user's environment may raise anything
            if isinstance(error, TypeError) and re.search("unexpected keyword argument '(seed|options)'", str(error)):
                raise InputError(
                    f"The environment {self._name!r} can't be reset with a seed ({error}); its reset must take the keywords "
                    "seed and options."
                ) from error
            raise self._raised(error) from error
        if not isinstance(result, (tuple, list)) or len(result) != 2 or not isinstance(result[1], Mapping | None):
            raise self._refused(result, "from reset", "(observation, info), the info a dict")
        return self._observation(result[0]), dict(result[1] or {})

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, Any]:
        if not _is_plain(action, self._action_shape):
            action = self.checked_action(action)
        self._steps += 1
        if self._longest is not None and self._steps > self._longest:
            raise InputError(
                f"An episode of {self._name!r} has not ended after {self._longest:,} steps, and runs need its end: "
                "register the environment with max_episode_steps."
            )
        try:
            result = self.env.step(action)
        except InputError:
            raise
        except (Exception, SystemExit) as error:
            if "unpack" in str(error) and _raised_in_gymnasium(error):
                raise InputError(
                    f"The environment {self._name!r} returned something else than (observation, reward, terminated, truncated, "
                    f"info) from step ({error}), {self._place()}."
                ) from error
            raise self._raised(error) from error
        if not isinstance(result, (tuple, list)) or len(result) != 5:
            raise self._refused(result, "from step", "(observation, reward, terminated, truncated, info)")
        obs, reward, terminated, truncated, info = result
        row = obs.copy() if _is_plain(obs, self._shape) else self._observation(obs)
        if type(reward) is not float or not -_LARGEST <= reward <= _LARGEST:
            reward = self._reward(reward)
        if type(terminated) is not bool:
            terminated = self._flag(terminated, "termination")
        if type(truncated) is not bool:
            truncated = self._flag(truncated, "truncation")
        if type(info) is not dict:
            if not isinstance(info, Mapping | None):
                raise self._refused(info, "as info", "a dict")
            info = dict(info or {})
        return row, reward, terminated, truncated, info

    def close(self) -> None:
        """Close the environment. An exception is only reported as a warning, since the results are complete by then."""
        try:
            self.env.close()
        except Exception as error:
            warnings.warn(f"The environment {self._name!r} raised {_said(error)} when it was closed.", stacklevel=2)

    def _observation(self, obs: Any) -> np.ndarray:
        """A flat float32 copy: the environment may reuse its buffer."""
        with np.errstate(over="ignore"):  # values too large for float32 become infinite and are refused below
            parts = [part.ravel().astype(np.float32) for _, part in self._parts(self._inner_space, obs, "observation")]
            row = np.concatenate(parts)
            if np.isfinite(row).all():
                return row
            for path, part in self._parts(self._inner_space, obs, "observation"):
                if where := np.argwhere(~np.isfinite(part.astype(np.float32))).tolist():
                    raise self._not_finite(part[tuple(where[0])], f"returned an {path} whose {_entry(where[0])}")
        raise AssertionError("one of the parts must have a value that is not finite")

    def _parts(self, space: spaces.Space, value: Any, path: str) -> Iterator[tuple[str, np.ndarray]]:
        """The path and the array of each Box in a space, in Gymnasium's flattening order."""
        if isinstance(space, spaces.Dict):
            if not isinstance(value, Mapping):
                raise self._refused(value, f"as {path}", f"a dict with the keys {_listed(space.spaces)}")
            if missing := [key for key in space.spaces if key not in value]:
                raise self._refused(value, f"without {missing[0]!r} as {path}", f"a dict with the keys {_listed(space.spaces)}")
            for key, inner in space.spaces.items():
                yield from self._parts(inner, value[key], f"{path}[{key!r}]")
        elif isinstance(space, spaces.Tuple):
            if not isinstance(value, (tuple, list)) or len(value) != len(space.spaces):
                raise self._refused(value, f"as {path}", f"a tuple of {len(space.spaces)}")
            for i, inner in enumerate(space.spaces):
                yield from self._parts(inner, value[i], f"{path}[{i}]")
        else:
            array = real_numbers(value)
            if array is None or array.shape != space.shape:
                raise self._refused(value, f"as {path}", f"real numbers of shape {space.shape}, as its space says")
            yield path, array

    def _reward(self, reward: Any) -> float:
        array = real_numbers(reward)
        if array is None or array.size != 1:
            raise self._refused(reward, "as reward", "a number")
        number = float(array.item())
        if not -_LARGEST <= number <= _LARGEST:
            raise self._not_finite(number, "returned a reward that")
        return number

    def _flag(self, value: Any, what: str) -> bool:
        array = real_numbers(value)
        if array is None or array.size != 1 or array.dtype.kind == "f" or array.item() not in (0, 1):
            raise self._refused(value, f"as {what}", "True or False")
        return bool(array.item())

    def checked_action(self, action: Any) -> np.ndarray:
        """The action as an array; `InputError` if it has another shape or is not numeric, `RunError` if it is not finite."""
        array = real_numbers(action)
        if array is None or array.shape != self._action_shape:
            raise InputError(
                f"The action for {self._name!r} is {brief(action)}, {self._place(1)}; it must be real numbers of shape "
                f"{self._action_shape}."
            )
        if not np.isfinite(array).all():
            where = np.argwhere(~np.isfinite(array)).tolist()[0]
            raise self._not_finite(array[tuple(where)], f"was to be given an action whose {_entry(where)}", 1)
        return array

    def _place(self, ahead: int = 0) -> str:
        """The step and the episode, for error messages; with `ahead` 1 the next step."""
        step = self._steps + ahead
        seed = "" if self._seed is None else f" (seed {self._seed})"
        return f"{f'in step {step}' if step else 'at the start'} of {self.episode or f'episode {self._episodes}'}{seed}"

    def _refused(self, value: Any, how: str, expected: str) -> InputError:
        given = f"{len(value)} values" if how.startswith("from") and isinstance(value, (tuple, list)) else brief(value)
        return InputError(f"The environment {self._name!r} returned {given} {how}, {self._place()}; it must be {expected}.")

    def _not_finite(self, value: Any, whose: str, ahead: int = 0) -> RunError:
        wide = ", too large for float32" if np.isfinite(value) else ""
        return RunError(f"The environment {self._name!r} {whose} is {float(value)!r}{wide}, {self._place(ahead)}.")

    def _raised(self, error: BaseException) -> RunError:
        return RunError(f"The environment {self._name!r} raised {_said(error)}, {self._place()}.")


def checked(env: gymnasium.Env) -> Checked:
    """The environment wrapped in `Checked`, unless it is already."""
    return env if isinstance(env, Checked) else Checked(env, env.spec.id if env.spec else type(env.unwrapped).__name__)


def _is_plain(array: Any, shape: tuple[int, ...] | None) -> bool:
    """Whether it is what nearly all are, a finite float32 vector of this shape: a quick test in each step.

    The sum of squares is infinite for large finite values too, which the slower test of all else then takes.
    """
    if type(array) is not _ARRAY or array.dtype is not _FLOAT32 or array.shape != shape:
        return False
    return isfinite(sum(array.tolist()) if array.size < 32 else np.vdot(array, array))


def _is_of_boxes(space: Any) -> bool:
    if isinstance(space, (spaces.Dict, spaces.Tuple)):
        inner = space.spaces.values() if isinstance(space, spaces.Dict) else space.spaces
        return len(inner) > 0 and all(map(_is_of_boxes, inner))
    return isinstance(space, spaces.Box)


def real_numbers(value: Any) -> np.ndarray | None:
    """The value as an array of real numbers or bools; None for everything else, and if entries are masked."""
    try:
        array = np.asarray(value)
    except Exception:  # such as ragged lists, or an array on a GPU
        return None
    return None if array.dtype.kind not in "fiub" or np.ma.is_masked(value) else array


def _entry(where: list[int]) -> str:
    return f"entry {where[0] if len(where) == 1 else tuple(where)}" if where else "value"


def _listed(keys: Any) -> str:
    return ", ".join(map(repr, keys))


def _said(error: BaseException) -> str:
    """The type and the message of an exception on one line."""
    text = " ".join(str(error).split()).removesuffix(".")
    return f"{type(error).__name__} ({text})" if text else type(error).__name__


def _raised_in_gymnasium(error: BaseException) -> bool:
    """Whether the exception was raised by a wrapper of Gymnasium's, not by the environment inside."""
    trace = error.__traceback__
    while trace and trace.tb_next:
        trace = trace.tb_next
    return trace is not None and trace.tb_frame.f_globals.get("__name__", "").startswith("gymnasium.wrappers")
