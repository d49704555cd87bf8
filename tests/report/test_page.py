"""The page of a report: complete, self-contained, reproducible, and correct in a browser."""

from __future__ import annotations

import base64
import io
import os
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fake_runs import fake_run, fake_sweep
from pcil.errors import InputError
from pcil.report import load, page
from pcil.report.load import Collection, TransitionRow

CHROMIUM = "/usr/bin/chromium"
FLAGS = "--no-sandbox --disable-gpu --no-first-run --disable-background-networking --disable-component-update --disable-sync"


def film(shade: int = 0) -> bytes:
    """An animation of two pictures."""
    pictures = [Image.fromarray(np.full((24, 32, 3), shade + i, np.uint8)) for i in (0, 99)]
    pictures[0].save(file := io.BytesIO(), "WEBP", save_all=True, append_images=pictures[1:])
    return file.getvalue()


def everything(folder: Path) -> Collection:
    """Two tasks, two methods, three seeds, a user's own method with an odd name, and transitions of all methods."""
    fake_sweep(folder)
    fake_run(folder / "own", [1.0, 2.0], "my_module:MyTask-v0", "<b>my.module:Mine</b>", expert=None, done=False)
    found = load.collect([folder])
    rng = np.random.default_rng(0)
    for task, method, variant, seed in sorted(found.sources, key=lambda name: (name[0], name[1] != "pcil", *name)):
        for reward in [None] * 8 + rng.random(16).tolist():
            found.transitions.append(TransitionRow(task, method, variant, seed, 2000, reward, *rng.random(4).tolist()))
    return found


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    found = everything(folder / "runs")
    found.notes.append("A run is left out & said so.")
    return page.build(found, folder / "out", {"walker_run, pcil, default, seed 1": film()})


class Page(HTMLParser):
    """The sources of all parts of a page, its visible text, and the elements that are not closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.sources: list[str] = []
        self.targets: list[str] = []
        self.ids: set[str] = set()
        self.tags: list[str] = []
        self.open: list[str] = []
        self.words = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.tags.append(tag)
        self.sources += [given["src"]] if "src" in given else []
        self.targets += [given["href"]] if "href" in given else []
        self.ids |= {given["id"]} if "id" in given else set()
        self.open += [tag] if tag not in ("meta", "link", "img", "input") else []

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words += data


def test_the_page_needs_nothing_but_itself(report: Path) -> None:
    """Images and scripts are embedded, links lead into the page or to its files; no address is opened; less than 5 MB."""
    text = report.read_text()
    seen = Page(text)
    assert seen.open == [] and seen.tags.count("script") == 3
    assert len(seen.sources) == 1 + 1 + 1 + 3 + 1, "curves without scripts, profiles, health, three t-SNE, a film"
    assert seen.sources[0] == "figures/curves.png" and (report.parent / seen.sources[0]).is_file()
    assert all(source.startswith("data:image/") for source in seen.sources[1:])
    for target in seen.targets:
        inside = target == "data:," or (target.startswith("#") and target[1:] in seen.ids)
        assert inside or (report.parent / target).is_file(), target
    text = text.replace("/*! https://github.com/leeoniya/uPlot (v1.6.32) */", "")
    assert not re.search(r"https?:|@import|url\(|fetch\(|XMLHttp|import\(", text) and len(text) < 5e6


def test_its_images_are_whole(report: Path) -> None:
    for source in Page(report.read_text()).sources[1:]:
        kind, data = re.fullmatch(r"data:image/([\w+]+);base64,(.*)", source).groups()
        image = base64.b64decode(data, validate=True)
        if kind == "webp":
            assert Image.open(io.BytesIO(image)).n_frames == 2
        else:
            assert kind == "svg+xml" and image.startswith(b"<?xml") and image.rstrip().endswith(b"</svg>")


def test_it_says_what_was_found(report: Path) -> None:
    words = Page(report.read_text()).words
    assert "13 runs: " in words and "A run is left out & said so." in words
    assert "<b>my.module:Mine</b>" in words, "a name is shown literally"
    first = [words.index(f"\n{title}\n") for title in ("Returns at a glance", "Learning curves", "Final return of each task")]
    assert first == sorted(first), "the answer comes first"
    for title in ("Final return of each task", "Comparison with the paper", "Sample efficiency", "Health of the learned"):
        assert title in words
    assert "200.0 [-48.4,\u00a0448.4]" in words and "agent.gamma: 0.99" in words and "commit: 0123456789abcdef" in words
    assert words.count("not finished") == 1


def test_figures_and_tables_lie_beside_it(report: Path) -> None:
    names = {"aggregate", "curves", "profiles", "health", "representation"}
    for task in ("hopper_stand", "walker_run", "my_module_MyTask-v0"):
        names |= {f"curves-{task}", f"representation-{task}"}
    files = {path.name for path in (report.parent / "figures").iterdir()}
    assert files == {f"{name}.{kind}" for name in names for kind in ("png", "pdf")}
    tables = {"overview", "aggregate", "finals", "paper", "efficiency", "improvement", "comparison", "health", "representation"}
    files = {path.name for path in (report.parent / "tables").iterdir()}
    assert files == {f"{name}.{kind}" for name in tables for kind in ("csv", "md")} | {"evaluations.csv", "transitions.csv"}


def test_its_rows_alone_make_the_same_report(report: Path, tmp_path: Path) -> None:
    """Everything except settings, film and notes is reproduced from the two files of rows, byte for byte."""
    rows = [report.parent / "tables" / name for name in ("evaluations.csv", "transitions.csv")]
    page.build(load.collect(rows), tmp_path, {})
    for path in (*report.parent.glob("tables/*"), *report.parent.glob("figures/*")):
        assert (tmp_path / path.relative_to(report.parent)).read_bytes() == path.read_bytes(), path.name
    again, first = (Page((folder / "index.html").read_text()) for folder in (tmp_path, report.parent))
    assert again.sources == [source for source in first.sources if "webp" not in source]
    assert "No animation" in again.words and "agent.gamma" not in again.words


def charts_can_be_looked_at_closely(window: Any) -> None:
    """Values under the pointer, a zoom that a double click ends, and a choice of methods and tasks."""
    chart = window.locator(".chart", has_text="walker_run").first
    chart.scroll_into_view_if_needed()
    plot = chart.locator(".u-over")
    box = plot.bounding_box()
    middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    window.mouse.move(*middle)
    legend = chart.locator(".u-legend").inner_text()
    assert re.search(r"pcil\s*[\d.]+ \[-?[\d.]+, [\d.]+\]", legend), legend
    ticks = "e => [...document.querySelectorAll('.chart')].map(c => c.querySelector('.uplot').clientWidth)"
    assert all(width > 100 for width in window.evaluate(ticks))

    scale = "charted.find(each => each.chart.title === 'walker_run').plot.scales.x"
    whole = window.evaluate(f"[{scale}.min, {scale}.max]")
    window.mouse.down()
    window.mouse.move(middle[0] + box["width"] / 4, middle[1], steps=5)
    window.mouse.up()
    low, high = window.evaluate(f"[{scale}.min, {scale}.max]")
    assert whole[0] < low < high < whole[1]
    window.mouse.dblclick(*middle)
    assert window.evaluate(f"[{scale}.min, {scale}.max]") == whole

    method, task = window.locator("fieldset.choices").all()
    shown = "charted.find(each => each.chart.title === 'walker_run').plot.series.filter(s => s.show).length"
    before = window.evaluate(shown)
    method.get_by_text("dac").click()
    assert window.evaluate(shown) == before - 3, "the line and the bounds of its band"
    method.get_by_text("dac").click()
    assert window.evaluate(shown) == before
    task.get_by_text("walker_run").click()
    assert not chart.is_visible()
    task.get_by_text("walker_run").click()
    assert chart.is_visible()


@pytest.mark.slow
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size", [(1280, 900), (390, 844)], ids=["desktop", "phone"])
def test_the_page_in_a_browser(size: tuple[int, int], scheme: Any, report: Path) -> None:
    """No error in the console, no request, nothing wider than the window; images load, and a click enlarges or closes one."""
    assert shutil.which(CHROMIUM), "this test needs a browser: apt-get install chromium"
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS.split())
        window = browser.new_page(viewport={"width": size[0], "height": size[1]}, color_scheme=scheme)
        said: list[str] = []
        asked: list[str] = []
        window.on("console", lambda message: said.append(message.text))
        window.on("pageerror", lambda error: said.append(str(error)))
        window.on("request", lambda request: asked.append(request.url))
        window.goto(report.as_uri())
        if folder := os.environ.get("PCIL_SCREENSHOTS"):
            window.screenshot(path=Path(folder) / f"page-{size[0]}-{scheme}.png", full_page=True)
        assert window.title().startswith("pcil report") and said == []
        assert {url for url in asked if not url.startswith("data:")} == {report.as_uri()}
        images = window.evaluate("[...document.images].map(i => [i.complete, i.naturalWidth, i.getBoundingClientRect().width])")
        assert len(images) == 6 and all(done and width > 0 and shown > 0 for done, width, shown in images)

        def overflow() -> list[str]:
            """Elements that extend beyond the window, except inside elements with their own scroll bars."""
            right = "e.getBoundingClientRect().right > document.documentElement.clientWidth + 1"
            elements = "[...document.querySelectorAll('body *')]"
            return window.evaluate(
                f"{elements}.filter(e => !e.closest('.scroll') && {right}).map(e => e.outerHTML.slice(0, 80))"
            )

        assert overflow() == []
        assert window.evaluate("document.documentElement.scrollWidth") <= size[0]
        for summary in window.locator("summary").all():
            summary.click()
        assert overflow() == [], "opened settings fit too"

        charts_can_be_looked_at_closely(window)
        picture = window.locator(".zoom img").first
        before = picture.bounding_box()
        picture.click()
        enlarged = picture.bounding_box()
        assert enlarged["width"] > 1.5 * before["width"] and enlarged["width"] >= 1000
        picture.click()
        assert picture.bounding_box()["width"] == before["width"]
        browser.close()


def test_a_report_replaces_a_report_and_nothing_else(tmp_path: Path) -> None:
    """Figures of an earlier report are removed; a page that is not ours is kept, and so are other files."""
    out = tmp_path / "out"
    for task in ("walker_run", "hopper_hop"):
        fake_run(tmp_path / task, [1.0, 2.0], task)
        page.clear(out)
        page.build(load.collect([tmp_path / task]), out, {})
        (out / "figures" / "mine.txt").write_text("mine")
    names = {path.name for path in (out / "figures").iterdir()}
    assert "mine.txt" in names and "curves-hopper_hop.png" in names and not any("walker_run" in name for name in names)
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "index.html").write_text("<title>mine</title>")
    with pytest.raises(InputError, match="something other than a report"):
        page.clear(tmp_path / "site")
    assert (tmp_path / "site" / "index.html").read_text() == "<title>mine</title>"
