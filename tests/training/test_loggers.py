"""The loggers for other programs: what these hold is what the log files hold, also after a stop and a resumption."""

from __future__ import annotations

import csv
import json
import statistics
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pcil import cli
from pcil.errors import InputError
from pcil.training import loggers, runs
from pcil.training.callbacks import Callback
from pcil.training.loop import Stopped
from small import small_run

Points = list[tuple[str, int, float]]


class StopAfter(Callback):
    """Stops a run after some episodes."""

    def __init__(self, episodes: int) -> None:
        self.left = episodes

    def episode(self, row: dict[str, Any]) -> None:
        self.left -= 1

    def stop(self) -> bool:
        return self.left == 0


def logged_in_two_parts(folder: Path, make: Callable[[], Callback]) -> Points:
    """Train a small run that stops once and is resumed, and return what its log files hold: name, frames and value."""
    with pytest.raises(Stopped):
        runs.execute(small_run("expert"), folder, [make(), StopAfter(4)])
    runs.execute(small_run("expert"), folder, [make()])
    found = []
    for line in (folder / "train.jsonl").read_text().splitlines():
        row = json.loads(line)
        numbers = {name: value for name, value in row.items() if isinstance(value, float)}
        found += [(name if "/" in name else f"episode/{name}", row["frames"], value) for name, value in numbers.items()]
    returns: dict[int, list[float]] = {}
    for row in csv.DictReader((folder / "eval.csv").read_text().splitlines()):
        returns.setdefault(int(row["frames"]), []).append(float(row["return"]))
    return sorted(found + [("evaluation/return", frames, statistics.fmean(paid)) for frames, paid in returns.items()])


def of_wandb(path: Path) -> Iterator[tuple[str, int, float]]:
    """The points in an offline file of W&B, which has LevelDB's log format: blocks of 32 KiB. Each record, or part of
    one, follows its checksum (4 bytes), its size (2 bytes) and its kind (1 byte: 1 is a whole record, 4 the last part)."""
    from wandb.proto import wandb_internal_pb2

    content, at, record = path.read_bytes(), 7, b""
    while at < len(content):
        if (left := 32768 - at % 32768) < 7:
            at += left
            continue
        size, kind = int.from_bytes(content[at + 4 : at + 6], "little"), content[at + 6]
        record, at = record + content[at + 7 : at + 7 + size], at + 7 + size
        if kind in (1, 4):
            kept = wandb_internal_pb2.Record.FromString(record)  # pyright: ignore[reportAttributeAccessIssue] - protobuf makes it
            record = b""
            values = {item.key or item.nested_key[0]: json.loads(item.value_json) for item in kept.history.item}
            yield from ((name, values["_step"], value) for name, value in values.items() if not name.startswith("_"))


def test_wandb_holds_the_same_numbers_offline(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WANDB_MODE", "offline")
    expected = logged_in_two_parts(tmp_path / "run", loggers.WandB)
    files = list((tmp_path / "run" / "wandb").glob("offline-run-*/*.wandb"))
    assert len(files) == 2
    assert len({path.name for path in files}) == 1  # both sessions have the id of one run
    found = [point for path in files for point in of_wandb(path)]
    assert sorted(found) == expected


@pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")  # MLflow with SQLAlchemy 2.1
def test_mlflow_holds_the_same_numbers_in_a_local_database(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import mlflow

    monkeypatch.setenv("MLFLOW_TRACKING_URI", f"sqlite:///{tmp_path / 'mlflow.db'}")
    expected = logged_in_two_parts(tmp_path / "run", loggers.MLflow)
    client = mlflow.MlflowClient()
    experiment = client.get_experiment_by_name("pcil")
    assert experiment is not None
    (held,) = client.search_runs([experiment.experiment_id])
    assert held.info.status == "FINISHED"
    assert held.info.run_name == "run"
    assert held.data.params["agent.gamma"] == "0.99"
    found = [
        (name, old.step, old.value) for name in held.data.metrics for old in client.get_metric_history(held.info.run_id, name)
    ]
    assert sorted(found) == expected


@pytest.mark.parametrize("name", loggers.LOGGERS)
def test_a_logger_that_is_not_installed_is_named_with_its_command(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(InputError, match=f"needs {name}, which pip install '.\\[{name}\\]' in a clone brings"):
        loggers.LOGGERS[name]()
    assert cli.main(["train", "walker_walk", "--out", str(tmp_path / "run"), "--callbacks", name]) == 2
    assert f"pip install '.[{name}]'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
