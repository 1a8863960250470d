"""The host's sign of life, without which the Pi ends a running row (fault 108, docs/spec/wire.md)."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import zmq

from polysight.host.capture.scheduling import take_priority
from polysight.shared.config import Instrument
from polysight.shared.messages import Alive, pack
from polysight.shared.sockets import requester

REAL_TIME = 1  # below the receiving processes
_REPLY_LIMIT_S = 1.0  # then the question was lost, and another one is asked


class HostHeartbeat:
    """Says `Alive` from a thread and a socket of its own, so that it lives as long as this process, and no longer.

    Parameters
    ----------
    context, instrument
        Where the Pi is.
    scan_id
        The run that is begun.
    interval_s
        How often.
    """

    def __init__(self, context: zmq.Context[Any], instrument: Instrument, scan_id: str, interval_s: float) -> None:
        self._socket = requester(context, instrument.pi.command_address, Path(instrument.pi.key_dir))
        self._alive, self._interval_s = pack(Alive(scan_id=scan_id)), interval_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._beat, name="heartbeat", daemon=True)
        self._thread.start()

    def _beat(self) -> None:
        take_priority(REAL_TIME)  # where that is not permitted, a busy machine may cost a row, which is taken again
        try:
            while not self._stop.wait(self._interval_s):
                self._socket.send(self._alive)
                waited_s = 0.0
                while not self._stop.is_set() and waited_s < _REPLY_LIMIT_S:
                    if self._socket.poll(round(self._interval_s * 1e3)):
                        self._socket.recv()
                        break
                    waited_s += self._interval_s
        finally:
            self._socket.close()

    def stop(self) -> None:
        """No more."""
        self._stop.set()
        self._thread.join()
