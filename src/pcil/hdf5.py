"""Numbers out of HDF5 files that anybody may have written: what a file says of its arrays is checked before they are read.

The HDF5 library follows a file to other files, to code and out of memory. So here nothing but plain arrays in the file itself
can be named, and only as many numbers are read as `NUMBERS`.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from pcil import files

_low: Any = h5py  # whose modules of low-level functions have no types
h5a, h5d, h5l, h5o, h5s, h5t, h5z = (getattr(_low, f"h5{letter}") for letter in "adlostz")

NUMBERS = 2**29
"""At most so many numbers are read of a file: 2 GiB in float32."""
UNFOLDED = 2**26
"""So many bytes any file may unfold to; of more, each byte of the file may stand for at most `RATIO`."""
RATIO = 1100
"""As deflate, the strongest of the `FILTERS`, makes 1 byte of 1032 at most."""
CHUNK = 2**26
"""Bytes of a chunk of an array, where the whole array is not larger."""
PACKED = 2**21
"""Bytes of a packed chunk, which may unfold to `RATIO` times as many before its size is known to be wrong."""
HEADER = 2**16
"""Bytes of what describes an array or a group; types can be nested in it."""
FILTERS = {h5z.FILTER_DEFLATE, h5z.FILTER_LZF, h5z.FILTER_SHUFFLE, h5z.FILTER_FLETCHER32}
"""What arrays may be packed with; the library looks for the code of others in folders of the machine."""


@contextlib.contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """An HDF5 file to read from; `ValueError` where it is none, or a pipe or a device."""
    if not path.exists():
        raise ValueError(f"{path.name} is missing")
    files.open_regular(path).close()
    if not h5py.is_hdf5(path):
        raise ValueError(f"{path.name} is not an HDF5 file")
    with h5py.File(path, "r") as file:
        yield file


def has(group: Any, name: str) -> bool:
    """Whether this is a group that has a member of this name, which may be a link to nowhere."""
    return isinstance(group, h5py.Group) and group.id.links.exists(name.encode())


def member(group: h5py.Group, path: str) -> Any:
    """A group or an array in the same file, named without links; `KeyError` or `ValueError` where there is none."""
    found: Any = group
    for name in path.split("/"):
        if not has(found, name):
            raise KeyError(path)
        if found.id.links.get_info(name.encode()).type != h5l.TYPE_HARD:
            raise ValueError(f"{path} is a link to another place")
        if h5o.get_info(found.id, name.encode()).hdr.space.total > HEADER:
            raise ValueError(f"{path} is described in more than {HEADER:,} bytes")
        found = found[name]
    return found


def array(group: h5py.Group, path: str, shape: list[int]) -> h5py.Dataset:
    """An array of rows of this shape, not read yet; `ValueError` where it is anything but plain numbers in the file itself."""
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
    """`ValueError` where all that is to be read of a file is too much, or more than the file can hold."""
    arrays = list(arrays)
    if (numbers := sum(math.prod(array.shape) for array in arrays)) > NUMBERS:
        raise ValueError(f"{path.name} holds {numbers:,} numbers, and at most {NUMBERS:,} are read")
    size = path.stat().st_size
    if (unfolded := sum(array.nbytes for array in arrays)) > max(UNFOLDED, RATIO * size):
        raise ValueError(f"{path.name} has {size:,} bytes and says that it unfolds to {unfolded:,}, more than packing can do")


def integer(group: h5py.Group, name: str) -> int | None:
    """An attribute that is a whole number, None where there is none of this name; `ValueError` where it is something else."""
    if not h5a.exists(group.id, name.encode()):
        return None
    found = h5a.open(group.id, name.encode())
    if found.get_type().get_class() != h5t.INTEGER or found.get_space().get_simple_extent_npoints() != 1:
        raise ValueError(f"its {name} is no whole number")
    value = np.zeros(found.shape, np.int64)
    found.read(value)
    return int(value.item())
