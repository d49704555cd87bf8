"""The data of the page's charts, by hand."""

from __future__ import annotations

import json

import pytest
from test_figures import curve

from pcil.report import charts, stats
from pcil.report.load import Collection


def made(rows: list) -> dict[str, dict]:
    found = charts.of(Collection(rows, [], {}, []), stats.share_curves(rows))
    json.dumps(found, allow_nan=False)
    return {chart["title"]: chart for chart in found}


def test_a_task_has_the_mean_of_its_seeds_with_students_interval() -> None:
    """Two seeds of 4 and 6 have the mean 5 and the interval 5 -+ 12.706 sqrt(2) / sqrt(2)."""
    rows = curve("a", "pcil", 1, 0, 4, expert=10.0) + curve("a", "pcil", 2, 0, 6, expert=10.0)
    chart = made(rows)["a"]
    (line,) = chart["lines"]
    assert chart["frames"] == [0, 1000] and chart["expert"] == 10.0 and line["name"] == "pcil"
    assert line["center"] == [0, 5]
    assert [line["low"][1], line["high"][1]] == [pytest.approx(5 - 12.706, abs=1e-3), pytest.approx(5 + 12.706, abs=1e-3)]


def test_lines_have_a_value_only_where_they_were_evaluated() -> None:
    """One seed has no interval; a method without steps in the environment is level at its last return."""
    rows = curve("a", "pcil", 1, 0, 4, 8) + curve("a", "dac", 1, 1, 3) + curve("a", "bc", 1, 2, 7)
    lines = {line["name"]: line for line in made(rows)["a"]["lines"]}
    assert lines["pcil"]["center"] == [0, 4, 8] and lines["pcil"]["low"] == [None] * 3
    assert lines["dac"]["center"] == [1, 3, None] and lines["bc"]["center"] == [7, 7, 7]


def test_several_tasks_are_also_put_together() -> None:
    """As the interquartile mean of the shares: of 0.5, 0.7, 0.3 and 1, the mean of the middle two."""
    rows = curve("a", "pcil", 1, 0, 5, expert=10.0) + curve("a", "pcil", 2, 0, 7, expert=10.0)
    rows += curve("b", "pcil", 1, 0, 6, expert=20.0) + curve("b", "pcil", 2, 0, 20, expert=20.0)
    found = made(rows)
    assert list(found) == ["all tasks together", "a", "b"]
    assert found["all tasks together"]["lines"][0]["center"] == [0, pytest.approx(0.6)]
    assert found["all tasks together"]["expert"] == 1.0
    assert list(made(curve("a", "pcil", 1, 0, 5))) == ["a"]
