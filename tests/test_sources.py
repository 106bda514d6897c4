"""A view that cannot be rendered is a mistake in the configuration, reported before anything starts."""

from __future__ import annotations

import pytest

from runner.configuration.config import configuration
from runner.errors import ConfigError

LENS = "must lie in ]0, 170] for a pinhole, ]0, 360] for a fisheye"


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("cameras.front_left.fov_deg=200", f"command line: cameras.front_left.fov_deg: 200: {LENS}"),
        (
            "cameras.rear_center.pose.z_m=-1",
            "command line: cameras.rear_center.pose.z_m: z_m -1, fps 40: must be above 0",
        ),
    ],
)
def test_a_camera_that_the_drive_cannot_show(override: str, line: str) -> None:
    with pytest.raises(ConfigError) as raised:
        configuration(["source=synthetic", override]).vehicle()
    assert str(raised.value) == f"{line}\n1 problem, nothing was started"
    configuration(["source=test", override]).vehicle()  # other sources accept it
