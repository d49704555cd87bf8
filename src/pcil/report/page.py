"""The report: tables, figures, and a self-contained HTML page."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from jinja2 import Environment

from pcil.errors import InputError, shown
from pcil.report import figures, tables
from pcil.report.load import Collection, write_rows

TITLE = "<title>pcil report"
"""The text that identifies a page as a report."""


def clear(out: Path) -> None:
    """Create the folder `out`, or remove the files of an earlier report; `InputError` if it holds anything else."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        old = out / "index.html"
        text = old.read_text(errors="replace")[:1000] if old.is_file() else None
        if any(out.iterdir()) and (text is None or (text and TITLE not in text)):  # a full disk leaves an empty page
            raise InputError(f"{out} holds something other than a report; give --out a new or empty folder.")
        for folder, kinds in (("figures", (".png", ".pdf")), ("tables", (".csv", ".md"))):
            for file in (out / folder).glob("*"):
                if file.suffix in kinds:
                    file.unlink()
        old.write_text(f"<!doctype html>{TITLE}</title>This report is not finished.")  # an interrupted report can be replaced
    except OSError as error:
        raise InputError(f"The folder {out} can't be written ({error.strerror}); give --out another one.") from error


def build(found: Collection, out: Path, films: Mapping[str, bytes]) -> Path:
    """Write `index.html`, `figures/` and `tables/` into `out`, and return the path of the page.

    `films` are animations (WebP) by title. The same input gives the same files.
    """
    (out / "tables").mkdir(parents=True, exist_ok=True)
    written = {name: table for name, make in tables.MAKERS.items() if (table := make(found)).rows}
    for name, table in written.items():
        tables.write(name, table, out / "tables")
    write_rows(out / "tables" / "evaluations.csv", found.rows)
    if found.transitions:
        write_rows(out / "tables" / "transitions.csv", found.transitions)
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"cell": tables.cell, "shown": lambda value: shown(str(value), 500)}
    page = environment.from_string(Path(__file__).with_name("page.html").read_text()).render(
        tasks=list(dict.fromkeys(row.task for row in found.rows)),
        methods=list(dict.fromkeys(row.method for row in found.rows)),
        found=found,
        last={row[:4]: row for row in found.rows},
        tables=[(name, *tables.title_and_caption(tables.MAKERS[name]), table) for name, table in written.items()],
        figures=draw(found, out / "figures"),
        films={title: _uri("webp", film) for title, film in films.items()},
    )
    (out / "index.html").write_text(page, encoding="utf-8")
    return out / "index.html"


def draw(found: Collection, folder: Path) -> dict[str, dict[str, str]]:
    """Write every figure to `folder`; return those of the page as data URIs, by heading and then by title."""
    rows, styles = found.rows, figures.assign_styles(found.rows)
    files = _file_names([row.task for row in (*rows, *found.transitions)])
    svg: dict[str, dict[str, str]] = {"Learning curves": {}}
    figures.grid(rows, folder / "curves", styles=styles)  # all tasks on one sheet, as papers print it
    for task in dict.fromkeys(row.task for row in rows):
        path = folder / f"curves-{files[task]}"
        svg["Learning curves"][task] = figures.grid([row for row in rows if row.task == task], path, styles=styles)
    if together := figures.aggregate(rows, folder / "aggregate", styles):
        svg["Learning curves"]["all tasks"] = together
    if any(row.correlation is not None for row in rows):
        svg["Reward health"] = {"all": figures.grid(rows, folder / "health", value="correlation", styles=styles)}
    if found.transitions:
        figures.scatter_grid(found.transitions, folder / "representation")
    for task in dict.fromkeys(row.task for row in found.transitions):
        path, mine = folder / f"representation-{files[task]}", [row for row in found.transitions if row.task == task]
        svg.setdefault("t-SNE", {})[task] = figures.scatter_grid(mine, path, columns=2)
    return {heading: {title: _uri("svg+xml", t.encode()) for title, t in drawn.items()} for heading, drawn in svg.items()}


def _file_names(tasks: Iterable[str]) -> dict[str, str]:
    """A unique part of a file name for each task."""
    names: dict[str, str] = {}
    for task in dict.fromkeys(tasks):
        name = re.sub(r"[^A-Za-z0-9_-]", "_", task)[:100]
        names[task] = f"{name}_{len(names)}" if name in names.values() else name
    return names


def _uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
