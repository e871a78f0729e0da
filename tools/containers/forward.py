"""Passes connections on to the recorder's view: the recorder is on no network that leads to the host, and cannot publish a port.

It has no brief and no results, and connects to the recorder alone. It ends when the recorder has ended.
"""

from __future__ import annotations

import asyncio
import contextlib
import sys

HOST = "recorder"
PORTS = (17450, 17451)
PROBED = 17449
"""A port on which nobody listens: a host that is there refuses at once, and one that is not says nothing."""
POLL_SECONDS = 2.0
SILENCES = 3


async def pour(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Write all that is read, until one of both has ended."""
    with contextlib.suppress(OSError):
        while data := await reader.read(65536):
            writer.write(data)
            await writer.drain()
    writer.close()


async def forward(port: int, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    """Pass one connection on."""
    try:
        there, back = await asyncio.open_connection(HOST, port)
    except OSError:
        writer.close()
        return
    await asyncio.gather(pour(reader, back), pour(there, writer))


async def is_there() -> bool:
    """Whether the recorder's container runs."""
    try:
        async with asyncio.timeout(POLL_SECONDS):
            _, writer = await asyncio.open_connection(HOST, PROBED)
        writer.close()
    except ConnectionRefusedError:
        return True
    except OSError:  # a timeout too
        return False
    return True


async def main() -> None:
    """Pass connections on as long as the recorder is there."""
    for port in PORTS:
        await asyncio.start_server(lambda *both, port=port: forward(port, *both), "0.0.0.0", port)  # noqa: S104 - Docker publishes it
    silent = 0
    while silent < SILENCES:
        silent = 0 if await is_there() else silent + 1
        await asyncio.sleep(POLL_SECONDS)


if __name__ == "__main__":
    sys.exit(asyncio.run(main()))
