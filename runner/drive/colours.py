"""One colour per camera, the same as on the operator's page (runner/page/static/colours.js)."""

from __future__ import annotations

DAY = ("#0b6fae", "#6c2c00", "#10372c", "#8d744d", "#45154f", "#c24100", "#6106af", "#676d7f")
NIGHT = ("#56b4e9", "#ecac00", "#53f3c5", "#fff269", "#b46b99", "#ff7847", "#828af9", "#c4def9")

# By day, as style.css has them; late values have the colour of the sixth camera.
NAMED = {
    "predicted": "#a86a00",
    "allocated": "#0b6fae",
    "actual": "#10161c",
    "link": "#b3bec8",
    "late": DAY[5],
    "text": "#10161c",
}
