"""Processes whose memory bench/memory.py compares. They import nothing but what they measure.

python bench/memory_steps.py vehicle WORDS...   the vehicle's side, step by step, with viewers for one camera after the
                                                other; prints the growth of each step, MB, as JSON
python bench/memory_steps.py pipeline LINE      a playing pipeline in gst-launch's syntax; prints its memory, MB
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from usage import memory_mb

SETTLE_S = 3.0  # until a pipeline has filled its pools, and the encoder its reference pictures


class Steps:
    """What each step added to the resident memory of this process, MB."""

    def __init__(self) -> None:
        self.growth: dict[str, float] = {}

    def measure(self, what: str) -> None:
        self.growth[what] = memory_mb(os.getpid()) - sum(self.growth.values())


def vehicle(*words: str) -> None:
    steps = Steps()
    steps.measure("Python")
    from runner.live import live_vehicle

    steps.measure("modules of the project and its libraries")
    from runner.apply import check_vehicle

    steps.measure("GStreamer and its bindings")
    from runner.configuration.config import configuration

    described = configuration(words, check=check_vehicle).setup()
    steps.measure("configuration composed, plugins loaded")
    with ExitStack() as stack:
        live = stack.enter_context(live_vehicle(words, say=lambda _: None))
        live.start()
        time.sleep(SETTLE_S)
        steps.measure("server, control loop and link")
        for name in described.vehicle.cameras:
            stack.enter_context(_viewer(f"rtsp://127.0.0.1:{described.media.port}/{name}"))
            time.sleep(SETTLE_S)
            steps.measure(f"camera {name}, watched")
    print(json.dumps(steps.growth))


def pipeline(line: str) -> None:
    import gi

    gi.require_version("Gst", "1.0")
    from gi.repository import Gst

    Gst.init(None)
    playing = Gst.parse_launch(line)
    playing.set_state(Gst.State.PLAYING)
    failed = playing.get_bus().timed_pop_filtered(int(SETTLE_S * Gst.SECOND), Gst.MessageType.ERROR)
    if failed:
        sys.exit(failed.parse_error().gerror.message)
    print(json.dumps(memory_mb(os.getpid())))
    playing.set_state(Gst.State.NULL)


@contextmanager
def _viewer(url: str) -> Iterator[None]:
    """A viewer in a process of its own, from its first frame on."""
    command = [sys.executable, Path(__file__).parent / "bare.py", "watch", url]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as client:
        try:
            assert client.stdout
            if not client.stdout.readline():
                sys.exit(f"{url}: its viewer ended without a frame")
            yield
        finally:
            client.kill()


if __name__ == "__main__":
    {"vehicle": vehicle, "pipeline": pipeline}[sys.argv[1]](*sys.argv[2:])
