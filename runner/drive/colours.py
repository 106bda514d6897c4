"""One colour per camera, the same as on the operator's page (runner/page/static/colours.js), after Okabe and Ito."""

from __future__ import annotations

DAY = ("#0b6fae", "#a86a00", "#00785a", "#7a6f00", "#a3478a", "#c24100", "#4a4fc4", "#4b5560")
NIGHT = ("#56b4e9", "#e69f00", "#2fc59a", "#f0e442", "#d98cc0", "#ff7847", "#9aa5ff", "#c9ced4")

# By day, as style.css has them; late values have the colour of the sixth camera.
NAMED = {
    "predicted": "#a86a00",
    "allocated": "#0b6fae",
    "actual": "#10161c",
    "link": "#b3bec8",
    "late": DAY[5],
    "text": "#10161c",
}
