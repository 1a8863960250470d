"""Data that the checks share: findings, options, rig file, connection to the Pi, card surveys, captured frames."""

from __future__ import annotations

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
from polysight.capture import CardSurvey, RowCapture, row_words, survey_cards
from polysight.doctor.machine import LoadResult, clock_is_synchronised, measure_receivers, write_speed
from polysight.radar import BoardState, radar_control
from polysight.store import PART
from polysight_shared.config import Instrument
from polysight_shared.findings import Finding
from polysight_shared.messages import HelloReply, Pulsed

if TYPE_CHECKING:
    from polysight.calibration import DirectSignal

_LAST_PACKET_S = 2.5  # a card sends its short last packet two seconds after the last data
_POLL_S = 0.05


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
    """Return the word of a finding for people and for `--json`: a check that was skipped is a note here."""
    return "not checked" if finding.level == "note" else finding.level


def finding_facts(finding: Finding) -> dict[str, Any]:
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
    """Options of the command. `out`: folder for scans; `move`: run a row; `pulse`: send SYNC_IN pulses at rest."""

    config: Path
    out: Path = Path()
    move: bool = False
    pulse: bool = True
    bursts: int = 4


@dataclass(frozen=True)
class System:
    """Functions that query this machine, so that tests can replace them. `root`: root of the file system."""

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
        int16 [frame, sample, 2, rx], I before Q.
    valid
        bool [frame]: received complete.
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
        Names of boards whose card passed the check `buffer`.
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
        CaptureRig(rig) as cards,  # first: fails if a scan uses the ports, before a radar is configured
        radar_control(rig) as radars,
    ):
        for board in rig.recorded:
            (Path(folder) / "raw" / board.name).mkdir(parents=True)
        cards.configure()
        radars.arm(frames)
        cards.begin_row(0, 1, bursts, Path(folder))
        radars.row_begins()
        sent = pi.pulse(frames, rig.burst.period_us, rig.burst.width_us)
        deadline = time.monotonic() + _LAST_PACKET_S + rig.limits.end_of_record_s
        while not cards.complete and time.monotonic() < deadline:
            cards.statuses()
            time.sleep(_POLL_S)
        rows = cards.end_row()
        states = radars.states()
        captured = {}
        for name, row in rows.items():
            payload = np.fromfile(Path(folder) / "raw" / name / f"0000{PART}", np.uint8)
            chirps = frames * rig.burst.chirps
            words, valid = row_words(payload, row.missing, chirps, rig.chirp.samples, len(rig.antennas.rx_mm))
            captured[name] = CapturedFrames(words, valid, row, states.get(name))
        return captured, sent


def with_boards(rig: Instrument, names: set[str]) -> Instrument:
    """Return the rig with only these boards recorded."""
    boards = tuple(msgspec.structs.replace(b, record=b.record and b.name in names) for b in rig.boards)
    return msgspec.structs.replace(rig, boards=boards)
