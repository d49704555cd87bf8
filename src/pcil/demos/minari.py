"""Reading and writing Minari datasets. Files may be damaged or come from anyone; pickles are never loaded."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, registry
from jaxtyping import Float

from pcil import envs
from pcil.demos.arrays import to_unit_box
from pcil.errors import InputError
from pcil.files import parse_json, read_json
from pcil.types import Episode, Origin

PARTS = ("observations", "actions", "rewards", "terminations", "truncations")
"""The arrays of an episode that are read; others, such as its infos, are ignored."""
SCALAR = {"type": "Box", "shape": []}


class Stored(NamedTuple):
    """The content of a dataset."""

    task: str
    episodes: tuple[Episode, ...]
    """Missing actions are arrays of shape `[T, 0]`, and missing rewards are 0."""
    info: dict[str, Any]
    origin: Origin
    has_actions: bool
    has_rewards: bool
    hash: Any
    """`pcil.demos:Demonstrations.hash` at the time of saving; None if unknown."""


def read(data: Path, *, trusted: bool = False) -> Stored:
    """Read a dataset in HDF5; one that is not `trusted` is read in a separate process.

    Actions or rewards are missing if no episode has them: the file lacks them, or all of them are NaN. Minari's own reader is
    not used, because a damaged or malicious file can make it crash, open other files, or create any environment.
    """
    from pcil.demos import hdf5

    where, episodes = str(data), []
    try:
        metadata = read_json(data / "metadata.json")
        environment = parse_json(metadata.get("env_spec", "{}")).get("id") or metadata.get("dataset_id", data.name)
        own = {"task": task_of(environment), "info": metadata} | metadata.get("pcil", {})
        spaces = [parse_json(metadata[key]) for key in ("observation_space", "action_space")]
        indices, steps = range(metadata["total_episodes"]), metadata["total_steps"]
        if not indices:
            return Stored(own["task"], (), own["info"], Origin(), True, True, None)
        if not isinstance(own["task"], str) or not isinstance(own["info"], dict):
            raise ValueError("its task is no name or its info no table")
        if metadata["data_format"] != "hdf5":
            raise ValueError(f"its data_format is {metadata['data_format']!r:.80}, and only hdf5 is read")
        boxes: dict[str, Any] = {
            key: list(_boxes(key, space)) for key, space in zip(PARTS, (spaces[0], *[SCALAR] * 4), strict=True)
        }
        boxes["actions"] = list(_boxes("actions", spaces[1])) if spaces[1]["type"] == "Box" else None
        wanted = {"episodes": len(indices), "steps": steps, "boxes": boxes}
        for seed, arrays in (hdf5.episodes if trusted else hdf5.read)(data / "main_data.hdf5", wanted):
            where = f"Episode {len(episodes)} of {data}"
            episodes.append(_episode(arrays, seed, spaces[1]))
        where = str(data)
        has_actions = any(episode.action.shape[1] for episode in episodes)
        has_rewards = not all(np.isnan(episode.reward).all() for episode in episodes)
        if not has_rewards:
            episodes = [dataclasses.replace(episode, reward=np.zeros(len(episode))) for episode in episodes]
        origin = _checked(Origin(**own["origin"]) if "origin" in own else _origin(metadata, spaces[1]))
    except Exception as error:  # damaged JSON can cause any exception
        if isinstance(error, hdf5.Damage):
            where = str(data) if error.episode is None else f"Episode {error.episode} of {data}"
        raise InputError(f"{where} is not as Minari writes it and can not be read: {reason(error)}.") from error
    return Stored(own["task"], tuple(episodes), own["info"], origin, has_actions, has_rewards, own.get("hash"))


def _boxes(path: str, space: dict[str, Any]) -> Iterator[tuple[str, list[int]]]:
    """Path and shape of each Box; the entries of Dicts and Tuples are in the order of the environment."""
    if space["type"] in ("Dict", "Tuple"):
        parts = space["subspaces"]
        named = parts.items() if space["type"] == "Dict" else ((f"_index_{i}", part) for i, part in enumerate(parts))
        for name, part in named:
            yield from _boxes(f"{path}/{name}", part)
    elif space["type"] != "Box":
        raise ValueError(f"{space['type']} spaces are not supported, only Box and Dict of Box or Tuple, nested ones too")
    else:
        yield path, space["shape"]


def _origin(metadata: dict[str, Any], action_space: dict[str, Any]) -> Origin:
    """What the metadata says about the environment, for datasets without our own `origin` entry."""
    spec = parse_json(metadata.get("env_spec", "{}"))
    known = Origin(spec.get("id"), spec.get("entry_point"), spec.get("kwargs"))
    if any(wrapper["name"] == "RescaleAction" for wrapper in spec.get("additional_wrappers") or ()):
        return known  # the stored box is that of the wrapper
    low, high = (np.ravel(action_space.get(bound, ())).tolist() for bound in ("low", "high"))
    return known._replace(action_low=low or None, action_high=high or None)


def _checked(origin: Origin) -> Origin:
    """`origin`, whose values come from a file; `ValueError` if one has the wrong type."""
    for name, kind in zip(Origin._fields, (str, str, dict, list, list, float | int), strict=True):
        value = getattr(origin, name)
        if value is not None and not isinstance(value, kind):
            raise ValueError(f"its environment's {name} is {value!r:.80}")
    low, high = (bound and [float(value) for value in bound] for bound in (origin.action_low, origin.action_high))
    return origin._replace(action_low=low, action_high=high)


def _episode(arrays: dict[str, list[Any]], seed: int | None, action_space: dict) -> Episode:
    """Build an episode from its arrays and the action space in the metadata's JSON; `ValueError` if they are invalid."""
    parts = [array.reshape(len(array), -1) for array in arrays["observations"] if 0 not in array.shape]
    if not parts:
        raise ValueError("its observations are rows of no numbers")
    ends = arrays["terminations"][0]
    action = _unit_actions(arrays["actions"][0], action_space) if "actions" in arrays else np.zeros((len(ends), 0))
    reward = arrays["rewards"][0] if "rewards" in arrays else np.full(len(ends), np.nan)
    reward = reward.astype("f4" if reward.dtype == np.float32 else "f8")
    with np.errstate(over="ignore"):  # values too large for float32 become infinite and are refused later
        obs = np.concatenate([part.astype(np.float32) for part in parts], axis=1)
        return Episode(obs, action.astype(np.float32), reward, bool(ends[-1]), seed)


def _unit_actions(stored: np.ndarray, space: dict[str, Any]) -> Float[np.ndarray, "T action"]:
    """Actions rescaled from their box to [-1, 1]; of shape `[T, 0]` if all are NaN, which is how missing actions are stored."""
    if stored.dtype.kind == "f" and stored.size and np.isnan(stored).all():
        return np.zeros((len(stored), 0))
    low, high = (np.ravel(space.get(bound, np.nan)).astype(np.float64) for bound in ("low", "high"))
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise ValueError("only actions of a Box with finite bounds can be brought to [-1, 1]")
    if not low.size:
        raise ValueError("its actions are rows of no numbers")
    return to_unit_box(stored.reshape(len(stored), -1).astype(np.float64), low, high)


def write(data: Path, dataset_id: str, kept: Stored) -> None:
    """Write `metadata.json` and `main_data.hdf5` into the new folder `data` with Minari's writer; NaN for missing arrays."""
    import minari
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    data.mkdir(parents=True)
    box, first = gymnasium.spaces.Box, kept.episodes[0]
    observation_space = box(-np.inf, np.inf, first.obs.shape[1:], np.float32)
    action_space = box(-1.0, 1.0, first.action.shape[1:] if kept.has_actions else (1,), np.float32)
    storage = MinariStorage.new(data, observation_space, action_space, _env_spec(kept.task, kept.origin))
    known = {"dataset_id": dataset_id, "minari_version": minari.__version__}
    described = {"description": f"Demonstrations of {kept.task} by {kept.info.get('expert', 'an unknown expert')}."}
    absent = [name for name in ("actions", "rewards") if not getattr(kept, f"has_{name}")]
    own = {"task": kept.task, "info": kept.info, "origin": kept.origin._asdict(), "absent": absent, "hash": kept.hash}
    storage.update_metadata(known | described | {"pcil": own})
    for episode in kept.episodes:
        last = np.arange(len(episode)) == len(episode) - 1
        action = episode.action if kept.has_actions else np.full((len(episode), 1), np.nan)
        reward = episode.reward if kept.has_rewards else np.full(len(episode), np.nan)
        buffer = EpisodeBuffer(
            seed=episode.seed,
            observations=list(episode.obs.astype(np.float32)),
            actions=list(action.astype(np.float32)),
            rewards=list(reward),
            terminations=list(last & episode.terminated),
            truncations=list(last & (not episode.terminated)),
        )
        storage.update_episodes([buffer])


def _env_spec(task: str, origin: Origin) -> EnvSpec | None:
    """The spec that is registered for `task`, with the keyword arguments of `origin` and with the wrappers that flatten
    observations and rescale actions to [-1, 1]."""
    known = next((registry[name] for name in (f"dmc/{task}-v0", task.rpartition(":")[2]) if name in registry), None)
    if known is None or not isinstance(known.entry_point, str):
        return None
    if origin.env_id == known.id:
        known = dataclasses.replace(known, kwargs=known.kwargs | (origin.kwargs or {}))
    if known.namespace in envs.SUITES:  # these have flat observations and actions in [-1, 1] already
        return known
    flatten = gymnasium.wrappers.FlattenObservation.wrapper_spec()
    rescale = gymnasium.wrappers.RescaleAction.wrapper_spec(min_action=-1.0, max_action=1.0)
    return dataclasses.replace(known, additional_wrappers=(flatten, rescale))


def task_of(name: str) -> str:
    """The task in the id of a dataset, "dmc/<task>/expert-v0" or "gymnasium/<id>/expert-v0", or of an environment,
    "dmc/<task>-v0"; other names are unchanged."""
    return re.sub(r"\A(?:dmc/(\w+?)(?:/expert)?|gymnasium/([\w-]+)/expert)-v0\Z", r"\1\2", name)


def reason(error: Exception) -> str:
    """The message of an exception, without line breaks and full stops, for use inside a sentence."""
    text = str(error.args[0] if isinstance(error, KeyError) else error).strip() or type(error).__name__
    text = f"there is no {text!r}" if isinstance(error, KeyError) and " " not in text else text
    return re.sub(r"[.!?]?\s*\n.*|[.!?]$", "", text, flags=re.DOTALL).replace(". ", "; ")
