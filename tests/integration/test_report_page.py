"""The report's page in a real browser, from its file: charts, hover texts, no external requests."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from drives import write_drive, write_models

from browser import shot
from rig import needs_browser
from runner.configuration.compose import compose
from runner.drive.colours import DAY, NIGHT
from runner.verbs.report import report

pytestmark = needs_browser
pytest.importorskip("matplotlib")
pytest.importorskip("plotly")
sync_api = pytest.importorskip("playwright.sync_api")

SINGLE = {
    ("bitrate_on_track", 0): 6,  # way, points, arrows, start, end, place under the pointer
    ("totals", 0): 4,
    ("bitrates", 0): 5,  # mean, lowest and highest of two cameras, and two others
    ("bitrates", 1): 3,
    ("scaling", 0): 3,
    ("scaling", 1): 1,
    ("latency", 0): 3,  # two percentiles, one camera that froze
    ("latency", 1): 9,
    ("quality", 0): 4,
    ("quality", 1): 4,
}
DRAWN = "[...document.querySelectorAll('.chart')].every(chart => chart.dataset.drawn)"
TRACES = """[...document.querySelectorAll('.chart')].map(chart =>
    [chart.dataset.figure, Number(chart.dataset.drive), Number(chart.dataset.part), chart.data.length])"""


@pytest.fixture(scope="module")
def drives(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    place = tmp_path_factory.mktemp("drives")
    adaptive = write_drive(place / "adaptive", seconds=60, freezes={"top_rear": [(6.0, 1.5)]}, congested=0.5)
    still = write_drive(place / "static <share>", seconds=40, overrides=("pqos=constant", "pqos.kbps=6000"))
    return [adaptive, still]


@pytest.fixture(scope="module")
def single(drives: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("single")
    models = write_models(place / "models", compose(["source=test"]).document)
    return report(drives[:1], place / "out", models)


@contextmanager
def opened(chromium: Any, page_file: Path, width: int = 1280, scheme: str = "dark") -> Iterator[Any]:
    """The page from its file, free of errors, requesting nothing but itself."""
    with chromium.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme) as tab:
        page = tab.new_page()
        wrong: list[str] = []
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.on("console", lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None)
        own = (page_file.as_uri(), "data:", "blob:")
        page.on("request", lambda request: request.url.startswith(own) or wrong.append(request.url))
        page.goto(page_file.as_uri())
        page.wait_for_function(DRAWN)
        yield page
        assert wrong == []


def hovered(page: Any, figure: str, part: int, curve: int, point: int) -> str:
    """Plotly's hover text at a point of a curve."""
    chart = page.locator(f".chart.{figure}[data-drive='0'][data-part='{part}']")
    chart.scroll_into_view_if_needed()
    place = chart.evaluate(
        """(chart, [curve, point]) => {
            const {xaxis, yaxis} = chart._fullLayout, trace = chart.data[curve];
            return [xaxis._offset + xaxis.d2p(trace.x[point]), yaxis._offset + yaxis.d2p(trace.y[point])];
        }""",
        [curve, point],
    )
    chart.hover(position={"x": place[0] + 1, "y": place[1]}, force=True)
    page.wait_for_selector(".hoverlayer text", state="attached")
    return " ".join(chart.locator(".hoverlayer text").all_text_contents())


OTHER_PAGES = (("light", 1280), ("light", 1920), ("dark", 1920))


@pytest.mark.parametrize(
    ("scheme", "width"),
    [("dark", 1280), *(pytest.param(*other, marks=pytest.mark.soak) for other in OTHER_PAGES)],
)
def test_every_chart_is_drawn_and_fits(chromium: Any, single: Path, width: int, scheme: str) -> None:
    with opened(chromium, single, width, scheme) as page:
        traces = {(figure, part): count for figure, _, part, count in page.evaluate(TRACES)}
        assert traces == SINGLE
        assert page.evaluate("document.documentElement.scrollWidth") == width
        for name in ("png", "pdf"):
            links = page.locator(f".files a[href$='.{name}']").evaluate_all("links => links.map(a => a.href)")
            assert len(links) == 6
            assert all(Path(link.removeprefix("file://")).is_file() for link in links)
        shot(page, f"report-{width}-{scheme}", full_page=True)


def test_the_theme_follows_the_system_and_is_chosen_by_a_button(chromium: Any, single: Path) -> None:
    with opened(chromium, single, scheme="light") as page:
        theme = "document.documentElement.dataset.theme"
        colour = "document.querySelector('.quality').data[0].line.color"
        assert (page.evaluate(theme), page.evaluate(colour)) == ("day", DAY[0])
        page.locator("#theme").click()
        page.wait_for_function(f"{colour} === '{NIGHT[0]}'")
        assert page.evaluate(theme) == "night"


def test_factors_show_their_reason(chromium: Any, single: Path) -> None:
    with opened(chromium, single) as page:
        at = page.evaluate("document.querySelector('.scaling').data[0].x.findIndex(t => t > 12)")
        text = hovered(page, "scaling", 0, 0, at)
        assert "front_left, front_right from " in text
        assert "of 6000 kbit/s, range [300, 950) -> 0.25" in text


def test_freezes_show_their_time_and_length(chromium: Any, single: Path) -> None:
    with opened(chromium, single) as page:
        (text,) = page.evaluate("document.querySelector('.latency').data[2].hovertext")
        assert text.startswith("top_rear froze at 6.0 s for 1.5")


def test_pointing_at_a_time_marks_the_place_on_the_map(chromium: Any, single: Path) -> None:
    with opened(chromium, single) as page:
        here = "document.querySelector('.bitrate_on_track').data.at(-1).x"
        assert page.evaluate(here) == []
        hovered(page, "totals", 0, 3, 100)
        page.wait_for_function(f"{here}.length === 1")


def test_tables_are_reached_by_keyboard(chromium: Any, single: Path) -> None:
    with opened(chromium, single) as page:
        tables = page.locator("table")
        assert tables.count() == 2
        for table in tables.all():
            region = table.locator("..")
            region.focus()
            assert region.evaluate("region => region === document.activeElement")
            assert table.locator("caption").inner_text()
        assert page.locator("[aria-label='Statistics by camera'] tbody tr").count() == 8


def test_several_drives_share_their_axes(chromium: Any, drives: list[Path], tmp_path: Path, unprinted: None) -> None:
    with opened(chromium, report(drives, tmp_path / "out")) as page:
        traces = [tuple(each) for each in page.evaluate(TRACES)]
        assert len(traces) == 1 + 2 + 4 + 4 + 3
        assert ("latency", 0, 1, 2) in traces
        ranges = page.locator(".chart.totals").evaluate_all(
            "charts => charts.map(c => [...c.layout.xaxis.range, ...c.layout.yaxis.range])"
        )
        assert ranges[0] == ranges[1]
        assert ranges[0][1] == 60
        assert page.locator("h1").inner_text() == "adaptive and static <share>"
        assert page.locator("[aria-label='One row for each drive'] tbody tr").count() == 2
        shot(page, "report-several", full_page=True)
