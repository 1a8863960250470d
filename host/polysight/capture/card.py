"""Control of one DCA1000 over UDP: start, stop and reset it, program its EEPROM, and check every hop to it.

The socket is never connected: replies come from the card's port 1024, for any port of the command. Only commands
that are safe to repeat are retried. If no reply comes before the timeout, the error names the hop that does not work.
`program_eeprom` writes new addresses and a new MAC address, which take effect when the card is next switched on.
`survey_cards` checks the hops between each card and the host's memory, in order.
"""

from __future__ import annotations

import errno
import ipaddress
import select
import struct
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from polysight.capture import dca1000
from polysight.capture.dca1000 import Code, Reply, Status, Version
from polysight.capture.network import (
    Hop,
    bind_udp,
    check_receive_buffer,
    explain_missing_route,
    explain_silent_card,
    explain_silent_radar,
    find_silent_hop,
    neighbour_mac,
    route_interface,
)
from polysight.capture.receiver import PRIORITY_REMEDY, Core, ReceiverProcess, RowCapture, receiver_cores
from polysight_shared.closing import Closing
from polysight_shared.config import Board, Card, Instrument
from polysight_shared.errors import ConfigError, DeviceError, ErrorCode, ProtocolError
from polysight_shared.findings import Finding

# Number of times that a command is sent before the card counts as silent (chosen); all together have one timeout.
ATTEMPTS = 3
# Time to wait for a second answer to one request, which a second card with this address would send (chosen).
_TWIN_S = 0.05
# Datagrams that may wait in the command socket when the time is over: Linux's usual 212,992 bytes hold 280 short ones.
SOCKET_DATAGRAMS = 1000
# Time to wait for the card's report of a failed write after its reply (chosen: no card has been measured).
EEPROM_REPORT_S = 0.5
# Command and data port, as the EEPROM holds them.
_PORTS = struct.Struct("<HH")
# Default MAC address of a card.
DEFAULT_MAC = "12:34:56:78:90:12"
_MAC_REMEDY = "give six bytes in hexadecimal, the first of them even, e.g. 12:34:56:78:90:13"


class CardClient(Closing):
    """Client of one capture card.

    Parameters
    ----------
    board
        Name, addresses and ports.
    timeout_s
        Timeout of a command, all attempts together.

    Raises
    ------
    DeviceError
        if the command port is in use or the host address is not this machine's.
    """

    def __init__(self, board: Board, timeout_s: float) -> None:
        self.board = board
        self._timeout_s = timeout_s
        self._address = (board.card_address, board.command_port)
        self._socket = bind_udp(board.host_address, board.command_port, f"{board.name} commands")
        self._status = Status(0)
        # MAC addresses that the kernel has had for the card's address.
        self._macs: set[str] = set()
        # Datagrams that were neither replies nor status of this card.
        self.strangers = 0

    def fileno(self) -> int:
        """Return the descriptor that becomes readable when the card reports a status."""
        return self._socket.fileno()

    @property
    def mac(self) -> str:
        """MAC address of the card; "" if the kernel does not know it."""
        return next(iter(self._macs), "")

    def check_alive(self) -> None:
        """Check that the card replies; otherwise raise DeviceError with the first hop that does not work."""
        self._send_command(Code.ALIVE)

    def read_version(self) -> Version:
        """Return the card's FPGA version. Raises DeviceError."""
        return dca1000.decode_version(self._exchange(Code.VERSION, b"", ATTEMPTS).status)

    def require_alone(self) -> None:
        """Check that one card alone has this address: one answer to one request, one MAC address.

        Raises DeviceError if there are two, or no answer. A second card sends whole rows that look like this one's.
        """
        self._note_mac()
        versions: list[Version] = []
        requests = 0
        while not versions:
            if requests == ATTEMPTS:
                raise self._no_answer_error(Code.VERSION, ATTEMPTS)
            requests += 1
            reply = self._try(Code.VERSION, b"", self._timeout_s / ATTEMPTS)
            if reply is not None:
                versions.append(dca1000.decode_version(reply.status))
        # The answer to an earlier attempt may only be late.
        deadline = time.monotonic() + _TWIN_S
        while len(versions) <= requests and (remaining_s := deadline - time.monotonic()) > 0:
            reply = self._receive(remaining_s)
            if reply is not None and reply.code == Code.VERSION:
                versions.append(dca1000.decode_version(reply.status))
        asked = "one request" if requests == 1 else f"{requests} requests"
        answers = f"{len(versions)} answers to {asked} (FPGA {', '.join(map(str, versions))})"
        self._note_mac(answers)
        if len(versions) > requests:
            raise self._twin_error(answers)

    def _note_mac(self, *answers: str) -> None:
        """Raise DeviceError, with the `answers`, if this address has had two MAC addresses since the first call."""
        mac = neighbour_mac(self.board.card_address)
        if mac:
            self._macs.add(mac)
        if len(self._macs) > 1:
            raise self._twin_error(*answers, f"MAC addresses {' and '.join(sorted(self._macs))}")

    def _twin_error(self, *addresses_seen: str) -> DeviceError:
        return DeviceError(
            f"{self._name()}: {', '.join(addresses_seen)}",
            "two cards have this address or were exchanged, or the network duplicates packets: rows of one card "
            "cannot be distinguished from those of the other",
            "give each card its own address (`polysight card`, docs/how-to/install.md), or unplug the second one;"
            f" `arping {self.board.card_address}` shows who answers",
            code=ErrorCode.VALUES_CONFLICT,
        )

    def configure(self, card: Card, lanes: int = 4) -> None:
        """Configure raw 16-bit capture of `lanes` LVDS lanes to Ethernet, and the packet delay. Raises DeviceError."""
        self._send_command(Code.CONFIGURE_FPGA, dca1000.encode_fpga_configuration(lanes))
        self._send_command(
            Code.CONFIGURE_PACKET, dca1000.encode_packet_configuration(card.packet_bytes, card.packet_delay_us)
        )

    def reset_fpga(self) -> None:
        """Reset the FPGA; its configuration is lost. Raises DeviceError."""
        self._send_command(Code.RESET_FPGA)

    def reset_radar(self) -> None:
        """Reset the radar board on the card; it must be armed again. Raises DeviceError."""
        self._send_command(Code.RESET_RADAR)

    def write_eeprom(self, body: bytes) -> Status:
        """Send the 18 bytes of command 0x04; return the status bits that the card reports. For `program_eeprom`.

        No retry: the card may be writing. Raises DeviceError when the card refuses or is silent.
        """
        self._status = Status(0)
        self._check(self._exchange(Code.CONFIGURE_EEPROM, body, 1), Code.CONFIGURE_EEPROM)
        # A failure is a separate message, perhaps after the reply.
        self._receive(EEPROM_REPORT_S)
        return self.take_status()

    def record_start(self) -> None:
        """Start a record; before a retry it is stopped, because it may run already.

        Raises DeviceError, also if another card than before answers at this address.
        """
        for attempt in range(ATTEMPTS):
            self.take_status()
            # Errors that the previous record left do not belong to this one.
            self._status = Status(0)
            reply = self._try(Code.RECORD_START, b"", self._timeout_s / ATTEMPTS)
            # A completion that was reported before the reply belongs to the previous record.
            self._status &= ~Status.RECORD_COMPLETED
            if reply is not None:
                self._check(reply, Code.RECORD_START)
                self._note_mac()
                return
            if attempt < ATTEMPTS - 1:
                self.record_stop()
        raise self._no_answer_error(Code.RECORD_START, ATTEMPTS)

    def record_stop(self) -> None:
        """Stop the record; a card that does not record may refuse. Raises DeviceError if there is no reply."""
        self._exchange(Code.RECORD_STOP, b"", ATTEMPTS)

    def wait_completed(self, limit_s: float) -> None:
        """Wait, after a stop, until the card reports the record as completed, or until the timeout.

        Before that status, but after the reply to the stop, the card sends the rest of the record as a short packet,
        which must not be taken for the next record's.
        """
        deadline = time.monotonic() + limit_s
        while Status.RECORD_COMPLETED not in self.take_status() and (remaining_s := deadline - time.monotonic()) > 0:
            select.select([self._socket], [], [], remaining_s)

    def take_status(self) -> Status:
        """Return the status bits that the card reported since the last record start, without waiting."""
        for _ in self._replies(0.0):
            pass
        return self._status

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _send_command(self, code: Code, data: bytes = b"") -> None:
        """Send a command, repeated if there is no reply. Raises DeviceError if the card refuses or is silent."""
        self._check(self._exchange(code, data, ATTEMPTS), code)

    def _check(self, reply: Reply, code: Code) -> None:
        """Raise DeviceError if the card refused the command: any status but 0."""
        if reply.status != 0:
            raise DeviceError(
                f"{self._name()} refused {code.name} with status {reply.status}",
                "the card is in another state than expected, or its switches select another mode",
                "power-cycle the card, and check its mode switches (docs/spec/dca1000.md)",
                code=ErrorCode.REFUSED_BY_PEER,
            )

    def _exchange(self, code: Code, data: bytes, attempts: int) -> Reply:
        """Send up to `attempts` times and return the first reply. Raises DeviceError if there is none."""
        for _ in range(attempts):
            reply = self._try(code, data, self._timeout_s / attempts)
            if reply is not None:
                return reply
        raise self._no_answer_error(code, attempts)

    def _try(self, code: Code, data: bytes, limit_s: float) -> Reply | None:
        """Send once and return the reply to this code, None after the timeout. Raises DeviceError if sending fails."""
        # Late replies to an earlier attempt are ignored.
        for _ in self._replies(0.0):
            pass
        try:
            self._socket.sendto(dca1000.encode_request(code, data), self._address)
        except OSError as e:
            if e.errno in (errno.ENETUNREACH, errno.EHOSTUNREACH):
                raise explain_missing_route(
                    self.board, f"no route to {self._name()} from {self.board.host_address}"
                ) from None
            problem = f"sending to {self._name()} failed: {e.strerror}"
            raise explain_silent_card(self.board, problem) from e
        return next((reply for reply in self._replies(limit_s) if reply.code == code), None)

    def _receive(self, limit_s: float) -> Reply | None:
        """Return the next reply, None after the timeout."""
        return next(self._replies(limit_s), None)

    def _replies(self, limit_s: float) -> Iterator[Reply]:
        """Yield replies until the timeout; collect status bits and count foreign datagrams.

        Datagrams that wait already are read even if the time is over, because the system may have suspended this
        program meanwhile: at most as many as a socket holds, for a flood of them has no end.
        """
        deadline = time.monotonic() + limit_s
        late_replies = 0
        while late_replies < SOCKET_DATAGRAMS:
            remaining_s = deadline - time.monotonic()
            if remaining_s <= 0:
                late_replies += 1
            if not select.select([self._socket], [], [], max(0.0, remaining_s))[0]:
                return
            try:
                raw, (address, _) = self._socket.recvfrom(2048)
            except (BlockingIOError, ConnectionError):
                continue
            if address != self.board.card_address:
                self.strangers += 1
                continue
            try:
                reply = dca1000.decode_reply(raw)
            except ProtocolError:
                self.strangers += 1
                continue
            if reply.code == Code.STATUS:
                # `Status` has twelve bits.
                self._status |= Status(reply.status & 0x0FFF)
            else:
                yield reply

    def _name(self) -> str:
        return f"capture card of {self.board.name} at {self.board.card_address}:{self.board.command_port}"

    def _no_answer_error(self, code: Code, attempts: int) -> DeviceError:
        """Return the error for a card that does not answer, with the hop that does not work, if known."""
        attempts_text = "1 attempt"
        if attempts > 1:
            attempts_text = f"{attempts} attempts"
        problem = f"{self._name()} did not answer {code.name} within {self._timeout_s:g} s ({attempts_text})"
        return explain_silent_card(self.board, problem)


@dataclass(frozen=True)
class EepromSettings:
    """Settings in the EEPROM; they take effect when the card is next switched on.

    The card answers to `host_address` and `command_port`, and sends data to `host_address` and `data_port`.

    Raises
    ------
    ConfigError
        if a card with these settings could not be reached.
    """

    host_address: str
    card_address: str
    card_mac: str = DEFAULT_MAC
    command_port: int = 4096
    data_port: int = 4098

    def __post_init__(self) -> None:
        host = self._parse_address(self.host_address)
        card = self._parse_address(self.card_address)
        if host == card:
            raise self._make_error(f"host and card both have the address {card}")
        if int(host) >> 8 != int(card) >> 8:
            raise self._make_error(f"host {host} and card {card} are in different /24 subnets")
        for address in (host, card):
            if address.is_multicast or int(address) & 0xFF in (0, 0xFF):
                raise self._make_error(f"{address} is not the address of one machine")
        try:
            mac = self._parse_mac()
        except ValueError:
            raise self._make_error(
                f"{self.card_mac!r} is not a MAC address such as {DEFAULT_MAC}", _MAC_REMEDY
            ) from None
        if len(mac) != 6 or mac[0] & 1 or not any(mac):
            raise self._make_error(f"{self.card_mac} is not the MAC address of one machine", _MAC_REMEDY)
        for port in (self.command_port, self.data_port):
            if not 1024 < port <= 0xFFFF:
                raise self._make_error(f"port {port} is outside 1025..65535")
        if self.command_port == self.data_port:
            raise self._make_error(f"commands and data both use port {self.data_port}")

    @staticmethod
    def of_board(board: Board, card_mac: str = DEFAULT_MAC) -> EepromSettings:
        """Return the settings for a board of the rig file. Cards on one network need different MAC addresses."""
        return EepromSettings(board.host_address, board.card_address, card_mac, board.command_port, board.data_port)

    @property
    def confirmation(self) -> str:
        """The text that a user must type to confirm the writing: the card's new address."""
        return self.card_address

    def encode(self) -> bytes:
        """Return the 18 bytes of the command: host, card and MAC address with reversed bytes, and the ports."""
        parts = (
            self._parse_address(self.host_address).packed,
            self._parse_address(self.card_address).packed,
            self._parse_mac(),
        )
        return b"".join(part[::-1] for part in parts) + _PORTS.pack(self.command_port, self.data_port)

    def text(self) -> str:
        """Describe the settings in a sentence."""
        return (
            f"card {self.card_address} ({self.card_mac}) answers to {self.host_address}:{self.command_port} and sends"
            f" data to port {self.data_port} after it is next switched on"
        )

    def _parse_mac(self) -> bytes:
        """Return the bytes of the MAC address. Raises ValueError if it is not hexadecimal."""
        return bytes.fromhex(self.card_mac.replace(":", "").replace("-", ""))

    def _parse_address(self, text: str) -> ipaddress.IPv4Address:
        try:
            return ipaddress.IPv4Address(text)
        except ValueError:
            raise self._make_error(f"{text!r} is not an IPv4 address") from None

    @staticmethod
    def _make_error(what: str, remedy: str = "correct the board in instrument.toml") -> ConfigError:
        cause = "a card with these settings could not be reached"
        return ConfigError(f"EEPROM settings refused: {what}", cause, remedy, code=ErrorCode.VALUE_INVALID)


def program_eeprom(card: CardClient, settings: EepromSettings, confirmed: str) -> None:
    """Write the settings to the EEPROM of a card.

    Parameters
    ----------
    card
        Client of the card at its present address and ports.
    settings
        Settings after the next power-up.
    confirmed
        Must be equal to `settings.confirmation`, as typed by the user.

    Raises
    ------
    ConfigError
        if the confirmation differs; nothing was sent.
    DeviceError
        if the card is silent, refuses, or reports an EEPROM failure.
    """
    if confirmed != settings.confirmation:
        raise ConfigError(
            f"EEPROM not written: confirmed with {confirmed!r}, not {settings.confirmation!r}",
            settings.text(),
            f"repeat the card's new address, {settings.confirmation}, to write it",
            code=ErrorCode.VALUE_INVALID,
        )
    card.check_alive()
    status = card.write_eeprom(settings.encode())
    if Status.EEPROM_FAILURE in status:
        raise DeviceError(
            f"card at {card.board.card_address} reports an EEPROM failure after {Code.CONFIGURE_EEPROM.name}",
            "the EEPROM could not be written",
            "write it again before switching the card off; its addresses may be damaged",
            code=ErrorCode.REFUSED_BY_PEER,
        )


HOPS = ("host", "route", "link", "card", "receiver", "buffer", "radar")
"""The host's address and ports, the interface, its cable, the card; then the receiver process, its buffer, data."""
# Remedy in the note on a radar whose data was not recorded.
PULSES_REMEDY = "`polysight doctor`: it sends pulses with the stage at rest, and reports each one"
# Names in `HOPS` of the hops before a silent card that may be the cause.
_FAULTY_HOP = {Hop.ROUTE: "route", Hop.LINK: "link"}
# Time between two queries for data of a radar (chosen).
_POLL_S = 0.05


@dataclass
class CardSurvey:
    """Survey result of one board's capture card; `version` is that of its FPGA, "" if the card did not reply.

    Each finding in `hops` is about the hop in `where` (one of `HOPS`); a `note` says that the hop was not checked.
    """

    board: Board
    version: str = ""
    hops: list[Finding] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """True if no hop has an error."""
        return all(hop.level != "error" for hop in self.hops)

    @property
    def failed_hop(self) -> str:
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
    """Check a board's card hop by hop; hops that are not checked become notes without text.

    These are all checks after the first that fails, and those after the card of a board that is not recorded.
    """
    survey = CardSurvey(board)
    findings = survey.hops
    try:
        with CardClient(board, instrument.limits.command_timeout_s) as card:
            findings.append(_ok("host", f"{board.host_address}:{board.command_port} is free to listen at"))
            findings += _check_way(survey, card)
            if survey.ok and board.record:
                findings += _check_reception(card, instrument, core, listen_s)
    except DeviceError as e:
        findings.append(Finding.of_error(e, where="host"))
    hops = {hop.where for hop in findings}
    findings += [Finding("note", "", where=hop) for hop in HOPS if hop not in hops]
    return survey


def _ok(hop: str, what: str) -> Finding:
    """Return the finding that a hop works."""
    return Finding("ok", what, where=hop)


def _check_way(survey: CardSurvey, card: CardClient) -> Iterator[Finding]:
    """Check route, link and card. If the card replies, the hops before it are ok."""
    address = card.board.card_address
    error = None
    try:
        card.check_alive()
        survey.version = str(card.read_version())
        card.require_alone()
    except DeviceError as e:
        error = e
    faulty = ""
    if error is not None:
        faulty = "card"
        if not survey.version:
            faulty = _FAULTY_HOP.get(find_silent_hop(address), "card")
    if address.startswith("127."):
        interface = "loopback"
    else:
        interface = route_interface(address) or "unknown interface"
    for hop, text in (("route", interface), ("link", interface), ("card", f"replies, FPGA {survey.version}")):
        if error is not None and hop == faulty:
            yield Finding.of_error(error, where=hop)
            return
        yield _ok(hop, text)


def _check_reception(card: CardClient, instrument: Instrument, core: Core | None, listen_s: float) -> Iterator[Finding]:
    """Check the receiver process as a scan starts it, its buffer, and the radar's data."""
    board = card.board
    requested = instrument.card.receive_buffer_bytes
    try:
        receiver = ReceiverProcess(board, requested, core)
    except DeviceError as e:
        yield Finding.of_error(e, where="receiver")
        return
    with receiver:
        if receiver.warnings:
            refused = "; ".join(warning.removeprefix(f"{board.name}: ") for warning in receiver.warnings)
            yield Finding("warning", receiver.scheduling, refused, PRIORITY_REMEDY, "receiver")
        else:
            yield _ok("receiver", receiver.scheduling)
        burst_bytes = instrument.burst.pulses * instrument.frame_bytes
        try:
            warning = check_receive_buffer(board.name, receiver.granted_bytes, requested, burst_bytes)
        except DeviceError as e:
            yield Finding.of_error(e, where="buffer")
            return
        if warning:
            yield Finding("warning", warning.removeprefix(f"{board.name}: "), where="buffer")
        else:
            yield _ok("buffer", f"{receiver.granted_bytes} bytes granted, {requested} requested")
        if listen_s > 0:
            yield _listen(card, receiver, instrument, listen_s)
        else:
            yield Finding("note", "it sends data only when it is triggered", do=PULSES_REMEDY, where="radar")


def _listen(card: CardClient, receiver: ReceiverProcess, instrument: Instrument, listen_s: float) -> Finding:
    """Record into a temporary file for `listen_s`, or until a row's bytes have arrived; return the finding on them."""
    try:
        with tempfile.TemporaryDirectory(prefix="polysight-card-") as folder:
            card.record_stop()
            # The end of the last record is not known. The reset makes the counters begin again at zero.
            card.reset_fpga()
            card.configure(instrument.card)
            listened = Path(folder) / "listened.bin"
            # The receiver needs a row and a take: 0 and 1.
            receiver.begin_row(0, 1, instrument.row_bytes, instrument.frame_bytes, listened, after_reset=True)
            card.record_start()
            deadline = time.monotonic() + listen_s
            # Do not wait for a complete row: a radar that does not stop sends more, and such a row never completes.
            while time.monotonic() < deadline and receiver.report().received < instrument.row_bytes:
                card.take_status()
                time.sleep(_POLL_S)
            card.record_stop()
            row_capture = receiver.end_row(card.take_status())
    except DeviceError as e:
        return Finding.of_error(e, where="radar")
    if row_capture.counts.placed == 0:
        return Finding.of_error(explain_silent_radar(card.board, row_capture), where="radar")
    return _report_stream(row_capture)


def _report_stream(row_capture: RowCapture) -> Finding:
    """Report a radar's data. Only gaps between packets count as lost: the record is stopped before its end."""
    text = f"{row_capture.counts.placed} packets, {row_capture.bytes} bytes came"
    if row_capture.lost_before_packets:
        return Finding(
            "warning",
            text,
            f"the card reports {row_capture.lost_before_packets.name}: it dropped data",
            "a shorter card.packet_delay_us in instrument.toml lets the card send faster",
            "radar",
        )
    if row_capture.losses.gap_bytes or row_capture.strangers:
        return Finding(
            "warning",
            text,
            f"{row_capture.losses.gap_bytes} bytes are lost in {row_capture.losses.gaps} gaps,"
            f" {row_capture.kernel_drops} packets dropped by this machine, {row_capture.strangers} came from elsewhere",
            "check cable and switch, the receive buffer above, and that no two cards have the same ports",
            "radar",
        )
    return _ok("radar", text)
