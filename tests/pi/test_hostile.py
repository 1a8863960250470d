"""Hostile messages, replies of the stage and connections are answered in bounded memory, and rows are undisturbed.

The clients that send without end speak ZMTP 3.0 (RFC 23) by hand, byte by byte.
"""

import copy
import itertools
import os
import random
import select
import socket
import struct
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgpack
import msgspec
import pytest
import zmq
from tests.support.pi.host_side import HostSide
from tests.support.pi.program import WiresLog, read_resident_bytes
from tests.support.processes import HANG_S, wait_for

from polysight_pi import executor as executors
from polysight_pi.executor import REPLAYS_WAITING
from polysight_pi.system import MAX_BYTES, SPARE_BYTES
from polysight_shared import messages as m
from polysight_shared.errors import ProtocolError
from polysight_shared.raster import RasterPlan
from polysight_shared.stage_line import Reply

NAN = float("nan")
INF = float("inf")
# Values at the limits of number types, names that lead out of a folder or end a text early, and wrong types. \u202e
# reverses the direction of the text after it.
HOSTILE_VALUES: tuple[Any, ...] = (
    NAN, INF, -INF, -1, 0, 1, 2**31, 2**40, 2**63, 2**64 - 1, -(2**63), 1e308, -1e308, 5e-324, True, None, b"\0", "",
    "a\0b", "a\n", "..", "/etc/passwd", "../x", "x" * 300, "x" * 5000, "\u202e", [], [1], {}, {"a": 1}, [[[[[[]]]]]],
)  # fmt: skip
# The resident memory of the program may grow by this in an attack: 384 of the largest messages (64 KiB).
BOUND_BYTES = 24 << 20
BEGIN = m.BeginRun(
    scan_id="scan", plan=RasterPlan(8, 4, 2.0, 2.0), pulses=4, period_us=1500.0, width_us=1.0, speed_mm_s=20.0
)
PULSE = m.Pulse(pulses=1, period_us=1500.0, width_us=1.0)
REPLAY = m.Replay(scan_id="scan", from_seq=1)
ALIVE = m.Alive(scan_id="scan")
RUN = m.RunRow(scan_id="scan", row_index=0, take=1)
END = m.EndRun(scan_id="scan", exit_status="abort")
JOG = m.Jog(axis="x", from_mm=0.0, distance_mm=1.0, speed_mm_s=20.0, heartbeat_ms=100)


def draw_message(rng: random.Random, valid: list[Any]) -> bytes:
    """Draw a message with one or more errors; sometimes a correct one of a client that does not own the run.

    The kinds: random bytes, a correct message, a cut one, one with changed bytes, and (two of six) one with hostile
    values in some of its fields.
    """
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
        if "plan" in node and isinstance(node["plan"], dict) and rng.random() < 0.5:
            inner = node["plan"]
        else:
            inner = node
        inner[rng.choice(sorted(inner) or ["x"])] = copy.deepcopy(rng.choice(HOSTILE_VALUES))
    return msgpack.packb(node, use_bin_type=True) or b""


class Stranger:
    """A client that may send again without waiting for a reply."""

    def __init__(self, address: str) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.socket = self._context.socket(zmq.REQ)
        # A request may follow one without reply; late replies to earlier ones are dropped.
        for option in (zmq.REQ_RELAXED, zmq.REQ_CORRELATE):
            self.socket.setsockopt(option, 1)
        self.socket.connect(address)

    def ask(self, raw: bytes, limit_s: float = HANG_S) -> m.AnyReply | None:
        self.socket.send(raw)
        if self.socket.poll(round(limit_s * 1e3)):
            return m.unpack_reply(self.socket.recv())
        return None

    def close(self) -> None:
        self._context.destroy(linger=0)


@pytest.fixture
def stranger(pi):
    stranger = Stranger(pi.service.server.command_address)
    yield stranger
    stranger.close()


@pytest.mark.parametrize(
    ("commands", "field", "impossible_value"),
    [
        ((BEGIN, PULSE), "period_us", (NAN, INF, -INF, 1e300, 1e70)),
        ((BEGIN, PULSE), "width_us", (NAN, INF, -INF, 1e300, 1e70)),
        ((BEGIN, JOG), "speed_mm_s", (NAN, INF, -INF, 1e300, 1e70)),
        # The run would belong to its host for 35 years of silence.
        ((BEGIN,), "heartbeat_ms", (2**40,)),
        # A jog is at most 100 mm.
        ((JOG,), "distance_mm", (NAN, INF, -INF, 100.1, -100.1)),
        ((JOG,), "from_mm", (NAN, INF, -INF, 1e70)),
        ((JOG,), "heartbeat_ms", (0, -1, 2**40)),
        ((BEGIN, REPLAY, ALIVE, RUN, END), "scan_id", ("a\0b", "x" * 300, "a\n", "..", "../../etc/passwd", "/")),
        ((BEGIN, REPLAY, RUN, END), "scan_id", ("",)),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)  # fmt: skip
def test_a_message_with_an_impossible_value_is_refused(commands, field, impossible_value):
    """The decoder refuses it here; `test_hostile_messages_disturb_nothing` sends such messages through the socket."""
    for command in commands:
        for value in impossible_value:
            raw = msgpack.packb(msgspec.to_builtins(command) | {field: value})
            assert raw is not None
            with pytest.raises(ProtocolError):
                m.unpack_command(raw)


def test_nan_of_single_precision_is_refused_too():
    # In MessagePack 0xcb is the type of a double, and 0xca that of a single precision number.
    raw = m.pack(PULSE).replace(b"\xcb" + struct.pack(">d", 1500.0), b"\xca" + struct.pack(">f", NAN))
    with pytest.raises(ProtocolError):
        m.unpack_command(raw)


def test_a_folder_in_the_journals_place_is_refused(pi, instrument):
    (Path(instrument.pi.journal_dir) / "folder.journal").mkdir()
    for command in (m.Replay(scan_id="folder", from_seq=1), pi.host.make_begin("folder")):
        assert pi.host.must_refuse(command)
    assert pi.host.must_accept(pi.host.make_begin()).state == "idle"


def test_a_message_of_64_mb_is_not_taken_into_memory(pi, stranger):
    # Client and server run in this process, so that its memory has the client's message and a copy of it at least.
    bytes_before = read_resident_bytes()
    big = msgpack.packb({"type": "Hello", "version": "1.0", "host_release": "x" * (64 << 20)})
    bytes_taken = read_resident_bytes() - bytes_before
    assert stranger.ask(big, limit_s=1.0) is None
    copy_of_sender_bytes = 64 << 20
    assert read_resident_bytes() - bytes_before < bytes_taken + copy_of_sender_bytes + BOUND_BYTES
    assert isinstance(pi.host.ask(m.Status()), m.StatusReply)


def test_hostile_messages_disturb_nothing(pi, hub, stage, stranger, instrument, request):
    """Thousands of messages come while rows run. Each gets a reply, and every pulse is at its time."""
    amount = 100_000 if request.config.getoption("--long") else 2_000
    host: HostSide = pi.host
    rng = random.Random(amount)
    wires = WiresLog(hub, *instrument.pi.sync_out)
    host.must_accept(host.make_begin(owner="mine", heartbeat_ms=10_000))
    host.home("mine")
    valid = [
        m.Hello(), m.Status(), ALIVE, m.Home(), JOG, RUN, PULSE, REPLAY, m.Hold(), m.Resume(), m.Abort(), END,
        host.make_begin("other"), host.make_begin(),
    ]  # fmt: skip
    sent = 0
    rows_taken = 0
    bytes_before = 0
    stage.pace_s = 0.05
    host.start_row(owner="mine")
    while sent < amount or not rows_taken:
        assert stranger.ask(draw_message(rng, valid)) is not None
        sent += 1
        # After a thousand messages the program has allocated what it needs in normal work.
        if sent == 1_000:
            bytes_before = read_resident_bytes()
        if host.subscriber.poll(0):
            event = m.unpack_event(host.subscriber.recv_multipart()[-1])
            if isinstance(event, m.RowFinished):
                pulses = instrument.grid.columns * instrument.burst.pulses
                assert (event.status, event.pulses) == ("done", pulses), event
                rows_taken += 1
                # A Pi in fault would refuse every row.
                host.wait_for_state("ready", "fault")
                host.start_row(take=rows_taken + 1, owner="mine")
            host.must_accept(m.Alive(scan_id="scan", owner="mine"))
    assert read_resident_bytes() - bytes_before < BOUND_BYTES
    assert pi.service.executor.crash is None
    host.must_accept(m.Abort(owner="mine"))
    host.wait_for_state("ready")
    wires.close()
    pulses_of_burst = instrument.burst.pulses
    period_ns = round(instrument.burst.period_us * 1e3)
    rises = wires.list_rises(instrument.pi.sync_out[0])
    # The abort may have cut the last burst.
    full_burst_count = len(rises) // pulses_of_burst
    full_bursts = [rises[i * pulses_of_burst : (i + 1) * pulses_of_burst] for i in range(full_burst_count)]
    assert len(full_bursts) >= rows_taken * instrument.grid.columns
    for burst in full_bursts:
        assert burst == [burst[0] + k * period_ns for k in range(pulses_of_burst)]


# Lines of the stage in the test of a flood.
FLOOD_LINES = 100_000
# The largest number that a line may have: ten digits
HUGE = 9_999_999_999
# Numbers of alarms have at most three digits.
ALARMS_END = 1000


@pytest.mark.parametrize("sign", [1, -1])
def test_an_impossible_position_is_ignored(pi, stage, sign):
    """The stage reports a position of 50 km; status and events still have the last possible one."""
    stage.x = stage.y = sign * HUGE
    for alarm in (-HUGE, -1, ALARMS_END, HUGE):
        fields = {"state": "idle", "x": stage.x, "y": stage.y, "points": HUGE, "alarm": alarm}
        stage.say(Reply("status", fields={k: str(v) for k, v in fields.items()}))
    status = pi.host.wait_for_event(m.StageStatus, lambda e: e.points == HUGE)
    assert (status.x_mm, status.y_mm) == (0.0, 0.0)
    assert 0 <= status.alarm < ALARMS_END
    assert pi.host.ask(m.Status()).x_mm == 0.0


def test_impossible_lost_steps_and_points_leave_the_journal_readable(pi, stage):
    """Lost steps are limited to the largest length that messages may have, 1 km."""
    stage.lost = (HUGE, -HUGE)
    pi.host.must_accept(pi.host.make_begin())
    pi.host.home()
    status = pi.host.ask(m.Status())
    assert (status.lost_x_mm, status.lost_y_mm) == (1e6, -1e6)
    stage.stays_after = 2
    pi.host.start_row()
    pi.host.wait_for_event(m.Capture)
    row = stage.seen[-1]
    stage.say(Reply("done", row.sequence, fields={"points": str(HUGE), "pulses": "0", "x": str(HUGE), "y": "0"}))
    row_finished = pi.host.wait_for_event(m.RowFinished)
    assert (row_finished.status, row_finished.points) == ("fault", HUGE)
    assert pi.host.replay()[-1].seq >= row_finished.seq


def test_a_flood_of_lines_keeps_commands_answered(pi, stage):
    """The stage sends far more lines than a serial line carries."""
    lines = (
        Reply("status", fields={"state": "row", "x": "1", "y": "2", "points": "3", "alarm": "0"}),
        Reply("banner", fields={"fw": "x" * 60, "proto": "2"}), Reply("alarm", number=999), Reply("alarm", number=15),
        Reply("done", 7), Reply("ok", 7), Reply("error", None, 1),
    )  # fmt: skip
    repeats = 14
    raw = b"".join(line.encode() for line in lines) * repeats
    ended = threading.Event()

    def flood() -> None:
        for _ in range(FLOOD_LINES // (repeats * len(lines))):
            stage.say_raw(raw)
        ended.set()

    bytes_before = read_resident_bytes()
    thread = threading.Thread(target=flood)
    thread.start()
    while not ended.wait(0.05):
        assert isinstance(pi.host.ask(m.Status()), m.StatusReply)
    thread.join()
    assert read_resident_bytes() - bytes_before < BOUND_BYTES
    assert pi.service.executor.crash is None
    assert isinstance(pi.host.ask(m.Abort()), m.Accepted)


# Flags of a ZMTP frame: further frames follow, its length has eight bytes, it is a command.
MORE = 1
LONG = 2
COMMAND = 4
# 2 GiB, twice the memory of a Pi with 1 GiB: a client that could send this was not stopped.
ENOUGH_BYTES = 2 << 30
# A client that floods the program sends 600 kB a turn, 240 MB/s in all: twice what a Pi's network carries. Without a
# limit, loopback would fill the memory of a busy machine before the program can act.
TURNS_A_SECOND = 400
# Limit of the program's memory, below MemoryMax of the unit, 512 MiB
HIGHEST_BYTES = 400 << 20
# Signature, version 3.0, and the mechanism NULL, as a client.
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + b"\0" + bytes(31)


def encode_frame(body: bytes, flags: int = 0) -> bytes:
    if len(body) < 256:
        return bytes([flags, len(body)]) + body
    return bytes([flags | LONG]) + len(body).to_bytes(8, "big") + body


def connect_peer(address: str, kind: bytes) -> socket.socket:
    """A connection after its handshake, as a socket of this kind."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    peer = socket.create_connection((host, int(port)), timeout=HANG_S)
    peer.sendall(GREETING)
    peer.recv(len(GREETING), socket.MSG_WAITALL)
    peer.sendall(encode_frame(b"\x05READY\x0bSocket-Type" + len(kind).to_bytes(4, "big") + kind, COMMAND))
    return peer


def is_cut(peer: socket.socket) -> bool:
    """True if the other end has closed the connection."""
    while select.select([peer], [], [], 0)[0]:
        if not peer.recv(1 << 16):
            return True
    return False


def wait_a_turn(frames: bytes) -> bytes:
    """Return the frames after a pause, so that there are at most `TURNS_A_SECOND`."""
    time.sleep(1 / TURNS_A_SECOND)
    return frames


# For each attack: the address that it floods, the kind of socket, and a function that makes its next messages.
ATTACKS = {
    "a message of many frames": (
        "commands",
        b"DEALER",
        lambda: wait_a_turn(encode_frame(b"", MORE) + encode_frame(bytes(60_000), MORE) * 10),
    ),
    "subscriptions": ("events", b"SUB", lambda: b"".join(encode_frame(b"\x01" + os.urandom(1000)) for _ in range(50))),
}


@pytest.mark.slow
@pytest.mark.parametrize("attack", ATTACKS)
def test_a_client_without_end_is_cut_off(instrument, start, hub, attack):
    """The next client is served by the same process with the same run."""
    channel, kind, make_messages = ATTACKS[attack]
    program, host = start(instrument, "--wires", hub)
    address = program.ready_line[1] if channel == "commands" else program.events_line[1]
    host.must_accept(host.make_begin())
    host.home()
    pid = program.popen.pid
    # The program's own limit: with its memory locked it may hold more than the least limit from the start.
    limit_bytes = max(MAX_BYTES, read_resident_bytes(pid) + SPARE_BYTES)
    highest_bytes = 0
    ended = threading.Event()

    def watch() -> None:
        nonlocal highest_bytes
        while not ended.wait(0.02):
            highest_bytes = max(highest_bytes, read_resident_bytes(pid))

    watcher = threading.Thread(target=watch)
    watcher.start()
    log = bytearray()

    def has_cut() -> bool:
        """True once the program's log says that it cut connections."""
        errors = program.popen.stderr.fileno()
        while select.select([errors], [], [], 0)[0]:
            log.extend(os.read(errors, 1 << 16))
        return b"connections were cut" in log

    sent = 0
    # ZeroMQ itself ends some of these connections: the client comes back until the program had to act.
    while highest_bytes < limit_bytes and not has_cut() and sent < ENOUGH_BYTES:
        with (
            connect_peer(address, kind) as peer,
            suppress(ConnectionError),
        ):
            # A connection that was cut may take nothing for a while before it is closed.
            peer.settimeout(0.1)
            remaining = b""
            while sent < ENOUGH_BYTES and not is_cut(peer):
                with suppress(TimeoutError):
                    if not remaining:
                        remaining = make_messages()
                    sent_now = peer.send(remaining)
                    sent += sent_now
                    remaining = remaining[sent_now:]
    wait_for(has_cut, "the cut", HANG_S)
    cut_ns = time.monotonic_ns()
    ended.set()
    watcher.join()
    assert 0 < sent < ENOUGH_BYTES
    assert highest_bytes < HIGHEST_BYTES
    # The program cuts all connections, also that of the host's events: it connects again.
    host.wait_for_event(m.Heartbeat, lambda beat: beat.t_mono_ns > cut_ns)
    # The remaining messages may cause another cut of the connections, with a command or an event.
    host.limit_s = 5.0
    takes = itertools.count(1)

    def is_done() -> bool:
        with suppress(AssertionError):
            return host.run_row(0, next(takes)).status == "done"
        return False

    wait_for(is_done, "a row", 120.0)
    with suppress(AssertionError):
        wait_for(lambda: read_resident_bytes(pid) < HIGHEST_BYTES, "that its memory is free")
    status, _, _ = program.end()
    assert status == 0


def test_a_queue_that_never_empties_is_not_a_hang(pi, monkeypatch):
    """The executor completes its turns although items always wait: the watchdog and `Alive` depend on turns."""
    monkeypatch.setattr(executors, "TURN_TIMEOUT_S", 0.05)
    turns = 0

    def count_turn() -> None:
        nonlocal turns
        turns += 1

    monkeypatch.setattr(pi.service.executor, "_turned", count_turn)
    queue_is_empty = threading.Event()
    # Items that each last longer than a turn may.
    for _ in range(60):
        pi.service.executor.post(lambda: pi.clock.sleep(0.06))
    pi.service.executor.post(queue_is_empty.set)
    assert queue_is_empty.wait(HANG_S)
    # A turn ends with the item that exceeds its time: at most two items in each.
    assert turns >= 60 / 2
    assert isinstance(pi.host.ask(m.Status()), m.StatusReply)


def test_replays_do_not_keep_other_commands_waiting(pi):
    """Only a few replays may wait at a time. Further ones are refused, but an abort is still accepted."""
    go_on = threading.Event()
    pi.service.executor.post(lambda: go_on.wait(HANG_S))
    replay = m.Replay(scan_id="scan", from_seq=1)
    is_queued = [pi.service.executor.submit(replay, lambda _: None) for _ in range(10)]
    assert is_queued == [True] * REPLAYS_WAITING + [False] * (10 - REPLAYS_WAITING)
    assert pi.service.executor.submit(m.Abort(), lambda _: None)
    go_on.set()
