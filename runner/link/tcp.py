"""usage: python -m runner.link.tcp '{"to": [HOST, PORT], "flows": 1, "size": null, "pause_s": 10, "start_s": 0}'

TCP flows that compete with cameras (`runner.link.limit.TcpFlows`), with CUBIC, whatever the machine's default is. The
first line of output names the congestion control in use. Transfers begin `start_s` after the first line of input, which
is answered by an empty object; the process ends with its input.
"""

from __future__ import annotations

import asyncio
import json
import random
import socket
import sys
from contextlib import suppress
from typing import Any

CONGESTION = b"cubic"
CHUNK = bytes(16_384)
RETRY_S = 0.5  # before a flow whose connection failed retries


def connection() -> socket.socket:
    sock = socket.socket()
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, CONGESTION)
    sock.setblocking(False)
    return sock


def congestion_control() -> str:
    """The congestion control of a connection; ends the process if cubic cannot be set."""
    try:
        with connection() as sock:
            return sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, 16).rstrip(b"\0").decode()
    except OSError as error:
        sys.exit(f"congestion control {CONGESTION.decode()} cannot be set: {error.strerror}")


async def transfer(to: tuple[str, int], size: float) -> None:
    """Send `size` bytes through a new connection."""
    loop = asyncio.get_running_loop()
    with connection() as sock:
        await loop.sock_connect(sock, to)
        while size > 0:
            await loop.sock_sendall(sock, CHUNK[: int(min(size, len(CHUNK)))])
            size -= len(CHUNK)


async def flow(number: int, settings: dict[str, Any]) -> None:
    """One transfer after the other, forever; the same sizes and pauses in each run."""
    generator, to = random.Random(number), tuple(settings["to"])
    await asyncio.sleep(settings["start_s"])
    while True:
        size = generator.randint(*settings["size"]) if settings["size"] else float("inf")
        try:
            await transfer((to[0], to[1]), size)
        except OSError:
            await asyncio.sleep(RETRY_S)
            continue
        await asyncio.sleep(generator.expovariate(1 / settings["pause_s"]) if settings["pause_s"] else 0)


async def main() -> None:
    settings = json.loads(sys.argv[1])
    print(json.dumps({"congestion": congestion_control()}), flush=True)
    lines = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    if not await lines.readline():
        return
    print("{}", flush=True)
    async with asyncio.TaskGroup() as tasks:
        sending = [tasks.create_task(flow(number, settings)) for number in range(settings["flows"])]
        await lines.read()
        for task in sending:
            task.cancel()


if __name__ == "__main__":
    with suppress(KeyboardInterrupt):
        asyncio.run(main())
