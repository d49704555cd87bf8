"""Which runs are seeds of one variant, and what the variant is called."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from typing import Any

from pcil.errors import shown

NO_VARIANT = ("task", "method", "preset", "seed", "checkpoint_seconds", "single_environment")
"""Settings by which two runs may differ and still be seeds, or tasks, of one variant."""
LONGEST = 1000
"""Letters of a name."""


def variants(runs: Sequence[dict[str, Any]]) -> list[str]:
    """The preset of each run, and the settings in which runs of its method and preset differ on one task, but for what most
    of these runs have.

    A budget is told only beside another one of the same task: there the usual one goes without, or the longest where the task
    does not have that. Otherwise a task with budgets of its own would part a method's other tasks.
    """
    differing: dict[tuple[str, str], set[str]] = {}
    for one, other in itertools.combinations(runs, 2):
        if all(one[name] == other[name] for name in ("task", "method", "preset")):
            names = {name for name in one | other if one.get(name) != other.get(name)} - set(NO_VARIANT)
            differing.setdefault((one["method"], one["preset"]), set()).update(names)
    usual: dict[tuple[str, str], dict[str, Any]] = {}
    for kind, names in differing.items():
        for name in names:
            values = Counter(str(run.get(name)) for run in runs if (run["method"], run["preset"]) == kind).most_common(2)
            if len(values) == 1 or values[0][1] > values[1][1]:
                usual.setdefault(kind, {})[name] = values[0][0]
    budgets: dict[tuple[str, str, str], set[int]] = {}
    for run in runs:
        budgets.setdefault((run["task"], run["method"], run["preset"]), set()).add(run.get("frames") or 0)
    labels = []
    for run in runs:
        kind = run["method"], run["preset"]
        there, usually = budgets[run["task"], *kind], dict(usual.get(kind, {}))
        if not any(usually.get("frames") == str(frames) for frames in there):
            usually["frames"] = str(max(there))
        told = [(name, str(run.get(name))) for name in sorted(differing.get(kind, ()))]
        parts = [run["preset"], *(shown(f"{name}={value}", 80) for name, value in told if usually.get(name) != value)]
        labels.append(shown(", ".join(parts), LONGEST - len(" ... ")))
    return labels
