"""Everything here needs GStreamer: `pytest -m "not gst"` leaves it out."""

from pathlib import Path

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(item.fspath).parent.name == "integration":
            item.add_marker("gst")
