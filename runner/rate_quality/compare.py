"""How two models differ. Pure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

ModelDocument = Mapping[str, Any]  # of a model file


def compare(a: ModelDocument, b: ModelDocument) -> Iterator[str]:
    """Lines of text: what they were measured on, then factors, bounds and b_full, then the points."""
    yield from _origins(a, b)
    if a["scaling"] == b["scaling"]:
        yield f"factors    {_list(a['scaling'])}, the same"
        for factor, low, high in list(zip(a["scaling"], a["b_min_kbps"], b["b_min_kbps"], strict=True))[1:]:
            yield f"b_min of {factor:<6g} {low:>6} -> {high:<6} {_percent(low, high)}{_certain(a, b, factor)}"
    else:
        yield f"factors    {_list(a['scaling'])} -> {_list(b['scaling'])}"
        yield f"b_min      {_list(a['b_min_kbps'])} -> {_list(b['b_min_kbps'])} kbit/s"
    yield f"b_full     {a['b_full_kbps']:>6} -> {b['b_full_kbps']:<6} {_percent(a['b_full_kbps'], b['b_full_kbps'])}"
    yield from _points(a, b)


def _origins(a: ModelDocument, b: ModelDocument) -> Iterator[str]:
    for what, key in (("metric", "metric"), ("plan", "plan")):
        if a[key] != b[key]:
            yield f"{what:<10} {a[key]} -> {b[key]}"
    if a["content"] == b["content"]:
        yield "measured   on the same sequences by the same encoder"
        return
    clips = [sorted(clip["sha256"] for clip in model["sequences"].values()) for model in (a, b)]
    yield f"sequences  {'the same' if clips[0] == clips[1] else f'{_files(a)} -> {_files(b)}'}"
    if a["encoder"]["graph"] != b["encoder"]["graph"]:
        yield "encoder    differs:"
        yield from (f"           {line}" for line in _changes(a["encoder"]["graph"], b["encoder"]["graph"]))
    for name in sorted({*a["encoder"]["versions"], *b["encoder"]["versions"]}):
        before, after = (model["encoder"]["versions"].get(name, "none") for model in (a, b))
        if before != after:
            yield f"version    {name}: {before} -> {after}"


def _changes(before: str, after: str) -> Iterator[str]:
    """Elements that only one of two lines has."""
    first, second = (line.split(" ! ") for line in (before, after))
    yield from (f"- {element}" for element in first if element not in second)
    yield from (f"+ {element}" for element in second if element not in first)


def _certain(a: ModelDocument, b: ModelDocument, factor: float) -> str:
    """Whether the confidence intervals of a bound overlap."""
    ranges = [(c["low"], c["high"]) for m in (a, b) for c in m["crossings"] if c["upper"] == factor]
    if len(ranges) < 2:
        return ""
    (low, high), (other_low, other_high) = ranges
    return ", within their confidence" if low <= other_high and other_low <= high else ", outside their confidence"


def _points(a: ModelDocument, b: ModelDocument) -> Iterator[str]:
    """Differences in quality between encodings that both have."""
    both = sorted(set(a["metrics"]) & set(b["metrics"]))
    mine, theirs = ({(p["scaling"], p["target_kbps"]): p for p in model["points"]} for model in (a, b))
    common = sorted(mine.keys() & theirs.keys())
    yield f"points     {len(mine)} -> {len(theirs)}, {len(common)} at the same factor and bitrate"
    for metric in both if common else ():
        changes = {at: theirs[at][metric] - mine[at][metric] for at in common}
        worst = max(changes, key=lambda at: abs(changes[at]))
        mean = sum(changes.values()) / len(changes)
        where = f"factor {worst[0]:g} at {worst[1]} kbit/s"
        yield f"{metric:<10} mean change {mean:+.4g}, largest {changes[worst]:+.4g} ({where})"


def _percent(before: float, after: float) -> str:
    return f"{100 * (after / before - 1):+.1f} %" if before else ""


def _list(values: list[float]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values) + "]"


def _files(model: ModelDocument) -> str:
    return ", ".join(clip["file"] for clip in model["sequences"].values())
