"""The report's page: one file that includes data, script and style, and loads nothing from other hosts."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from runner.drive.charts import Chart, Curve, Figure, MapTrack
from runner.drive.checks import ClaimCheck
from runner.drive.colours import DAY, NIGHT
from runner.drive.document import number, rules, when
from runner.drive.series import Series
from runner.drive.statistics import DriveStatistics
from runner.drive.tables import (
    LEGEND,
    SEEN,
    UPLINKS,
    VERDICTS,
    camera_rows,
    drive_rows,
    seen_rows,
    shown,
    uplink_rows,
)
from runner.drive.time_series import FloatSeries
from runner.system.files import plotly_script

STATIC = Path(__file__).parent / "static"
MOST_POINTS = 2000  # of a curve; longer ones are thinned
LAST_REASONS = 200
HtmlTable = tuple[Sequence[str], Sequence[Sequence[str]]]


def page(
    drives: Sequence[DriveStatistics],
    checks: Mapping[str, Sequence[ClaimCheck]],
    figures: Sequence[Figure],
    left_out: Sequence[str],
) -> str:
    """The whole page.

    checks   by label of a drive
    figures  those stored beside the page as .png and .pdf
    raises   RunError if plotly is not installed
    """
    title = " and ".join(drive.series.label for drive in drives)
    parts = {
        "title": escape(title),
        "style": (STATIC / "report.css").read_text(encoding="utf-8"),
        "plotly": _in_script(plotly_script("report").read_text(encoding="utf-8")),
        "data": _json(_data(figures)),
        "script": (STATIC / "report.js").read_text(encoding="utf-8"),
        "made": escape(f"tod-runner {version('tod-runner')} report"),
        "body": "\n".join(_body(drives, checks, figures, left_out)),
    }
    text = (STATIC / "report.html").read_text(encoding="utf-8")
    head, *rest = text.split("{{")
    # One pass: inserted text is not scanned again.
    return head + "".join(parts[key] + tail for key, tail in (each.split("}}", 1) for each in rest))


def _in_script(code: str) -> str:
    """JavaScript that cannot end the element that contains it."""
    return code.replace("</script", "<\\/script").replace("<!--", "<\\!--")


def _json(document: Any) -> str:
    """JSON that is safe inside a script element, whatever text it contains."""
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


# --- text and tables --------------------------------------------------------------------------------------------------


def _body(
    drives: Sequence[DriveStatistics],
    checks: Mapping[str, Sequence[ClaimCheck]],
    figures: Sequence[Figure],
    left_out: Sequence[str],
) -> Iterable[str]:
    several = len(drives) > 1
    yield from (_drive_section(drive, several=several) for drive in drives)
    if notes := _notes(drives, left_out):
        yield f"<section>{notes}</section>"
    if several:
        yield _section("Drives compared", _table("One row for each drive", drive_rows(drives)))
    for drive in drives:
        held = checks.get(drive.series.label)
        if held:
            rows = [(check.claim, check.outcome, VERDICTS[check.holds]) for check in held]
            heading = f"Claims of the paper and results{_suffix(drive, several)}"
            yield _section(heading, _table("Claims", (("claim", "result", "holds"), rows)))
    yield f'<div class="figures{"" if several else " single"}">'
    yield from (_figure(figure) for figure in figures)
    yield "</div>"
    for drive in drives:
        yield _section(f"Cameras{_suffix(drive, several)}", _table("Statistics by camera", camera_rows(drive)))
        if drive.uplinks:
            table = _table("Statistics by uplink", uplink_rows(drive))
            yield _section(f"Uplinks{_suffix(drive, several)}", f'{table}<p class="muted">{escape(UPLINKS)}</p>')
        if drive.seen:
            table = _table("What the driver saw", seen_rows(drive.seen))
            yield _section(f"On the screen{_suffix(drive, several)}", f'{table}<p class="muted">{escape(SEEN)}</p>')
    yield f'<p class="muted">{escape(LEGEND)}</p>'
    yield from (_reasons(drive, _suffix(drive, several)) for drive in drives)
    named = ((each, f"{side}{_suffix(drive, several)}") for drive in drives for side, each in _versions(drive))
    versions = _grouped(named)
    yield _section("Versions", _list((", ".join(labels), each) for each, labels in versions.items()))


def _notes(drives: Sequence[DriveStatistics], left_out: Sequence[str]) -> str:
    """Notes of the drives, each note once."""
    noted = _grouped((each, drive.series.label) for drive in drives for each in (*drive.series.warnings, *drive.notes))
    notes = [note if len(labels) == len(drives) else f"{', '.join(labels)}: {note}" for note, labels in noted.items()]
    items = "".join(f"<li>{escape(each)}</li>" for each in (*notes, *left_out))
    return f'<ul class="warnings" aria-label="Notes">{items}</ul>' if items else ""


def _grouped(notes: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Each text once, with the labels of its drives."""
    found: dict[str, list[str]] = {}
    for text, label in notes:
        found.setdefault(text, []).append(label)
    return found


def _list(facts: Iterable[tuple[str, str]]) -> str:
    listed = "".join(f"<div><dt>{escape(key)}</dt><dd>{escape(value)}</dd></div>" for key, value in facts)
    return f"<dl>{listed}</dl>"


def _suffix(drive: DriveStatistics, several: bool) -> str:
    return f": {drive.series.label}" if several else ""


def _section(heading: str, content: str) -> str:
    return f"<section><h2>{escape(heading)}</h2>{content}</section>"


def _table(caption: str, table: HtmlTable, more: str = "") -> str:
    """A table that can be scrolled with the keyboard."""
    headings, rows = table
    head = "".join(f'<th scope="col">{escape(each)}</th>' for each in headings)
    body = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>' + "".join(f"<td>{escape(each)}</td>" for each in row[1:]) + "</tr>"
        for row in rows
    )
    region = f'class="scroll{more}" tabindex="0" role="region" aria-label="{escape(caption)}"'
    return (
        f'<div {region}><table><caption class="unseen">{escape(caption)}</caption>'
        f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _drive_section(drive: DriveStatistics, *, several: bool) -> str:
    """Facts about a drive: vehicle, time, rates, modes, rules, and how it ended."""
    series = drive.series
    ends = ", ".join(f"{side}: {'ended cleanly' if clean else 'cut off'}" for side, clean in series.ended.items())
    facts = [
        ("vehicle", series.vehicle or "-"),
        ("began", when(series)),
        ("length", f"{series.end:.1f} s"),
        ("logs", ends),
        ("predicted", f"{shown(drive.predicted_min)} to {shown(drive.predicted_max)} kbit/s"),
        ("allocated, mean", f"{shown(drive.allocated)} kbit/s"),
        *([(f"{series.measured}, mean", f"{shown(drive.kbps)} kbit/s")] if series.measured else []),
        ("modes", ", ".join(f"{mode} from {t:.1f} s" for t, mode in series.modes)),
        ("rules", _rules(series)),
        ("refused requests", str(series.refused)),
    ]
    if series.replayed is not None:
        facts.insert(1, ("replayed with", " ".join(series.replayed) or "nothing changed"))
    for lane, link in series.links.items():
        facts.append((f"dropped on {f'lane {lane}' if lane else 'the link'}", f"{link.dropped[-1]:.0f} packets"))
    return _section(series.label if several else "Drive", _list(facts))


def _rules(series: Series) -> str:
    """Rules of the modes that were in force."""
    known = rules(series)
    used = dict.fromkeys(mode for _, mode in series.modes)
    return "; ".join(f"{mode}: {', '.join(known[mode])}" for mode in used if mode in known) or "-"


def _versions(drive: DriveStatistics) -> Iterable[tuple[str, str]]:
    """Software versions by side."""
    for side, versions in drive.series.versions.items():
        yield side, ", ".join(f"{name} {version}" for name, version in versions.items()) or "-"


def _figure(figure: Figure) -> str:
    links = " ".join(f'<a href="{figure.name}.{form}" download>{form.upper()}</a>' for form in ("png", "pdf"))
    charts = "".join(
        f'<figure><figcaption>{escape(chart.title)}</figcaption><div class="chart {figure.name}" '
        f'data-figure="{figure.name}" data-drive="{chart.drive or 0}" data-part="{chart.part}"></div></figure>'
        for chart in chain.from_iterable(figure.rows)
    )
    heading = f'<div class="head"><h2>{figure.heading}</h2><span class="files">{links}</span></div>'
    return f'<section class="figure" id="{figure.name}">{heading}<div class="charts">{charts}</div></section>'


def _reasons(drive: DriveStatistics, of: str) -> str:
    """The last changes with their reasons, and the notes."""
    last = drive.series.reasons[-LAST_REASONS:]
    rows = [(f"{each.t:.1f}", each.camera, each.reason, each.cause) for each in reversed(last)]
    caption = f"the last {len(rows)} of {len(drive.series.reasons)} changes of factor or sending, newest first"
    parts = [f'<p class="muted">{caption}</p>', _table("Decisions", (("s", "camera", "why", "after"), rows), " tall")]
    if drive.series.notes:
        notes = [(f"{t:.1f}", text) for t, text in reversed(drive.series.notes[-LAST_REASONS:])]
        parts.append(_table("Notes", (("s", "note"), notes), " tall"))
    return _section(f"Decisions{of}", "".join(parts))


# --- data of the charts -----------------------------------------------------------------------------------------------


def _data(figures: Sequence[Figure]) -> dict[str, Any]:
    charts = [_chart(chart) for figure in figures for chart in chain.from_iterable(figure.rows)]
    return {"day": DAY, "night": NIGHT, "charts": charts}


def _chart(chart: Chart) -> dict[str, Any]:
    return {
        "x": chart.x._asdict(),
        "y": chart.y._asdict(),
        "drive": chart.drive,
        "unit_s": chart.unit_s,
        "hover": chart.hover,
        "curves": [_curve(curve) for curve in chart.curves],
        "shades": [shade._asdict() for shade in chart.shades],
        "strip": chart.strip and {"bars": [bars._asdict() for bars in chart.strip.bars], "none": chart.strip.none},
        "track": chart.track and _track(chart.track),
    }


def _curve(curve: Curve) -> dict[str, Any]:
    """A thinned curve; steps are kept where they change, and at their end."""
    keys = ("label", "colour", "dash", "width", "steps", "filled", "points")
    x, y = curve.x, curve.y
    kept = np.zeros(x.shape, dtype=bool)
    kept[:: 1 + len(x) // MOST_POINTS] = True
    if curve.steps and x.size:
        changed = np.append(True, ~np.isclose(y[1:], y[:-1], equal_nan=True))
        last = np.append(np.isnan(y[1:]), False)  # a step is drawn up to the next known value
        kept = changed | last | (kept if curve.reasons else False)
        kept[-1] = True
    around = curve.around and [_rounded(side[kept]) for side in curve.around]
    why = [curve.reasons[at] for at in np.flatnonzero(kept)] if curve.reasons else None
    points = {"x": _rounded(x[kept]), "y": _rounded(y[kept]), "around": around, "why": why}
    return {key: getattr(curve, key) for key in keys} | points


def _track(track: MapTrack) -> dict[str, Any]:
    each, every = 1 + len(track.t) // MOST_POINTS, 1 + len(track.way[0]) // MOST_POINTS
    columns = {key: _rounded(getattr(track, key)[::each]) for key in ("t", "east", "north", "values")}
    way = [_rounded(side[::every]) for side in track.way]
    return columns | {"way": way, "low": track.low, "high": track.high, "title": track.title, "arrows": track.arrows}


def _rounded(values: FloatSeries) -> list[float | None]:
    return [number(float(f"{value:.6g}"), 6) for value in values.tolist()]
