"""One colour per camera, the same as on the operator's page (runner/page/static/colours.js), after Okabe and Ito."""

from __future__ import annotations

from collections.abc import Iterable

DAY = ("#0b6fae", "#a86a00", "#00785a", "#7a6f00", "#a3478a", "#c24100", "#4a4fc4", "#4b5560")
NIGHT = ("#56b4e9", "#e69f00", "#2fc59a", "#f0e442", "#d98cc0", "#ff7847", "#9aa5ff", "#c9ced4")

PREDICTED, ALLOCATED, ACTUAL, LINK = "#a86a00", "#0b6fae", "#10161c", "#b3bec8"  # style.css, by day


def colours(cameras: Iterable[str]) -> dict[str, str]:
    """On a light ground, by camera in the configuration's order."""
    return {name: DAY[index % len(DAY)] for index, name in enumerate(cameras)}
