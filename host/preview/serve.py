"""`polysight preview`: one server for one scan folder, until it is stopped."""

from __future__ import annotations

import contextlib
import ipaddress
import logging
import os
import secrets
import socket
import sys
from pathlib import Path

import uvicorn
from starlette.applications import Starlette

from polysight.host.preview.server import make_app
from polysight.host.preview.watch import Watch
from polysight.shared.errors import DeviceError

NICE = 10
_END_S = 1
_CONNECTIONS = 64


def preview(folder: Path, host: str, port: int, control: bool) -> int:
    """Serve the live view of a scan folder until Ctrl-C; returns the exit status.

    Raises
    ------
    DeviceError
        when the address cannot be bound.
    """
    listener = _bind(host, port)
    _step_back()
    token = secrets.token_urlsafe(18) if control else ""
    loopback = is_loopback(host)
    watch = Watch(folder, control)
    watch.start()
    try:
        sys.stderr.write(_welcome(folder, listener, token, loopback))
        sys.stderr.flush()
        server(make_app(watch, token, loopback)).run(sockets=[listener])
    finally:
        watch.close()
        listener.close()
    return 0


def server(app: Starlette) -> uvicorn.Server:
    """A quiet server of few connections, which ends within a second of being told to."""
    logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=False,
        lifespan="off",
        ws="none",
        limit_concurrency=_CONNECTIONS,
        timeout_graceful_shutdown=_END_S,
    )
    made = uvicorn.Server(config)
    app.state.ending = lambda: made.should_exit
    return made


def is_loopback(host: str) -> bool:
    """Whether an address to bind reaches this machine only."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _bind(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(_CONNECTIONS)
    except OSError as e:
        listener.close()
        raise DeviceError(
            f"{host}:{port} cannot be served: {e.strerror}",
            "another program holds this port, the address is not this machine's, or the port is below 1024",
            "give another --port; `ss -ltnp` shows who holds it",
        ) from None
    return listener


def _step_back() -> None:
    """Everything else goes first: the processor to capture and scan, and memory too, should it run out."""
    with contextlib.suppress(OSError):
        os.nice(NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")


def _welcome(folder: Path, listener: socket.socket, token: str, loopback: bool) -> str:
    host, port = str(listener.getsockname()[0]), listener.getsockname()[1]
    shown = {"0.0.0.0": socket.gethostname(), "::": socket.gethostname(), "::1": "localhost"}.get(host, host)
    address = f"http://[{shown}]:{port}/" if ":" in shown else f"http://{shown}:{port}/"
    lines = [f"live view of {folder}: {address}{f'#token={token}' if token else ''}"]
    if token:
        lines.append("whoever has this address with its token can pause and stop the scan")
    else:
        lines.append("read-only; --control adds buttons to pause and stop the scan")
    if not loopback:
        lines.append("anyone who reaches this machine can look on; nothing is encrypted")
    return "\n".join(lines) + "\nCtrl-C ends the view; the scan goes on\n"
