"""Events per second that `tod-runner replay` decides for the eight cameras of the paper's vehicle.

python bench/replay.py [events]

The whole process is timed: start, composition of the configuration, reading, deciding, writing. Two scenarios: one in
which every event is a prediction that changes all bitrates, and a drive as logged, with time, positions and link
measurements between the predictions.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from table import Row, show

LEAST_RATE = 7000  # events per second
RUNS = 3


def prediction(t: float) -> dict[str, Any]:
    return {"t": t, "event": "bitrate_predicted", "kbps": round(5500 + 2500 * math.sin(t / 5), 1)}


def predictions(count: int) -> Iterator[dict[str, Any]]:
    return (prediction(round(index * 0.1, 1)) for index in range(count))


def drive(count: int) -> Iterator[dict[str, Any]]:
    for index in range(count):
        t = round(index * 0.025, 3)
        if index % 20 == 0:
            yield prediction(t)
        elif index % 4 == 0:
            yield {"t": t, "event": "clock_advanced"}
        elif index % 4 == 2:
            yield {"t": t, "event": "position_reported", "lat": 48.26, "lon": 11.66, "speed_mps": 8.3}
        else:
            link = {"kbps": 3200 + index % 7, "queue_ms": 3, "loss": 0, "state": "clear", "rtt_ms": 31}
            busy = {"busy_kbit": 120 + index % 7, "busy_s": 0.04, "kbit": 120 + index % 7, "wait_s": 0.003}
            yield {"t": t, "event": "link_measured", **link, "evidence": busy}


def seconds(modes: str, events: Path) -> float:
    """Best of some runs."""
    command = [sys.executable, "-m", "runner", "replay", "vehicle=tum_q7", f"modes={modes}", f"input={events}"]
    times = []
    for _ in range(RUNS):
        began = time.perf_counter()
        subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
        times.append(time.perf_counter() - began)
    return min(times)


def rows(count: int = 50_000) -> list[Row]:
    found = []
    with tempfile.TemporaryDirectory() as directory:
        for scenario in (predictions, drive):
            events = Path(directory) / f"{scenario.__name__}.jsonl"
            events.write_text("".join(json.dumps(event) + "\n" for event in scenario(count)))
            for modes in ("paper", "safe", "steady"):
                rate = count / seconds(modes, events)
                found.append(Row(f"replay of {scenario.__name__}, modes={modes}", rate, "events/s", least=LEAST_RATE))
    return found


if __name__ == "__main__":
    show(rows(*map(int, sys.argv[1:])))
