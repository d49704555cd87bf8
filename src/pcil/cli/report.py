"""`pcil report`: collect runs, analyse their representations, and write a page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.console import Console
from rich.progress import track

from pcil.cli import arguments
from pcil.errors import InputError, shown
from pcil.files import expanded, room_for
from pcil.modules import Trust


def report(
    paths: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="DIR ...", help_behavior_hint="")],
    /,
    out: Path,
    rollouts: bool = True,
    trust: Trust = (),
) -> int:
    """Draw figures, tables and a page from runs.

    Args:
        paths: Run folders, folders that contain some at any depth, or files like results/*.csv.
        out: The report's folder, with index.html, figures and tables.
        rollouts: Run an episode with the networks of each run, for their representations and an animation of each method.
        trust: Modules that the runs' files may name and whose code is then run, such as my.module.
    """
    try:
        from pcil.report import load, page
    except ImportError as error:
        raise InputError(f"A report needs {error.name}, which pip install '.[report]' in a clone brings.") from error
    found = load.collect([expanded(path) for path in paths], _with_defaults)
    with room_for(f"The report in {out}"):
        page.clear(out := expanded(out))
        films: dict[str, bytes] = {}
        if rollouts and found.sources:
            from pcil.report import film, representation

            representation.add(found, trust, _track)
            films = film.films(found, trust, _track)
        print("\n".join(map(shown, [*found.notes, f"Report: {page.build(found, out, films)}"])))
    return 0


def _track(items: Sequence[Any], name: str) -> Iterable[Any]:
    """Go through the items with a progress bar on standard error, if that is a terminal."""
    console = Console(stderr=True)
    return track(items, name, console=console, transient=True, disable=not console.is_terminal)


def _with_defaults(settings: dict[str, Any]) -> dict[str, Any]:
    """`pcil.report.representation:with_defaults`, imported late: it loads JAX, which reports of result files do not need."""
    from pcil.report.representation import with_defaults

    return with_defaults(settings)


def main(argv: list[str]) -> int:
    return arguments.call("report", report, argv)
