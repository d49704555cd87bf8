"""Run folders to rows and back."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pcil.errors import InputError
from pcil.report.load import Point, read_points, read_run, write_points


def make_run(folder: Path) -> Path:
    folder.mkdir()
    run = {"task": "walker_walk", "method": "pcil", "preset": "default", "seed": 3}
    about = {"run": run, "demos": {"return_mean": 947.456}, "commit": "abc+"}
    (folder / "run.json").write_text(json.dumps(about))
    rows = ["frames,episode,return,length,seconds", "0,0,1.0,500,0.1", "0,1,4.0,500,0.1", "20000,0,10.25,500,9.9"]
    (folder / "eval.csv").write_text("\n".join([*rows, "20000,1,10.75,500,9.9"]) + "\n")
    return folder


def test_each_evaluation_is_one_point(tmp_path: Path) -> None:
    points = read_run(make_run(tmp_path / "run"))
    assert points == [
        Point("walker_walk", "pcil", "default", 3, 0, 2.5, 1.0, 4.0, 947.46, "abc+"),
        Point("walker_walk", "pcil", "default", 3, 20000, 10.5, 10.25, 10.75, 947.46, "abc+"),
    ]


def test_points_survive_their_file(tmp_path: Path) -> None:
    points = [*read_run(make_run(tmp_path / "run"), "warm"), Point("t", "expert", "default", 1, 0, 0.0, 0.0, 0.0, None, "")]
    write_points(tmp_path / "results" / "x.csv", points)
    assert read_points(tmp_path / "results" / "x.csv") == points


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no run"):
        read_run(tmp_path)


def test_a_run_without_demonstrations_has_no_expert(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    about = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps(about | {"demos": None, "commit": None}))
    assert {(point.expert_return, point.commit) for point in read_run(folder)} == {(None, "")}


@pytest.mark.parametrize("text", ["{", "[]", "{}"])
def test_a_damaged_description_is_refused(text: str, tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    (folder / "run.json").write_text(text)
    with pytest.raises(InputError, match="holds no run"):
        read_run(folder)
