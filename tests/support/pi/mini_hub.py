"""A wire hub of a few lines (the real one is in simulators): every S line reaches all others that asked for it."""

from __future__ import annotations

import selectors
import socket
import threading
from pathlib import Path


class MiniHub:
    def __init__(self, path: Path) -> None:
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._listener.bind(str(path))
        self._listener.listen()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._parties: dict[socket.socket, tuple[set[bytes], bytearray]] = {}
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self) -> None:
        while not self._closed.is_set():
            for key, _ in self._selector.select(0.02):
                if key.fileobj is self._listener:
                    party, _ = self._listener.accept()
                    self._parties[party] = (set(), bytearray())
                    self._selector.register(party, selectors.EVENT_READ)
                else:
                    self._hear(key.fileobj)  # type: ignore[arg-type]

    def _hear(self, party: socket.socket) -> None:
        wanted, buffer = self._parties[party]
        try:
            data = party.recv(65536)
        except OSError:
            data = b""
        if not data:
            self._selector.unregister(party)
            del self._parties[party]
            party.close()
            return
        buffer += data
        *lines, rest = bytes(buffer).split(b"\n")
        buffer[:] = rest
        out: dict[socket.socket, bytearray] = {}
        for line in lines:
            words = line.split()
            if words[0] == b"L":
                wanted.update(words[1:])
                party.sendall(b"K\n")
            for other, (lines_wanted, _) in self._parties.items():
                if words[0] == b"S" and other is not party and words[2] in lines_wanted:
                    out.setdefault(other, bytearray()).extend(line + b"\n")
        for other, text in out.items():
            other.sendall(text)

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
        for party in self._parties:
            party.close()
        self._listener.close()
        self._selector.close()
