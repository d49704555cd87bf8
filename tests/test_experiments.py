"""The scripts of experiments/ say in one sentence what is wrong with their arguments."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

EXPERIMENTS = Path(__file__).parent.parent / "experiments"
BAD = {
    "collect.py only.csv": "Give the CSV file, and one or more folders with runs",
    "collect.py rows.csv nowhere": "There are no rows to write to rows.csv",
    "cost.py": "Give the TOML file of a sweep",
    "cost.py sweep.toml two": "and then numbers of cores",
    "cost.py nosuch.toml 2": "nosuch.toml can't be read as TOML",
    "experts.py nosuch": "experts.toml has no nosuch",
    "spans.py nowhere": "nowhere/train.jsonl can't be read",
}


@pytest.mark.parametrize("words", BAD)
def test_bad_arguments_end_with_a_sentence(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    script, *arguments = words.split()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [script, *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(EXPERIMENTS / script), run_name="__main__")
    said = capsys.readouterr().err
    assert (ended.value.code, said.count("\n")) == (2, 1)
    assert BAD[words] in said
    assert not list(tmp_path.iterdir())
