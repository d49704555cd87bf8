"""A damaged run, whatever its files contain, gives a note on the page and the terminal; the others are reported as usual."""

from __future__ import annotations

import csv
import json
import math
import os
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest

from fake_runs import fake_run, fake_sweep
from pcil import cli
from pcil.report import figures, load, page, tables

OTHERS: list[Any] = [None, True, "x", "", "3", -1, 1.5, 10**60, -(10**299), math.nan, math.inf, 1e300, [], [1], {}, {"a": 1}]
"""Unexpected values."""


def told(folder: Path, *names: str, value: Any) -> None:
    """Replaces a value in `run.json`."""
    about = table = json.loads((folder / "run.json").read_text())
    for name in names[:-1]:
        table = table[name]
    table[names[-1]] = value
    (folder / "run.json").write_text(json.dumps(about))


def without(name: str) -> Callable[[Path], None]:
    """Removes a column of `eval.csv`."""

    def damage(folder: Path) -> None:
        with (folder / "eval.csv").open() as file:
            rows = list(csv.DictReader(file))
        kept = [column for column in rows[0] if column != name]
        lines = [",".join(kept), *(",".join(row[column] for column in kept) for row in rows)]
        (folder / "eval.csv").write_text("\n".join(lines) + "\n")

    return damage


def row(text: str, name: str = "eval.csv") -> Callable[[Path], None]:
    """Adds a line to a file."""

    def damage(folder: Path) -> None:
        with (folder / name).open("a") as file:
            file.write(f"{text}\n")

    return damage


def instead(content: bytes, name: str = "eval.csv") -> Callable[[Path], Any]:
    """Replaces the file."""
    return lambda folder: (folder / name).write_bytes(content)


def pipe(name: str) -> Callable[[Path], None]:
    """Replaces the file by a pipe to which nothing is written."""

    def damage(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        os.mkfifo(folder / name)

    return damage


DAMAGES: dict[str, Callable[[Path], Any]] = {
    **{f"return {value}": row(f"3000,0,{value},500,9.9") for value in ("nan", "inf", "-inf", "1e300", "x", "", "1,2")},
    **{f"frames {value}": row(f"{value},0,1.0,500,9.9") for value in ("nan", "inf", "-5", "1e300", "1e16", "3000.5", "0", "x")},
    "seconds": row("3000,0,1.0,500,nan"),
    **{f"no {name}": without(name) for name in ("frames", "return", "seconds")},
    "short line": row("3000,0"),
    "long field": row("3000,0," + "1" * 200_000 + ",500,9.9"),
    "many digits": row("9" * 5000 + ",0,1.0,500,9.9"),
    **{f"eval.csv {text[:4]!r}": instead(text) for text in (b"", b"\n", b"\xff\xfe", b"\x00" * 99, b'"' + b"x" * 200_000)},
    **{f"log {text[:20]}": row(text, "train.jsonl") for text in (
        '{"frames": 1500, "correlation": NaN}',
        '{"frames": 1500, "correlation": Infinity}',
        '{"frames": 1500, "correlation": "high"}',
        '{"frames": 1500, "correlation": [0.5]}',
        '{"frames": 1500, "correlation": %s}' % ("9" * 200),
        '{"frames": "x", "correlation": 0.5}',
        '{"correlation": 0.5}',
        '{"frames": 1500, "corr',
        '"correlation"',
        '["correlation"]',
        "7",
        "[" * 100_000,
    )},
    **{f"pipe {name}": pipe(name) for name in ("run.json", "eval.csv", "train.jsonl")},
    "many dollars": lambda folder: told(folder, "run", "task", value="x$" * 3000),
    "surrogate": lambda folder: told(folder, "run", "task", value="lone \ud800"),
    "method of lines": lambda folder: told(folder, "run", "method", value="a\nb"),
    "preset of escapes": lambda folder: told(folder, "run", "preset", value="\x1b[31mred"),
    "deep": instead(b'{"run": ' + b"[" * 900 + b"]" * 900 + b"}", "run.json"),
    "deep setting": lambda folder: told(folder, "run", "odd", value=json.loads("[" * 300 + "]" * 300)),
    "run.json x": instead(b"x", "run.json"),
}  # fmt: skip
WRONG = {
    ("run",): OTHERS,
    ("demos",): [value for value in OTHERS if value not in (None, {}, {"a": 1})],
    ("commit",): [value for value in OTHERS if value is not None and not isinstance(value, str)],
    ("run", "task"): [value for value in OTHERS if not isinstance(value, str) or not value],
    ("run", "method"): [value for value in OTHERS if not isinstance(value, str) or not value],
    ("run", "preset"): [value for value in OTHERS if not isinstance(value, str) or not value],
    ("run", "seed"): OTHERS,
    ("run", "frames"): [value for value in OTHERS if value not in (None, -1, 10**60, -(10**299))],
    ("demos", "return_mean"): [value for value in OTHERS if value not in (None, -1, 1.5)],
}
DAMAGES |= {
    f"{'.'.join(names)} = {str(value)[:9]!r}": lambda folder, names=names, value=value: told(folder, *names, value=value)
    for names, values in WRONG.items()
    for value in values
}
HOSTILE = [
    "=1+1</style></title><script>alert(1)</script><img src=x onerror=alert(1)>",
    "$\\frac{$ \" onerror=alert(1) x=\"' onmouseover='x {{7*7}} {% raw %} a|b`c*d[e](f) &lt; 行",
]
"""Names that are accepted, shown literally, and have no effect."""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fake_sweep(tmp_path_factory.mktemp("runs"))


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_run_is_a_note_and_the_others_stay(damage: str, runs: Path, tmp_path: Path) -> None:
    bad = fake_run(tmp_path / "bad", [0.0, 1.0, 2.0], seed=9, correlation=[0.5, 0.5])
    whole = load.collect([runs])
    assert len(load.collect([bad]).rows) == 3
    DAMAGES[damage](bad)
    found = load.collect([bad, runs])
    (note,) = found.notes
    assert note.startswith(f"left out: {bad}, ") and note.isprintable() and len(note) < 1200
    assert found._replace(notes=[]) == whole


def test_the_page_and_the_terminal_say_what_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    """All damaged runs at once, and an invalid file of results."""
    good = fake_run(Path("runs") / "good", [0.0, 1.0, 2.0], method="dac")
    for i, damage in enumerate(DAMAGES.values()):
        damage(fake_run(Path("runs") / f"bad-{i}", [0.0, 1.0], correlation=[0.5]))
    (Path("runs") / "rows.csv").write_text("task,method\nx,y\n")
    assert cli.main(["report", "runs", "runs/rows.csv", "--out", "out", "--no-rollouts"]) == 0
    *notes, last = capsys.readouterr().out.splitlines()
    assert last == "Report: out/index.html" and len(notes) == len(DAMAGES) + 1
    words = Page(Path("out/index.html").read_text()).words
    assert [note for note in notes if not (note.startswith("left out: runs/") and note in words)] == []
    assert load.read_rows(Path("out/tables/evaluations.csv")) == load.read_run(good)
    assert {path.name for path in Path("out/figures").glob("*.png")} == {"curves.png", "curves-walker_run.png", "aggregate.png"}


def test_half_a_line_takes_its_evaluation_with_it(tmp_path: Path) -> None:
    run = fake_run(tmp_path / "run", [1.0, 2.0, 3.0])
    text = (run / "eval.csv").read_text()
    last, half = (len(line) for line in text.splitlines(keepends=True)[-2:])
    for lost in range(1, last + half):
        (run / "eval.csv").write_text(text[:-lost])
        found = load.collect([run])
        if lost == half:  # a complete line is missing, which can't be noticed
            assert len(found.rows) == 3 and found.notes == []
        else:
            assert [row.return_mean for row in found.rows] == [1.0, 2.0]
            assert found.notes == [f"left out: {run}, the end of eval.csv, whose last line is half written"]


def test_settings_of_every_kind_are_shown(tmp_path: Path) -> None:
    """Nested, long and odd values of settings that a report only shows."""
    value = ["\ud800", "$x", "<b>", "x" * 9000, [[[1.5]]], None, {"a": "\x1b[31m"}]
    fake_run(tmp_path / "a", [1.0], odd=value)
    fake_run(tmp_path / "b", [1.0], odd=value[::-1])
    found = load.collect([tmp_path])
    assert len({row.variant for row in found.rows}) == 2
    text = page.build(found, tmp_path / "out", {}).read_text()
    assert "<b>" not in text and "\x1b" not in text and len(text) < 1e6
    assert load.collect([tmp_path / "out" / "tables" / "evaluations.csv"]).rows == found.rows


class Page(HTMLParser):
    """The tags, attributes and text of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags, self.attributes, self.words, self.scripts = set[str](), set[str](), "", 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        self.scripts += tag == "script"
        self.attributes |= {name for name, _ in attrs}

    def handle_data(self, data: str) -> None:
        self.words += data


def test_names_are_shown_as_they_are_and_do_nothing(tmp_path: Path) -> None:
    """As task, method, preset, setting, commit and folder: the page has the same elements as with plain names."""
    transitions = tmp_path / "transitions.csv"
    for side, names in (("plain", ["plain"] * len(HOSTILE)), ("odd", HOSTILE)):
        for i, name in enumerate(names):
            folder = fake_run(
                tmp_path / side / str(i) / name.replace("/", "_"), [1.0, 2.0], f"{name}{i}", f"{name}{i}", odd=name
            )
            told(folder, "commit", value=name)
            told(folder, "run", "preset", value=name)
        rows = load.collect([tmp_path / side]).rows
        load.write_rows(
            transitions, [load.TransitionRow(*rows[0][:5], reward, 0.1, 0.2, 0.3, 0.4) for reward in (None, 1.0, 2.0)]
        )
        page.build(load.collect([tmp_path / side, transitions]), tmp_path / f"{side}-out", {f"{rows[0].task} film": b""})
    plain, odd = (Page((tmp_path / f"{side}-out" / "index.html").read_text()) for side in ("plain", "odd"))
    assert (odd.tags, odd.attributes) == (plain.tags, plain.attributes) and odd.scripts == plain.scripts == 3
    assert all(f"{name}{i}" in odd.words for i, name in enumerate(HOSTILE))
    assert len(list((tmp_path / "odd-out" / "figures").glob("curves-*.png"))) == len(HOSTILE)


def test_tasks_of_like_and_long_names_have_files_of_their_own() -> None:
    tasks = ["a/b", "a_b", "x" * 1000, "x" * 999 + "y", "a/b"]
    rows = [load.EvalRow(task, "pcil", "default", 1, 0, 0.0, 0.0, 0.0, None, "") for task in tasks]
    found = list(figures._by_task(load.Collection(rows, [], {}, []), rows))
    names = {task: name for task, name, _ in found}
    assert [[row.task for row in mine] for *_, mine in found] == [["a/b"] * 2, *([task] for task in tasks[1:4])]
    assert len(names) == len(set(names.values())) == 4
    assert all(re.fullmatch(r"[\w-]{1,110}", name) for name in names.values()) and names["a/b"] == "a_b"


@pytest.mark.parametrize("text", [*HOSTILE, "+1", "-x", "@x", "\tx", "'=x", "''=x", "'x", "x=1", "''", "", "-"])
def test_text_of_a_csv_is_no_formula_and_comes_back(text: str, tmp_path: Path) -> None:
    table = tables.Table((text, "n"), [(text, -3.2), (text, -4)])
    tables.write("finals", table, tmp_path)
    with (tmp_path / "finals.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert not re.match(r"[=+\-@\t\r]", header[0]) and header[0] == rows[0][0]
    assert [cell for _, cell in rows] == ["-3.2", "-4"], "numbers stay numbers"
    assert load._PARSERS[str](header[0]) == text


def test_a_markdown_table_holds_no_markup() -> None:
    table = tables.Table(("a|b", "c"), [("`x` <b> *y* [z](u) \\ $e$ &lt; ~~s~~\nnew", -3.2)])
    header, _, line = tables.markdown(table).splitlines()
    assert header == r"| a\|b | c |"
    assert line == r"| \`x\` \<b> \*y\* \[z](u) \\ \$e\$ \&lt; \~\~s\~\~\\nnew | -3.20 |"
