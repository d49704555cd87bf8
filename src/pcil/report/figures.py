"""Learning curves, from files alone."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes

Curve = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Frames, mean, lowest and highest return, one number an evaluation."""

INK, GREY = "#1b1b1b", "#808080"
COLOURS = {
    "pcil": "#a60628",  # the paper's legend, appendix
    "dac": "#348abd",
    "pwil": "#467821",
    "sil": "#d55e00",
    "bc": "#7a68a6",
    "expert": GREY,
}


def read_curve(path: Path) -> Curve:
    """An `eval.csv`, one point for each evaluation: its mean, lowest and highest episode."""
    with path.open() as file:
        rows = [(int(row["frames"]), float(row["return"])) for row in csv.DictReader(file)]
    frames = np.array(sorted({frame for frame, _ in rows}))
    groups = [np.array([value for f, value in rows if f == frame]) for frame in frames]
    mean, low, high = (np.array([reduce(group) for group in groups]) for reduce in (np.mean, np.min, np.max))
    return frames, mean, low, high


def run_curve(folder: Path, expert_return: float | None) -> Path:
    """Draw one run's learning curve as `curve.png` in its folder, and return that path."""
    run = json.loads((folder / "run.json").read_text())["run"]
    frames, mean, low, high = read_curve(folder / "eval.csv")
    colour = COLOURS.get(run["method"], INK)
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    axes.fill_between(frames, low, high, color=colour, alpha=0.18, linewidth=0, label="lowest to highest episode")
    axes.plot(frames, mean, color=colour, marker="o", markersize=3, label="mean")
    if expert_return is not None:
        axes.axhline(expert_return, color=GREY, linestyle="--", linewidth=1, label=f"expert {expert_return:.0f}")
    _finish(axes, f"{run['task']} - {run['method']} ({run['preset']}, seed {run['seed']})")
    path = folder / "curve.png"
    figure.savefig(path, dpi=150)
    plt.close(figure)
    return path


def grid(panels: Sequence[tuple[str, dict[str, Sequence[Curve]], float | None]], path: Path, columns: int = 3) -> Path:
    """Small multiples: a panel `(title, curves by method, expert's return)` each, mean over seeds with every seed behind it."""
    rows = -(-len(panels) // columns)
    figure, axes = plt.subplots(rows, columns, figsize=(4 * columns, 2.9 * rows), layout="constrained", squeeze=False)
    for axis in axes.flat[len(panels) :]:
        axis.axis("off")
    for axis, (title, methods, expert_return) in zip(axes.flat, panels, strict=False):
        for method, curves in methods.items():
            _plot_seeds(axis, method, curves)
        if expert_return is not None:
            axis.axhline(expert_return, color=GREY, linestyle="--", linewidth=1, label="expert")
        _finish(axis, title)
    path.parent.mkdir(parents=True, exist_ok=True)
    for ending in (".png", ".pdf"):
        figure.savefig(path.with_suffix(ending), dpi=130, metadata={"CreationDate": None} if ending == ".pdf" else None)
    plt.close(figure)
    return path.with_suffix(".png")


def _plot_seeds(axis: Axes, method: str, curves: Sequence[Curve]) -> None:
    colour = COLOURS.get(method, INK)
    for frames, mean, _, _ in curves:
        axis.plot(frames, mean, color=colour, alpha=0.35, linewidth=0.8)
    shortest = min(len(frames) for frames, *_ in curves)
    middle = np.mean([mean[:shortest] for _, mean, _, _ in curves], axis=0)
    axis.plot(curves[0][0][:shortest], middle, color=colour, linewidth=1.8, label=f"{method} ({len(curves)} seeds)")


def _finish(axis: Axes, title: str) -> None:
    axis.set(title=title, xlabel="frames (environment control steps)", ylabel="return")
    axis.set_ylim(bottom=0)
    axis.ticklabel_format(axis="x", style="sci", scilimits=(3, 3), useMathText=True)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False, fontsize=8)
