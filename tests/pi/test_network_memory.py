"""Clients that send without end are disconnected before ZeroMQ fills the memory with their messages.

The client speaks ZMTP 3.0 (RFC 23) by hand, byte by byte.
"""

from __future__ import annotations

import os
import select
import socket
import threading
import time
from contextlib import suppress

import pytest
from tests.support.pi.program import resident_bytes

from polysight_pi import executor as executors
from polysight_pi.executor import REPLAYS_WAITING
from polysight_pi.system import MAX_BYTES
from polysight_shared import messages as m

MORE, LONG, COMMAND = 1, 2, 4
ENOUGH_BYTES = 2 << 30  # a client that could send so much was not stopped
TURNS_A_SECOND = 400  # of 600 kB: twice what a Pi's network carries; loopback fills a busy machine's memory at once
BOUND_BYTES = 400 << 20  # MemoryMax of the unit is 512 MiB
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + b"\0" + bytes(31)


def frame(body: bytes, flags: int = 0) -> bytes:
    if len(body) < 256:
        return bytes([flags, len(body)]) + body
    return bytes([flags | LONG]) + len(body).to_bytes(8, "big") + body


def connected(address: str, kind: bytes) -> socket.socket:
    """A connection after its handshake, as a socket of this kind."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    peer = socket.create_connection((host, int(port)), timeout=60)
    peer.sendall(GREETING)
    peer.recv(len(GREETING), socket.MSG_WAITALL)
    peer.sendall(frame(b"\x05READY\x0bSocket-Type" + len(kind).to_bytes(4, "big") + kind, COMMAND))
    return peer


def is_cut(peer: socket.socket) -> bool:
    """True if the other end has closed the connection."""
    while select.select([peer], [], [], 0)[0]:
        if not peer.recv(1 << 16):
            return True
    return False


def paced(frames: bytes) -> bytes:
    time.sleep(1 / TURNS_A_SECOND)
    return frames


ATTACKS = {
    "a message of many frames": (0, b"DEALER", lambda: paced(frame(b"", MORE) + frame(bytes(60_000), MORE) * 10)),
    "subscriptions": (1, b"SUB", lambda: b"".join(frame(b"\x01" + os.urandom(1000)) for _ in range(50))),
}


@pytest.mark.slow
@pytest.mark.parametrize("attack", ATTACKS)
def test_a_client_without_end_is_cut_off(instrument, start, hub, attack):
    """And the next one is served, by the same process with the same run."""
    which, kind, more = ATTACKS[attack]
    program, host = start(instrument, "--wires", hub)
    host.accepted(host.begin())
    host.home()
    pid, highest, ended = program.popen.pid, [0], threading.Event()

    def watch() -> None:
        while not ended.wait(0.02):
            highest[0] = max(highest[0], resident_bytes(pid))

    watcher = threading.Thread(target=watch)
    watcher.start()
    sent = 0
    while highest[0] < MAX_BYTES and sent < ENOUGH_BYTES:  # ZeroMQ itself ends some of these connections
        with connected((program.ready[1], program.events[1])[which], kind) as peer, suppress(ConnectionError):
            peer.settimeout(0.1)  # a connection that was cut may stall before it is closed
            left = b""
            while sent < ENOUGH_BYTES and not is_cut(peer):
                with suppress(TimeoutError):
                    left = left or more()
                    taken = peer.send(left)
                    sent, left = sent + taken, left[taken:]
    cut_ns = time.monotonic_ns()
    ended.set()
    watcher.join()
    assert 0 < sent < ENOUGH_BYTES
    assert highest[0] < BOUND_BYTES
    host.wait(m.Heartbeat, lambda beat: beat.t_mono_ns > cut_ns)  # events were cut off, too: they come again
    assert host.row(0).status == "done"
    deadline = time.monotonic() + 60
    while resident_bytes(pid) >= BOUND_BYTES and time.monotonic() < deadline:
        time.sleep(0.1)
    status, _, err = program.end()
    assert status == 0
    assert "connections were cut" in err, (sent, highest)


def test_a_queue_that_never_empties_is_not_a_hang(pi, monkeypatch):
    """The executor completes turns, however much waits: the watchdog and `Alive` go by them."""
    monkeypatch.setattr(executors, "TURN_TIMEOUT_S", 0.05)
    longest = 0.0
    done = threading.Event()
    for _ in range(60):
        pi.service.executor.post(lambda: time.sleep(0.05))
    pi.service.executor.post(done.set)
    while not done.wait(0.02):
        longest = max(longest, pi.service.executor.unresponsive_s)
    assert longest < 2.0
    assert isinstance(pi.host.ask(m.Status()), m.StatusReply)


def test_replays_do_not_keep_other_commands_waiting(pi):
    """Only few of them wait at a time; more are refused."""
    slow = threading.Event()
    pi.service.executor.post(lambda: slow.wait(60))
    replay = m.Replay(scan_id="scan", from_seq=1)
    taken = [pi.service.executor.submit(replay, lambda _: None) for _ in range(10)]
    assert taken == [True] * REPLAYS_WAITING + [False] * (10 - REPLAYS_WAITING)
    assert pi.service.executor.submit(m.Abort(), lambda _: None)
    slow.set()
