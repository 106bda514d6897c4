"""The socket between the node and the process that started it."""

from __future__ import annotations

import json
import os
import select
import socket
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

MAX_MESSAGE_BYTES = 131_072


class NodeError(Exception):
    """Why the node cannot work, with the remedy."""


class Port:
    """The node's end."""

    def __init__(self, number: int) -> None:
        self._socket = socket.socket(fileno=number)

    def task(self) -> dict[str, Any]:
        task: dict[str, Any] = json.loads(self._socket.recv(MAX_MESSAGE_BYTES))
        return task

    def send(self, kind: str, **values: Any) -> None:
        """Send a message, from any thread."""
        self._socket.send(json.dumps({"kind": kind, **values}).encode())

    def report(self, text: str, topic: str = "") -> None:
        """Report something to the user about a topic; "" stands for the node itself."""
        self.send("report", topic=topic, text=text)

    def send_picture(self, data: memoryview, **values: Any) -> None:
        """Copy a picture into memory of its own and pass that on. It is freed even if the other side is killed.

        If the other side lags behind, the picture is dropped in favour of later ones.
        """
        memory = shared_memory(data)
        try:
            message = json.dumps({"kind": "picture", **values}).encode()
            socket.send_fds(self._socket, [message], [memory], socket.MSG_DONTWAIT)
        except BlockingIOError:
            pass
        finally:
            os.close(memory)

    def orders(self) -> Iterator[tuple[dict[str, Any], int]]:
        """Texts and pictures to publish, and answers, until the other side closes the connection or ends.

        yields  an order, and the memory of its picture, which the caller must close; -1: none
        """
        with suppress(OSError):
            while True:
                order, memory, _, _ = socket.recv_fds(self._socket, MAX_MESSAGE_BYTES, 1, socket.MSG_CMSG_CLOEXEC)
                if not order:
                    return
                yield json.loads(order), memory[0] if memory else -1

    def wait_closed(self, within_s: float) -> bool:
        """Wait; returns True as soon as the other side has closed the connection."""
        poll = select.poll()
        poll.register(self._socket, select.POLLRDHUP)
        return bool(poll.poll(1000 * within_s))


def shared_memory(data: memoryview | bytes) -> int:
    """The file descriptor of new anonymous memory that contains the data.

    raises  OSError
    """
    memory, data = os.memfd_create("picture"), memoryview(data)
    try:
        while data:
            data = data[os.write(memory, data) :]
    except OSError:
        os.close(memory)
        raise
    return memory
