"""Safe reading of HDF5 files from untrusted sources: the description of every array is checked before its data are read.

A malicious file can make the HDF5 library open other files, load filter plugins or run out of memory. Therefore only plain
arrays that are stored in the file itself are read, and at most `NUMBERS` numbers. Damage that the library does not detect, such
as a cyclic index, can crash it or make it hang. Therefore `read` does the work in a child process, which runs this module as a
script.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from pcil import files

_low: Any = h5py  # its low-level modules have no type annotations
h5a, h5d, h5l, h5o, h5s, h5t, h5z = (getattr(_low, f"h5{letter}") for letter in "adlostz")

NUMBERS = 2**29
"""The largest number of values that are read from one file: 2 GiB in float32."""
UNFOLDED = 2**26
"""Decompressed bytes that are always allowed; above this, at most `RATIO` times the size of the file."""
RATIO = 1100
"""The largest compression ratio: deflate, the strongest of the `FILTERS`, reaches at most 1032."""
CHUNK = 2**26
"""The largest chunk in bytes, unless the whole array is larger."""
PACKED = 2**21
"""The largest compressed chunk in bytes: HDF5 may decompress it to `RATIO` times as many before it notices a wrong size."""
HEADER = 2**16
"""The largest object header of an array or a group in bytes; data types can be nested in it."""
MEMORY = 2**34
"""The address space of the child process in bytes."""
PATIENCE_SECONDS, BYTES_A_SECOND = 12.0, 5e6
"""The time limit for reading a file: a constant, plus its size divided by a rate."""
DEPTH, MEMBERS = 6, 100_000
"""How deep groups are searched for arrays, and how many members each may have."""
FILTERS = {h5z.FILTER_DEFLATE, h5z.FILTER_LZF, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32}
"""The allowed filters; the library would search the machine for plugins that implement other ones."""

Parts = dict[str, list[Any]]
"""The arrays of an episode by part ("observations", "actions", ...): one array per Box."""


class Damage(ValueError):
    """A file is invalid; `episode` is the index of the invalid episode, or None."""

    def __init__(self, text: str, episode: int | None) -> None:
        super().__init__(text)
        self.episode = episode


def read(path: Path, wanted: dict[str, Any] | None) -> list[tuple[int | None, Parts]]:
    """`episodes`, or `tables` if nothing is `wanted`, computed in a child process; `Damage` also if that crashes or exceeds its
    time limit."""
    seconds = PATIENCE_SECONDS + (path.stat().st_size if path.exists() else 0) / BYTES_A_SECOND
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, "-P", __file__, str(path)]
    try:
        asked = {"input": json.dumps(wanted).encode(), "timeout": seconds, "env": environment}
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True, **asked)
    except subprocess.TimeoutExpired:
        raise Damage(f"reading it did not end within {seconds:.0f} s", None) from None
    except subprocess.CalledProcessError as error:
        raise Damage(f"the HDF5 library can't read it (exit code {error.returncode})", None) from None
    answer, found = io.BytesIO(done.stdout), []
    while line := answer.readline():
        about = json.loads(line)
        if "error" in about:
            raise Damage(about["error"], about["episode"])
        numbers = {key: [np.lib.format.read_array(answer) for _ in range(count)] for key, count in about["parts"].items()}
        found.append((about["seed"], numbers))
    return found


def main() -> None:
    """The child process of `read`: reads the path from argv and `wanted` from stdin, writes episodes or an error to stdout."""
    with contextlib.suppress(ImportError, ValueError, OSError):  # not every system has this limit
        import resource

        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY if hard == resource.RLIM_INFINITY else min(MEMORY, hard), hard))
    out = sys.stdout.buffer
    try:
        path, wanted = Path(sys.argv[1]), json.load(sys.stdin)
        for seed, parts in tables(path) if wanted is None else episodes(path, wanted):
            about = {"seed": seed, "parts": {key: len(arrays) for key, arrays in parts.items()}}
            out.write(json.dumps(about).encode() + b"\n")
            for array in (array for arrays in parts.values() for array in arrays):
                np.lib.format.write_array(out, array)
    except Damage as error:
        out.write(json.dumps({"error": str(error), "episode": error.episode}).encode() + b"\n")


def episodes(path: Path, wanted: dict[str, Any]) -> Iterator[tuple[int | None, Parts]]:
    """The seed and the arrays of each episode of a Minari file; `Damage` if the file does not match `wanted`.

    `wanted` has the total number of "episodes" and "steps", and for each part of an episode its "boxes": the path and the shape
    of a row. Actions and rewards may be missing from all episodes.
    """
    index = None
    try:
        with opened(path) as file:
            count, groups, located = wanted["episodes"], [], []
            if len(file) != count:
                raise ValueError(f"{path.name} has {len(file)} episodes, metadata.json says {count}")
            for index in range(count):
                groups.append(member(file, f"episode_{index}"))
            absent = {key for key in ("actions", "rewards") if not any(has(group, key) for group in groups)}
            boxes = {key: value for key, value in wanted["boxes"].items() if key not in absent}
            for index in range(count):
                located.append(_located(groups[index], boxes))
            index, steps = None, sum(len(parts["terminations"][0]) for parts in located)
            if steps != wanted["steps"]:
                raise ValueError(f"there are {steps} steps in all, metadata.json says {wanted['steps']}")
            check_size((array for parts in located for arrays in parts.values() for array in arrays), path)
            for index in range(count):
                numbers = {key: [array[()] for array in arrays] for key, arrays in located[index].items()}
                yield integer(groups[index], "seed"), numbers
    except Exception as error:  # damaged files make h5py raise many kinds of exceptions
        raise Damage(str(error) or type(error).__name__, index) from error


def tables(path: Path) -> Iterator[tuple[None, Parts]]:
    """All arrays of numbers with one or two axes, by their paths; `Damage` if the file is invalid. Others, such as images and
    texts, are None."""
    try:
        with opened(path) as file:
            found: dict[str, h5py.Dataset | None] = dict(_plain(file, "", DEPTH))
            check_size((array for array in found.values() if array is not None), path)
            yield None, {name: [] if array is None else [array[()]] for name, array in found.items()}
    except Exception as error:  # damaged files make h5py raise many kinds of exceptions
        raise Damage(str(error) or type(error).__name__, None) from error


def _plain(group: h5py.Group, place: str, depth: int) -> Iterator[tuple[str, h5py.Dataset | None]]:
    """The arrays below a group by their paths, None for those that are no rows of numbers, without links to other places."""
    if len(group) > MEMBERS:
        raise ValueError(f"{place or 'the file'} has {len(group):,} members, and at most {MEMBERS:,} are read")
    for name in map(str, group):
        if group.id.links.get_info(name.encode()).type != h5l.TYPE_HARD:
            continue
        found = member(group, name)
        if isinstance(found, h5py.Group):
            if not depth:
                raise ValueError(f"{place}{name} lies too deep in groups")
            yield from _plain(found, f"{place}{name}/", depth - 1)
        elif isinstance(found, h5py.Dataset):
            shape = found.shape or ()
            numbers = found.dtype.kind in "fiub" and len(shape) in (1, 2)
            yield f"{place}{name}", array(group, name, list(shape[1:])) if numbers else None


def _located(group: h5py.Group, boxes: dict[str, Any]) -> Parts:
    """The arrays of an episode, without reading their data; `ValueError` if their lengths do not match."""
    if boxes.get("actions", ()) is None:
        raise ValueError("only actions of a Box with finite bounds can be brought to [-1, 1]")
    parts = {key: [array(group, path, shape) for path, shape in inner] for key, inner in boxes.items()}
    lengths = {key: {len(array) for array in arrays} or {0} for key, arrays in parts.items()}
    steps = max(lengths["terminations"])
    if not steps or any(length != {steps + (key == "observations")} for key, length in lengths.items()):
        counts = {key: " or ".join(map(str, sorted(length))) for key, length in lengths.items()}
        counts = {"actions": "no", "rewards": "no"} | counts
        given = "{actions} actions with {observations} observations, {rewards} rewards, {terminations} terminations and "
        given = (given + "{truncations} truncations").format_map(counts)
        raise ValueError(f"T >= 1 actions need T+1 observations and T of the rest, not {given}")
    return parts


@contextlib.contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """Open an HDF5 file for reading; `ValueError` if it is not a regular HDF5 file."""
    if not path.exists():
        raise ValueError(f"{path.name} is missing")
    files.open_regular(path).close()
    if not h5py.is_hdf5(path):
        raise ValueError(f"{path.name} is not an HDF5 file")
    with h5py.File(path, "r") as file:
        yield file


def has(group: Any, name: str) -> bool:
    """Whether `group` is a group with a member of this name, which may be a dangling link."""
    return isinstance(group, h5py.Group) and group.id.links.exists(name.encode())


def member(group: h5py.Group, path: str) -> Any:
    """A group or an array that is reached without soft or external links; `ValueError` if there is none."""
    found: Any = group
    for name in path.split("/"):
        if not has(found, name):
            raise ValueError(f"there is no {path!r}")
        if found.id.links.get_info(name.encode()).type != h5l.TYPE_HARD:
            raise ValueError(f"{path} is a link to another place")
        if h5o.get_info(found.id, name.encode()).hdr.space.total > HEADER:
            raise ValueError(f"{path} is described in more than {HEADER:,} bytes")
        found = found[name]
    return found


def array(group: h5py.Group, path: str, shape: list[int]) -> h5py.Dataset:
    """An array with rows of this shape, without reading its data; `ValueError` unless it holds plain numbers in this file."""
    found = member(group, path)
    if not isinstance(found, h5py.Dataset):
        raise ValueError(f"{path} is no array")
    plan, kind = found.id.get_create_plist(), found.id.get_type().get_class()
    if plan.get_layout() == h5d.VIRTUAL or plan.get_external_count():
        raise ValueError(f"{path} is stored elsewhere than in its own place in this file")
    if kind not in (h5t.INTEGER, h5t.FLOAT, h5t.ENUM) or found.id.get_space().get_simple_extent_type() != h5s.SIMPLE:
        raise ValueError(f"{path} holds text, objects or nothing where there must be rows of numbers")
    if found.dtype.kind not in "fiub" or list(found.shape[1:]) != shape or (kind == h5t.ENUM and found.dtype != bool):
        raise ValueError(f"{found.dtype} {found.shape[1:]} is stored as {path} where there must be numbers {shape}")
    if plan.get_layout() == h5d.CHUNKED:
        _check_chunks(found, path, plan)
    return found


def _check_chunks(found: h5py.Dataset, path: str, plan: Any) -> None:
    if (size := math.prod(plan.get_chunk()) * found.dtype.itemsize) > max(CHUNK, found.nbytes):
        raise ValueError(f"{path} is stored in chunks of {size:,} bytes, more than {CHUNK:,} and than it has itself")
    filters = [plan.get_filter(i)[0] for i in range(plan.get_nfilters())]
    packing = [code for code in filters if code in (h5z.FILTER_DEFLATE, h5z.FILTER_LZF)]
    if not FILTERS.issuperset(filters) or len(set(filters)) < len(filters) or len(packing) > 1:
        raise ValueError(f"{path} is packed by the filters {filters}; it may be packed by gzip or lzf")
    packed: list[int] = []
    if packing:
        found.id.chunk_iter(lambda chunk: packed.append(chunk.size))
    if max(packed, default=0) > PACKED:
        raise ValueError(f"{path} has a packed chunk of {max(packed):,} bytes; it may have {PACKED:,}")


def check_size(arrays: Iterable[h5py.Dataset], path: Path) -> None:
    """`ValueError` if the arrays are too large, or larger than the file could hold when compressed."""
    arrays = list(arrays)
    if (numbers := sum(math.prod(array.shape) for array in arrays)) > NUMBERS:
        raise ValueError(f"{path.name} holds {numbers:,} numbers, and at most {NUMBERS:,} are read")
    size = path.stat().st_size
    if (unfolded := sum(array.nbytes for array in arrays)) > max(UNFOLDED, RATIO * size):
        raise ValueError(f"{path.name} has {size:,} bytes and says that it unfolds to {unfolded:,}, more than packing can do")


def integer(group: h5py.Group, name: str) -> int | None:
    """An integer attribute, or None if it is missing; `ValueError` if it has another type."""
    if not h5a.exists(group.id, name.encode()):
        return None
    found = h5a.open(group.id, name.encode())
    if found.get_type().get_class() != h5t.INTEGER or found.get_space().get_simple_extent_npoints() != 1:
        raise ValueError(f"its {name} is no whole number")
    value = np.zeros(found.shape, np.int64)
    found.read(value)
    return int(value.item())


if __name__ == "__main__":
    main()
