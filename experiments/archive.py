"""Pack the results of this commit for a release: python experiments/archive.py [OUT.tar.gz]

The archive has the rows, tables, figures and pages of results, the experiments, the lock file, and two files of its own:
MANIFEST.json says the commit, versions, processor, commands, and the hash of each task's demonstrations, and SHA256SUMS has the
checksum of every file. Before it is written, tables and figures are made again from the rows and must equal the committed ones
byte for byte. The same commit gives the same archive on the same machine.
"""

from __future__ import annotations

import gzip
import hashlib
import io
import json
import platform
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

from pcil import __version__
from pcil.demos.inspect import shipped
from pcil.report.load import EvalRow, read_rows

ROOT = Path(__file__).parent.parent
PARTS = ("README.md", "LICENSE", "CITATION.cff", "CHANGELOG.md", "pyproject.toml", "uv.lock", "results", "experiments", "docs")
"""The files and folders that are packed."""
PACKAGES = ("jax", "jaxlib", "equinox", "optax", "numpy", "scipy", "gymnasium", "dm-control", "mujoco", "matplotlib")


def main(words: list[str]) -> int:
    """Check and pack the repository; exit code 2 with a sentence where it has uncommitted changes or stale results."""
    out = Path(words[0]) if words else ROOT / "dist" / f"pcil-results-{__version__}.tar.gz"
    try:
        if changed := _git(ROOT, "status", "--porcelain", *PARTS):
            raise ValueError(f"there are uncommitted changes ({changed.splitlines()[0].strip()}); commit them first")
        if stale := differences(ROOT):
            raise ValueError(f"{', '.join(stale)} differ from what the rows give; run python experiments/results.py")
        commit, seconds = _git(ROOT, "rev-parse", "HEAD"), int(_git(ROOT, "log", "-1", "--format=%ct"))
        pack(ROOT, out, manifest(ROOT, commit), seconds)
    except (ValueError, OSError, subprocess.CalledProcessError) as error:
        print(f"No archive is written: {error}.", file=sys.stderr)
        return 2
    print(f"Archive: {out}, {out.stat().st_size / 1e6:.1f} MB, SHA-256 {hashlib.sha256(out.read_bytes()).hexdigest()}")
    return 0


def differences(root: Path) -> list[str]:
    """The pages and figures that differ from those that `results.py` makes from the rows, in a copy."""
    with tempfile.TemporaryDirectory() as place:
        for part in PARTS:
            if (root / part).is_dir():
                shutil.copytree(root / part, Path(place) / part)
            elif (root / part).exists():
                shutil.copy(root / part, Path(place) / part)
        subprocess.run([sys.executable, f"{place}/experiments/results.py"], check=True, capture_output=True)
        return [name for name, file in files(root) if file.read_bytes() != (Path(place) / name).read_bytes()]


def files(root: Path) -> Iterator[tuple[str, Path]]:
    """Every file that is packed, by its name in the archive, in alphabetical order."""
    for part in sorted(PARTS):
        for file in sorted([root / part, *(root / part).rglob("*")]):
            if file.is_file() and "__pycache__" not in file.parts:
                yield file.relative_to(root).as_posix(), file


def manifest(root: Path, commit: str) -> dict[str, Any]:
    """What the results were made of, and with which commands."""
    found = {}
    for file in sorted((root / "results").rglob("*.csv")):
        rows = read_rows(file)
        commits = {row.commit for row in rows if isinstance(row, EvalRow) and row.commit}
        found[file.relative_to(root).as_posix()] = {
            "rows": len(rows),
            "runs": len({row[:4] for row in rows}),
            "commits": sorted(commits),
        }
    pages = [root / "docs" / "results.md", *sorted((root / "docs" / "results").glob("*.md"))]
    commands = re.findall(r"^    ((?:pcil|python) .+)$", "\n".join(page.read_text() for page in pages), re.MULTILINE)
    return {
        "version": __version__,
        "commit": commit,
        "python": platform.python_version(),
        "packages": {name: metadata.version(name) for name in PACKAGES},
        "processor": _processor(),
        "demonstrations": {row["task"]: row["hash"] for row in shipped()},
        "results": found,
        "commands": list(dict.fromkeys(commands)),
    }


def pack(root: Path, out: Path, about: dict[str, Any], seconds: int) -> None:
    """Write the archive; all its files have the time `seconds`."""
    contents = {name: file.read_bytes() for name, file in files(root)}
    contents["MANIFEST.json"] = (json.dumps(about, indent=1) + "\n").encode()
    sums = "".join(f"{hashlib.sha256(content).hexdigest()}  {name}\n" for name, content in contents.items())
    contents["SHA256SUMS"] = sums.encode()
    out.parent.mkdir(parents=True, exist_ok=True)
    top = out.name.removesuffix(".tar.gz")
    with (
        out.open("wb") as raw,
        gzip.GzipFile("", "wb", fileobj=raw, mtime=seconds) as packed,
        tarfile.open(None, "w", packed) as tar,
    ):
        for name, content in contents.items():
            entry = tarfile.TarInfo(f"{top}/{name}")
            entry.size, entry.mtime = len(content), seconds
            tar.addfile(entry, io.BytesIO(content))


def _git(root: Path, *words: str) -> str:
    return subprocess.run(["git", "-C", str(root), *words], check=True, capture_output=True, text=True).stdout.strip()


def _processor() -> str:
    """The model of the processor, as Linux names it."""
    table = Path("/proc/cpuinfo")
    found = re.search(r"^model name\s*: (.+)$", table.read_text(), re.MULTILINE) if table.exists() else None
    return found[1] if found else platform.processor() or platform.machine()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
