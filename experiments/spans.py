"""What learning looked like over spans of the runs of one method and task: python experiments/spans.py RUN ...

Each cell is the range over the runs of the mean over a span's episodes, as `train.jsonl` has them; a blank is what no run has.
"""

import json
import sys
from pathlib import Path

import numpy as np

SPANS = ((5, 50), (50, 100), (100, 150), (150, 200))
"""Thousands of frames."""
ROWS = {
    "correlation of learned and true reward in an episode": "correlation",
    "similarity of positives": "reward/positive_similarity",
    "similarity of negatives": "reward/negative_similarity",
    "gradient penalty, unweighted": "reward/penalty",
}


def main(*folders: str) -> None:
    """One row a quantity, one column a span."""
    logs = [[json.loads(line) for line in (Path(folder) / "train.jsonl").read_text().splitlines()] for folder in folders]
    print("| frames |" + "".join(f" {low}k to {high}k |" for low, high in SPANS) + f"\n|{'---|' * (len(SPANS) + 1)}")
    for words, name in ROWS.items():
        cells = []
        for low, high in SPANS:
            spans = ([e[name] for e in log if low < e["frames"] / 1000 <= high and name in e] for log in logs)
            means = [float(np.mean(span)) for span in spans if span]
            cells.append(f" {min(means):.2f} to {max(means):.2f} |" if means else " |")
        print(f"| {words} |{''.join(cells)}")


main(*sys.argv[1:])
