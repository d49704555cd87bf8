"""Which runs are seeds of one variant, and what the variant is called."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

from pcil.errors import shown

NO_VARIANT = ("task", "method", "preset", "seed", "checkpoint_seconds", "single_environment")
"""Settings by which two runs may differ and still be seeds, or tasks, of one variant."""
MAX_NAME_LENGTH = 1000
"""Letters of a name."""


def variants(runs: Sequence[dict[str, Any]]) -> list[str]:
    """The preset of each run, and the settings in which runs of its method and preset differ on one task, but for what most
    of these runs have.

    A budget is told only beside another one of the same task: there the usual one goes without, or the longest where the task
    does not have that. Otherwise a task with budgets of its own would part a method's other tasks.
    """
    groups: dict[tuple[str, str], list[int]] = {}
    for i, run in enumerate(runs):
        groups.setdefault((run["method"], run["preset"]), []).append(i)
    labels = [""] * len(runs)
    for (_, preset), members in groups.items():
        group = [runs[i] for i in members]
        pairs = [(one, other) for one, other in itertools.combinations(group, 2) if one["task"] == other["task"]]
        differing = {name for one, other in pairs for name in one | other if one.get(name) != other.get(name)} - set(NO_VARIANT)
        usual = {name: _most_frequent(str(run.get(name)) for run in group) for name in differing}
        for i, own in zip(members, group, strict=True):
            budgets = [run.get("frames") or 0 for run in group if run["task"] == own["task"]]
            untold = usual if str(usual.get("frames")) in map(str, budgets) else usual | {"frames": str(max(budgets))}
            values = {name: str(own.get(name)) for name in sorted(differing)}
            changes = [shown(f"{name}={value}", 80) for name, value in values.items() if untold.get(name) != value]
            labels[i] = shown(", ".join([preset, *changes]), MAX_NAME_LENGTH - len(" ... "))
    return labels


def _most_frequent(values: Iterable[str]) -> str | None:
    """The value that occurs most often; None where two occur equally often."""
    (value, count), *others = Counter(values).most_common(2)
    return None if others and others[0][1] == count else value
