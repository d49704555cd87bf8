"""Draw the figures and fill the tables of the docs from the files of results: python experiments/results.py [--check]

With --check nothing is written, and the exit code is 1 if a table is stale. A page requests a table of a report by two marks
such as `<!-- finals:pcil-200k -->` and `<!-- /finals:pcil-200k -->`: the table's name, and the file that it is made from.
`<!-- demos -->` and `<!-- /demos -->` request the table of included demonstrations.
"""

from __future__ import annotations

import re
import sys
from functools import cache
from pathlib import Path

import cost
import race
import starts

from pcil.demos.inspect import shipped
from pcil.report import figures, tables
from pcil.report.load import Collection, EvalRow, TransitionRow, read_rows

ROOT = Path(__file__).parent.parent
PAGES = (ROOT / "README.md", ROOT / "docs" / "results.md", *sorted((ROOT / "docs" / "results").glob("*.md")))
MARKED = re.compile(r"(<!-- ([\w:-]+) -->\n).*?(<!-- /\2 -->)", re.DOTALL)


def main(words: list[str]) -> int:
    """Fill all tables, and draw the figures unless only a check is requested."""

    def fresh(mark: re.Match[str]) -> str:
        name, _, file = mark[2].partition(":")
        return mark[1] + (tables.markdown(MAKERS[name](results(file))) if file else PLAIN[name]()) + mark[3]

    stale = 0
    for page in PAGES:
        text = page.read_text()
        filled = MARKED.sub(fresh, text)
        stale += filled != text
        if "--check" not in words:
            page.write_text(filled)
    if "--check" in words:
        return int(stale > 0)
    for file in sorted(file for file in (ROOT / "results").iterdir() if file.suffix != ".json"):
        found, path = results(file.stem), ROOT / "docs" / "figures" / file.stem
        if file == race.ROWS:
            race.draw(found, path)
        else:
            _ = figures.scatter_grid(found.transitions, path) if found.transitions else figures.grid(found.rows, path)
        print(path.relative_to(ROOT))
    return 0


@cache
def results(name: str) -> Collection:
    """The rows of `results/<name>.csv`, or of all files in `results/<name>/`."""
    files = sorted((ROOT / "results" / name).glob("*.csv")) or [ROOT / "results" / f"{name}.csv"]
    rows = [row for file in files for row in read_rows(file)]
    return Collection(
        [row for row in rows if isinstance(row, EvalRow)], [row for row in rows if isinstance(row, TransitionRow)], {}, []
    )


def demos_table() -> str:
    """The included demonstrations: `pcil demos` in Markdown."""
    rows = []
    for row in shipped():
        returns = f"{row['return_mean']:.1f} +- {row['return_std']:.1f}"
        bounds = f"{row['return_min']:.1f}", f"{row['return_max']:.1f}"
        rows.append((row["task"], row["observation_dim"], row["action_dim"], row["episodes"], returns, *bounds, row["expert"]))
    header = ("task", "observation", "action", "episodes", "return", "minimum", "maximum", "expert")
    return tables.markdown(tables.Table(header, rows))


MAKERS = {**tables.MAKERS, "race": race.table, "savings": cost.savings}
PLAIN = {
    "demos": demos_table,
    "race-costs": lambda: tables.markdown(race.costs_table()),
    "starts": lambda: tables.markdown(starts.table()),
}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
