"""Bandwidth maps from drives: only where the link was the limit, a percentile per square, exact messages."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drives import Lines, believing, measured, write_drive
from helpers import Command

from runner.drive.capacity import CapacitySample, cells, limited_samples
from runner.drive.read import read_drive
from runner.drive.series import series
from runner.records.lines import line_to_json
from runner.records.reception import ReceptionReport, ReceptionReported, UnitReceived

pytestmark = pytest.mark.slow  # draws figures of drives


def test_a_square_holds_the_percentile_of_its_samples() -> None:
    here = [CapacitySample(52.0, 11.0, kbps) for kbps in range(1000, 1100)]
    there = [CapacitySample(52.0, 11.001, 5000.0)]  # 68 m further east
    first, second = cells([*here, *there], 10, 10)
    assert (first.kbps, first.samples) == (1009, 100)
    assert (second.kbps, second.samples) == (5000, 1)
    assert (second.lat, second.lon) == pytest.approx((52.0, 11.001))
    assert [cell.samples for cell in cells([*here, *there], 10, 200)] == [101]
    assert cells([*here], 0, 10)[0].kbps == 1000 and cells([*here], 100, 10)[0].kbps == 1099


def test_a_square_states_how_far_its_rate_is_from_the_truth() -> None:
    """One pass says little: the error of what nobody has checked counts as another. Each later pass says as much."""
    once = [CapacitySample(52.0, 11.0, 1000 * np.exp(off), t) for t, off in enumerate((-0.1, 0.1))]
    (cell,) = cells(once, 0, 10)
    assert (cell.bias, cell.error) == (pytest.approx(0.1), pytest.approx(np.sqrt((0.35**2 + 0.1**2) / 2)))
    often = [sample._replace(t=sample.t + 60 * n) for n in range(9) for sample in once]
    (cell,) = cells(often, 0, 10)
    assert (cell.bias, cell.error) == (pytest.approx(0.1), pytest.approx(np.sqrt((0.35**2 + 9 * 0.1**2) / 10)))


def test_what_was_believed_counts_while_it_was_sure_and_below_what_cameras_can_use(tmp_path: Path) -> None:
    change = believing(lambda t: 90_000 if t < 5 else 2000, lambda t: 0.5 if 8 <= t < 10 else 0.1)
    drive = series(read_drive(write_drive(tmp_path / "drive", ["vehicle"], seconds=20, change=change)))
    found = limited_samples(drive)
    assert {sample.kbps for sample in found} == {2000}
    assert len(found) > 40
    assert not any(sample.t < 5 or 8.5 < sample.t < 9.9 for sample in found)


def test_squares_are_square_at_every_latitude_and_across_the_180th_meridian() -> None:
    for lat in (0.0, 60.0, -75.0):
        east = np.degrees(100 / 6378137.0) / np.cos(np.radians(lat))
        row = [
            CapacitySample(lat, float(np.remainder(179.9995 + 180 + n * east / 10, 360) - 180), 1.0) for n in range(31)
        ]
        assert 3 <= len(cells(row, 50, 100)) <= 4


def reported(t: float, late_s: float) -> dict[str, Any]:
    """A reception report of a frame that the vehicle sent late."""
    report = ReceptionReport(t, t, (UnitReceived("front_left", 0.01, 0.1, 1000),), 1, 0)
    return line_to_json(ReceptionReported(t, "operator", True, report, late_s=(late_s,)))


def test_samples_count_only_where_the_link_was_the_limit(tmp_path: Path) -> None:
    """Frames queue from 4 to 6 s, packets are lost from 8 s to 9 s; otherwise the link has spare capacity."""

    def change(side: str, lines: Lines) -> Lines:
        for line in lines:
            for camera in line["cameras"].values() if line.get("log") == "sample" else ():
                camera["arrivals"] = [[t, 100.0 if 4 <= t < 6 else 10.0] for t, _ in camera["arrivals"]]
                camera["lost"] = round(np.interp(line["t"], [8, 9], [0, 20]))
        return measured(side, lines)

    drive = series(read_drive(write_drive(tmp_path / "drive", seconds=14, change=change)))
    samples = limited_samples(drive)
    at = [drive.positions.t[np.argmin(np.abs(drive.positions.lon - s.lon))] for s in samples]  # type: ignore[union-attr]
    operator = (
        np.array(at) - 1.5 + 0.5
    )  # from the middle of the window, on the vehicle's clock, to the operator's end of it
    assert len(samples) > 10
    assert all(4.4 <= t <= 6.8 or 7.9 <= t <= 10.1 for t in operator)
    assert any(t < 6 for t in operator) and any(t > 8.5 for t in operator)
    assert all(0 < sample.kbps < 9000 for sample in samples)


def test_frames_that_a_machine_held_up_do_not_count(tod: Command, tmp_path: Path) -> None:
    """Everything queues from 4 to 6 s and the total is cut: by the link, or since the vehicle sent frames late."""

    def change(side: str, lines: Lines) -> Lines:
        for line in lines:
            for camera in line["cameras"].values() if line.get("log") == "sample" else ():
                camera["arrivals"] = [[t, 100.0 if 4 <= t < 6 else 10.0] for t, _ in camera["arrivals"]]
                camera["lost"] = 0
        return measured(side, lines)

    def held_up(side: str, lines: Lines) -> Lines:
        late = [reported(t / 10, 0.2) for t in range(55, 80)] if side == "vehicle" else []
        return sorted([*change(side, lines), *late], key=lambda line: line["t"])

    def uncut(side: str, lines: Lines) -> Lines:
        found = change(side, lines)
        for line in found:
            if line.get("log") == "state":
                line["asked_kbps"] = line["total_kbps"]
        return found

    by_link = write_drive(tmp_path / "link", seconds=14, change=change)
    by_machine = write_drive(tmp_path / "machine", seconds=14, change=held_up)
    never_cut = write_drive(tmp_path / "uncut", seconds=14, change=uncut)
    output = tmp_path / "map.csv"
    for path in (by_machine, never_cut):
        done = tod("map", str(path), f"output={output}")
        assert (done.status, done.err.partition(" samples ")[0].rpartition(" ")[0]) == (1, "no map: in none of")
        assert not output.exists()
    assert tod("map", str(by_link), f"output={output}").status == 0


def test_the_verb_writes_a_map_that_pqos_reads(tod: Command, tmp_path: Path) -> None:
    drives = [
        str(write_drive(tmp_path / name, seconds=40, seed=seed, congested=3.0, change=measured))
        for name, seed in (("a", 1), ("b", 2))
    ]
    output = tmp_path / "map.csv"
    result = tod("map", *drives, f"output={output}", "percentile=20", "cell_m=20")
    assert result.status == 0, result.err
    rows: list[dict[str, Any]] = list(csv.DictReader(output.open()))
    counted = sum(int(row["samples"]) for row in rows)
    assert result.out.startswith(f"{output}: {len(rows)} squares of 20 m from {counted} of ")
    replayed = tod("replay", "pqos=map", f"pqos.file={output}", f"input={drives[0]}")
    assert replayed.status == 0, replayed.err
    assert '"source": "pqos"' in replayed.out


def believing_of_two(side: str, lines: Lines) -> Lines:
    """As if uplink a were believed to carry 2000 kbit/s, and b more than the one camera on it can use."""
    known = {"deviation": 0.1, "margin": 0.1, "bias": -0.2, "error": 0.1, "gain": 0.5, "policer_kbps": None}
    for line in lines:
        if line.get("log") == "decision":
            for number, camera in enumerate(line["cameras"].values()):
                camera |= {"uplinks": ["b" if number == 0 else "a"], "demand_kbps": 900}
            line["uplinks"] = {
                name: {"total_kbps": kbps, "stalled": False, "reason": "", "believed": known | {"kbps": kbps}}
                for name, kbps in (("a", 2000), ("b", 1000))
            }
    return lines


def test_each_of_several_uplinks_gets_a_map_of_its_own(tod: Command, tmp_path: Path) -> None:
    drive = str(write_drive(tmp_path / "drive", ["vehicle"], seconds=10, change=believing_of_two))
    output = tmp_path / "map.csv"
    assert tod("map", drive, "uplink=a", f"output={output}").status == 0
    assert {row["kbps"] for row in csv.DictReader(output.open())} == {"2000"}
    for words, expected in (
        (("uplink=b",), "no map: in none of 40 samples was the link the limit: "),
        (("uplink=c",), f"no map: {drive} has the uplinks a, b: uplink=NAME chooses one\n"),
        ((), f"no map: {drive} has the uplinks a, b: uplink=NAME chooses one\n"),
    ):
        assert tod("map", drive, f"output={output}", *words).err.startswith(expected)


def test_drives_that_yield_no_map_are_reported(tod: Command, tmp_path: Path) -> None:
    def roomy(side: str, lines: Lines) -> Lines:
        for line in lines:
            for camera in line["cameras"].values() if line.get("log") == "sample" else ():
                camera |= {"arrivals": [[t, 10.0] for t, _ in camera["arrivals"]], "lost": 0}
        return measured(side, lines)

    good = write_drive(tmp_path / "good", seconds=5, change=roomy)
    output = f"output={tmp_path / 'map.csv'}"
    for words, status, expected in (
        ((output,), 2, "command line: DRIVE: must be given: a directory that log= wrote"),
        ((str(good),), 2, "command line: output: must be given: the map's file"),
        ((str(good), output, "percentile=101"), 2, "command line: percentile: 101: must be at most 100"),
        ((str(good), output, "cell_m=0"), 2, "command line: cell_m: 0: must be at least 1"),
        ((str(tmp_path / "no"), output), 2, f"{tmp_path / 'no'}: no such directory"),
        ((str(good), output), 1, "no map: in none of "),
    ):
        result = tod("map", *words)
        assert result.status == status, result.err
        assert result.err.startswith(expected) and result.err.count("\n") == 1
    alone = write_drive(tmp_path / "alone", ["vehicle"], seconds=5)
    assert tod("map", str(alone), output).err == f"no map: {alone} has no operator's log\n"
    of_one = f"no map: {good} has no uplink a: the vehicle had one\n"
    assert tod("map", str(good), output, "uplink=a").err == of_one
    assert tod("map", str(good), output, "percentil=5").err.startswith("command line: percentil=5: unknown argument")
    assert not (tmp_path / "map.csv").exists()
