"""The picture of Theorem 1 shows its numbers, without overlaps, and the same numbers give the same file."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.figure import Figure

from pcil import theory
from pcil.theory.figure import FAILS, HOLDS, draw

PAIRS = [
    theory.Pairs(2, np.array([0.3, 0.6]), np.array([0.4, 0.7]), np.array([0.1, 0.6]), np.zeros(2)),
    theory.Pairs(9, np.array([0.9]), np.array([1.7]), np.array([1.65]), np.zeros(1)),
]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Figure]]:
    """Every closed figure, kept for inspection."""
    kept: list[Figure] = []
    with monkeypatch.context() as patch:
        patch.setattr(plt, "close", kept.append)
        yield kept
    plt.close("all")


def test_both_panels_show_their_numbers(tmp_path: Path, drawn: list[Figure]) -> None:
    draw(PAIRS, tmp_path)
    left, right = drawn[0].axes
    for axes, ratios, bound, star in (
        (left, [0.4, 0.7, 1.7], theory.sharper_bound, 1 / 3),
        (right, [0.1, 0.6, 1.65], theory.bound_with_atoms, 0),
    ):
        fine, below, bounds = axes.collections
        points = np.concatenate([fine.get_offsets(), below.get_offsets()])
        assert sorted(points.tolist()) == sorted([mass, ratio] for mass, ratio in zip([0.3, 0.6, 0.9], ratios, strict=True))
        assert np.all(fine.get_offsets()[:, 1] >= 0.25) and np.all(below.get_offsets()[:, 1] < 0.25)
        assert [segment[0][1] for segment in bounds.get_segments()] == [0.25, 2]
        curve, marked = axes.lines
        assert curve.get_ydata() == pytest.approx(bound(curve.get_xdata()))
        assert [*marked.get_xdata(), *marked.get_ydata()] == pytest.approx([0.25, star], abs=1e-9)
        assert f"{star:.2f}" in axes.texts[1].get_text()
        assert axes.get_ylim()[0] < 0 and axes.get_ylim()[1] > 2, "all possible values are in view"
    assert len(right.collections[1].get_offsets()) == 1 and len(left.collections[1].get_offsets()) == 0


def test_no_words_cover_each_other_or_leave_the_page(tmp_path: Path, drawn: list[Figure]) -> None:
    draw(PAIRS, tmp_path)
    (figure,) = drawn
    figure.canvas.draw()
    texts = [text for axes in figure.axes for text in (*axes.texts, axes.title, axes.xaxis.label, axes.yaxis.label)]
    texts += [text for axes in figure.axes for text in axes.get_xticklabels()]
    labels = zip(figure.axes[0].get_yticks(), figure.axes[0].get_yticklabels(), strict=True)
    texts += [text for height, text in labels if -0.1 < height < 2.15]  # some ticks are out of view
    boxes = [text.get_window_extent() for text in (*texts, *figure.legends[0].get_texts()) if text.get_text()]
    assert len(boxes) > 20
    assert not [pair for pair in itertools.combinations(boxes, 2) if pair[0].overlaps(pair[1])]
    assert all(figure.bbox.contains(*corner) for box in boxes for corner in box.corners())


def test_good_and_bad_differ_in_shade_and_in_shape(tmp_path: Path, drawn: list[Figure]) -> None:
    draw(PAIRS, tmp_path)
    blue, vermilion = (np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) for colour in (HOLDS, FAILS))
    assert abs(blue[0] - vermilion[0]) > 100, "the colours can be distinguished without green"
    fine, below, _ = drawn[0].axes[1].collections
    assert len(fine.get_paths()[0]) != len(below.get_paths()[0])


def test_the_same_numbers_make_the_same_files(tmp_path: Path) -> None:
    one, two = (draw(PAIRS, tmp_path / name) for name in "ab")
    assert one == tmp_path / "a" / "theory.png" and one.read_bytes() == two.read_bytes()
    pdf = one.with_suffix(".pdf").read_bytes()
    assert pdf == two.with_suffix(".pdf").read_bytes() and pdf.startswith(b"%PDF") and b"CreationDate" not in pdf
    assert not plt.get_fignums()
