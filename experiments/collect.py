"""Collect the evaluations of finished runs, at any depth, in a CSV file: python experiments/collect.py FILE.csv FOLDER ...

Rows of other runs that are already in the file are kept.
"""

import json
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from pcil.cli import exit_code
from pcil.errors import InputError
from pcil.files import flat
from pcil.report.load import read_rows, read_run, sort_key, write_rows
from pcil.report.variants import NO_VARIANT
from pcil.training import presets
from pcil.training.config import renamed


def main(*words: str) -> None:
    """Replace or add the rows of the runs."""
    if len(words) < 2:
        raise InputError("Give the CSV file, and one or more folders with runs.")
    target, *folders = words
    rows = [row for folder in finished(folders) for row in read_run(folder, variant(described(folder)["run"]))]
    new = {row[:4] for row in rows}
    kept = [row for row in read_rows(Path(target)) if row[:4] not in new] if Path(target).exists() else []
    write_rows(Path(target), sorted(kept + rows, key=sort_key))


def finished(folders: Iterable[str]) -> list[Path]:
    """The folders of finished runs, at any depth."""
    return sorted({done.parent for top in folders for done in Path(top).rglob("DONE")})


def described(folder: Path) -> dict[str, Any]:
    """A run's `run.json`, with the settings in `run` by their present names."""
    about = json.loads((folder / "run.json").read_text())
    return about | {"run": renamed(about["run"])}


def variant(run: dict[str, Any]) -> str:
    """The preset of a run, and all settings that differ from it."""
    now, before = flat(run), flat(presets.make(run["task"], run["method"], run["preset"]).to_json())
    unnamed = {*NO_VARIANT, "frames", "agent.absorbing"}  # the last was decided when the run began
    if before.get("agent.cloning", False) is None and (now["agent.cloning"] or now["demos"] is None):
        unnamed.add("agent.cloning")  # decided too
    differing = (name for name in now if now[name] != before.get(name) and name not in unnamed)
    return ", ".join([run["preset"], *(f"{name}={now[name]}" for name in differing)])


if __name__ == "__main__":
    sys.exit(exit_code(lambda: main(*sys.argv[1:])))
