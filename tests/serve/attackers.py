"""Concurrent clients of a server, as a program: `PORT STREAMS READERS WRONG_TOKENS CONNECTIONS ABORTS VIEWS`.

`Attack` in test_attack.py describes these numbers; VIEWS is the number of scans that have a live view.
Every second a line says how many connections were opened in all, and how many requests were reset before their answer.
"""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import random
import socket
import sys
import time
from collections import Counter
from multiprocessing.sharedctypes import Synchronized

# Pause before a client opens a lost live view again, seconds.
STREAM_RETRY_S = 0.2
# Longest pause of a reader between two answers, and its pause before it connects again, seconds.
LONGEST_READ_PAUSE_S = 0.02
READER_RETRY_S = 0.05
# Each client with a wrong token tries at most ten times a second.
GUESS_PAUSE_S = 0.1
# Pause if no connection is due, seconds; at 1000 connections a second two are due after it.
CONNECTION_PAUSE_S = 0.002
# What pages read, with the number of a scan.
PATHS = ("scans", "scan?scan=s{}", "result?scan=s{}", "map/h_amplitude?scan=s{}", "running")
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
        await asyncio.sleep(STREAM_RETRY_S)


async def read_pages(port: int, scan_count: int) -> None:
    """Request one page after another, each of a scan drawn by chance."""
    while True:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            may_ask = True
            while may_ask:
                path = random.choice(PATHS).format(random.randrange(scan_count))
                may_ask = await ask(reader, writer, f"GET /api/{path} HTTP/1.1\r\nHost: localhost\r\n\r\n")
                await asyncio.sleep(LONGEST_READ_PAUSE_S * random.random())
            writer.close()
        except (OSError, asyncio.IncompleteReadError):
            counted["reads lost"] += 1
        await asyncio.sleep(READER_RETRY_S)


async def ask(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: str) -> bool:
    """Send a request, and read its answer; False if the server closes the connection after it."""
    writer.write(request.encode())
    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
    for line in head.split("\r\n"):
        name, _, value = line.partition(":")
        if name == "content-length":
            await reader.readexactly(int(value))
    counted["answers"] += 1
    return "connection: close" not in head


async def guess_token(port: int, scan: int) -> None:
    """Try to abort a scan with a wrong token, again and again."""
    head = f"POST /api/control/abort?scan=s{scan} HTTP/1.1\r\nHost: localhost\r\nX-Polysight-Token: wrong\r\n"
    while True:
        try:
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            await ask(reader, writer, f"{head}Content-Length: 2\r\nConnection: close\r\n\r\n{{}}")
            writer.close()
        except (OSError, asyncio.IncompleteReadError):
            counted["wrong tokens lost"] += 1
        await asyncio.sleep(GUESS_PAUSE_S)


def open_connections(port: int, rate: int, opened: Synchronized[int]) -> None:
    """Open `rate` connections a second and close them without a request; this runs in a process of its own."""
    parent = os.getppid()
    begun_s = time.monotonic()
    while os.getppid() == parent:
        if opened.value < (time.monotonic() - begun_s) * rate:
            with contextlib.suppress(OSError):
                socket.create_connection(("127.0.0.1", port)).close()
                opened.value += 1
        else:
            # As many connections as are due were opened.
            time.sleep(CONNECTION_PAUSE_S)


async def report(opened: Synchronized[int]) -> None:
    """Print the counts each second."""
    while True:
        await asyncio.sleep(1)
        counted["connections"] = opened.value
        sys.stdout.write(", ".join(f"{name} {count}" for name, count in sorted(counted.items())) + "\n")
        sys.stdout.flush()


async def main() -> None:
    """Run all clients until the process is ended."""
    # The sixth argument, the number of aborts, is for the test that sends them.
    port, streams, readers, wrong_tokens, connections, _, views = map(int, sys.argv[1:])
    # The first scans have live views; the test aborts the one after these.
    aborted_scan = views
    scan_count = views + 1
    clients = [read_stream(port, k % views) for k in range(streams)]
    clients += [read_pages(port, scan_count) for _ in range(readers)]
    clients += [guess_token(port, aborted_scan) for _ in range(wrong_tokens)]
    opened = multiprocessing.Value("i", 0)
    multiprocessing.Process(target=open_connections, args=(port, connections, opened), daemon=True).start()
    await asyncio.gather(*clients, report(opened))


if __name__ == "__main__":
    asyncio.run(main())
