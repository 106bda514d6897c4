"""Parts of the page's server: a viewer's queues, control, history."""

from __future__ import annotations

import asyncio
import gc
import hmac
import http.client
import inspect
import json
import math
import shutil
import socket
import ssl
import time
from contextlib import AsyncExitStack, ExitStack, closing, contextmanager, nullcontext, suppress
from types import SimpleNamespace
from urllib.parse import urlencode

import pytest
from helpers import setup

from rig import free_port
from runner.errors import RunError
from runner.h264.access_unit import AccessUnit

pytest.importorskip("aiohttp")
import aiohttp

from runner.configuration.layout import NOWHERE, Layouts
from runner.core.events import Attention
from runner.core.model import Roi
from runner.core.roles import Role
from runner.operator.seen import StatedView
from runner.operator.station import LinkState
from runner.page.access import LOGIN_POLICY, POLICY, Access, hosts
from runner.page.control import GRACE_S, Control, combined_attention, page_of
from runner.page.history import MAX_SAMPLES, History
from runner.page.login import COOKIE, PageLogin
from runner.page.server import PageServer
from runner.page.viewer import CATCH_UP, HEADER, KEY, PLACED, REGION, RESTART, PageViewer
from runner.records.operator import CameraSample, LatencyStages, Sample
from runner.records.vehicle import Outcome, Position
from runner.security import keyring
from runner.security.authority import Authority
from runner.security.keyring import Keyring
from runner.security.page_people import PagePerson

UPGRADE = (
    "Connection: Upgrade\r\nUpgrade: websocket\r\n"
    "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: MDEyMzQ1Njc4OWFiY2RlZg=="
)
FULL = b"GET / HTTP/1.1\r\nHost: localhost:PORT\r\n\r\n"


def unit(number, key=False, captured=None):
    return AccessUnit(bytes([number]), captured, number / 10, key)


def sent(viewer):
    """Everything queued: texts as their kind, units as (camera, flags, number)."""
    messages = []
    while (message := viewer.pop()) is not None:
        if isinstance(message, str):
            messages.append(json.loads(message)["kind"])
        else:
            camera, flags, _, _, _, _ = HEADER.unpack_from(message)
            messages.append((camera, flags, message[HEADER.size]))
    return messages


@contextmanager
def served(*overrides, layouts=None, login=None, keyring=None, note=print):
    """Port of a page, and its station; with a login, browsers must expect HTTPS, although it is not encrypted.

    No window is dropped for its silence: most clients here answer pings only while they receive.
    """
    port = free_port()
    told = {"identity": "anna", "answer_s": 1.0, "attention": None, "link_state": LinkState()}
    station = SimpleNamespace(state=None, note=note, seen=StatedView(), **told)
    with pytest.MonkeyPatch.context() as patch:
        if login:
            patch.setattr("runner.page.front.Access", lambda _none, *rest: Access(login, *rest))
        page = PageServer(setup(f"page.port={port}", *overrides), station, layouts=layouts, keyring=keyring)
        station.latency, station.page = SimpleNamespace(captured=lambda camera, captured: captured), page
        patch.setattr("runner.page.server.UNRESPONSIVE_S", 60)
        page.start()
        try:
            yield port, station
        finally:
            page.stop()


@pytest.mark.parametrize("begun", [b"", b"GET / HT", b"GET / HTTP/1.1\r\nHost: localhost\r\n", FULL + b"GET / H"])
def test_a_request_that_is_never_finished_is_closed(monkeypatch, begun):
    monkeypatch.setattr("runner.page.connections.REQUEST_S", 0.3)
    with served() as (port, _), socket.create_connection(("127.0.0.1", port), timeout=60) as line:
        line.sendall(begun.replace(b"PORT", str(port).encode()))
        with suppress(ConnectionResetError):
            while line.recv(65536):  # the response to the finished request, then the end
                pass


def test_a_login_whose_body_never_comes_is_closed(monkeypatch):
    """The body is read before anybody has logged in."""
    monkeypatch.setattr("runner.page.connections.REQUEST_S", 0.3)
    login = PageLogin(lambda: {"anna": PagePerson(Role.CONTROLLER, b"token")})
    with served(login=login) as (port, _), socket.create_connection(("127.0.0.1", port), timeout=60) as line:
        own = f"Host: localhost:{port}\r\nOrigin: https://localhost:{port}\r\n"
        line.sendall(f"POST /login HTTP/1.1\r\n{own}Content-Length: 100\r\n\r\n".encode())
        assert line.recv(1) == b""


@pytest.mark.parametrize(
    "handshake",
    [
        UPGRADE.replace("Connection:", "Connection:\xff"),
        UPGRADE.replace("Upgrade: ", "Upgrade: \xc3"),
        UPGRADE.replace("-Key: ", "-Key: \xff"),
        UPGRADE.replace("-Key: ", "-Key: \xc3\xa9"),  # UTF-8
        UPGRADE.replace("-Version: ", "-Version: \xfe"),
    ],
)
def test_a_handshake_that_is_not_ascii_is_the_clients_fault(handshake):
    notes = []
    with served(note=notes.append) as (port, _), socket.create_connection(("127.0.0.1", port), timeout=60) as line:
        text = f"GET /live?viewer=me HTTP/1.1\r\nHost: localhost:{port}\r\n{handshake}\r\n\r\n"
        line.sendall(text.encode("latin-1"))
        assert line.recv(65536)[8:].startswith(b" 400 ")
    assert notes == []


class OneSession:
    """A login with one session that has access, until its token is replaced."""

    def __init__(self):
        self.token = b"token"
        self.login = PageLogin(lambda: {"anna": PagePerson(Role.CONTROLLER, self.token)})
        challenge = self.login.challenge(time.monotonic())
        answer = hmac.new(self.token, challenge.encode(), "sha256").hexdigest()
        self.cookie = f"{COOKIE}={self.login.open(challenge, answer, time.monotonic())}"


def test_messages_are_ignored_once_the_token_is_replaced(monkeypatch):
    """Also on a connection whose pings do not get through, so that it is not closed yet."""
    monkeypatch.setattr("runner.page.server.PING_S", 60)
    changed = OneSession()

    async def drive(port, station):
        own = f"http://localhost:{port}"
        headers = {"Cookie": changed.cookie}
        async with (
            aiohttp.ClientSession(headers=headers) as session,
            session.ws_connect(f"{own}/live?viewer=me", origin=own.replace("http", "https")) as ws,
        ):
            await ws.send_json({"take_control": True})
            while (await ws.receive_json()).get("holder") != "you":
                pass
            await ws.send_json({"attention": "hidden"})
            await ws.send_json({"clock": 1})
            while "page_ms" not in await ws.receive_json():
                pass
            assert station.attention is Attention.HIDDEN
            changed.token = b"another"
            await ws.send_json({"attention": "watching"})
            await ws.send_json({"clock": 1})
            with pytest.raises(TimeoutError):
                while "page_ms" not in await ws.receive_json(timeout=1):
                    pass
            assert station.attention is Attention.HIDDEN

    with served(login=changed.login) as (port, station):
        asyncio.run(drive(port, station))


PEOPLE = {
    "anna": PagePerson(Role.CONTROLLER, b"of anna"),
    **{name: PagePerson(Role.WATCHER, f"of {name}".encode()) for name in ("bob", "carol")},
}


def pages(*names, login=None):
    """Drives the pages of these people: a decorator; each is given as a function that asks and returns what answers."""

    def decorate(drive):
        people = login or PageLogin(lambda: PEOPLE)

        async def run(port, station):
            async with AsyncExitStack() as stack:
                opened = [await opened_page(stack, people, port, name) for name in names]
                await drive(station, *opened)

        with served(login=people) as (port, station):
            asyncio.run(run(port, station))

    return decorate


async def opened_page(stack, login, port, name):
    challenge, now = login.challenge(time.monotonic()), time.monotonic()
    answer = hmac.new(f"of {name}".encode(), challenge.encode(), "sha256").hexdigest()
    headers = {"Cookie": f"{COOKIE}={login.open(challenge, answer, now)}", "Origin": f"https://localhost:{port}"}
    session = await stack.enter_async_context(aiohttp.ClientSession(headers=headers))
    return await stack.enter_async_context(session.ws_connect(f"http://localhost:{port}/live?viewer=of-{name}"))


async def told(page, kind, wanted=lambda message: True):
    """The next message of a kind that is as wanted."""
    while (message := await page.receive_json(timeout=60))["kind"] != kind or not wanted(message):
        pass
    return message


def test_a_watchers_page_is_told_so_and_can_request_nothing():
    reason = "bob may only watch"

    @pages("bob", "anna")
    async def _(station, bob, anna):
        assert (await told(bob, "hello"))["visitor"] == {"name": "bob", "may_drive": False}
        assert (await told(anna, "hello"))["visitor"] == {"name": "anna", "may_drive": True}
        control = await told(anna, "control", lambda message: message["holder"] == "you")  # though bob was first
        assert control["watching"] == ["bob"]
        assert "watching" not in await told(bob, "control", lambda message: message["holder"] == "another")
        requests = (
            {"take_control": True},
            {"release_control": True},
            {"id": "1", "event": "mode_selected", "mode": "single"},
            {"id": "1", "layout": {}},
            {"counter": {}},
        )
        for request in requests:
            await bob.send_json(request)
            reply = await told(bob, "reply")
            assert (reply["result"], reply["reason"]) == ("refused", reason), request
        await bob.send_json({"attention": "hidden"})
        await bob.send_json({"clock": 1})
        await told(bob, "clock")
        assert station.attention is not Attention.HIDDEN


def test_the_driver_is_told_who_watches_until_they_leave():
    @pages("anna", "bob", "carol")
    async def _(_station, anna, bob, carol):
        await told(anna, "control", lambda message: message["watching"] == ["bob", "carol"])
        await bob.close()
        await told(anna, "control", lambda message: message["watching"] == ["carol"])


def test_a_watcher_that_reads_nothing_delays_no_picture_of_the_driver_and_fills_no_memory():
    @pages("anna", "bob")
    async def _(station, anna, bob):
        await told(anna, "control", lambda message: message["holder"] == "you")
        camera, picture = next(iter(station.page._index)), bytes(40_000)
        for number in range(500):  # 20 MB, which nothing between the two would hold
            station.page.show(camera, AccessUnit(picture, None, number / 10, key=number % 20 == 0))
            while not isinstance(message := (await anna.receive(timeout=60)).data, bytes):
                pass
            assert HEADER.unpack_from(message)[3] == number + 1
        slow = next(viewer for viewer in station.page._windows if viewer.visitor.name == "bob")
        assert len(slow._queues[0].live) + len(slow._queues[0].burst) <= 20 + 30
        await bob.send_json({"clock": 1})  # it is still there, and up to date once it reads
        newest = 0
        while not newest >= 490:
            message = await bob.receive(timeout=60)
            newest = HEADER.unpack_from(message.data)[5] / 100 if isinstance(message.data, bytes) else newest


def test_a_watcher_opens_no_more_windows_than_a_person_looks_at(monkeypatch):
    monkeypatch.setattr("runner.page.server.WATCHER_WINDOWS", 1)
    with pytest.raises(aiohttp.WSServerHandshakeError, match="429"):
        pages("bob", "anna", "anna", "bob")(None)


def test_a_watcher_whose_line_is_removed_is_disconnected_and_the_others_stay():
    people = dict(PEOPLE)

    @pages("bob", "carol", login=PageLogin(lambda: people))
    async def _(_station, bob, carol):
        await told(bob, "control")
        del people["bob"]
        while (await bob.receive(timeout=60)).type is not aiohttp.WSMsgType.CLOSE:
            pass
        await carol.send_json({"clock": 1})
        await told(carol, "clock")


def test_connections_without_access_replace_each_other_and_close_none_with_access(monkeypatch):
    """Otherwise a stranger could take all descriptors of the process that shows the pictures."""
    monkeypatch.setattr("runner.page.connections.MAX_STRANGERS", 5)
    one = OneSession()
    with served(login=one.login) as (port, _), ExitStack() as stack:

        def connected(path, cookie=""):
            line = stack.enter_context(socket.create_connection(("127.0.0.1", port), timeout=60))
            line.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost:{port}\r\n{cookie}\r\n".encode())
            assert line.recv(65536).startswith(b"HTTP/1.1 200")
            return line

        driver = connected("/", f"Cookie: {one.cookie}\r\n")
        strangers = [connected("/login") for _ in range(8)]
        for line in strangers[:3]:
            while line.recv(65536):
                pass
        driver.sendall(f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\nCookie: {one.cookie}\r\n\r\n".encode())
        assert driver.recv(1)
        strangers[-1].settimeout(0.1)
        with suppress(TimeoutError):
            while strangers[-1].recv(65536):
                pass
            raise AssertionError("the newest connection was closed")


@pytest.fixture
def keys(tmp_path):
    """An authority with the keys of alice, whose page is at 127.0.0.1."""
    authority = Authority(tmp_path / "keys")
    with authority.opened():
        authority.issue("alice", Role.CONTROLLER, ["127.0.0.1"])
        yield authority


def answered(port, keys, path="/login", host="", method="GET", **headers):
    """The serial number of the certificate that a page presents, and its answer."""
    tls = ssl.create_default_context(cafile=keys.directory / "alice" / keyring.AUTHORITY)
    connection = http.client.HTTPSConnection("127.0.0.1", port, context=tls, timeout=60)
    with closing(connection):
        connection.request(method, path, headers={"Host": host or f"127.0.0.1:{port}", **headers})
        serial = int(connection.sock.getpeercert()["serialNumber"], 16)
        return serial, connection.getresponse()


def test_new_keys_take_effect_while_the_page_runs(keys, monkeypatch):
    """The certificate, and the addresses that it names; while only one of two files is new, the old ones serve."""
    monkeypatch.setattr(keyring, "CHECK_S", 0)
    notes, directory = [], keys.directory / "alice"
    with served(keyring=Keyring.of(directory), note=notes.append) as (port, _):
        first, answer = answered(port, keys)
        assert (answer.status, answered(port, keys, host=f"localhost:{port}")[1].status) == (200, 403)
        shutil.copytree(directory, keys.directory / "old")
        keys.issue("alice", Role.CONTROLLER, ["127.0.0.1", "localhost"])
        new_key = (directory / keyring.KEY).read_bytes()
        shutil.copy(keys.directory / "old" / keyring.KEY, directory)
        assert answered(port, keys)[0] == first
        (directory / keyring.KEY).write_bytes(new_key)
        second, answer = answered(port, keys, host=f"localhost:{port}")
        assert (answer.status, second != first) == (200, True)
    reports = [note for note in notes if note.endswith("the previous content stays in force")]
    assert [f"must be a certificate that matches {keyring.KEY}" in report for report in reports] == [True]


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_the_page_accepts_nothing_older_than_tls_1_3(keys, version):
    context = ssl.create_default_context(cafile=keys.directory / "alice" / keyring.AUTHORITY)
    context.maximum_version = version
    refusal = pytest.raises(ssl.SSLError) if version < ssl.TLSVersion.TLSv1_3 else nullcontext()
    with served(keyring=Keyring.of(keys.directory / "alice")) as (port, _), refusal:
        line = socket.create_connection(("127.0.0.1", port), timeout=60)
        with line, context.wrap_socket(line, server_hostname="127.0.0.1"):
            pass


def test_a_handshake_that_never_ends_is_closed(keys, monkeypatch):
    monkeypatch.setattr("runner.page.connections.REQUEST_S", 0.3)
    with (
        served(keyring=Keyring.of(keys.directory / "alice")) as (port, _),
        socket.create_connection(("127.0.0.1", port), timeout=60) as line,
    ):
        assert line.recv(1) == b""


def test_every_refusal_is_reported_once_without_secrets_and_carries_the_policy(keys):
    notes, secret = [], (keys.directory / "alice" / keyring.TOKEN).read_text()
    with served(keyring=Keyring.of(keys.directory / "alice"), note=notes.append) as (port, _):
        own = {"Origin": f"https://127.0.0.1:{port}"}
        upgrade = dict(line.split(": ") for line in UPGRADE.split("\r\n"))
        refused = [
            ("/login", {"host": "evil.example:8090"}, 403, "Host 'evil.example:8090' is not an address of this page"),
            ("/", {"Origin": "https://evil.example"}, 403, "Origin 'https://evil.example' is another site"),
            ("/login", {"method": "POST"}, 403, "a POST without Origin"),
            (f"/live?viewer={secret}", upgrade, 401, "not logged in"),
            ("/static/../../../etc/passwd", own, 401, "not logged in"),
            ("/login/challenge", {"method": "PUT", **own}, 405, "method not allowed"),
        ]
        for path, headers, status, _ in refused * 3:
            answer = answered(port, keys, path, **headers)[1]
            policy = LOGIN_POLICY if path.startswith("/login") else POLICY
            assert (answer.status, answer.headers["Content-Security-Policy"]) == (status, policy), path
        redirect = answered(port, keys, "/?view=drive", **own)[1]
        assert (redirect.status, redirect.headers["Location"]) == (303, "/login?view=drive")
        assert redirect.headers["Content-Security-Policy"] == POLICY
    expected = [
        f"page: refused {headers.get('method', 'GET')} {path.partition('?')[0]!r} from 127.0.0.1: {why}"
        for path, headers, _, why in refused
    ]
    assert notes == expected


def test_a_path_outside_the_page_does_not_exist_and_is_reported():
    notes = []
    with served(note=notes.append) as (port, _), socket.create_connection(("127.0.0.1", port), timeout=60) as line:
        line.sendall(f"GET /static/%2e%2e/../server.py HTTP/1.1\r\nHost: localhost:{port}\r\n\r\n".encode())
        assert line.recv(12) == b"HTTP/1.1 404"
    assert notes == ["page: refused GET '/static/%2e%2e/../server.py' from 127.0.0.1: not found"]


def test_wrong_answers_to_the_login_do_not_displace_the_other_notes():
    notes, login = [], PageLogin(lambda: {"anna": PagePerson(Role.CONTROLLER, b"token")})
    with served(login=login, note=notes.append) as (port, _):
        own = f"Host: localhost:{port}\r\nOrigin: https://localhost:{port}\r\nConnection: close\r\n"
        for _ in range(100):
            with socket.create_connection(("127.0.0.1", port), timeout=60) as line:
                line.sendall(f"POST /login HTTP/1.1\r\n{own}Content-Length: 2\r\n\r\n{{}}".encode())
                assert line.recv(12) == b"HTTP/1.1 403"
    assert notes == ["page: refused POST '/login' from 127.0.0.1: wrong token"]


@pytest.mark.parametrize(
    ("port", "scheme", "accepted"),
    [
        (8090, "https", {"station.example.org:8090", "10.0.0.1:8090"}),
        (443, "https", {"station.example.org", "10.0.0.1", "station.example.org:443", "10.0.0.1:443"}),
        (443, "http", {"station.example.org:443", "10.0.0.1:443"}),
    ],
)
def test_a_page_is_known_by_the_names_that_browsers_send(port, scheme, accepted):
    assert hosts(("Station.example.org", "10.0.0.1"), port, scheme) == accepted
    assert hosts(("FD00:0::2",), 8090, scheme) == {"[fd00::2]:8090"}


def test_a_page_at_an_ipv6_address():
    try:
        with served("page.host=::1") as (port, _), socket.create_connection(("::1", port), timeout=60) as line:
            line.sendall(f"GET / HTTP/1.1\r\nHost: [::1]:{port}\r\nConnection: close\r\n\r\n".encode())
            assert line.recv(12) == b"HTTP/1.1 200"
    except RunError as error:  # only where there is no IPv6
        assert "cannot assign requested address" in str(error)


@pytest.mark.parametrize("line", [b"GET \x01 HTTP/1.1", b"\xff" * 50, b"GET / HTTP/9", b"GET / HTTP/1.1\r\nHost"])
def test_invalid_http_is_refused_without_a_traceback(line, caplog, capfd):
    with served() as (port, _), socket.create_connection(("127.0.0.1", port), timeout=60) as connection:
        connection.sendall(line + b"\r\n\r\n")
        assert connection.recv(12)[:10] in (b"HTTP/1.0 4", b"HTTP/1.1 4")
    assert (caplog.text, *capfd.readouterr()) == ("", "", "")


@pytest.mark.parametrize("host", ["127.0.0.1:abc", "[::1", "a:b:c", "127.0.0.1:99999", "%zz", "", "a b"])
def test_a_malformed_host_is_refused_without_a_traceback(host, caplog):
    with served() as (port, _):
        with socket.create_connection(("127.0.0.1", port), timeout=60) as line:
            line.sendall(f"GET / HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n".encode())
            answer = b"".join(iter(lambda: line.recv(65536), b""))
        with socket.create_connection(("127.0.0.1", port), timeout=60) as line:
            line.sendall(f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\nConnection: close\r\n\r\n".encode())
            assert line.recv(12) == b"HTTP/1.1 200"
    assert answer[:12] in (b"HTTP/1.1 403", b"HTTP/1.1 400")
    assert caplog.text == ""


def waiting():
    """Coroutines that have begun and not ended."""
    return [it for it in gc.get_objects() if inspect.iscoroutine(it) and it.cr_frame]


def test_no_handler_is_pending_once_the_page_has_stopped(monkeypatch):
    """Python 3.11 may crash at exit while a handler is pending."""
    monkeypatch.setattr("runner.page.loop.STOP_S", 30)  # enough, however busy the machine is
    hello = f"GET /live?viewer=me HTTP/1.1\r\nHost: localhost:PORT\r\n{UPGRADE}\r\n\r\n"
    before = waiting()  # a library that another test has used may keep a loop of its own
    with socket.socket() as line:
        with served() as (port, _):
            line.connect(("127.0.0.1", port))
            line.sendall(hello.replace("PORT", str(port)).encode())
            assert line.recv(12) == b"HTTP/1.1 101"
        assert [it.__qualname__ for it in waiting() if it not in before] == []


def test_hello_describes_each_cameras_pose_and_optics():
    async def first_message(port):
        own = f"http://localhost:{port}"
        async with aiohttp.ClientSession() as session, session.ws_connect(f"{own}/live?viewer=me", origin=own) as ws:
            return await ws.receive_json(timeout=60)

    native = "{width_px: 1920, height_px: 1080, left_px: 0, top_px: 30}"
    words = (
        "+cameras.front_left.framing=fit",
        "+cameras.rear_center.calibrated=true",
        f"+cameras.front_left.native={native}",
        "cameras.rear_center.place.column_span=2",
        "graph.key_interval_s=2.5",
    )
    with served(*words) as (port, _):
        hello = asyncio.run(first_message(port))
    cameras = {camera["name"]: camera for camera in hello["cameras"]}
    pose = {"x_m": 1.9, "y_m": 0.5, "z_m": 1.5, "yaw_deg": 55, "pitch_deg": 5, "roll_deg": 0}
    native = {"width": 1920, "height": 1080, "left": 0, "top": 30}
    optics = {"pose": pose, "fov_deg": 90, "lens": "pinhole", "native": native, "calibrated": False}
    assert {key: cameras["front_left"][key] for key in optics} == optics
    native = {"width": 1280, "height": 800, "left": 0, "top": 0}
    optics = {"fov_deg": 180, "lens": "fisheye", "native": native}
    assert {key: cameras["top_left"][key] for key in optics} == optics
    assert [name for name, camera in cameras.items() if camera["calibrated"]] == ["rear_center"]
    assert {camera["wave_s"] for camera in cameras.values()} == {2.5}
    assert hello["layout"]["places"]["front_left"] == {"row": 0, "column": 0, "row_span": 1, "column_span": 1}
    assert hello["layout"]["own"]["rear_center"] == {"row": 1, "column": 1, "row_span": 1, "column_span": 2}
    dimensions = {"wheelbase_m": 2.9, "track_m": 1.65, "width_m": 1.92, "front_m": 3.65, "rear_m": 0.95}
    assert hello["dimensions"] == dimensions
    assert [cameras[name]["framing"] for name in ("front_left", "front_right")] == ["fit", None]


async def attention_becomes(station, attention):
    for _ in range(500):
        if station.attention == attention:
            return
        await asyncio.sleep(0.01)
    assert station.attention == attention


def test_the_drivers_attention_is_reported_to_the_station():
    """Only the page in control counts: a closed page is absent."""

    async def drive(own, station):
        async with aiohttp.ClientSession() as session:
            driver = await session.ws_connect(f"{own}/live?viewer=driver", origin=own)
            await attention_becomes(station, None)
            await driver.send_json({"attention": "watching"})
            await attention_becomes(station, "watching")
            async with session.ws_connect(f"{own}/live?viewer=other", origin=own) as other:
                await other.send_json({"attention": "hidden"})
                await driver.send_json({"attention": "slow"})
                await attention_becomes(station, "slow")
                await other.send_json({"take_control": True})
                await attention_becomes(station, "hidden")
                await driver.send_json({"take_control": True})
                await attention_becomes(station, "slow")
                for invalid in ("absent", "asleep", 1, None):
                    await driver.send_json({"attention": invalid, "id": "1"})
                    while (reply := await driver.receive_json(timeout=60))["kind"] != "reply":
                        pass
                    assert reply["result"] == "refused"
            assert station.attention == "slow"
            await driver.close()
            await attention_becomes(station, "absent")
            driver = await session.ws_connect(f"{own}/live?viewer=driver", origin=own)
            await driver.send_json({"attention": "unfocused"})
            await attention_becomes(station, "unfocused")

    with served() as (port, station):
        asyncio.run(drive(f"http://localhost:{port}", station))


class Windows:
    """Windows of browsers, as a server's clients see it: a page or a monitor at each end of a WebSocket."""

    def __init__(self, session, stack, own):
        self._session, self._stack, self._own = session, stack, own

    async def open(self, viewer, browser, **more):
        query = urlencode({"viewer": viewer, "browser": browser, **more})
        connecting = self._session.ws_connect(f"{self._own}/live?{query}", origin=self._own)
        return await self._stack.enter_async_context(connecting)


async def received(ws, kind, **wanted):
    """The next message of a kind with these values."""
    while (message := await ws.receive_json(timeout=60))["kind"] != kind or not wanted.items() <= message.items():
        pass
    return message


def in_windows(steps, *overrides, **more):
    """Carry out steps with windows and the station of a page."""

    async def run(port, station):
        async with aiohttp.ClientSession() as session, AsyncExitStack() as stack:
            await steps(Windows(session, stack, f"http://localhost:{port}"), station)

    with served(*overrides, **more) as (port, station):
        asyncio.run(run(port, station))


def test_a_monitor_shares_selection_and_control_with_the_page_in_its_browser():
    async def steps(windows, station):
        requests = []
        station.ask = lambda document, on_reply: (requests.append(document), on_reply(Outcome(0, "applied", "")))
        monitor = await windows.open("m", "here", show="rear_center,front_left,nothing")
        hello = await received(monitor, "hello")
        assert [(camera["name"], camera["index"]) for camera in hello["cameras"]] == [
            ("front_left", 0),
            ("rear_center", 3),
        ]
        await received(monitor, "control", holder="nobody", abandoned=False)  # it does not take control that is free
        page = await windows.open("driver", "here")
        assert (await received(page, "hello"))["selected"] is None
        await received(page, "control", holder="you")
        await received(monitor, "control", holder="you")
        stranger = await windows.open("s", "there", show="rear_center")
        await received(stranger, "control", holder="another")

        await monitor.send_json({"select": "rear_center"})
        await received(page, "selection", camera="rear_center")
        await page.send_json({"select": "top_left"})
        await received(monitor, "selection", camera="top_left")
        second = await windows.open("m2", "here", show="top_left")
        assert (await received(second, "hello"))["selected"] == "top_left"
        assert (await received(await windows.open("s2", "there", show="top_left"), "hello"))["selected"] is None

        request = {"id": "1", "event": "mode_selected", "mode": "single"}
        await monitor.send_json(request)
        await received(monitor, "reply", id="1", result="applied")
        await stranger.send_json(request)
        await received(stranger, "reply", id="1", reason="this page does not hold control; take it first")
        assert requests == [{"event": "mode_selected", "mode": "single"}]
        await stranger.send_json({"id": "2", "event": "stop_requested"})  # which any window may
        await received(stranger, "reply", id="2", result="applied")
        await stranger.send_json({"id": "3", "event": "stop_lifted"})
        await received(stranger, "reply", id="3", reason="this page does not hold control; take it first")
        assert requests[1:] == [{"event": "stop_requested"}]
        for window in (monitor, stranger):
            await window.send_json({"take_control": True})
            await received(window, "reply", result="refused")

        other = await windows.open("other", "there")
        await received(stranger, "control", holder="another")
        await other.send_json({"take_control": True})
        await received(stranger, "control", holder="you")
        await received(monitor, "control", holder="another")
        await page.send_json({"take_control": True})
        await received(monitor, "control", holder="you")
        await page.close()
        await received(monitor, "control", holder="nobody", abandoned=True)
        await monitor.send_json(request)
        await received(monitor, "reply", reason="this page does not hold control; take it first")

    in_windows(steps)


def test_the_driver_needs_the_pictures_of_every_window_and_the_focus_in_one_of_them():
    async def steps(windows, station):
        page = await windows.open("driver", "here")
        monitor = await windows.open("m", "here", show="rear_center")
        stranger = await windows.open("s", "there", show="rear_center")
        await page.send_json({"attention": "watching", "focused": True})
        await attention_becomes(station, "watching")
        await received(monitor, "control", elsewhere=True)
        await stranger.send_json({"attention": "hidden"})
        await monitor.send_json({"attention": "unfocused"})
        await page.send_json({"attention": "unfocused"})
        await attention_becomes(station, "unfocused")
        await received(monitor, "control", elsewhere=False)
        await monitor.send_json({"attention": "watching", "focused": True})
        await attention_becomes(station, "watching")
        await received(page, "control", elsewhere=True)
        await monitor.send_json({"attention": "slow", "focused": True})
        await attention_becomes(station, "slow")
        await received(page, "control", elsewhere=True)
        await monitor.send_json({"attention": "hidden"})
        await attention_becomes(station, "hidden")
        await monitor.close()
        await attention_becomes(station, "unfocused")
        await page.close()
        await attention_becomes(station, "absent")

    in_windows(steps)


SEEN = {"x": 0, "y": 0, "width": 480, "height": 200, "screen_width": 240, "screen_height": 100}


async def view_becomes(station, wanted):
    for _ in range(600):
        view = {name: (seen.width, seen.screen_width) for name, seen in station.seen.view.items()}
        if view == wanted:
            return
        await asyncio.sleep(0.1)
    pytest.fail(f"view: {view}, not {wanted}")


def test_what_is_seen_is_what_the_windows_of_the_page_in_control_show_while_somebody_watches():
    async def steps(windows, station):
        names = list(setup().vehicle.cameras)
        nothing = dict.fromkeys(SEEN, 0)
        page = await windows.open("driver", "here")
        await received(page, "control", holder="you")
        monitor = await windows.open("m", "here", show="rear_center")
        stranger = await windows.open("s", "there")

        async def state(small=SEEN):
            """Of two cameras, the page shows one, the monitor the other."""
            await page.send_json({"view": {name: small if name == "front_center" else nothing for name in names}})
            await monitor.send_json({"view": {"rear_center": {**SEEN, "screen_width": 480}}})
            await stranger.send_json({"view": {"front_center": nothing}})

        await state()
        await received(page, "control")
        assert station.seen.view == {}  # nobody is known to watch
        await page.send_json({"attention": "watching", "focused": True})
        await monitor.send_json({"attention": "unfocused"})
        both = {name: {"front_center": (480, 240), "rear_center": (480, 480)}.get(name, (0, 0)) for name in names}
        await state()
        await view_becomes(station, both)
        await page.send_json({"view": {name: {**nothing, "x": -1} for name in names}})  # refused: it sees everything
        reply = await received(page, "reply")
        assert (reply["result"], reply["reason"]) == (
            "refused",
            f"view: {names[0]}: x: must be an integer from 0 to 65535",
        )
        await view_becomes(station, {})
        await state()
        await view_becomes(station, both)
        await monitor.send_json({"attention": "hidden"})
        await view_becomes(station, {})
        await monitor.send_json({"attention": "watching", "focused": True})
        await state()
        await view_becomes(station, both)
        await monitor.close()
        await view_becomes(station, {**both, "rear_center": (0, 0)})
        await stranger.send_json({"take_control": True})
        await view_becomes(station, {})  # it has not stated whether anybody watches
        await stranger.send_json({"attention": "watching", "focused": True})
        await stranger.send_json({"view": {"front_center": nothing}})
        await view_becomes(station, {"front_center": (0, 0)})
        await view_becomes(station, {})  # it has stated nothing for two seconds

    in_windows(steps)


PLACE = {"row": 0, "column": 0, "row_span": 1, "column_span": 2}


def test_a_layout_is_saved_by_the_page_in_control_and_sent_to_all(tmp_path):
    file = tmp_path / "layout" / "alice.yaml"

    async def steps(windows, station):
        page = await windows.open("driver", "here")
        assert (await received(page, "hello"))["layout"]["problem"] is None
        watcher = await windows.open("w", "there")
        monitor = await windows.open("m", "here", show="rear_center")
        await watcher.send_json({"id": "1", "layout": {"rear_center": PLACE}})
        await received(watcher, "reply", id="1", reason="this page does not hold control; take it first")
        assert not file.exists()
        await page.send_json({"id": "2", "layout": {"rear_center": PLACE}})
        for window in (page, watcher, monitor):
            layout = await received(window, "layout")
            assert {name: place for name, place in layout["places"].items() if place} == {"rear_center": PLACE}
            assert layout["saved"]
            assert layout["own"]["front_left"] == {"row": 0, "column": 0, "row_span": 1, "column_span": 1}
        await received(page, "reply", id="2", result="applied")
        assert "    rear_center: {row: 0, column: 0, column_span: 2}\n" in file.read_text()
        later = await received(await windows.open("late", "there"), "hello")
        assert later["layout"]["places"]["rear_center"] == PLACE
        await page.send_json({"id": "4", "drive": {"front": "rear_center"}})
        await received(page, "reply", id="4", result="applied")
        assert (await received(watcher, "layout"))["drive"] == {"front": "rear_center"}
        await page.send_json({"id": "5", "drive": None})
        await received(page, "reply", id="5", result="applied")
        await monitor.send_json({"id": "3", "layout": None})  # it has its page's control
        await received(monitor, "reply", id="3", result="applied")
        reset = await received(page, "layout")
        assert (reset["places"], reset["saved"]) == (layout["own"], False)
        assert file.read_text().endswith("vehicles: {}\n")

    in_windows(steps, layouts=Layouts(tmp_path, "alice"))
    assert [path.name for path in tmp_path.rglob("*")] == ["layout", "alice.yaml"]


@pytest.mark.parametrize(
    ("document", "reason"),
    [
        ({"layout": {"../x": PLACE}}, "'../x': must be letters, digits, _ and - only"),
        ({"layout": {"rear_centre": PLACE}}, "'rear_centre': unknown camera, did you mean rear_center?"),
        ({"layout": {"rear_center": {**PLACE, "row": -1}}}, "rear_center.row: -1: must be at least 0"),
        ({"layout": "../../x"}, "'../../x': must be a mapping"),
        ({"layout": {}, "operator": "../bob"}, "operator: unknown key, only layout is allowed"),
        ({"layout": {}, "drive": None}, "drive: unknown key, only layout is allowed"),
        ({"drive": {"front": "rear_centre"}}, "'rear_centre': unknown camera, did you mean rear_center?"),
        ({"layout": {}, "id": 7}, "id: must be given, as text of at most 64 characters"),
    ],
)
def test_a_layout_that_is_wrong_is_refused_and_nothing_is_written(tmp_path, document, reason):
    async def steps(windows, station):
        page = await windows.open("driver", "here")
        await received(page, "control", holder="you")
        await page.send_json({"id": "1", **document})
        assert (await received(page, "reply"))["reason"] == reason
        await page.send_json({"id": "2", "layout": {}})
        await received(page, "reply", id="2", result="applied")  # one refusal does not lock the next out

    in_windows(steps, layouts=Layouts(tmp_path / "conf", "alice"))
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["alice.yaml", "conf", "layout"]


def test_why_a_layout_cannot_be_saved(tmp_path):
    (tmp_path / "layout").touch()

    def reason_of(layouts):
        found = []

        async def steps(windows, station):
            page = await windows.open("driver", "here")
            found.append((await received(page, "hello"))["layout"]["problem"])
            await page.send_json({"id": "1", "layout": {"rear_center": PLACE}})
            found.append((await received(page, "reply", id="1", result="refused"))["reason"])

        in_windows(steps, layouts=layouts)
        return found

    assert reason_of(None) == [NOWHERE, NOWHERE]
    early, late = reason_of(Layouts(tmp_path, "alice"))
    assert early is None
    assert late.startswith(f"{tmp_path}/layout/alice.yaml: cannot be written: ")


def test_the_combined_attention_of_several_windows():
    hidden, slow, watching, unfocused = Attention.HIDDEN, Attention.SLOW, Attention.WATCHING, Attention.UNFOCUSED
    assert combined_attention([]) is combined_attention([None]) is None
    assert combined_attention([None, unfocused]) is unfocused
    assert combined_attention([unfocused, watching]) is watching
    assert combined_attention([watching, slow]) is slow
    assert combined_attention([slow, hidden, watching]) is hidden


def window(token, browser="", monitor=False):
    return SimpleNamespace(token=token, browser=browser, monitor=monitor)


def test_which_page_a_window_belongs_to():
    control, monitor = Control(), window("m", "a", monitor=True)
    pages = [window("1", "a"), window("2", "a"), window("3", "b"), monitor]
    assert [page_of(each, pages, control) for each in pages] == ["1", "2", "3", "2"], "the newest of its browser"
    control.take("1")
    assert page_of(monitor, pages, control) == "1"
    control.take("3")
    assert page_of(monitor, pages, control) == "2"
    assert page_of(monitor, [monitor], control) == "m"
    nameless = window("n", "", monitor=True)
    assert page_of(nameless, [window("4"), nameless], control) == "n", (
        "it shares nothing with pages that state no browser"
    )
    control.on_closed("3", 0)
    assert control.holder_for(page_of(nameless, [nameless], control)) == "nobody"


def test_a_monitor_gets_only_the_pictures_of_its_cameras():
    burst = []
    viewer = PageViewer("me", [1, 3], lambda camera: burst.append(camera) or [unit(camera, key=True)], "here", True)
    for camera in range(4):
        viewer.show(camera, unit(9))
        viewer.restart(camera)
    assert [(camera, number) for camera, _, number in sent(viewer)] == [(1, 1), (3, 3)]
    assert burst == [1, 3]
    assert sent(PageViewer("me", [], lambda camera: [unit(0, key=True)], "here", True)) == []


def test_a_viewer_starts_with_a_burst_of_which_only_the_last_unit_is_drawn():
    viewer = PageViewer("me", range(1), lambda camera: [unit(0, key=True), unit(7), unit(8)])
    viewer.show(0, unit(8))  # part of the burst already
    assert sent(viewer) == [(0, KEY | RESTART | CATCH_UP, 0), (0, CATCH_UP, 7), (0, 0, 8)]
    viewer.show(0, unit(9))
    viewer.show(0, unit(10, key=True))
    assert sent(viewer) == [(0, 0, 9), (0, KEY, 10)]


def test_a_viewer_that_starts_late_is_not_shown_a_mixed_picture():
    """Others go on: their decoders hold what was sent before."""
    stored = [unit(0, key=True)]
    viewer, late = (PageViewer(name, range(1), lambda camera: stored) for name in ("viewer", "late"))
    assert sent(viewer) == [(0, KEY | RESTART, 0)]
    units = [unit(7)._replace(whole=False), unit(8)._replace(whole=False), unit(9), unit(10)._replace(whole=False)]
    stored.append(units[0])
    for each in units[1:]:
        viewer.show(0, each)
    assert sent(viewer) == [(0, 0, 8), (0, 0, 9), (0, 0, 10)]
    assert sent(late) == [(0, KEY | RESTART | CATCH_UP, 0), (0, CATCH_UP, 7)]
    for each in units[1:]:
        late.show(0, each)
    assert sent(late) == [(0, CATCH_UP, 8), (0, 0, 9), (0, 0, 10)]


def test_a_viewer_waits_for_a_burst_and_a_single_unit_is_drawn():
    burst = []
    viewer = PageViewer("me", range(1), lambda camera: burst)
    assert sent(viewer) == []
    burst.append(unit(0, key=True))
    assert sent(viewer) == [(0, KEY | RESTART, 0)]


def test_texts_go_first_and_cameras_take_turns():
    viewer = PageViewer("me", range(2), lambda camera: [unit(0, key=True), unit(1)])
    viewer.post("state", {})
    assert [m if isinstance(m, str) else m[0] for m in sent(viewer)] == ["state", 0, 1, 0, 1]


def test_a_viewer_that_lags_restarts_and_its_queue_stays_bounded():
    newest = []
    viewer = PageViewer("me", range(1), lambda camera: [unit(0, key=True), *newest])
    sent(viewer)
    for number in range(1, 201):
        newest[:] = [unit(number)]
        viewer.show(0, newest[0])
    assert sent(viewer) == [(0, KEY | RESTART | CATCH_UP, 0), (0, 0, 200)]


def test_a_viewer_that_is_always_behind_still_sees_pictures_and_its_queue_stays_bounded():
    """It gets a twentieth of what arrives: each burst is out of date before it is sent, but its end is a picture."""
    newest = [unit(number) for number in range(1, 41)]
    viewer = PageViewer("me", range(1), lambda camera: [unit(0, key=True), *newest])
    drawn = 0
    for number in range(4000):
        newest[:] = [*newest[1:], unit(number % 256)]
        viewer.show(0, newest[-1])
        if number % 20 == 0:
            drawn += not HEADER.unpack_from(viewer.pop())[1] & CATCH_UP
        queue = viewer._queues[0]
        assert len(queue.live) + len(queue.burst) <= 41 + 30
    assert drawn == 4


def test_texts_are_bounded_too():
    viewer = PageViewer("me", range(0), lambda camera: [])
    for _ in range(10_000):
        viewer.post("sample", {})
    assert len(sent(viewer)) == 500


def test_the_header_states_times_in_ms_and_an_unknown_capture_as_nan():
    viewer = PageViewer("me", range(1), lambda camera: [unit(5, key=True, captured=0.25)])
    assert HEADER.unpack_from(viewer.pop()) == (0, KEY | RESTART, 0, 1, 250.0, 500.0)
    viewer = PageViewer("me", range(1), lambda camera: [unit(5, key=True)])
    assert math.isnan(HEADER.unpack_from(viewer.pop())[4])


def test_a_unit_that_states_its_region_has_it_behind_the_header():
    placed = unit(5, key=True)._replace(region=Roi(2, 300, 640, 480))
    viewer = PageViewer("me", range(1), lambda camera: [placed])
    message = viewer.pop()
    assert HEADER.unpack_from(message)[1] == KEY | RESTART | PLACED
    assert REGION.unpack_from(message, HEADER.size) == (2, 300, 640, 480)
    assert message[HEADER.size + REGION.size :] == placed.data


def test_control_belongs_to_one_page():
    control = Control()
    control.on_opened("a", 0)
    control.on_opened("b", 1)
    assert [control.holder_for(page) for page in "ab"] == ["you", "another"]
    control.take("b")
    assert [control.holder_for(page) for page in "ab"] == ["another", "you"]


def test_a_reload_keeps_control_and_a_page_that_left_loses_it():
    control = Control()
    control.on_opened("a", 0)
    control.on_closed("a", 1)
    control.on_opened("b", 1 + GRACE_S / 2)
    assert control.holder_for("b") == "nobody"
    control.on_opened("a", 1 + GRACE_S)
    assert control.holder_for("a") == "you"
    control.on_closed("a", 10)
    control.on_opened("c", 11 + GRACE_S)
    assert control.holder_for("c") == "you"
    control.on_opened("a", 12 + GRACE_S)
    assert control.holder_for("a") == "another"


def test_a_watching_page_that_connects_again_gets_no_control():
    control = Control()
    control.on_opened("driver", 0)
    control.on_opened("watcher", 1)
    for page in ("driver", "watcher"):  # the network fails for longer than a reload takes
        control.on_closed(page, 2)
    control.on_opened("watcher", 12, before="another")
    assert control.holder_for("watcher") == "nobody"
    control.on_opened("driver", 13, before="you")
    assert control.holder_for("driver") == "you"


def test_after_a_restart_of_the_station_its_driver_gets_control_again():
    control = Control()
    for page, before in (("watcher", "another"), ("opened before", "nobody"), ("driver", "you"), ("opened", None)):
        control.on_opened(page, 1, before)
    assert control.holder_for("driver") == "you"


def sample(time, position=None):
    camera = CameraSample(
        fps=10,
        kbps=time,
        allocated_kbps=500,
        demand_kbps=1000,
        scaling=None,
        width=0,
        height=0,
        latency_ms=None,
        lost=0,
        rebuilt=0,
        frames=0,
        bytes=0,
        damaged=0,
        stages_ms=LatencyStages(),
        arrivals=(),
    )
    return Sample(time, None, 0, 0, position, 0, {"front": camera})


def test_history_keeps_a_point_a_second_for_minutes():
    history = History()
    assert history.columns()["time"] == []
    for quarter in range(4 * (MAX_SAMPLES + 50)):
        history.add(sample(quarter / 4))
    columns = history.columns()
    assert len(columns["time"]) == MAX_SAMPLES
    assert columns["time"][-2:] == [MAX_SAMPLES + 48, MAX_SAMPLES + 49]
    assert columns["cameras"]["front"]["kbps"] == columns["time"]


def test_history_restarts_when_the_clock_is_set_back():
    history = History()
    for t in (100, 101, 50, 51):
        history.add(sample(t))
    assert history.columns()["time"] == [50, 51]


def test_history_keeps_none_for_unknown_values():
    history = History()
    history.add(sample(0))
    history.add(sample(1, position=Position(48.1, 11.6)))
    assert history.columns()["lat"] == [None, 48.1]
    assert history.columns()["cameras"]["front"]["scaling"] == [None, None]
