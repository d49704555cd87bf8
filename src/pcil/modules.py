"""User code that is named as `module:Name`. A module that is named in a file is imported only if the user trusts it."""

from __future__ import annotations

import contextlib
import importlib
import os
import re
import sys
from collections.abc import Container, Iterable, Sequence
from typing import Annotated, Any

import tyro

from pcil.errors import InputError, brief

Trust = Annotated[tuple[str, ...], tyro.conf.arg(metavar="MODULE ...")]
"""The option that lists the modules that a file may name."""
_NAMED = re.compile(r"([^\W\d][\w.]*):[\w-]")


def is_ours(module: str) -> bool:
    """Whether a module belongs to this package, so that a file may name its classes without trust."""
    return module.startswith(("pcil.agents.", "pcil.nets.", "pcil.rewards."))


def of_task(task: str, env_kwargs: Any = None) -> list[str]:
    """The modules that Gymnasium imports for a task, and those in keyword arguments that look like `module:Name`."""
    return [*([task.partition(":")[0]] if ":" in task else []), *_of_values(env_kwargs)]


def of_class(spec: Any, registry: Container[str] = ()) -> list[str]:
    """The module that is imported for a class named as `module:Class`; none for a name in the registry or a class of ours."""
    module = spec.partition(":")[0] if isinstance(spec, str) and spec not in registry else None
    return [] if module is None or is_ours(module) else [module]


def admit(source: str, names: Iterable[str], trust: Sequence[str] | None) -> None:
    """Allow the modules that `source` names to be imported, also from the current folder, which is searched last.

    `trust` are the modules that a file may name, including their submodules; None if the user typed the names. `InputError` if
    another module is named.
    """
    for name in (names := list(names)):
        if trust is not None and not any(f"{name}.".startswith(f"{trusted}.") for trusted in trust):
            raise InputError(
                f"{source} names code of the module {brief(name)}, and what a file names is not run unasked; read that code, "
                f"and give --trust {name} if you trust it."
            )
    with contextlib.suppress(OSError):  # the current folder may have been deleted
        if names and (here := os.getcwd()) not in sys.path:
            sys.path.append(here)


def _of_values(values: Any) -> list[str]:
    if isinstance(values, str):
        found = _NAMED.match(values)
        return [found[1]] if found else []
    parts = [*values, *values.values()] if isinstance(values, dict) else values if isinstance(values, list) else []
    return [name for part in parts for name in _of_values(part)]


def load(option: str, spec: str, base: type, expected: str) -> Any:
    """Import the subclass of `base` that `spec`, `module:Class`, names; the `InputError` tells what was `expected`."""
    module, _, name = spec.partition(":")
    try:
        kind = getattr(importlib.import_module(module), name)
        if not (isinstance(kind, type) and issubclass(kind, base)):
            raise TypeError(f"{name} is no subclass of pcil.{base.__name__}")
        return kind
    except Exception as error:  # the module is a user's own and may raise anything
        raise InputError(
            f"{option} {spec!r} can't be loaded ({type(error).__name__}: {error}); it must look like {expected}."
        ) from error


def instance(option: str, kind: type) -> Any:
    """An object of the class, created without arguments; `InputError` where its code raises."""
    try:
        return kind()
    except InputError:
        raise
    except Exception as error:  # the class may be a user's own and may raise anything
        raise InputError(
            f"{option} {kind.__module__}:{kind.__qualname__} can't be created without arguments "
            f"({type(error).__name__}: {error}); it must define every abstract method, and every argument needs a default."
        ) from error
