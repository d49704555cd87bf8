"""Files that may be damaged or hostile: locks that follow no links, and text, JSON and TOML that are read within limits."""

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
"""The largest file in bytes that is read into memory."""
DIGITS = 300
"""The largest number of digits of an integer in JSON, about that of a float."""
DEPTH = 100
"""The deepest nesting of tables and lists; deeper ones could be parsed but not printed."""


@contextlib.contextmanager
def locked(path: Path) -> Iterator[bool]:
    """Hold a lock on a file, which is created if necessary. Yields False if another process holds the lock.

    The lock is released when the process ends, even if it is killed; the file stays. `InputError` if the system refuses the
    lock, or if the file is a link.
    """
    import filelock

    lock = filelock.FileLock(path, fallback_to_soft=False)  # soft locks would remain after a process was killed
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
    """The path with `~` expanded to the home directory; `InputError` if that can't be determined."""
    try:
        return path.expanduser()
    except RuntimeError as error:
        raise InputError(f"{path} starts in the home of a user who is not known here; give the whole path.") from error


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading; `ValueError` if it is a pipe or a device, `OSError` as usual."""
    flags = (
        os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    )  # opening a pipe without a writer must not block
    file = open(os.open(path, flags), "rb")  # noqa: SIM115 - the caller closes it
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise ValueError("it is no regular file")
    return file


def read_text(path: Path, limit: int = LARGEST) -> str:
    """The text of a regular file; `ValueError` if it is a pipe, a device or has more than `limit` bytes, `OSError` as usual."""
    with open_regular(path) as file:
        content = file.read(limit + 1)
    if len(content) > limit:
        raise ValueError(f"it is larger than {limit:,} bytes")
    return content.decode()


def write_text(path: Path, text: str) -> None:
    """Write a file atomically: after a crash or a power failure it has either its old or its new content."""
    partial = path.with_suffix(path.suffix + ".tmp")
    with partial.open("w", newline="", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


@contextlib.contextmanager
def room_for(what: str) -> Iterator[None]:
    """Convert exceptions about a full disk or full memory to an `InputError` that begins with `what`."""
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
    """Raise `OSError` if the folder's disk has no room for `size` bytes; for libraries that crash if a write fails."""
    with tempfile.TemporaryFile(dir=folder) as file:
        while size > 0:
            size -= file.write(bytes(min(size, 2**20)))
            file.flush()


def save_arrays(path: Path, arrays: dict[str, Any], metadata: dict[str, str] | None = None) -> None:
    """Write a safetensors file; `OSError` if that fails."""
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
    """Flush a file or a folder to the disk, where the system supports this."""
    with contextlib.suppress(PermissionError):  # Windows can't open folders
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def read_json(path: Path) -> Any:
    """The content of a JSON file; `ValueError` or `OSError` if it can't be read."""
    return parse_json(read_text(path))


def parse_json(text: str | bytes) -> Any:
    """Parse JSON; `ValueError` also if it is nested too deeply or has an integer with too many digits."""
    return _shallow(lambda: json.loads(text, parse_int=_whole))


def read_toml(path: Path) -> dict[str, Any]:
    """The content of a TOML file; `ValueError` or `OSError` if it can't be read."""
    text = read_text(path)
    return _shallow(lambda: tomllib.loads(text))


def _shallow(parse: Callable[[], Any]) -> Any:
    """The parsed value; `ValueError` if it is nested deeper than `DEPTH`."""

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
    """Flatten nested tables to dotted names; `env_kwargs` stays one value."""
    values: dict[str, Any] = {}
    for name, value in table.items():
        nested = isinstance(value, dict) and name.replace("-", "_") != "env_kwargs"
        values |= flat(value, f"{prefix}{name}.") if nested else {prefix + name: value}
    return values
