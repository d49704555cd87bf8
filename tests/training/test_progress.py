"""The output on a terminal."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from pcil.training import progress
from pcil.training.callbacks import History
from pcil.training.evaluate import Evaluation
from pcil.training.progress import Bar, compared
from small import small_run


def shown(expert: float | None, width: int = 140, **changes: Any) -> str:
    """The output on a terminal for one evaluation and four episodes, the first update after the second; the last two are ten
    seconds apart."""
    stream, clock = io.StringIO(), [0.0]
    run = dataclasses.replace(small_run("expert", frames=100_000), **changes)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(progress.time, "perf_counter", lambda: clock[-1])
        with Bar(Console(file=stream, force_terminal=True, width=width, color_system=None), expert) as bar:
            bar.begin(run, Path(), History([], [], 0.0, None))
            bar.evaluation(0, 0.1, Evaluation(np.array([1.0, 3.0]), np.array([5, 5]), 0.1))
            for second, frames, updates in ((1.0, 1000, 0), (2.0, 2000, 0), (100.0, 3000, 10), (110.0, 4000, 20)):
                clock.append(second)
                bar.episode({"frames": frames, "return": 30.0 + updates / 5, "updates": updates})
            assert not bar.stop()
    return stream.getvalue().replace("\x1b[2K", "")


def test_the_bar_says_frames_speed_time_left_and_return_beside_the_experts() -> None:
    text = shown(40.0)
    last = [line for line in text.splitlines() if "4,000/100,000 frames" in line][-1]
    assert "100/s" in last and "0:16:00 left" in last and "return 34 of 40" in last
    assert "0 frames  return     2.0  [1.0, 3.0] (5% of the expert's 40.0)" in text


@pytest.mark.parametrize(
    ("width", "line"),
    [
        (80, "acrobot_swingup expert 4,000/500,000  100/s 1:22:40 left return 34 of 40"),
        (60, "acrobot_swingup expert 4k/500k 1:22:40 left return 34"),
    ],
)
def test_narrow_terminals_have_the_numbers_without_the_bar(width: int, line: str) -> None:
    lines = shown(40.0, width, task="acrobot_swingup", frames=500_000, method="expert").splitlines()
    last = [text for text in lines if text.startswith("acrobot")][-1].rstrip()
    assert last == line
    lines = shown(40.0, width, task="my.package.module:MyRobot-v0", frames=900_000).splitlines()
    assert max(len(text) for text in lines if text.startswith("my.package")) <= width


def test_without_an_expert_nothing_is_compared() -> None:
    text = shown(None)
    assert "return 34" in text and "expert's" not in text


def test_a_share_is_said_only_of_positive_returns() -> None:
    assert compared(9.0, 10.0) == "90% of the expert's 10.0"
    assert compared(-9.0, -10.0) == "the expert's -10.0"


def test_a_task_is_no_markup_and_no_escape() -> None:
    text = shown(None, task="[/red]\x1b]0;title\x07")
    assert "[/red]\\x1b]0;title\\x07 expert" in text and "\x1b]0;" not in text
