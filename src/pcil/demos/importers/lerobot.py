"""LeRobot datasets, versions 2.1 and 3: Parquet files and `meta/info.json`. Images and videos are left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pcil import files
from pcil.demos.importers.tables import Keys, Source, chosen, split, unnamed
from pcil.errors import InputError

ROWS = 2**26
"""The largest number of rows of a dataset."""


def is_lerobot(path: Path) -> bool:
    return (path / "meta" / "info.json").is_file()


def read_lerobot(path: Path, keys: Keys) -> Source:
    """The low-dimensional features of all episodes, ordered by `episode_index` and `frame_index`."""
    try:
        from pyarrow import ArrowException, parquet
    except ImportError as error:
        raise InputError("LeRobot datasets are read by pyarrow; pip install '.[lerobot]' in a clone brings it.") from error
    try:
        info: dict[str, Any] = files.read_json(path / "meta" / "info.json")
        features, places = dict(info["features"]), sorted((path / "data").rglob("*.parquet"))
        seconds = 1 / float(info["fps"]) if info.get("fps") else None
        images = [name for name, about in features.items() if about["dtype"] in ("video", "image")]
        wanted = [name for name, about in features.items() if name not in images and about["dtype"] != "string"]
        if not places:
            raise ValueError("there is no Parquet file below data/")
        if (rows := sum(parquet.read_metadata(place).num_rows for place in places)) > ROWS:
            raise ValueError(f"it has {rows:,} rows, and at most {ROWS:,} are read")
        parts: dict[str, list[np.ndarray]] = {}
        for place in places:
            columns = [name for name in parquet.read_schema(place).names if name in wanted]
            table = parquet.read_table(place, columns=columns)
            for name in columns:
                parts.setdefault(name, []).append(np.array(table[name].to_pylist()))
        found = {name: np.concatenate(arrays) for name, arrays in parts.items()}
        order = np.lexsort((found["frame_index"], found["episode_index"]))
        found = {name: array[order] for name, array in found.items() if array.dtype.kind in "fiub"}
    except (OSError, ValueError, LookupError, TypeError, ArithmeticError, ArrowException) as error:
        raise InputError(f"{path} is no LeRobot dataset that can be read ({type(error).__name__}: {error}).") from error
    used, names = chosen(found, keys, str(path))
    task = str(info.get("robot_type") or path.name)
    shown = [f"{name}, which is {features[name]['dtype']}" for name in images]
    shown += unnamed(found, names)
    version = str(info.get("codebase_version", "")).removeprefix("v")
    return Source(f"LeRobot {version}".strip(), split(used, str(path)), names, shown, step_seconds=seconds, task=task)
