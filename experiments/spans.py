"""Metrics of runs of one method and task over spans of frames: python experiments/spans.py RUN ...

Each cell is the range over the runs of the mean over the episodes of a span, from `train.jsonl`; it is blank if no run has any.
"""

import itertools
import json
import sys
from pathlib import Path

import numpy as np

from pcil.cli import exit_code

SPANS = ((5, 50), (50, 100), (100, 150), (150, 200))
"""Spans, in thousands of frames."""
ROWS = {
    "correlation of learned and true reward in an episode": "correlation",
    "similarity of positives": "reward/positive_similarity",
    "similarity of negatives": "reward/negative_similarity",
    "positives on top": "reward/accuracy",
    "contrastive loss": "reward/contrast_loss",
    "gradient penalty, unweighted": "reward/penalty",
}


def main(*folders: str) -> None:
    """Print a row for each quantity and a column for each span."""
    logs = [[json.loads(line) for line in (Path(folder) / "train.jsonl").read_text().splitlines()] for folder in folders]
    for episode in itertools.chain(*logs):
        episode["correlation"] = episode.get("correlation") or None  # older logs have 0 if a reward does not vary
    print("| frames |" + "".join(f" {low}k to {high}k |" for low, high in SPANS) + f"\n|{'---|' * (len(SPANS) + 1)}")
    for words, name in ROWS.items():
        cells = []
        for low, high in SPANS:
            spans = ([e[name] for e in log if low < e["frames"] / 1000 <= high and e.get(name) is not None] for log in logs)
            means = [float(np.mean(span)) for span in spans if span]
            ends = dict.fromkeys(f"{end(means):.2f}" for end in (min, max)) if means else ()
            cells.append(f" {' to '.join(ends)} |")
        print(f"| {words} |{''.join(cells)}")


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(*sys.argv[1:])))
