"""Files as they may lie in a folder: locks that follow no link and empty nothing, small text and JSON read within limits."""

from __future__ import annotations

import contextlib
import json
import os
import re
import stat
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

from pcil.errors import NO_ROOM, InputError

LARGEST = 16 * 2**20
"""Bytes of a file that is read whole."""
DIGITS = 300
"""Of a whole number in JSON; a float holds no more."""
DEPTH = 100
"""Of tables and lists within each other: what is deeper could be read and then not be shown."""


@contextlib.contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Hold the lock of a file, which is made if need be; False where another process holds it.

    The lock ends with the process, however that ends, and the file stays. `InputError` with the reason where the system
    refuses the lock, or where the file is a link.
    """
    import filelock

    lock = filelock.FileLock(path, fallback_to_soft=False)  # soft locks outlive a killed process
    try:
        if path.is_symlink():
            raise OSError("it is a link")
        lock.acquire(blocking=False)
    except filelock.Timeout:
        yield False
        return
    except OSError as error:
        reason = error.strerror or error
        raise InputError(
            f"{path} can't be locked against other processes ({reason}); delete it if it is no plain file, or use a folder "
            "where files can be made and locked."
        ) from error
    try:
        yield True
    finally:
        lock.release()


def expanded(path: Path) -> Path:
    """The path with `~` as the user's home; `InputError` where nobody has that name."""
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise InputError(f"{path} starts in the home of a user who is not known here; give the whole path.") from error


def open_regular(path: Path) -> BinaryIO:
    """A regular file, open to read from; `ValueError` where it is a pipe or a device, `OSError` as ever."""
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)  # a pipe nobody writes to must not block
    file = open(os.open(path, flags), "rb")  # noqa: SIM115 - it is the caller's to close
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise ValueError("it is no regular file")
    return file


def read_text(path: Path, limit: int = LARGEST) -> str:
    """The text of a regular file; `ValueError` where it is a pipe, a device or larger than so many bytes, `OSError` as ever."""
    with open_regular(path) as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f"it is larger than {limit:,} bytes")
    return content.decode()


def write_text(path: Path, text: str) -> None:
    """The whole file or nothing, after a power cut too."""
    partial = path.with_suffix(path.suffix + ".tmp")
    with partial.open("w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


@contextlib.contextmanager
def room_for(what: str) -> Iterator[None]:
    """Turn what a full disk or memory raises into an `InputError` that begins with the name of what did not fit."""
    try:
        yield
    except MemoryError as error:
        raise InputError(f"{what} stopped: there is not enough memory ({error}); make --replay-steps smaller.") from error
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        raise InputError(
            f"{what} stopped: {NO_ROOM[error.errno]}; what was saved is whole: free some space and give the same command again."
        ) from error


def reserve(folder: Path, size: int) -> None:
    """Raise `OSError` where a folder has no room for so many bytes, for libraries that die where a write fails."""
    with tempfile.TemporaryFile(dir=folder) as file:
        while size > 0:
            size -= file.write(bytes(min(size, 2**20)))
            file.flush()


def save_arrays(path: Path, arrays: dict[str, Any], metadata: dict[str, str] | None = None) -> None:
    """Write a safetensors file; `OSError` where the disk does not take it."""
    import numpy as np
    from safetensors import SafetensorError
    from safetensors.numpy import save_file

    try:
        save_file({name: np.asarray(array, order="C") for name, array in arrays.items()}, path, metadata)
    except SafetensorError as error:
        if not (code := re.search(r"(?:os error|code:) (\d+)", str(error))):
            raise
        raise OSError(int(code[1]), os.strerror(int(code[1])), str(path)) from error


def sync(path: Path) -> None:
    """Return once the disk holds a file, or the names in a folder, where the system can say so of a folder."""
    with contextlib.suppress(PermissionError):  # Windows opens no folder
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_json(path: Path, limit: int = LARGEST) -> Any:
    """What a JSON file holds; `ValueError` or `OSError` where it can't be read."""
    return parse_json(read_text(path, limit))


def parse_json(text: str | bytes) -> Any:
    """What JSON text says; `ValueError` too where it is nested too deeply, or holds a whole number that no float holds."""
    return _shallow(lambda: json.loads(text, parse_int=_whole))


def read_toml(path: Path) -> dict[str, Any]:
    """What a TOML file holds; `ValueError` or `OSError` where it can't be read."""
    text = read_text(path)
    return _shallow(lambda: tomllib.loads(text))


def _shallow(parse: Callable[[], Any]) -> Any:
    """What is parsed, if it is nested no deeper than `DEPTH`, or else `ValueError`."""

    def check(value: Any, left: int) -> None:
        if left < 0:
            raise RecursionError
        for part in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
            check(part, left - 1)

    try:
        value = parse()
        check(value, DEPTH)
        return value
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _whole(digits: str) -> int:
    if len(digits) > DIGITS:
        raise ValueError(f"it holds a number of {len(digits):,} digits")
    return int(digits)


def flat(table: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """The values of nested tables by their dotted names; an environment's keyword arguments are one value."""
    values: dict[str, Any] = {}
    for name, value in table.items():
        nested = isinstance(value, dict) and name.replace("-", "_") != "env_kwargs"
        values |= flat(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return values
