"""The operator's page in a real browser when a vehicle or an operator's process fails or differs."""

from __future__ import annotations

import http.client
import os
import re
import signal
import socket
import ssl
import subprocess
import time
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from functools import partial
from itertools import dropwhile
from pathlib import Path

import pytest

from browser import all_live, has_started, luma, measure, opened, send, shot, state_when, take_control, until, visit
from rig import SMALL_ROBOT, answers, clock_ahead, free_port, needs_browser, needs_compiler, process
from runner.core.roles import Role
from runner.drive.read import read_drive
from runner.mqtt.broker import private_broker
from runner.records.operator import Sample
from runner.security.authority import Authority
from runner.settings import Endpoint

pytestmark = [pytest.mark.gst, needs_browser]


# Not the measured link rate: a busy machine delays packets, which would lower it and so the total.
ROBOT = (*SMALL_ROBOT, "source=test", "fps_max=15", "modes=open_loop", "pqos=constant", "pqos.kbps=3000")


@contextmanager
def sides(*overrides, log="log.video=false", keys=None):
    """Vehicle and operator as two processes. Yields the page's address, a way to start the vehicle, the operator.

    log   argument of the operator's side
    keys  directory with the keys of all sides; None: nothing is encrypted
    """
    vehicle_keys, operator_keys = ([f"keys={keys / name}"] if keys else [] for name in ("delivery_robot", "alice"))
    control, media, port = (free_port() for _ in range(3))
    words = (*ROBOT, *overrides, f"control.port={control}", f"media.port={media}", f"page.port={port}")
    with (
        private_broker(Endpoint("127.0.0.1", control), keys and keys / "broker"),
        process("operator", *words, *operator_keys, log) as operator,
    ):
        until(lambda: answers(port))
        yield f"http://127.0.0.1:{port}/", partial(process, "vehicle", *words, *vehicle_keys), operator


@pytest.mark.alone
def test_a_killed_vehicle_is_clearly_marked_and_recovers(chromium):
    """Each picture is marked before the banner names the cause."""
    kill_and_restart_the_vehicle(chromium, banner_ms=10_000)


@pytest.mark.soak
def test_a_killed_vehicle_is_marked_within_150_ms_and_named_within_a_second(chromium):
    kill_and_restart_the_vehicle(chromium, banner_ms=1000, frozen_ms=150)


def kill_and_restart_the_vehicle(chromium, banner_ms, frozen_ms=None):
    with sides() as (url, vehicle, _), opened(chromium, url) as page:
        with vehicle() as first:
            all_live(page)
            time.sleep(1)
            first.kill()
            killed = time.time() * 1000
            page.wait_for_selector("#banner:not([hidden])", timeout=banner_ms)
            named_ms = time.time() * 1000 - killed
            shot(page, "vehicle-gone")
        log = page.evaluate("tod.measure()")["status_log"]
        for camera in ("front", "rear", "mast"):
            at = next(
                ms for ms, name, status in log if name == camera and ms > killed - 100 and status in ("frozen", "lost")
            )
            assert at - killed < (frozen_ms or named_ms), f"{camera}: {at - killed} ms"
        with vehicle():
            state_when(page, lambda now: True)
            online = time.monotonic()
            all_live(page)
            assert time.monotonic() - online < (3 if frozen_ms else 20)
            until(lambda: page.locator("#banner").is_hidden())


@pytest.mark.alone
def test_a_hung_station_is_dropped_and_reconnected(chromium):
    with sides() as (url, vehicle, operator), vehicle(), opened(chromium, url) as page:
        all_live(page)
        operator.send_signal(signal.SIGSTOP)
        stopped = time.monotonic()
        page.wait_for_selector("#banner:not([hidden])", timeout=10_000)
        assert time.monotonic() - stopped < 10  # 2 s without a message
        assert "NO CONNECTION TO THE STATION" in page.locator("#banner").inner_text()
        until(lambda: page.evaluate("tod.measure()")["attempts"] >= 4)  # each times out after 1 s
        shot(page, "station-gone")
        operator.send_signal(signal.SIGCONT)
        reconnects(page)


def test_a_station_that_ends_says_so_and_a_killed_one_is_lost(chromium):
    with sides() as (url, vehicle, operator), vehicle(), opened(chromium, url, refused=True) as page:
        all_live(page)
        operator.send_signal(signal.SIGTERM)
        page.wait_for_selector("#banner:not([hidden])")
        assert page.locator("#banner").inner_text().startswith("○ The station has ended")
        assert page.locator("#connection").inner_text() == "○ station has ended"
        until(lambda: statuses(page) == {"ended"})
        shot(page, "station-ended")
        with process(*operator.args[3:]) as again:
            until(lambda: answers(int(url.rstrip("/").rpartition(":")[2])))
            reconnects(page)
            again.kill()
            page.wait_for_selector("#banner:not([hidden])")
            assert "NO CONNECTION TO THE STATION" in page.locator("#banner").inner_text()
            until(lambda: statuses(page) == {"lost"})


@pytest.mark.alone
@pytest.mark.soak
@pytest.mark.parametrize("attempts", [12, 25])
def test_a_restarted_station_is_reconnected_promptly(chromium, attempts):
    """However many attempts have failed: browsers delay WebSockets after repeated failures."""
    with sides() as (url, vehicle, operator), vehicle(), opened(chromium, url, refused=True) as page:
        all_live(page)
        operator.kill()
        until(lambda: page.evaluate("tod.measure()")["attempts"] >= attempts)
        with process(*operator.args[3:], "dimensions.width_m=0.6"):  # the page's worker makes new streams
            until(lambda: answers(int(url.rstrip("/").rpartition(":")[2])))
            reconnects(page)


def statuses(page):
    return set(page.eval_on_selector_all(".tile", "all => all.map(({ dataset }) => dataset.status)"))


def reconnects(page):
    back = time.monotonic()
    until(lambda: page.locator("#banner").is_hidden())
    all_live(page)
    assert time.monotonic() - back < 10


def test_an_operator_that_joins_a_watched_stream_shows_pictures(chromium):
    """A running stream has no IDR to start from."""
    from runner.operator.frames import live_frames

    with sides() as (url, vehicle, _), vehicle() as running:
        media = next(word for word in running.args if word.startswith("media.port="))
        with live_frames([*ROBOT, media]) as frames, opened(chromium, url) as page:
            all_live(page)
            assert frames.next(5)


@pytest.mark.soak
def test_two_size_changes_a_second_break_no_decoder(chromium):
    """`make soak` runs it for longer."""
    turns = int(os.environ.get("TOD_NEW_SIZES", "20"))
    graphs = ("+graph@cameras.rear.graph=openh264_rtsp",)  # keyframes there, refresh waves on the other cameras
    keys = Path(os.environ["TOD_NEW_SIZES_KEYS"]) if "TOD_NEW_SIZES_KEYS" in os.environ else None
    with sides("mode=single", *graphs, keys=keys) as (url, vehicle, _), vehicle(), opened(chromium, url) as page:
        all_live(page)
        counted = measure(page)
        for turn in range(turns):
            for camera in ("front", "rear", "mast"):
                reply = send(page, event="camera_configured", camera=camera, scaling=(0.25, 0.5, 1.0)[turn % 3])
                assert reply["result"] == "applied", reply
            time.sleep(0.5)
            for camera in ("front", "rear", "mast"):
                assert luma(page, camera)[0].mean() > 40, f"{camera} is black in turn {turn}"
        measured = measure(page)
        assert {name: camera["errors"] for name, camera in measured.items()} == {"front": 0, "rear": 0, "mast": 0}
        for name, camera in measured.items():
            received, drawn = (camera[key] - counted[name][key] for key in ("received", "drawn"))
            assert received > 5 * turns
            assert drawn > 0.9 * received


@needs_compiler
def test_ages_are_right_although_the_vehicles_clock_is_ahead(chromium, tmp_path):
    log = f"log={tmp_path / 'drive'}"
    ahead = clock_ahead(tmp_path, seconds=3.7)
    with sides(log=log) as (url, vehicle, operator), vehicle(env=ahead), opened(chromium, url) as page:
        all_live(page)
        shown = partial(page.locator("[data-camera=front] .form").inner_text)

        def is_right():
            """Not the 3700 ms by which the clock is ahead, once the clocks have been compared well."""
            age = re.search(r" (\d+) ± (\d+) ms", shown())
            return age and int(age[1]) < 500 and int(age[2]) < 100

        until(is_right)
        time.sleep(2.5)  # by then the page warns of an unknown clock offset
        assert page.locator("#warning").is_hidden()
        shot(page, "clock-ahead")
        operator.terminate()
        operator.communicate(timeout=20)
    samples = list(read_drive(tmp_path / "drive").sides["operator"].of(Sample))
    known = list(dropwhile(lambda sample: sample.clock_bound_ms is None, samples))
    assert len(known) > 5
    assert all(sample.clock_bound_ms is not None for sample in known)
    right = [abs(sample.clock_ahead_ms - 3700) <= sample.clock_bound_ms for sample in known]
    assert sum(right) >= 0.99 * len(right)


def test_no_stale_values_are_shown_of_a_camera_that_is_off_or_lost(chromium):
    with sides() as (url, vehicle, _), opened(chromium, url) as page:
        with vehicle() as running:
            all_live(page)
            until(lambda: "– fps" not in caption(page, "rear"))
            page.locator("[data-camera=rear] .switch").click()
            until(lambda: measure(page)["rear"]["status"] == "off")
            until(lambda: caption(page, "rear") == "– fps · –/0/0 kbit/s – · ×– · – ms")
            page.locator("[data-camera=rear] .head b").click()
            _, decided, applied = page.locator("#camera-panel .facts tbody tr").nth(1).inner_text().split("\t")
            assert decided == "0"
            assert re.fullmatch(r"– \(keeps \d+\)", applied)
            assert page.locator("#camera-panel [data-differs]").count() == 0
            shot(page, "off")
            running.kill()
        until(lambda: measure(page)["front"]["status"] == "lost")
        until(lambda: caption(page, "front") == "– fps · –/–/– kbit/s – · ×– · – ms")
        shot(page, "lost")


@pytest.mark.soak
@pytest.mark.players
def test_a_camera_that_the_vehicle_lacks_is_lost_and_the_others_are_driven(chromium):
    with sides() as (url, vehicle, _), opened(chromium, url) as page, vehicle("~cameras.mast"):
        until(lambda: {name: shown["status"] for name, shown in measure(page).items()} == LACKING)
        until(lambda: page.locator("[data-camera=mast] .refused").inner_text() == "The vehicle has no camera mast.")
        assert page.locator("#banner").is_hidden()
        take_control(page)
        page.locator("[data-camera=rear] .switch").click()
        until(lambda: measure(page)["rear"]["status"] == "off")
        shot(page, "lacking")


@pytest.mark.soak
@pytest.mark.players
def test_the_page_says_why_there_is_no_control_link(chromium):
    control, port = free_port(), free_port()
    words = (*ROBOT, f"control.port={control}", f"page.port={port}", "log.video=false")
    with (
        process("operator", *words),
        opened(chromium, until(lambda: answers(port) and f"http://127.0.0.1:{port}/")) as page,
    ):
        why = f"✕ VIDEO IS NOT LIVE: no control link: MQTT broker at 127.0.0.1:{control}: connection refused"
        until(lambda: page.locator("#banner").inner_text() == why)
        until(lambda: page.locator("#connection").inner_text() == "✕ no control link")
        shot(page, "no_control_link")
        with private_broker(Endpoint("127.0.0.1", control)):
            until(lambda: page.locator("#banner").inner_text() == "✕ VEHICLE OFFLINE: video is not live")


@pytest.mark.soak
@pytest.mark.players
def test_the_page_names_certificates_that_expire_soon(chromium, tmp_path):
    for name, role, days in (
        ("broker", Role.BROKER, 300),
        ("delivery_robot", Role.VEHICLE, 360),
        ("alice", Role.CONTROLLER, 354),
    ):
        authority = Authority(tmp_path / "keys", lambda days=days: datetime.now(UTC) - timedelta(days=days, hours=-1))
        with authority.opened():
            authority.issue(name, role, ["127.0.0.1"])
    own, vehicles = (f"{datetime.now(UTC) + timedelta(days=days, hours=1):%Y-%m-%d}" for days in (11, 5))
    with sides(keys=tmp_path / "keys") as (url, vehicle, _), vehicle(), opened(chromium, url) as page:
        text = (
            f"▲ Renew the keys: own certificate expires on {own}, in 11 days; "
            f"the vehicle's certificate expires on {vehicles}, in 5 days"
        )
        until(lambda: page.locator("#warning").is_visible() and page.locator("#warning").inner_text() == text)
        shot(page, "expiring")


LACKING = {"front": "live", "rear": "live", "mast": "lost"}


def caption(page, camera):
    parts = (page.locator(f"[data-camera={camera}] .{part}").inner_text() for part in ("rates", "form"))
    return " ".join(parts).replace("\u2009", "")


@pytest.mark.soak
def test_h265_is_played_or_refused_with_the_reason(chromium):
    with sides("+graph@cameras.rear.graph=h265_rtsp") as (url, vehicle, _), vehicle(), opened(chromium, url) as page:
        until(lambda: {"live", "unsupported"} >= {camera["status"] for camera in measure(page).values()})
        until(lambda: page.evaluate("tod.sample?.cameras?.rear?.fps ?? 0") > 5)
        supported = "VideoDecoder.isConfigSupported({codec: 'hev1.1.6.L90.90'}).then(({supported}) => supported)"
        if page.evaluate(supported):
            all_live(page)
            return
        tile = page.locator("[data-camera=rear]")
        expected = r"This browser has no decoder for H\.265 \(hev1\.1\.6\.L\d+\.90\)\. Use an H\.264 graph or .*"
        until(lambda: re.fullmatch(expected, tile.locator(".refused").inner_text()))
        assert tile.locator(".status").inner_text() == "⊘ NO PICTURE"
        until(lambda: not tile.locator(".rates").inner_text().startswith("–"))  # the rates of the received stream
        for camera in ("front", "mast"):
            until(lambda camera=camera: measure(page)[camera]["status"] == "live")
            until(lambda camera=camera: page.locator(f"[data-camera={camera}] .refused").is_hidden())
        assert measure(page)["rear"]["resyncs"] <= 1  # another burst would not help
        tile.locator(".head b").click()
        assert "no decoder for H.265" in page.locator("#camera-panel .why-decided").inner_text()
        received = measure(page)["rear"]["received"]
        until(lambda: measure(page)["rear"]["received"] > received + 60)  # the refusal outlasts further keyframes
        assert tile.locator(".status").inner_text() == "⊘ NO PICTURE"
        shot(page, "h265")
        with opened(chromium, url) as later:
            until(lambda: re.fullmatch(expected, later.locator("[data-camera=rear] .refused").inner_text()))
            assert measure(later)["rear"]["status"] == "unsupported"


def test_a_source_that_repeats_its_picture_is_shown_as_frozen(chromium):
    """Pictures arrive as usual; only their content shows that none of them is new."""
    still = "source.elements=[{name: source, element: videotestsrc, properties: {is-live: true, pattern: circular}}, "
    raw = "{name: raw, element: capsfilter, properties: {caps: '{raw_caps}'}}]"
    with sides() as (url, vehicle, _), vehicle(still + raw, "+source.repeated_s=1"), opened(chromium, url) as page:
        refused = page.locator("[data-camera] .refused")
        until(lambda: refused.all_inner_texts() == 3 * ["source: repeats the same picture"])
        until(lambda: {camera["status"] for camera in measure(page).values()} == {"frozen"})
        counted = measure(page)
        until(lambda: all(camera["drawn"] > counted[name]["drawn"] + 5 for name, camera in measure(page).items()))
        assert "live" not in {camera["status"] for camera in measure(page).values()}
        until(lambda: {camera["status"] for camera in measure(page).values()} == {"frozen"})  # "lost" on a busy machine


def test_a_camera_that_delivers_too_few_pictures_says_so_and_stays_live(chromium):
    """As in the dark, when automatic exposure halves the rate: no alarm, and nothing is wrong with the stream."""
    raw = "video/x-raw,format=I420,width={width},height={height},colorimetry=bt709"
    slow = [
        "{name: source, element: videotestsrc, properties: {is-live: true, pattern: ball}}",
        f"{{name: dark, element: capsfilter, properties: {{caps: '{raw},framerate=4/1'}}}}",
        "{name: states, element: capssetter, properties: {caps: 'video/x-raw,framerate={framerate}'}}",
        "{name: raw, element: capsfilter, properties: {caps: '{raw_caps}'}}",
    ]
    elements = f"cameras.rear.source.elements=[{', '.join(slow)}]"
    with (
        sides() as (url, vehicle, _),
        vehicle("+source@cameras.rear.source=test", elements),
        opened(chromium, url) as page,
    ):
        until(lambda: measure(page)["rear"]["note"] == "4 of 15 Hz")

        def is_calm():  # a busy machine may hold up any picture for a moment
            seen = [measure(page) for _ in range(20)]
            return all(each["rear"]["status"] == "live" and each["front"]["note"] == "" for each in seen)

        until(is_calm)
        until(lambda: re.match(r"[345] of 15 fps", page.locator("[data-camera=rear] .rates").inner_text()))
        shot(page, "slow camera")
        page.keyboard.press("v")
        shot(page, "slow camera driving")


def _own_address():
    """An address at which other machines may reach this one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing
        except OSError:
            pytest.skip("this machine has no network")
        return probe.getsockname()[0]


@pytest.fixture
def remote_page(tmp_path):
    """The page of an operator, served at an address that is not loopback: (url, keys)."""
    here = _own_address()
    keys, port = tmp_path / "keys", free_port()
    authority = Authority(keys)
    with authority.opened():
        authority.issue("broker", Role.BROKER, ["localhost"])
        authority.issue("delivery_robot", Role.VEHICLE, [])
        authority.issue("alice", Role.CONTROLLER, [here])
    words = (*ROBOT, f"page.host={here}", f"page.port={port}", f"keys={keys}")
    ports = (f"media.port={free_port()}", f"control.port={free_port()}", "duration_s=600")
    with process("demo", *words, *ports, stdout=subprocess.DEVNULL):
        until(lambda: answers(port, here), seconds=60)
        yield f"https://{here}:{port}/", keys / "alice"


def test_a_browser_on_another_machine_needs_the_token(chromium, remote_page):
    url, alice = remote_page
    token = (alice / "page.token").read_text()
    with chromium.new_context(ignore_https_errors=True) as tab:  # this browser does not know the authority
        page = tab.new_page()
        visit(page, url)
        assert page.url == f"{url}login"
        page.fill("#token", "guessed")
        page.click("button")
        until(lambda: "Wrong token" in page.locator("#problem").inner_text())
        shot(page, "login")
        page.fill("#token", token)
        page.click("button")
        page.wait_for_url(url)
        until(lambda: has_started(page))
        all_live(page)
        authority = Authority(alice.parent)
        with authority.opened():
            authority.rotate("alice")
        page.wait_for_url(f"{url}login")  # by itself


def test_other_sites_and_host_names_are_refused(remote_page):
    """Cross-site WebSocket, DNS rebinding, another site's form, path traversal, and no session at all."""
    url, alice = remote_page
    host = url.removeprefix("https://").rstrip("/")
    own = {"Host": host, "Origin": url.rstrip("/")}
    tls = ssl.create_default_context(cafile=alice / "ca.crt")

    def status(path, method="GET", **headers):
        connection = http.client.HTTPSConnection(*host.split(":"), context=tls, timeout=10)
        connection.request(method, path, headers={**own, **headers})
        found = connection.getresponse()
        connection.close()
        return found.status

    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
    upgrade["Sec-WebSocket-Key"] = "dGhlIHNhbXBsZSBub25jZQ=="
    assert status("/login") == 200
    assert status("/login", Host="evil.example:8090") == 403
    assert status("/login", Origin="https://evil.example") == 403
    assert status("/login/challenge", "POST") == 200
    assert status("/login/challenge", "POST", Origin="https://evil.example") == 403
    assert status("/live?viewer=x", **upgrade) == 401
    assert status("/live?viewer=x", **upgrade, Cookie="tod_session=guessed") == 401
    assert status("/live?viewer=x", **upgrade, Origin="https://evil.example") == 403
    assert status("/login/challenge") == 405, "a GET changes nothing"
    assert status("/static/main.js") == 401
    assert status("/static/../../../../etc/passwd") in (401, 404)
    assert status("/static/%2e%2e/%2e%2e/server.py") in (401, 404)
    assert status("/") == 303
