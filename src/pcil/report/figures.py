"""Learning curves, from files alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

from pcil.report.load import Point, read_run

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

INK, GREY = "#1b1b1b", "#808080"
COLOURS = {
    "pcil": "#a60628",  # the paper's legend, appendix
    "dac": "#348abd",
    "pwil": "#467821",
    "sil": "#d55e00",
    "bc": "#7a68a6",
    "expert": GREY,
}


def run_curve(folder: Path, expert_return: float | None) -> Path:
    """Draw one run's learning curve as `curve.png` in its folder, and return that path."""
    points = read_run(folder)
    task, method, preset, seed = points[0][:4]
    frames = [point.frames for point in points]
    figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
    low, high = [point.return_low for point in points], [point.return_high for point in points]
    colour = COLOURS.get(method, INK)
    axis.fill_between(frames, low, high, color=colour, alpha=0.18, linewidth=0, label="lowest to highest episode")
    axis.plot(frames, [point.return_mean for point in points], color=colour, marker="o", markersize=3, label="mean")
    if expert_return is not None:
        axis.axhline(expert_return, color=GREY, linestyle="--", linewidth=1, label=f"expert {expert_return:.0f}")
    _finish(axis, f"{task} - {method} ({preset}, seed {seed})")
    path = folder / "curve.png"
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return path


def grid(points: Sequence[Point], path: Path, columns: int = 3) -> Path:
    """A panel for each task: the mean over seeds of each method and variant, every seed behind it, and the expert's return.

    Written as PNG and PDF; returns the PNG's path.
    """
    tasks = list(dict.fromkeys(point.task for point in points))
    columns = min(columns, len(tasks))
    rows = -(-len(tasks) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(4.4 * columns, 3.2 * rows), layout="constrained", squeeze=False)
    for axis in axes.flat[len(tasks) :]:
        axis.axis("off")
    for axis, task in zip(axes.flat, tasks, strict=False):
        _panel(axis, task, [point for point in points if point.task == task])
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path.with_suffix(".png"), dpi=130)
    figure.savefig(path.with_suffix(".pdf"), metadata={"CreationDate": None})
    plt.close(figure)
    return path.with_suffix(".png")


def _panel(axis: Axes, task: str, points: Sequence[Point]) -> None:
    variants = list(dict.fromkeys((point.method, point.variant) for point in points))
    methods = [method for method, _ in variants]
    for index, (method, variant) in enumerate(variants):
        alone = methods.count(method) == 1
        colour = COLOURS.get(method, INK) if alone else plt.get_cmap("tab10")(index)
        mine = [point for point in points if (point.method, point.variant) == (method, variant)]
        _seeds(axis, mine, colour, method if alone else f"{method}, {variant}")
    for expert in {point.expert_return for point in points if point.expert_return is not None}:
        axis.axhline(expert, color=GREY, linestyle="--", linewidth=1, label=f"expert {expert:.0f}")
    _finish(axis, task)


def _seeds(axis: Axes, points: Sequence[Point], colour: object, name: str) -> None:
    """Each seed as a thin line, and their mean as far as the shortest reaches."""
    seeds = list(dict.fromkeys(point.seed for point in points))
    curves = [[(p.frames, p.return_mean) for p in points if p.seed == seed] for seed in seeds]
    for curve in curves:
        axis.plot(*zip(*curve, strict=True), color=colour, alpha=0.4, linewidth=0.8)
    shortest = min(len(curve) for curve in curves)
    mean = np.mean([[value for _, value in curve[:shortest]] for curve in curves], axis=0)
    plural = "s" if len(seeds) > 1 else ""
    label = f"{name} ({len(seeds)} seed{plural})"
    axis.plot([frames for frames, _ in curves[0][:shortest]], mean, color=colour, linewidth=1.8, label=label)


def _finish(axis: Axes, title: str) -> None:
    axis.set(title=title, xlabel="frames (environment control steps)", ylabel="return")
    if axis.dataLim.y0 >= 0:  # most tasks' returns; some Gymnasium environments pay less than nothing
        axis.set_ylim(bottom=0)
    axis.ticklabel_format(axis="x", style="sci", scilimits=(3, 3), useMathText=True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=8)
