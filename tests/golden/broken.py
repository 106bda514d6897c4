"""One hundred configuration files, each with one mistake: packaged files, and the text to replace in each.

`directories` groups them into users' directories. Mistakes that a schema sees end `validate` before anything is
composed, so they share a directory; the others have one per group, since vehicles, graphs and sources are combined.

Graphs and modes are taken from conf/ beside this file: they state each list in full, as do users' files that
were written before graphs and modes could build on each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

Edit = tuple[str, str]
WHOLE_LISTS = Path(__file__).resolve().parent / "conf"

SCHEMA: Mapping[str, Sequence[Edit]] = {
    "cameras/wide_720p": [
        ("fps: 30", "fsp: 30"),
        ("fps: 30", "fps: -1"),
        ("fps: 30", "fps: thirty"),
        ("fps: 30\n", ""),
        ("width_px: 1280\nheight", "width_px: 1e9\nheight"),
        ("height_px: 720", "height_px: 0"),
        ("height_px: 720", "height_px: 720.5"),
        ("top_px: 120", "top_px: -2"),
        ("left_px: 0", "left_px: 0\n  right_px: 0"),
        ("b_full_kbps: 4000", "b_full_kbps: -4000"),
        ("b_full_kbps: 4000", "b_full: 4000"),
        ("[0.25, 0.5, 0.75, 1.0]", "[]"),
        ("[0.25, 0.5, 0.75, 1.0]", "[0.25, 0.5, 0.75, 1.5]"),
        ("[0.25, 0.5, 0.75, 1.0]", "0.25"),
        ("[0, 250, 900, 2000]", "[0, 250, x, 2000]"),
        ("fov_deg: 100", "fov_deg: 400"),
        ("fov_deg: 100", "lens: telephoto"),
        ("rate_quality:", "rate-quality:"),
        ("fps: 30", "fps: 30\nfps: 25"),
        ("fps: 30", "fps: [30"),
    ],
    "modes/safe": [
        ("single:", "singel:"),
        ("single:\n", "single: demand_from_roi\nsolo:\n"),
        ("  share_by_demand: {}", "  share_by_demand"),
        ("  share_by_demand: {}", "  share_by_demand: [{other: {}}]"),
        ("{start_kbps: 3000}", "3000"),
    ],
    "graph/h264_rtsp": [
        ("transport: rtsp", "transport: rtps"),
        ("transport: rtsp", "transport: 1"),
        ("mtu_bytes: 1200", "mtu_bytes: 12"),
        ("jitter_buffer_ms: 40", "jitter_buffer_ms: -40"),
        ("first_port: 5600 ", "first_port: 99999 "),
        ("knobs:\n", "knob:\n"),
        ("  sending: [", "  send: ["),
        ("{name: crop, element: videocrop}", "{name: crop, factory: videocrop}"),
        ("{name: crop, element: videocrop}", "{element: videocrop}"),
        ("{name: crop, element: videocrop}", "videocrop"),
        ("value: kbps", "value: kilobits"),
        ("property: bitrate, ", ""),
    ],
    "source/file": [
        ("clip: null", "clip: 7"),
        ("loop: true", "loop: sometimes"),
        ("elements:", "element:"),
        ("clip: null", "clips: null"),
    ],
    "pqos/map": [
        ("kind: map", "kind: mapp"),
        ("radius_m: 15", "radius_m: 0"),
        ("radius_m: 15 ", "radius: 15 "),
        ("off_map_kbps: 1000", "off_map_kbps: -1"),
        ("valid_s: null", "valid_s: never"),
        ("kind: route ", "kind: rout "),
        ("speed_mps: 8", "speed_mps: -8"),
    ],
    "pqos/trace": [("period_s: 0.5", "period_s: 0"), ("loop: true", "loop: 1"), ("file: traces/demo_dips.csv", "")],
    "recording/ffv1": [("of_raw: 0.6", "of_raw: -1"), ("codec: ffv1", "codec: 1"), ("elements:", "elements: []\nx:")],
    "study/paper": [
        ("metric: mssim", "metric: ssim"),
        ("plan: adaptive", "plan: quick"),
        ("metric_every: 5", "metric_every: 0"),
        ("workers: threads", "workers: fibres"),
        ("narrowest: 1.25", "narrowest: wide"),
    ],
    "link/netns": [
        ("kind: netns", "kind: modem"),
        ("queue_ms: 200", "queue_ms: -1"),
        ("share: 1.1 ", "share: 0 "),
    ],
    "experiment/bottleneck": [
        ("duration_s: 100", "duration_s: 0"),
        ("fixed: [modes=fixed]", "fixed: modes=fixed"),
        ("  about:", "  abuot:"),
    ],
    "vehicle/delivery_robot": [
        ("name: delivery_robot", "name: [robot]"),
        ("place: {row: 0, column: 0}", "place: {row: -1, column: 0}"),
        ("weight: 2 ", "weight: heavy "),
        ("yaw_deg: 180, ", "yaw: 180, "),
        ("defaults:\n", "defaults: everything\nothers:\n"),
    ],
}
# By group: mistakes that only the composed configuration shows.
COMPOSED: Mapping[str, Mapping[str, Sequence[Edit]]] = {
    "cameras": {
        "cameras/wide_720p": [
            ("[0, 250, 900, 2000]", "[0, 900, 250, 2000]"),
            ("[0, 250, 900, 2000]", "[100, 250, 900, 2000]"),
            ("[0, 250, 900, 2000]", "[0, 250, 900]"),
            ("[0.25, 0.5, 0.75, 1.0]", "[0.5, 0.25, 0.75, 1.0]"),
            ("b_full_kbps: 4000", "b_full_kbps: 2000"),
            ("top_px: 120", "top_px: 480"),
        ]
    },
    "modes": {
        "modes/safe": [
            ("  share_by_demand: {}", "  share_by_demnd: {}"),
            ("{start_kbps: 3000}", "{start: 3000}"),
            ("{start_kbps: 3000}", "{}"),
            ("{start_kbps: 3000}", "{start_kbps: many}"),
            ("halve_every_s: 1 ", "halve_every_s: 0 "),
            ("  share_by_demand: {}\n", ""),
            ("  total_from_prediction: {start_kbps: 3000}\n  follow", "  follow"),
        ]
    },
    "graph": {
        "graph/h264_rtsp": [
            ("element: encoder, property: bitrate", "element: encodr, property: bitrate"),
            ("element: encoder, property: bitrate", "element: encoder, property: bitrat"),
            ("name: pay0", "name: payloader"),
            ("name: crop,", "name: scaler,"),
            ('"{mtu_bytes}"', '"{mtu}"'),
            ("speed-preset: superfast", "speed-preset: hyperfast"),
            ("threads: 1 ", "threads: many "),
        ]
    },
    "source": {
        "source/test": [("element: videotestsrc", "element: videotestsource")],
        "source/v4l2": [('"{device}"', '"{devise}"')],
    },
    "pqos": {"pqos/map": [("maps/demo_loop.csv", "maps/demo_lop.csv")], "pqos/trace": [("demo_dips", "dips")]},
    "recording": {"recording/ffv1": [("name: mux", "name: encoder")]},
    "link": {"link/netns": [("file: null ", "file: nowhere.csv ")]},
    "experiment": {
        "experiment/bottleneck": [
            ("equal: [modes=equal]", "equal: [modes=equl]"),
            ("# @package _global_\n", ""),
        ]
    },
    "vehicle": {
        "vehicle/delivery_robot": [
            ("compact_480p", "compact_480"),
            ("  rear:\n    place", "  raer:\n    place"),
            ("    device: /dev/video0", "    device: /dev/video0\n    graph: {first_port: 8554}"),
            ("# @package _global_\n", ""),
        ]
    },
}


def directories(packaged: Path) -> Iterator[tuple[str, dict[str, str]]]:
    """Each directory's name, and the text of its files by path.

    raises  ValueError if an edit finds nothing to replace
    """
    yield "schema", dict(_edited(packaged, SCHEMA))
    for group, edits in COMPOSED.items():
        yield f"composed_{group}", dict(_edited(packaged, edits))


def text_of(packaged: Path, name: str) -> str:
    """The original text of a packaged file."""
    kept = WHOLE_LISTS / f"{name}.yaml"
    return (kept if kept.exists() else packaged / f"{name}.yaml").read_text()


def _edited(packaged: Path, edits: Mapping[str, Sequence[Edit]]) -> Iterator[tuple[str, str]]:
    for name, pairs in edits.items():
        text = text_of(packaged, name)
        for number, (old, new) in enumerate(pairs, 1):
            if old not in text:
                raise ValueError(f"{name}.yaml: {old!r} is not in it")
            yield f"{name}_{number}.yaml", text.replace(old, new, 1)
