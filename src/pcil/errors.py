"""The exceptions that the command line prints as one sentence, and the checks of settings that raise them."""

from __future__ import annotations

import dataclasses
import errno
import functools
import json
import math
import numbers
import reprlib
import types
import typing
from typing import Any

NO_ROOM = {
    errno.ENOSPC: "the disk is full",
    errno.EDQUOT: "the quota on the disk is used up",
    errno.EFBIG: "a file would be larger than the system allows (ulimit -f)",
}
"""The system errors that mean that nothing more can be written."""
WHOLE = 2**53
"""The largest integer of a setting; a float can represent every integer up to this."""


class InputError(Exception):
    """The user's input is invalid. The command line prints the message as one sentence and exits with `exit_code`."""

    exit_code = 2


class RunError(InputError):
    """A run failed: its environment raised an exception or returned a value that is not finite, or training diverged.

    `__cause__` is the exception of the environment, if there was one.
    """

    exit_code = 1


def brief(value: Any) -> str:
    """A short description of a value: shape and dtype of an array, a plain value (shortened), or the class of an object."""
    shape = getattr(value, "shape", None)
    if isinstance(shape, tuple) and not isinstance(value, numbers.Number):
        return f"an array of shape {shape} and dtype {getattr(value, 'dtype', 'unknown')}"
    if value is None or isinstance(value, (str, bytes, numbers.Number, list, tuple, dict, set)):
        text = reprlib.repr(value)
        return text if len(text) <= 80 else f"{text[:77]}..."
    return f"an object of class {type(value).__module__}.{type(value).__qualname__}"


def shown(text: str, longest: int = 1500) -> str:
    """Text for one line of a terminal: characters that are not printable are escaped, and long text is shortened."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    half = longest // 2
    return text if len(text) <= longest else f"{text[:half]} ... {text[-half:]}"


def as_message(error: Exception) -> tuple[str, int] | None:
    """The message and the exit code of a command that ends with this exception; None if it can only be a bug of ours."""
    if isinstance(error, InputError):
        sentence = " ".join(str(error).split())  # messages of libraries may have line breaks
        return shown(sentence.removesuffix(".")), error.exit_code
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.EMFILE, errno.ENFILE, errno.ENOMEM, errno.EAGAIN) or isinstance(error, MemoryError):
        scarce = True
    else:  # messages of JAX and Python
        scarce = any(text in str(error) for text in ("RESOURCE_EXHAUSTED", "bad_alloc", "can't start new thread"))
    if scarce:
        reason = shown(" ".join(str(error).split()) or "no memory is left", 300)
        return f"The system refuses what this needs ({reason}); raise the limits that ulimit -a shows, or ask for less", 1
    if isinstance(error, OSError) and (error.filename is not None or number in NO_ROOM):
        return f"{shown(str(error.filename or 'standard output'), 500)} can't be read or written ({error.strerror})", 2
    return None


def check_ranges(settings: Any, **ranges: tuple[float | int, float | int]) -> None:
    """Check that each named field is within its range (low, high); `InputError` names the first that is not."""
    for name, (low, high) in ranges.items():
        value = getattr(settings, name)
        high = WHOLE if isinstance(value, int) and math.isinf(high) and value > WHOLE else high
        if not low <= value <= high:  # also refuses NaN
            limits = f"at least {low}" if math.isinf(high) else f"from {low} to {high}"
            raise InputError(f"{type(settings).__name__}.{name} is {value}; it must be {limits}.")


_type_hints = functools.cache(typing.get_type_hints)


def check_kinds(settings: Any) -> None:
    """Check that each field has the type of its annotation: a Literal, a number, text or a class; else `InputError`."""
    hints = _type_hints(type(settings))
    for field in dataclasses.fields(settings):
        value, hint = getattr(settings, field.name), hints[field.name]
        if not _fits(value, hint):
            raise InputError(f"{type(settings).__name__}.{field.name} is {brief(value)}; it must be {_described(hint)}.")


def json_object(name: str, value: Any) -> dict[str, Any]:
    """`value`, a dict or JSON text, after a round trip through JSON (tuples become lists); `InputError` if it is no object."""
    try:
        value = json.loads(value) if isinstance(value, str) else value
        if isinstance(value, dict) and all(isinstance(key, str) for key in value):
            return json.loads(json.dumps(value, allow_nan=False))
    except (ValueError, TypeError, RecursionError):
        pass
    given = repr(value)
    given = given if len(given) <= 80 else f"{given[:80]}..."
    raise InputError(f'{name} is {given}; it must be a JSON object such as {{"frame_skip": 5}}.')


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value matches an annotation; annotations that are not known here match every value."""
    if typing.get_origin(hint) is typing.Literal:
        return isinstance(value, str) and value in typing.get_args(hint)
    if isinstance(hint, types.UnionType):
        return any(_fits(value, part) for part in typing.get_args(hint))
    if hint in (int, float):
        return isinstance(value, numbers.Integral if hint is int else numbers.Real) and not isinstance(value, bool)
    return not isinstance(hint, type) or isinstance(value, hint)


def _described(hint: Any) -> str:
    if typing.get_origin(hint) is typing.Literal:
        return f"one of {', '.join(map(repr, typing.get_args(hint)))}"
    if isinstance(hint, types.UnionType):
        return " or ".join(map(_described, typing.get_args(hint)))
    names = {int: "a whole number", float: "a number", str: "text", bool: "True or False", types.NoneType: "None"}
    return names.get(hint) or f"of class {hint.__name__}"
