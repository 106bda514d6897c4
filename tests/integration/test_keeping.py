"""A vehicle with `drives=DIR`: old drives go, and a marked moment protects the running one."""

from __future__ import annotations

import json
import signal
import subprocess
from pathlib import Path

from rig import ROBOT, Operator, free_port, process, until
from runner.drive.log import PROTECTED
from runner.live import live_operator


def test_a_marked_moment_protects_the_drives_of_both_sides(broker, tmp_path: Path) -> None:
    ports = (f"control.port={broker.port}", f"media.port={free_port()}")
    drives, own = tmp_path / "drives", tmp_path / "own"
    words = (*ROBOT, *ports, f"drives={drives}", "log.keep_gb=0.000000001")
    with (
        process("vehicle", *words, stdout=subprocess.DEVNULL) as vehicle,
        live_operator([*ROBOT, *ports], log=own) as operator,
    ):
        operator.start()
        until(lambda: operator.station.state)
        outcomes: list[str] = []
        operator.station.ask({"event": "moment_marked"}, lambda outcome: outcomes.append(outcome.result))
        (kept,) = until(lambda: list(drives.glob(f"*/{PROTECTED}")))
        assert until(lambda: outcomes) == ["applied"]
        until((own / PROTECTED).exists)
        vehicle.send_signal(signal.SIGTERM)
        vehicle.wait(20)
    lines = [json.loads(line) for line in (kept.parent / "drive.jsonl").read_text().splitlines()]
    (event,) = (line for line in lines if line.get("event") == "moment_marked")
    assert event["back_s"] == 60
    assert kept.read_text() == f"{event['t']:.1f} s: the last 60 s were marked\n"

    unprotected = []
    for _ in range(2):  # each start removes what the one before has left
        with process("vehicle", *words, stdout=subprocess.DEVNULL) as vehicle:
            Operator(broker).state(lambda state: state["online"])
            (running,) = (path for path in until(lambda: new_drives(drives, kept.parent, *unprotected)))
            until(lambda: not any(path.exists() for path in unprotected))
            vehicle.send_signal(signal.SIGTERM)
            vehicle.wait(20)
        unprotected.append(running)
    assert sorted(drives.iterdir()) == sorted([kept.parent, running])


def new_drives(parent: Path, *known: Path) -> list[Path]:
    return [path for path in parent.iterdir() if path not in known and (path / "drive.jsonl").exists()]
