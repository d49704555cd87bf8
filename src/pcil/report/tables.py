"""Tables of a set of runs, as CSV, Markdown and HTML. The docstring of a maker is the title and the caption of its table."""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pcil.errors import shown
from pcil.report import stats
from pcil.report.embedding import measures
from pcil.report.load import OFFLINE, Collection, EvalRow, by_variant, label, matrix, write_csv
from pcil.report.stats import Interval

PAPER = {  # paper Table 1: final return over 3 seeds, mean and standard deviation
    "pcil": ((964.2, 24.2), (778.4, 14.1), (771.2, 142.1), (43.2, 20.1)),
    "tcn": ((975.2, 45.1), (180.5, 11.4), (2.0, 1.2), (6.8, 0.2)),
    "pcil-gail": ((2.5, 2.4), (18.5, 6.5), (1.2, 1.8), (0.1, 0.1)),
    "tcn-gail": ((35.4, 19.2), (19.8, 4.2), (1.5, 0.3), (17.3, 4.6)),
}
PAPER_TASKS = ("finger_spin", "walker_run", "hopper_stand", "hopper_hop")
PAPER_SEEDS = 3
SHARES = (0.5, 0.8, 0.9)
"""Shares of the expert's return for which sample efficiency is measured."""
KEY = ("task", "method", "variant")


class Table(NamedTuple):
    """A header and rows of text, numbers, `Interval`s and None; no rows if the table does not apply to the runs."""

    header: tuple[str, ...]
    rows: list[tuple[Any, ...]]


def finals(found: Collection) -> Table:
    """Final return of each task: mean over seeds at the last evaluation that all of them have, with Student's 95% interval.

    sd is the sample standard deviation. The interquartile mean (IQM) has a bootstrap interval. Of three seeds the IQM is the
    mean, and its bootstrap interval is too narrow.
    """
    rows = []
    for name, runs in by_variant(found.rows).items():
        frames, final = _final(runs)
        share = stats.share_of_expert(runs, final)
        deviation = float(np.std(final, ddof=1)) if len(final) > 1 else None
        expert = runs[0][-1].expert_return, None if share is None else float(share.mean())
        ours = stats.mean_interval(final), deviation, stats.interval(stats.iqm, [final])
        rows.append((*name, *ours, *expert, len(final), frames))
    return Table((*KEY, "mean", "sd", "IQM", "expert", "of expert", "seeds", "frames"), rows)


def overview(found: Collection) -> Table:
    """Returns at a glance: mean final return over seeds for each task, with its 95% interval, and the demonstrations' return.

    A blank cell was not run. Where a method has fewer frames on a task than another method, its cell states how many.
    """
    # the longer of the two axes runs down the page
    means, experts, lengths = {}, {}, {}
    for (task, *name), runs in by_variant(found.rows).items():
        frames, final = _final(runs)
        means[task, tuple(name)] = stats.mean_interval(final)
        lengths[task, tuple(name)] = 0 if name[0] in OFFLINE else frames
        experts[task] = experts.get(task) or runs[0][-1].expert_return
    for (task, name), frames in lengths.items():
        if 0 < frames < max(other for (where, _), other in lengths.items() if where == task):
            means[task, name] = f"{cell(means[task, name])} at {frames:,}"
    names = list(dict.fromkeys(name for _, name in sorted(means, key=lambda key: key[1][0] != "pcil")))
    columns: dict[str, list[Any]] = {"demonstrations": list(experts.values())}
    columns |= {label(name, names): [means.get((task, name)) for task in experts] for name in names}
    if len(names) > len(experts):
        return Table(("method", *experts), [(word, *values) for word, values in columns.items()])
    return Table(("task", *columns), list(zip(experts, *columns.values(), strict=True)))


def paper(found: Collection) -> Table:
    """Comparison with the paper: Table 1 of the paper has mean and standard deviation over 3 seeds after 2,000,000 frames.

    Both intervals are Student's. The paper does not say whether its standard deviation is that of a sample, which is assumed
    here, or of a population; in the latter case its interval is 1.22 times as wide. Our runs may have fewer frames.
    """
    rows = []
    for (task, method, variant), runs in by_variant(found.rows).items():
        if task in PAPER_TASKS and method in PAPER:
            frames, final = _final(runs)
            published = stats.student(*PAPER[method][PAPER_TASKS.index(task)], PAPER_SEEDS)
            ours = stats.mean_interval(final)
            overlap = {True: "yes", False: "no", None: None}[ours.overlaps(published)]
            difference = ours.value - published.value
            rows.append((task, method, variant, ours, published, difference, overlap, len(final), frames))
    return Table((*KEY, "ours", "paper", "difference", "intervals overlap", "seeds", "frames"), rows)


def aggregate(found: Collection) -> Table:
    """All tasks together: final return as a share of the demonstrations' return, over all seeds and tasks of a method.

    The area is that under the learning curve of this share, divided by the frames; a method that takes no step in the
    environment has none. The bootstrap intervals draw seeds within each task. Compare methods only if they have the same tasks
    and the same number of frames.
    """
    rows = []
    for name, tasks in _by_method(found.rows).items():
        curves = [(frames, stats.share_of_expert(runs, values)) for runs in tasks.values() for frames, values in [matrix(runs)]]
        known = [(frames, share) for frames, share in curves if share is not None]
        if not known:
            continue
        scores, areas = [share[:, -1] for _, share in known], [stats.area(*curve) for curve in known]
        mean, iqm = (stats.interval(statistic, scores) for statistic in (stats.mean_of_tasks, stats.iqm))
        area = stats.interval(stats.mean_of_tasks, areas)
        if name[0] in OFFLINE:
            area = stats.Interval(math.nan, math.nan, math.nan)
        rows.append((*name, mean, iqm, area, len(scores), sum(map(len, scores))))
    return Table(("method", "variant", "mean", "IQM", "area", "tasks", "runs"), rows)


def efficiency(found: Collection) -> Table:
    """Sample efficiency: the first evaluation at which a seed reaches 50, 80 and 90% of the demonstrations' return.

    The table has the median over all seeds, which is blank if half of them never reach the share, and the number of seeds that
    reach it within the frames of the last column. Minutes are wall-clock time since the start of the run; they equal
    core-minutes only if the run had a core to itself. Methods that take no step in the environment are left out.
    """
    rows = []
    for name, runs in by_variant(row for row in found.rows if row.method not in OFFLINE).items():
        cells: list[Any] = [*name]
        for reached in ([stats.first_reach(run, share) for run in runs] for share in SHARES):
            frames = np.median([row.frames if row else math.inf for row in reached])
            minutes = np.median([(row.seconds or math.nan) / 60 if row else math.inf for row in reached])
            cells += [int(frames) if np.isfinite(frames) else None, float(minutes) if np.isfinite(minutes) else None]
            cells.append(sum(row is not None for row in reached))
        if stats.share_of_expert(runs, np.zeros(len(runs))) is not None:
            rows.append((*cells, len(runs), _final(runs)[0]))
    columns = (f"{word} {share:.0%}" for share in SHARES for word in ("frames to", "minutes to", "seeds to"))
    return Table((*KEY, *columns, "seeds", "frames"), rows)


def improvement(found: Collection) -> Table:
    """Probability of improvement: the probability that a run of the first method has a higher return than one of the second.

    Runs are compared on the same task, at the last evaluation that both methods have (a method that takes no step in the
    environment, at its own last); a tie counts one half. The value is the mean over common tasks, with a bootstrap interval.
    """
    rows = []
    for (ours, x), (theirs, y) in itertools.combinations(_by_method(found.rows).items(), 2):
        both = (_at_the_same_frames(x[task], y[task]) for task in x if task in y)
        if pairs := [pair for pair in both if pair]:
            chance = stats.probability_of_improvement(*zip(*pairs, strict=True))
            rows.append((*ours, *theirs, chance, len(pairs)))
    return Table(("method", "variant", "over method", "over variant", "probability", "tasks"), rows)


def comparison(found: Collection) -> Table:
    """Comparisons by task: the difference of two methods' mean returns, with Welch's 95% interval.

    Holm's correction holds the chance of any false difference between two methods, over all of their common tasks, below the
    corrected p-value. Returns are those of the last evaluation that both methods have. Only tasks with at least two seeds of
    both are compared.
    """
    rows = []
    for (ours, x), (theirs, y) in itertools.combinations(_by_method(found.rows).items(), 2):
        tested = []
        for task in (task for task in x if task in y):
            if pair := _at_the_same_frames(x[task], y[task]):
                between, chance = stats.difference(*pair)
                if not math.isnan(chance):
                    tested.append((task, between, chance, f"{len(pair[0])} and {len(pair[1])}"))
        adjusted = stats.holm([chance for _, _, chance, _ in tested])
        for (task, between, chance, seeds), corrected in zip(tested, adjusted, strict=True):
            rows.append((task, *ours, *theirs, between, _p_value(chance), _p_value(corrected), seeds))
    columns = ("method", "variant", "over method", "over variant", "difference", "p", "p (Holm)", "seeds")
    return Table(("task", *columns), rows)


def _p_value(chance: float) -> str:
    return f"{chance:.2g}" if chance >= 1e-4 else "< 0.0001"


def health(found: Collection) -> Table:
    """Health of the learned reward: its correlation with the true reward over the steps of a training episode.

    Each value is the mean over the episodes of one half of the run in which both rewards vary, with Student's interval over
    seeds. The task's own reward has correlation 1.
    """
    rows = []
    for name, runs in by_variant(found.rows).items():
        frames, correlation = matrix(runs, "correlation")
        if len(frames) > 1:
            halves = np.array_split(correlation, 2, axis=1)
            rows.append((*name, *(stats.mean_interval(half.mean(axis=1)) for half in halves), len(runs)))
    return Table((*KEY, "first half", "second half", "seeds"), rows)


def representation(found: Collection) -> Table:
    """Representation: how well the distance to the experts predicts the true reward, and whether the experts form a cluster.

    Both are computed in the representation, not in its t-SNE. Spearman's rank correlation between an agent transition's
    distance to the experts' mean and its reward is -1 if the distance determines the order of the rewards. The experts' mean
    silhouette is near 1 if they form a cluster apart from the agent, and 0 or less if they are scattered among its transitions.
    """
    rows = []
    for name, seeds in by_variant(found.transitions).items():
        columns: list[Any] = []
        for values in zip(*map(measures, seeds), strict=True):
            each = ", ".join(f"{run[0].seed}: {value:.2f}" for run, value in zip(seeds, values, strict=True))
            columns += [stats.mean_interval(values), each]
        rows.append((*name, *columns))
    return Table((*KEY, "Spearman", "Spearman of each seed", "silhouette", "silhouette of each seed"), rows)


Maker = Callable[[Collection], Table]
MAKERS: dict[str, Maker] = {
    make.__name__: make
    for make in (overview, aggregate, finals, paper, efficiency, improvement, comparison, health, representation)
}


def title_and_caption(make: Callable[..., Any]) -> tuple[str, str]:
    """The title and the caption of what a maker of tables or figures makes."""
    title, _, caption = " ".join((make.__doc__ or "").split()).partition(": ")
    return title, caption[:1].upper() + caption[1:]


def cell(value: Any) -> str:
    """A cell as text: numbers from 10 on with one decimal, smaller ones with two."""
    if isinstance(value, Interval):
        return cell(value.value) + ("" if math.isnan(value.low) else f" [{cell(value.low)}, {cell(value.high)}]")
    if isinstance(value, float):
        return "" if math.isnan(value) else f"{value:.1f}" if abs(value) >= 9.995 else f"{value:.2f}"
    return f"{value:,}" if isinstance(value, int) else value or ""


def markdown(table: Table) -> str:
    """The table in Markdown, with a line break at its end; text is escaped, so that none of it is markup."""

    def escaped(value: Any) -> str:
        return re.sub(r"[\\`*<\[|&$~]", r"\\\g<0>", shown(value)) if isinstance(value, str) else cell(value)

    rows = [map(escaped, table.header), ["---"] * len(table.header), *(map(escaped, row) for row in table.rows)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def write(name: str, table: Table, folder: Path) -> None:
    """Write `<name>.md` with title and caption, and `<name>.csv`: an interval has three columns, an unknown number is empty."""
    title, caption = title_and_caption(MAKERS[name])
    (folder / f"{name}.md").write_text(f"# {title}\n\n{caption}\n\n{markdown(table)}", encoding="utf-8")
    first = zip(table.header, table.rows[0], strict=True)
    header = [[word, f"{word} low", f"{word} high"] if isinstance(value, Interval) else [word] for word, value in first]
    split = ([value if isinstance(value, Interval) else (value,) for value in row] for row in table.rows)
    lines = ([_rounded(value) for value in itertools.chain(*row)] for row in split)
    write_csv(folder / f"{name}.csv", [itertools.chain(*header), *lines])


def _rounded(value: Any) -> Any:
    if not isinstance(value, float):
        return value
    return None if math.isnan(value) else round(value, 6)


def _final(runs: Sequence[Sequence[EvalRow]]) -> tuple[int, np.ndarray]:
    """The number of frames of the last evaluation that every seed has, and the returns `[seeds]` there."""
    frames, returns = matrix(runs)
    return int(frames[-1]), returns[:, -1]


def _at_the_same_frames(x: list[list[EvalRow]], y: list[list[EvalRow]]) -> tuple[np.ndarray, np.ndarray] | None:
    """The returns `[seeds]` of two methods at the last evaluation that all their runs have; None if they have none in common.

    If one of the methods takes no step in the environment, each has its own last evaluation.
    """
    if {x[0][0].method, y[0][0].method} & set(OFFLINE):
        return _final(x)[1], _final(y)[1]
    if not len(matrix([*x, *y])[0]):
        return None
    last = _final([*x, *y])[1]
    return last[: len(x)], last[len(x) :]


def _by_method(rows: Sequence[EvalRow]) -> dict[Any, dict[str, list[list[EvalRow]]]]:
    """The rows of the seeds, by method and variant and then by task."""
    found: dict[Any, dict[str, list[list[EvalRow]]]] = {}
    for (task, *name), runs in by_variant(rows).items():
        found.setdefault(tuple(name), {})[task] = runs
    return found
