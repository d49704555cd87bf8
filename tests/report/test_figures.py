"""Figures come from files alone, show the right numbers, and are not blank."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes

from pcil.report import figures
from pcil.report.load import Point

EVALUATIONS = """\
frames,episode,return,length,seconds
0,0,10.0,500,0.1
0,1,30.0,500,0.1
0,2,20.0,500,0.1
1000,0,100.5,500,9.0
1000,1,200.5,500,9.0
20000,0,7.254,500,80.0
"""


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """As much of a run folder as a figure needs."""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "eval.csv").write_text(EVALUATIONS)
    settings = {"task": "walker_walk", "method": "pcil", "preset": "default", "seed": 3}
    about = {"run": settings, "demos": {"return_mean": 960.333}, "commit": "abc+"}
    (folder / "run.json").write_text(json.dumps(about))
    return folder


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Axes]]:
    """The axes of every figure that is closed, kept for a look."""
    kept: list[Axes] = []
    with monkeypatch.context() as patch:
        patch.setattr(plt, "close", lambda figure: kept.extend(figure.axes))
        yield kept
    plt.close("all")


def curve(
    task: str, method: str, seed: int, *means: float, variant: str = "default", expert: float | None = 9.0
) -> list[Point]:
    """One evaluation every 1000 frames."""
    return [
        Point(task, method, variant, seed, 1000 * i, mean, mean - 1, mean + 1, expert, "abc") for i, mean in enumerate(means)
    ]


def lines(axes: Axes) -> dict[str, list[float]]:
    """Heights of the labelled lines, by label."""
    return {str(line.get_label()): list(line.get_ydata()) for line in axes.lines if not str(line.get_label()).startswith("_")}


def pixels(path: Path) -> np.ndarray:
    """Height x width x colour, from 0 to 1."""
    return matplotlib.image.imread(path)[..., :3]


def test_a_runs_curve_is_a_picture_in_its_folder(run: Path) -> None:
    path = figures.run_curve(run, 160.0)
    image = pixels(path)
    assert path == run / "curve.png"
    height, width, _ = image.shape
    assert width >= 1000 and 500 <= height < width
    assert image.reshape(-1, 3).std(axis=0).min() > 0.03, "blank paper has no variance"
    red = (image[..., 0] > 0.6) & (image[..., 1] < 0.1)
    assert red.any(axis=0).sum() > width / 2, "the mean's line in the method's colour crosses the picture"
    assert not plt.get_fignums(), "figures are closed, or a long sweep would fill the memory"


def test_a_runs_curve_shows_its_numbers(run: Path, drawn: list[Axes]) -> None:
    figures.run_curve(run, 160.0)
    (axes,) = drawn
    assert lines(axes) == {"mean": [20.0, 150.5, 7.25], "expert 160": [160.0, 160.0]}
    assert list(axes.lines[0].get_xdata()) == [0, 1000, 20000]
    (band,) = axes.collections
    assert band.get_datalim(axes.transData).intervaly.tolist() == [7.25, 200.5]
    assert axes.get_title() == "walker_walk - pcil (default, seed 3)" and "frames" in axes.get_xlabel()


def test_a_run_without_an_expert_has_no_such_line(run: Path, drawn: list[Axes]) -> None:
    figures.run_curve(run, None)
    assert list(lines(drawn[0])) == ["mean"]


def test_axes_begin_at_zero_except_where_returns_are_below(run: Path, drawn: list[Axes]) -> None:
    """Pendulum-v1 never returns more than 0."""
    figures.run_curve(run, 160.0)
    (run / "eval.csv").write_text("frames,episode,return,length,seconds\n0,0,-900.0,200,0.1\n1000,0,-300.0,200,0.1\n")
    figures.run_curve(run, -150.0)
    above, below = (axes.get_ylim() for axes in drawn)
    assert above[0] == 0 and above[1] > 200.5
    assert below[0] < -900 and below[1] > -150


def test_a_grid_is_a_png_and_a_pdf(tmp_path: Path) -> None:
    points = curve("one", "pcil", 1, 1, 2, 3) + curve("two", "a new method", 1, 1, 1, expert=None)
    path = figures.grid(points, tmp_path / "deep" / "all.png")
    assert path == tmp_path / "deep" / "all.png"
    assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
    image = pixels(path)
    assert image.shape[1] > 2 * image.shape[0], "two panels side by side"
    assert all(half.std() > 0.03 for half in np.array_split(image, 2, axis=1))


def test_a_grid_shows_means_over_seeds_as_far_as_all_have_come(tmp_path: Path, drawn: list[Axes]) -> None:
    figures.grid(curve("task", "pcil", 1, 1, 2, 3) + curve("task", "pcil", 2, 3, 6), tmp_path / "grid")
    (axes,) = drawn
    assert lines(axes) == {"pcil (2 seeds)": [2, 4], "expert 9": [9, 9]}
    assert [list(line.get_ydata()) for line in axes.lines[:2]] == [[1, 2, 3], [3, 6]]


def test_a_grid_tells_variants_and_tasks_apart(tmp_path: Path, drawn: list[Axes]) -> None:
    points = curve("a", "pcil", 1, 1) + curve("a", "pcil", 1, 2, variant="paper") + curve("a", "dac", 1, 3)
    points += [point for task in "bc" for point in curve(task, "dac", 1, 4, expert=None)]
    figures.grid(points, tmp_path / "grid", columns=2)
    assert [axes.get_title() for axes in drawn if axes.axison] == ["a", "b", "c"] and len(drawn) == 4
    names = {"pcil, default (1 seed)": [1], "pcil, paper (1 seed)": [2], "dac (1 seed)": [3], "expert 9": [9, 9]}
    assert lines(drawn[0]) == names
    colours = {line.get_color() for line in drawn[0].lines if str(line.get_label()) in names}
    assert len(colours) == 4


def test_the_same_grid_is_the_same_file(tmp_path: Path) -> None:
    """Committed figures change only where their numbers do."""
    points = curve("task", "pcil", 1, 1, 2, 3)
    one, two = (figures.grid(points, tmp_path / name / "grid.png") for name in "ab")
    assert one.read_bytes() == two.read_bytes()
    pdf = one.with_suffix(".pdf").read_bytes()
    assert pdf == two.with_suffix(".pdf").read_bytes() and b"CreationDate" not in pdf
