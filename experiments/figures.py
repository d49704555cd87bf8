"""Draw every figure of the docs from results/*.csv alone: python experiments/figures.py"""

from pathlib import Path

from pcil.report.figures import grid
from pcil.report.load import read_points

ROOT = Path(__file__).parent.parent

for table in sorted((ROOT / "results").glob("*.csv")):
    print(grid(read_points(table), ROOT / "docs" / "figures" / table.stem))
