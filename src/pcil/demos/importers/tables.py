"""Named columns of numbers, as most formats have them, and how they become episodes."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from pcil.errors import InputError

NAMES: dict[str, tuple[str, ...]] = {
    "obs": ("observations", "observation", "obs", "observation.state", "states", "state"),
    "action": ("actions", "action", "acts", "act"),
    "reward": ("rewards", "reward", "rews", "rew", "next.reward"),
    "next_obs": ("next_observations", "next_observation", "next_obs", "next_states", "next_state"),
    "terminated": ("terminals", "terminal", "terminations", "terminated", "dones", "done", "next.done"),
    "truncated": ("timeouts", "timeout", "truncations", "truncated", "next.truncated"),
    "episode": ("episode", "episodes", "episode_index", "episode_id", "episode_ids"),
    "ends": ("episode_ends",),
    "time": ("time", "t", "timestamp", "seconds"),
}
"""What columns are called, the most usual name first."""
COUNTERS = ("step", "index", "frame_index", "episode_index", "task_index")
"""Columns that number the rows; when nothing uses them, that is not worth a line."""


@dataclass
class Keys:
    """The names of columns that a user gave; what is empty is looked for among `NAMES`."""

    obs: Sequence[str] = ()
    action: Sequence[str] = ()
    reward: str | None = None
    episode: str | None = None


class Table(NamedTuple):
    """One episode as a file has it."""

    obs: np.ndarray
    """`[T, O]`, or `[T+1, O]` with the state after the last action."""
    action: np.ndarray | None
    reward: np.ndarray | None
    terminated: bool = False
    last: np.ndarray | None = None
    """The state after the last action, `[O]`, where `obs` has only T rows."""


@dataclass
class Source:
    """What one source holds."""

    format: str
    tables: list[Table]
    keys: dict[str, list[str]]
    """The columns that became observation, action and so on."""
    dropped: list[str] = field(default_factory=list)
    """What was left out, in words."""
    low: list[float] | None = None
    """The bounds of actions, where the source says them."""
    high: list[float] | None = None
    step_seconds: float | None = None
    task: str | None = None


def chosen(found: Mapping[str, np.ndarray], keys: Keys, where: str) -> tuple[dict[str, np.ndarray], dict[str, list[str]]]:
    """The columns that are used by what they mean (a key of `NAMES`), each as rows, and their names.

    Several columns of one meaning stand side by side. `InputError` if a named column is not there, or if there are no
    observations.
    """
    asked = {"obs": list(keys.obs), "action": list(keys.action)}
    asked |= {"reward": [keys.reward] if keys.reward else [], "episode": [keys.episode] if keys.episode else []}
    used: dict[str, np.ndarray] = {}
    names: dict[str, list[str]] = {}
    lower = {name.lower(): name for name in found}
    for meaning, usual in NAMES.items():
        wanted = asked.get(meaning) or next(([lower[name]] for name in usual if name in lower), [])
        if missing := [name for name in wanted if name not in found]:
            raise InputError(f"{where} has no column {missing[0]!r}; it has {', '.join(sorted(found)[:30])}.")
        if wanted:
            columns = [np.asarray(found[name]) for name in wanted]
            if meaning == "time" and not np.isfinite(columns[0]).all():
                continue  # such as dates
            if len({len(column) for column in columns}) > 1:
                raise InputError(f"The columns {', '.join(wanted)} of {where} have different lengths.")
            wide = [column.reshape(len(column), -1) if column.ndim < 3 else column for column in columns]
            used[meaning] = np.concatenate(wide, axis=-1)
            names[meaning] = wanted
    if "obs" not in used:
        raise InputError(
            f"{where} has no observations: none of its columns ({', '.join(sorted(found)[:30])}) is called "
            f"{', '.join(NAMES['obs'][:3])}; name them by --obs-keys."
        )
    if restarts(used).any():
        names["episode"] = [f"where {names['time'][0]} begins again"]
    return used, names


def restarts(used: Mapping[str, np.ndarray]) -> np.ndarray:
    """Whether each row but the first is earlier than the row before, in columns that have times but no episodes."""
    if "time" not in used or used["obs"].ndim == 3 or {"episode", "ends"} & used.keys():
        return np.zeros(0, bool)
    return np.diff(used["time"].reshape(-1).astype(np.float64)) < 0


def unnamed(found: Iterable[str], names: Mapping[str, Sequence[str]]) -> list[str]:
    """What of `found` no column of `names` took, apart from `COUNTERS`, as one entry of `Source.dropped`, or none."""
    taken = {name for columns in names.values() for name in columns}
    left = [name for name in found if name not in taken and name.lower() not in COUNTERS]
    return [f"{', '.join(left)}, which no key names"] if left else []


def split(used: Mapping[str, np.ndarray], where: str) -> list[Table]:
    """The episodes of columns as `chosen` gives them.

    An episode ends where its number changes; without numbers, with a row that is terminated or truncated, and before a row
    whose time is earlier; without any of these, all rows are one. Observations of three axes are `[episodes, T, O]`.
    """
    obs = used["obs"]
    if obs.ndim == 3:
        parts = [{name: column[i] for name, column in used.items() if column.ndim == 3} for i in range(len(obs))]
        flags = {name: column for name, column in used.items() if column.ndim == 2 and len(column) == len(obs)}
        parts = [part | {name: column[i].reshape(-1, 1) for name, column in flags.items()} for i, part in enumerate(parts)]
        return [table for part in parts for table in split(part, where)]
    rows = len(used["action"]) if "action" in used else len(obs)
    flags = {
        name: used[name].reshape(-1) != 0 if name in used else np.zeros(rows, bool) for name in ("terminated", "truncated")
    }
    lengths = {name: len(used[name]) for name in ("action", "reward", "next_obs", "terminated", "truncated") if name in used}
    if wrong := [f"{name} {length}" for name, length in lengths.items() if length not in (rows, len(obs))]:
        raise InputError(f"{where} has {len(obs)} observations, but {', '.join(wrong)} rows; each step needs one of each.")
    if len(obs) not in (rows, rows + 1):
        raise InputError(f"{where} has {len(obs)} observations for {rows} actions; there may be as many, or one more.")
    if "ends" in used:
        ends = used["ends"].reshape(-1).astype(int)
        if (np.diff(ends, prepend=0) <= 0).any() or ends[-1] > rows:
            raise InputError(f"{where} has episode_ends that do not rise from 1 to at most the {rows} rows.")
    elif "episode" in used:
        ends = np.append(np.flatnonzero(np.diff(used["episode"].reshape(-1)[:rows])) + 1, rows)
    else:
        over = flags["terminated"][:rows] | flags["truncated"][:rows]
        begun = np.flatnonzero(restarts(used)[: rows - 1]) + 1
        ends = np.unique(np.concatenate([np.flatnonzero(over) + 1, begun, [rows]]))
    made = []
    for start, end in zip([0, *ends[:-1]], ends, strict=True):
        whole = end == rows and len(obs) == rows + 1
        part = {name: used[name][start:end] for name in ("action", "reward") if name in used}
        last = used["next_obs"][end - 1] if "next_obs" in used and not whole else None
        reward = part["reward"].reshape(-1) if "reward" in part else None
        states = obs[start : end + whole]
        made.append(Table(states, part.get("action"), reward, bool(flags["terminated"][end - 1]), last))
    return made


def grouped(names: Sequence[str]) -> dict[str, list[int]]:
    """The positions of numbered columns (`obs_0`, `obs.1`, `obs[2]`, `obs3`) by the name before the number, and of each other
    column by its own name."""
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        numbered = re.fullmatch(r"(.*?[A-Za-z])[_.\[]?\d+\]?", name)
        groups.setdefault(numbered[1] if numbered else name, []).append(i)
    return groups


def step_seconds(used: Mapping[str, np.ndarray], tables: Sequence[Table]) -> float | None:
    """The time between two rows of the first episode, where it is always about the same."""
    if "time" not in used:
        return None
    between = np.diff(used["time"].reshape(-1)[: len(tables[0].obs)].astype(np.float64))
    usual = float(np.median(between)) if len(between) else 0.0
    return usual if usual > 0 and np.mean(np.abs(between - usual) < 0.01 * usual) > 0.9 else None
