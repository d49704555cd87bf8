"""The race's clock and table by hand, and one short race of our own."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pcil.report.load import Collection, EvalRow

EXPERIMENTS = Path(__file__).parent.parent / "experiments"


def loaded(path: Path) -> Any:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def request_file(tmp_path: Path) -> dict[str, Any]:
    np.savez(tmp_path / "demos.npz", obs_0=np.zeros((501, 3), np.float32), action_0=np.zeros((500, 1), np.float32))
    request = {"task": "pendulum_swingup", "seed": 1, "starts": [1, 2], "demos": str(tmp_path / "demos.npz")}
    return {**request, "minutes": 0.5, "competitor": "PCIL", "out": str(tmp_path / "run")}


def test_the_clock_stands_still_during_evaluations(
    request_file: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Marks at 15 and 30 seconds. Each of the two starts takes 100 seconds, which no row counts."""
    contest_module = loaded(EXPERIMENTS / "peers" / "contest.py")
    now = [0.0]
    monkeypatch.setattr(contest_module.time, "process_time", lambda: now[0])
    contest = contest_module.Contest(request_file)

    def play(act: Any, start: int) -> float:
        now[0] += 100
        return float(start)

    monkeypatch.setattr(contest, "_play", play)
    for step in range(1, 4):
        now[0] += 8
        contest.show(lambda obs: obs, step)
    now[0] += 8
    with pytest.raises(contest_module.Finished):
        contest.show(lambda obs: obs, 4)
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(row["seconds"], row["frames"], row["returns"]) for row in rows] == [(16, 2, [1, 2]), (32, 4, [1, 2])]


def test_the_table_says_the_return_after_so_many_minutes_and_leaves_out_what_was_not_run() -> None:
    race = loaded(EXPERIMENTS / "race.py")

    def row(name: str, seed: int, minutes: float, value: float) -> EvalRow:
        return EvalRow("walker_walk", name, "default", seed, int(1000 * minutes), value, value, value, 100.0, "c", 60 * minutes)

    rows = [row("PCIL", seed, *at) for seed in (1, 2) for at in ((0.5, 20.0), (1.05, 50.0 * seed), (2.0, 95.0), (3.4, 99.0))]
    rows += [row("SB3 SAC", 1, 1.0, 7.0), row("SB3 SAC", 1, 9.5, 30.0)]
    table = race.table(Collection(rows, [], {}, []))
    pcil, sac = ([None if value is None else value for value in line] for line in table.rows)
    assert pcil == ["walker_walk", "PCIL", "default", "demonstrations", 75.0, 95.0, None, None, (2.0 + 1.05) / 2, 3400]
    assert sac == ["walker_walk", "SB3 SAC", "default", "the task's reward", 7.0, 7.0, 30.0, None, None, 9500]


@pytest.mark.slow
def test_our_own_competitor_ends_when_its_time_is_over(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    race = loaded(EXPERIMENTS / "race.py")
    monkeypatch.setattr(race, "COSTS", tmp_path / "costs.json")
    rows = race.run("PCIL", "pendulum_swingup", 1, 0.6)
    assert [row.frames for row in rows[:2]] == [0, 5000] and all((row.seconds or 0) < 80 for row in rows)
    assert json.loads((tmp_path / "costs.json").read_text())["memory_mb"]["PCIL"] > 100
