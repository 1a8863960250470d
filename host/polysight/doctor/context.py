"""Objects that the checks examine: this machine, the options and the rig file, the Pi, card surveys, captured frames.

The first part of this file has the measurements of this machine: clock, network interfaces, disk, and receivers over
loopback while every core is busy. The second part has the findings of checks, and `CheckContext`, which all checks
share.
"""

from __future__ import annotations

import array
import ctypes
import fcntl
import os
import random
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray

from polysight.acquisition import CaptureRig, PiClient
from polysight.capture import (
    CARD_SOURCE_PORT,
    MAX_PAYLOAD_BYTES,
    PACKET_TIME_US,
    CardSurvey,
    ReceiverProcess,
    RowCapture,
    receiver_cores,
    survey_cards,
    view_row_words,
)
from polysight.radar import BoardState, open_radar_control
from polysight.store import PART_SUFFIX
from polysight_shared.config import Instrument
from polysight_shared.findings import Finding
from polysight_shared.messages import HelloReply, Pulsed

if TYPE_CHECKING:
    from polysight.calibration import DirectSignal

# Flag in the status of struct timex, see adjtimex(2).
_STA_UNSYNC = 0x40
# The ioctl of ethtool (linux/sockios.h), and its command to read the sizes of rings (linux/ethtool.h).
_SIOCETHTOOL = 0x8946
_ETHTOOL_GRINGPARAM = 0x10
# Indices of two words of struct ethtool_ringparam: the size of the largest receive ring and of the one in use.
_RX_MAX_WORD = 1
_RX_WORD = 5
# Files of sysfs that count packets which an interface dropped.
_DROP_COUNTERS = ("rx_missed_errors", "rx_fifo_errors", "rx_dropped")
# The probe of a disk ends after this many bytes, or on a slow disk after this time; both are chosen.
_PROBE_BYTES = 64 << 20
_PROBE_S = 2.0

# Time limit for the short last packet, which a card sends two seconds after the last data; chosen.
_LAST_PACKET_S = 2.5
# Time between two looks for the last packet; chosen.
_POLL_S = 0.05


def clock_is_synchronised() -> bool | None:
    """Return the kernel's synchronisation flag (adjtimex(2)); None if the system does not provide it."""
    # The buffer is larger than struct timex; its zeros (modes = 0) request a read.
    timex = ctypes.create_string_buffer(512)
    adjtimex = getattr(ctypes.CDLL(None, use_errno=True), "adjtimex", None)
    if adjtimex is None or adjtimex(timex) < 0:
        return None
    # The fields are modes, offset, freq, maxerror, esterror, status.
    *_, status = struct.unpack_from("@illlli", timex.raw)
    return not status & _STA_UNSYNC


@dataclass(frozen=True)
class NetworkInterface:
    """Settings and drop count of a network interface. None: unknown.

    `ring` and `ring_max` are the number of its receive descriptors and the largest possible one, `lost` is the number
    of packets dropped since it came up.
    """

    name: str
    mtu: int | None = None
    speed_mbit: int | None = None
    ring: int | None = None
    ring_max: int | None = None
    lost: int = 0


def read_interface(name: str, root: Path = Path("/")) -> NetworkInterface:
    """Read an interface's settings from sysfs under `root`; the receive ring only for the running system."""
    folder = root / "sys/class/net" / name

    def number(file: str) -> int | None:
        """Return the number in a file of the interface; None if it is missing or negative."""
        try:
            value = int((folder / file).read_text(encoding="ascii"))
        except (OSError, ValueError):
            return None
        # The kernel writes -1 for an interface that is down.
        if value < 0:
            return None
        return value

    ring = None
    ring_max = None
    if root == Path("/"):
        ring, ring_max = _receive_ring(name)
    dropped = sum(number(f"statistics/{counter}") or 0 for counter in _DROP_COUNTERS)
    return NetworkInterface(name, number("mtu"), number("speed"), ring, ring_max, dropped)


def _receive_ring(name: str) -> tuple[int, int] | tuple[None, None]:
    """Return the receive descriptors in use and their maximum (ethtool -g); None if not reported."""
    # The structure has the command and eight sizes; the request names the interface and points to it.
    words = array.array("I", [_ETHTOOL_GRINGPARAM] + 8 * [0])
    request = struct.pack("16sP16x", name.encode()[:15], words.buffer_info()[0])
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
            fcntl.ioctl(sock, _SIOCETHTOOL, request)
    except OSError:
        return None, None
    return words[_RX_WORD], words[_RX_MAX_WORD]


def write_speed(folder: Path) -> float:
    """Measure the durable write speed of this folder's disk, bytes/s, with a temporary file of 64 MiB or two seconds.

    Raises OSError.
    """
    block = os.urandom(1 << 20)
    with tempfile.TemporaryFile(dir=folder) as file:
        started_s = time.perf_counter()
        written_bytes = 0
        while written_bytes < _PROBE_BYTES and time.perf_counter() - started_s < _PROBE_S:
            file.write(block)
            file.flush()
            os.fsync(file.fileno())
            written_bytes += len(block)
        return written_bytes / (time.perf_counter() - started_s)


# Duration of the load at each rate; chosen, so that the whole check takes a few seconds.
_RATE_S = 1.5
# Time for a receiver that was late to read the packets that wait in its socket; chosen.
_DRAIN_S = 5.0
_SENDER_PROGRAM = Path(__file__).with_name("send_packets.py")
_BUSY_LOOP = "while True: sum(range(100_000))"


@dataclass(frozen=True)
class LoadResult:
    """Result at one rate: packets/s of each card, requested (`wanted`) and reached; packets sent and lost in all."""

    wanted: float
    reached: float
    sent: int
    lost: int

    @property
    def mbit_s(self) -> float:
        """Payload rate of one card, Mbit/s."""
        return self.reached * MAX_PAYLOAD_BYTES * 8e-6


def card_rates(rig: Instrument) -> list[float]:
    """Packet rates of a card, packets/s, ascending: during bursts, while emptying its memory, and its maximum."""
    burst = rig.frame_bytes / MAX_PAYLOAD_BYTES / (rig.burst.period_us * 1e-6)
    emptying = 1e6 / (rig.card.packet_delay_us + PACKET_TIME_US)
    # 5 us is the shortest delay for which TI gives a rate.
    maximum = 1e6 / (5.0 + PACKET_TIME_US)
    return sorted({burst, emptying, maximum})


def measure_receivers(rig: Instrument, rates: list[float], seconds: float = _RATE_S) -> tuple[list[LoadResult], str]:
    """Send packets at each rate (packets/s) to the receivers of all recorded boards, with a busy process on each core.

    Returns the result for each rate and the receivers' scheduling. Raises DeviceError if a receiver does not start.
    """
    # Draw addresses of the loopback device, so that another doctor or a scan does not use the same ones.
    subnet = f"127.{random.randint(2, 250)}.{random.randint(1, 250)}"
    boards = [
        msgspec.structs.replace(b, card_address=f"{subnet}.{100 + k}", host_address=f"{subnet}.30")
        for k, b in enumerate(rig.recorded)
    ]
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="polysight-receivers-")))
        receivers = [
            stack.enter_context(ReceiverProcess(b, rig.card.receive_buffer_bytes, core))
            for b, core in zip(boards, receiver_cores(len(boards)), strict=True)
        ]
        for _ in range(os.cpu_count() or 1):
            busy = stack.enter_context(subprocess.Popen([sys.executable, "-c", _BUSY_LOOP], start_new_session=True))
            stack.callback(busy.kill)
        results = []
        for rate in rates:
            packets = max(2, round(rate * seconds))
            results.append(_measure_rate(rate, packets, receivers, folder))
        return results, receivers[0].scheduling


def _measure_rate(rate: float, packets: int, receivers: list[ReceiverProcess], folder: Path) -> LoadResult:
    """Send `packets` packets to each receiver, and count those that are lost.

    The packets are those of cards that were reset, so that losses at an earlier rate do not count.
    """
    for receiver in receivers:
        part = folder / f"{receiver.board.name}.part"
        # The packets hold no frames.
        receiver.begin_row(
            row=0, take=1, expected_bytes=packets * MAX_PAYLOAD_BYTES, frame_bytes=1, path=part, after_reset=True
        )
    senders = []
    for receiver in receivers:
        card = (receiver.board.card_address, CARD_SOURCE_PORT)
        host = (receiver.board.host_address, receiver.board.data_port)
        words = map(str, (*card, *host, packets, rate, MAX_PAYLOAD_BYTES))
        command = [sys.executable, "-I", str(_SENDER_PROGRAM), *words]
        senders.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
    # A sender prints the seconds that it took; one that failed prints nothing.
    sending_s = [float(sender.communicate()[0] or "inf") for sender in senders]
    # Wait until all packets are in place, or nothing more arrives: the rest is lost.
    deadline = time.monotonic() + _DRAIN_S
    while not all(r.poll().complete for r in receivers) and time.monotonic() < deadline:
        received_before = [r.report().received for r in receivers]
        time.sleep(0.2)
        if [r.report().received for r in receivers] == received_before:
            break
    lost_packets = sum(packets - r.end_row().counts.placed for r in receivers)
    return LoadResult(rate, packets / max(sending_s), packets * len(receivers), lost_packets)


def ok(what: str, **facts: Any) -> Finding:
    """Return a finding without a fault."""
    return Finding("ok", what, facts=facts)


def warning(what: str, why: str, do: str, **facts: Any) -> Finding:
    """Return a fault that still allows a scan."""
    return Finding("warning", what, why, do, facts=facts)


def error(what: str, why: str, do: str, **facts: Any) -> Finding:
    """Return a fault that would make a scan fail or its data useless."""
    return Finding("error", what, why, do, facts=facts)


def verdict(finding: Finding) -> str:
    """Return the verdict on a finding for people and for `--json`; the note of a skipped check is "not checked"."""
    if finding.level == "note":
        return "not checked"
    return finding.level


def finding_to_json(finding: Finding) -> dict[str, Any]:
    """Return a finding as `doctor --json` prints it."""
    return {
        "verdict": verdict(finding),
        "found": finding.what,
        "why": finding.why,
        "remedy": finding.do,
        "facts": finding.facts,
        "check": finding.where,
    }


def not_checked(what: str, do: str = "") -> Finding:
    """Return the finding of a check that was skipped, by option or because data is missing: a note."""
    return Finding("note", what, do=do)


@dataclass(frozen=True)
class DoctorOptions:
    """Options of the command.

    `out` is the folder for scans. With `move` a row is run, with `pulse` `bursts` bursts of SYNC_IN pulses are sent at
    rest.
    """

    config: Path
    out: Path = Path()
    move: bool = False
    pulse: bool = True
    bursts: int = 4


@dataclass(frozen=True)
class System:
    """Functions that query this machine, which tests can replace, and the root of the file system, `root`."""

    wall_ns: Callable[[], int] = time.time_ns
    clock_is_synchronised: Callable[[], bool | None] = clock_is_synchronised
    write_speed: Callable[[Path], float] = write_speed
    measure_receivers: Callable[[Instrument, list[float]], tuple[list[LoadResult], str]] = measure_receivers
    root: Path = Path("/")


@dataclass(frozen=True)
class CapturedFrames:
    """Frames of one board.

    Attributes
    ----------
    words
        int16 [chirp, sample, 2, rx], I before Q.
    valid
        bool [chirp]: received complete.
    row
        Packet and byte counts of the receiver.
    radar
        State of the radar; None if its backend does not report it.
    """

    words: NDArray[np.int16]
    valid: NDArray[np.bool_]
    row: RowCapture
    radar: BoardState | None = None


@dataclass
class CheckContext(ExitStack):
    """State of one run of the doctor; a context manager that closes the connection to the Pi.

    Attributes
    ----------
    loaded_rig
        The rig file, once the check `config` has loaded it.
    hello, hello_at_ns, hello_took_ns
        The Pi's self-description; this machine's wall clock in the middle of the request, and its duration, in ns.
    usable_cards
        Names of boards whose card had no error in the check `buffer`.
    captured, signals
        Frames and direct path of each board, by name.
    """

    options: DoctorOptions
    system: System = System()
    loaded_rig: Instrument | None = None
    hello: HelloReply | None = None
    hello_at_ns: int = 0
    hello_took_ns: int = 0
    usable_cards: set[str] = field(default_factory=set)
    captured: dict[str, CapturedFrames] = field(default_factory=dict)
    signals: dict[str, DirectSignal] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__init__()

    @property
    def rig(self) -> Instrument:
        """The rig file. Raises RuntimeError if a check uses it without naming `config` among its prerequisites."""
        if self.loaded_rig is None:
            raise RuntimeError("a check that uses the rig file needs the check 'config'")
        return self.loaded_rig

    @cached_property
    def pi(self) -> PiClient:
        """Connection to the Pi, opened at the first use. Raises ConfigError if keys are missing."""
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.callback(context.destroy, linger=0)
        return self.enter_context(PiClient(context, self.rig))

    @cached_property
    def surveys(self) -> dict[str, CardSurvey]:
        """Network survey of all capture cards, by board name; made once."""
        return {survey.board.name: survey for survey in survey_cards(self.rig)}


def capture_frames(rig: Instrument, pi: PiClient, bursts: int) -> tuple[dict[str, CapturedFrames], Pulsed]:
    """Record `bursts` bursts of every recorded board with the stage at rest; the data is deleted afterwards.

    The Pi sends the bursts without a pause, because a card would end its record at a pause.

    Raises
    ------
    DeviceError, ScanError
        if a card, the disk or the Pi fails.
    ConfigError
        if the configured radar backend is not available.
    """
    frames = bursts * rig.burst.pulses
    with (
        tempfile.TemporaryDirectory(prefix="polysight-doctor-") as folder,
        # The cards come first: they fail if a scan uses their ports, before a radar is configured.
        CaptureRig(rig) as cards,
        open_radar_control(rig) as radars,
    ):
        for board in rig.recorded:
            (Path(folder) / "raw" / board.name).mkdir(parents=True)
        cards.configure()
        radars.arm(frames)
        cards.begin_row(row=0, take=1, points=bursts, folder=Path(folder))
        radars.note_row_start()
        pulses_sent = pi.pulse(frames, rig.burst.period_us, rig.burst.width_us)
        deadline = time.monotonic() + _LAST_PACKET_S + rig.limits.end_of_record_s
        while not cards.complete and time.monotonic() < deadline:
            cards.statuses()
            time.sleep(_POLL_S)
        rows = cards.end_row()
        states = radars.states()
        captured = {}
        for name, row in rows.items():
            # The row is never committed, so that its file has the name of an unfinished one.
            payload = np.fromfile(Path(folder) / "raw" / name / f"0000{PART_SUFFIX}", np.uint8)
            chirps = frames * rig.burst.chirps
            words, valid = view_row_words(payload, row.missing, chirps, rig.chirp.samples, len(rig.antennas.rx_mm))
            captured[name] = CapturedFrames(words, valid, row, states.get(name))
        return captured, pulses_sent


def select_boards(rig: Instrument, names: set[str]) -> Instrument:
    """Return the rig with only these boards recorded."""
    boards = tuple(msgspec.structs.replace(b, record=b.record and b.name in names) for b in rig.boards)
    return msgspec.structs.replace(rig, boards=boards)
