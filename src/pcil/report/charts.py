"""Learning curves as data for the charts of a report's page, which `web/charts.js` draws with uPlot."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

from pcil.report import stats
from pcil.report.figures import Style, assign_styles
from pcil.report.load import OFFLINE, Collection, by_variant, label

DIGITS = 5
"""Significant digits of the numbers."""


def of(found: Collection, together: stats.Shares) -> list[dict[str, Any]]:
    """A chart for all tasks `together`, if there are several, and one for each task.

    A chart has a `title`, the label `y` of its axis, the `frames` of all its lines, the return of the `expert` or None, and
    `lines`: `name`, `colour`, `dashes`, and `center`, `low` and `high` with a value, or None, for each of the frames.
    """
    styles, tasks = assign_styles(found.rows), list(dict.fromkeys(row.task for row in found.rows))
    names = {name: label(name, styles) for name in styles}
    made = []
    if len(tasks) > 1 and together:
        lines = [(name, names[name], styles[name], together[name][0]) for name in styles if name in together]
        made.append(_chart("all tasks together", "share of the demonstrations' return", 1.0, lines))
    for task in tasks:
        groups = by_variant(row for row in found.rows if row.task == task)
        own = [name for name in styles if (task, *name) in groups]
        lines = [(name, names[name], styles[name], stats.curve(groups[task, *name])) for name in own]
        experts = [run[0].expert_return for runs in groups.values() for run in runs]
        made.append(_chart(task, "return", max((paid for paid in experts if paid is not None), default=None), lines))
    return made


def _chart(
    title: str, y: str, expert: float | None, lines: Iterable[tuple[tuple[str, str], str, Style, stats.Curve]]
) -> dict[str, Any]:
    lines = [line for line in lines if len(line[3].frames)]
    frames = sorted({int(f) for name, _, _, curve in lines for f in curve.frames if name[0] not in OFFLINE})
    frames = frames or [0, max((int(curve.frames[-1]) for *_, curve in lines), default=1)]
    drawn = []
    for name, text, style, curve in lines:
        values = {}
        for part in ("center", "low", "high"):
            own: list[float] = getattr(curve, part).tolist()
            at = dict(zip(curve.frames.tolist(), own, strict=True))
            at = dict.fromkeys(frames, own[-1]) if name[0] in OFFLINE else at
            values[part] = [_number(at.get(f, math.nan)) for f in frames]
        drawn.append({"name": text, "colour": style.colour, "dashes": style.dashes, **values})
    return {"title": title, "y": y, "expert": _number(math.nan if expert is None else expert), "frames": frames, "lines": drawn}


def _number(value: float) -> float | None:
    """The number with few digits; None if it is not finite, which JSON can't say."""
    return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
