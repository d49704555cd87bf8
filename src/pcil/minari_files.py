"""Minari datasets: reading ours and anybody's, whatever a damaged or foreign file may hold, and writing. Never a pickle."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, registry
from jaxtyping import Float

from pcil.errors import InputError
from pcil.files import read_json
from pcil.types import Episode, Origin


class Stored(NamedTuple):
    """What a dataset holds."""

    task: str
    episodes: tuple[Episode, ...]
    """Absent actions are rows of no numbers, absent rewards are 0."""
    info: dict[str, Any]
    origin: Origin
    has_actions: bool
    has_rewards: bool


def read(data: Path) -> Stored:
    """A dataset in any format that Minari can read here.

    Actions or rewards are absent where no episode has any: the file lacks them, or all of them are NaN.
    """
    import h5py
    from minari.dataset.minari_storage import MinariStorage

    where, episodes = str(data), []
    try:
        metadata = read_json(data / "metadata.json")
        environment = json.loads(metadata.get("env_spec", "{}")).get("id") or metadata.get("dataset_id", data.name)
        own = {"task": task_of(environment), "info": metadata} | metadata.get("pcil", {})
        # Were the spaces missing, Minari would make the environment, and so run whatever code the file names.
        spaces = [json.loads(metadata[key]) for key in ("observation_space", "action_space")]
        indices, steps = range(metadata["total_episodes"]), metadata["total_steps"]
        if not indices:
            return Stored(own["task"], (), own["info"], Origin(), True, True)
        if metadata["data_format"] == "hdf5":
            if not h5py.is_hdf5(file := data / "main_data.hdf5"):
                raise ValueError(f"{file.name} is {'not an HDF5 file' if file.exists() else 'missing'}")
            with h5py.File(file) as groups:
                if len(groups) != len(indices):
                    raise ValueError(f"{file.name} has {len(groups)} episodes, metadata.json says {len(indices)}")
        storage = MinariStorage.read(data)
        stored = storage.get_episodes(indices)
        if metadata["data_format"] == "hdf5" and (absent := _absent(file)):
            stored = _without(storage, file, indices, absent)
        where = f"Episode 0 of {data}"
        for raw, known in zip(stored, storage.get_episode_metadata(indices), strict=True):
            episodes.append(_episode(raw, known.get("seed"), *spaces))
            where = f"Episode {len(episodes)} of {data}"
        where, found = str(data), sum(map(len, episodes))
        if found != steps:
            raise ValueError(f"there are {found} steps in all, metadata.json says {steps}")
        has_actions = any(episode.action.shape[1] for episode in episodes)
        has_rewards = not all(np.isnan(episode.reward).all() for episode in episodes)
        if not has_rewards:
            episodes = [dataclasses.replace(episode, reward=np.zeros(len(episode))) for episode in episodes]
        origin = _checked(Origin(**own["origin"]) if "origin" in own else _origin(metadata, spaces[1]))
    except Exception as error:  # a damaged file may make json, h5py and Minari raise anything
        raise InputError(f"{where} is not as Minari writes it and can not be read: {reason(error)}.") from error
    return Stored(own["task"], tuple(episodes), own["info"], origin, has_actions, has_rewards)


def _absent(file: Path) -> set[str]:
    """Which of actions and rewards no episode of an HDF5 file has."""
    import h5py

    with h5py.File(file) as groups:
        return {key for key in ("actions", "rewards") if not any(key in group for group in groups.values())}


def _without(storage: Any, file: Path, indices: range, absent: set[str]) -> Iterator[dict[str, Any]]:
    """The episodes as Minari gives them, with NaN for what is absent; Minari itself would refuse them."""
    import h5py

    with h5py.File(file) as groups:
        for index in indices:
            group: Any = groups[f"episode_{index}"]
            raw = {key: group[key][()] for key in {"rewards", "terminations", "truncations"} - absent}
            for key in {"observations", "actions"} - absent:
                raw[key] = storage._decode_space(group[key], getattr(storage, f"{key[:-1]}_space"))
            yield raw | {key: np.full(len(raw["terminations"]), np.nan) for key in absent}


def _origin(metadata: dict[str, Any], action_space: dict[str, Any]) -> Origin:
    """What a dataset of others, or an older one of ours, tells of its environment."""
    spec = json.loads(metadata.get("env_spec", "{}"))
    known = Origin(spec.get("id"), spec.get("entry_point"), spec.get("kwargs"))
    if any(wrapper["name"] == "RescaleAction" for wrapper in spec.get("additional_wrappers") or ()):
        return known  # the box that is stored is the wrapper's
    low, high = (np.ravel(action_space.get(bound, ())).tolist() for bound in ("low", "high"))
    return known._replace(action_low=low or None, action_high=high or None)


def _checked(origin: Origin) -> Origin:
    """`origin`, whose values come from a file; `ValueError` where one is of another kind than it must be."""
    for name, kind in zip(Origin._fields, (str, str, dict, list, list, float | int), strict=True):
        value = getattr(origin, name)
        if value is not None and not isinstance(value, kind):
            raise ValueError(f"its environment's {name} is {value!r:.80}")
    low, high = (bound and [float(value) for value in bound] for bound in (origin.action_low, origin.action_high))
    return origin._replace(action_low=low, action_high=high)


def _episode(raw: dict[str, Any], seed: int | None, observation_space: dict, action_space: dict) -> Episode:
    """One episode out of Minari's arrays; the spaces are those of the metadata, in JSON. `ValueError` if ill-formed."""
    action, obs = _unit_actions(raw["actions"], action_space), _flat(raw["observations"], observation_space)
    if not obs.shape[1]:
        raise ValueError("its observations are rows of no numbers")
    reward, *flags = (np.asarray(raw[key]) for key in ("rewards", "terminations", "truncations"))
    reward = _flat(reward, {"type": "Box", "shape": []})[:, 0].astype("f4" if reward.dtype == np.float32 else "f8")
    steps, lengths = len(action), (len(obs), len(reward), *map(len, flags))
    if steps == 0 or lengths != (steps + 1, steps, steps, steps):
        given = "{} observations, {} rewards, {} terminations and {} truncations".format(*lengths)
        raise ValueError(f"T >= 1 actions need T+1 observations and T of the rest, not {steps} actions with {given}")
    with np.errstate(over="ignore"):  # what is too large becomes infinite here, and is refused as such
        return Episode(obs.astype(np.float32), action.astype(np.float32), reward, bool(flags[0][-1]), seed)


def _unit_actions(stored: Any, space: dict[str, Any]) -> Float[np.ndarray, "T action"]:
    """Actions brought from their box to [-1, 1]; rows of no numbers where all are NaN, which is how absent ones are stored."""
    if isinstance(stored, np.ndarray) and stored.dtype.kind == "f" and stored.size and np.isnan(stored).all():
        return np.zeros((len(stored), 0))
    low, high = (np.ravel(space.get(bound, np.nan)).astype(np.float64) for bound in ("low", "high"))
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise ValueError("only actions of a Box with finite bounds can be brought to [-1, 1]")
    if not low.size:
        raise ValueError("its actions are rows of no numbers")
    return (_flat(stored, space) - (high + low) / 2) / ((high - low) / 2)


def _flat(values: Any, space: dict[str, Any]) -> Float[np.ndarray, "T dim"]:
    """The values of `space` as rows of numbers, the parts of Dicts and Tuples in the order that the environment gave them."""
    if space["type"] in ("Dict", "Tuple"):
        parts = space["subspaces"].items() if space["type"] == "Dict" else enumerate(space["subspaces"])
        return np.concatenate([_flat(values[key], part) for key, part in parts], axis=1)
    if space["type"] != "Box":
        raise ValueError(f"{space['type']} spaces are not supported, only Box and Dict of Box or Tuple, nested ones too")
    if values.dtype.kind not in "fiub" or list(values.shape[1:]) != space["shape"]:
        raise ValueError(f"{values.dtype} {values.shape[1:]} is stored where there must be numbers {space['shape']}")
    return values.reshape(len(values), math.prod(space["shape"])).astype(np.float64)


def write(data: Path, dataset_id: str, kept: Stored) -> None:
    """Write `metadata.json` and `main_data.hdf5` into the new folder `data`, by Minari's own hand; what is absent is NaN."""
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
    own = {"task": kept.task, "info": kept.info, "origin": kept.origin._asdict(), "absent": absent}
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
    """What Gymnasium has registered for `task`, with the arguments of the origin and with the wrappers that make it flat and
    its actions [-1, 1]."""
    known = next((registry[name] for name in (f"dmc/{task}-v0", task.rpartition(":")[2]) if name in registry), None)
    if known is None or not isinstance(known.entry_point, str):
        return None
    if origin.env_id == known.id:
        known = dataclasses.replace(known, kwargs=known.kwargs | (origin.kwargs or {}))
    if known.namespace in ("dmc", "toy"):  # these are so by themselves
        return known
    flatten = gymnasium.wrappers.FlattenObservation.wrapper_spec()
    rescale = gymnasium.wrappers.RescaleAction.wrapper_spec(min_action=-1.0, max_action=1.0)
    return dataclasses.replace(known, additional_wrappers=(flatten, rescale))


def task_of(name: str) -> str:
    """The task that "dmc/<task>-v0" (an environment) or "dmc/<task>/expert-v0" (a dataset) names; else `name`."""
    return re.sub(r"\Admc/(\w+?)(/expert)?-v0\Z", r"\1", name)


def reason(error: Exception) -> str:
    """What a library said, without line breaks and full stops, to go into a sentence of ours."""
    text = str(error.args[0] if isinstance(error, KeyError) else error).strip() or type(error).__name__
    text = f"there is no {text!r}" if isinstance(error, KeyError) and " " not in text else text
    return re.sub(r"[.!?]?\s*\n.*|[.!?]$", "", text, flags=re.DOTALL).replace(". ", "; ")
