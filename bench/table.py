"""One table and one JSON document of all figures, with machine and date."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from runner.operator.meter import middle, percentile
from runner.system.files import write_whole

WIDTH = 58  # of the names


class Row(NamedTuple):
    """A figure.

    bare         the same for bare GStreamer; None: it has no counterpart
    least, most  limits of what is acceptable
    note         further information, such as the spread
    """

    what: str
    value: float
    unit: str
    bare: float | None = None
    least: float | None = None
    most: float | None = None
    note: str = ""

    @property
    def ratio(self) -> float | None:
        return self.value / self.bare if self.bare else None

    @property
    def is_acceptable(self) -> bool:
        return (self.least is None or self.value >= self.least) and (self.most is None or self.value <= self.most)


def show(rows: Sequence[Row]) -> None:
    print(f"{'':{WIDTH}} {'tod-runner':>10} {'bare':>10} {'ratio':>6}")
    for row in rows:
        bare = "" if row.bare is None else f"{row.bare:.3g}"
        ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
        limits = [f"{word} {limit:g}" for word, limit in (("at least", row.least), ("at most", row.most)) if limit]
        notes = "; ".join([*filter(None, [row.note]), *limits, *([] if row.is_acceptable else ["MISSED"])])
        print(f"{row.what:{WIDTH}} {_short(row.value):>10} {bare:>10} {ratio:>6} {row.unit:9} {notes}".rstrip())


def spread(what: str, values: Sequence[float], unit: str) -> Row:
    """The median, with higher percentiles in the note."""
    shares = ", ".join(f"{name} {percentile(values, share):.1f}" for name, share in (("p95", 0.95), ("p99", 0.99)))
    return Row(what, middle(values), unit, note=f"{shares}, max {max(values):.1f} of {len(values)}")


def as_json(rows: Sequence[Row]) -> dict[str, Any]:
    return {"date": datetime.now(UTC).isoformat(timespec="seconds"), "machine": machine(),
            "rows": [{**row._asdict(), "ratio": row.ratio} for row in rows]}  # fmt: skip


def write(rows: Sequence[Row], path: Path) -> None:
    write_whole(path, (json.dumps(as_json(rows), indent=2) + "\n").encode())


def machine() -> dict[str, Any]:
    """The hardware and software that the figures depend on."""
    cpu = next((line.partition(":")[2].strip() for line in Path("/proc/cpuinfo").read_text().splitlines()
                if line.startswith("model name")), platform.machine())  # fmt: skip
    gst = subprocess.run(["gst-launch-1.0", "--version"], capture_output=True, text=True, check=False).stdout
    version = next((line.split()[-1] for line in gst.splitlines() if line.startswith("GStreamer")), "unknown")
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "memory_gb": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9),
        "system": platform.platform(),
        "python": platform.python_version(),
        "gstreamer": version,
    }


def _short(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.3g}"
