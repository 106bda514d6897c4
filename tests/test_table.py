"""Tables named in settings: what is read, and each error with its exact message."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from runner.core.model import ModelError
from runner.pqos.settings import find_file, number, within
from runner.pqos.table import LAT, LON, RATE, TIME, read_map, read_table

MATRIX = (
    "%YAML:1.0\n---\nbandwidth_map: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n"
)


def written(folder: Path, text: str, name: str = "map.csv") -> Path:
    path = folder / name
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    return path


@pytest.mark.parametrize(
    "text",
    [
        "lon,lat,kbps\n11.5,48.25,3000\n11.6,48.26,0\n",
        "bandwidth_kbps,lat,lon\n3000,48.25,11.5\n0,48.26,11.6\n",
        "t_s,lat,lon,note,uplink_kbps\n0,48.25,11.5,start here,3000\n1,48.26,11.6,,0\n",
        '\ufeff"Lon", LAT , kbps\r\n11.5, 48.25, 3e3\r\n\r\n"11.6","48.26",0\r\n',
    ],
    ids=["plain", "other order and name", "more columns", "spreadsheet"],
)
def test_map_csv(tmp_path: Path, text: str) -> None:
    np.testing.assert_array_equal(read_map(written(tmp_path, text)), [[11.5, 48.25, 3000], [11.6, 48.26, 0]])


def test_map_yaml(tmp_path: Path) -> None:
    text = MATRIX.format(rows=2, cols=3, data="11.5, 48.25, 3000.,\n       11.6, 48.26, 0.")
    found = read_map(written(tmp_path, text, "map.yaml"))
    np.testing.assert_array_equal(found, [[11.5, 48.25, 3000], [11.6, 48.26, 0]])


HEADER = "must be a header with the columns lon, lat, kbps or bandwidth_kbps or uplink_kbps"
KBPS = "must be a finite number of kbit/s, 0 or more"


@pytest.mark.parametrize(
    "text, found, rule",
    [
        ("", ":1: no column lon, lat, kbps", HEADER),
        ("11.5,48.25,3000\n", ":1: no column lon, lat, kbps", HEADER),
        ("lon,lat\n1,2\n", ":1: no column kbps", HEADER),
        ("lon,lat,downlink_kbps\n1,2,3\n", ":1: no column kbps", HEADER),
        ("lon;lat;kbps\n1;2;3\n", ":1: no column lon, lat, kbps", HEADER),
        ("lon,lat,kbps\n", "", "must have rows"),
        ("lon,lat,kbps\n1,2,3\n1,2,fast\n", ":3: kbps 'fast'", "must be a number"),
        ("lon,lat,kbps\n1,2,3\n\n1,2\n", ":4: kbps ''", "must be a number"),
        ("lon,lat,kbps\n1,,3\n", ":2: lat ''", "must be a number"),
        ("lon,lat,kbps\n1,2,3\n\n1,2,-5\n", ":4: kbps -5", KBPS),
        ("lon,lat,uplink_kbps\n1,2,nan\n", ":2: uplink_kbps nan", KBPS),
        ("lon,lat,kbps\n1,2,inf\n", ":2: kbps inf", KBPS),
        ("lon,lat,kbps\n1,2,1e999\n", ":2: kbps 1e999", KBPS),
        ("lon,lat,kbps\n48.2,-122.4,9\n", ":2: lat -122.4", "must lie in [-90, 90] degrees; are lon and lat swapped?"),
        ("lon,lat,kbps\n1,nan,9\n", ":2: lat nan", "must lie in [-90, 90] degrees; are lon and lat swapped?"),
        ("lon,lat,kbps\n181,2,9\n", ":2: lon 181", "must lie in [-180, 180] degrees"),
        ("lon,lat,kbps\n1_0,2,9\n", "", "must contain only plain decimal numbers"),
        (
            'lon,lat,kbps\n1,2,3\n1,"2,3\n' + 30_000 * "1,2,3\n",
            ":3: field larger than field limit (131072)",
            "must be CSV; is a closing quote missing?",
        ),
        ("lon,lat,kbps\n1,2,\udcff\n", ":2: kbps '\ufffd'", "must be a number"),
    ],
)
def test_map_csv_mistakes(tmp_path: Path, text: str, found: str, rule: str) -> None:
    path = written(tmp_path, text)
    with pytest.raises(ModelError) as raised:
        read_map(path)
    assert str(raised.value) == f"file: {path}{found}: {rule}"


SIZE = "must have 3 cols (lon, lat, kbps) and rows x cols numbers"


@pytest.mark.parametrize(
    "text, found, rule",
    [
        ("rows: 1\n", "", "must contain a matrix: rows, cols: 3 and data: [lon, lat, kbps, ...]"),
        (MATRIX.format(rows=2, cols=3, data="1, 2, 3"), ": rows 2, cols 3, 3 numbers in data", SIZE),
        (MATRIX.format(rows=1, cols=4, data="1, 2, 3, 4"), ": rows 1, cols 4, 4 numbers in data", SIZE),
        ("data: [1, 2, 3]\n", ": rows 0, cols 0, 3 numbers in data", SIZE),
        (MATRIX.format(rows=0, cols=3, data=""), "", "must have rows"),
        (MATRIX.format(rows=2, cols=3, data="1, 2, 3,\n 1, 2, x"), ":8: kbps 'x'", "must be a number"),
        (MATRIX.format(rows=2, cols=3, data="1, 2, 3,\n 1, 2, -3."), ":8: kbps -3.", KBPS),
        (MATRIX.format(rows=1, cols=3, data="48, 111, 3"), ":7: lat 111", LAT.rule),
    ],
)
def test_map_yaml_mistakes(tmp_path: Path, text: str, found: str, rule: str) -> None:
    path = written(tmp_path, text, "map.yaml")
    with pytest.raises(ModelError) as raised:
        read_map(path)
    assert str(raised.value) == f"file: {path}{found}: {rule}"


@pytest.mark.parametrize("second", ["0.5", "nan"])
def test_time_does_not_decrease(tmp_path: Path, second: str) -> None:
    path = written(tmp_path, f"t_s,kbps\n1,5\n{second},6\n")
    with pytest.raises(ModelError) as raised:
        read_table(path, (TIME, RATE))
    assert str(raised.value) == f"file: {path}:3: t_s {second}: {TIME.rule}"


def test_last_row_of_a_time_counts(tmp_path: Path) -> None:
    path = written(tmp_path, "t_s,kbps\n1,5\n1,6\n2,7\n2,8\n")
    np.testing.assert_array_equal(read_table(path, (TIME, RATE)), [[1, 6], [2, 8]])


def test_file_is_looked_up_in_order(tmp_path: Path) -> None:
    own, packaged = tmp_path / "own", tmp_path / "packaged"
    for base, name in ((own, "both.csv"), (packaged, "both.csv"), (packaged, "one.csv")):
        (base / "maps").mkdir(parents=True, exist_ok=True)
        (base / "maps" / name).touch()
    assert find_file({"file": "maps/both.csv"}, "file", [own, packaged]) == own / "maps/both.csv"
    assert find_file({"file": "maps/one.csv"}, "file", [own, packaged]) == packaged / "maps/one.csv"
    assert find_file({"file": str(packaged / "maps/one.csv")}, "file", [own]) == packaged / "maps/one.csv"
    with pytest.raises(ModelError) as raised, within("position"):
        find_file({"file": "maps/no.csv"}, "file", [own, packaged])
    assert str(raised.value) == f"position.file: maps/no.csv: no such file in {own}/maps, {packaged}/maps"
    with pytest.raises(ModelError, match="file: None: must name a file"):
        find_file({}, "file", [own])


@pytest.mark.parametrize("value", [None, "5", True, -1, float("nan"), float("inf"), 0])
def test_number_refuses(value: object) -> None:
    with pytest.raises(ModelError) as raised:
        number({"radius_m": value}, "radius_m", positive=True)
    assert str(raised.value) == f"radius_m: {value}: must be a number above 0"
    assert number({"radius_m": 0}, "radius_m") == 0


def test_an_error_at_the_end_of_a_big_file_is_found_quickly(tmp_path: Path) -> None:
    path = written(tmp_path, "lon,lat,kbps\n" + "11.5,48.25,3000\n" * 200_000 + "11.5,48.25,x\n")
    start = time.process_time()
    with pytest.raises(ModelError, match=":200002: kbps 'x': must be a number"):
        read_table(path, (LON, LAT, RATE))
    assert time.process_time() - start < 5
