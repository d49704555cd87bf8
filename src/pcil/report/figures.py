"""Figures of a set of runs, written as PNG and PDF. The docstring of a maker is the heading and the caption of its figures."""

from __future__ import annotations

import io
import itertools
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np

from pcil.errors import shown
from pcil.report import stats
from pcil.report.load import OFFLINE, Collection, EvalRow, Row, TransitionRow, by_variant, label, matrix, read_run

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

matplotlib.rcParams["svg.hashsalt"] = "pcil"  # the same figure gives the same file
LEGEND_ROW = 0.18
"""Inches that each row of a legend after the first adds to its figure."""
INK, GREY, BLUE = "#1b1b1b", "#808080", "#1f5fbf"
REWARD_COLOURS = LinearSegmentedColormap.from_list("reward", ["#0b3d1e", "#3f9b3a", "#ffe135"])
"""As in the paper's Figure 4: dark green for a low true reward, yellow for a high one."""


class Style(NamedTuple):
    """The style of a method on every figure. Marker and dashes are unique too, for readers who cannot tell colours apart."""

    colour: str
    marker: str
    dashes: tuple[float, ...] = ()

    @property
    def line(self) -> dict[str, Any]:
        """Matplotlib's options of a line."""
        linestyle = (0, self.dashes) if self.dashes else "-"
        return {"color": self.colour, "linestyle": linestyle, "linewidth": 1.8, "marker": self.marker, "markersize": 5}


STYLES = {
    "pcil": Style("#a60628", "o"),  # the colours of the first five and of the expert are those of the paper's Figure 3
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
"""For methods without a style of their own, in alphabetical order, and for every variant of a method after the first."""


def escape_label(text: str) -> str:
    """A name as text of a figure: shortened, and with dollar signs escaped, which would begin a formula."""
    return shown(text, 70).replace("$", "\\$")


def assign_styles(rows: Iterable[EvalRow | TransitionRow]) -> dict[tuple[str, str], Style]:
    """A style for each method and variant: the first variant of a method has the method's own."""
    found: dict[tuple[str, str], Style] = {}
    order, spare = {method: place for place, method in enumerate(STYLES)}, itertools.cycle(SPARE_STYLES)
    for method, variant in sorted({row[1:3] for row in rows}, key=lambda name: (order.get(name[0], len(order)), name)):
        own = method in STYLES and method not in {name for name, _ in found}
        found[method, variant] = STYLES[method] if own else next(spare)
    return found


def learning_curves(found: Collection, together: stats.Shares, folder: Path) -> None:
    """Draw the mean over seeds with Student's 95% interval as a band, and each seed as a thin line: all tasks on one sheet,
    each on its own, and `together`, the interquartile means over each method's own tasks."""
    styles = assign_styles(found.rows)
    grid(found.rows, folder / "curves", styles=styles)
    for _, file, rows in _by_task(found, found.rows):
        grid(rows, folder / f"curves-{file}", styles=styles)
    aggregate(together, folder / "aggregate", styles)


def profiles(found: Collection, folder: Path) -> dict[str, str]:
    """Performance profiles: the share of runs whose final return is at least so large a part of the demonstrations' return.

    It is averaged over each method's own tasks, with a bootstrap interval as a band. A line that is higher everywhere is a
    better method.
    """
    styles, shares = assign_styles(found.rows), {}
    for name, runs in by_variant(found.rows).items():
        final = matrix(runs)[1][:, -1]
        if (share := stats.share_of_expert(runs, final)) is not None:
            shares.setdefault(name[1:], []).append(share)
    if not any(sum(map(len, own)) > 1 for own in shares.values()):
        return {}
    figure, (axis,) = _axes(1, 1, (6.0, 3.6))
    levels = np.linspace(0, 1.1, 111)
    for name in (name for name in styles if name in shares):
        _band_line(axis, stats.profile(shares[name], levels), styles[name], escape_label(label(name, styles)))
    axis.set(xlabel="share of the demonstrations' return", ylabel="share of runs", ylim=(-0.02, 1.02))
    axis.spines[["top", "right"]].set_visible(False)
    return {"all tasks": save(figure, folder / "profiles")}


def reward_health(found: Collection, folder: Path) -> dict[str, str]:
    """Reward health: correlation of the learned with the true reward over the steps of an episode.

    It is averaged between evaluations.
    """
    if all(row.correlation is None for row in found.rows):
        return {}
    return {"all": grid(found.rows, folder / "health", value="correlation")}


def t_sne(found: Collection, folder: Path) -> dict[str, str]:
    """t-SNE: 128 transitions of the expert (blue) and 256 of one episode of the agent.

    They are those of the first seed, the agent's coloured by their true reward.
    """
    if found.transitions:
        scatter_grid(found.transitions, folder / "representation")
    tasks = _by_task(found, found.transitions)
    return {task: scatter_grid(rows, folder / f"representation-{file}", columns=2) for task, file, rows in tasks}


FIGURES: list[Callable[[Collection, Path], dict[str, str]]] = [profiles, reward_health, t_sne]
"""What draws each kind of figure of a report's page into a folder, and returns its figures as SVG, by title."""


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
    styles: dict[tuple[str, str], Style] | None = None,
) -> str:
    """Draw a panel for each task: the mean over seeds of each method with Student's 95% interval, the seeds, and the expert.

    A method that takes no step in the environment is a horizontal line at its last return. `value` is the column to draw;
    seeds and expert are drawn only for returns. PNG and PDF are written to `path`, and SVG is returned.
    """
    styles = styles or assign_styles(rows)
    rows = [row for row in rows if getattr(row, value) is not None]
    tasks = list(dict.fromkeys(row.task for row in rows))
    figure, axes = _axes(len(tasks), columns)
    for axis, task in zip(axes, tasks, strict=True):
        groups = by_variant(row for row in rows if row.task == task)
        drawn = [getattr(row, value) for runs in groups.values() for run in runs for row in run]
        for name in (name for name in styles if (task, *name) in groups):
            runs, text = groups[task, *name], escape_label(label(name, styles))
            if name[0] in OFFLINE:
                axis.axhline(matrix(runs, value)[1][:, -1].mean(), label=text, **styles[name].line)
            else:
                _seed_lines(axis, runs, value, styles[name], text)
        if value == "return_mean":
            experts = {run[0].expert_return for runs in groups.values() for run in runs} - {None}
            drawn += [_expert_line(axis, expert) for expert in experts if expert is not None]
        ylabel = {"return_mean": "return", "correlation": "correlation with true reward"}[value]
        _label_axes(axis, f"{escape_label(task)}, {_counted([len(runs) for runs in groups.values()], 'seed')}", ylabel, drawn)
    return save(figure, path)


def aggregate(found: stats.Shares, path: Path, styles: dict[tuple[str, str], Style]) -> str:
    """Draw the share of the expert's return over frames: each method's IQM over seeds and tasks, with bootstrap intervals.

    If methods have different numbers of tasks, the legend states the number. If no task has a known expert, nothing is drawn
    and "" is returned.
    """
    if not found:
        return ""
    figure, (axis,) = _axes(1, 1)
    drawn = [1.0]
    counts = sorted({tasks for _, tasks in found.values()})
    for name in (name for name in styles if name in found):
        curve, tasks = found[name]
        text = escape_label(label(name, styles)) + (f" ({_counted([tasks], 'task')})" if len(counts) > 1 else "")
        if name[0] in OFFLINE:
            axis.axhline(curve.center[-1], label=text, **styles[name].line)
        else:
            _band_line(axis, curve, styles[name], text)
        drawn += curve.center.tolist()
    _expert_line(axis, 1.0)
    _label_axes(axis, _counted(counts, "task"), "share of expert (IQM)", drawn)
    return save(figure, path)


def scatter_grid(transitions: Sequence[TransitionRow], path: Path, columns: int | None = None) -> str:
    """Draw the t-SNE of each method's representation, first seed; by default a row is a method and a column a task."""
    first: dict[tuple[str, ...], list[TransitionRow]] = {name: seeds[0] for name, seeds in by_variant(transitions).items()}
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
    """Add a legend for all panels, write PNG and PDF without a date, close the figure, and return it as SVG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn = ((str(line.get_label()), line) for axis in figure.axes for line in axis.lines)
    lines = {name: line for name, line in drawn if not name.startswith("_")}  # Matplotlib's names of unlabelled lines
    if lines:
        fitting = int(72 * figure.get_figwidth() / (4.6 * max(map(len, lines)) + 36))  # points of an entry
        columns = max(min(fitting, len(lines)), 1)
        figure.set_figheight(figure.get_figheight() + LEGEND_ROW * (-(-len(lines) // columns) - 1))
        figure.legend(lines.values(), lines, loc="outside lower center", ncols=columns, frameon=False, fontsize=8)
    _write(figure, path.with_suffix(".png"), dpi=130)
    _write(figure, path.with_suffix(".pdf"), metadata={"CreationDate": None})
    text = io.StringIO()
    _write(figure, text, format="svg", metadata={"Date": None}, dpi=130)
    plt.close(figure)
    return re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text.getvalue())  # 0.01 pt is enough


def _by_task(found: Collection, rows: Sequence[Row]) -> Iterator[tuple[str, str, list[Row]]]:
    """Each task of the rows, a part of a file name that no other task has, and the rows of the task."""
    names: dict[str, str] = {}
    for task in dict.fromkeys(row.task for row in (*found.rows, *found.transitions)):
        name = re.sub(r"[^A-Za-z0-9_-]", "_", task)[:100]
        names[task] = f"{name}_{len(names)}" if name in names.values() else name
    for task in dict.fromkeys(row.task for row in rows):
        yield task, names[task], [row for row in rows if row.task == task]


def _write(figure: Figure, file: Path | io.StringIO, **options: Any) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph")  # a name may have letters that the font lacks
        figure.savefig(file, **options)


def _axes(panels: int, columns: int, size: tuple[float, float] = (4.4, 3.2)) -> tuple[Figure, list[Axes]]:
    """A figure with this number of panels; the rest of the last row stays empty."""
    columns = min(columns, panels)
    rows = -(-panels // columns)
    figsize = size[0] * columns, size[1] * rows
    figure, axes = plt.subplots(rows, columns, figsize=figsize, layout="constrained", squeeze=False)
    for axis in axes.flat[panels:]:
        axis.axis("off")
    return figure, list(axes.flat)[:panels]


def _seed_lines(axis: Axes, runs: Sequence[Sequence[EvalRow]], value: str, style: Style, name: str) -> None:
    """Draw each seed's return as a thin line, and their mean with its interval at the frames that all seeds have."""
    for run in runs if value == "return_mean" else ():
        axis.plot(
            [row.frames for row in run], [getattr(row, value) for row in run], color=style.colour, alpha=0.35, linewidth=0.7
        )
    if len((curve := stats.curve(runs, value)).frames):
        _band_line(axis, curve, style, name)


def _band_line(axis: Axes, curve: stats.Curve, style: Style, label: str) -> None:
    """Draw a method's line with a few markers, and the band between the bounds if they are known."""
    if np.isfinite(curve.low).all():
        axis.fill_between(curve.frames, curve.low, curve.high, color=style.colour, alpha=0.15, linewidth=0)
    axis.plot(curve.frames, curve.center, label=label, markevery=max(len(curve.frames) // 6, 1), **style.line)


def _scatter(axis: Axes, rows: Sequence[TransitionRow], low: float, high: float) -> None:
    """Draw the agent's transitions, coloured by reward on the scale `low` to `high`, and the expert's in blue."""
    expert, agent = ([row for row in rows if (row.reward is None) == of_expert] for of_expert in (True, False))
    colours: dict[str, Any] = {"c": [row.reward for row in agent], "cmap": REWARD_COLOURS, "vmin": low, "vmax": high}
    places = [row.x for row in agent], [row.y for row in agent]
    image = axis.scatter(*places, s=12, linewidths=0, rasterized=True, **colours)
    style: dict[str, Any] = {"color": BLUE, "marker": "^", "markersize": 3.5, "markeredgewidth": 0, "linestyle": ""}
    axis.plot([row.x for row in expert], [row.y for row in expert], label="expert", rasterized=True, **style)
    bar = axis.figure.colorbar(image, ax=axis, label="true reward of an agent step", shrink=0.8)
    assert bar.solids is not None
    bar.solids.set_rasterized(True)
    task, method, variant, seed, frames = rows[0][:5]
    title = f"{escape_label(f'{task}, {method}, {variant}')}\nseed {seed}, {frames:,} frames"
    axis.set(xticks=[], yticks=[])
    axis.set_title(title, fontsize=8)


def _expert_line(axis: Axes, value: float) -> float:
    """Draw a line at the expert's return, with the number at its right end; return the value."""
    axis.axhline(value, color=GREY, linestyle="--", linewidth=1, label="demos")
    where = {"xycoords": ("axes fraction", "data"), "xytext": (4, 0), "textcoords": "offset points"}
    axis.annotate(f"{value:.0f}", (1, value), fontsize=7, color=INK, va="center", **where)
    return value


def _counted(counts: Sequence[int], word: str) -> str:
    """The range of some counts, such as "2 to 3 seeds"."""
    ends = dict.fromkeys([min(counts), max(counts)])
    return f"{' to '.join(map(str, ends))} {word}{'s' * (max(counts) > 1)}"


def _label_axes(axis: Axes, title: str, ylabel: str, drawn: Sequence[float]) -> None:
    """Set title, labels and limits. The limits include every value of `drawn`; a wide band may extend beyond them."""
    low, high = min(drawn), max(drawn)
    margin = 0.08 * (high - low) or 1
    axis.set(title=title, xlabel="frames (environment control steps)", ylabel=ylabel)
    axis.set_ylim(0 if low >= 0 else low - margin, high + margin)  # returns can be negative in some environments
    axis.ticklabel_format(axis="x", style="sci", scilimits=(3, 3), useMathText=True)
    axis.spines[["top", "right"]].set_visible(False)
