"""The report's page: one file with data, script and style in it, which asks no other host for anything."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from runner.drive.checks import Check
from runner.drive.colours import DAY, NIGHT
from runner.drive.document import number, rules, when
from runner.drive.figures import METRICS, has_latency, has_quality, on_track
from runner.drive.series import CameraSeries, Line, Series, Values
from runner.drive.statistics import Statistics, latencies, per_second, to_arrival
from runner.drive.tables import MEANING, VERDICTS, camera_rows, drive_rows, shown
from runner.errors import RunError

STATIC = Path(__file__).parent / "static"
MOST_POINTS = 2000  # of a curve; longer ones are thinned
QUANTILES = np.concatenate([np.linspace(0, 0.95, 96), np.linspace(0.951, 1, 50)])
LAST_REASONS = 200
HEADINGS = {
    "bitrate_on_track": "Total bitrate on the track",
    "totals": "Predicted, allocated and actual total",
    "bitrates": "Camera bitrates over time",
    "scaling": "Resolution factors over time",
    "latency": "Latency and freezes",
    "quality": "Estimated quality over time",
}

Table = tuple[Sequence[str], Sequence[Sequence[str]]]


def page(
    drives: Sequence[Statistics],
    checks: Mapping[str, Sequence[Check]],
    figures: Sequence[str],
    left_out: Sequence[str],
) -> str:
    """The whole page.

    checks   by label of a drive
    figures  names of those that lie beside the page as .png and .pdf
    raises   RunError where plotly is not installed
    """
    title = " and ".join(drive.series.label for drive in drives)
    parts = {
        "title": escape(title),
        "style": (STATIC / "report.css").read_text(encoding="utf-8"),
        "plotly": _in_script(_plotly()),
        "data": _json(_data(drives)),
        "script": (STATIC / "report.js").read_text(encoding="utf-8"),
        "made": escape(f"tod-runner {version('tod-runner')} report"),
        "body": "\n".join(_body(drives, checks, figures, left_out)),
    }
    text = (STATIC / "report.html").read_text(encoding="utf-8")
    head, *rest = text.split("{{")
    # One pass: nothing that was filled in is looked at again.
    return head + "".join(parts[key] + tail for key, tail in (each.split("}}", 1) for each in rest))


def _plotly() -> str:
    """The script that plotly's wheel brings."""
    spec = find_spec("plotly")
    if spec is None or spec.origin is None:
        raise RunError("the Python module plotly is not installed: pip install 'tod-runner[report]'")
    return (Path(spec.origin).parent / "package_data" / "plotly.min.js").read_text(encoding="utf-8")


def _in_script(code: str) -> str:
    """JavaScript that cannot end the element it stands in."""
    return code.replace("</script", "<\\/script").replace("<!--", "<\\!--")


def _json(document: Any) -> str:
    """JSON that may stand inside a script element, whatever text it holds."""
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")


# --- text and tables --------------------------------------------------------------------------------------------------


def _body(
    drives: Sequence[Statistics],
    checks: Mapping[str, Sequence[Check]],
    figures: Sequence[str],
    left_out: Sequence[str],
) -> Iterable[str]:
    several = len(drives) > 1
    yield from (_about(drive, several=several) for drive in drives)
    if several:
        yield _section("Drives beside each other", _table("One row for each drive", drive_rows(drives)))
    for drive in drives:
        held = checks.get(drive.series.label)
        if held:
            rows = [(check.claim, check.outcome, VERDICTS[check.holds]) for check in held]
            heading = f"What the paper reports and what came out{_of(drive, several)}"
            yield _section(heading, _table("Claims", (("claim", "came out", "holds"), rows)))
    yield f'<div class="figures{"" if several else " single"}">'
    yield from (_figure(name, drives) for name in HEADINGS if name in figures)
    yield "</div>"
    if left_out:
        yield "".join(f'<p class="muted">{escape(each)}</p>' for each in left_out)
    meaning = f'<p class="muted">{escape(MEANING)}</p>'
    for drive in drives:
        yield _section(f"Cameras{_of(drive, several)}", _table("Statistics by camera", camera_rows(drive)) + meaning)
        yield _reasons(drive, _of(drive, several))


def _of(drive: Statistics, several: bool) -> str:
    return f": {drive.series.label}" if several else ""


def _section(heading: str, content: str) -> str:
    return f"<section><h2>{escape(heading)}</h2>{content}</section>"


def _table(caption: str, table: Table, more: str = "") -> str:
    """A table that the keyboard can scroll."""
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


def _about(drive: Statistics, *, several: bool) -> str:
    """What was driven, when, with what, and how it ended."""
    series = drive.series
    ends = ", ".join(f"{side}: {'ended cleanly' if clean else 'cut off'}" for side, clean in series.ended.items())
    facts = [
        ("vehicle", series.vehicle or "-"),
        ("began", when(series)),
        ("length", f"{series.end:.1f} s"),
        ("logs", ends),
        ("predicted", f"{shown(drive.predicted_min)} to {shown(drive.predicted_max)} kbit/s"),
        ("allocated, mean", f"{shown(drive.allocated)} kbit/s"),
        (f"{series.measured or 'actual'}, mean", f"{shown(drive.kbps)} kbit/s"),
        ("modes", ", ".join(f"{mode} from {t:.1f} s" for t, mode in series.modes)),
        ("rules", _rules(series)),
        ("refused requests", str(series.refused)),
    ]
    if series.link:
        facts.append(("dropped on the link", f"{series.link.dropped[-1]:.0f} packets"))
    facts += [(heading, ", ".join(f"{k} {v}" for k, v in each.items())) for heading, each in _versions(series)]
    listed = "".join(f"<div><dt>{escape(key)}</dt><dd>{escape(str(value))}</dd></div>" for key, value in facts)
    told = "".join(f"<li>{escape(each)}</li>" for each in (*series.warnings, *drive.notes))
    notes = f'<ul class="warnings" aria-label="What to know">{told}</ul>' if told else ""
    return _section(series.label if several else "Drive", f"<dl>{listed}</dl>{notes}")


def _rules(series: Series) -> str:
    """Those of the modes that were in force."""
    known = rules(series)
    used = dict.fromkeys(mode for _, mode in series.modes)
    return "; ".join(f"{mode}: {', '.join(known[mode])}" for mode in used if mode in known) or "-"


def _versions(series: Series) -> list[tuple[str, Mapping[str, str]]]:
    """By heading, for each side, or once where all are the same."""
    sides = [(side, each) for side, each in series.versions.items() if each]
    if sides and all(each == sides[0][1] for _, each in sides):
        return [("versions", sides[0][1])]
    return [(f"versions, {side}", each) for side, each in sides]


def _figure(name: str, drives: Sequence[Statistics]) -> str:
    links = " ".join(f'<a href="{name}.{form}" download>{form.upper()}</a>' for form in ("png", "pdf"))
    charts = "".join(
        f'<figure><figcaption>{escape(caption)}</figcaption><div class="chart {name}" data-figure="{name}" '
        f'data-drive="{index}" data-part="{part}"></div></figure>'
        for index, part, caption in _charts(name, drives)
    )
    heading = f'<div class="head"><h2>{HEADINGS[name]}</h2><span class="files">{links}</span></div>'
    return f'<section class="figure" id="{name}">{heading}<div class="charts">{charts}</div></section>'


def _charts(name: str, drives: Sequence[Statistics]) -> Iterable[tuple[int, int, str]]:
    """Drive, part and caption of each chart of a figure."""
    several = len(drives) > 1
    for index, drive in enumerate(drives):
        label = drive.series.label if several else ""
        if (name == "latency" and not has_latency(drive)) or (name == "quality" and not has_quality(drive)):
            continue
        if name in ("bitrates", "scaling", "quality"):
            for part, panel in enumerate(drive.series.panels):
                yield index, part, ": ".join(filter(None, (label, panel.title)))
        elif name == "latency":
            yield index, 0, ": ".join(filter(None, (label, "each second, all cameras")))
            if not several:
                yield index, 1, "distribution"
        elif name != "bitrate_on_track" or drive.series.positions:
            yield index, 0, label
    if name == "latency" and several:
        yield 0, 1, "distribution, all cameras"


def _reasons(drive: Statistics, of: str) -> str:
    """The last changes and why; and what was noted."""
    last = drive.series.reasons[-LAST_REASONS:]
    rows = [(f"{each.t:.1f}", each.camera, each.reason, each.cause) for each in reversed(last)]
    told = f"the last {len(rows)} of {len(drive.series.reasons)} changes of factor or sending, newest first"
    parts = [f'<p class="muted">{told}</p>', _table("Decisions", (("s", "camera", "why", "after"), rows), " tall")]
    if drive.series.notes:
        notes = [(f"{t:.1f}", text) for t, text in reversed(drive.series.notes[-LAST_REASONS:])]
        parts.append(_table("Notes", (("s", "note"), notes), " tall"))
    return _section(f"Decisions{of}", "".join(parts))


# --- data of the charts -----------------------------------------------------------------------------------------------


def _data(drives: Sequence[Statistics]) -> dict[str, Any]:
    metrics = sorted({camera.quality.metric for d in drives for camera in d.cameras.values() if camera.quality})
    return {
        "day": DAY,
        "night": NIGHT,
        "end": max(drive.series.end for drive in drives),
        "metric": METRICS.get(metrics[0], metrics[0]) if metrics else "",
        "drives": [_drive(drive, metrics[0] if metrics else "") for drive in drives],
    }


def _drive(drive: Statistics, metric: str) -> dict[str, Any]:
    series = drive.series
    seconds = per_second(series)
    frozen = [(camera.name, f) for camera in drive.cameras.values() for f in camera.freezes or ()]
    return {
        "label": series.label,
        "measured": series.measured,
        "panels": [list(panel.cameras) for panel in series.panels],
        "cameras": {name: _camera(camera, drive, metric) for name, camera in series.cameras.items()},
        "predicted": _steps(series.predicted, series.end),
        "allocated": _steps(series.allocated, series.end),
        "actual": _points(series.actual),
        "link": _steps(Line(series.link.t, series.link.kbps), series.end) if series.link else None,
        "latency": {
            "of": "arrival" if to_arrival(series) else "decode",
            "t": _rounded(seconds.t, 1),
            "median": _rounded(seconds.median, 1),
            "p95": _rounded(seconds.p95, 1),
            "all": _quantiles(latencies(series)[1]),
            "watched": drive.freezes is not None,
            "freezes": [{"camera": name, "t": number(f.t, 3), "s": number(f.seconds, 3)} for name, f in frozen],
        },
        "shares": _rounded(QUANTILES, 4),
        "track": _track(series),
    }


def _camera(camera: CameraSeries, drive: Statistics, metric: str) -> dict[str, Any]:
    quality = drive.cameras[camera.name].quality
    return {
        "actual": _points(camera.actual),
        "allocated": _steps(Line(camera.decided.t, camera.decided.kbps), drive.series.end),
        "factor": _factor(camera, drive.series.end),
        "latency": _quantiles(latencies(drive.series, camera.name)[1]),
        "quality": _points(quality.line, 4) if quality and quality.metric == metric else None,
    }


def _factor(camera: CameraSeries, end: float) -> dict[str, Any]:
    """Steps with the reason in force; changes of the factor are kept however many there are."""
    decided = camera.decided
    values = np.where(decided.sending, decided.scaling, np.nan)
    before = np.concatenate([[-1.0], values[:-1]])
    kept = ~((values == before) | (np.isnan(values) & np.isnan(before)))
    kept[:: _stride(len(values))] = True
    at = np.flatnonzero(kept)
    t, reason = np.append(decided.t[at], end), [decided.reason[i] for i in [*at, at[-1]]] if at.size else []
    y = np.append(values[at], values[at[-1]]) if at.size else values
    return {"t": _rounded(t if at.size else decided.t, 2), "y": _rounded(y, 4), "why": reason}


def _track(series: Series) -> dict[str, Any] | None:
    if series.positions is None:
        return None
    t, east, north, kbps = on_track(series)
    places = series.positions
    each, every = _stride(len(t)), _stride(len(places.t))
    way = {"x": _rounded(places.east[::every], 1), "y": _rounded(places.north[::every], 1)}
    columns = {"t": (t, 2), "x": (east, 1), "y": (north, 1), "kbps": (kbps, 0)}
    return {key: _rounded(values[::each], digits) for key, (values, digits) in columns.items()} | {"way": way}


def _quantiles(values: Values) -> list[float | None]:
    return _rounded(np.quantile(values, QUANTILES), 1) if values.size else []


def _points(line: Line, digits: int = 1) -> dict[str, Any]:
    each = _stride(len(line.t))
    return {"t": _rounded(line.t[::each], 2), "y": _rounded(line.y[::each], digits)}


def _steps(line: Line, end: float) -> dict[str, Any]:
    """Where a quantity whose values hold until the next changes, and its end."""
    if not line.t.size:
        return {"t": [], "y": []}
    kept = np.append(True, ~np.isclose(line.y[1:], line.y[:-1], equal_nan=True))
    t, y = np.append(line.t[kept], max(end, line.t[-1])), np.append(line.y[kept], line.y[-1])
    return {"t": _rounded(t, 2), "y": _rounded(y, 1)}


def _stride(count: int) -> int:
    return 1 + count // MOST_POINTS


def _rounded(values: Values, digits: int) -> list[float | None]:
    return [number(value, digits) for value in values.tolist()]
