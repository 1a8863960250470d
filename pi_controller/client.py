"""A small client of the running service, for `home` and `events`. The host has its own."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import zmq

from polysight.pi_controller.bringup import MOTION_LIMIT_S
from polysight.pi_controller.finding import AS_THE_SERVICE
from polysight.pi_controller.journal import TAKE_OVER_KEY
from polysight.shared import messages as m
from polysight.shared.config import Instrument
from polysight.shared.errors import DeviceError, PolysightError, os_error
from polysight.shared.sockets import Socket, requester, subscriber

HELLO_LIMIT_MS = 500


def _ask(socket: Socket, command: m.AnyCommand, limit_ms: float) -> m.AnyReply | None:
    try:
        socket.send(m.pack(command))
    except zmq.Again:  # nobody to send to
        return None
    return m.unpack_reply(socket.recv()) if socket.poll(round(limit_ms)) else None


def _silent(address: str) -> DeviceError:
    return DeviceError(f"nobody answers at {address}", "polysight-pi run is not running here", "start it")


def refuse_beside_service(instrument: Instrument) -> None:
    """Refuse what needs lines, stage and ports for itself. Raises DeviceError when the service of this rig runs."""
    context: zmq.Context[Socket] = zmq.Context()
    try:
        socket = requester(context, instrument.pi.command_address, Path(instrument.pi.key_dir))
        hello = _ask(socket, m.Hello(), HELLO_LIMIT_MS)
    except PolysightError:
        return  # no keys, or no such address: whatever runs, it does not serve there
    finally:
        context.destroy(linger=0)
    if hello is not None:
        raise DeviceError(
            f"polysight-pi run serves at {instrument.pi.command_address}",
            "it holds the lines, the stage and the ports",
            "`polysight doctor` on the host tries them through it; or `sudo systemctl stop polysight-pi`, this, and"
            " `sudo systemctl start polysight-pi`",
        )


def home_by_service(instrument: Instrument) -> m.StatusReply | None:
    """Home through the running service, and wait for it. None when no service runs.

    Raises
    ------
    DeviceError
        when the service refuses, or homing fails.
    """
    context: zmq.Context[Socket] = zmq.Context()
    try:
        socket = requester(context, instrument.pi.command_address, Path(instrument.pi.key_dir))
        if _ask(socket, m.Hello(), HELLO_LIMIT_MS) is None:
            return None
        reply = _ask(socket, m.Home(), instrument.limits.command_timeout_s * 1e3)
        if isinstance(reply, m.Refused):
            raise DeviceError(f"homing was refused: {reply.what}", reply.why, reply.remedy)
        deadline = time.monotonic() + MOTION_LIMIT_S
        while time.monotonic() < deadline:
            status = _ask(socket, m.Status(), instrument.limits.command_timeout_s * 1e3)
            if not isinstance(status, m.StatusReply):
                raise _silent(instrument.pi.command_address)
            if status.state == "fault":
                raise DeviceError(f"homing failed: {status.reason}", "see the fault", "remove its cause, home again")
            if status.state != "homing":
                return status
            time.sleep(0.1)  # between questions
        raise DeviceError("homing has not ended", "the motors stall", "look at the stage")
    finally:
        context.destroy(linger=0)


def take_over(instrument: Instrument, what: str, journal: Path) -> str:
    """Hold, resume, abort or end the run that is begun, whoever began it; returns the state after it.

    Raises
    ------
    DeviceError
        when the service refuses or is silent, or the key of the person at the Pi cannot be read.
    """
    try:
        owner = (journal / TAKE_OVER_KEY).read_text(encoding="ascii").strip()
    except OSError as e:
        raise os_error(e, "polysight-pi run is not running here, or you are not its user", AS_THE_SERVICE) from None
    context: zmq.Context[Socket] = zmq.Context()
    limit_ms = instrument.limits.command_timeout_s * 1e3
    try:
        socket = requester(context, instrument.pi.command_address, Path(instrument.pi.key_dir))
        status = _ask(socket, m.Status(), limit_ms)
        if not isinstance(status, m.StatusReply):
            raise _silent(instrument.pi.command_address)
        reason = "a person at the Pi took over"
        commands: dict[str, m.AnyCommand] = {
            "hold": m.Hold(owner=owner), "resume": m.Resume(owner=owner), "abort": m.Abort(reason=reason, owner=owner),
        }  # fmt: skip
        if what == "end":
            commands["end"] = m.EndRun(scan_id=status.scan_id, exit_status="abort", reason=reason, owner=owner)
        reply = _ask(socket, commands[what], limit_ms)
    finally:
        context.destroy(linger=0)
    if isinstance(reply, m.Accepted):
        return reply.state
    if isinstance(reply, m.Refused):
        raise DeviceError(f"{what} was refused: {reply.what}", reply.why, reply.remedy)
    raise _silent(instrument.pi.command_address)


def follow_events(instrument: Instrument, limit_s: float) -> Iterator[Any]:
    """Live events as plain objects. Raises DeviceError when none comes for `limit_s`."""
    context: zmq.Context[Socket] = zmq.Context()
    try:
        socket = subscriber(context, instrument.pi.event_address, Path(instrument.pi.key_dir))
        while socket.poll(round(limit_s * 1e3)):
            yield msgspec.to_builtins(m.unpack_event(socket.recv_multipart()[-1]))
        raise _silent(instrument.pi.event_address)
    finally:
        context.destroy(linger=0)


def replay_events(instrument: Instrument, scan_id: str, from_seq: int) -> Iterator[Any]:
    """Journalled events of a scan as plain objects. Raises DeviceError when nobody answers, or there are none."""
    context: zmq.Context[Socket] = zmq.Context()
    try:
        socket = requester(context, instrument.pi.command_address, Path(instrument.pi.key_dir))
        while True:
            command = m.Replay(scan_id=scan_id, from_seq=from_seq)
            reply = _ask(socket, command, instrument.limits.command_timeout_s * 1e3)
            if reply is None:
                raise _silent(instrument.pi.command_address)
            if not isinstance(reply, m.ReplayReply):
                raise DeviceError(f"replay was refused: {getattr(reply, 'what', reply)}", "", "see the Pi's log")
            if reply.last_seq == 0:
                raise DeviceError(
                    f"the Pi has no journal of scan {scan_id!r}", "another name", "see its journal folder"
                )
            if not reply.events:
                return
            for event in reply.events:
                yield msgspec.to_builtins(event)
            from_seq = reply.events[-1].seq + 1  # not one by one: a lost journal leaves a jump
    finally:
        context.destroy(linger=0)
