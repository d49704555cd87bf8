"""The release archive: complete, reproducible, and refused where a page or a figure is not what the rows give."""

from __future__ import annotations

import hashlib
import importlib.util
import json
import shutil
import tarfile
from pathlib import Path
from typing import Any

import pytest

from pcil.demos import shipped_tasks

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def archive() -> Any:
    spec = importlib.util.spec_from_file_location("archive", ROOT / "experiments" / "archive.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A repository with one file of results."""
    root = tmp_path / "root"
    for part in ("README.md", "LICENSE", "CITATION.cff", "CHANGELOG.md", "pyproject.toml", "uv.lock"):
        (root / part).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / part, root / part)
    (root / "README.md").write_text("# A project\n")
    shutil.copytree(ROOT / "experiments", root / "experiments", ignore=shutil.ignore_patterns("__pycache__"))
    (root / "results").mkdir()
    shutil.copy(ROOT / "results" / "pcil-200k.csv", root / "results")
    (root / "docs" / "figures").mkdir(parents=True)
    (root / "docs" / "results.md").write_text(
        "# Results\n\n    pcil train walker_walk --out DIR\n\n<!-- finals:pcil-200k -->\nold\n<!-- /finals:pcil-200k -->\n"
    )
    return root


def test_the_same_commit_gives_the_same_whole_archive(archive: Any, small: Path, tmp_path: Path) -> None:
    about = archive.manifest(small, "0" * 40)
    for name in ("one", "two"):
        archive.pack(small, tmp_path / name / "results.tar.gz", about, 1_700_000_000)
    one, two = ((tmp_path / name / "results.tar.gz").read_bytes() for name in ("one", "two"))
    assert one == two
    with tarfile.open(tmp_path / "one" / "results.tar.gz") as tar:
        tar.extractall(tmp_path / "out", filter="data")
    top = tmp_path / "out" / "results"
    sums = dict(line.split("  ")[::-1] for line in (top / "SHA256SUMS").read_text().splitlines())
    packed = {file.relative_to(top).as_posix() for file in top.rglob("*") if file.is_file()}
    assert packed == {*sums, "SHA256SUMS"}
    assert all(hashlib.sha256((top / name).read_bytes()).hexdigest() == value for name, value in sums.items())
    assert (top / "results" / "pcil-200k.csv").read_bytes() == (small / "results" / "pcil-200k.csv").read_bytes()
    held = json.loads((top / "MANIFEST.json").read_text())
    assert held["commit"] == "0" * 40 and held["commands"] == ["pcil train walker_walk --out DIR"]
    assert held["results"]["results/pcil-200k.csv"]["runs"] == 6 and list(held["demonstrations"]) == shipped_tasks()


def test_what_the_rows_do_not_give_is_named(archive: Any, small: Path) -> None:
    """A stale table is; after `results.py` has been run nothing is; a changed row makes table and figure stale."""
    assert archive.differences(small) == ["docs/results.md"]
    archive.subprocess.run([archive.sys.executable, small / "experiments" / "results.py"], check=True, capture_output=True)
    assert archive.differences(small) == []
    rows = (small / "results" / "pcil-200k.csv").read_text()
    last = rows.splitlines()[-1].split(",")
    (small / "results" / "pcil-200k.csv").write_text(rows.replace(f",{last[5]},", ",1.0,"))
    assert archive.differences(small) == ["docs/figures/pcil-200k.pdf", "docs/figures/pcil-200k.png", "docs/results.md"]
