"""Checkpoints between episodes: arrays in safetensors, counters in JSON, a checksum of each; the two newest are kept."""

from __future__ import annotations

import json
import shutil
import zlib
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from pcil import files
from pcil.errors import InputError

KEEP = 2
ARRAYS = "arrays.safetensors"
Arrays = dict[str, np.ndarray]


def save(folder: Path, frames: int, arrays: Arrays, counters: dict[str, Any]) -> None:
    """Write one checkpoint as `folder/<frames>`: whole, by a rename, or not at all.

    Older ones than the last two go, and so do those after `frames`: `restore` passed over them, for they were damaged.
    """
    final, partial = folder / str(frames), folder / f"partial-{frames}"
    for leftover in folder.glob("partial-*"):
        shutil.rmtree(leftover)
    partial.mkdir(parents=True)
    files.save_arrays(partial / ARRAYS, arrays)
    text = json.dumps({"counters": counters, "files": _checksums(partial)})
    (partial / "meta.json").write_text(f"{zlib.crc32(text.encode())}\n{text}\n")
    for path in (*partial.iterdir(), partial):
        files.sync(path)
    shutil.rmtree(final, ignore_errors=True)
    partial.rename(final)
    files.sync(folder)
    others = _newest_first(folder)
    kept = others[others.index(final) :][:KEEP]
    for path in set(others) - set(kept):
        shutil.rmtree(path)


def restore(folder: Path) -> tuple[Arrays | None, dict[str, Any], list[str]]:
    """The newest checkpoint that is whole: its arrays and counters, and a sentence for each that had to be passed over."""
    complaints = []
    for path in _newest_first(folder):
        try:
            arrays, counters = _read(path)
        except InputError:
            raise
        except Exception as error:  # whatever a torn file makes a library raise, the next older checkpoint is the answer
            complaints.append(f"The checkpoint {path} is damaged ({_first_line(error)}) and is passed over.")
        else:
            return arrays, counters, complaints
    return None, {}, complaints


def flatten(name: str, tree: Any) -> Arrays:
    """The arrays of a pytree by their path, each name beginning with `name`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(eqx.filter(tree, eqx.is_array))
    return {f"{name}{jax.tree_util.keystr(path)}": np.asarray(leaf) for path, leaf in leaves}


def unflatten(name: str, like: Any, arrays: Arrays) -> Any:
    """`like` with the arrays that `flatten` gave under `name`; a missing one or another shape raises `ValueError`."""
    array_part, rest = eqx.partition(like, eqx.is_array)

    def take(path: Any, leaf: Any) -> Any:
        full = f"{name}{jax.tree_util.keystr(path)}"
        array, expected = arrays.get(full), f"{leaf.dtype}{list(leaf.shape)}"
        if array is None:
            raise ValueError(f"{full} is missing, expected {expected}")
        if array.shape != leaf.shape or array.dtype != leaf.dtype:
            raise ValueError(f"{full} is {array.dtype}{list(array.shape)}, expected {expected}")
        return jax.numpy.asarray(array)

    return eqx.combine(jax.tree_util.tree_map_with_path(take, array_part), rest)


def _read(path: Path) -> tuple[Arrays, dict[str, Any]]:
    from safetensors.numpy import load_file

    crc, text = (path / "meta.json").read_text().splitlines()
    if zlib.crc32(text.encode()) != int(crc):
        raise ValueError("the checksum of meta.json is wrong")
    meta, orbax = json.loads(text), path / "arrays"
    found = _checksums(orbax if orbax.is_dir() else path)
    for name, expected in meta["files"].items():
        if found.get(name) != expected:
            raise ValueError(f"{name} is {'missing' if name not in found else 'not what was written'}")
    return _read_orbax(orbax) if orbax.is_dir() else load_file(path / ARRAYS), meta["counters"]


def _read_orbax(folder: Path) -> Arrays:
    """The arrays of a checkpoint of before 2026-11-26, which Orbax wrote."""
    try:
        import orbax.checkpoint as ocp
    except ImportError as error:
        raise InputError(
            f"{folder} is of an older version and needs Orbax; pip install orbax-checkpoint, and give the same command again."
        ) from error
    arrays = ocp.PyTreeCheckpointer().restore(folder.absolute())
    return {name: np.asarray(array) for name, array in arrays.items()}


def _newest_first(folder: Path) -> list[Path]:
    return sorted((p for p in folder.glob("*") if p.name.isdigit()), key=lambda p: int(p.name), reverse=True)


def _checksums(folder: Path) -> dict[str, int]:
    """CRC-32 of each file of arrays, so that damage is known before a library reads it."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != "meta.json")
    return {str(path.relative_to(folder)): zlib.crc32(path.read_bytes()) for path in paths}


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"[:160]
