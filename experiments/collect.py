"""Gather the evaluations of finished runs into one small CSV: python experiments/collect.py FILE.csv RUN[=VARIANT] ..."""

import sys
from pathlib import Path

from pcil.report.load import read_run, write_rows


def main(target: str, *runs: str) -> None:
    """Each `RUN` is a run folder; `VARIANT` names what was changed from its preset."""
    points = []
    for run in runs:
        folder, _, variant = run.partition("=")
        points += read_run(Path(folder), variant or None)
    write_rows(Path(target), points)


main(*sys.argv[1:])
