"""Everything here needs GStreamer, and most of it lives by the clock.

`pytest -m "not gst"` leaves out what needs GStreamer. `make test` runs a few files at a time of what is marked `timed`,
then, one by one, the tests marked `alone`, whose limits are tight. Everything else runs on the processor time that
these leave over.
"""

from collections.abc import Iterator

import pytest

from rig import free_port
from runner.core.model import Endpoint
from runner.mqtt.broker import private_broker

UNTIMED = ("test_keyframe", "test_model", "test_report_page", "test_video_files")


def pytest_itemcollected(item: pytest.Item) -> None:
    item.add_marker("gst")
    if item.path.stem not in UNTIMED and not item.get_closest_marker("alone"):
        item.add_marker("timed")


@pytest.fixture
def broker() -> Iterator[Endpoint]:
    """Address of a broker of the test's own."""
    endpoint = Endpoint("127.0.0.1", free_port())
    with private_broker(endpoint):
        yield endpoint
