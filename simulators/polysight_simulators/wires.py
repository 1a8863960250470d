"""Hub of the simulated wires: relay GPIO edges and stage motion between the processes of a simulated rig.

Protocol: docs/spec/simulated-rig.md; a line of text for each message; its first letter gives the kind:

    `S <t_ns> <line> <0|1>`                 a GPIO line changed at wire time t_ns
    `M <t_ns> <x_um> <y_um> <vx_um_s>`      place and speed of the stage from t_ns on
    `L <line> [<line> ...]`, `W`            subscribe to S of these GPIO lines; subscribe to M
    `J <line> <other>`, `X <line> <1|0>`    faults: join two GPIO lines; cut one, or repair it
    `K`                                     the hub confirms L, W, J or X

Lines of a client reach every subscriber in order, and none is dropped, unless a fault has cut its wire: unread lines
are queued up to a limit; a client that exceeds it is disconnected with a message.
"""

import selectors
import socket
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from threading import Event

from polysight_shared.errors import ConfigError, DeviceError, ErrorCode, ProtocolError
from polysight_shared.wires import WireMotion, parse
from polysight_simulators.process import announce_ready, make_parser, run_until_stopped

# Longest line that is accepted; chosen, several times the longest line of the protocol.
MAX_LINE_BYTES = 200
# Most bytes that a client may leave unread; chosen, about two million edges for a stopped client.
MAX_PENDING_BYTES = 64 << 20
# `sun_path` of Linux holds 108 bytes with its terminator.
MAX_SOCKET_PATH = 107
_READ_BYTES = 1 << 18


class _Client:
    """A connected process.

    `partial` is a line of which the end has not come yet, `lines` are the GPIO lines that it subscribed to, `motion`
    is true if it gets M lines, `pending` are the bytes that it has not read.
    """

    def __init__(self, connection: socket.socket, number: int) -> None:
        self.connection = connection
        self.name = f"client {number}"
        self.partial = b""
        self.lines: set[bytes] = set()
        self.motion = False
        self.pending = bytearray()


class WireHub:
    """Relay S lines to the clients that subscribed with L, M lines to those that sent W, except to the sender.

    Two faults change that: a cut GPIO line reaches no client; of two joined lines, the second repeats the edges of the
    first, and that copy also reaches the sender, as it would on a short circuit.

    Parameters
    ----------
    path
        Unix socket; an unused socket file is replaced.
    report
        Called with the reason when a client is disconnected: an invalid line, or too many unread bytes.
    max_pending_bytes
        Limit of unread bytes of a client.

    Raises
    ------
    ConfigError
        if the path is too long for a Unix socket.
    DeviceError
        if the socket cannot be created, or another hub uses it.
    """

    def __init__(self, path: Path, report: Callable[[str], object], max_pending_bytes: int = MAX_PENDING_BYTES) -> None:
        if len(str(path).encode()) > MAX_SOCKET_PATH:
            raise ConfigError(
                f"{path}: too long for a Unix socket (at most {MAX_SOCKET_PATH} bytes)",
                "the folder of the run is too deep",
                "choose a shorter folder, for example in /tmp",
                code=ErrorCode.VALUE_INVALID,
            )
        self._path = path
        self._report = report
        self._max_pending = max_pending_bytes
        self._listener = _listen(path)
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ, None)
        self._clients: dict[socket.socket, _Client] = {}
        self._accepted = 0
        # Motion line sent last, for late subscribers.
        self._last_motion = b""
        # Numbers, as bytes, of the GPIO lines that a fault has cut.
        self._cut: set[bytes] = set()
        # Number of a joined GPIO line to that of the line that repeats its edges.
        self._joined: dict[bytes, bytes] = {}

    def serve(self, stop: Event, poll_s: float = 0.1) -> None:
        """Relay until `stop` is set."""
        while not stop.is_set():
            self.step(poll_s)

    def step(self, timeout_s: float) -> None:
        """Read lines from the clients, relay them, and write queued lines."""
        for key, events in self._selector.select(timeout_s):
            if key.data is None:
                self._accept()
            elif events & selectors.EVENT_READ and key.data.connection in self._clients:
                self._read(key.data)
        for client in list(self._clients.values()):
            if client.pending:
                self._write(client)

    def close(self) -> None:
        """Close all connections and remove the socket file."""
        for client in list(self._clients.values()):
            self._drop(client)
        self._selector.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        """Accept a client and number it."""
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        self._accepted += 1
        client = _Client(connection, self._accepted)
        self._clients[connection] = client
        self._selector.register(connection, selectors.EVENT_READ, client)

    def _read(self, client: _Client) -> None:
        """Read from a client and relay its complete lines; disconnect it at its end or at an invalid line."""
        try:
            data = client.connection.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(client)
            return
        *lines, client.partial = (client.partial + data).split(b"\n")
        try:
            self._relay(client, lines)
            if len(client.partial) > MAX_LINE_BYTES:
                raise ProtocolError(f"a line of more than {MAX_LINE_BYTES} bytes: {client.partial[:40]!r}...")
        except ProtocolError as e:
            self._disconnect(client, str(e))

    def _relay(self, sender: _Client, lines: list[bytes]) -> None:
        """Obey lines by their letter: S edge, M motion, L and W subscribe, X cut or repair a wire, J join two.

        Raises ProtocolError for any other line.
        """
        other_clients = [client for client in self._clients.values() if client is not sender]
        for line in lines:
            tag = line[:2]
            if tag == b"S ":
                fields = line.split(b" ")
                if len(fields) != 4 or not fields[2]:
                    raise ProtocolError(f"not a wire line: {line!r}")
                gpio_line = fields[2]
                self._pass_on(gpio_line, line, other_clients)
                if joined := self._joined.get(gpio_line):
                    self._pass_on(joined, b" ".join([b"S", fields[1], joined, fields[3]]), list(self._clients.values()))
            elif tag == b"M ":
                if not isinstance(parse(line.decode("ascii", "replace")), WireMotion):
                    raise ProtocolError(f"not a wire line: {line!r}")
                self._last_motion = line + b"\n"
                for client in other_clients:
                    if client.motion:
                        client.pending += self._last_motion
            elif tag == b"L " and all(word.isdigit() for word in line[2:].split()):
                sender.lines.update(line[2:].split())
                sender.pending += b"K\n"
            elif tag == b"X " and len(fields := line.split(b" ")) == 3 and fields[2] in (b"0", b"1"):
                if fields[2] == b"1":
                    self._cut.add(fields[1])
                else:
                    self._cut.discard(fields[1])
                sender.pending += b"K\n"
            elif tag == b"J " and len(fields := line.split(b" ")) == 3:
                self._joined[fields[1]] = fields[2]
                sender.pending += b"K\n"
            elif line == b"W":
                sender.motion = True
                # A client that subscribes late needs the stage's position.
                sender.pending += b"K\n" + self._last_motion
            else:
                raise ProtocolError(f"not a wire line: {line!r}")

    def _pass_on(self, gpio_line: bytes, line: bytes, clients: list[_Client]) -> None:
        """Queue `line` for the clients that subscribed to this GPIO line, unless it is cut."""
        for client in clients:
            if gpio_line in client.lines and gpio_line not in self._cut:
                client.pending += line + b"\n"

    def _write(self, client: _Client) -> None:
        """Send what a client takes immediately; if bytes are left, let `step` wake when it takes more.

        Disconnect it if more than the limit is left.
        """
        try:
            sent_bytes = client.connection.send(client.pending)
        except BlockingIOError:
            sent_bytes = 0
        except OSError:
            self._drop(client)
            return
        del client.pending[:sent_bytes]
        if len(client.pending) > self._max_pending:
            self._disconnect(client, f"{len(client.pending)} unread bytes")
            return
        events = selectors.EVENT_READ
        if client.pending:
            events |= selectors.EVENT_WRITE
        if self._selector.get_key(client.connection).events != events:
            self._selector.modify(client.connection, events, client)

    def _disconnect(self, client: _Client, why: str) -> None:
        """Drop a client and report why."""
        lines = ", ".join(sorted(word.decode() for word in client.lines)) or "none"
        self._drop(client)
        self._report(f"{client.name} (lines: {lines}) disconnected: {why}")

    def _drop(self, client: _Client) -> None:
        self._selector.unregister(client.connection)
        del self._clients[client.connection]
        client.connection.close()


def _listen(path: Path) -> socket.socket:
    """Create the listening socket; an unused socket file is replaced.

    Raises DeviceError, also if a hub answers there.
    """
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if path.is_socket():
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
                if probe.connect_ex(str(path)) == 0:
                    raise DeviceError(
                        f"{path}: another hub uses this socket",
                        "a simulated rig is still running",
                        "end it first",
                        code=ErrorCode.BUSY,
                    )
            path.unlink()
        listener.bind(str(path))
        listener.listen(16)
    except OSError as e:
        listener.close()
        raise DeviceError(
            f"{path}: cannot listen: {e}", "the folder is missing or not writable", "create the folder"
        ) from None
    except DeviceError:
        listener.close()
        raise
    return listener


def main(argv: list[str] | None = None) -> int:
    """Run the hub until SIGTERM or SIGINT."""
    parser = make_parser("polysight_simulators.wires", "Hub of the simulated wires.", "--socket out/wires.sock")
    parser.add_argument("--socket", type=Path, required=True, help="Unix socket to serve")
    args = parser.parse_args(argv)

    def serve(stop: Event) -> None:
        with closing(WireHub(args.socket, lambda message: sys.stderr.write(f"wires: {message}\n"))) as hub:
            announce_ready(str(args.socket))
            hub.serve(stop)

    return run_until_stopped(serve)


if __name__ == "__main__":
    sys.exit(main())
