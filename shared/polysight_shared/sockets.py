"""Create the ZeroMQ sockets of host and Pi, with timeouts, limits, and CURVE keys on addresses other than loopback."""

from __future__ import annotations

import errno
import ipaddress
import re
from pathlib import Path
from typing import Any

import zmq
from zmq.utils.monitor import recv_monitor_message

from polysight_shared.errors import ConfigError, DeviceError, ErrorCode, quote
from polysight_shared.messages import MAX_COMMAND_BYTES

Socket = zmq.Socket[bytes]
HOST_KEYS = ("pi.key", "host.key_secret")
"""Key files that the host needs, made on the Pi. `pi.key_secret` never leaves the Pi."""
# The Pi's key with its secret part: the only key file that the Pi needs.
PI_SECRET_KEY = "pi.key_secret"
PI_KEYS = (PI_SECRET_KEY,)
# First frame of every event; the second is the packed event.
EVENT_TOPIC = b"event"
# Longest message of a subscriber to the Pi (its topics); after a longer one the Pi closes its connection; chosen.
MAX_SUBSCRIPTION_BYTES = 1024
# A local network takes a command within this time, or there is no connection (chosen).
SEND_TIMEOUT_MS = 200
# A connection without a handshake is closed after this time; chosen.
HANDSHAKE_TIMEOUT_MS = 5000
# Bit masks of ZMQ_AFFINITY: which of a context's I/O threads reads and writes the connections of a socket.
COMMAND_IO_THREAD = 0b01
EVENT_IO_THREAD = 0b10
# Highest number of a TCP port.
MAX_PORT = 65535
_CHANGE_REMEDY = "change the address in instrument.toml"
_NO_ADDRESS_CAUSE = ("the address does not exist on this machine", _CHANGE_REMEDY)
_NO_RIGHTS_CAUSE = ("this user may not use it", f"{_CHANGE_REMEDY}: ports below 1024 need rights")
# Cause and remedy of what bind and connect answer.
_CAUSES = {
    zmq.EADDRINUSE: ("another program uses this port", f"stop it (ss -ltnp shows it), or {_CHANGE_REMEDY}"),
    zmq.EADDRNOTAVAIL: _NO_ADDRESS_CAUSE,
    errno.ENODEV: _NO_ADDRESS_CAUSE,
    errno.EACCES: _NO_RIGHTS_CAUSE,
    errno.EPERM: _NO_RIGHTS_CAUSE,
}


def host_name(address: str) -> str:
    """Return the host of `tcp://host:port` (port `*`: any free one). Raises ConfigError for another form."""
    scheme, _, host_and_port = address.partition("://")
    host, _, port = host_and_port.rpartition(":")
    # Of a larger number libzmq takes the lower 16 bits, and so another port.
    port_is_valid = port == "*" or (re.fullmatch("[0-9]{1,5}", port) and int(port) <= MAX_PORT)
    if scheme != "tcp" or not host or not port_is_valid:
        raise ConfigError(
            f"address {address!r} is not of the form tcp://host:port, with a port of at most {MAX_PORT}",
            "a typing error",
            "correct it in instrument.toml",
            code=ErrorCode.VALUE_INVALID,
        )
    return host.strip("[]")


def is_loopback(address: str) -> bool:
    """Return True if the address is reachable only from this machine."""
    host = host_name(address)
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def advise_keys(key_dir: Path) -> str:
    """Return the advice to make the Pi's keys in this folder, in the place of damaged ones."""
    command = f"polysight-pi keys --dir {quote(key_dir)}"
    if not (key_dir / PI_SECRET_KEY).exists():
        return f"make them: `{command}`"
    return f"make new ones: `{command} --replace`, then copy {' and '.join(HOST_KEYS)} to the host"


def advise_owner(key_dir: Path) -> str:
    """Return the advice to give the keys in this folder, made by root, to the user of the Pi's service."""
    return f"give them to the service's user: `sudo chown -R polysight: {quote(key_dir)}`"


def _secure(socket: Socket, address: str, key_dir: Path, server: bool) -> None:
    """Enable CURVE on a socket whose address is not loopback. Raises ConfigError without usable keys.

    `key_dir` has PI_KEYS or HOST_KEYS in the format of zmq.auth. Which clients the
    server accepts is decided by the program that answers at its `create_authenticator`.
    """
    if is_loopback(address):
        return
    if server:
        files = PI_KEYS
        remedy = f"{advise_keys(key_dir)}, or use a loopback address"
    else:
        files = HOST_KEYS
        remedy = f"copy the Pi's {' and '.join(HOST_KEYS)} here (docs/how-to/install.md); pi.key_dir is {key_dir}"
    # The last of the files is this side's own key, with its secret part.
    secret_file = key_dir / files[-1]
    try:
        from zmq.auth import load_certificate

        public, secret = load_certificate(secret_file)
        if secret is None:
            raise OSError(f"{secret_file} contains no secret key")
        socket.curve_publickey = public
        socket.curve_secretkey = secret
        if server:
            socket.curve_server = True
        else:
            socket.curve_serverkey = load_certificate(key_dir / HOST_KEYS[0])[0]
    # zmq.ZMQError: a key of the wrong length.
    except (OSError, ValueError, zmq.ZMQError) as e:
        if server and isinstance(e, PermissionError):
            remedy = advise_owner(key_dir)
        raise ConfigError(
            f"{address} is not loopback, and no CURVE keys are usable: {e}",
            f"{key_dir} lacks {' or '.join(files)}, they are damaged, or they belong to another user",
            remedy,
            code=ErrorCode.FILE_MISSING,
        ) from None


def _make(
    context: zmq.Context[Any], kind: int, address: str, key_dir: Path, bind: bool, options: dict[int, int | bytes]
) -> Socket:
    """Create a socket of the ZeroMQ type `kind`, set its options and keys, and bind or connect it.

    Raises ConfigError for a wrong address or without usable keys, DeviceError if ZeroMQ cannot bind or connect it.
    """
    # Raises ConfigError for a wrong address.
    host_name(address)
    socket: Socket = context.socket(kind)
    socket.setsockopt(zmq.LINGER, 0)
    for option, value in options.items():
        socket.setsockopt(option, value)
    try:
        _secure(socket, address, key_dir, server=bind)
        if bind:
            socket.bind(address)
        else:
            socket.connect(address)
    except zmq.ZMQError as e:
        socket.close()
        cause, remedy = _CAUSES.get(e.errno, ("the system refuses it", _CHANGE_REMEDY))
        code = ErrorCode.OTHER
        if e.errno == zmq.EADDRINUSE:
            code = ErrorCode.BUSY
        raise DeviceError(f"{address}: {e.strerror or e}", cause, remedy, code=code) from None
    except ConfigError:
        socket.close()
        raise
    return socket


def make_server_context() -> zmq.Context[Socket]:
    """Create a context for `create_publisher` and `create_replier`, with an I/O thread for each.

    With one thread for both, 1,000 subscribers that came and left kept a command waiting for 50 to 170 ms; with two,
    20 to 60 ms (on a PC).
    """
    return zmq.Context(io_threads=2)


def create_publisher(context: zmq.Context[Any], address: str, key_dir: Path) -> Socket:
    """Create the Pi's PUB socket, bound. `context`: from `make_server_context`.

    Its queue has 100,000 events for each subscriber (chosen: a scan of 70,000 positions fits); further ones are lost to
    that subscriber, which then requests them by the command `messages.Replay`.
    """
    options: dict[int, int | bytes] = {zmq.SNDHWM: 100_000, zmq.MAXMSGSIZE: MAX_SUBSCRIPTION_BYTES}
    options |= {zmq.HANDSHAKE_IVL: HANDSHAKE_TIMEOUT_MS, zmq.AFFINITY: EVENT_IO_THREAD}
    return _make(context, zmq.PUB, address, key_dir, bind=True, options=options)


def create_replier(context: zmq.Context[Any], address: str, key_dir: Path) -> Socket:
    """Create the Pi's ROUTER socket, bound, for REQ sockets. `context`: from `make_server_context`.

    A longer message than MAX_COMMAND_BYTES closes its connection. Sending to a disconnected client raises zmq.ZMQError
    (ROUTER_MANDATORY) instead of dropping the reply silently.
    """
    options: dict[int, int | bytes] = {zmq.MAXMSGSIZE: MAX_COMMAND_BYTES, zmq.ROUTER_MANDATORY: 1}
    options |= {zmq.HANDSHAKE_IVL: HANDSHAKE_TIMEOUT_MS, zmq.AFFINITY: COMMAND_IO_THREAD}
    return _make(context, zmq.ROUTER, address, key_dir, bind=True, options=options)


def create_authenticator(context: zmq.Context[Any]) -> Socket:
    """Create the REP socket to which ZeroMQ sends each CURVE client of this context for approval (ZAP, RFC 27)."""
    socket: Socket = context.socket(zmq.REP)
    socket.bind("inproc://zeromq.zap.01")
    return socket


def create_subscriber(context: zmq.Context[Any], address: str, key_dir: Path) -> Socket:
    """Create the host's SUB socket, connected, subscribed to all events, with a long queue."""
    options: dict[int, int | bytes] = {zmq.RCVHWM: 100_000, zmq.SUBSCRIBE: EVENT_TOPIC}
    return _make(context, zmq.SUB, address, key_dir, bind=False, options=options)


def create_observer(context: zmq.Context[Any], address: str, key_dir: Path) -> Socket:
    """Create the SUB socket of a program that only displays events: a short queue, and a heartbeat of ZeroMQ.

    The Pi has a queue for each subscriber; without the heartbeat it would keep the queue of one that was
    stopped, or whose machine has failed. The host that runs a scan uses `create_subscriber`: it must lose no events, so
    that the Pi has to keep its queue.
    """
    # Times in ms: a heartbeat each second; after five seconds without one the Pi drops this subscriber. Chosen.
    options: dict[int, int | bytes] = {zmq.RCVHWM: 1000, zmq.SUBSCRIBE: EVENT_TOPIC}
    options |= {zmq.HEARTBEAT_IVL: 1000, zmq.HEARTBEAT_TTL: 5000}
    return _make(context, zmq.SUB, address, key_dir, bind=False, options=options)


def create_requester(context: zmq.Context[Any], address: str, key_dir: Path) -> Socket:
    """Create the host's REQ socket, connected; relaxed (REQ_RELAXED): it may send again when a reply was lost.

    If the server refused the handshake, `send` raises zmq.Again after `SEND_TIMEOUT_MS`.
    """
    options: dict[int, int | bytes] = {zmq.REQ_RELAXED: 1, zmq.REQ_CORRELATE: 1, zmq.SNDTIMEO: SEND_TIMEOUT_MS}
    return _make(context, zmq.REQ, address, key_dir, bind=False, options=options)


class HandshakeMonitor:
    """Detect that a server refused this client's key, as opposed to not answering. `socket`: the client's.

    `lacks_curve` is True if :meth:`is_refused` found that the server has no CURVE, so that no key would help.
    A wrong server key in this client is not detected: it looks like a server that does not answer.
    """

    def __init__(self, socket: Socket) -> None:
        self._socket = socket
        self._monitor = socket.get_monitor_socket(zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)
        self._refused = False
        self.lacks_curve = False
        # The server may have refused the key before this monitor saw it, and reports that once for each connection. So
        # the socket connects again.
        if endpoint := socket.getsockopt_string(zmq.LAST_ENDPOINT):
            socket.disconnect(endpoint)
            socket.connect(endpoint)

    def is_refused(self) -> bool:
        """Return True if so far the server refused this client's key, or is a server without CURVE."""
        while self._monitor.poll(0):
            failure = recv_monitor_message(self._monitor)["value"]
            self._refused = True
            self.lacks_curve = failure == zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH
        return self._refused

    def close(self) -> None:
        """Close the monitor; call it before closing the socket."""
        self._socket.disable_monitor()
        self._monitor.close()
