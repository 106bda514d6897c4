"""A child process that is asked in lines and answers in lines of JSON."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping, Sequence
from typing import Any

from runner.errors import RunError

END_S = 5.0  # how long it may take to end once nobody asks any more


class Child:
    """Asked through its standard input; everything that it says and that is not JSON is a complaint.

    name     for people
    command  ends when its standard input does, as it does with this process, however that ends
    """

    def __init__(self, name: str, command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        self._name = name
        pipe = subprocess.PIPE
        # A session of its own: Ctrl-C ends whoever asks, not who is to count until the end.
        self._process = subprocess.Popen(
            command,
            stdin=pipe,
            stdout=pipe,
            stderr=subprocess.STDOUT,
            text=True,
            env=environment,
            start_new_session=True,
        )

    def ask(self, *lines: str) -> Any:
        """Send lines and wait for one answer.

        raises  RunError with what it says instead
        """
        assert self._process.stdin
        try:
            self._process.stdin.write("".join(f"{line}\n" for line in lines))
            self._process.stdin.flush()
        except OSError:
            pass  # it is gone; what it has said follows
        return self.answer()

    def answer(self) -> Any:
        """The next answer. raises RunError as `ask`"""
        assert self._process.stdout
        complaints: list[str] = []
        for line in self._process.stdout:
            if line[:1] in ("{", "["):
                if complaints:
                    break
                return json.loads(line)
            complaints.append(line.strip())
        else:
            # Of a traceback the last line says it all.
            complaints = complaints[-1:] if complaints[:1] == ["Traceback (most recent call last):"] else complaints
            complaints.append(f"it ended with status {self._process.wait()}")
        raise RunError(f"{self._name}: {'; '.join(complaints)}")

    def end(self) -> None:
        """Let it end, by force if need be."""
        with self._process as process:
            assert process.stdin
            try:
                process.stdin.close()
                process.wait(END_S)
            except (OSError, subprocess.TimeoutExpired):
                process.kill()
