"""Shared by the tests with real GStreamer: free ports, one-camera vehicles, a client that inspects pictures."""

from __future__ import annotations

import itertools
import json
import os
import queue
import random
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from runner.errors import RunError
from runner.graph import FEEDBACK, Plan
from runner.link import check_possible
from runner.operator.station import Listener
from runner.records import to_json
from runner.records.lines import Note
from runner.records.operator import Sample
from runner.records.vehicle import VehicleState, state_to_json
from runner.security.keyring import Keyring

CHECKOUT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("TOD_SHARED_DATA", CHECKOUT.parent / "shared" / "data"))
CLIPS = sorted((SHARED / "video").glob("*")) if SHARED.is_dir() else []

ROBOT_SIZES = {"front": (320, 180), "rear": (424, 240), "mast": (400, 300)}


def small_robot(*cameras: str) -> tuple[str, ...]:
    """Words for a robot with these cameras only, and smaller pictures: the processor has time to spare."""
    absent = [f"~cameras.{name}" for name in ROBOT_SIZES if name not in cameras]
    sizes = [(f"cameras.{name}", *ROBOT_SIZES[name]) for name in cameras]
    small = [word for key, width, height in sizes for word in (f"{key}.width_px={width}", f"{key}.height_px={height}")]
    native = ["cameras.front.native={width_px: 320, height_px: 240, top_px: 30}"] if "front" in cameras else []
    return ("vehicle=delivery_robot", *absent, *small, *native)


SMALL_ROBOT = small_robot(*ROBOT_SIZES)
# Likewise two cameras of the paper's vehicle.
SMALL_FRONT = tuple(
    f"cameras.{name}.{size}" for name in ("front_left", "front_right") for size in ("width_px=480", "height_px=260")
)
# Without the measured link: a busy machine delays packets, which would lower the total.
ROBOT = (
    *SMALL_ROBOT,
    "source=test",
    "fps_max=15",
    "modes=open_loop",
    "pqos=constant",
    "pqos.kbps=3000",
    "page.serve=false",
)

_SNOW = "{name: source, element: videotestsrc, properties: {is-live: true, pattern: snow}}"
_RAW = "{name: raw, element: capsfilter, properties: {caps: '{raw_caps}'}}"
NOISE = ("source=test", f"source.elements=[{_SNOW}, {_RAW}]")  # noise, for which the encoder needs all of its bitrate

# Starts and draws with less processor time than the whole browser, on the same engine.
BROWSER = shutil.which("chromium-headless-shell") or shutil.which("chromium")
needs_browser = pytest.mark.skipif(not BROWSER, reason="needs chromium-headless-shell or chromium")
# No sandbox inside containers; no background traffic to hosts that a closed network refuses anyway.
CHROMIUM_FLAGS = [
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]


SHIFTED = """\
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>
static volatile long *ahead_ns; /* shared with who sets the clock; 0 in a process whose command line lacks SIDE */
static int (*own)(clockid_t, struct timespec *);
static long monotonic_ns(void) {
  struct timespec now;
  own(CLOCK_MONOTONIC, &now);
  return now.tv_sec * 1000000000 + now.tv_nsec;
}
__attribute__((constructor)) static void look(void) {
  char line[4096];
  int file = open("/proc/self/cmdline", O_RDONLY), size = (int)read(file, line, sizeof line);
  close(file);
  for (int at = 0; at < size; at += (int)strlen(line + at) + 1)
    if (!strcmp(line + at, SIDE) && !ahead_ns)
      ahead_ns = mmap(0, sizeof *ahead_ns, PROT_READ, MAP_SHARED, open(AHEAD_FILE, O_RDONLY), 0);
}
int clock_gettime(clockid_t id, struct timespec *t) {
  if (!own) own = dlsym(RTLD_NEXT, "clock_gettime");
  int failed = own(id, t);
  if (failed || id != CLOCK_REALTIME || !ahead_ns) return failed;
  long drift_ns = (monotonic_ns() - BEGAN_NS) / 1000 * FAST_PPM / 1000;
  long ns = t->tv_sec * 1000000000 + t->tv_nsec + *ahead_ns + drift_ns;
  t->tv_sec = ns / 1000000000, t->tv_nsec = ns % 1000000000;
  return 0;
}
int gettimeofday(struct timeval *t, void *zone) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  t->tv_sec = now.tv_sec, t->tv_usec = now.tv_nsec / 1000;
  return 0;
}
time_t time(time_t *at) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (at) *at = now.tv_sec;
  return now.tv_sec;
}
"""
needs_compiler = pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")


def _no_namespaces() -> str:
    """Why this process cannot make network namespaces; "" if it can."""
    try:
        check_possible("netns")
    except RunError as error:
        return str(error)
    return ""


needs_root = pytest.mark.skipif(bool(_no_namespaces()), reason=_no_namespaces())


def clock_ahead(directory: Path, seconds: float, verb: str = "vehicle", fast_ppm: int = 0) -> dict[str, str]:
    """The environment in which CLOCK_REALTIME of one verb, alone or in a demo, is ahead, and too fast from now on.

    directory  of this clock, which `set_clock` sets while the process runs
    """
    directory.mkdir(exist_ok=True)
    (directory / "shifted.c").write_text(SHIFTED)
    (directory / "ahead").touch()
    set_clock(directory, seconds)
    began, ahead = f"-DBEGAN_NS={time.monotonic_ns()}L", f'-DAHEAD_FILE="{directory / "ahead"}"'
    values = (f'-DSIDE="{verb}"', ahead, began, f"-DFAST_PPM={fast_ppm}")
    command = ["cc", "-shared", "-fPIC", *values, "-o", "shifted.so", "shifted.c", "-ldl"]
    subprocess.run(command, cwd=directory, check=True)
    return {"LD_PRELOAD": str(directory / "shifted.so")}


def set_clock(directory: Path, seconds: float) -> None:
    """Set how far ahead a clock of `clock_ahead` is, in the middle of whatever reads it."""
    with (directory / "ahead").open("r+b") as file:
        file.write(round(1e9 * seconds).to_bytes(8, sys.byteorder, signed=True))


# Of vehicles by default and in tests: each takes those that are free at the moment when a viewer comes.
RTP_PORTS = range(20_000, 22_000)


# Below the ephemeral range of Linux: a client might take one of those before a side under test has bound it.
def _own_ports() -> Iterator[int]:
    """Ports that no other process of the tests hands out: until its end, an abstract socket claims a block of them."""
    blocks = [begin for begin in range(10_000, 30_000, 100) if begin not in RTP_PORTS]
    random.SystemRandom().shuffle(blocks)
    for begin in blocks:
        claim = socket.socket(socket.AF_UNIX)
        try:
            claim.bind(f"\0tod-runner-tests-{begin}")
        except OSError:
            claim.close()
            continue
        _CLAIMS.append(claim)
        yield from range(begin, begin + 100)


_CLAIMS: list[socket.socket] = []
_PORTS = itertools.cycle(_own_ports())

WAIT_S = 60.0  # a demo starts in 3 s, and in 15 if five such tests run in parallel
ANSWERED_S = 10.0  # before a request is sent again


def _has_ipv6() -> bool:
    with socket.socket(socket.AF_INET6) as probe:
        try:
            probe.bind(("::1", 0))
        except OSError:
            return False
    return True


LOOPBACK6 = "::1" if _has_ipv6() else "127.0.0.1"  # some tests run with it, so that IPv6 is tested where it exists


def free_port(count: int = 1) -> int:
    """The first of so many ports in a row that nothing is bound to, UDP or TCP, and that were not handed out before."""
    row: list[int] = []
    while len(row) < count:
        port = next(_PORTS)
        follows = bool(row) and port == row[-1] + 1
        row = [*(row if follows else []), port] if _is_free(port) else []
    return row[0]


def even_ports(count: int) -> range:
    """So many ports of `free_port` in a row, of which the first is even, as for RTP and RTCP."""
    first = free_port(count + 1) + 1
    first -= first % 2
    return range(first, first + count)


def _is_free(port: int) -> bool:
    if port == 10080:  # the one in this range that browsers refuse (Fetch, bad port)
        return False
    with socket.socket() as tcp, socket.socket(type=socket.SOCK_DGRAM) as udp:
        try:
            tcp.bind(("127.0.0.1", port))
            udp.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def over_tcp(plan: Plan) -> Plan:
    """The plan with an operator that receives RTSP over TCP, which loses nothing on a busy machine."""
    client, *rest = plan.operator
    return replace(plan, operator=(replace(client, properties={**client.properties, "protocols": "tcp"}), *rest))


def children_named(parent: int, name: str) -> list[int]:
    """Children of a process, by a word of their command lines."""
    files = Path(f"/proc/{parent}/task").glob("*/children")
    found = [int(word) for file in files for word in file.read_text().split()]
    return [pid for pid in found if name in Path(f"/proc/{pid}/cmdline").read_text()]


def answers(port: int, host: str = "127.0.0.1") -> bool:
    """Whether a server listens on a port."""
    with socket.socket() as probe:
        return probe.connect_ex((host, port)) == 0


def until(done: Callable[[], Any], seconds: float = WAIT_S, every_s: float = 0.01) -> Any:
    """Wait until a condition is true; the limit is far above what is normal."""
    end = time.monotonic() + seconds
    while not (seen := done()):
        assert time.monotonic() < end, "timed out"
        time.sleep(every_s)
    return seen


def passes(done: Callable[[], Any], seconds: float = WAIT_S) -> bool:
    """Whether a condition becomes true in time."""
    try:
        return bool(until(done, seconds))
    except AssertionError:
        return False


@contextmanager
def repeating(call: Callable[[], Any], every_s: float) -> Iterator[None]:
    """Call a function regularly, in a thread of its own."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(every_s):
            call()

    thread = threading.Thread(target=repeat)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


class RecordingListener(Listener):
    """Records a station's reports, as ("state" | "sample" | "note", record)."""

    def __init__(self) -> None:
        self.received: list[tuple[str, Any]] = []

    def on_state(self, state: VehicleState | None) -> None:
        self.received.append(("state", state))

    def on_sample(self, sample: Sample) -> None:
        self.received.append(("sample", sample))

    def on_note(self, note: Note) -> None:
        self.received.append(("note", note))

    @property
    def notes(self) -> list[str]:
        return [record.text for kind, record in self.received if kind == "note"]


class Operator:
    """An operator's end of the control link, as a program would implement it.

    keys  directory of its keys, which then name it
    """

    def __init__(self, broker: Any, vehicle: str = "delivery_robot", name: str = "", keys: Path | None = None) -> None:
        from runner.mqtt.link import ControlLink
        from runner.mqtt.login import Login
        from runner.mqtt.messages import OPERATOR_GONE, read_state, topic

        login = Login(Keyring(keys), print) if keys else None
        self.broker, self.name = broker, login.user if login else name or f"op{free_port()}"
        self.states: queue.Queue[Any] = queue.Queue()
        self.last: Any = None  # state
        self.replies: dict[str, Any] = {}
        self.telemetry: list[Any] = []
        self._clock: tuple[float, float] | None = None  # the vehicle's time, and when it arrived
        self.requests = topic(vehicle, "request", self.name)
        listen = {
            topic(vehicle, "state"): lambda message: self.states.put(state_to_json(read_state(message.payload))),
            topic(vehicle, "reply", self.name): lambda m: self.replies.update({(r := json.loads(m.payload))["id"]: r}),
            topic(vehicle, "telemetry"): self._on_telemetry,
        }
        will = (self.requests, OPERATOR_GONE)
        self.link = ControlLink(broker, will, listen, lambda here: None, lambda what: None, login)
        self.link.connect()
        assert self.link.wait_connected(WAIT_S)

    def _on_telemetry(self, message: Any) -> None:
        from runner.mqtt.messages import read_telemetry

        arrived, telemetry = time.monotonic(), read_telemetry(message.payload)
        if not message.retained:
            self._clock = (telemetry.t, arrived)
        self.telemetry.append(to_json(telemetry))

    def as_of(self) -> float:
        """The vehicle's current time, estimated from its telemetry."""
        vehicle, arrived = until(lambda: self._clock)
        return float(vehicle) + time.monotonic() - arrived

    def send(self, identity: str, **event: Any) -> None:
        until(lambda: self.link.wait_connected(0.1))  # a link that is down sends nothing
        self.link.publish(self.requests, {"id": identity, "as_of": self.as_of(), **event})

    def ask(self, identity: str, **event: Any) -> Any:
        """Sends it again if nothing answers: a request or its answer may be lost with the connection."""

        def asked() -> Any:
            self.send(identity, **event)
            return passes(lambda: self.replies.get(identity), ANSWERED_S) and self.replies[identity]

        return until(asked)

    def state(self, wanted: Callable[[Any], bool]) -> Any:
        """The next state that fulfils a condition."""
        end = time.monotonic() + WAIT_S
        while not wanted(state := self.states.get(timeout=max(0.0, end - time.monotonic()))):
            self.last = state
        self.last = state
        return state

    def reach(self, wanted: Callable[[Any], bool]) -> Any:
        """The last state if it fulfils a condition, otherwise the next one that does."""
        return self.last if self.last and wanted(self.last) else self.state(wanted)

    def publish(self, payload: bytes, topic: str = "", retain: bool = False) -> None:
        """Publish any payload as a request, or to another topic, as any program can that the broker lets in."""
        from paho.mqtt.publish import single

        single(topic or self.requests, payload, 1, retain, self.broker.host, self.broker.port)


def run(*words: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """The command line in its own process."""
    command = [sys.executable, "-m", "runner", *words]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), **options.pop("env", {})}
    options = {"cwd": CHECKOUT, "timeout": 120, **options}
    return subprocess.run(command, capture_output=True, text=True, check=False, env=environment, **options)


@contextmanager
def process(
    verb: str,
    *words: str,
    stdout: int = subprocess.PIPE,
    env: Mapping[str, str] | None = None,
    before: Sequence[str] = (),
    cwd: Path = CHECKOUT,
) -> Iterator[subprocess.Popen[str]]:
    """A verb in its own process, killed at the end; `before` is prepended to its command line."""
    command = [*before, sys.executable, "-m", "runner", verb, *words]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT), **(env or {})}
    with subprocess.Popen(
        command, stdout=stdout, stderr=subprocess.STDOUT, text=True, env=environment, cwd=cwd
    ) as child:
        try:
            yield child
        finally:
            child.kill()


@contextmanager
def streaming(
    *overrides: str, cameras: Sequence[str] = ("front_left",), keyring: Keyring | None = None
) -> Iterator[Any]:
    """Some cameras of a vehicle behind a real RTSP server. Yields (side, setup, plans, reports)."""
    from runner.apply import VehicleSide, check_plan
    from runner.configuration.config import configuration
    from runner.plans import compile_plans

    words = ["source=test", *overrides, f"media.port={free_port()}"]
    setup = configuration(words, check=check_plan).setup()
    setup = setup.with_cameras({name: setup.vehicle.cameras[name] for name in cameras or setup.vehicle.cameras})
    plans = compile_plans(setup)
    reported: list[str] = []
    side = VehicleSide(plans, setup.media, lambda camera, what: reported.append(f"{camera}: {what}"), keyring=keyring)
    try:
        yield side, setup, plans, reported
    finally:
        side.stop()


def faults(reported: Sequence[str]) -> list[str]:
    """The reports without those of a camera's rate, which a busy machine may not keep."""
    return [line for line in reported if not re.fullmatch(r".*: (\d+ of )?[\d.]+ Hz( again)?", line)]


def rejected(reported: Sequence[str]) -> list[str]:
    """The reports of values that elements rejected."""
    return [line for line in reported if " after it was set to " in line]


class Client:
    """Receives and decodes one camera; keeps the size of each frame and, if requested, the last picture.

    feedback  requests retransmission of lost packets (AVPF), as the operator's side does
    """

    def __init__(self, plan: Any, *, pictures: bool = False, feedback: bool = False) -> None:
        from runner.gst import Gst
        from runner.gst.caps import structure

        self.gst, self._structure = Gst, structure
        line = plan.receiver if feedback else plan.receiver.replace(f"/{FEEDBACK} ", " ")
        if pictures:
            head, _, _ = line.rpartition(" ! ")
            sink = "appsink name=sink sync=false max-buffers=1 drop=true"
            line = f"{head} ! videoconvert ! video/x-raw,format=RGB ! {sink}"
        self.sizes: list[tuple[int, int]] = []
        self.times: list[float] = []
        self.errors: list[str] = []
        self.pipeline = Gst.parse_launch(line)
        for element in plan.operator[:1]:
            client = self.pipeline.get_by_name(element.name)
            if client and client.find_property("tcp-timeout"):  # as patient as the server: it does not reconnect
                client.set_property("tcp-timeout", 20_000_000)
        self._sink = self.pipeline.get_by_name("sink")
        self._sink.get_static_pad("sink").add_probe(Gst.PadProbeType.BUFFER, self._on_frame)
        self.pipeline.get_bus().set_sync_handler(self._on_message)
        self.pipeline.set_state(Gst.State.PLAYING)

    def _on_frame(self, pad: Any, _info: Any) -> Any:
        picture = self._structure(pad.get_current_caps())
        self.sizes.append((picture.get_int("width")[1], picture.get_int("height")[1]))
        self.times.append(time.monotonic())
        return self.gst.PadProbeReturn.OK

    def _on_message(self, _bus: Any, message: Any) -> Any:
        kinds = self.gst.MessageType
        parse = {kinds.ERROR: message.parse_error, kinds.WARNING: message.parse_warning}.get(message.type)
        if parse:
            self.errors.append(parse()[0].message)
        return self.gst.BusSyncReply.PASS

    def picture(self) -> Any:
        """The newest picture as an array of RGB."""
        import numpy as np

        sample = self._sink.emit("try-pull-sample", 5 * self.gst.SECOND)
        caps = self._structure(sample.get_caps())
        width, height = caps.get_int("width")[1], caps.get_int("height")[1]
        data = sample.get_buffer().extract_dup(0, sample.get_buffer().get_size())
        stride = len(data) // height
        return np.frombuffer(data, np.uint8).reshape(height, stride)[:, : width * 3].reshape(height, width, 3)

    def frames_with_retry(self) -> int:
        """Number of frames received; reconnects if the server refused it with 503, as it does when a camera's first
        frame takes too long on a busy machine."""
        if self.errors and not self.sizes:
            self.reconnect()
        return len(self.sizes)

    def reconnect(self) -> None:
        self.close()
        self.errors.clear()
        self.pipeline.set_state(self.gst.State.PLAYING)

    def close(self) -> None:
        self.pipeline.set_state(self.gst.State.NULL)

    def end(self) -> None:
        """Let go of the pipeline: it holds this client by its callbacks, and would keep two descriptors open."""
        self.close()
        del self.pipeline, self._sink


@contextmanager
def watching(plan: Any, *, pictures: bool = False, feedback: bool = False) -> Iterator[Client]:
    client = Client(plan, pictures=pictures, feedback=feedback)
    try:
        yield client
    finally:
        client.end()


CAMERA_VIDEO = (
    "videotestsrc is-live=true ! video/x-raw,format=I420,width=320,height=240,framerate=25/1 "
    "! x264enc tune=zerolatency speed-preset=ultrafast key-int-max=25 ! rtph264pay name=pay0 pt=96 config-interval=-1"
)
IP_CAMERA = """
import sys
from runner.gst import GLib
from gi.repository import GstRtsp, GstRtspServer
server = GstRtspServer.RTSPServer()
server.set_address("127.0.0.1")
server.set_service(sys.argv[1])
factory = GstRtspServer.RTSPMediaFactory()
factory.set_launch(f"( {sys.argv[4]} )")
factory.set_shared(True)
if user := sys.argv[2]:
    auth, token, permissions = GstRtspServer.RTSPAuth(), GstRtspServer.RTSPToken(), GstRtspServer.RTSPPermissions()
    auth.set_supported_methods(GstRtsp.RTSPAuthMethod.DIGEST)
    token.set_string(GstRtspServer.RTSP_TOKEN_MEDIA_FACTORY_ROLE, "user")
    auth.add_digest(user, sys.argv[3], token)
    for name in (GstRtspServer.RTSP_PERM_MEDIA_FACTORY_ACCESS, GstRtspServer.RTSP_PERM_MEDIA_FACTORY_CONSTRUCT):
        permissions.add_permission_for_role("user", name, True)
    factory.set_permissions(permissions)
    server.set_auth(auth)
server.get_mount_points().add_factory("/stream", factory)
server.attach(None)
print("serves", flush=True)
GLib.MainLoop().run()
"""


STREAM_END_SIGNALS = ("on-bye-ssrc", "on-bye-timeout", "on-timeout")  # of an RTP session


def rtp_session(client: Any) -> tuple[Any, int]:
    """The session of an RTSP client that receives one stream, and the stream's SSRC."""
    _, _, _, number, ssrc, _ = client.srcpads[0].get_name().split("_")
    return client.get_by_name("manager").emit("get-internal-session", int(number)), int(ssrc)


def count_handlers(session: Any, name: str) -> int:
    """Of a signal of an RTP session: one is rtpsession's."""
    from gi.repository import GObject

    kind, blocked = GObject.signal_lookup(name, session), []
    match = GObject.SignalMatchType.ID | GObject.SignalMatchType.UNBLOCKED
    while handler := GObject.signal_handler_find(session, match, kind, 0, None, None, None):
        GObject.signal_handler_block(session, handler)
        blocked.append(handler)
    for handler in blocked:
        GObject.signal_handler_unblock(session, handler)
    return len(blocked)


@contextmanager
def ip_camera(
    port: int, user: str = "", password: str = "", media: str = CAMERA_VIDEO
) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """An IP camera in its own process. Yields its address and the process, which may be stopped or killed.

    user   who may watch it; "": everybody
    media  what it sends, each medium ending in a payloader named pay0, pay1, ...
    """
    command = [sys.executable, "-c", IP_CAMERA, str(port), user, password, media]
    environment = {**os.environ, "PYTHONPATH": str(CHECKOUT)}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment, cwd=CHECKOUT) as child:
        try:
            assert child.stdout is not None
            assert child.stdout.readline() == "serves\n"
            yield f"rtsp://127.0.0.1:{port}/stream", child
        finally:
            child.kill()
