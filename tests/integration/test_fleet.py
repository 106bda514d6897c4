"""One page for several vehicles: what is listed, opened and watched, and the processes behind it."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack, ExitStack

import pytest
from aiohttp import WSMsgType
from fleet_rig import NAMES, Programs, await_page, card, leave, moving, pids_of, three
from visitors import browsing

from browser import barriers, needs_axe, shot, visit
from rig import needs_browser, until
from runner.core.roles import Role
from runner.mqtt.link import ControlLink
from runner.mqtt.messages import topic
from runner.security.authority import Authority
from runner.security.keyring import AUTHORITY, TOKEN
from runner.security.page_people import change_people
from runner.settings import Endpoint


class Heard:
    """What the vehicles publish."""

    def __init__(self, control: int) -> None:
        self.state, self.telemetry = {}, {}
        listen = {topic("+", "state"): self._on(self.state), topic("+", "telemetry"): self._on(self.telemetry)}
        self.link = ControlLink(Endpoint("127.0.0.1", control), None, listen, lambda _: None, print)
        self.link.connect()

    def _on(self, kept):
        def keep(message):
            kept[message.topic.split("/")[1]] = json.loads(message.payload)

        return keep

    def encoding(self, name):
        """The cameras of a vehicle that somebody receives: the others have no encoder."""
        cameras = self.telemetry.get(name, {}).get("cameras", {})
        return {camera for camera, each in cameras.items() if each["frames"]}

    def driver(self, name):
        driving = self.state.get(name, {}).get("driving", {})
        return driving.get("holder") if driving.get("state") == "held" else None


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    with three(tmp_path_factory.mktemp("fleet")) as programs:
        heard = Heard(programs.control)
        until(lambda: all(heard.state.get(name, {}).get("online") for name in NAMES), 120)
        yield programs, heard
        heard.link.close()


@pytest.fixture
def page(fleet, chromium):
    """The list, with all vehicles online."""
    programs, _ = fleet
    with ExitStack() as stack:
        tab = stack.enter_context(chromium.new_context(viewport={"width": 1366, "height": 768}))
        page, wrong = tab.new_page(), []
        tab.on("weberror", lambda error: wrong.append(str(error.error)))
        await_page(programs)
        visit(page, programs.url)
        until(lambda: page.locator(".state[data-level=fine]").count() == 3, 120, 0.1)
        yield page
        assert wrong == []


@needs_browser
@needs_axe
def test_the_list_has_no_serious_barrier(fleet, page):
    for theme in ("day", "night"):
        page.evaluate("theme => (document.documentElement.dataset.theme = theme)", theme)
        assert barriers(page) == [], theme


def test_a_vehicle_that_is_only_listed_costs_its_uplink_nothing(fleet, page):
    _, heard = fleet
    until(lambda: set(heard.telemetry) == set(NAMES))
    for name in NAMES:
        until(lambda name=name: "Nobody drives" in card(page, name).inner_text(), every_s=0.1)
        assert (heard.encoding(name), heard.driver(name)) == (set(), None)
    assert page.title() == "Vehicles · tod-runner"
    shot(page, "fleet")


@needs_browser
def test_a_picture_on_demand_is_of_one_camera_and_gives_no_control(fleet, page):
    _, heard = fleet
    button = card(page, "courier-2").locator("button.watch")
    button.click()
    picture = page.frame_locator("iframe")
    until(lambda: picture.locator(".tile:is([data-status=live], [data-status=late])").count() == 1, every_s=0.1)
    until(lambda: heard.encoding("courier-2") == {"front"})
    assert heard.driver("courier-2") is None
    assert picture.locator("body").evaluate("() => document.title") == "front · courier-2 · tod-runner"
    shot(page, "fleet_picture")
    button.click()
    until(lambda: heard.encoding("courier-2") == set())


@needs_browser
def test_opening_a_vehicle_drives_it_and_switching_ends_its_pictures(fleet, page):
    _, heard = fleet
    card(page, "courier-1").locator("a.open").click()
    until(lambda: moving(page) == 3, every_s=0.1)
    until(lambda: heard.driver("courier-1"))
    assert page.title() == "courier-1 · tod-runner"
    assert page.inner_text("#vehicle") == "courier-1"
    card(page, "courier-3").locator("button.watch").click()
    until(
        lambda: page.frame_locator("iframe").locator(".tile:is([data-status=live], [data-status=late])").count() == 1,
        every_s=0.1,
    )
    page.keyboard.press("v")
    shot(page, "fleet_drive")
    leave(page, "courier-2")
    until(lambda: moving(page) == 3, every_s=0.1)
    until(lambda: heard.encoding("courier-1") == set())
    until(lambda: heard.encoding("courier-3") == {"front"})
    left = card(page, "courier-1")
    until(lambda: "You drive" in left.inner_text(), every_s=0.1)  # leaving a page releases nothing
    until(lambda: "the driver's page is closed" in left.inner_text(), every_s=0.1)
    left.locator("button.release").click()
    until(lambda: heard.driver("courier-1") is None)
    until(lambda: "Nobody drives" in left.inner_text(), every_s=0.1)


@needs_browser
def test_a_station_that_crashes_is_started_again(fleet, page):
    programs, _ = fleet
    card(page, "courier-3").locator("a.open").click()
    until(lambda: moving(page) == 3, every_s=0.1)
    before = pids_of(programs)
    os.kill(before["courier-3"], signal.SIGKILL)
    until(lambda: moving(page) == 0, every_s=0.05)
    until(lambda: moving(page) == 3, every_s=0.1)
    after = pids_of(programs)
    assert after["courier-3"] != before["courier-3"]
    assert [after[name] for name in NAMES[:2]] == [before[name] for name in NAMES[:2]]
    assert "courier-3: its station ended (killed by SIGKILL); starting again in 0.5 s" in programs.output("station")


@needs_browser
def test_an_unknown_vehicle_is_refused_with_the_known_ones(fleet, page):
    programs, _ = fleet
    answer = page.request.get(f"{programs.url}vehicle/courier-9/")
    assert (answer.status, answer.text()) == (404, f"no such vehicle; there are {', '.join(NAMES)}\n")


def test_stations_end_with_their_parent_however_it_ends(tmp_path):
    name = NAMES[0]
    for number in (signal.SIGTERM, signal.SIGKILL):
        with Programs(tmp_path) as programs:
            programs.station(programs.file([name]))
            until(lambda programs=programs: set(pids_of(programs)) == {name}, 60)
            pids = pids_of(programs).values()
            os.kill(programs.processes["station"].pid, number)
            programs.processes["station"].wait(30)
            until(lambda pids=pids: not any(is_alive(pid) for pid in pids), 30)


def is_alive(pid):
    try:
        return open(f"/proc/{pid}/stat").read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@needs_browser
def test_all_vehicles_that_the_broker_knows_are_listed(tmp_path, chromium):
    """One has a file here, in conf; of the other only the name is known."""
    with Programs(tmp_path) as programs:
        programs.vehicle("courier-1")
        programs.start("robot", "vehicle", f"media.port={programs.media['courier-2']}")
        programs.station("all")
        with chromium.new_context() as tab:
            page = tab.new_page()
            await_page(programs)
            visit(page, programs.url)
            until(lambda: page.locator(".state[data-level=fine]").count() == 1, 120, 0.1)
            assert "● online" in card(page, "delivery_robot").inner_text()
            until(lambda: card(page, "courier-1").count(), 60, 0.1)
            assert "no station: " in card(page, "courier-1").inner_text()


def test_with_keys_people_open_the_list_and_watch_and_only_the_operator_drives(tmp_path):
    authority, keys = Authority(tmp_path / "keys"), tmp_path / "keys"
    with authority.opened():
        for name, role in {"broker": Role.BROKER, **dict.fromkeys(NAMES, Role.VEHICLE)}.items():
            authority.issue(name, role, [])
        authority.issue("alice", Role.CONTROLLER, ["127.0.0.1"])
    people = change_people(tmp_path / "people", {"dave": Role.WATCHER})
    with Programs(tmp_path, keys=keys) as programs:
        for name in NAMES[:2]:
            programs.vehicle(name)
        programs.station(programs.file(), f"page.people={tmp_path / 'people'}")
        await_page(programs)
        url, own = f"https://127.0.0.1:{programs.page}", keys / "alice"
        with ThreadPoolExecutor(1) as browsers:  # in this thread the other tests' browser may have its loop
            token = (own / TOKEN).read_text().strip()
            browsers.submit(asyncio.run, _watched(url, own / AUTHORITY, people["dave"].token.decode())).result()
            browsers.submit(asyncio.run, _driven(url, own / AUTHORITY, token)).result()


async def _watched(url, ca, token):
    async with asyncio.timeout(120), browsing(url, ca, token) as (session, origin):
        shown = await session.ws_connect(f"{url}/list", origin=origin)
        document = await _list(shown, lambda rows: [_online(row) for row in rows] == [True, True, False])
        assert not document["may_drive"]
        live = f"{url}/vehicle/courier-1/live?viewer=w"
        async with session.ws_connect(live, origin=origin, max_msg_size=0) as page:
            assert (await _message(page, "hello"))["visitor"] == {"name": "dave", "may_drive": False}
            await page.send_json({"id": "1", "event": "stop_requested"})
            assert (await _message(page, "reply"))["reason"] == "dave may only watch"
            while (await page.receive()).type is not WSMsgType.BINARY:  # a picture
                pass
            document = await _list(shown, lambda rows: rows[0]["summary"]["received"])
            assert document["vehicles"][0]["summary"]["control"] == "free", "who looks on does not drive"


async def _driven(url, ca, token):
    async with asyncio.timeout(120), browsing(url, ca, token) as (session, origin):
        shown = await session.ws_connect(f"{url}/list", origin=origin)
        async with asyncio.TaskGroup() as group, AsyncExitStack() as pages:
            for name in NAMES[:2]:
                live = f"{url}/vehicle/{name}/live?viewer=d"
                page = await pages.enter_async_context(session.ws_connect(live, origin=origin, max_msg_size=0))
                group.create_task(_read(page))
            document = await _list(shown, lambda rows: [_holder(row) for row in rows] == ["alice", "alice", None])
            assert document["may_drive"]
        await shown.send_str("courier-2")
        await _list(shown, lambda rows: "the vehicle must stand" in rows[1]["answer"])


def _online(row):
    return bool(row["summary"] and row["summary"]["online"])


def _holder(row):
    return row["summary"] and row["summary"]["holder"]


async def _read(page):
    async for _ in page:
        pass


async def _list(shown, is_right):
    while not is_right((document := json.loads(await shown.receive_str()))["vehicles"]):
        pass
    return document


async def _message(page, kind):
    """The next of a kind."""
    while True:
        message = await page.receive()
        if message.type is WSMsgType.TEXT and (document := json.loads(message.data))["kind"] == kind:
            return document
