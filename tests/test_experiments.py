"""The scripts of experiments/ say in one sentence what is wrong with their arguments; the table of savings by hand."""

from __future__ import annotations

import math
import runpy
import sys
from pathlib import Path

import pytest

from pcil.report.load import Collection, EvalRow

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


def test_savings_are_ratios_of_the_minutes_at_which_runs_ended() -> None:
    """Of a return of 100, 90 are wanted twice in a row; the last run has them once, and so has not reached them."""

    def run(task: str, variant: str, returns: list[float], minutes: float) -> list[EvalRow]:
        ends = range(5000, 5000 * (len(returns) + 1), 5000)
        step = 60 * minutes / len(returns)
        return [
            EvalRow(task, "pcil", variant, 1, end, paid, paid, paid, 100.0, "", step * i)
            for i, (end, paid) in enumerate(zip(ends, returns, strict=True), start=1)
        ]

    rows = [
        *run("walker_walk", "default, evaluate_every=5000, until=0.9", [80.0, 95.0, 90.0], 2.0),
        *run("walker_walk", "reward-only, evaluate_every=5000, until=0.9", [0.0, 50.0, 91.0, 92.0], 4.0),
        *run("hopper_hop", "default, evaluate_every=5000, until=0.9", [95.0, 95.0], 1.0),
        *run("hopper_hop", "reward-only, evaluate_every=5000, until=0.9", [0.0, 20.0, 89.9, 95.0], 8.0),
    ]
    table = runpy.run_path(str(EXPERIMENTS / "cost.py"))["savings"](Collection(rows, [], {}, []))
    assert table.rows[:2] == [
        ("walker_walk", 15_000, "2.00", 20_000, "4.00", 0.5),
        ("hopper_hop", 10_000, "1.00", 20_000, "8.00, not reached", 0.125),
    ]
    assert math.isclose(table.rows[2][-1], 0.25)
