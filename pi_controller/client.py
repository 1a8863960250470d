"""A small client of the running service, for `home`, `take-over` and `events`. The host has its own."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import zmq

from polysight.pi_controller import AS_THE_SERVICE
from polysight.pi_controller.service import TAKE_OVER_KEY
from polysight.pi_controller.stage import MOTION_LIMIT_S
from polysight.shared import messages as m
from polysight.shared.config import Instrument
from polysight.shared.errors import DeviceError, os_error
from polysight.shared.sockets import Socket, requester, subscriber

CONNECT_LIMIT_S = 2.0
Ask = Callable[..., Any]


def _silent(address: str) -> DeviceError:
    return DeviceError(f"nobody answers at {address}", "polysight-pi run is not running here", "start it")


@contextmanager
def _service(instrument: Instrument) -> Iterator[Ask]:
    """A function that asks the service and returns its reply. It raises DeviceError for silence and for a refusal."""
    context: zmq.Context[Socket] = zmq.Context()
    address = instrument.pi.command_address
    try:
        client = requester(context, address, Path(instrument.pi.key_dir))

        def ask(command: m.AnyCommand) -> m.AnyReply:
            try:
                client.send(m.pack(command))
            except zmq.Again:  # nobody to send to
                raise _silent(address) from None
            if not client.poll(round(instrument.limits.command_timeout_s * 1e3)):
                raise _silent(address)
            reply = m.unpack_reply(client.recv())
            if isinstance(reply, m.Refused):
                raise DeviceError(f"{type(command).__name__} was refused: {reply.what}", reply.why, reply.remedy)
            return reply

        yield ask
    finally:
        context.destroy(linger=0)


def _listens(address: str) -> bool:
    """Whether a program listens there, whatever it is: known at once, also of a machine that is slow to answer."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=CONNECT_LIMIT_S).close()
    except (OSError, ValueError):
        return False
    return True


def refuse_beside_service(instrument: Instrument) -> None:
    """Refuse what needs lines, stage and ports for itself. Raises DeviceError when the service of this rig runs."""
    if _listens(instrument.pi.command_address):
        raise DeviceError(
            f"polysight-pi run serves at {instrument.pi.command_address}",
            "it holds the lines, the stage and the ports",
            "`polysight doctor` on the host tries them through it; or `sudo systemctl stop polysight-pi`, this, and"
            " `sudo systemctl start polysight-pi`",
        )


def home_by_service(instrument: Instrument) -> m.StatusReply | None:
    """Home through the running service, and wait for it. None when no service runs.

    Raises DeviceError when the service refuses, or homing fails.
    """
    if not _listens(instrument.pi.command_address):
        return None
    with _service(instrument) as ask:
        ask(m.Home())
        deadline = time.monotonic() + MOTION_LIMIT_S
        while time.monotonic() < deadline:
            status = ask(m.Status())
            if status.state == "fault":
                raise DeviceError(f"homing failed: {status.reason}", "see the fault", "remove its cause, home again")
            if status.state != "homing":
                return status
            time.sleep(0.1)  # between questions
        raise DeviceError("homing has not ended", "the motors stall", "look at the stage")


def take_over(instrument: Instrument, what: str) -> str:
    """Hold, resume, abort or end the run that is begun, whoever began it; returns the state after it.

    Raises DeviceError when the service refuses or is silent, or the key of the person at the Pi cannot be read.
    """
    try:
        owner = (Path(instrument.pi.journal_dir) / TAKE_OVER_KEY).read_text(encoding="ascii").strip()
    except OSError as e:
        raise os_error(e, "polysight-pi run is not running here, or you are not its user", AS_THE_SERVICE) from None
    reason = "a person at the Pi took over"
    with _service(instrument) as ask:
        if what == "end":
            scan_id = ask(m.Status()).scan_id
            return ask(m.EndRun(scan_id=scan_id, exit_status="abort", reason=reason, owner=owner)).state
        if what == "abort":
            return ask(m.Abort(reason=reason, owner=owner)).state
        return ask({"hold": m.Hold, "resume": m.Resume}[what](owner=owner)).state


def follow_events(instrument: Instrument, limit_s: float) -> Iterator[Any]:
    """Live events as plain objects. Raises DeviceError when none comes for `limit_s`."""
    context: zmq.Context[Socket] = zmq.Context()
    try:
        listener = subscriber(context, instrument.pi.event_address, Path(instrument.pi.key_dir))
        while listener.poll(round(limit_s * 1e3)):
            yield msgspec.to_builtins(m.unpack_event(listener.recv_multipart()[-1]))
        raise _silent(instrument.pi.event_address)
    finally:
        context.destroy(linger=0)


def replay_events(instrument: Instrument, scan_id: str, from_seq: int) -> Iterator[Any]:
    """Journalled events of a scan as plain objects. Raises DeviceError when nobody answers, or there are none."""
    with _service(instrument) as ask:
        while True:
            reply = ask(m.Replay(scan_id=scan_id, from_seq=from_seq))
            if reply.last_seq == 0:
                raise DeviceError(
                    f"the Pi has no journal of scan {scan_id!r}", "another name", "see its journal folder"
                )
            if not reply.events:
                return
            yield from map(msgspec.to_builtins, reply.events)
            from_seq = reply.events[-1].seq + 1  # not one by one: a lost journal leaves a jump
