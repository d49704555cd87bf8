"""Checkpoints between episodes: arrays by Orbax, counters by JSON, a checksum of every file; the two newest are kept."""

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

KEEP = 2
Arrays = dict[str, np.ndarray]


def save(folder: Path, frames: int, arrays: Arrays, counters: dict[str, Any]) -> None:
    """Write one checkpoint as `folder/<frames>`: whole, by a rename, or not at all.

    Older ones than the last two go, and so do those after `frames`: `restore` passed over them, for they were damaged.
    """
    import orbax.checkpoint as ocp

    final, partial = folder / str(frames), folder / f"partial-{frames}"
    for leftover in folder.glob("partial-*"):
        shutil.rmtree(leftover)
    partial.mkdir(parents=True)
    ocp.PyTreeCheckpointer().save((partial / "arrays").absolute(), arrays)
    text = json.dumps({"counters": counters, "files": _checksums(partial / "arrays")})
    (partial / "meta.json").write_text(f"{zlib.crc32(text.encode())}\n{text}\n")
    for path in (*partial.rglob("*"), partial):
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
        except Exception as error:  # whatever a torn file makes Orbax raise, the next older checkpoint is the answer
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
    import orbax.checkpoint as ocp

    crc, text = (path / "meta.json").read_text().splitlines()
    if zlib.crc32(text.encode()) != int(crc):
        raise ValueError("the checksum of meta.json is wrong")
    meta = json.loads(text)
    found = _checksums(path / "arrays")
    for name, expected in meta["files"].items():
        if found.get(name) != expected:
            raise ValueError(f"{name} is {'missing' if name not in found else 'not what was written'}")
    arrays = ocp.PyTreeCheckpointer().restore((path / "arrays").absolute())
    return {name: np.asarray(array) for name, array in arrays.items()}, meta["counters"]


def _newest_first(folder: Path) -> list[Path]:
    return sorted((p for p in folder.glob("*") if p.name.isdigit()), key=lambda p: int(p.name), reverse=True)


def _checksums(arrays: Path) -> dict[str, int]:
    """CRC-32 of each file that Orbax wrote, so that damage is known before Orbax reads it."""
    files = sorted(path for path in arrays.rglob("*") if path.is_file())
    return {str(path.relative_to(arrays)): zlib.crc32(path.read_bytes()) for path in files}


def _first_line(error: Exception) -> str:
    return f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"[:160]
