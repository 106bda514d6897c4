"""One colour per camera, the same as on the operator's page (runner/page/static/colours.js)."""

from __future__ import annotations

DAY = ("#1034c9", "#7f8502", "#ff0b7a", "#18530b", "#bf46fe", "#7d5f56", "#2c918b", "#880f5c")
NIGHT = ("#8d6bfb", "#f3f123", "#ff078c", "#74901e", "#d2d3fd", "#e6ad83", "#139695", "#94fede")

# By day, as style.css of the page and report.css have them.
NAMED = {
    "predicted": "#a86a00",
    "allocated": "#0b6fae",
    "actual": "#10161c",
    "link": "#b3bec8",
    "late": "#c24100",
    "text": "#10161c",
}
