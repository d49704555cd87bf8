"""Draw the figures and fill the tables of the docs from results/*.csv and what ships: python experiments/results.py [--check]

With --check nothing is written; exit code 1 where a table is stale. A page asks for a table of a report by a pair of marks
such as `<!-- finals:pcil-200k -->` and `<!-- /finals:pcil-200k -->`: the table's name, and the file of results it is made of.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

from pcil.demos import shipped
from pcil.report import figures, stats, tables
from pcil.report.load import Collection, Dot, Point, read_points

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", ROOT / "docs" / "results.md")
MARKED = re.compile(r"(<!-- ([\w:-]+) -->\n).*?(<!-- /\2 -->)", re.DOTALL)


def main(words: list[str]) -> int:
    """Every table, and the figures too unless only a check is asked for."""
    own: dict[str, Callable[[], str]] = {"demos": demos_table, "pcil": lambda: finals_table(results("pcil-200k"))}

    def fresh(mark: re.Match[str]) -> str:
        name, _, file = mark[2].partition(":")
        return mark[1] + (tables.markdown(tables.MAKERS[name](results(file))) if file else own[name]()) + mark[3]

    stale = 0
    for page in PAGES:
        text = page.read_text()
        filled = MARKED.sub(fresh, text)
        stale += filled != text
        if "--check" not in words:
            page.write_text(filled)
    if "--check" in words:
        return int(stale > 0)
    for file in sorted((ROOT / "results").iterdir()):
        found, path = results(file.stem), ROOT / "docs" / "figures" / file.stem
        _ = figures.clouds(found.dots, path) if found.dots else figures.grid(found.points, path)
        print(path.relative_to(ROOT))
    return 0


@cache
def results(name: str) -> Collection:
    """The rows of `results/<name>.csv`, or of all files in `results/<name>/`."""
    files = sorted((ROOT / "results" / name).glob("*.csv")) or [ROOT / "results" / f"{name}.csv"]
    rows = [row for file in files for row in read_points(file)]
    return Collection([row for row in rows if isinstance(row, Point)], [row for row in rows if isinstance(row, Dot)], {}, [])


def demos_table() -> str:
    """What ships: `pcil demos` in Markdown."""
    lines = ["| task | observation | action | episodes | return | expert |", "|---|---|---|---|---|---|"]
    for row in shipped():
        returns = f"{row['return_mean']:.1f} +- {row['return_std']:.1f}"
        sizes = f"{row['observation_dim']} | {row['action_dim']} | {row['episodes']}"
        lines.append(f"| {row['task']} | {sizes} | {returns} | {row['expert']} |")
    return "\n".join([*lines, ""])


def finals_table(found: Collection) -> str:
    """The last evaluation of each seed, and their mean with Student's 95% interval beside the demonstrations' return."""
    lines = ["| task | demonstrations | seed: final return | mean [95% interval] | of the expert |", "|---|---|---|---|---|"]
    for task in dict.fromkeys(point.task for point in found.points):
        last = {point.seed: point for point in found.points if point.task == task}  # rows are in the order of time
        mean = stats.mean_interval([point.return_mean for point in last.values()])
        expert = next(point.expert_return for point in last.values())
        seeds = ", ".join(f"{seed}: {point.return_mean:.1f}" for seed, point in last.items())
        share = f"{mean.value / expert:.0%}" if expert else ""
        lines.append(f"| {task} | {expert:.1f} | {seeds} | {tables.cell(mean)} | {share} |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
