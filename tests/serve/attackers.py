"""Clients that ask a server all at once, as a program: `PORT STREAMS READERS WRONG_TOKENS CONNECTIONS ABORTS VIEWS`.

Every second a line says how many connections were opened in all, and how many requests were reset before their answer.
"""

from __future__ import annotations

import asyncio
import random
import sys
from collections import Counter

PATHS = ("scans", "scan?scan=s{}", "result?scan=s{}", "map/h_amplitude?scan=s{}", "running")
REQUESTS_OF_A_CONNECTION = 20
counted: Counter[str] = Counter()


async def read_stream(port: int, scan: int) -> None:
    """Follow one live view."""
    while True:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(f"GET /api/events?scan=s{scan} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
            while await reader.read(65536):
                pass
        except OSError:
            counted["streams lost"] += 1
        await asyncio.sleep(0.2)


async def read_pages(port: int, views: int) -> None:
    """Ask for one thing after another, as pages do."""
    while True:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            for _ in range(REQUESTS_OF_A_CONNECTION):
                path = random.choice(PATHS).format(random.randrange(views + 1))
                await ask(reader, writer, f"GET /api/{path} HTTP/1.1\r\nHost: localhost\r\n\r\n")
                await asyncio.sleep(0.02 * random.random())
            writer.close()
        except OSError:
            counted["reads lost"] += 1
        except asyncio.IncompleteReadError:
            counted["reads lost"] += 1
        await asyncio.sleep(0.05)


async def ask(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: str) -> None:
    """Send a request, and read its answer."""
    writer.write(request.encode())
    head = await reader.readuntil(b"\r\n\r\n")
    for line in head.decode("latin-1").lower().split("\r\n"):
        name, _, value = line.partition(":")
        if name == "content-length":
            await reader.readexactly(int(value))
    counted["answers"] += 1


async def guess_token(port: int, scan: int) -> None:
    """Abort with a wrong token."""
    head = f"POST /api/control/abort?scan=s{scan} HTTP/1.1\r\nHost: localhost\r\nX-Polysight-Token: wrong\r\n"
    while True:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            await ask(reader, writer, f"{head}Content-Length: 2\r\nConnection: close\r\n\r\n{{}}")
            writer.close()
        except (OSError, asyncio.IncompleteReadError):
            counted["wrong tokens lost"] += 1
        await asyncio.sleep(0.1)


async def open_connections(port: int, rate: int) -> None:
    """Open connections and close them without a request, so many each second."""
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    while True:
        if counted["connections"] < (loop.time() - begun_s) * rate:
            try:
                _, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.close()
            except OSError:
                counted["connections lost"] += 1
            counted["connections"] += 1
        else:
            await asyncio.sleep(0.002)


async def report() -> None:
    """Say each second what was counted."""
    while True:
        await asyncio.sleep(1)
        sys.stdout.write(", ".join(f"{name} {count}" for name, count in sorted(counted.items())) + "\n")
        sys.stdout.flush()


async def main() -> None:
    """Run all of them until the process is ended."""
    port, streams, readers, wrong_tokens, connections, _, views = map(int, sys.argv[1:])
    clients = [read_stream(port, k % views) for k in range(streams)]
    clients += [read_pages(port, views) for _ in range(readers)]
    clients += [guess_token(port, views) for _ in range(wrong_tokens)]
    await asyncio.gather(*clients, open_connections(port, connections), report())


if __name__ == "__main__":
    asyncio.run(main())
