"""Client of the running service, for the commands `home`, `take-over` and `events`. The host has a client of its own.

Commands that use the hardware themselves are refused while the service runs (`refuse_while_service_runs`).
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import zmq

from polysight_pi.service import TAKE_OVER_KEY
from polysight_pi.stage import MOTION_TIMEOUT_S
from polysight_shared import messages as m
from polysight_shared.config import Instrument
from polysight_shared.errors import DeviceError, ErrorCode
from polysight_shared.sockets import Socket, create_requester, create_subscriber

# A program that does not accept a connection in this time counts as not running (chosen).
CONNECT_TIMEOUT_S = 2.0
# Sends a command and returns the service's reply.
Ask = Callable[..., Any]


def _no_answer_error(address: str) -> DeviceError:
    """Return the error for a service that does not answer at this address."""
    cause = "the service `polysight-pi run` is not running on this Pi, or it hangs"
    remedy = "start it: `sudo systemctl restart polysight-pi`"
    return DeviceError(f"no answer from {address}", cause, remedy, code=ErrorCode.NO_ANSWER)


@contextmanager
def _open_service(instrument: Instrument) -> Iterator[Ask]:
    """Connect and give a function that sends a command and returns its reply.

    The function raises DeviceError if the service refuses or does not reply in time.
    """
    context: zmq.Context[Socket] = zmq.Context()
    address = instrument.pi.command_address
    try:
        client = create_requester(context, address, Path(instrument.pi.key_dir))

        def ask(command: m.AnyCommand) -> m.AnyReply:
            """Send a command and return the reply. Raises DeviceError for a refusal, or without an answer."""
            try:
                client.send(m.pack(command))
            # There is no connection to the service.
            except zmq.Again:
                raise _no_answer_error(address) from None
            if not client.poll(round(instrument.limits.command_timeout_s * 1e3)):
                raise _no_answer_error(address)
            reply = m.unpack_reply(client.recv())
            if isinstance(reply, m.Refused):
                summary = f"{type(command).__name__} was refused: {reply.problem}"
                raise DeviceError(summary, reply.cause, reply.remedy, code=ErrorCode.REFUSED_BY_PEER)
            return reply

        yield ask
    finally:
        context.destroy(linger=0)


def _is_listening(address: str) -> bool:
    """True if any program listens there. Needs no answer, which a busy machine would give late."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_TIMEOUT_S).close()
    except (OSError, ValueError):
        return False
    return True


def refuse_while_service_runs(instrument: Instrument) -> None:
    """Raise DeviceError if the service of this rig runs: it holds the trigger's GPIO lines, stage and ports."""
    if _is_listening(instrument.pi.command_address):
        raise DeviceError(
            f"polysight-pi run serves at {instrument.pi.command_address}",
            "it uses the lines, the stage and the ports",
            "use `polysight doctor` on the host, or `sudo systemctl stop polysight-pi`, this command, and"
            " `sudo systemctl start polysight-pi`",
            code=ErrorCode.BUSY,
        )


def home_by_service(instrument: Instrument) -> m.StatusReply | None:
    """Home through the running service and wait for the end; return None if no service runs.

    Raises DeviceError if the service refuses, for example because the host of a run is alive, if it does not answer, or
    if homing fails.
    """
    if not _is_listening(instrument.pi.command_address):
        return None
    with _open_service(instrument) as ask:
        ask(m.Home())
        deadline = time.monotonic() + MOTION_TIMEOUT_S
        while time.monotonic() < deadline:
            status = ask(m.Status())
            if status.state == "fault":
                raise DeviceError(
                    f"homing failed: {status.reason}",
                    "the text above shows which fault stopped it",
                    "remove the cause, then home again",
                )
            if status.state != "homing":
                return status
            time.sleep(0.1)
        raise DeviceError(
            f"homing did not end within {MOTION_TIMEOUT_S:.0f} s",
            "the motors stall, or a limit switch does not close",
            "look at the stage, then home again",
        )


def take_over(instrument: Instrument, action: str) -> str:
    """Hold, resume, abort or end the active run of any client; return the state after it.

    Raises DeviceError if the service refuses, does not answer or never ran here, or if there is no run to end; OSError
    if the take-over key cannot be read.
    """
    # The service takes this key in place of the secret of the run's owner.
    key_file = Path(instrument.pi.journal_dir) / TAKE_OVER_KEY
    try:
        owner = key_file.read_text(encoding="ascii").strip()
    except FileNotFoundError:
        raise DeviceError(
            f"{key_file}: no such file",
            "`polysight-pi run` has not run on this Pi, or its journals are in another folder",
            "start it: `sudo systemctl restart polysight-pi`; or name the folder of its journals with --journal",
            code=ErrorCode.FILE_MISSING,
        ) from None
    reason = "a person at the Pi took over the run"
    with _open_service(instrument) as ask:
        if action == "end":
            scan_id = ask(m.Status()).scan_id
            if not scan_id:
                remedy = "there is nothing to end"
                raise DeviceError(
                    "no run is active", "it has ended, or none was begun", remedy, code=ErrorCode.REFUSED_BY_PEER
                )
            return ask(m.EndRun(scan_id=scan_id, exit_status="abort", reason=reason, owner=owner)).state
        if action == "abort":
            return ask(m.Abort(reason=reason, owner=owner)).state
        if action == "hold":
            return ask(m.Hold(owner=owner)).state
        return ask(m.Resume(owner=owner)).state


def follow_events(instrument: Instrument, timeout_s: float) -> Iterator[Any]:
    """Yield live events as dicts, for JSON. Raises DeviceError after `timeout_s` without one."""
    context: zmq.Context[Socket] = zmq.Context()
    try:
        listener = create_subscriber(context, instrument.pi.event_address, Path(instrument.pi.key_dir))
        while listener.poll(round(timeout_s * 1e3)):
            # The last part of a message is the event.
            yield msgspec.to_builtins(m.unpack_event(listener.recv_multipart()[-1]))
        raise _no_answer_error(instrument.pi.event_address)
    finally:
        context.destroy(linger=0)


def replay_events(instrument: Instrument, scan_id: str, from_seq: int) -> Iterator[Any]:
    """Yield a scan's journalled events from number `from_seq` on as dicts, for JSON.

    Raises DeviceError without an answer or a journal.
    """
    missing = DeviceError(
        f"the Pi has no journal of scan {scan_id!r}",
        "the scan has another name, or another Pi ran it",
        f"list the journals in {instrument.pi.journal_dir}",
        code=ErrorCode.FILE_MISSING,
    )
    try:
        msgspec.convert(scan_id, m.ScanId)
    except msgspec.ValidationError:
        # No scan can have this name.
        raise missing from None
    with _open_service(instrument) as ask:
        while True:
            reply = ask(m.Replay(scan_id=scan_id, from_seq=from_seq))
            if reply.last_seq == 0:
                raise missing
            if not reply.events:
                return
            yield from map(msgspec.to_builtins, reply.events)
            # Do not count the events instead: if a journal file was lost during a scan, numbers are missing.
            from_seq = reply.events[-1].seq + 1
