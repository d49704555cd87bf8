"""The output on a terminal."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from pcil.training.callbacks import History
from pcil.training.evaluate import Evaluation
from pcil.training.progress import Bar, compared
from small import small_run


def shown(expert: float | None, **changes: Any) -> str:
    """The output on a terminal with 140 columns for one evaluation and two episodes."""
    stream = io.StringIO()
    run = dataclasses.replace(small_run("expert", frames=100_000), **changes)
    with Bar(Console(file=stream, force_terminal=True, width=140, color_system=None), expert) as bar:
        bar.begin(run, Path(), History([], [], 0.0, None))
        bar.evaluation(0, 0.1, Evaluation(np.array([1.0, 3.0]), np.array([5, 5]), 0.1))
        bar.episode({"frames": 1000, "return": 12.0})
        bar.episode({"frames": 2000, "return": 34.0})
        assert not bar.stop()
    return stream.getvalue()


def test_the_bar_says_frames_speed_time_left_and_return_beside_the_experts() -> None:
    text = shown(40.0)
    last = [line for line in text.splitlines() if "2,000/100,000 frames" in line][-1]
    assert "/s" in last and "left" in last and "return 34 of 40" in last
    assert "0 frames  return     2.0  [1.0, 3.0] (5% of the expert's 40.0)" in text


def test_without_an_expert_nothing_is_compared() -> None:
    text = shown(None)
    assert "return 34" in text and "expert's" not in text


def test_a_share_is_said_only_of_positive_returns() -> None:
    assert compared(9.0, 10.0) == "90% of the expert's 10.0"
    assert compared(-9.0, -10.0) == "the expert's -10.0"


def test_a_task_is_no_markup_and_no_escape() -> None:
    text = shown(None, task="[/red]\x1b]0;title\x07")
    assert "[/red]\\x1b]0;title\\x07 expert" in text and "\x1b]0;" not in text
