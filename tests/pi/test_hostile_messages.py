"""Whatever comes to the command socket: the Pi answers, lives on, keeps its memory, and a row runs undisturbed."""

from __future__ import annotations

import copy
import random
import struct
import threading
import time
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import pytest
import zmq

from polysight.shared import messages as m
from polysight.shared.faults import PiFault
from polysight.shared.wires import WireClient, WireEdge
from tests.support.pi.host_side import HostSide

NAN, INF = float("nan"), float("inf")
VALUES: tuple[Any, ...] = (
    NAN, INF, -INF, -1, 0, 1, 2**31, 2**40, 2**63, 2**64 - 1, -(2**63), 1e308, -1e308, 5e-324, True, None, b"\0", "",
    "a\0b", "a\n", "..", "/etc/passwd", "../x", "x" * 300, "x" * 5000, "\u202e", [], [1], {}, {"a": 1}, [[[[[[]]]]]],
)  # fmt: skip
BOUND_BYTES = 24 << 20  # of resident memory; one message may hold 64 KiB


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def commands(host: HostSide) -> list[Any]:
    """One of each command that does not stop the row that runs."""
    return [
        m.Hello(), m.Status(), m.Alive(scan_id="scan"), m.Home(), m.RunRow(scan_id="scan", row_index=0, take=1),
        m.Pulse(pulses=1, period_us=1500.0, width_us=1.0), m.Replay(scan_id="scan", from_seq=1), host.begin("other"),
        m.Hold(), m.Resume(), m.Abort(), m.EndRun(scan_id="scan", exit_status="abort"), host.begin(),
    ]  # fmt: skip


def draw(rng: random.Random, valid: list[Any]) -> bytes:
    """A message that is wrong in one way or several; now and then a right one, of a client that owns nothing."""
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
    """A client that sends bytes, and speaks REQ's framing by hand, so that nothing keeps it from sending more."""

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


class Radar:
    """Reads the SYNC_IN wire all the time; a party that does not would hold up the others."""

    def __init__(self, hub: Path, lines: tuple[int, ...]) -> None:
        self._client = WireClient(hub, listen=lines)
        self._rises: list[int] = []
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        while (edge := self._client.receive(0.5)) is not None or not self._ended.is_set():
            if isinstance(edge, WireEdge) and edge.value:
                self._rises.append(edge.t_ns)

    def close(self) -> list[int]:
        self._ended.set()
        self._thread.join()
        self._client.close()
        return self._rises


@pytest.fixture
def stranger(pi):
    stranger = Stranger(pi.service.server.command_address)
    yield stranger
    stranger.close()


@pytest.mark.parametrize("wrong", [NAN, INF, -INF, 1e300, 2**70])
@pytest.mark.parametrize("field", ["period_us", "width_us", "speed_mm_s"])
def test_a_number_that_is_none_is_refused(pi, field, wrong):
    host = pi.host
    node = msgspec.to_builtins(host.begin()) | {field: wrong if wrong != 2**70 else 1e70}
    for raw in (node, msgspec.to_builtins(m.Pulse(pulses=1, period_us=1500.0, width_us=1.0)) | {field: wrong}):
        if field == "speed_mm_s" and raw["type"] == "Pulse":
            continue
        host.commands.send(msgpack.packb({k: float(v) if k == field else v for k, v in raw.items()}))
        assert host.commands.poll(60_000), "no reply"
        assert isinstance(m.unpack_reply(host.commands.recv()), m.Refused)
    assert host.ask(m.Status()).state == "idle"
    assert pi.service.executor.crash is None


@pytest.mark.parametrize("scan_id", ["a\0b", "x" * 300, "a\n", "..", "../../etc/passwd", "/", ""])
@pytest.mark.parametrize("command", ["Replay", "BeginRun", "EndRun", "RunRow", "Alive"])
def test_a_name_that_is_none_is_refused(pi, command, scan_id):
    host = pi.host
    kinds: dict[str, Any] = {
        "Replay": m.Replay(scan_id="scan", from_seq=1), "BeginRun": host.begin(), "Alive": m.Alive(scan_id="scan"),
        "EndRun": m.EndRun(scan_id="scan", exit_status="abort"),
        "RunRow": m.RunRow(scan_id="scan", row_index=0, take=1),
    }  # fmt: skip
    host.commands.send(msgpack.packb(msgspec.to_builtins(kinds[command]) | {"scan_id": scan_id}))
    assert host.commands.poll(60_000), "no reply"
    reply = m.unpack_reply(host.commands.recv())
    assert isinstance(reply, m.Refused)
    assert reply.number == PiFault.BAD_REQUEST
    assert isinstance(host.ask(m.Status()), m.StatusReply)


def test_a_place_in_the_journals_way_is_refused(pi, instrument):
    (Path(instrument.pi.journal_dir) / "folder.journal").mkdir()
    for command in (m.Replay(scan_id="folder", from_seq=1), pi.host.begin("folder")):
        assert isinstance(pi.host.ask(command), m.Refused)
    assert pi.host.accepted(pi.host.begin()).state == "idle"


def test_a_message_of_64_mb_is_not_taken_into_memory(pi, stranger):
    before = resident_bytes()
    big = msgpack.packb({"type": "Hello", "version": "1.0", "host_release": "x" * (64 << 20)})
    mine = resident_bytes() - before
    assert stranger.ask(big, limit_s=2.0) is None
    assert resident_bytes() - before < mine + BOUND_BYTES + (64 << 20), "the sender's own copy and no second one"
    assert isinstance(pi.host.ask(m.Status()), m.StatusReply)


def test_a_promise_of_35_years_is_refused(pi):
    """It would keep every other host out for as long."""
    node = msgspec.to_builtins(pi.host.begin()) | {"heartbeat_ms": 2**40}
    pi.host.commands.send(msgpack.packb(node))
    assert pi.host.commands.poll(60_000)
    assert isinstance(m.unpack_reply(pi.host.commands.recv()), m.Refused)


def test_hostile_messages_disturb_nothing(pi, hub, stage, stranger, instrument, request):
    """Thousands of messages while rows run: every one is answered, and every pulse is where it would have been."""
    amount = 100_000 if request.config.getoption("--long") else 2_000
    host, rng = pi.host, random.Random(amount)
    radar = Radar(hub, instrument.pi.sync_out)
    host.accepted(host.begin(owner="mine", heartbeat_ms=10_000))
    host.home()
    valid = commands(host)
    sent = taken = 0
    before = 0
    row = 0
    stage.pace_s = 0.05
    host.accepted(m.RunRow(scan_id="scan", row_index=row, take=1, owner="mine"))
    while sent < amount or not taken:
        reply = stranger.ask(draw(rng, valid))
        assert reply is not None
        sent += 1
        if sent == 1_000:
            before = resident_bytes()
        if host.subscriber.poll(0):
            event = m.unpack_event(host.subscriber.recv_multipart()[-1])
            if isinstance(event, m.RowFinished):
                assert (event.status, event.pulses) == ("done", instrument.grid.columns * instrument.burst.pulses)
                taken += 1
                run = m.RunRow(scan_id="scan", row_index=0, take=taken + 1, owner="mine")
                deadline = time.monotonic() + 60
                while isinstance(host.ask(run), m.Refused) and time.monotonic() < deadline:
                    time.sleep(0.01)
            host.accepted(m.Alive(scan_id="scan", owner="mine"))
    assert resident_bytes() - before < BOUND_BYTES
    assert pi.service.executor.crash is None
    host.accepted(m.Abort(owner="mine"))
    rises = radar.close()
    bursts = [rises[i : i + instrument.burst.pulses] for i in range(0, len(rises), instrument.burst.pulses)]
    period = round(instrument.burst.period_us * 1e3)
    whole = [b for b in bursts if len(b) == instrument.burst.pulses]
    assert len(whole) >= taken * instrument.grid.columns
    assert all(t - b[0] == k * period for b in whole for k, t in enumerate(b))


def test_a_float_that_packs_oddly_is_still_a_float():
    """NaN in every encoding msgpack has."""
    node = msgpack.packb(msgspec.to_builtins(m.Pulse(pulses=1, period_us=1500.0, width_us=1.0)))
    assert node is not None
    for nan in (b"\xca" + struct.pack(">f", NAN), b"\xcb" + struct.pack(">d", NAN)):
        raw = node.replace(b"\xcb" + struct.pack(">d", 1500.0), nan)
        with pytest.raises(m.ProtocolError):
            m.unpack_command(raw)
