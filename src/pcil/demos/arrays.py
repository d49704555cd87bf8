"""Episodes from plain arrays, with a check of everything that a user may pass."""

from __future__ import annotations

from typing import Any

import numpy as np

from pcil.errors import InputError
from pcil.types import Episode


def episodes_of(obs: Any, actions: Any, rewards: Any, terminated: Any) -> tuple[Episode, ...]:
    """One episode per entry of `obs`; the arguments are those of `Demonstrations.from_arrays`.

    Missing actions become arrays of shape `[T, 0]`, and missing rewards become 0. `InputError` names the first invalid array.
    """
    obs = _listed("obs", obs)
    count = len(obs)
    if not count:
        raise InputError("obs holds no episodes; it must be a list of arrays [T+1, O], one for each episode.")
    flags = _listed("terminated", [False] * count if terminated is None else terminated, count)
    actions = None if actions is None else _listed("actions", actions, count)
    rewards = None if rewards is None else _listed("rewards", rewards, count)
    episodes = []
    for index in range(count):
        states = _numbers(f"obs[{index}]", obs[index], "[T+1, O]").astype(np.float32)
        steps = len(states) - 1
        if steps < 1:
            raise InputError(
                f"obs[{index}] has {len(states)} rows; it must have at least two, one more than there are actions."
            )
        action, reward = np.zeros((steps, 0), np.float32), np.zeros(steps)
        if actions is not None:
            action = _numbers(f"actions[{index}]", actions[index], "[T, A]", steps).astype(np.float32)
        if rewards is not None:
            reward = _numbers(f"rewards[{index}]", rewards[index], "[T]", steps)
        if not isinstance(flags[index], bool | np.bool_):
            raise InputError(f"terminated[{index}] is {flags[index]!r:.80}; it must be True or False.")
        episodes.append(Episode(states, action, reward, bool(flags[index])))
    return tuple(episodes)


def to_unit_box(actions: Any, low: Any, high: Any) -> np.ndarray:
    """Actions rescaled from `[low, high]` to [-1, 1]."""
    return (actions - (high + low) / 2) / ((high - low) / 2)


def _listed(name: str, values: Any, count: int | None = None) -> list[Any]:
    """`values` as a list, which must have `count` entries if that is given."""
    try:
        values = list(values)
    except TypeError:
        given = type(values).__name__
        raise InputError(f"{name} is of type {given}; it must be a list with one entry for each episode.") from None
    if count is not None and len(values) != count:
        raise InputError(f"{name} has {len(values)} entries, but obs has {count}; each episode needs one.")
    return values


def _numbers(name: str, value: Any, shape: str, rows: int | None = None) -> np.ndarray:
    """`value` as a float64 array of finite numbers with the rank of `shape` and, if given, this number of `rows`."""
    try:
        array = np.asarray(value)
    except ValueError:
        raise InputError(f"{name} is ragged; it must be an array {shape}.") from None
    rank = shape.count(",") + 1
    if array.dtype.kind not in "fiub":
        raise InputError(f"{name} holds {array.dtype} values; it must be an array {shape} of numbers.")
    if array.ndim != rank or 0 in array.shape[1:]:
        raise InputError(f"{name} has shape {array.shape}; it must be an array {shape} of at least one number in each row.")
    if rows is not None and len(array) != rows:
        raise InputError(f"{name} has {len(array)} rows; it must have {rows}, one fewer than there are observations.")
    with np.errstate(over="ignore"):
        if not np.isfinite(array.astype(np.float32)).all():
            raise InputError(f"{name} holds NaN, infinite or too large values; all must be finite in float32.")
    return array.astype(np.float64)
