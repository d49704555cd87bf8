"""Loggers that show the numbers of a run in other programs: TensorBoard, Weights & Biases and MLflow."""

from __future__ import annotations

import abc
import itertools
import math
import statistics
import time
import uuid
from pathlib import Path
from typing import Any

from pcil.errors import InputError
from pcil.files import flat
from pcil.training.callbacks import Callback, History
from pcil.training.config import Run
from pcil.training.evaluate import Evaluation


class Numbers(Callback, abc.ABC):
    """Passes the numbers of a run on by name: those of each metrics row, with the prefix `episode/` where the name has none,
    and `evaluation/return` and `evaluation/success`, the means of an evaluation.

    A subclass defines `log`. Numbers that are not finite are left out.
    """

    @abc.abstractmethod
    def log(self, numbers: dict[str, float], frames: int, seconds: float) -> None:
        """Numbers after `frames` frames and `seconds` of training."""

    def episode(self, row: dict[str, Any]) -> None:
        numbers = {name if "/" in name else f"episode/{name}": value for name, value in row.items() if isinstance(value, float)}
        self._log(numbers, row["frames"], row.get("seconds", 0.0))

    def evaluation(self, frames: int, seconds: float, result: Evaluation) -> None:
        columns = {"return": result.returns.tolist(), "success": result.success or []}
        self._log(_means(columns), frames, float(f"{seconds:.1f}"))  # as the logs have it

    def again(self, history: History) -> None:
        """Log what the run had logged before."""
        for row in history.episodes:
            self.episode(row)
        for frames, group in itertools.groupby(history.evaluations, key=lambda row: row["frames"]):
            episodes = list(group)
            columns = {name: [float(row[name]) for row in episodes if name in row] for name in ("return", "success")}
            self._log(_means(columns), int(frames), float(episodes[0]["seconds"]))

    def _log(self, numbers: dict[str, float], frames: int, seconds: float) -> None:
        if numbers := {name: value for name, value in numbers.items() if math.isfinite(value)}:
            self.log(numbers, frames, seconds)


def _means(columns: dict[str, list[float]]) -> dict[str, float]:
    """The mean of each column of an evaluation that has values."""
    return {f"evaluation/{name}": statistics.fmean(values) for name, values in columns.items() if values}


class TensorBoard(Numbers):
    """Writes TensorBoard's file of a run; a resumed run rebuilds it from the logs.

    It is written in this thread, so that a full disk raises here and not in another thread.
    """

    def begin(self, run: Run, folder: Path, history: History) -> None:
        from tensorboardX.record_writer import RecordWriter

        place = folder / "tensorboard"
        place.mkdir(exist_ok=True)
        for path in place.glob("events.out.tfevents.*"):
            path.unlink()
        self._began = time.time() - history.seconds
        self._writer = RecordWriter(str(place / f"events.out.tfevents.{int(self._began)}.pcil"))
        self._event(0.0, file_version="brain.Event:2")
        self.again(history)
        self._writer.flush()

    def evaluation(self, frames: int, seconds: float, result: Evaluation) -> None:
        super().evaluation(frames, seconds, result)
        self._writer.flush()

    def log(self, numbers: dict[str, float], frames: int, seconds: float) -> None:
        from tensorboardX.summary import scalar

        for name, value in numbers.items():
            self._event(seconds, step=frames, summary=scalar(name, value))

    def end(self) -> None:
        self._writer.close()

    def _event(self, seconds: float, **content: Any) -> None:
        from tensorboardX.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue] - protobuf makes it

        self._writer.write(Event(wall_time=self._began + seconds, **content).SerializeToString())


class WandB(Numbers):
    """Logs to Weights & Biases, in the project `pcil`, under the name of the run's folder; the steps are frames.

    Its own environment variables apply: `WANDB_MODE=offline` writes to the run's folder alone. A resumed run goes on under the
    same id, and W&B ignores the steps that it has already.
    """

    def __init__(self) -> None:
        self._wandb = _imported("wandb")

    def begin(self, run: Run, folder: Path, history: History) -> None:
        settings = self._wandb.Settings(silent=True)
        self._run = self._wandb.init(
            project="pcil",
            name=folder.resolve().name,
            id=_id(folder / "wandb.txt"),
            dir=folder,
            config=run.to_json(),
            resume="allow",
            settings=settings,
        )

    def log(self, numbers: dict[str, float], frames: int, seconds: float) -> None:
        self._run.log(numbers, step=frames)

    def end(self) -> None:
        self._run.finish()


MLFLOW_BATCH = 100
"""The number of parameters that MLflow takes at once."""


class MLflow(Numbers):
    """Logs to MLflow, in the experiment `pcil`, under the name of the run's folder; the steps are frames.

    `MLFLOW_TRACKING_URI` says where to; without it MLflow's default applies, which is the file mlflow.db in the current
    folder. A resumed run goes on with the same MLflow run, which is found by its tag `pcil.id`.
    """

    def __init__(self) -> None:
        self._mlflow = _imported("mlflow")

    def begin(self, run: Run, folder: Path, history: History) -> None:
        self._client, number = self._mlflow.MlflowClient(), _id(folder / "mlflow.txt")
        held = self._client.get_experiment_by_name("pcil")
        experiment = held.experiment_id if held else self._client.create_experiment("pcil")
        found = self._client.search_runs([experiment], f"tags.`pcil.id` = '{number}'")
        if found:
            self._id = found[0].info.run_id
            self._client.update_run(self._id, status="RUNNING")
        else:
            name = folder.resolve().name
            self._id = self._client.create_run(experiment, tags={"pcil.id": number}, run_name=name).info.run_id
            params = [self._mlflow.entities.Param(name, str(value)) for name, value in flat(run.to_json()).items()]
            for first in range(0, len(params), MLFLOW_BATCH):
                self._client.log_batch(self._id, params=params[first : first + MLFLOW_BATCH])
        names = self._client.get_run(self._id).data.metrics
        self._logged = {(name, old.step) for name in names for old in self._client.get_metric_history(self._id, name)}

    def log(self, numbers: dict[str, float], frames: int, seconds: float) -> None:
        now, metric = int(time.time() * 1000), self._mlflow.entities.Metric
        new = [metric(name, value, now, frames) for name, value in numbers.items() if (name, frames) not in self._logged]
        self._client.log_batch(self._id, metrics=new)

    def end(self) -> None:
        self._client.set_terminated(self._id)


LOGGERS: dict[str, type[Callback]] = {"wandb": WandB, "mlflow": MLflow}
"""The loggers that `--callbacks` takes by name."""


def _imported(name: str) -> Any:
    """The module of an optional package, or `InputError`."""
    import importlib

    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(f"The logger {name} needs {error.name}, which pip install '.[{name}]' in a clone brings.") from error


def _id(path: Path) -> str:
    """The id of a run for another program, which is kept in a file of its folder."""
    if not path.exists():
        path.write_text(uuid.uuid4().hex + "\n")
    return path.read_text().strip()
