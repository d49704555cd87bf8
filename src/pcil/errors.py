"""The one error that is a person's to mend, and the check of settings that raises it."""

from __future__ import annotations

import math
from typing import Any


class InputError(Exception):
    """Something that a person gave is wrong. The command line prints it as one sentence and exits with code 2."""


def check_ranges(settings: Any, **ranges: tuple[float | int, float | int]) -> None:
    """Each named field must be a number from the first to the second of its range, or `InputError` says which is not."""
    for name, (low, high) in ranges.items():
        value = getattr(settings, name)
        if not low <= value <= high:  # NaN is in no range
            limits = f"at least {low}" if math.isinf(high) else f"from {low} to {high}"
            raise InputError(f"{type(settings).__name__}.{name} is {value}; it must be {limits}.")
