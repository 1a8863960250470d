"""Hostile messages to the command socket: the Pi replies, stays alive, keeps its memory, and a row is undisturbed."""

from __future__ import annotations

import copy
import random
import struct
import time
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import pytest
import zmq
from tests.support.pi.host_side import HostSide
from tests.support.pi.program import resident_bytes
from tests.support.pi.wires_log import WiresLog

from polysight_shared import messages as m
from polysight_shared.errors import ProtocolError
from polysight_shared.raster import RasterPlan

NAN, INF = float("nan"), float("inf")
VALUES: tuple[Any, ...] = (
    NAN, INF, -INF, -1, 0, 1, 2**31, 2**40, 2**63, 2**64 - 1, -(2**63), 1e308, -1e308, 5e-324, True, None, b"\0", "",
    "a\0b", "a\n", "..", "/etc/passwd", "../x", "x" * 300, "x" * 5000, "\u202e", [], [1], {}, {"a": 1}, [[[[[[]]]]]],
)  # fmt: skip
BOUND_BYTES = 24 << 20  # of resident memory; one message may hold 64 KiB
BEGIN = m.BeginRun(
    scan_id="scan", plan=RasterPlan(8, 4, 2.0, 2.0), pulses=4, period_us=1500.0, width_us=1.0, speed_mm_s=20.0
)
PULSE = m.Pulse(pulses=1, period_us=1500.0, width_us=1.0)
REPLAY, ALIVE = m.Replay(scan_id="scan", from_seq=1), m.Alive(scan_id="scan")
RUN, END = m.RunRow(scan_id="scan", row_index=0, take=1), m.EndRun(scan_id="scan", exit_status="abort")


def draw(rng: random.Random, valid: list[Any]) -> bytes:
    """Draw a message with one or more errors; sometimes a correct one of a client that does not own the run."""
    kind = rng.randrange(6)
    if kind == 0:
        return rng.randbytes(rng.choice([0, 1, 5, 40, 400]))
    node = msgspec.to_builtins(rng.choice(valid))
    if kind == 1:
        return m.pack(rng.choice(valid))
    if kind == 2:
        raw = m.pack(rng.choice(valid))
        return raw[: rng.randrange(len(raw))]
    if kind == 3:
        raw = bytearray(m.pack(rng.choice(valid)))
        for _ in range(rng.randint(1, 3)):
            raw[rng.randrange(len(raw))] = rng.randrange(256)
        return bytes(raw)
    for _ in range(rng.randint(1, 3)):
        inner = node["plan"] if "plan" in node and isinstance(node["plan"], dict) and rng.random() < 0.5 else node
        inner[rng.choice(sorted(inner) or ["x"])] = copy.deepcopy(rng.choice(VALUES))
    return msgpack.packb(node, use_bin_type=True) or b""


class Stranger:
    """A client that may send again without waiting for a reply."""

    def __init__(self, address: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self._context.socket(zmq.REQ)
        for option in (zmq.REQ_RELAXED, zmq.REQ_CORRELATE):
            self.socket.setsockopt(option, 1)
        self.socket.connect(address)

    def ask(self, raw: bytes, limit_s: float = 60.0) -> m.AnyReply | None:
        self.socket.send(raw)
        return m.unpack_reply(self.socket.recv()) if self.socket.poll(round(limit_s * 1e3)) else None

    def close(self) -> None:
        self._context.destroy(linger=0)


@pytest.fixture
def stranger(pi):
    stranger = Stranger(pi.service.server.command_address)
    yield stranger
    stranger.close()


@pytest.mark.parametrize(
    ("commands", "field", "wrong"),
    [
        ((BEGIN, PULSE), "period_us", (NAN, INF, -INF, 1e300, 1e70)),
        ((BEGIN, PULSE), "width_us", (NAN, INF, -INF, 1e300, 1e70)),
        ((BEGIN,), "speed_mm_s", (NAN, INF, -INF, 1e300, 1e70)),
        ((BEGIN,), "heartbeat_ms", (2**40,)),  # it would keep every other host out for 35 years
        (
            (BEGIN, REPLAY, ALIVE, RUN, END), "scan_id", ("a\0b", "x" * 300, "a\n", "..", "../../etc/passwd", "/", ""),
        ),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)  # fmt: skip
def test_an_impossible_value_is_no_command(commands, field, wrong):
    """What cannot be decoded is refused; the fuzz test below shows that, through the socket."""
    for command in commands:
        for value in wrong:
            raw = msgpack.packb(msgspec.to_builtins(command) | {field: value})
            assert raw is not None
            with pytest.raises(ProtocolError):
                m.unpack_command(raw)


@pytest.mark.parametrize("nan", [b"\xca" + struct.pack(">f", NAN), b"\xcb" + struct.pack(">d", NAN)])
def test_nan_is_refused_in_every_encoding(nan):
    raw = m.pack(PULSE).replace(b"\xcb" + struct.pack(">d", 1500.0), nan)
    with pytest.raises(ProtocolError):
        m.unpack_command(raw)


def test_a_folder_in_the_journals_place_is_refused(pi, instrument):
    (Path(instrument.pi.journal_dir) / "folder.journal").mkdir()
    for command in (m.Replay(scan_id="folder", from_seq=1), pi.host.begin("folder")):
        assert pi.host.refused(command)
    assert pi.host.accepted(pi.host.begin()).state == "idle"


def test_a_message_of_64_mb_is_not_taken_into_memory(pi, stranger):
    before = resident_bytes()
    big = msgpack.packb({"type": "Hello", "version": "1.0", "host_release": "x" * (64 << 20)})
    mine = resident_bytes() - before
    assert stranger.ask(big, limit_s=1.0) is None
    assert resident_bytes() - before < mine + BOUND_BYTES + (64 << 20), "the sender's own copy and no second one"
    assert isinstance(pi.host.ask(m.Status()), m.StatusReply)


def test_hostile_messages_disturb_nothing(pi, hub, stage, stranger, instrument, request):
    """Thousands of messages while rows run: each gets a reply, and every pulse is at its time."""
    amount = 100_000 if request.config.getoption("--long") else 2_000
    host: HostSide = pi.host
    rng = random.Random(amount)
    wires = WiresLog(hub, *instrument.pi.sync_out)
    host.accepted(host.begin(owner="mine", heartbeat_ms=10_000))
    host.home()
    valid = [
        m.Hello(), m.Status(), ALIVE, m.Home(), RUN, PULSE, REPLAY, m.Hold(), m.Resume(), m.Abort(), END,
        host.begin("other"), host.begin(),
    ]  # fmt: skip
    sent = taken = before = 0
    stage.pace_s = 0.05
    host.start_row(owner="mine")
    while sent < amount or not taken:
        assert stranger.ask(draw(rng, valid)) is not None
        sent += 1
        if sent == 1_000:
            before = resident_bytes()
        if host.subscriber.poll(0):
            event = m.unpack_event(host.subscriber.recv_multipart()[-1])
            if isinstance(event, m.RowFinished):
                assert (event.status, event.pulses) == ("done", instrument.grid.columns * instrument.burst.pulses)
                taken += 1
                deadline = time.monotonic() + 60
                while isinstance(
                    host.ask(m.RunRow(scan_id="scan", row_index=0, take=taken + 1, owner="mine")), m.Refused
                ):
                    assert time.monotonic() < deadline
                    time.sleep(0.01)
            host.accepted(m.Alive(scan_id="scan", owner="mine"))
    assert resident_bytes() - before < BOUND_BYTES
    assert pi.service.executor.crash is None
    host.accepted(m.Abort(owner="mine"))
    host.until_state("ready")
    wires.close()
    n, period_ns = instrument.burst.pulses, round(instrument.burst.period_us * 1e3)
    rises = wires.rises(instrument.pi.sync_out[0])
    whole = [burst for i in range(0, len(rises), n) if len(burst := rises[i : i + n]) == n]
    assert len(whole) >= taken * instrument.grid.columns
    assert all(t - b[0] == k * period_ns for b in whole for k, t in enumerate(b))
