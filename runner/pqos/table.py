"""Tables of numbers: bandwidth maps, traces, GPS tracks; checked in full before use."""

from __future__ import annotations

import csv
import re
import sys
import warnings
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from runner.core.model import ModelError
from runner.schema import shown

FINITE = sys.float_info.max
LONGEST_HEADER = 10_000  # characters


class Column(NamedTuple):
    """A column of numbers: names its header may have, range, and whether it is a time that must not decrease."""

    names: tuple[str, ...]
    least: float
    most: float
    rule: str
    time: bool = False


LON = Column(("lon",), -180, 180, "must lie in [-180, 180] degrees")
LAT = Column(("lat",), -90, 90, "must lie in [-90, 90] degrees; are lon and lat swapped?")
RATE = Column(("kbps", "bandwidth_kbps", "uplink_kbps"), 0, FINITE, "must be a finite number of kbit/s, 0 or more")
TIME = Column(
    ("t_s",), -FINITE, FINITE, "must be a finite number of seconds, not below that of the row before", time=True
)
DELAY = Column(("delay_ms", "rtt_ms"), 0, 60_000, "must be a number of ms from 0 to 60000")
BIAS = Column(("bias",), -10, 10, "must be a number from -10 to 10: mean of ln(capacity / kbps)")
ERROR = Column(("error",), 0.01, 10, "must be a number from 0.01 to 10: deviation of ln(capacity / kbps)")
SPEED = Column(("speed_mps",), 0, FINITE, "must be a finite number of m/s, 0 or more")


class _Text(NamedTuple):
    """A table as read from a file.

    values  float64 (rows, columns); None: some cell is not a number
    names   name of each column in this file
    rows    line number and cells of each row, read again to report an error
    """

    values: NDArray[np.float64] | None
    names: Sequence[str]
    rows: Iterator[tuple[int, Sequence[str]]]


def read_table(path: Path, columns: Sequence[Column]) -> NDArray[np.float64]:
    """The requested columns of a CSV file with a header, as float64 (rows, columns); other columns are ignored.

    raises  ModelError with file, line, cell and rule of the first error
    """
    return _checked(path, columns, _csv(path, columns))


def read_map(path: Path) -> NDArray[np.float64]:
    """A bandwidth map as rows of lon, lat (degrees, WGS-84) and kbit/s: CSV, or the matrix in OpenCV's YAML.

    raises  ModelError with file, line, cell and rule of the first error
    """
    columns = (LON, LAT, RATE)
    text = _matrix(path) if path.suffix.lower() in {".yaml", ".yml"} else _csv(path, columns)
    return _checked(path, columns, text)


def read_errors(path: Path) -> NDArray[np.float64] | None:
    """Bias and error of each point of a bandwidth map, ln, in the order of `read_map`; None: it does not state them.

    raises  ModelError as there
    """
    columns = (BIAS, ERROR)
    is_stated = all(column.names[0] in header(path) for column in columns)
    return read_table(path, columns) if is_stated else None


def header(path: Path) -> list[str]:
    """Column names in the first line of a CSV file, in lower case."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        return [name.strip(' \t\r\n"').lower() for name in file.readline(LONGEST_HEADER).split(",")]


def _csv(path: Path, columns: Sequence[Column]) -> _Text:
    found = header(path)
    names = [next((name for name in column.names if name in found), "") for column in columns]
    if "" in names:
        # The content is not shown: this may be the wrong file.
        expected = ", ".join(" or ".join(column.names) for column in columns)
        lacks = ", ".join(column.names[0] for column, name in zip(columns, names, strict=True) if not name)
        raise ModelError("file", f"{path}:1: no column {lacks}", f"must be a header with the columns {expected}")
    index = [found.index(name) for name in names]

    def rows() -> Iterator[tuple[int, Sequence[str]]]:
        line = 0
        with path.open(newline="", encoding="utf-8-sig", errors="replace") as file:
            reader = csv.reader(file)
            try:
                for row in reader:
                    if line and row:
                        yield reader.line_num, [row[i].strip() if i < len(row) else "" for i in index]
                    line = reader.line_num
            except csv.Error as error:
                rule = "must be CSV; is a closing quote missing?"
                raise ModelError("file", f"{path}:{line + 1}: {error}", rule) from None

    with path.open(encoding="utf-8-sig", errors="replace") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about an empty table, which `_checked` refuses
        try:
            values = np.loadtxt(file, delimiter=",", skiprows=1, usecols=index, comments=None, quotechar='"', ndmin=2)
        except ValueError:
            return _Text(None, names, rows())
    return _Text(values, names, rows())


def _matrix(path: Path) -> _Text:
    """The matrix of rows x 3 numbers (lon, lat, kbit/s) in which the paper's own implementation stores its map.

    No YAML parser reads OpenCV's `%YAML:1.0`, so rows, cols and data are looked up in the text.
    """
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    data = re.search(r"\bdata:\s*\[([^\]]*)\]", text)
    if not data:
        raise ModelError("file", path, "must contain a matrix: rows, cols: 3 and data: [lon, lat, kbps, ...]")
    cells = data[1].replace(",", " ").split()
    size = [int(found[1]) if (found := re.search(rf"\b{key}:\s*(\d+)", text)) else 0 for key in ("rows", "cols")]
    if size[1] != 3 or size[0] * 3 != len(cells):
        sizes = f"{path}: rows {size[0]}, cols {size[1]}, {len(cells)} numbers in data"
        raise ModelError("file", sizes, "must have 3 cols (lon, lat, kbps) and rows x cols numbers")

    def rows() -> Iterator[tuple[int, Sequence[str]]]:
        first = text.count("\n", 0, data.start(1)) + 1
        lines = enumerate(data[1].replace(",", " ").split("\n"), first)
        numbers = ((line, cell) for line, cells in lines for cell in cells.split())
        for (line, lon), (_, lat), (_, rate) in zip(numbers, numbers, numbers, strict=True):
            yield line, (lon, lat, rate)

    try:
        values = np.array(cells, dtype=np.float64).reshape(-1, 3)
    except ValueError:
        return _Text(None, ("lon", "lat", "kbps"), rows())
    return _Text(values, ("lon", "lat", "kbps"), rows())


def _checked(path: Path, columns: Sequence[Column], text: _Text) -> NDArray[np.float64]:
    """The values of a table, each within the range of its column; raises ModelError for the first that is not.

    Recorders sometimes write a row twice: of rows with the same time, the last one counts.
    """
    values = text.values
    if values is None:
        raise _not_a_number(path, text)
    if not len(values):
        raise ModelError("file", path, "must have rows")
    good = (values >= [column.least for column in columns]) & (values <= [column.most for column in columns])
    times = [j for j, column in enumerate(columns) if column.time]
    for j in times:
        good[1:, j] &= np.diff(values[:, j]) >= 0
    if not good.all():
        i, j = (int(k) for k in np.argwhere(~good)[0])
        line, cells = next(islice(text.rows, i, None))
        raise ModelError("file", f"{path}:{line}: {text.names[j]} {cells[j]}", columns[j].rule)
    for j in times:
        values = values[np.append(np.diff(values[:, j]) > 0, True)]
    return values


def _not_a_number(path: Path, text: _Text) -> ModelError:
    for line, cells in text.rows:
        for name, cell in zip(text.names, cells, strict=True):
            try:
                float(cell)
            except ValueError:
                return ModelError("file", f"{path}:{line}: {name} {shown(cell)}", "must be a number")
    return ModelError("file", path, "must contain only plain decimal numbers")
