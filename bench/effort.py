"""What the encoder's efforts cost and give, as `tod-runner model` measures it with graph.effort=low, medium and high.

  python bench/effort.py CLIP...                 with frames that are worth encoding: recorded ones

Each clip is scaled to half of its size and encoded at two bitrates. Printed: processor time of the encoder for a frame,
as a ratio to medium, and the difference of MSSIM, on all pictures of the clip.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import fmean, median
from typing import Any

from table import Row, show

EFFORTS, USUAL = ("low", "medium", "high"), "medium"
STUDY = ("scalings=[0.5]", "bitrates_kbps=[250,800]", "plan=full", "metric_every=4")
RUNS = 3  # of each encoding, of which the median counts

Points = dict[int, tuple[float, float]]  # by kbit/s: processor time of the encoder, ms a frame, and MSSIM


def measured(clip: Path, effort: str) -> Points:
    runs = [_once(clip, effort) for _ in range(RUNS)]
    return {kbps: (median(run[kbps][0] for run in runs), runs[0][kbps][1]) for kbps in runs[0]}


def _once(clip: Path, effort: str) -> Points:
    with tempfile.TemporaryDirectory() as name:
        output = Path(name) / "model"
        words = ("camera=front_center", f"sequence={clip}", f"output={output}", f"graph.effort={effort}", *STUDY)
        command = [sys.executable, "-m", "runner", "model", *words]
        environment = {**os.environ, "XDG_CACHE_HOME": name}  # nothing has been measured yet
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)
        document: dict[str, Any] = json.loads((output / "front_center.model.json").read_text())
    return {point["target_kbps"]: (point["encode_ms"], point["mssim"]) for point in document["points"]}


def rows(clips: list[Path]) -> list[Row]:
    by_effort = {effort: [measured(clip, effort) for clip in clips] for effort in EFFORTS}
    usual = by_effort[USUAL]
    found = []
    for effort, of_clips in by_effort.items():
        pairs = [
            (points[kbps], before[kbps]) for points, before in zip(of_clips, usual, strict=True) for kbps in points
        ]
        worse = [mine[1] - medium[1] for mine, medium in pairs]
        note = f"MSSIM {min(worse):+.4f} to {max(worse):+.4f}, mean {fmean(worse):+.4f}, beside {USUAL}"
        mine, medium = (fmean(pair[side][0] for pair in pairs) for side in (0, 1))
        found.append(Row(f"encoder, {effort} ({mine / medium:.2f} of {USUAL})", mine, "ms/frame", note=note))
    return found


if __name__ == "__main__":
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    show(rows([Path(word).resolve() for word in sys.argv[1:]]))
