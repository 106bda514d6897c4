"""A child process that takes requests as lines and answers in lines of JSON."""

from __future__ import annotations

import json
import os
import select
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

from runner.errors import RunError
from runner.link.limit import LinkCounters, Rates
from runner.system import children, signals

ANSWER_S = 5.0  # a child that has not answered by then never will
END_S = 0.5  # how long it may take to end once its input is closed
POLL_MS = 50  # how soon a signal to this process is noticed


class Child:
    """Takes requests on its standard input; every output line that is not JSON is an error.

    name     for messages
    command  must end with its standard input; it is killed with the thread that creates this object
    """

    def __init__(self, name: str, command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        self._name = name
        pipe = subprocess.PIPE
        # In its own session, so that Ctrl-C ends the parent but not the child, which counts until the end.
        self._process = subprocess.Popen(
            children.bound(command),
            stdin=pipe,
            stdout=pipe,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
        assert self._process.stdout
        self._out = self._process.stdout.fileno()
        self._rest = b""

    def ask(self, *lines: str) -> Any:
        """Send lines and wait for one answer.

        raises  RunError with its output instead
        """
        assert self._process.stdin
        try:
            self._process.stdin.write("".join(f"{line}\n" for line in lines).encode())
            self._process.stdin.flush()
        except OSError:
            pass  # it has ended; its output follows
        return self.answer()

    def answer(self) -> Any:
        """The next answer. raises RunError as `ask`"""
        errors: list[str] = []
        for line in self._lines():
            if line[:1] in ("{", "["):
                if errors:
                    break
                return json.loads(line)
            errors.append(line.strip())
        else:
            # The last line of a traceback is enough.
            errors = errors[-1:] if errors[:1] == ["Traceback (most recent call last):"] else errors
            errors.append(f"it ended: {children.ending(self._process.wait(END_S))}")
        raise RunError(f"{self._name}: {'; '.join(errors)}")

    def check(self) -> None:
        """raises RunError if it has ended"""
        status = self._process.poll()
        if status is not None:
            raise RunError(f"{self._name}: it ended: {children.ending(status)}")

    def end(self) -> None:
        """End it, by force if necessary."""
        assert self._process.stdin and self._process.stdout
        with suppress(OSError):  # it has ended; unwritten input is lost
            self._process.stdin.close()
        children.end(self._process, END_S)
        self._process.stdout.close()

    def _lines(self) -> Iterator[str]:
        """Its output lines, until it ends or answers.

        raises  RunError if it neither answers nor ends
        """
        deadline, ready = time.monotonic() + ANSWER_S, select.poll()
        ready.register(self._out, select.POLLIN)
        while time.monotonic() < deadline:
            while b"\n" in self._rest:
                line, _, self._rest = self._rest.partition(b"\n")
                yield line.decode(errors="replace")
            signals.check()
            if ready.poll(POLL_MS):
                data = os.read(self._out, 65_536)
                if not data:
                    break
                self._rest += data
        else:
            raise RunError(f"{self._name}: it has not answered for {ANSWER_S:g} s")
        if self._rest:
            yield self._rest.decode(errors="replace")


class ChildShaper:
    """A child that forwards packets, and reads rates with `runner.link.direction.take_rates`.

    tcp     child that sends competing TCP flows, started with the first rates; None: no such flows
    number  of the link among those of the child
    """

    def __init__(self, child: Child, tcp: Child | None = None, number: int = 0) -> None:
        self._child, self._tcp, self._number = child, tcp, number
        self._tcp_started = False

    def limit(self, rates: Rates) -> LinkCounters:
        if self._tcp and not self._tcp_started:
            self._tcp_started = True
            self._tcp.ask("start")
        return LinkCounters(**self._child.ask(json.dumps([self._number, rates])))

    def check(self) -> None:
        for child in (self._child, self._tcp):
            if child:
                child.check()
