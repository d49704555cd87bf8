"""The logs of a run: every row is on disk at once, no digit is lost, and rewinding removes exactly the later rows."""

from __future__ import annotations

import csv
import dataclasses
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

from pcil.report.load import read_evaluations
from pcil.training.callbacks import EVAL_COLUMNS, Callback, Callbacks, LogFiles
from pcil.training.evaluate import Evaluation
from pcil.training.loggers import TensorBoard
from pcil.training.metrics import pearson
from pcil.training.state import WALL_CLOCK
from small import small_run

law = settings(deadline=None, derandomize=True, max_examples=20)
NAMES = ("eval.csv", "train.jsonl")


def make_evaluation(*returns: float) -> Evaluation:
    return Evaluation(np.array(returns), np.arange(len(returns)) + 10, 0.5)


class Told(Callback):
    """Keeps the messages."""

    def __init__(self, said: list[str]) -> None:
        self.said = said

    def message(self, text: str) -> None:
        self.said.append(text)


class Writer(Callbacks):
    """The log files and TensorBoard, as a run has them."""

    def __init__(self, folder: Path, logs: dict[str, str], said: list[str]) -> None:
        folder.mkdir(exist_ok=True)
        self.files = LogFiles(folder, logs, Told(said))
        super().__init__([self.files, TensorBoard()])
        self.begin(small_run(), folder, self.files.history(0.0, None))
        self.logs, self.rows = self.files.contents, self.files.rows


@contextmanager
def writer(folder: Path, logs: dict[str, str] | None = None, said: list[str] | None = None) -> Iterator[Writer]:
    log = Writer(folder, logs or {}, [] if said is None else said)
    try:
        yield log
    finally:
        log.end()


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
        log.episode({"frames": 1000, "return": 0.1 + 0.2, "length": 500, "reward/loss": 1e-30})
        log.episode({"frames": 2000, "return": float("nan"), "length": 500})
    lines = [json.loads(line) for line in (tmp_path / "train.jsonl").read_text().splitlines()]
    assert lines[0] == {"frames": 1000, "return": 0.1 + 0.2, "length": 500, "reward/loss": 1e-30}
    assert lines[1]["frames"] == 2000 and np.isnan(lines[1]["return"])


def test_every_row_is_on_disk_when_the_call_returns(tmp_path: Path) -> None:
    with writer(tmp_path) as log:
        assert contents(tmp_path)["eval.csv"] == b"frames,episode,return,length,seconds\n"
        log.evaluation(2000, 1.0, make_evaluation(7.0))
        log.episode({"frames": 2000, "return": 7.0})
        assert contents(tmp_path)["eval.csv"].endswith(b"2000,0,7.0,10,1.0\n")
        assert contents(tmp_path)["train.jsonl"] == b'{"frames": 2000, "return": 7.0}\n'
        assert log.logs() == {name: content.decode() for name, content in contents(tmp_path).items()}


def test_tensorboard_gets_the_same_numbers(tmp_path: Path) -> None:
    with writer(tmp_path) as log:
        log.evaluation(2000, 1.0, make_evaluation(7.0, 8.0))
        log.episode({"frames": 2000, "return": 7.0, "reward/loss": 0.5, "note": "text", "bad": float("inf")})
    (events,) = (tmp_path / "tensorboard").glob("events.out.tfevents.*")
    content = events.read_bytes()
    for tag in (b"evaluation/return", b"episode/return", b"reward/loss"):
        assert tag in content
    assert b"note" not in content and b"bad" not in content
    assert np.float32(7.5).tobytes() in content


def test_success_is_the_last_column_where_the_environment_reports_it(tmp_path: Path) -> None:
    """From the first evaluation; a resumed run keeps the columns of its file, with or without it."""
    ended = lambda *success: dataclasses.replace(make_evaluation(1.5, -2.0), info={"is_success": np.array(success)})  # noqa: E731
    with writer(tmp_path / "one") as log:
        log.evaluation(2000, 12.34, ended(1.0, 0.0))
        logs = log.logs()
    with writer(tmp_path / "one", logs) as log:
        log.evaluation(4000, 56.78, ended(1.0, 1.0))
        log.evaluation(6000, 60.0, make_evaluation(3.0, 4.0))
    rows = ["2000,0,1.5,10,12.3,1", "2000,1,-2.0,11,12.3,0", "4000,0,1.5,10,56.8,1", "4000,1,-2.0,11,56.8,1"]
    rows += ["6000,0,3.0,10,60.0,nan", "6000,1,4.0,11,60.0,nan"]
    assert (tmp_path / "one" / "eval.csv").read_text().splitlines() == ["frames,episode,return,length,seconds,success", *rows]
    assert [point[1:3] for point in points(tmp_path / "one") if point[0] == "evaluation/success"] == [(2000, 0.5), (4000, 1.0)]
    with writer(tmp_path / "two") as log:
        log.evaluation(0, 1.0, make_evaluation(1.0))
        log.evaluation(2000, 2.0, ended(1.0, 0.0))
    assert (tmp_path / "two" / "eval.csv").read_text().splitlines()[::2] == [",".join(EVAL_COLUMNS), "2000,0,1.5,10,2.0"]


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
    """Three rounds are written; a second writer resumes at the checkpoint after `kept` of them."""
    with writer(tmp_path) as log:
        logs, rows, before = [log.logs()], [log.rows()], [contents(tmp_path)]
        for k in range(3):
            log.evaluation(1000 * k, 1.0 * k, make_evaluation(k / 3, -k / 7))
            log.episode({"frames": 1000 * k, "return": k / 3})
            logs.append(log.logs())
            rows.append(log.rows())
            before.append(contents(tmp_path))
        assert [log.logs(number) for number in rows] == logs
    with writer(tmp_path, logs[kept], said := []) as log:
        assert contents(tmp_path) == before[kept] and not said
        assert log.logs() == logs[kept]
        for k in range(kept, 3):
            log.evaluation(1000 * k, 1.0 * k, make_evaluation(k / 3, -k / 7))
            log.episode({"frames": 1000 * k, "return": k / 3})
        assert log.logs() == logs[3]
    assert contents(tmp_path) == before[3]


def flipped(content: bytes) -> bytes:
    return content[:3] + bytes([content[3] ^ 4]) + content[4:]


DAMAGE: dict[str, Callable[[bytes], bytes | None]] = {
    "gone": lambda content: None,
    "emptied": lambda content: b"",
    "cut": lambda content: content[:-9],
    "a flipped bit": flipped,
    "more at the end": lambda content: content + b'{"fra',
    "a line twice": lambda content: content + content.splitlines(keepends=True)[-1],
}


@pytest.mark.parametrize("kind", DAMAGE)
@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_log_is_written_again(tmp_path: Path, name: str, kind: str) -> None:
    """A message says so, except if there are only additional rows, which were written after the checkpoint."""
    with writer(tmp_path) as log:
        log.evaluation(0, 0.0, make_evaluation(1.0))
        log.episode({"frames": 0, "return": 1.0})
        logs, whole = log.logs(), contents(tmp_path)
    damaged = DAMAGE[kind](whole[name])
    if damaged is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_bytes(damaged)
    with writer(tmp_path, logs, said := []):
        assert contents(tmp_path) == whole
    after = kind in ("more at the end", "a line twice")
    assert said == (
        [] if after else [f"{tmp_path / name} is not what this run had written; it is written again from the checkpoint."]
    )


def test_a_log_that_is_a_link_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "precious.txt").write_text("mine")
    (tmp_path / "eval.csv").symlink_to("precious.txt")
    with pytest.raises(OSError), writer(tmp_path):
        pass
    assert (tmp_path / "precious.txt").read_text() == "mine"


def points(folder: Path) -> list[tuple[str, int, float, float]]:
    """The points found by TensorBoard's own reader: name, frames, value, and seconds since the first event."""
    from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]

    found, began = [], None
    (path,) = (folder / "tensorboard").glob("events.out.tfevents.*")
    content = path.read_bytes()
    while content:  # length, its checksum, the event, its checksum
        size = int.from_bytes(content[:8], "little")
        event = Event.FromString(content[12 : 12 + size])
        content = content[16 + size :]
        began = event.wall_time if began is None else began
        found += [(v.tag, event.step, v.simple_value, round(event.wall_time - began, 3)) for v in event.summary.value]
    return found


def test_tensorboard_is_written_again_from_the_logs(tmp_path: Path) -> None:
    """Whatever a kill left of it, points before the checkpoint appear once, and later points not at all."""
    with writer(tmp_path) as log:
        log.evaluation(1000, 5.0, make_evaluation(1.0, 2.0))
        log.episode({"frames": 1000, "return": 0.5, "reward/loss": 0.25, "length": 3, "seconds": 5.5})
        logs = log.logs()
        log.episode({"frames": 2000, "return": 0.75, "seconds": 9.0})
    expected = [
        ("evaluation/return", 1000, 1.5, 5.0),
        ("episode/return", 1000, 0.5, 5.5),
        ("reward/loss", 1000, 0.25, 5.5),
        ("episode/seconds", 1000, 5.5, 5.5),
    ]
    assert points(tmp_path) == [*expected, ("episode/return", 2000, 0.75, 9.0), ("episode/seconds", 2000, 9.0, 9.0)]
    for path in (tmp_path / "tensorboard").iterdir():
        path.write_bytes(path.read_bytes()[:-30])
    with writer(tmp_path, logs):
        assert sorted(points(tmp_path)) == sorted(expected)


def test_a_run_that_starts_anew_starts_with_empty_files_and_one_header(tmp_path: Path) -> None:
    for _ in range(2):
        with writer(tmp_path) as log:
            log.evaluation(0, 0.0, make_evaluation(1.0))
            log.episode({"frames": 0, "return": 1.0})
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
    """Even if the mean of equal float32 numbers differs from that number."""
    flat, line = np.full(length, constant, np.float32), np.linspace(0.0, 1.0, length, dtype=np.float32)
    assert pearson(flat, line) is None
    assert pearson(line, flat) is None
    assert pearson(flat, 0.3 * flat + 5.7) is None
    assert pearson(line, 2 * line + 1) == pytest.approx(1)
    assert pearson(line, -line) == pytest.approx(-1)
