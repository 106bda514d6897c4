"""Feeds pictures of a bag into an appsrc: read in a separate thread, in real time or as fast as they are consumed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

from gi.repository import GLib, Gst

from runner.bag import PICTURES, Bag
from runner.bag.pictures import BadPicture, Picture, bayer_pattern
from runner.core.model import BagTopic, ModelError
from runner.graph import Plan
from runner.gst.source import BEHIND_S

POLL_S = 0.5  # while waiting for the next picture, how often the thread checks that its pipeline still runs
VIDEO = {codec: f"video/x-{codec},stream-format=byte-stream,alignment=au" for codec in ("h264", "h265")}
ENCODED = {"jpeg": "image/jpeg", "png": "image/png", **VIDEO}
BAYER_NAME = "bayer"  # of what converts Bayer patterns
# What decodes one as grey becomes a pattern again.
MOSAIC = (
    "{form}dec ! videoconvert ! video/x-raw,format=GRAY8 ! capssetter join=false caps=video/x-bayer,format={pattern}"
)
NO_BAYER = "pictures in Bayer patterns need bayer2rgb; on Debian: apt-get install gstreamer1.0-plugins-bad"
BLOCKING = {"leaky-type": 0, "block": True}  # of an appsrc that drops nothing and blocks until a picture is consumed


def play_bag(pipeline: Gst.Bin, plan: Plan, bag: BagTopic, on_report: Callable[[str], None]) -> None:
    """Let the source of a new pipeline play a bag as a camera would: live, at the bag's pace."""
    source = pipeline.get_by_name(plan.source[0].name)
    BagFeed(source, bag, plan.camera.fps, plan.camera.source.loop, on_report)


def read_bag(source: Gst.Element, bag: BagTopic, fps: Fraction, loop: bool = False) -> BagFeed:
    """Let an appsrc of a new pipeline pass a bag's pictures as fast as they are consumed; none may be skipped."""
    source.set_property("is-live", False)
    _block(source)
    return BagFeed(source, bag, fps, loop)


class BagFeed:
    """Pushes the pictures of a topic into an appsrc once it requests data.

    The first picture is pushed immediately; the running times of the others follow from their stamps. A bag
    that cannot be read ends the pipeline, as an error of its source.

    fps        stated in the caps, Hz
    loop       start again at the end, one mean interval after the last picture
    on_report  called with a line about skipped pictures; playback is in real time. None: pictures are pushed as fast
               as they are consumed, and a picture that would be skipped is an error

    `first` is the stamp of the first picture, ns since 1970; None before it. `pushed` counts pictures.
    """

    def __init__(
        self,
        source: Gst.Element,
        bag: BagTopic,
        fps: Fraction,
        loop: bool,
        on_report: Callable[[str], None] | None = None,
    ) -> None:
        self._source, self._bag, self._fps, self._loop, self._on_report = source, bag, fps, loop, on_report
        self.first: int | None = None
        self.pushed = 0
        self._interval = round(Gst.SECOND / fps)  # between two rounds, ns
        self._shift = 0  # from stamps to running time, ns
        self._last = -1  # running time of the last picture, ns
        self._form: Picture | None = None  # the picture whose size and format the others must have
        self._skipped = 0  # pictures of this round
        self._told = False  # of the first skipped picture
        self._waiting = threading.Event()  # never set: the daemon thread itself checks that its pipeline still runs
        self._starting = source.connect("need-data", self._on_need_data)

    def _on_need_data(self, source: Gst.Element, _bytes: int) -> None:
        """From the streaming thread, once."""
        source.disconnect(self._starting)
        threading.Thread(target=self._run, name="bag", daemon=True).start()

    def _run(self) -> None:
        try:
            with Bag(Path(self._bag.path)) as bag:
                bag.find(PICTURES, self._bag.topic, "pictures")
                while self._play_once(bag) and self._loop:
                    pass
            self._source.emit("end-of-stream")
        except ModelError as error:
            self._fail(f"{error.found}: {error.rule}")

    def _play_once(self, bag: Bag) -> bool:
        """Play the bag once; returns False if the pipeline is gone."""
        began, count, number = 0, 0, 0
        for number, picture in enumerate(bag.pictures(self._bag.topic, self._bag.depth_m), 1):
            if why := self._problem(picture, first=not count):
                self._skip(bag, f"picture {number}{why}")
                continue
            assert isinstance(picture, Picture)
            if not count and not self._begin(picture):
                return False
            self._last = max(picture.ns + self._shift, self._last + 1)
            if not self._push(picture):
                return False
            began, count = began if count else self._last, count + 1
        if not count:
            raise ModelError("topic", bag.names(self._bag.topic), f"none of its {number} pictures can be shown")
        if count > 1:
            self._interval = (self._last - began) // (count - 1)
        self._count_skipped(bag, number)
        return True

    def _begin(self, picture: Picture) -> bool:
        """Start a round with this picture; returns False if nothing converts it."""
        if self._form is None:
            self._form, self.first = picture, picture.ns
            if picture.format in VIDEO:
                _block(self._source)  # those that follow need each of them
            if bayer_pattern(picture.format) and not accept_bayer(self._source, picture.format):
                return False
            form = caps(picture.format, picture.width, picture.height, self._fps)
            self._source.set_property("caps", Gst.Caps.from_string(form))
            start = self._now() if self._on_report else 0
        else:
            start = self._last + self._interval
        self._shift = start - picture.ns
        return True

    def _problem(self, picture: Picture | BadPicture, first: bool) -> str | None:
        """Why a picture cannot be shown after the previous ones, to follow its number; None: it can.

        first  of its round
        """
        if isinstance(picture, BadPicture):
            return f": {picture.why}"
        form = self._form
        if form is None:
            return None
        is_video = picture.format in VIDEO  # whose decoder follows its size, and which has no picture to spare
        if not is_video and (picture.width, picture.height) != (form.width, form.height):
            return f" is {picture.size}, the first one {form.size}"
        if picture.format != form.format:
            return f" is {picture.format}, the first one {form.format}"
        if not is_video and not first and picture.ns + self._shift <= self._last:
            return " is not later than the one before"
        return None

    def _skip(self, bag: Bag, why: str) -> None:
        """Count a skipped picture and report the first one; raises ModelError if none may be skipped."""
        where = bag.names(self._bag.topic)
        if self._on_report is None:
            raise ModelError("topic", where, why)
        self._skipped += 1
        if not self._told:
            self._told = True
            self._on_report(f"{where}: {why}: such pictures are skipped")

    def _count_skipped(self, bag: Bag, of: int) -> None:
        """After the first round, report how many pictures were skipped."""
        if self._skipped and self._on_report and self.pushed + self._skipped == of:
            self._on_report(f"{bag.names(self._bag.topic)}: {self._skipped} of {of} pictures were skipped")

    def _push(self, picture: Picture) -> bool:
        """Push a picture when it is due; returns False if the pipeline is gone."""
        if self._on_report:
            while (early := self._last - self._now()) > 0:
                self._waiting.wait(min(early / Gst.SECOND, POLL_S))
                if self._source.get_state(0).state < Gst.State.PAUSED:
                    return False
            if -early > BEHIND_S * Gst.SECOND:  # like a clip, it does not catch up
                self._shift -= early
                self._last -= early
        buffer = Gst.Buffer.new_wrapped(picture.data)
        buffer.pts = self._last
        self.pushed += 1
        return bool(self._source.emit("push-buffer", buffer) == Gst.FlowReturn.OK)

    def _now(self) -> int:
        """Running time of the pipeline, ns; 0 once the source has been removed from it."""
        clock = self._source.get_clock()
        return int(clock.get_time() - self._source.get_base_time()) if clock else 0

    def _fail(self, why: str) -> None:
        error = GLib.Error.new_literal(Gst.ResourceError.quark(), why, Gst.ResourceError.READ)
        self._source.post_message(Gst.Message.new_error(self._source, error, ""))


def _block(source: Gst.Element) -> None:
    for key, value in BLOCKING.items():
        source.set_property(key, value)


def accept_bayer(source: Gst.Element, form: str) -> bool:
    """Let the pictures of an appsrc be Bayer patterns: decodebin itself plugs no element that converts them.

    form  as in `Picture`

    To be called before the first picture is pushed; has no effect afterwards. Returns False if it cannot, which an
    error of the appsrc says once, or if the appsrc is being removed.
    """
    out = source.get_static_pad("src")
    below = out.get_peer()
    if below is None:
        return False
    if below.get_parent_element().get_name() == BAYER_NAME:
        return True
    compressed, _, pattern = form.rpartition("-")
    decode = MOSAIC.format(form=compressed, pattern=pattern) + " ! " if compressed else ""
    try:
        convert = Gst.parse_bin_from_description(f"{decode}bayer2rgb", True)
    except GLib.Error:
        out.unlink(below)  # the next call finds it so
        error = GLib.Error.new_literal(Gst.CoreError.quark(), NO_BAYER, Gst.CoreError.MISSING_PLUGIN)
        source.post_message(Gst.Message.new_error(source, error, ""))
        return False
    convert.set_name(BAYER_NAME)
    source.get_parent().add(convert)
    out.unlink(below)
    convert.get_static_pad("src").link(below)
    convert.sync_state_with_parent()
    out.link(convert.get_static_pad("sink"))
    return True


def caps(form: str, width: int, height: int, fps: Fraction) -> str:
    """Caps for a format named as in `Picture`."""
    rate = f"framerate={fps.numerator}/{fps.denominator}"
    if (encoded := form.partition("-")[0]) in ENCODED:
        return f"{ENCODED[encoded]},{rate}"
    if bayer_pattern(form):
        return f"video/x-bayer,format={form},width={width},height={height},{rate}"
    return f"video/x-raw,format={form},width={width},height={height},pixel-aspect-ratio=1/1,{rate}"
