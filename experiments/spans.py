"""What learning looked like over spans of the runs of one method and task: python experiments/spans.py RUN ...

Each cell is the range over the runs of the mean over a span's episodes, as `train.jsonl` has them; a blank is what no run has.
"""

import itertools
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
    "positives on top": "reward/accuracy",
    "contrastive loss": "reward/contrast_loss",
    "gradient penalty, unweighted": "reward/penalty",
}


def main(*folders: str) -> None:
    """One row a quantity, one column a span."""
    logs = [[json.loads(line) for line in (Path(folder) / "train.jsonl").read_text().splitlines()] for folder in folders]
    for episode in itertools.chain(*logs):
        episode["correlation"] = episode.get("correlation") or None  # older logs have 0 where a reward does not vary
    print("| frames |" + "".join(f" {low}k to {high}k |" for low, high in SPANS) + f"\n|{'---|' * (len(SPANS) + 1)}")
    for words, name in ROWS.items():
        cells = []
        for low, high in SPANS:
            spans = ([e[name] for e in log if low < e["frames"] / 1000 <= high and e.get(name) is not None] for log in logs)
            means = [float(np.mean(span)) for span in spans if span]
            ends = dict.fromkeys(f"{end(means):.2f}" for end in (min, max)) if means else ()
            cells.append(f" {' to '.join(ends)} |")
        print(f"| {words} |{''.join(cells)}")


main(*sys.argv[1:])
