"""Figures come from files alone, show the right numbers, and are not blank."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import matplotlib.image
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb

from pcil.report import figures, stats, tables
from pcil.report.load import EvalRow, TransitionRow
from pcil.training import presets

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
    """The parts of a run folder that a figure needs."""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "eval.csv").write_text(EVALUATIONS)
    settings = {"task": "walker_walk", "method": "pcil", "preset": "default", "seed": 3}
    about = {"run": settings, "demos": {"return_mean": 960.333}, "commit": "abc+"}
    (folder / "run.json").write_text(json.dumps(about))
    return folder


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Axes]]:
    """The axes of every closed figure, kept for inspection."""
    kept: list[Axes] = []
    with monkeypatch.context() as patch:
        patch.setattr(plt, "close", lambda figure: kept.extend(figure.axes))
        yield kept
    plt.close("all")


def curve(
    task: str, method: str, seed: int, *means: float, variant: str = "default", expert: float | None = 9.0
) -> list[EvalRow]:
    """One evaluation every 1000 frames."""
    triples = [(float(mean), mean - 1.0, mean + 1.0) for mean in means]
    return [EvalRow(task, method, variant, seed, 1000 * i, *triple, expert, "abc") for i, triple in enumerate(triples)]


def lines(axes: Axes) -> dict[str, list[float]]:
    """The y values of the labelled lines, by label."""
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
    assert image.reshape(-1, 3).std(axis=0).min() > 0.03, "a blank picture has no variance"
    red = (image[..., 0] > 0.6) & (image[..., 1] < 0.1)
    assert red.any(axis=0).sum() > width / 2, "the mean's line in the method's colour crosses the picture"
    assert not plt.get_fignums(), "figures are closed, or a long sweep would fill the memory"


def test_a_runs_curve_shows_its_numbers(run: Path, drawn: list[Axes]) -> None:
    figures.run_curve(run, 160.0)
    (axes,) = drawn
    assert lines(axes) == {"mean": [20.0, 150.5, 7.25], "demos": [160.0, 160.0]}
    assert list(axes.lines[0].get_xdata()) == [0, 1000, 20000]
    (band,) = axes.collections
    assert band.get_datalim(axes.transData).intervaly.tolist() == [7.25, 200.5]
    assert axes.get_title() == "walker_walk - pcil (default, seed 3)" and "frames" in axes.get_xlabel()


def test_a_run_without_an_expert_has_no_such_line(run: Path, drawn: list[Axes]) -> None:
    figures.run_curve(run, None)
    assert list(lines(drawn[0])) == ["mean"]


def test_axes_begin_at_zero_except_where_returns_are_below(run: Path, drawn: list[Axes]) -> None:
    """The return of Pendulum-v1 is never above 0."""
    figures.run_curve(run, 160.0)
    (run / "eval.csv").write_text("frames,episode,return,length,seconds\n0,0,-900.0,200,0.1\n1000,0,-300.0,200,0.1\n")
    figures.run_curve(run, -150.0)
    above, below = (axes.get_ylim() for axes in drawn)
    assert above[0] == 0 and above[1] > 200.5
    assert below[0] < -900 and below[1] > -150


@pytest.mark.parametrize("make", figures.FIGURES)
def test_every_kind_of_figure_has_a_heading_and_a_caption(make: Callable[..., Any]) -> None:
    heading, caption = tables.title_and_caption(make)
    assert 3 < len(heading) < 40 and caption.endswith(".") and len(caption) > 40


def test_a_grid_is_a_png_a_pdf_and_svg(tmp_path: Path) -> None:
    rows = curve("one", "pcil", 1, 1, 2, 3) + curve("two", "a new method", 1, 1, 1, expert=None)
    svg = figures.grid(rows, tmp_path / "deep" / "all")
    path = tmp_path / "deep" / "all.png"
    assert path.with_suffix(".pdf").read_bytes().startswith(b"%PDF")
    assert svg.startswith("<?xml") and svg.rstrip().endswith("</svg>")
    image = pixels(path)
    assert image.shape[1] > 2 * image.shape[0], "two panels side by side"
    assert all(half.std() > 0.03 for half in np.array_split(image, 2, axis=1))


def test_a_long_legend_takes_nothing_from_the_panels(tmp_path: Path, drawn: list[Axes]) -> None:
    """Twenty variants in one column; the figure grows with them."""
    few, many = (
        [row for i in range(count) for row in curve("task", "pcil", 1, 1, 2, variant=f"default, some.setting_of_a_run={i}")]
        for count in (2, 20)
    )
    figures.grid(few, tmp_path / "few")
    figures.grid(many, tmp_path / "many")
    heights = [axes.get_window_extent().height for axes in drawn]
    assert 100 < heights[0] <= heights[1] < 1.3 * heights[0]


def test_a_grid_shows_means_over_seeds_as_far_as_all_have_come(tmp_path: Path, drawn: list[Axes]) -> None:
    """Student's interval of two numbers is +- 12.706 times half their distance; the axis may cut off the band."""
    figures.grid(curve("task", "pcil", 1, 1, 2, 3) + curve("task", "pcil", 2, 3, 6), tmp_path / "grid")
    (axes,) = drawn
    assert lines(axes) == {"pcil": [2, 4], "demos": [9, 9]} and axes.get_title() == "task, 2 seeds"
    assert [list(line.get_ydata()) for line in axes.lines[:2]] == [[1, 2, 3], [3, 6]]
    (band,) = axes.collections
    assert np.allclose(band.get_datalim(axes.transData).intervaly, [4 - 12.706 * 2, 4 + 12.706 * 2], atol=1e-2)
    assert axes.get_ylim()[0] == 0 and 9 < axes.get_ylim()[1] < 12


def test_one_seed_has_no_band(tmp_path: Path, drawn: list[Axes]) -> None:
    figures.grid(curve("task", "pcil", 1, 1, 2, 3), tmp_path / "grid")
    assert not drawn[0].collections and drawn[0].get_title() == "task, 1 seed"


def test_a_grid_tells_variants_and_tasks_apart(tmp_path: Path, drawn: list[Axes]) -> None:
    rows = curve("a", "pcil", 1, 1) + curve("a", "pcil", 1, 2, variant="paper") + curve("a", "dac", 1, 3)
    rows += [row for task in "bc" for row in curve(task, "dac", 1, 4, expert=None)]
    figures.grid(rows, tmp_path / "grid", columns=2)
    titles = ["a, 1 seed", "b, 1 seed", "c, 1 seed"]
    assert [axes.get_title() for axes in drawn if axes.axison] == titles and len(drawn) == 4
    names = {"pcil, default": [1], "pcil, paper": [2], "dac": [3], "demos": [9, 9]}
    assert lines(drawn[0]) == names
    shown = [line for line in drawn[0].lines if str(line.get_label()) in names]
    assert len({line.get_color() for line in shown}) == len({line.get_marker() for line in shown}) == 4
    (legend,) = drawn[0].get_figure().legends
    assert sorted(text.get_text() for text in legend.get_texts()) == sorted(names), "one legend for all panels"


def test_health_is_drawn_where_it_is_known(tmp_path: Path, drawn: list[Axes]) -> None:
    known = [row._replace(correlation=0.1 * i) for i, row in enumerate(curve("a", "pcil", 1, 1, 2, 3))]
    figures.grid(known + curve("b", "bc", 1, 5, 6), tmp_path / "grid", value="correlation")
    (axes,) = drawn
    assert np.allclose(lines(axes)["pcil"], [0, 0.1, 0.2]) and "correlation" in axes.get_ylabel()
    assert len(axes.lines) == 1, "one line: neither seeds nor demonstrations"


def test_tasks_together_are_an_iqm_of_shares(tmp_path: Path, drawn: list[Axes]) -> None:
    """Four seeds end at 0.5, 0.7, 0.3 and 1 times the expert's return: without the lowest and the highest, the mean is 0.6."""
    rows = curve("a", "pcil", 1, 0, 5, expert=10.0) + curve("a", "pcil", 2, 0, 7, expert=10.0)
    rows += curve("b", "pcil", 1, 0, 6, expert=20.0) + curve("b", "pcil", 2, 0, 20, expert=20.0)
    rows += curve("c", "dac", 1, 3, 4, expert=None)
    figures.aggregate(stats.share_curves(rows), tmp_path / "all", figures.assign_styles(rows))
    (axes,) = drawn
    assert np.allclose(lines(axes)["pcil"], [0, 0.6]) and axes.get_title() == "2 tasks" and "dac" not in lines(axes)
    assert np.allclose(axes.collections[0].get_datalim(axes.transData).intervaly, [0, 0.85])


def test_a_method_without_steps_is_a_level_line(tmp_path: Path, drawn: list[Axes]) -> None:
    """At the mean of its seeds' last returns; for several tasks, at the fraction of the expert's return."""
    rows = curve("a", "bc", 1, 0, 1, 4) + curve("a", "bc", 2, 0, 1, 6)
    rows += curve("a", "pcil", 1, 0, 9) + curve("b", "pcil", 1, 0, 9)
    figures.grid(rows, tmp_path / "grid", columns=2)
    figures.aggregate(stats.share_curves(rows), tmp_path / "all", figures.assign_styles(rows))
    assert lines(drawn[0])["bc"] == [5, 5] and drawn[0].get_title() == "a, 1 to 2 seeds"
    assert lines(drawn[2]) == {"pcil (2 tasks)": [0, 1], "bc (1 task)": [pytest.approx(5 / 9)] * 2, "demos": [1, 1]}


def test_without_an_expert_there_is_nothing_to_put_together(tmp_path: Path) -> None:
    rows = curve("a", "pcil", 1, 0, 5, expert=None)
    assert figures.aggregate(stats.share_curves(rows), tmp_path / "all", figures.assign_styles(rows)) == ""
    assert not list(tmp_path.iterdir())


def test_the_same_grid_is_the_same_file(tmp_path: Path) -> None:
    """Committed figures change only if their numbers do."""
    rows = curve("task", "pcil", 1, 1, 2, 3) + curve("task", "pcil", 2, 3, 6)
    one, two = (figures.grid(rows, tmp_path / name / "grid") for name in "ab")
    assert one == two
    for kind in ("png", "pdf"):
        first, second = ((tmp_path / name / f"grid.{kind}").read_bytes() for name in "ab")
        assert first == second and b"CreationDate" not in first


# --- Appearance ---


def luminance(colour: str) -> float:
    """Relative luminance of sRGB (WCAG 2)."""
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_every_method_has_a_look_and_can_be_told_without_colour() -> None:
    looks = [*figures.STYLES.values(), *figures.SPARE_STYLES]
    assert set(figures.STYLES) >= set(presets.METHODS) | {"pwil", "sil", "tcn", "pcil-gail", "tcn-gail", "potil"}
    assert len({look.marker for look in looks}) == len({look.colour for look in looks}) == len(looks)
    assert len({look.dashes for look in figures.STYLES.values()}) == len(figures.STYLES)


@pytest.mark.parametrize("colour", [look.colour for look in (*figures.STYLES.values(), *figures.SPARE_STYLES)])
def test_lines_stand_out_from_the_paper(colour: str) -> None:
    assert 1.05 / (luminance(colour) + 0.05) > 3, "WCAG's minimum contrast for graphical objects"


def test_a_look_does_not_depend_on_who_else_is_there() -> None:
    everyone = [row for method in ("dac", "zzz", "pcil", "aaa") for row in curve("a", method, 1, 1)]
    looks = figures.assign_styles(everyone + curve("a", "pcil", 1, 1, variant="paper"))
    assert looks["pcil", "default"] == figures.STYLES["pcil"] and looks["dac", "default"] == figures.STYLES["dac"]
    assert len(set(looks.values())) == 5 and list(looks)[:3] == [("pcil", "default"), ("pcil", "paper"), ("dac", "default")]


# --- Representations ---


def test_transitions_are_drawn_where_they_lie(tmp_path: Path, drawn: list[Axes]) -> None:
    """One row for each method, one column for each task; one panel is missing; of two seeds the first is drawn."""

    def make_transitions(task: str, method: str, seed: int, shift: float) -> list[TransitionRow]:
        head = (task, method, "default", seed, 5000)
        return [
            TransitionRow(*head, None, 0.0, 0.5, shift, 0.0),
            TransitionRow(*head, 0.0, 1.0, 0.5, shift + 1, 1.0),
            TransitionRow(*head, 2.0, 3.0, 0.5, shift + 2, 3.0),
        ]

    transitions = make_transitions("a", "dac", 1, 10) + make_transitions("a", "dac", 2, 50)
    transitions += make_transitions("a", "pcil", 1, 20) + make_transitions("b", "pcil", 1, 30)
    transitions += [TransitionRow("a", "pcil", "default", 1, 5000, 5.0, 1.0, 0.5, 20.0, 9.0)]
    figures.scatter_grid(transitions, tmp_path / "clouds")
    panels = [axes for axes in drawn if axes.get_title()]
    assert [axes.get_title().split(",")[:2] for axes in panels] == [["a", " dac"], ["a", " pcil"], ["b", " pcil"]]
    (agent,), (expert,) = panels[0].collections, panels[0].lines
    assert np.asarray(agent.get_offsets()).tolist() == [[11, 1], [12, 3]]
    assert expert.get_xydata().tolist() == [[10, 0]] and expert.get_label() == "expert"
    assert agent.get_array().tolist() == [0, 2]
    assert [axes.collections[0].get_clim() for axes in panels] == [(0, 5), (0, 5), (0, 2)], "a task has one colour scale"
    red, green, blue = to_rgb(expert.get_color())
    assert blue > green > red, "experts are blue"
    low, high = figures.REWARD_COLOURS([0.0, 1.0])
    assert low[1] > 2 * low[0] and low.sum() < high.sum() and min(high[:2]) > 0.8 > 0.3 > high[2], "dark green to yellow"
