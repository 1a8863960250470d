"""Construction of every ZeroMQ socket, in one place: time-outs, limits, and CURVE on anything that is not loopback."""

from __future__ import annotations

import ipaddress
from pathlib import Path
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from polysight.shared.errors import ConfigError, DeviceError
from polysight.shared.messages import MAX_COMMAND_BYTES

Socket = zmq.Socket[bytes]
HOST_KEYS = ("pi.key", "host.key_secret")
"""What the host needs of the keys that were made on the Pi. `pi.key_secret` never leaves the Pi."""
PI_KEYS = ("pi.key_secret",)
EVENT_TOPIC = b"event"
MAX_SUBSCRIPTION_BYTES = 1024
SEND_LIMIT_MS = 200
HANDSHAKE_LIMIT_MS = 5000  # who connects and says nothing holds a descriptor for so long


def host_of(address: str) -> str:
    """The host part of `tcp://host:port`. Raises ConfigError for another form."""
    scheme, _, rest = address.partition("://")
    host, _, port = rest.rpartition(":")
    if scheme != "tcp" or not host or not (port == "*" or port.isdigit()):
        raise ConfigError(
            f"address {address!r} is not of the form tcp://host:port", "a typing error", "correct it in instrument.toml"
        )
    return host.strip("[]")


def is_loopback(address: str) -> bool:
    """Whether an address never leaves this machine."""
    host = host_of(address)
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _secure(socket: Socket, address: str, key_dir: Path, server: bool) -> None:
    """CURVE on a socket whose address is not loopback.

    `key_dir` holds PI_KEYS or HOST_KEYS as zmq.auth writes them. Which clients' keys the server takes is for its
    :func:`authenticator`; an address that is not loopback is refused without keys.
    """
    if is_loopback(address):
        return
    needed = PI_KEYS if server else HOST_KEYS
    secret_file = key_dir / needed[-1]
    try:
        from zmq.auth import load_certificate

        public, secret = load_certificate(secret_file)
        if secret is None:
            raise OSError(f"{secret_file} holds no secret key")
        socket.curve_publickey, socket.curve_secretkey = public, secret
        if server:
            socket.curve_server = True
        else:
            socket.curve_serverkey = load_certificate(key_dir / HOST_KEYS[0])[0]
    except (OSError, ValueError) as e:
        raise ConfigError(
            f"{address} is not loopback and there are no usable CURVE keys: {e}",
            f"{key_dir} lacks {' or '.join(needed)}, or they belong to another user",
            "make keys with `polysight-pi keys`, or use a loopback address"
            if server
            else f"copy the Pi's {' and '.join(HOST_KEYS)} here (docs/how-to/install.md); pi.key_dir is {key_dir}",
        ) from None


def _make(
    context: zmq.Context[Any],
    kind: int,
    address: str,
    key_dir: Path,
    bind: bool,
    options: dict[int, int | bytes] | None = None,
) -> Socket:
    host_of(address)
    socket: Socket = context.socket(kind)
    for option, value in {zmq.LINGER: 0, **(options or {})}.items():
        socket.setsockopt(option, value)
    try:
        _secure(socket, address, key_dir, server=bind)
        if bind:
            socket.bind(address)
        else:
            socket.connect(address)
    except zmq.ZMQError as e:
        socket.close()
        raise DeviceError(
            f"{address}: {e.strerror}" if hasattr(e, "strerror") else f"{address}: {e}",
            "another program holds this port"
            if e.errno == zmq.EADDRINUSE
            else "the address does not exist on this machine",
            "stop the other program (ss -ltnp shows it), or change the address in instrument.toml",
        ) from None
    except ConfigError:
        socket.close()
        raise
    return socket


def publisher(context: zmq.Context[Any], address: str, key_dir: Path) -> Socket:
    """PUB socket of the Pi, bound."""
    options: dict[int, int | bytes] = {zmq.SNDHWM: 100_000, zmq.MAXMSGSIZE: MAX_SUBSCRIPTION_BYTES}
    options |= {zmq.HANDSHAKE_IVL: HANDSHAKE_LIMIT_MS}
    return _make(context, zmq.PUB, address, key_dir, bind=True, options=options)


def subscriber(context: zmq.Context[Any], address: str, key_dir: Path) -> Socket:
    """SUB socket of the host, connected, subscribed to all events, with a deep queue."""
    return _make(
        context, zmq.SUB, address, key_dir, bind=False, options={zmq.RCVHWM: 100_000, zmq.SUBSCRIBE: EVENT_TOPIC}
    )


def observer(context: zmq.Context[Any], address: str, key_dir: Path) -> Socket:
    """SUB socket of somebody who only looks on: a short queue, and the Pi forgets it when it falls silent.

    The Pi queues for each subscriber; ZeroMQ's own heartbeat ends the connection of one that is stopped or cut off.
    """
    heartbeat: dict[int, int | bytes] = {zmq.HEARTBEAT_IVL: 1000, zmq.HEARTBEAT_TTL: 5000}
    options = {zmq.RCVHWM: 1000, zmq.SUBSCRIBE: EVENT_TOPIC, **heartbeat}
    return _make(context, zmq.SUB, address, key_dir, bind=False, options=options)


def replier(context: zmq.Context[Any], address: str, key_dir: Path) -> Socket:
    """ROUTER socket of the Pi, bound: it answers REQ sockets. Who sends a longer message than a command is cut off."""
    options: dict[int, int | bytes] = {zmq.MAXMSGSIZE: MAX_COMMAND_BYTES, zmq.ROUTER_MANDATORY: 1}
    options |= {zmq.HANDSHAKE_IVL: HANDSHAKE_LIMIT_MS}
    return _make(context, zmq.ROUTER, address, key_dir, bind=True, options=options)


def authenticator(context: zmq.Context[Any]) -> Socket:
    """REP socket that ZeroMQ asks about each client that connects by CURVE to a socket of this context (RFC 27)."""
    socket: Socket = context.socket(zmq.REP)
    socket.bind("inproc://zeromq.zap.01")
    return socket


class Refusals:
    """Tells a server that refuses this client from one that is silent.

    Parameters
    ----------
    socket
        The client's, before or after it has connected.
    """

    def __init__(self, socket: Socket) -> None:
        self._socket = socket
        self._monitor = socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)
        self._refused = False

    def seen(self) -> bool:
        """Whether the server has refused this client's key, or this client the server's, until now."""
        while self._monitor.poll(0):
            recv_monitor_message(self._monitor)
            self._refused = True
        return self._refused

    def close(self) -> None:
        """Let go of the monitor. Before the socket is closed."""
        self._socket.disable_monitor()
        self._monitor.close()


def requester(context: zmq.Context[Any], address: str, key_dir: Path) -> Socket:
    """REQ socket of the host, connected. Relaxed, so that a lost reply does not wedge it.

    A socket that the server refused has nobody to send to: its `send` raises zmq.Again, soon.
    """
    options: dict[int, int | bytes] = {zmq.REQ_RELAXED: 1, zmq.REQ_CORRELATE: 1, zmq.SNDTIMEO: SEND_LIMIT_MS}
    return _make(context, zmq.REQ, address, key_dir, bind=False, options=options)
