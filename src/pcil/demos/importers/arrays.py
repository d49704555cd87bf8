"""NumPy `.npz` files and CSV files: one episode a file, or several."""

from __future__ import annotations

import csv
import warnings
import zipfile
from pathlib import Path

import numpy as np

from pcil import files
from pcil.demos.importers.tables import TIME, Keys, Source, chosen, grouped, split, step_seconds, unnamed
from pcil.errors import InputError

LARGEST = 2**31
"""The largest file, and the most bytes that the arrays of a `.npz` may take."""


def is_npz(path: Path) -> bool:
    return (
        path.is_file() and zipfile.is_zipfile(path) and any(name.endswith(".npy") for name in zipfile.ZipFile(path).namelist())
    )


def read_npz(path: Path, keys: Keys) -> Source:
    """The episodes of a `.npz`; arrays of objects, which are pickles, are never loaded."""
    with zipfile.ZipFile(path) as packed:
        if (size := sum(entry.file_size for entry in packed.infolist())) > LARGEST:
            raise InputError(f"{path} unpacks to {size:,} bytes, and at most {LARGEST:,} are read.")
    found, dropped = {}, []
    with np.load(path) as held:  # an array of objects raises, since NumPy unpickles nothing by default
        for name in held.files:
            try:
                array = held[name]
            except ValueError:
                array = None
            if array is None or array.dtype.kind not in "fiub" or not 1 <= array.ndim <= 3:
                dropped.append(f"{name} of {path.name}, which is no rows of numbers")
            else:
                found[name] = array
    used, names = chosen(found, keys, str(path))
    return Source("NumPy", split(used, str(path)), names, dropped + unnamed(found, names), step_seconds=_time(found))


def is_csv(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in (".csv", ".tsv", ".txt")


def read_csv(path: Path, keys: Keys) -> Source:
    """The episodes of a CSV file with a header; numbered columns such as `obs_0` and `obs_1` are one array `obs`."""
    if path.stat().st_size > LARGEST:
        raise InputError(f"{path} has {path.stat().st_size:,} bytes, and at most {LARGEST:,} are read.")
    with files.open_regular(path) as file:
        head = file.readline(2**20).decode(errors="replace")
    separator = max(",;\t", key=head.count)
    header = [name.strip() for name in next(csv.reader([head], delimiter=separator), [])]
    if len(set(header)) < len(header) or not any(header) or all(_is_number(name) for name in header):
        raise InputError(f"The first line of {path} must have a different name for each column, such as obs_0,obs_1,action_0.")
    groups = grouped(header)
    singles = {name: [i] for i, name in enumerate(header)}
    columns = singles | groups
    asked = {*keys.obs, *keys.action, *filter(None, (keys.reward, keys.episode))}
    numbers = [i for i in range(len(header)) if header[i] not in TIME]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of files without rows, which are refused below
            rows = np.genfromtxt(path, delimiter=separator, skip_header=1, ndmin=2, dtype=np.float64, comments="\0")
    except ValueError as error:
        raise InputError(f"{path} has rows of different lengths ({str(error).splitlines()[-1].strip()}).") from error
    if not len(rows) or rows.shape[1] != len(header):
        raise InputError(
            f"{path} has {len(rows)} rows below a header of {len(header)} columns; it must have at least one of them."
        )
    found = {name: rows[:, places] for name, places in columns.items() if set(places) & set(numbers) or name in asked}
    used, names = chosen(found, keys, str(path))
    for meaning, chosen_names in names.items():
        if not np.isfinite(used[meaning]).all():
            row = int(np.argmin(np.isfinite(used[meaning]).all(axis=-1)))
            raise InputError(f"Line {row + 2} of {path} has no number in the columns {', '.join(chosen_names)}.")
    taken = {i for chosen_names in names.values() for name in chosen_names for i in columns[name]}
    left = unnamed([header[i] for i in range(len(header)) if i not in taken], {})
    time = next((rows[:, i] for i, name in enumerate(header) if name in TIME), None)
    tables = split(used, str(path))
    seconds = None if time is None else step_seconds(time[: len(tables[0].obs)])
    return Source("CSV", tables, names, left, step_seconds=seconds)


def _time(found: dict[str, np.ndarray]) -> float | None:
    return next((step_seconds(found[name]) for name in TIME if name in found and found[name].ndim == 1), None)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True
