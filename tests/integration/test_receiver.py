"""The operator's receivers: a vehicle that starts late or disappears, other senders, a link that is cut."""

from __future__ import annotations

import gc
import socket
import struct
import threading
import time
from collections import Counter
from contextlib import ExitStack, contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from statistics import median

import inside
import pytest

from rig import SMALL_ROBOT, STREAM_END_SIGNALS, count_handlers, free_port, rtp_session, until
from runner.core.commands import Command
from runner.errors import RunError

CAMERAS = ("front", "rear")
SENDING = dict.fromkeys(CAMERAS, True)
WORDS = (*SMALL_ROBOT, "source=test", "fps_max=15")


def compiled(*words):
    from runner.apply import check_plan
    from runner.configuration.config import configuration
    from runner.plans import compile_plans

    setup = configuration([*WORDS, f"media.port={free_port()}", *words], check=check_plan).setup()
    return setup, [plan for plan in compile_plans(setup) if plan.camera.name in CAMERAS]


@contextmanager
def sending(setup, plans):
    from runner.apply import VehicleSide

    side = VehicleSide(plans, setup.media, lambda camera, what: None)
    knobs = {"sending": True, "size": (320, 180), "bitrate": 300}
    side.turn([Command(camera, knob, value) for camera in CAMERAS for knob, value in knobs.items()])
    try:
        yield side
    finally:
        side.stop()


@contextmanager
def receiving(plans):
    """Yields (side, messages, a function that waits for n more frames of every camera)."""
    from runner.apply import OperatorSide

    messages = []
    side = OperatorSide(plans, lambda cameras, what: messages.append(f"{cameras}: {what}"))

    def frames():
        return {name: received.frames for name, received in side.sample(SENDING).items()}

    def more(n=10):
        before = frames()
        until(lambda: all(now - before[name] >= n for name, now in frames().items()), every_s=0.1)

    try:
        yield side, messages, more
    finally:
        side.stop()


def test_waiting_for_a_vehicle_that_starts_later_is_silent():
    setup, plans = compiled()
    with receiving(plans) as (side, messages, more):
        end = time.monotonic() + 3
        while time.monotonic() < end:
            side.sample({})
            time.sleep(0.1)
        with sending(setup, plans):
            more()
            assert {received.rebuilt for received in side.sample(SENDING).values()} == {0}
            assert messages == []


def test_a_vehicle_that_is_away_is_reported_once_and_its_return_once():
    setup, plans = compiled()
    with receiving(plans) as (side, messages, more):
        with sending(setup, plans):
            more()
        end = time.monotonic() + 8
        while time.monotonic() < end:
            side.sample(SENDING)
            time.sleep(0.1)
        away = list(messages)
        with sending(setup, plans):
            more()
            until(lambda: any("works again" in what for what in messages))
            assert {received.rebuilt for received in side.sample(SENDING).values()} == {1}
            back = messages[len(away) :]
    assert 1 <= len(away) <= 4  # each reason once; cameras with the same one are named together
    assert len(set(away)) == len(away)
    assert all(" works again after " in what for what in back)


def test_the_end_of_a_stream_is_handled_here_and_not_by_the_client():
    """The client's handlers of RTCP BYE and time-outs may deadlock with the failure of its connection."""
    setup, plans = compiled()
    with sending(setup, plans), receiving(plans) as (side, messages, more):
        more()
        pipeline, elements = inside.receiver(side, "front"), []
        pipeline.get_bus().connect("message::eos", lambda *_: elements.append("ended"))
        session, ssrc = rtp_session(pipeline.get_by_name("client"))
        sources = {source.props.ssrc: source for source in session.props.sources}
        assert [count_handlers(session, name) for name in STREAM_END_SIGNALS] == [2, 2, 2]
        session.emit("on-timeout", sources[ssrc])  # frames arrive
        for other in sources.keys() - {ssrc}:  # the receiver's own, and one of retransmitted packets
            session.emit("on-bye-ssrc", sources[other])
        more()
        assert side.sample(SENDING)["front"].rebuilt == 0
        session.emit("on-bye-ssrc", sources[ssrc])
        until(lambda: side.sample(SENDING)["front"].rebuilt == 1)
        more()
        assert any("the stream ended" in what for what in messages)
        assert elements == []


def test_a_client_is_not_stopped_while_it_frees_its_connection():
    """It reports an error first, and frees its connection in its own thread."""
    from runner.gst import GLib, Gst
    from runner.gst.rtspsrc import Opening

    bus, client = Gst.Bus(), Gst.ElementFactory.make("identity")
    opening, stopped = Opening(), threading.Event()
    opening.follow(bus)

    def report(kind):
        bus.post(Gst.Message.new_progress(client, kind, "open", ""))

    opening.wait()  # nothing is being opened
    report(Gst.ProgressType.START)
    report(Gst.ProgressType.CONTINUE)
    opening.wait()  # it may be stopped meanwhile
    bus.post(Gst.Message.new_error(client, GLib.Error("refused"), ""))
    stopping = threading.Thread(target=lambda: opening.wait() or stopped.set())
    stopping.start()
    assert not stopped.wait(0.2)
    report(Gst.ProgressType.ERROR)
    assert stopped.wait(1)
    stopping.join()
    setup, plans = compiled()
    with sending(setup, plans), receiving(plans) as (side, _, more):
        more()
        source = inside.receiver(side, "front").get_by_name("client")
        assert source.get_property("teardown-timeout") > 1000 * source.get_property("tcp-timeout")  # ns, µs


def open_ports():
    """UDP ports of this process on all addresses, which anybody reaches: those of RTSP clients."""
    own = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):  # closed meanwhile
            own.add(descriptor.stat().st_ino)
    bound = [line.split() for line in Path("/proc/self/net/udp").read_text().splitlines()[1:]]
    places = [words[1].split(":") for words in bound if int(words[9]) in own]
    return [int(port, 16) for address, port in places if int(address, 16) == 0]


def test_packets_of_other_senders_are_dropped_and_counted():
    setup, plans = compiled()
    with sending(setup, plans), receiving(plans) as (side, messages, more):
        more()
        until(lambda: len(open_ports()) == 2 * len(CAMERAS))  # RTP and RTCP; a client that is freed closes its own
        ports = open_ports()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.bind(("127.0.0.2", 0))
            for number in range(500):
                packet = struct.pack(">BBHII", 0x80, 0x80 | 96, number, 3000 * number, 0xBAD) + b"\x41" * 100
                for port in ports:
                    stranger.sendto(packet, ("127.0.0.1", port))
                if number % 50 == 0:
                    side.sample(SENDING)  # other sockets of this machine may drop packets, too
        more(20)
        samples = side.sample(SENDING)
        assert sum(received.foreign for received in samples.values()) == 500 * len(ports)
        assert {(received.lost, received.rebuilt) for received in samples.values()} == {(0, 0)}
        until(lambda: messages)
    assert messages == ["front, rear: packets from hosts other than the vehicle are dropped"]


def test_an_unresponsive_server_is_retried_every_two_seconds():
    """Accepts connections and sends nothing, like a vehicle that hangs."""
    setup, plans = compiled()
    with socket.create_server((setup.media.host, setup.media.port)) as server:
        server.settimeout(30)
        with receiving(plans[:1]) as (_, messages, _more), ExitStack() as connections:
            connected = []
            for _ in range(4):
                connections.enter_context(server.accept()[0])
                connected.append(time.monotonic())
            assert messages == []
    assert median(after - before for before, after in pairwise(connected)) < 2.0


def test_loss_during_a_rebuild_shows_until_a_wave_is_complete():
    """Another viewer keeps the stream running, so that it does not begin with an IDR picture."""
    setup, plans = compiled("media.max_viewers=2")
    with sending(setup, plans), receiving(plans) as (_, _, watched), receiving(plans) as (side, _, more):
        watched()
        more()
        assert side.sample(SENDING)["front"].damaged == 0
        inside.fail(inside.receiver(side, "front"), "made to fail")
        until(lambda: side.sample(SENDING)["front"].rebuilt == 1, every_s=0.1)
        more()
        until(lambda: side.sample(SENDING)["front"].damaged > 0, every_s=0.1)
        until(lambda: not side.take_arrivals()[""].damaged, every_s=0.1)


def test_what_was_rebuilt_is_freed_at_once():
    """Python cannot free an object that holds a pad whose probe holds the object, and is late with other cycles."""
    from runner.gst.repair import RepairBuffer
    from runner.gst.repeats import RepeatDetector
    from runner.gst.sender_stages import EncoderWatch

    def alive():
        kinds = (RepairBuffer, RepeatDetector, EncoderWatch)
        return Counter(type(each) for each in gc.get_objects() if isinstance(each, kinds))

    setup, plans = compiled()
    with sending(setup, plans), receiving(plans[:1]) as (side, _, more):
        more()
        before = alive()
        assert len(before) == 3
        gc.disable()
        try:
            for number in range(1, 4):
                inside.fail(inside.receiver(side, "front"), "made to fail")
                until(lambda n=number: side.sample(SENDING)["front"].rebuilt == n, every_s=0.1)
                more()
            until(lambda: alive() == before, every_s=0.2)
        finally:
            gc.enable()


@pytest.mark.alone
def test_a_receiver_that_locks_up_does_not_delay_the_others(monkeypatch):
    """As rtspsrc can on network faults, on its way to NULL."""
    from runner.gst import Gst, aside

    monkeypatch.setattr(aside, "HUNG_S", 1.0)
    freed = threading.Event()

    class Stuck(Gst.Bin):
        def do_change_state(self, transition):
            if transition == Gst.StateChange.READY_TO_NULL:
                freed.wait(120)
            return Gst.Bin.do_change_state(self, transition)

    setup, plans = compiled()
    with sending(setup, plans):
        try:
            with receiving(plans) as (side, messages, more):
                more()
                stuck, pipeline = Stuck(), inside.receiver(side, "front")
                pipeline.add(stuck)
                stuck.sync_state_with_parent()
                inside.fail(pipeline, "locked up")
                more(30)  # both: another receiver replaces the stuck one
                until(lambda: any(aside.HUNG in what for what in messages))
                began = time.monotonic()
            assert time.monotonic() - began < 60  # 120 s if it waited for the stuck one
        finally:
            freed.set()
    assert messages[0] == "front: locked up"
    assert f"front: {aside.HUNG}" in messages


def test_calls_run_although_timers_keep_gstreamer_s_thread_busy():
    from gi.repository import GLib

    with receiving([]) as (side, _, _more):
        busy = GLib.timeout_add(0, lambda: True)  # always due, as a timer is on an overloaded machine
        try:
            for _ in range(3):
                assert side.sample({}) == {}
        finally:
            GLib.source_remove(busy)


def test_work_that_hangs_in_gstreamer_s_thread_is_reported(monkeypatch):
    from gi.repository import GLib

    freed = threading.Event()
    with receiving([]) as (side, _, _more):
        try:
            GLib.idle_add(lambda: freed.wait(30) and False)
            with monkeypatch.context() as patch, pytest.raises(RunError) as raised:
                patch.setattr("runner.gst.glib_thread.CALL_S", 0.2)
                until(lambda: side.sample({}))
            what = "reading the receivers' counters"
            assert str(raised.value) == f"GStreamer hangs: {what} takes more than 0.2 s"
        finally:
            freed.set()


def test_cameras_are_received_while_they_are_asked_for():
    setup, plans = compiled()
    with sending(setup, plans) as vehicle, receiving(plans) as (side, messages, more):
        more()

        def watched():
            return {name for name in CAMERAS if vehicle.read()[name].encoded.frames}

        assert watched() == set(CAMERAS)
        side.receive(["rear"])
        until(lambda: watched() == {"rear"})
        at_stop = side.sample(SENDING)["front"]
        assert (at_stop.frames > 0, at_stop.width, at_stop.latency_ms) == (True, 0, None)
        side.receive([])
        until(lambda: watched() == set())
        assert side.sample(SENDING)["front"] == at_stop  # although the vehicle says that it sends
        side.receive(CAMERAS)
        more()
        assert side.sample(SENDING)["front"].frames > at_stop.frames  # its counters go on
        assert {received.rebuilt for received in side.sample(SENDING).values()} == {0}
        assert messages == []


def test_a_side_may_begin_without_any_camera():
    from runner.apply import OperatorSide

    setup, plans = compiled()
    with sending(setup, plans) as vehicle:
        side = OperatorSide(plans, lambda *_: None, cameras=())
        try:
            assert {received.frames for received in side.sample(SENDING).values()} == {0}
            assert side.take_arrivals()[""].frames == {}
            side.receive(["front"])
            until(lambda: side.sample(SENDING)["front"].frames > 5)
            assert not vehicle.read()["rear"].encoded.frames
        finally:
            side.stop()
