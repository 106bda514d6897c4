"""User names and passwords of IP cameras, from files: they appear in no configuration, printout or process list."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from gi.repository import GLib, Gst

from runner.graph import Plan
from runner.gst.rtspsrc import is_rtsp_client
from runner.system.backoff import pause_s
from runner.system.files import read_credentials
from runner.system.rtsp import describe

REFUSED_S = (60.0, 1800.0)  # after a refused login, until the next one: doubled from the first value up to the second
ASKED_S = 10.0  # how long the camera may take to say which logins it accepts


class Login:
    """How a camera is logged in to, over all of its connections.

    A camera locks out who tries wrong passwords. So after a refused login nothing is tried until a growing pause is
    over, or the file of the credentials has changed.

    on_report  called, from any thread, with a sentence when the camera refuses the login
    """

    def __init__(self, plan: Plan, on_report: Callable[[str], None]) -> None:
        given = plan.camera.credentials
        self._file = None if given is None else Path(given)
        self._plan, self._on_report = plan, on_report
        self._stamp: tuple[int, ...] | None = None  # of the file, when it was last read
        self._refused = 0  # logins in a row
        self._until = 0.0  # s by the monotonic clock
        self._reason: str | None = None
        self._unknown_login: str | None = None  # why GStreamer cannot log in

    def log_in(self, pipeline: Gst.Bin) -> str | None:
        """As the function `log_in`, for the next attempt."""
        self._stamp, self._until = self._current_stamp(), 0.0
        return log_in(pipeline, self._plan)

    @property
    def refusal(self) -> str | None:
        """Why the camera must not be asked now; None if it may."""
        if not self._refused or time.monotonic() >= self._until or self._current_stamp() != self._stamp:
            return None
        return self._reason

    def follow(self, bus: Gst.Bus) -> None:
        """Handle the errors of a bus."""
        bus.enable_sync_message_emission()
        bus.connect("sync-message::error", lambda _bus, message: self.handle(message))

    def handle(self, message: Gst.Message) -> None:
        """An error may say that the camera has refused the login of an RTSP client."""
        if was_refused(message.parse_error()[0]) and is_rtsp_client(message.src):
            self._refuse(message.src)

    def _refuse(self, client: Gst.Element) -> None:
        pause = pause_s(self._refused, *REFUSED_S)
        self._refused, self._until = self._refused + 1, time.monotonic() + pause
        what = "asks for a user and a password: name their file as credentials"
        changes = ""
        if self._file is not None:
            what, changes = f"refuses the user or the password of {self._file}", ", or once this file has changed"
        self._reason = self._unknown_login or f"the camera {what}"
        self._on_report(f"{self._reason}; next attempt after {pause:g} s{changes}")
        if self._refused == 1:
            address = client.get_property("location")
            threading.Thread(target=self._ask, args=(address,), name="challenge", daemon=True).start()

    def accept(self) -> None:
        """The camera has streamed."""
        self._refused = 0

    def _ask(self, address: str) -> None:
        """Ask the camera which logins it accepts: only after a refusal, and without trying one."""
        with suppress(OSError, ValueError):  # what it said before has been reported
            self._unknown_login = describe(address, ASKED_S).unknown_login
            if self._unknown_login:
                self._reason = self._unknown_login
                self._on_report(self._unknown_login)

    def _current_stamp(self) -> tuple[int, ...] | None:
        if self._file is None:
            return None
        try:
            stat = self._file.stat()
        except OSError:
            return None
        return stat.st_ino, stat.st_size, stat.st_mtime_ns, stat.st_ctime_ns


def was_refused(error: GLib.Error) -> bool:
    """Whether an error says that a camera demands another login, or one at all."""
    return bool(error.matches(Gst.ResourceError.quark(), Gst.ResourceError.NOT_AUTHORIZED))


def log_in(pipeline: Gst.Bin, plan: Plan) -> str | None:
    """Set the user name and password of the elements of a new source.

    returns  why it cannot, such as a file that others may read; None if it can, or no file is configured
    """
    if plan.camera.credentials is None:
        return None
    path = Path(plan.camera.credentials)
    try:
        user, password = read_credentials(path)
    except ValueError as error:
        return f"credentials {path}: {error}"
    for element in (pipeline.get_by_name(element.name) for element in plan.source):
        if element and element.find_property("user-id") and element.find_property("user-pw"):
            element.set_property("user-id", user)
            element.set_property("user-pw", password)
    return None
