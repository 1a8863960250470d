"""Lines of a simulated rig: edges are sent and received over a local socket, with their wire time (`wires` of shared).

Wire time is the simulated stage's clock. Here it is the latest of the received edges and of the deadlines slept until,
so a burst takes no wall time and its pulses are exactly on their deadlines, however busy the machine is.
"""

from __future__ import annotations

import time
from pathlib import Path

from polysight_pi.bursts import DEFAULT_BUFSIZ, Edge, SpiBurst
from polysight_shared.config import Pi
from polysight_shared.messages import WIRES
from polysight_shared.wires import WireClient, WireEdge


class WireLines:
    """Lines on simulated wires; `path` is the hub's socket. Raises DeviceError if no hub listens there."""

    name: str = WIRES

    def __init__(self, path: Path, pi: Pi) -> None:
        self.check_width = not pi.one_shot
        self._trigger, self._outputs = pi.trigger_in, pi.sync_out
        self._client = WireClient(path, listen=(pi.trigger_in,))
        self._now_ns = self._seqno = 0
        self._active = False
        self._unsent: list[WireEdge] = []

    def now_ns(self) -> int:
        """Return the wire time."""
        return self._now_ns

    def sleep_until(self, t_ns: int) -> None:
        """Advance the wire time; return at once."""
        self._now_ns = max(self._now_ns, t_ns)

    def wait_edge(self, timeout_s: float) -> Edge | None:
        """Send the edges of the last burst and wait for the next rising edge of the trigger line.

        Raises DeviceError when the hub is lost.
        """
        self._flush()
        deadline = time.monotonic() + timeout_s
        while (left := deadline - time.monotonic()) > 0:
            message = self._client.receive(left)
            if isinstance(message, WireEdge) and message.line == self._trigger and message.value:
                self.sleep_until(message.t_ns)
                self._seqno += 1
                return Edge(message.t_ns, self._seqno)
        return None

    def pulse(self, width_ns: int) -> tuple[int, int]:
        """Send a pulse on all output lines, starting now; return its times."""
        begin_ns = self._now_ns
        self._set_output(True)
        self.sleep_until(begin_ns + width_ns)
        self._set_output(False)
        return begin_ns, self._now_ns

    def _set_output(self, active: bool) -> None:
        if active != self._active:
            self._active = active
            self._unsent += [WireEdge(self._now_ns, line, int(active)) for line in self._outputs]

    def _flush(self) -> None:
        if self._unsent:
            unsent, self._unsent = self._unsent, []
            self._client.send(*unsent)

    def close(self) -> None:
        """Set the outputs low and disconnect from the hub."""
        try:
            self._set_output(False)
            self._flush()
        finally:
            self._client.close()


class SpiWireLines(WireLines):
    """Simulated wires whose SYNC_IN is MOSI: the bits of a transfer become edges at the wire time of their bit."""

    bufsiz = DEFAULT_BUFSIZ

    def transfer(self, burst: SpiBurst) -> tuple[int, int]:
        """Send the edges of a transfer, most significant bit first; the line keeps the level of the last bit."""
        begin_ns = self._now_ns
        for i, byte in enumerate(burst.data):
            if byte or self._active:
                for k in range(8):
                    self._now_ns = begin_ns + round((8 * i + k) * burst.bit_ns)
                    self._set_output(bool(byte << k & 0x80))
        self._now_ns = begin_ns + round(burst.duration_ns)
        return begin_ns, self._now_ns
