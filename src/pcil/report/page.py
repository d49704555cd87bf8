"""The report: tables, figures, and a self-contained HTML page."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path

from jinja2 import Environment

from pcil.errors import InputError, shown
from pcil.report import charts, figures, stats, tables
from pcil.report.load import Collection, write_rows

WEB = Path(__file__).with_name("web")
"""The template of the page, what it is drawn with, and the chart library uPlot."""
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
    together = stats.share_curves(found.rows)
    figures.learning_curves(found, together, out / "figures")
    drawn = {
        tables.title_and_caption(make): {title: _uri("svg+xml", svg.encode()) for title, svg in pictures.items()}
        for make in figures.FIGURES
        if (pictures := make(found, out / "figures"))
    }
    environment = Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"cell": tables.cell, "shown": lambda value: shown(str(value), 500)}
    page = environment.from_string((WEB / "page.html").read_text()).render(
        tasks=list(dict.fromkeys(row.task for row in found.rows)),
        methods=list(dict.fromkeys(row.method for row in found.rows)),
        found=found,
        last={row[:4]: row for row in found.rows},
        tables=[(name, *tables.title_and_caption(tables.MAKERS[name]), table) for name, table in written.items()],
        charts=charts.of(found, together),
        web={name: (WEB / name).read_text() for name in ("uplot.css", "uplot.js", "charts.js")},
        figures=drawn,
        films={title: _uri("webp", film) for title, film in films.items()},
    )
    (out / "index.html").write_text(page, encoding="utf-8")
    return out / "index.html"


def _uri(kind: str, data: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
