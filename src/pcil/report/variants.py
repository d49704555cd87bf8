"""Which runs are seeds of the same variant, and the name of that variant."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from pcil.errors import shown

NO_VARIANT = ("task", "method", "preset", "seed", "checkpoint_seconds", "keep_replay", "single_environment")
"""Settings in which runs of the same variant may differ."""
MAX_NAME_LENGTH = 1000
"""The largest number of characters in a name."""


def variants(runs: Sequence[dict[str, Any]]) -> list[str]:
    """Name the variant of each run: its preset, followed by the settings that set it apart.

    These are the settings in which runs of the same method and preset differ on one task. A setting is left out where it has
    its most frequent value among the runs of that method and preset; if two values are equally frequent, both are named.

    The number of frames is named only if the task has runs of other lengths. The most frequent length is left out, or the
    longest if the task has no run of the most frequent one. Otherwise a task with lengths of its own would separate the
    method's runs there from those on other tasks.
    """
    groups: dict[tuple[str, str], list[int]] = {}
    for i, run in enumerate(runs):
        groups.setdefault((run["method"], run["preset"]), []).append(i)
    labels = [""] * len(runs)
    for (_, preset), members in groups.items():
        group = [runs[i] for i in members]
        pairs = [(one, other) for one, other in itertools.combinations(group, 2) if one["task"] == other["task"]]
        differing = {name for one, other in pairs for name in one | other if one.get(name) != other.get(name)} - set(NO_VARIANT)
        common = {name: _most_frequent(str(run.get(name)) for run in group) for name in differing}
        for i, own in zip(members, group, strict=True):
            lengths = [run.get("frames") or 0 for run in group if run["task"] == own["task"]]
            usual = common if str(common.get("frames")) in map(str, lengths) else common | {"frames": str(max(lengths))}
            values = {name: str(own.get(name)) for name in sorted(differing)}
            changes = [shown(f"{name}={value}", 80) for name, value in values.items() if usual.get(name) != value]
            labels[i] = shown(", ".join([preset, *changes]), MAX_NAME_LENGTH - len(" ... "))
    return labels


def _most_frequent(values: Iterable[str]) -> str | None:
    """The value that occurs most often; None if another one occurs as often."""
    (value, count), *others = Counter(values).most_common(2)
    return None if others and others[0][1] == count else value
