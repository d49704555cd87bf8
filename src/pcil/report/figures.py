"""Learning curves and pictures of representations, from rows of results alone; each as PNG and PDF."""

from __future__ import annotations

import functools
import io
import itertools
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence, Sized
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np

from pcil.errors import shown
from pcil.report import stats
from pcil.report.load import OFFLINE, EvalRow, TransitionRow, curves, label, matrix, read_run

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

matplotlib.rcParams["svg.hashsalt"] = "pcil"  # the same figure is the same file
LEGEND_ROW = 0.18
"""Inches that each further row of a legend adds to its figure."""
INK, GREY, BLUE = "#1b1b1b", "#808080", "#1f5fbf"
REWARD_COLOURS = LinearSegmentedColormap.from_list("reward", ["#0b3d1e", "#3f9b3a", "#ffe135"])
"""The paper's Figure 4: dark green for a low true reward, yellow for a high one."""


class Style(NamedTuple):
    """How a method looks on every figure; its marker and dashes are its own, for those who do not see its colour."""

    colour: str
    marker: str
    dashes: tuple[float, ...] = ()

    @property
    def line(self) -> dict[str, Any]:
        """Matplotlib's options of a line."""
        linestyle = (0, self.dashes) if self.dashes else "-"
        return {"color": self.colour, "linestyle": linestyle, "linewidth": 1.8, "marker": self.marker, "markersize": 5}


STYLES = {
    "pcil": Style("#a60628", "o"),  # colours of the first five and of the expert: the paper's legend, Figure 3
    "dac": Style("#348abd", "s", (6, 2)),
    "pwil": Style("#467821", "^", (6, 2, 1.5, 2)),
    "sil": Style("#d55e00", "D", (2, 1.5)),
    "bc": Style("#7a68a6", "v", (9, 3)),
    "potil": Style("#8c6d00", "P", (4, 1.5, 1, 1.5, 1, 1.5)),
    "tcn": Style("#00847e", "X", (4, 4)),
    "pcil-gail": Style("#d14d9b", "<", (8, 2, 2, 2)),
    "tcn-gail": Style("#5b4636", ">", (1, 2)),
    "expert": Style(GREY, "*", (3, 1, 1, 1)),
}
SPARE_STYLES = [
    Style(INK, "p"),
    Style("#0000c8", "h", (5, 2)),
    Style("#7f7f00", "d", (3, 2)),
    Style("#b000b0", "8", (7, 3, 1, 3)),
    Style("#006d77", "H", (1, 1)),
    Style("#b85c00", "x", (4, 1)),
    Style("#5a189a", "+", (8, 2)),
    Style("#2e7d32", "1", (2, 4)),
    Style("#c2185b", "2", (10, 2, 2, 2)),
    Style("#455a64", "3", (5, 1, 1, 1)),
    Style("#6d4c41", "4", (3, 3)),
    Style("#0077b6", "|", (6, 1, 1, 1, 1, 1)),
]
"""Methods that are not ours, in the order of their names; and variants of a method after its first."""


def escape_label(text: str) -> str:
    """A name as a figure shows it: short, and its dollar signs begin no formula."""
    return shown(text, 70).replace("$", "\\$")


def styles(rows: Iterable[EvalRow | TransitionRow]) -> dict[tuple[str, str], Style]:
    """A look for each method and variant: the method's own, and another one for each further variant of it."""
    found: dict[tuple[str, str], Style] = {}
    order, spare = {method: place for place, method in enumerate(STYLES)}, itertools.cycle(SPARE_STYLES)
    for method, variant in sorted({row[1:3] for row in rows}, key=lambda name: (order.get(name[0], len(order)), name)):
        own = method in STYLES and method not in {name for name, _ in found}
        found[method, variant] = STYLES[method] if own else next(spare)
    return found


def run_curve(folder: Path, expert_return: float | None) -> Path:
    """Draw one run's learning curve as `curve.png` in its folder, and return that path."""
    rows = read_run(folder)
    task, method, preset, seed = rows[0][:4]
    frames = [row.frames for row in rows]
    figure, axis = plt.subplots(figsize=(7, 4), layout="constrained")
    low, high = [row.return_low for row in rows], [row.return_high for row in rows]
    colour = STYLES.get(method, SPARE_STYLES[0]).colour
    axis.fill_between(frames, low, high, color=colour, alpha=0.18, linewidth=0, label="lowest to highest episode")
    axis.plot(frames, [row.return_mean for row in rows], color=colour, marker="o", markersize=3, label="mean")
    drawn = low + high
    if expert_return is not None:
        drawn.append(_expert_line(axis, expert_return))
    _label_axes(axis, escape_label(f"{task} - {method} ({preset}, seed {seed})"), "return", drawn)
    axis.legend(frameon=False, fontsize=8)
    path = folder / "curve.png"
    _write(figure, path, dpi=150)
    plt.close(figure)
    return path


def grid(
    rows: Sequence[EvalRow],
    path: Path,
    columns: int = 3,
    value: str = "return_mean",
    looks: dict[tuple[str, str], Style] | None = None,
) -> str:
    """A panel for each task: mean over seeds of each method with Student's 95% interval, every seed behind it, the expert.

    A method that takes no step in the environment is a level line at its last return. `value` is the column that is drawn;
    seeds and expert only for returns. PNG and PDF are written to `path`, SVG is returned.
    """
    looks = looks or styles(rows)
    rows = [row for row in rows if getattr(row, value) is not None]
    tasks = list(dict.fromkeys(row.task for row in rows))
    figure, axes = _axes(len(tasks), columns)
    for axis, task in zip(axes, tasks, strict=True):
        mine = curves(row for row in rows if row.task == task)
        drawn = [getattr(row, value) for runs in mine.values() for run in runs for row in run]
        for name in (name for name in looks if (task, *name) in mine):
            runs, look = mine[task, *name], (looks[name], escape_label(label(name, looks)))
            if name[0] in OFFLINE:
                _level_line(axis, matrix(runs, value)[1][:, -1].mean(), *look)
            else:
                _seed_lines(axis, runs, value, *look)
        if value == "return_mean":
            experts = {run[0].expert_return for runs in mine.values() for run in runs} - {None}
            drawn += [_expert_line(axis, expert) for expert in experts if expert is not None]
        ylabel = {"return_mean": "return", "correlation": "correlation with true reward"}[value]
        _label_axes(axis, f"{escape_label(task)}, {_count('seed', mine)}", ylabel, drawn)
    return save(figure, path)


def aggregate(rows: Sequence[EvalRow], path: Path, looks: dict[tuple[str, str], Style]) -> str:
    """Share of the expert's return over frames: IQM over all seeds of all tasks of a method, with its bootstrap interval.

    The legend says of how many tasks where methods have not the same number of them. Nothing is drawn, and "" returned, where
    no task's expert is known.
    """
    strata: dict[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]] = {}
    for name, runs in curves(rows).items():
        frames, returns = matrix(runs)
        if (share := stats.share_of_expert(runs, returns)) is not None:
            strata.setdefault(name[1:], []).append((frames, share))
    if not strata:
        return ""
    figure, (axis,) = _axes(1, 1)
    drawn = [1.0]
    for name in (name for name in looks if name in strata):
        tasks = strata[name]
        frames = functools.reduce(np.intersect1d, [own for own, _ in tasks])
        scores = [share[:, np.isin(own, frames)] for own, share in tasks]
        center, text = stats.iqm(*scores), escape_label(label(name, looks))
        if len({len(tasks) for tasks in strata.values()}) > 1:
            text += f" ({len(tasks)} task{'s' * (len(tasks) > 1)})"
        if name[0] in OFFLINE:
            _level_line(axis, center[-1], looks[name], text)
        else:
            _band_line(axis, frames, center, stats.bootstrap(stats.iqm, scores), looks[name], text)
        drawn += center.tolist()
    _expert_line(axis, 1.0)
    _label_axes(axis, _count("task", strata), "share of expert (IQM)", drawn)
    return save(figure, path)


def scatter_grid(transitions: Sequence[TransitionRow], path: Path, columns: int | None = None) -> str:
    """t-SNE of each method's representation: the first seed's transitions; by default a row a method and a column a task."""
    first: dict[tuple[str, ...], list[TransitionRow]] = {name: seeds[0] for name, seeds in curves(transitions).items()}
    tasks, methods = (list(dict.fromkeys(name[part] for name in first)) for part in (slice(1), slice(1, 3)))
    figure, axes = _axes(len(tasks) * len(methods), columns or len(tasks), (3.4, 3.2))
    for axis, name in zip(axes, ((*task, *method) for method in methods for task in tasks), strict=True):
        if name in first:
            drawn = [row for other, own in first.items() if other[0] == name[0] for row in own]
            rewards = [row.reward for row in drawn if row.reward is not None]
            _scatter(axis, first[name], min(rewards), max(rewards))
        else:
            axis.axis("off")
    return save(figure, path)


def save(figure: Figure, path: Path) -> str:
    """Write PNG and PDF without a date, close the figure, and return it as SVG; one legend for all panels stands below."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = {str(line.get_label()): line for axis in figure.axes for line in axis.lines}
    lines = {name: line for name, line in lines.items() if not name.startswith("_")}
    if lines:
        fitting = int(72 * figure.get_figwidth() / (4.6 * max(map(len, lines)) + 36))  # points of the words and of a line
        columns = max(min(fitting, len(lines)), 1)
        figure.set_figheight(figure.get_figheight() + LEGEND_ROW * (-(-len(lines) // columns) - 1))
        figure.legend(lines.values(), lines, loc="outside lower center", ncols=columns, frameon=False, fontsize=8)
    _write(figure, path.with_suffix(".png"), dpi=130)
    _write(figure, path.with_suffix(".pdf"), metadata={"CreationDate": None})
    text = io.StringIO()
    _write(figure, text, format="svg", metadata={"Date": None}, dpi=130)
    plt.close(figure)
    return re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text.getvalue())  # 0.01 pt is enough


def _write(figure: Figure, file: Path | io.StringIO, **options: Any) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # of a name in letters that the font lacks
        figure.savefig(file, **options)


def _axes(panels: int, columns: int, size: tuple[float, float] = (4.4, 3.2)) -> tuple[Figure, list[Axes]]:
    """A figure with so many panels; what is left of the last row is empty."""
    columns = min(columns, panels)
    rows = -(-panels // columns)
    figsize = size[0] * columns, size[1] * rows
    figure, axes = plt.subplots(rows, columns, figsize=figsize, layout="constrained", squeeze=False)
    for axis in axes.flat[panels:]:
        axis.axis("off")
    return figure, list(axes.flat)[:panels]


def _seed_lines(axis: Axes, runs: Sequence[Sequence[EvalRow]], value: str, style: Style, name: str) -> None:
    """Each seed's return as a thin line, and their mean with its interval at the frames that all of them have."""
    for run in runs if value == "return_mean" else ():
        axis.plot([p.frames for p in run], [getattr(p, value) for p in run], color=style.colour, alpha=0.35, linewidth=0.7)
    frames, values = matrix(runs, value)
    if len(frames):
        center, *bounds = np.array([stats.mean_interval(column) for column in values.T]).T
        _band_line(axis, frames, center, bounds, style, name)


def _level_line(axis: Axes, value: float, style: Style, label: str) -> None:
    """The line of a method that takes no step in the environment: one return at all frames."""
    axis.axhline(value, label=label, **style.line)


def _band_line(
    axis: Axes, frames: np.ndarray, center: np.ndarray, bounds: Sequence[np.ndarray] | np.ndarray, style: Style, label: str
) -> None:
    """A method's line with a few markers, and the band between the bounds where they are known."""
    if np.isfinite(bounds[0]).all():
        axis.fill_between(frames, bounds[0], bounds[1], color=style.colour, alpha=0.15, linewidth=0)
    axis.plot(frames, center, label=label, markevery=max(len(frames) // 6, 1), **style.line)


def _scatter(axis: Axes, rows: Sequence[TransitionRow], low: float, high: float) -> None:
    """The agent's transitions coloured by reward, from `low` to `high` on all panels of a task, and the expert's in blue."""
    expert, agent = ([row for row in rows if (row.reward is None) == of_expert] for of_expert in (True, False))
    colours: dict[str, Any] = {"c": [row.reward for row in agent], "cmap": REWARD_COLOURS, "vmin": low, "vmax": high}
    places = [row.x for row in agent], [row.y for row in agent]
    image = axis.scatter(*places, s=12, linewidths=0, rasterized=True, **colours)
    look: dict[str, Any] = {"color": BLUE, "marker": "^", "markersize": 3.5, "markeredgewidth": 0, "linestyle": ""}
    axis.plot([row.x for row in expert], [row.y for row in expert], label="expert", rasterized=True, **look)
    bar = axis.figure.colorbar(image, ax=axis, label="true reward of an agent step", shrink=0.8)
    assert bar.solids is not None
    bar.solids.set_rasterized(True)
    task, method, variant, seed, frames = rows[0][:5]
    title = f"{escape_label(f'{task}, {method}, {variant}')}\nseed {seed}, {frames:,} frames"
    axis.set(xticks=[], yticks=[])
    axis.set_title(title, fontsize=8)


def _expert_line(axis: Axes, value: float) -> float:
    """A line at what the expert has, with its number at the right end; returns the value."""
    axis.axhline(value, color=GREY, linestyle="--", linewidth=1, label="demos")
    where = {"xycoords": ("axes fraction", "data"), "xytext": (4, 0), "textcoords": "offset points"}
    axis.annotate(f"{value:.0f}", (1, value), fontsize=7, color=INK, va="center", **where)
    return value


def _count(word: str, groups: Mapping[Any, Sized]) -> str:
    """How many of something the groups have, such as "2 to 3 seeds"."""
    counts = sorted({len(group) for group in groups.values()})
    return f"{' to '.join(map(str, dict.fromkeys([counts[0], counts[-1]])))} {word}{'s' * (counts[-1] > 1)}"


def _label_axes(axis: Axes, title: str, ylabel: str, drawn: Sequence[float]) -> None:
    """Words, and limits that hold every value of `drawn`; a wide band may reach beyond them."""
    low, high = min(drawn), max(drawn)
    room = 0.08 * (high - low) or 1
    axis.set(title=title, xlabel="frames (environment control steps)", ylabel=ylabel)
    axis.set_ylim(0 if low >= 0 else low - room, high + room)  # most returns; some environments pay less than nothing
    axis.ticklabel_format(axis="x", style="sci", scilimits=(3, 3), useMathText=True)
    axis.spines[["top", "right"]].set_visible(False)
