"""Laws of what a run writes: every row is on disk at once, no digit is lost, and rewinding removes what came later."""

from __future__ import annotations

import csv
import json
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import hypothesis.extra.numpy as arrays
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pcil.evaluate import Evaluation
from pcil.metrics import EVAL_COLUMNS, WALL_CLOCK, MetricWriter, pearson
from pcil.report.load import read_evaluations

law = settings(deadline=None, derandomize=True, max_examples=20)
NAMES = ("eval.csv", "train.jsonl")


def make_evaluation(*returns: float) -> Evaluation:
    return Evaluation(np.array(returns), np.arange(len(returns)) + 10, 0.5)


@contextmanager
def writer(folder: Path, positions: dict[str, int] | None = None, frames: int = 0) -> Iterator[MetricWriter]:
    log = MetricWriter(folder, positions or {}, frames)
    try:
        yield log
    finally:
        log.close()


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in NAMES}


def test_an_evaluation_is_one_row_an_episode(tmp_path: Path) -> None:
    with writer(tmp_path) as log:
        log.evaluation(2000, 12.34, make_evaluation(1.5, -2.0))
        log.evaluation(4000, 56.78, make_evaluation(3.25))
    assert (tmp_path / "eval.csv").read_text() == (
        "frames,episode,return,length,seconds\n2000,0,1.5,10,12.3\n2000,1,-2.0,11,12.3\n4000,0,3.25,10,56.8\n"
    )
    assert EVAL_COLUMNS == ("frames", "episode", "return", "length", "seconds")
    assert set(WALL_CLOCK) & set(EVAL_COLUMNS) == {"seconds"}


def test_an_episode_is_one_line_of_json(tmp_path: Path) -> None:
    with writer(tmp_path) as log:
        log.episode(1000, {"return": 0.1 + 0.2, "length": 500, "reward/loss": 1e-30})
        log.episode(2000, {"return": float("nan"), "length": 500})
    lines = [json.loads(line) for line in (tmp_path / "train.jsonl").read_text().splitlines()]
    assert lines[0] == {"frames": 1000, "return": 0.1 + 0.2, "length": 500, "reward/loss": 1e-30}
    assert lines[1]["frames"] == 2000 and np.isnan(lines[1]["return"])


def test_every_row_is_on_disk_when_the_call_returns(tmp_path: Path) -> None:
    with writer(tmp_path) as log:
        assert contents(tmp_path)["eval.csv"] == b"frames,episode,return,length,seconds\n"
        log.evaluation(2000, 1.0, make_evaluation(7.0))
        log.episode(2000, {"return": 7.0})
        assert contents(tmp_path)["eval.csv"].endswith(b"2000,0,7.0,10,1.0\n")
        assert contents(tmp_path)["train.jsonl"] == b'{"frames": 2000, "return": 7.0}\n'
        assert log.positions() == {name: len(content) for name, content in contents(tmp_path).items()}


def test_tensorboard_gets_the_same_numbers(tmp_path: Path) -> None:
    with writer(tmp_path) as log:
        log.evaluation(2000, 1.0, make_evaluation(7.0, 8.0))
        log.episode(2000, {"return": 7.0, "reward/loss": 0.5, "note": "text", "bad": float("inf")})
    (events,) = (tmp_path / "tensorboard").glob("events.out.tfevents.*")
    content = events.read_bytes()
    for tag in (b"evaluation/return", b"episode/return", b"reward/loss"):
        assert tag in content
    assert b"note" not in content and b"bad" not in content
    assert np.float32(7.5).tobytes() in content


@law
@given(st.lists(st.floats(allow_nan=False), min_size=1, max_size=5))
def test_no_digit_of_a_return_is_lost(returns: list[float]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        with writer(Path(folder)) as log:
            log.evaluation(123_456_789, 1.0, make_evaluation(*returns))
        columns = read_evaluations(Path(folder))
    assert columns["return"].tolist() == returns
    assert columns["frames"].tolist() == [123_456_789] * len(returns)
    assert columns["episode"].tolist() == list(range(len(returns)))
    assert columns["length"].tolist() == [10 + i for i in range(len(returns))]


def test_the_columns_are_read_in_the_order_of_time(tmp_path: Path) -> None:
    with writer(tmp_path) as log:
        empty = read_evaluations(tmp_path)
        log.evaluation(0, 0.0, make_evaluation(1.0, 2.0))
        log.evaluation(20_000, 9.96, make_evaluation(3.0))
    columns = read_evaluations(tmp_path)
    assert tuple(columns) == tuple(empty) == EVAL_COLUMNS
    assert all(len(column) == 0 for column in empty.values())
    assert columns["frames"].tolist() == [0, 0, 20_000]
    assert columns["seconds"].tolist() == [0.0, 0.0, 10.0]


@pytest.mark.parametrize("kept", [0, 1, 3])
def test_rewinding_removes_exactly_what_came_later(tmp_path: Path, kept: int) -> None:
    """Three rounds are written; a second writer starts at the checkpoint after `kept` of them and goes on."""
    with writer(tmp_path) as log:
        positions, before = [log.positions()], [contents(tmp_path)]
        for k in range(3):
            log.evaluation(1000 * k, 1.0 * k, make_evaluation(k / 3, -k / 7))
            log.episode(1000 * k, {"return": k / 3})
            positions.append(log.positions())
            before.append(contents(tmp_path))
    with writer(tmp_path, positions[kept], 1000 * kept) as log:
        assert contents(tmp_path) == before[kept]
        assert log.positions() == positions[kept]
        for k in range(kept, 3):
            log.evaluation(1000 * k, 1.0 * k, make_evaluation(k / 3, -k / 7))
            log.episode(1000 * k, {"return": k / 3})
    assert contents(tmp_path) == before[3]


def test_a_torn_row_at_the_end_goes_with_the_rewinding(tmp_path: Path) -> None:
    with writer(tmp_path) as log:
        log.evaluation(0, 0.0, make_evaluation(1.0))
        positions, whole = log.positions(), contents(tmp_path)
    for name in NAMES:
        with (tmp_path / name).open("ab") as file:
            file.write(b'{"fra')
    with writer(tmp_path, positions, 1000):
        assert contents(tmp_path) == whole


@pytest.mark.parametrize("damage", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:5])], ids=["gone", "cut"])
def test_where_a_file_lost_its_rows_nothing_is_made_up_for_them(tmp_path: Path, damage: Callable) -> None:
    with writer(tmp_path) as log:
        log.evaluation(0, 0.0, make_evaluation(1.0))
        log.episode(0, {"return": 1.0})
        positions, before = log.positions(), contents(tmp_path)
    for name in NAMES:
        damage(tmp_path / name)
    left = {name: (tmp_path / name).read_bytes() if (tmp_path / name).exists() else b"" for name in NAMES}
    with writer(tmp_path, positions, 1000):
        header = b"frames,episode,return,length,seconds\n"
        assert contents(tmp_path) == {"eval.csv": left["eval.csv"] or header, "train.jsonl": left["train.jsonl"]}
    assert all(before[name].startswith(content) for name, content in contents(tmp_path).items())


def test_a_run_that_starts_anew_starts_with_empty_files_and_one_header(tmp_path: Path) -> None:
    for _ in range(2):
        with writer(tmp_path) as log:
            log.evaluation(0, 0.0, make_evaluation(1.0))
            log.episode(0, {"return": 1.0})
    assert len((tmp_path / "train.jsonl").read_text().splitlines()) == 1
    with (tmp_path / "eval.csv").open() as file:
        assert [tuple(row) for row in csv.reader(file)] == [EVAL_COLUMNS, ("0", "0", "1.0", "10", "0.0")]


# --- The correlation ---

series = arrays.arrays(np.float64, 6, elements=st.integers(-100, 100).map(float))


@law
@given(series, series)
def test_the_correlation_is_the_covariance_over_both_deviations(x: np.ndarray, y: np.ndarray) -> None:
    varies = len(set(x)) > 1 and len(set(y)) > 1
    covariance = sum(a * b for a, b in zip(x, y, strict=True)) / 6 - sum(x) / 6 * sum(y) / 6
    expected = pytest.approx(covariance / (np.std(x) * np.std(y)), abs=1e-9) if varies else None
    assert pearson(x, y) == expected


@pytest.mark.parametrize("constant", [0.0, 1.0, 0.1, 33.3, 1000.1])
@pytest.mark.parametrize("length", [7, 500, 501])
def test_what_does_not_vary_has_no_correlation(constant: float, length: int) -> None:
    """Also where the mean of equal float32 numbers is not that number."""
    flat, line = np.full(length, constant, np.float32), np.linspace(0.0, 1.0, length, dtype=np.float32)
    assert pearson(flat, line) is None
    assert pearson(line, flat) is None
    assert pearson(flat, 0.3 * flat + 5.7) is None
    assert pearson(line, 2 * line + 1) == pytest.approx(1)
    assert pearson(line, -line) == pytest.approx(-1)
