"""Check every hop between a capture card and the host's memory, in order."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from polysight.capture.card import CardClient
from polysight.capture.network import Hop, check_receive_buffer, route_interface, silent_hop, silent_radar
from polysight.capture.receiver import ReceiverProcess, RowCapture
from polysight.capture.scheduling import PRIORITY_REMEDY, Core, receiver_cores
from polysight_shared.config import Board, Instrument
from polysight_shared.errors import DeviceError
from polysight_shared.findings import Finding

HOPS = ("host", "route", "link", "card", "receiver", "buffer", "radar")
"""The host's address and ports, the interface, its cable, the card; then the receiver process, its buffer, data."""
PULSES = "`polysight doctor`: it sends pulses with the stage at rest, and reports each one"
_FAULTY_HOP = {Hop.ROUTE: "route", Hop.LINK: "link"}
_POLL_S = 0.05


@dataclass
class CardSurvey:
    """Survey result of one board's capture card; `version` is "" if the card did not reply.

    Each finding is about the hop in `where`; a `note` says that the hop was not checked.
    """

    board: Board
    version: str = ""
    hops: list[Finding] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """True if no hop has an error."""
        return all(hop.level != "error" for hop in self.hops)

    @property
    def silent(self) -> str:
        """The first hop with an error; "" if none has."""
        return next((hop.where for hop in self.hops if hop.level == "error"), "")


def survey_cards(instrument: Instrument, listen_s: float = 0.0) -> list[CardSurvey]:
    """Check the cards of all boards in parallel; return the results in the order of the rig file.

    From every recorded board, data is recorded for `listen_s` seconds (0: not at all), to check that its radar streams.
    """
    cores = dict(zip(instrument.recorded, receiver_cores(len(instrument.recorded)), strict=True))
    with ThreadPoolExecutor(len(instrument.boards)) as pool:
        surveys = [pool.submit(_survey, b, instrument, cores.get(b), listen_s) for b in instrument.boards]
        return [survey.result() for survey in surveys]


def _survey(board: Board, instrument: Instrument, core: Core | None, listen_s: float) -> CardSurvey:
    survey = CardSurvey(board)
    found = survey.hops
    try:
        with CardClient(board, instrument.limits.command_timeout_s) as card:
            found.append(_ok("host", f"{board.host_address}:{board.command_port} is free to listen at"))
            found += _reach(survey, card)
            if survey.ok and board.record:
                found += _receive(card, instrument, core, listen_s)
    except DeviceError as e:
        found.append(_wrong("host", e))
    tried = {hop.where for hop in found}
    found += [Finding("note", "", where=hop) for hop in HOPS if hop not in tried]
    return survey


def _ok(hop: str, what: str) -> Finding:
    return Finding("ok", what, where=hop)


def _wrong(hop: str, e: DeviceError) -> Finding:
    return Finding.of_error(e, where=hop)


def _reach(survey: CardSurvey, card: CardClient) -> Iterator[Finding]:
    """Check route, link and card. If the card replies, the hops before it are ok."""
    address = card.board.card_address
    error = None
    try:
        card.alive()
        survey.version = str(card.version())
    except DeviceError as e:
        error = e
    faulty = "" if error is None else _FAULTY_HOP.get(silent_hop(address), "card")
    interface = "loopback" if address.startswith("127.") else route_interface(address) or "unknown interface"
    for hop, found in (("route", interface), ("link", interface), ("card", f"replies, FPGA {survey.version}")):
        if error is not None and hop == faulty:
            yield _wrong(hop, error)
            return
        yield _ok(hop, found)


def _receive(card: CardClient, instrument: Instrument, core: Core | None, listen_s: float) -> Iterator[Finding]:
    """Check the receiver process as a scan starts it, its buffer, and the radar's data."""
    board, wanted = card.board, instrument.card.receive_buffer_bytes
    try:
        receiver = ReceiverProcess(board, wanted, core)
    except DeviceError as e:
        yield _wrong("receiver", e)
        return
    with receiver:
        if receiver.warnings:
            refused = "; ".join(warning.removeprefix(f"{board.name}: ") for warning in receiver.warnings)
            yield Finding("warning", receiver.scheduling, refused, PRIORITY_REMEDY, "receiver")
        else:
            yield _ok("receiver", receiver.scheduling)
        burst_bytes = instrument.burst.pulses * instrument.frame_bytes
        try:
            warning = check_receive_buffer(board.name, receiver.granted_bytes, wanted, burst_bytes)
        except DeviceError as e:
            yield _wrong("buffer", e)
            return
        if warning:
            yield Finding("warning", warning.removeprefix(f"{board.name}: "), where="buffer")
        else:
            yield _ok("buffer", f"{receiver.granted_bytes} bytes granted, {wanted} requested")
        if listen_s > 0:
            yield _listen(card, receiver, instrument, listen_s)
        else:
            yield Finding("note", "it sends data only when it is triggered", do=PULSES, where="radar")


def _listen(card: CardClient, receiver: ReceiverProcess, instrument: Instrument, listen_s: float) -> Finding:
    """Record for a time, or until a row's bytes have arrived, into a temporary file."""
    try:
        with tempfile.TemporaryDirectory(prefix="polysight-card-") as folder:
            card.record_stop()
            card.configure(instrument.card)
            receiver.begin_row(0, 1, instrument.row_bytes, instrument.frame_bytes, Path(folder) / "listened.bin")
            card.record_start()
            deadline = time.monotonic() + listen_s
            while time.monotonic() < deadline and not receiver.poll().complete:
                card.take_status()
                time.sleep(_POLL_S)
            card.record_stop()
            got = receiver.end_row(card.take_status())
    except DeviceError as e:
        return _wrong("radar", e)
    return _wrong("radar", silent_radar(card.board, got)) if got.packets == 0 else _streams(got)


def _streams(got: RowCapture) -> Finding:
    """Report a radar's data; the start of its record is unknown, so only gaps between packets count as lost."""
    text = f"{got.packets} packets, {got.bytes} bytes came"
    if got.lost_before_packets:
        return Finding(
            "warning",
            text,
            f"the card reports {got.lost_before_packets.name}: it dropped data",
            "a shorter card.packet_delay_us in instrument.toml lets the card send faster",
            "radar",
        )
    if got.gap_bytes or got.strangers:
        return Finding(
            "warning",
            text,
            f"{got.gap_bytes} bytes are lost in {got.gaps} gaps, {got.kernel_drops} packets dropped by this machine,"
            f" {got.strangers} came from elsewhere",
            "check cable and switch, the receive buffer above, and that no two cards have the same ports",
            "radar",
        )
    return _ok("radar", text)
