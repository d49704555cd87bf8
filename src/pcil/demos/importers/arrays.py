"""NumPy `.npz` files and CSV files: one episode a file, or several."""

from __future__ import annotations

import codecs
import csv
import io
import math
import zipfile
from array import array
from pathlib import Path

import numpy as np

from pcil import files
from pcil.demos.importers.tables import Keys, Source, chosen, grouped, split, step_seconds, unnamed
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
    tables = split(used, str(path))
    return Source("NumPy", tables, names, dropped + unnamed(found, names), step_seconds=step_seconds(used, tables))


def is_csv(path: Path) -> bool:
    return path.is_file() and path.suffix.lower() in (".csv", ".tsv", ".txt")


def read_csv(path: Path, keys: Keys) -> Source:
    """The episodes of a CSV file with a header; numbered columns such as `obs_0` and `obs_1` are one array `obs`."""
    if path.stat().st_size > LARGEST:
        raise InputError(f"{path} has {path.stat().st_size:,} bytes, and at most {LARGEST:,} are read.")
    try:
        header, rows, lines = _cells(path)
    except (csv.Error, UnicodeError) as error:
        raise InputError(f"{path} can't be read as CSV ({error}).") from error
    names_given = [name for name in header if name]
    if len(set(names_given)) < len(names_given) or not names_given or all(map(_is_number, names_given)):
        raise InputError(f"The first line of {path} must have a different name for each column, such as obs_0,obs_1,action_0.")
    if not len(rows):
        raise InputError(f"{path} has no rows below its header of {len(header)} columns; it must have at least one.")
    columns = {name: [i] for i, name in enumerate(header) if name} | grouped(header)
    found = {name: rows[:, places] for name, places in columns.items() if name}
    used, names = chosen(found, keys, str(path))
    for meaning, column in used.items():
        if not np.isfinite(column).all():
            line = lines[int(np.argmin(np.isfinite(column).all(axis=-1)))]
            raise InputError(f"Line {line} of {path} has no number in the columns {', '.join(names[meaning])}.")
    taken = {i for meaning in used for name in names[meaning] for i in columns[name]}
    left = unnamed([name for i, name in enumerate(header) if name and i not in taken], {})
    tables = split(used, str(path))
    return Source("CSV", tables, names, left, step_seconds=step_seconds(used, tables))


def _cells(path: Path) -> tuple[list[str], np.ndarray, array[int]]:
    """The header, the numbers below it (NaN where there is none), and the number of each row's line.

    Files as spreadsheets, pandas and NumPy write them: with a byte order mark or in UTF-16, separated by commas, semicolons,
    tabs or spaces, with decimal commas where commas don't separate, quotes, `True` and `False`, empty lines, and comments above
    the header. NumPy makes the header a comment, too: it is the last one if the first other line has numbers alone.
    """
    with files.open_regular(path) as file:
        utf16 = file.read(2) in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        file.seek(0)
        text = io.TextIOWrapper(file, encoding="utf-16" if utf16 else "utf-8-sig", newline="")
        comment, head, above = "", "", 0
        for head in text:
            above += 1
            if head.strip() and not head.startswith("#"):
                break
            comment = head if head.strip() else comment
        separator = max(",;\t", key=head.count)
        separator = separator if separator in head else " "
        number = _number if separator == "," else lambda cell: _number(cell.replace(",", "."))
        first = next(csv.reader([head], delimiter=separator, skipinitialspace=True), [])
        numbers, lines = array("d"), array("q")
        header = first
        if comment and not any(math.isnan(number(cell)) for cell in first):
            header = next(csv.reader([comment.lstrip("# ")], delimiter=separator, skipinitialspace=True))
            numbers.extend(map(number, first))
            lines.append(above)
        reader = csv.reader(text, delimiter=separator, skipinitialspace=True)
        for row in reader:
            if row and not (len(row) == 1 < len(header) and not row[0].strip()):
                if len(row) != len(header):
                    where = f"line {above + reader.line_num} has {len(row)}, and the header {len(header)}"
                    raise InputError(f"{path} has rows of different lengths: {where}.")
                numbers.extend(map(number, row))
                lines.append(above + reader.line_num)
    rows = np.frombuffer(numbers, np.float64) if numbers else np.zeros(0)
    return [name.strip() for name in header], rows.reshape(len(lines), -1) if lines else rows, lines


def _number(cell: str) -> float:
    """The number of a cell; NaN if it has none."""
    try:
        return float(cell)
    except ValueError:
        return {"true": 1.0, "false": 0.0}.get(cell.strip().lower(), math.nan)


def _is_number(text: str) -> bool:
    return not math.isnan(_number(text))
