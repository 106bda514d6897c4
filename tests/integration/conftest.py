"""What runs here needs GStreamer, and most of it the machine for itself.

`pytest -m "not gst"` leaves out what needs GStreamer. `make test` runs what is marked `alone` by itself, and the rest
on all cores.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest

from rig import free_port
from runner.core.model import Endpoint
from runner.mqtt.broker import private_broker

BESIDE_OTHERS = ("test_keyframe", "test_model", "test_report_page", "test_video_files")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        path = Path(item.fspath)
        if path.parent.name == "integration":
            item.add_marker("gst")
            if path.stem not in BESIDE_OTHERS:
                item.add_marker("alone")


@pytest.fixture
def broker() -> Iterator[Endpoint]:
    """Address of a broker of the test's own."""
    endpoint = Endpoint("127.0.0.1", free_port())
    with private_broker(endpoint):
        yield endpoint
