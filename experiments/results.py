"""Draw the figures and fill the tables of the docs from results/*.csv and what ships: python experiments/results.py [--check]

With --check nothing is written; exit code 1 where a table is stale.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from pcil.demos import shipped
from pcil.report.figures import grid
from pcil.report.load import Point, read_points

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", ROOT / "docs" / "results.md")


def main(words: list[str]) -> int:
    """Every table, and the figures too unless only a check is asked for."""
    tables = {"demos": demos_table(), "pcil": finals_table(read_points(ROOT / "results" / "pcil-200k.csv"))}
    stale = 0
    for page in PAGES:
        text = page.read_text()
        fresh = text
        for name, table in tables.items():
            fresh = re.sub(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", rf"\g<1>{table}\g<2>", fresh, flags=re.DOTALL)
        stale += fresh != text
        if "--check" not in words:
            page.write_text(fresh)
    if "--check" in words:
        return int(stale > 0)
    for table in sorted((ROOT / "results").glob("*.csv")):
        print(grid(read_points(table), ROOT / "docs" / "figures" / table.stem).relative_to(ROOT))
    return 0


def demos_table() -> str:
    """What ships: `pcil demos` in Markdown."""
    lines = ["| task | observation | action | episodes | return | expert |", "|---|---|---|---|---|---|"]
    for row in shipped():
        returns = f"{row['return_mean']:.1f} +- {row['return_std']:.1f}"
        sizes = f"{row['observation_dim']} | {row['action_dim']} | {row['episodes']}"
        lines.append(f"| {row['task']} | {sizes} | {returns} | {row['expert']} |")
    return "\n".join([*lines, ""])


def finals_table(points: list[Point]) -> str:
    """The last evaluation of each seed, and their mean beside the demonstrations' return."""
    lines = ["| task | demonstrations | seed: final return | mean | of the expert |", "|---|---|---|---|---|"]
    for task in dict.fromkeys(point.task for point in points):
        last = {point.seed: point for point in points if point.task == task}  # rows are in the order of time
        finals = [point.return_mean for point in last.values()]
        expert = next(point.expert_return for point in last.values())
        mean = sum(finals) / len(finals)
        seeds = ", ".join(f"{seed}: {point.return_mean:.1f}" for seed, point in last.items())
        share = f"{mean / expert:.0%}" if expert else ""
        lines.append(f"| {task} | {expert:.1f} | {seeds} | {mean:.1f} | {share} |")
    return "\n".join([*lines, ""])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
