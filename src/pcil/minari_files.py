"""Reading Minari datasets, ours and anybody's, whatever a damaged or foreign file may hold. Never a pickle."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pcil.errors import InputError
from pcil.types import Episode


def read(data: Path) -> tuple[str, list[Episode], dict[str, Any]]:
    """Task, episodes and info of a dataset, in any format that Minari can read here."""
    import h5py
    from minari.dataset.minari_storage import MinariStorage

    where, episodes = str(data), []
    try:
        metadata = json.loads((data / "metadata.json").read_bytes())
        environment = json.loads(metadata.get("env_spec", "{}")).get("id") or metadata.get("dataset_id", data.name)
        own = {"task": task_of(environment), "info": metadata} | metadata.get("pcil", {})
        # Were the spaces missing, Minari would make the environment, and so run whatever code the file names.
        spaces = [json.loads(metadata[key]) for key in ("observation_space", "action_space")]
        indices, steps = range(metadata["total_episodes"]), metadata["total_steps"]
        if not indices:
            return own["task"], [], own["info"]
        if metadata["data_format"] == "hdf5":
            if not h5py.is_hdf5(file := data / "main_data.hdf5"):
                raise ValueError(f"{file.name} is {'not an HDF5 file' if file.exists() else 'missing'}")
            with h5py.File(file) as groups:
                if len(groups) != len(indices):
                    raise ValueError(f"{file.name} has {len(groups)} episodes, metadata.json says {len(indices)}")
        storage = MinariStorage.read(data)
        where = f"Episode 0 of {data}"
        for raw, known in zip(storage.get_episodes(indices), storage.get_episode_metadata(indices), strict=True):
            episodes.append(_episode(raw, known.get("seed"), *spaces))
            where = f"Episode {len(episodes)} of {data}"
        where, found = str(data), sum(map(len, episodes))
        if found != steps:
            raise ValueError(f"there are {found} steps in all, metadata.json says {steps}")
    except Exception as error:  # a damaged file may make json, h5py and Minari raise anything
        raise InputError(f"{where} is not as Minari writes it and can not be read: {reason(error)}.") from error
    return own["task"], episodes, own["info"]


def _episode(raw: dict[str, Any], seed: int | None, observation_space: dict, action_space: dict) -> Episode:
    """One episode out of Minari's arrays; the spaces are those of the metadata, in JSON. `ValueError` if ill-formed."""
    low, high = (np.ravel(action_space.get(bound, np.nan)).astype(np.float64) for bound in ("low", "high"))
    if not (np.isfinite(low) & np.isfinite(high) & (low < high)).all():
        raise ValueError("only actions of a Box with finite bounds can be brought to [-1, 1]")
    obs, stored = _flat(raw["observations"], observation_space), _flat(raw["actions"], action_space)
    action = (stored - (high + low) / 2) / ((high - low) / 2)
    reward, *flags = (np.asarray(raw[key]) for key in ("rewards", "terminations", "truncations"))
    reward = _flat(reward, {"type": "Box", "shape": []})[:, 0].astype("f4" if reward.dtype == np.float32 else "f8")
    steps, lengths = len(action), (len(obs), len(reward), *map(len, flags))
    if steps == 0 or lengths != (steps + 1, steps, steps, steps):
        given = "{} observations, {} rewards, {} terminations and {} truncations".format(*lengths)
        raise ValueError(f"T >= 1 actions need T+1 observations and T of the rest, not {steps} actions with {given}")
    with np.errstate(over="ignore"):  # what is too large becomes infinite here, and is refused as such
        return Episode(obs.astype(np.float32), action.astype(np.float32), reward, bool(flags[0][-1]), seed)


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


def task_of(name: str) -> str:
    """The task that "dmc/<task>-v0" (an environment) or "dmc/<task>/expert-v0" (a dataset) names; else `name`."""
    return re.sub(r"\Admc/(\w+?)(/expert)?-v0\Z", r"\1", name)


def reason(error: Exception) -> str:
    """What a library said, without line breaks and full stops, to go into a sentence of ours."""
    text = str(error.args[0] if isinstance(error, KeyError) else error).strip() or type(error).__name__
    text = f"there is no {text!r}" if isinstance(error, KeyError) and " " not in text else text
    return re.sub(r"[.!?]?\s*\n.*|[.!?]$", "", text, flags=re.DOTALL).replace(". ", "; ")
