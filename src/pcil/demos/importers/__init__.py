"""Demonstrations from other people's files: NumPy, CSV, D4RL, robomimic, LeRobot and Minari, recognised by their content."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pcil.demos import Demonstrations
from pcil.demos.arrays import to_unit_box
from pcil.demos.importers.arrays import is_csv, is_npz, read_csv, read_npz
from pcil.demos.importers.hdf5 import is_hdf5, read_hdf5
from pcil.demos.importers.lerobot import is_lerobot, read_lerobot
from pcil.demos.importers.tables import Keys, Source, Table
from pcil.errors import InputError
from pcil.types import Origin

FORMATS: list[tuple[Callable[[Path], bool], Callable[[Path, Keys], Source]]] = [
    (is_lerobot, read_lerobot),
    (is_npz, read_npz),
    (is_hdf5, read_hdf5),
    (is_csv, read_csv),
]
"""What recognises a file or a folder, and what reads it."""


Bounds = tuple[float | int, float | int]


@dataclass(frozen=True)
class Imported:
    """Demonstrations and how they were read."""

    demos: Demonstrations
    told: list[str]
    """What was found and what was left out, a line each."""


def load(
    sources: Sequence[Path],
    keys: Keys | None = None,
    *,
    task: str | None = None,
    bounds: Bounds | None = None,
    clip: bool = False,
    step_seconds: float | None = None,
) -> Imported:
    """Read the episodes of all sources as one set of demonstrations.

    `bounds` are those of the environment's own actions. Without them, actions are taken as they are if all are in [-1, 1].
    `clip` clips those outside. Where a file has as many states as actions, and does not say what came after the last one, the
    last action is left out. `InputError` in one sentence says what is wrong.
    """
    keys = keys or Keys()
    found = [each for source in sources for each in _sources(source, keys)]
    tables = [table for source in found for table in source.tables]
    whole, cut, short = [], 0, 0
    for table in tables:
        obs, action, reward, terminated = _aligned(table)
        cut += table.last is None and table.action is not None and len(table.obs) == len(table.action)
        if len(obs) < 2:
            short += 1
        else:
            whole.append((obs, action, reward, terminated))
    if not whole:
        raise InputError(f"There is no episode of at least one step in {', '.join(map(str, sources))}.")
    for name, index in (("observations", 0), ("actions", 1)):
        sizes = sorted({0 if part[index] is None else part[index].shape[1] for part in whole})
        if len(sizes) > 1:
            raise InputError(f"The sources don't agree: their {name} have {' and '.join(map(str, sizes))} numbers.")
    if len({part[2] is None for part in whole}) > 1:
        raise InputError("The sources don't agree: some have rewards, and some have none.")
    obs, actions, rewards, terminated = (list(column) for column in zip(*whole, strict=True))
    has_actions, has_rewards = actions[0] is not None, rewards[0] is not None
    low, high = _bounds(found, actions if has_actions else [], bounds)
    if has_actions and (low != [-1.0] * len(low) or high != [1.0] * len(high)):
        actions = [to_unit_box(action, np.array(low), np.array(high)) for action in actions]
    seconds = step_seconds or next((source.step_seconds for source in found if source.step_seconds), None)
    named = task or next((source.task for source in found if source.task), sources[0].stem)
    given: dict[str, Any] = {"actions": actions if has_actions else None, "rewards": rewards if has_rewards else None}
    made = Demonstrations.from_arrays(obs, **given, terminated=terminated, task=named)
    origin = Origin(action_low=low or None, action_high=high or None, step_seconds=seconds)
    made = replace(made, origin=origin, info={"imported_from": [source.name for source in sources]})
    beyond = max((float(np.abs(action).max()) for action in actions), default=0.0) if has_actions else 0.0
    if clip:
        made = made.clip()
    elif beyond > 1 + 1e-6:
        edges = _range([part[1] for part in whole])
        raise InputError(
            f"The actions go from {edges[0]:.6g} to {edges[1]:.6g}, beyond their bounds [{min(low):.6g}, {max(high):.6g}]; "
            "give those of the environment by --action-bounds LOW HIGH, or --clip-actions True."
        )
    return Imported(made, _told(found, made, cut, short, low, high))


def _sources(path: Path, keys: Keys) -> list[Source]:
    """What a file holds, a dataset's folder, or each of the files in a folder, in the order of the numbers in their names."""
    if not path.exists():
        raise InputError(f"There is no file or folder {path}.")
    for recognised, read in FORMATS:
        if recognised(path):
            try:
                return [read(path, keys)]
            except (OSError, EOFError) as error:
                raise InputError(f"{path} can't be read ({error}).") from error
    if path.is_dir() and any((place / "metadata.json").is_file() for place in (path, path / "data")):
        return [_minari(path)]
    if path.is_dir():
        inner = sorted((file for file in path.iterdir() if any(is_one(file) for is_one, _ in FORMATS)), key=_natural)
        if inner:
            return [source for file in inner for source in _sources(file, keys)]
    raise InputError(
        f"{path} is nothing that can be imported: give .npz, .csv or HDF5 files, folders of them, a LeRobot dataset (with "
        "meta/info.json) or a Minari dataset (with data/metadata.json)."
    )


def _minari(path: Path) -> Source:
    held = Demonstrations.load(path, bounded=False)
    tables = [
        Table(e.obs, e.action if held.has_actions else None, e.reward if held.has_rewards else None, e.terminated)
        for e in held.episodes
    ]
    sides = ([side] * held.action.shape[1] for side in (-1.0, 1.0)) if held.has_actions else (None, None)
    return Source("Minari", tables, {}, [], *sides, step_seconds=held.origin.step_seconds, task=held.task)


def _natural(path: Path) -> list[Any]:
    """A key that sorts `episode_10` after `episode_9`."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _aligned(table: Table) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None, bool]:
    """The episode with one more state than actions and rewards."""
    obs, action, reward = table.obs, table.action, table.reward
    if table.last is not None:
        obs = np.concatenate([obs, table.last[None]])
    steps = len(obs) - 1
    cut = action is not None and len(action) > steps
    return (
        obs,
        None if action is None else action[:steps],
        None if reward is None else reward[:steps],
        table.terminated and not cut,
    )


def _bounds(
    found: list[Source], actions: list[Any], bounds: tuple[float | int, float | int] | None
) -> tuple[list[float], list[float]]:
    """The bounds of the environment's own actions: those given, those that the sources say, or [-1, 1]."""
    if not actions:
        return [], []
    size = actions[0].shape[1]
    if bounds is not None:
        if not -np.inf < bounds[0] < bounds[1] < np.inf:
            raise InputError(f"--action-bounds are {bounds[0]} and {bounds[1]}; they must be two numbers, the lower one first.")
        return [float(bounds[0])] * size, [float(bounds[1])] * size
    said = [(source.low, source.high) for source in found if source.low and source.high]
    if any(each != said[0] for each in said):
        raise InputError("The sources don't agree on the bounds of actions; give them by --action-bounds LOW HIGH.")
    low, high = said[0] if said else ([-1.0] * size, [1.0] * size)
    assert low is not None and high is not None
    return low, high


def _range(arrays: Sequence[Any]) -> tuple[float, float]:
    return min(float(array.min()) for array in arrays), max(float(array.max()) for array in arrays)


def _told(found: list[Source], made: Demonstrations, cut: int, short: int, low: list[float], high: list[float]) -> list[str]:
    """What was found and what was left out; `cut` last actions and `short` episodes were."""
    told = [
        f"Read {len(made.episodes)} episodes, {made.num_steps:,} steps, from {', '.join(sorted({s.format for s in found}))}."
    ]
    for meaning, word in (("obs", "Observations"), ("action", "Actions"), ("reward", "Rewards"), ("episode", "Episodes")):
        if names := list(dict.fromkeys(name for source in found for name in source.keys.get(meaning, []))):
            told.append(f"{word}: {', '.join(names)}.")
    if made.has_actions:
        sides = [f"[{low[0]:.6g}, {high[0]:.6g}]"] if len({*low}) == len({*high}) == 1 else [f"{low} to {high}"]
        told.append(f"Bounds of the environment's actions: {sides[0]}.")
    if made.origin.step_seconds:
        told.append(f"Time step: {made.origin.step_seconds:.6g} s.")
    left = list(dict.fromkeys(text for source in found for text in source.dropped))
    told += [f"Left out: {text}." for text in left[:20]]
    if cut:
        told.append(f"Left out: the last action of {cut} episodes, since the state that it led to is not there.")
    if short:
        told.append(f"Left out: {short} episodes of less than one step.")
    told += [f"There are no {name}." for name in ("actions", "rewards") if not getattr(made, f"has_{name}")]
    return told
