"""Starting JAX: fatal problems are one sentence, others one line, and commands that need no device start none."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

TRAIN = ["train", "toy/point_mass-v0", "--method", "expert", "--out", "run"]
START = "from pcil import compilation; compilation.start(); print('started')"


def run(words: list[str], tmp_path: Path, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a process in which a plugin of JAX fails, as CUDA's does without a GPU."""
    plugin = tmp_path / "site" / "jax_plugins" / "failing"
    plugin.mkdir(parents=True)
    (plugin / "__init__.py").write_text("def initialize():\n    raise RuntimeError('no device\\nwas found')\n")
    site = os.pathsep.join([str(plugin.parent.parent), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, *words]
    environment = {"JAX_PLATFORMS": "", **os.environ, "PYTHONPATH": site, **environment}
    return subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)


@pytest.mark.parametrize("platforms", ["cuda", "foo", "cpu,foo"])
def test_platforms_that_are_not_here_are_one_sentence(platforms: str, tmp_path: Path) -> None:
    result = run(["-m", "pcil", *TRAIN], tmp_path, JAX_PLATFORMS=platforms)
    assert (result.returncode, result.stdout, result.stderr.count("\n")) == (2, "", 1)
    assert result.stderr.startswith(f"pcil: JAX can't start with JAX_PLATFORMS={platforms} (no device was found")
    assert "set it to cpu" in result.stderr and not (tmp_path / "run").exists()


@pytest.mark.parametrize(("platforms", "lines"), [("", 1), ("cpu", 0)])
def test_a_plugin_that_fails_is_one_line_and_where_it_is_not_asked_for_none(platforms: str, lines: int, tmp_path: Path) -> None:
    result = run(["-c", START], tmp_path, JAX_PLATFORMS=platforms)
    assert (result.returncode, result.stdout) == (0, "started\n")
    assert (
        result.stderr.count("\n")
        == lines
        == result.stderr.count("does not work here (no device was found); JAX computes on cpu")
    )


@pytest.mark.parametrize("words", [["--help"], ["demos", "--json"], ["train", "--help"]])
def test_commands_that_compute_nothing_start_no_device(words: list[str], tmp_path: Path) -> None:
    result = run(["-m", "pcil", *words], tmp_path, JAX_PLATFORMS="foo")
    assert (result.returncode, result.stderr) == (0, "")
