"""A camera without refresh waves: whoever joins late is sent a key picture, and nobody else waits for one."""

from __future__ import annotations

import asyncio
import subprocess
import time
from fractions import Fraction

import aiohttp
import pytest

from rig import SMALL_ROBOT, answers, free_port, process, streaming, until, watching
from runner.core.commands import Command
from runner.core.graph_settings import NEVER_S
from runner.h264.access_unit import nal_units
from runner.page.viewer import CATCH_UP, HEADER, KEY

pytestmark = pytest.mark.gst

NO_WAVES = ("modes.automatic.waves_by_loss={loss: 0.01, calm_s: 1}", "graph.longest_wave_s=0")
IDR, SPS = 5, 7
RECENT_S = 6  # after which a station no longer keeps what followed a key picture


def units_of(client):
    """The NAL unit types of each access unit that a player receives."""
    units = []

    def on_unit(_pad, info):
        data = info.get_buffer()
        kinds = [header & 0x1F for header, _ in nal_units(data.extract_dup(0, data.get_size()))]
        units.append(kinds)
        return client.gst.PadProbeReturn.OK

    pad = client.pipeline.get_by_name("received").get_static_pad("sink")
    pad.add_probe(client.gst.PadProbeType.BUFFER, on_unit)
    return units


def test_players_that_ask_for_nothing_are_sent_one_key_picture_all_who_join_together():
    words = (*SMALL_ROBOT, "cameras.rear.fps=20", *NO_WAVES)
    with streaming(*words, cameras=("rear",)) as (side, _, (plan,), _), watching(plan) as first:
        knobs = {"sending": True, "size": (424, 240), "bitrate": 600, "wave_s": Fraction(NEVER_S)}
        side.turn([Command("rear", knob, value) for knob, value in knobs.items()])
        until(lambda: first.frames_with_retry() > 20)
        seen = units_of(first)
        until(lambda: len(seen) > 60)
        del seen[:20]  # a wave may have been on its way
        assert not any(IDR in kinds or SPS in kinds for kinds in seen)
        with watching(plan) as second, watching(plan) as third:
            joined = [units_of(second), units_of(third)]
            until(lambda: all(any(IDR in kinds for kinds in units) for units in joined))
            until(lambda: len(second.sizes) > 3 and len(third.sizes) > 3)
            assert all(SPS in kinds for kinds in seen if IDR in kinds)
            assert 1 <= sum(IDR in kinds for kinds in seen) <= 2  # within a second they share one


class Window:
    """Units that a window of the page receives: by camera, their flags and when they came."""

    def __init__(self, url, viewer):
        self._address, self._url = f"{url}live?viewer={viewer}", url
        self.units, self.opened = {}, 0.0

    async def watch(self, done):
        session = aiohttp.ClientSession()
        async with session, session.ws_connect(self._address, origin=self._url.rstrip("/"), max_msg_size=0) as ws:
            self.opened = time.monotonic()
            while not done():
                message = await ws.receive(60)
                if message.type == aiohttp.WSMsgType.BINARY:
                    camera, flags, *_ = HEADER.unpack_from(message.data)
                    self.units.setdefault(camera, []).append((flags, time.monotonic() - self.opened))


def test_a_window_that_opens_late_begins_with_a_key_picture_of_its_own():
    port = free_port()
    words = (
        *SMALL_ROBOT,
        *NO_WAVES,
        f"page.port={port}",
        f"media.port={free_port()}",
        f"control.port={free_port()}",
        "duration_s=300",
        "fps_max=10",
    )

    async def look():
        early, late = Window(url, "early"), Window(url, "late")
        ended = False
        first = asyncio.create_task(early.watch(lambda: ended))
        while not early.units:
            await asyncio.sleep(0.1)
        await asyncio.sleep(RECENT_S)
        before = {camera: len(units) for camera, units in early.units.items()}
        await late.watch(lambda: len(late.units) == len(before) and all(len(own) > 5 for own in late.units.values()))
        ended = True
        await first
        return early, late, before

    with process("demo", *words, stdout=subprocess.DEVNULL) as child:
        until(lambda: answers(port) or child.poll() is not None, seconds=300)
        url = f"http://127.0.0.1:{port}/"
        early, late, before = asyncio.run(look())
        child.terminate()
        child.wait(timeout=15)
    for camera, units in late.units.items():
        print(f"camera {camera}: {1000 * units[0][1]:.0f} ms to the first picture of a late window")
        assert units[0][0] & KEY
        assert not any(flags & CATCH_UP for flags, _ in units)  # no older picture has to be made up for
        assert not any(
            flags & (KEY | CATCH_UP) for flags, _ in early.units[camera][before[camera] - 20 : before[camera]]
        )
        assert sum(flags & KEY > 0 for flags, _ in early.units[camera][before[camera] :]) <= 3
