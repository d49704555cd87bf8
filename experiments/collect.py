"""Collect the evaluations of finished runs, at any depth, in a CSV file: python experiments/collect.py FILE.csv FOLDER ...

Rows of other runs that are already in the file are kept.
"""

import json
import sys
from pathlib import Path

from pcil.files import flat
from pcil.report.load import read_rows, read_run, sort_key, write_rows
from pcil.report.variants import NO_VARIANT
from pcil.training import presets
from pcil.training.config import renamed


def main(target: str, *folders: str) -> None:
    """The variant of a run is its preset and all settings that differ from it."""
    rows = []
    for folder in sorted({done.parent for top in folders for done in Path(top).rglob("DONE")}):
        run = renamed(json.loads((folder / "run.json").read_text())["run"])
        now, before = flat(run), flat(presets.make(run["task"], run["method"], run["preset"]).to_json())
        unnamed = {*NO_VARIANT, "frames", "agent.absorbing"}  # the last was decided when the run began
        if before.get("agent.cloning", False) is None and (now["agent.cloning"] or now["demos"] is None):
            unnamed.add("agent.cloning")  # decided too
        differing = (name for name in now if now[name] != before.get(name) and name not in unnamed)
        told = [f"{name}={now[name]}" for name in differing]
        rows += read_run(folder, ", ".join([run["preset"], *told]))
    new = {row[:4] for row in rows}
    kept = [row for row in read_rows(Path(target)) if row[:4] not in new] if Path(target).exists() else []
    write_rows(Path(target), sorted(kept + rows, key=sort_key))


main(*sys.argv[1:])
