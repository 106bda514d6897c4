"""What runs here needs GStreamer, and most of it the machine for itself.

`pytest -m "not gst"` leaves out what needs GStreamer. `make test` runs what is marked `alone` by itself, and the rest
on all cores.
"""

from pathlib import Path

import pytest

BESIDE_OTHERS = ("test_keyframe", "test_model", "test_report_page", "test_video_files")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        path = Path(item.fspath)
        if path.parent.name == "integration":
            item.add_marker("gst")
            if path.stem not in BESIDE_OTHERS:
                item.add_marker("alone")
