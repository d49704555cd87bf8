"""The representations of PCIL and DAC early, halfway and late in training (paper Figure 4):

    python experiments/representation.py [TASK ...]

Trains three seeds of each to the frames of STAGES in turn, and adds rows to results/representation.csv at each. Interrupted
runs resume, and stages whose rows are there are skipped.
"""

from __future__ import annotations

import sys
from pathlib import Path

from pcil import cli
from pcil.report import load, representation

FOLDER = Path("runs/representation")
ROWS = Path(__file__).parent.parent / "results" / "representation.csv"
TASKS, METHODS, SEEDS = ("finger_spin", "walker_walk"), ("pcil", "dac"), (1, 2, 3)
STAGES = {"early, 20k frames": 20_000, "halfway, 100k frames": 100_000, "late, 200k frames": 200_000}


def main(tasks: list[str]) -> None:
    """Train every run to every stage; rows are written after each."""
    for seed in SEEDS:
        for task in tasks or TASKS:
            for method in METHODS:
                for stage, frames in STAGES.items():
                    if (task, method, stage, seed) not in {row[:4] for row in rows()}:
                        add(task, method, seed, stage, frames)


def add(task: str, method: str, seed: int, stage: str, frames: int) -> None:
    """Train a run to a stage, and add what its networks say of expert and agent there."""
    out = FOLDER / task / method / str(seed)
    words = f"train {task} --method {method} --preset reward-only --seed {seed} --frames {frames} --out {out}".split()
    if code := cli.main(words):
        sys.exit(code)
    found = load.collect([out], representation.with_defaults)
    representation.add(found)
    made = [row._replace(variant=stage) for row in found.transitions]
    load.write_rows(ROWS, sorted([*rows(), *made], key=load.sort_key))


def rows() -> list[load.TransitionRow]:
    """The rows that are there."""
    held = load.read_rows(ROWS) if ROWS.exists() else []
    return [row for row in held if isinstance(row, load.TransitionRow)]


if __name__ == "__main__":
    sys.exit(cli.exit_code(lambda: main(sys.argv[1:])))
