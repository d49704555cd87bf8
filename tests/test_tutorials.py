"""The tutorials, block by block."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from pcil import cli

PAGE = Path(__file__).parent.parent / "docs" / "tutorials" / "own-data.md"
SMALL = (
    "--agent.hidden 16 --reward.hidden 16 --agent.batch-size 32 --reward.batch-size 32 --seed-frames 100 --random-frames 100"
)
SMALLER = [*SMALL.split(), "--evaluate-episodes", "2", "--cloning-updates", "20"]
"""Settings that make a run take seconds; its frames are a tenth of the page's."""


BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```$|^    (python \w+\.py)$", re.MULTILINE | re.DOTALL)


def test_the_tutorial_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Files are written, and commands given, in the order of the page; it ends with the robot near its target."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "arm", raising=False)
    said = ""
    for kind, text, script in BLOCK.findall(PAGE.read_text()):
        if kind == "python":
            Path(text.split()[1]).write_text(text)
        elif script:
            done = subprocess.run([sys.executable, script.split()[1]], capture_output=True, text=True, check=True)
            said += done.stdout
        for command in text.splitlines() if kind == "sh" else []:
            words = shlex.split(re.sub(r"000\b", "00", command))[1:]
            assert cli.main([*words, *(SMALLER if words[0] == "train" else [])]) == 0, command
            said += capsys.readouterr().out
    assert "Read 10 episodes, 990 steps, from CSV." in said and "the last action of 10 episodes" in said
    assert "Time step: 0.05 s." in said and "The demonstrations fit arm:Arm-v0." in said
    assert "had finished at 600 frames, and goes on" in said and "Resuming at 600 of 1,000 frames." in said
    assert said.splitlines()[-1].startswith("angles [") and (tmp_path / "arm.onnx").exists()
