"""The hub of the simulated wires: relays GPIO edges and stage motion between the processes of a simulated rig.

Protocol: shared/wires.py and docs/spec/simulated-rig.md. Lines of one party reach every listener in the order they were
written. Nothing is dropped: what a party does not read is kept for it, up to a bound; beyond it that party alone is
cut off, with a message, and notices by its closed connection.
"""

from __future__ import annotations

import selectors
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Event

from polysight.shared.errors import ConfigError, DeviceError, PolysightError, ProtocolError
from polysight.shared.wires import WireMotion, parse
from polysight.simulators.process import announce_ready, command_line, die_with_parent, stop_requested

MAX_LINE_BYTES = 200
MAX_PENDING_BYTES = 64 << 20
MAX_SOCKET_PATH = 107  # sun_path of Linux holds 108 bytes with its terminator
_READ_BYTES = 1 << 18


class _Party:
    """One connected process: what it wants to hear, and what it has not read yet."""

    def __init__(self, connection: socket.socket, number: int) -> None:
        self.connection = connection
        self.name = f"party {number}"
        self.partial = b""
        self.lines: set[bytes] = set()
        self.motion = False
        self.pending = bytearray()


class WireHub:
    """Relays S lines to the parties that asked for them with L, M lines to those that sent W; never back to the sender.

    Parameters
    ----------
    path
        Unix socket to listen at; a socket file left over from an earlier run is replaced.
    report
        Told why a party was cut off: it wrote what is not a wire line, or did not read.
    max_pending_bytes
        What is kept for a party that does not read, before it is cut off.

    Raises
    ------
    ConfigError
        when the path is too long for a Unix socket.
    DeviceError
        when the socket cannot be made, or another hub serves there.
    """

    def __init__(self, path: Path, report: Callable[[str], object], max_pending_bytes: int = MAX_PENDING_BYTES) -> None:
        if len(str(path).encode()) > MAX_SOCKET_PATH:
            raise ConfigError(
                f"{path}: too long for a Unix socket (at most {MAX_SOCKET_PATH} bytes)",
                "the run's folder lies too deep",
                "choose a shorter folder, for example below /tmp",
            )
        self._path = path
        self._report = report
        self._max_pending = max_pending_bytes
        self._listener = _listen(path)
        self._listener.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ, None)
        self._parties: dict[socket.socket, _Party] = {}
        self._accepted = 0
        self._last_motion = b""
        self._cut: set[bytes] = set()
        self.relayed = 0

    def serve(self, stop: Event, poll_s: float = 0.1) -> None:
        """Relay until `stop` is set."""
        while not stop.is_set():
            self.step(poll_s)

    def step(self, timeout_s: float) -> None:
        """One turn: take in what the parties wrote, then write what they want to hear."""
        for key, events in self._selector.select(timeout_s):
            if key.data is None:
                self._accept()
            elif events & selectors.EVENT_READ and key.data.connection in self._parties:
                self._read(key.data)
        for party in list(self._parties.values()):
            if party.pending:
                self._write(party)

    def close(self) -> None:
        """Close all connections and remove the socket file."""
        for party in list(self._parties.values()):
            self._drop(party)
        self._selector.close()
        self._listener.close()
        self._path.unlink(missing_ok=True)

    def _accept(self) -> None:
        connection, _ = self._listener.accept()
        connection.setblocking(False)
        self._accepted += 1
        party = _Party(connection, self._accepted)
        self._parties[connection] = party
        self._selector.register(connection, selectors.EVENT_READ, party)

    def _read(self, party: _Party) -> None:
        try:
            data = party.connection.recv(_READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop(party)
            return
        *lines, party.partial = (party.partial + data).split(b"\n")
        try:
            self._relay(party, lines)
            if len(party.partial) > MAX_LINE_BYTES:
                raise ProtocolError(f"a line of more than {MAX_LINE_BYTES} bytes: {party.partial[:40]!r}...")
        except ProtocolError as e:
            self._cut_off(party, str(e))

    def _relay(self, sender: _Party, lines: list[bytes]) -> None:
        others = [p for p in self._parties.values() if p is not sender]
        for line in lines:
            tag = line[:2]
            if tag == b"S ":
                fields = line.split(b" ")
                wanted = len(fields) == 4 and fields[2]
                if not wanted:
                    raise ProtocolError(f"not a wire line: {line!r}")
                for p in others:
                    if wanted in p.lines and wanted not in self._cut:
                        p.pending += line + b"\n"
                        self.relayed += 1
            elif tag == b"M ":
                if not isinstance(parse(line.decode("ascii", "replace")), WireMotion):
                    raise ProtocolError(f"not a wire line: {line!r}")
                self._last_motion = line + b"\n"
                for p in others:
                    if p.motion:
                        p.pending += self._last_motion
                        self.relayed += 1
            elif tag == b"L " and all(word.isdigit() for word in line[2:].split()):
                sender.lines.update(line[2:].split())
                sender.pending += b"K\n"
            elif tag == b"X " and len(fields := line.split(b" ")) == 3 and fields[2] in (b"0", b"1"):
                (self._cut.add if fields[2] == b"1" else self._cut.discard)(fields[1])
                sender.pending += b"K\n"
            elif line == b"W":
                sender.motion = True
                # Whoever joins late must know where the stage stands now.
                sender.pending += b"K\n" + self._last_motion
            else:
                raise ProtocolError(f"not a wire line: {line!r}")

    def _write(self, party: _Party) -> None:
        try:
            sent = party.connection.send(party.pending)
        except BlockingIOError:
            sent = 0
        except OSError:
            self._drop(party)
            return
        del party.pending[:sent]
        if len(party.pending) > self._max_pending:
            self._cut_off(party, f"has not read {len(party.pending)} bytes")
            return
        wanted = selectors.EVENT_READ | (selectors.EVENT_WRITE if party.pending else 0)
        if self._selector.get_key(party.connection).events != wanted:
            self._selector.modify(party.connection, wanted, party)

    def _cut_off(self, party: _Party, why: str) -> None:
        lines = ", ".join(sorted(word.decode() for word in party.lines)) or "none"
        self._drop(party)
        self._report(f"{party.name} (listening to lines: {lines}) cut off: {why}")

    def _drop(self, party: _Party) -> None:
        self._selector.unregister(party.connection)
        del self._parties[party.connection]
        party.connection.close()


def _listen(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        if path.is_socket():
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
                if probe.connect_ex(str(path)) == 0:
                    raise DeviceError(
                        f"{path}: another hub serves here", "a simulated rig is still running", "end it first"
                    )
            path.unlink()
        listener.bind(str(path))
        listener.listen(16)
    except OSError as e:
        listener.close()
        raise DeviceError(
            f"{path}: cannot listen: {e}", "the folder is absent or not writable", "make the folder"
        ) from None
    except DeviceError:
        listener.close()
        raise
    return listener


def main(argv: list[str] | None = None) -> int:
    """Run the hub until SIGTERM or SIGINT."""
    parser = command_line("polysight.simulators.wires", "Hub of the simulated wires.", "--socket out/wires.sock")
    parser.add_argument("--socket", type=Path, required=True, help="Unix socket to serve")
    args = parser.parse_args(argv)
    stop = stop_requested()
    die_with_parent()
    try:
        hub = WireHub(args.socket, lambda message: sys.stderr.write(f"wires: {message}\n"))
    except PolysightError as e:
        sys.stderr.write(f"error: {e}\n")
        return e.exit_status
    announce_ready(str(args.socket))
    try:
        hub.serve(stop)
    finally:
        hub.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
