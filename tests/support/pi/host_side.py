"""A minimal host that sends commands to the Pi's program and receives its events, and that program in a thread."""

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import zmq

from polysight_pi import executor, journal, lines, service, stage, system
from polysight_pi.service import Service
from polysight_shared import messages as m
from polysight_shared.config import Instrument
from polysight_shared.raster import plan_raster
from polysight_shared.sockets import create_requester, create_subscriber
from tests.support.processes import LIMIT_S, read_idle_s, wait_for

POLL_MS = 100
# Step of the ticking clock
TICK_S = 0.01


class TickingClock:
    """The clock of the Pi's program in this process, which a thread of this process advances by `TICK_S` at a time.

    On a busy machine the process gets little processor time, and its clock is slow as well, so that no event is late.
    The clock stands still while `stands` is True.
    """

    def __init__(self) -> None:
        self.stands = False
        self._now_s = time.monotonic()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._tick)
        self._patches = ExitStack()
        times = SimpleNamespace(**{**vars(time), "monotonic": self})
        for module in (executor, journal, lines, service, stage):
            self._patches.enter_context(patch.object(module, "time", times))
        self._thread.start()

    def __call__(self) -> float:
        return self._now_s

    def _tick(self) -> None:
        while not self._stop.wait(TICK_S):
            if not self.stands:
                self._now_s += TICK_S

    def sleep(self, seconds: float) -> None:
        """Return when the clock has advanced by this much."""
        end_s = self._now_s + seconds
        wait_for(lambda: self._now_s >= end_s, f"{seconds} s of the Pi's clock")

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._patches.close()


class HostSide:
    """Sends commands to the Pi, and records every event in `events`."""

    def __init__(
        self,
        command_address: str,
        event_address: str,
        instrument: Instrument,
        key_dir: Path = Path("none"),
        limit_s: float = LIMIT_S,
    ) -> None:
        self.limit_s = limit_s
        self.context: Any = zmq.Context()
        self.commands = create_requester(self.context, command_address, key_dir)
        self.subscriber = create_subscriber(self.context, event_address, key_dir)
        self.instrument = instrument
        self.events: list[Any] = []
        # When the first event comes, the Pi has received the subscription.
        self.wait_for_event(object)

    def ask(self, command: Any) -> Any:
        """Send a command, or bytes; return the reply."""
        self.commands.send(command if isinstance(command, bytes) else m.pack(command))
        wait_for(lambda: self.commands.poll(POLL_MS) != 0, f"a reply to {command}", self.limit_s)
        return m.unpack_reply(self.commands.recv())

    def must_accept(self, command: Any) -> m.Accepted:
        reply = self.ask(command)
        assert isinstance(reply, m.Accepted), reply
        return reply

    def must_refuse(self, command: Any) -> int:
        """Send a command that must be refused; return the fault number of the refusal."""
        reply = self.ask(command)
        assert isinstance(reply, m.Refused), reply
        assert reply.problem
        assert reply.remedy
        return reply.number

    def make_begin(self, scan_id: str = "scan", **changes: Any) -> m.BeginRun:
        """Return the command that begins a run of this rig, with other values for `changes`."""
        i = self.instrument
        fields: dict[str, Any] = {
            "scan_id": scan_id,
            "plan": plan_raster(i.grid),
            "pulses": i.burst.pulses,
            "period_us": i.burst.period_us,
            "width_us": i.burst.width_us,
            "speed_mm_s": i.stage.speed_mm_s,
            "owns_home": True,
        }
        return m.BeginRun(**{**fields, **changes})

    def home(self, owner: str = "") -> None:
        self.must_accept(m.Home(owner=owner))
        self.wait_for_state("ready")

    def wait_for_state(self, *states: str) -> m.StatusReply:
        """Wait until the Pi is in one of these states; return its status."""
        replies: list[Any] = []

        def is_reached() -> bool:
            # A program without processor time refuses the request.
            replies.append(self.ask(m.Status()))
            return isinstance(replies[-1], m.StatusReply) and replies[-1].state in states

        wait_for(is_reached, f"a state of {states}", self.limit_s)
        return replies[-1]

    def wait_for_event(
        self, kind: type, where: Callable[[Any], bool] = lambda _: True, limit_s: float | None = None
    ) -> Any:
        """Wait for the next event of a kind, for which `where` is true if it is given; return it."""
        limit_s = self.limit_s if limit_s is None else limit_s
        deadline = read_idle_s() + limit_s
        while read_idle_s() < deadline:
            if self.subscriber.poll(POLL_MS):
                event = m.unpack_event(self.subscriber.recv_multipart()[-1])
                self.events.append(event)
                if isinstance(event, kind) and where(event):
                    return event
        raise AssertionError(f"no {kind.__name__} within {limit_s} s; seen {self.events[-5:]}")

    def start_row(self, row_index: int = 0, take: int = 1, owner: str = "") -> m.Accepted:
        return self.must_accept(m.RunRow(scan_id="scan", row_index=row_index, take=take, owner=owner))

    def run_row(self, row_index: int, take: int = 1) -> m.RowFinished:
        """Run a row to its end."""
        self.start_row(row_index, take)
        return self.wait_for_event(m.RowFinished, lambda e: (e.row_index, e.take) == (row_index, take))

    def list_events(self, *kinds: type) -> list[Any]:
        """Events of these kinds so far."""
        return [e for e in self.events if isinstance(e, kinds)]

    @property
    def journalled(self) -> list[Any]:
        return self.list_events(*m.JOURNALLED_EVENTS)

    def replay(self, scan_id: str = "scan", from_seq: int = 1, limit: int = 10000) -> list[Any]:
        return self.ask(m.Replay(scan_id=scan_id, from_seq=from_seq, limit=limit)).events

    def close(self) -> None:
        self.context.destroy(linger=0)


class Running:
    """A service in a thread with a clock of its own, and the host's end of its sockets."""

    def __init__(self, instrument: Instrument, wires: Path) -> None:
        self.clock = TickingClock()
        self.service = Service(instrument, wires)
        self.service.executor._machine._clock = self.clock
        # The program closes connections when its process has too much memory. Here that is the tests' memory, too, so
        # the limit is raised to a terabyte.
        self._without_limit = patch.object(system, "MAX_BYTES", 1 << 40)
        self._without_limit.start()
        self.thread = threading.Thread(target=self.service.serve)
        self.thread.start()
        server = self.service.server
        self.host = HostSide(server.command_address, server.event_address, instrument)

    def close(self) -> None:
        self.host.close()
        self.service.stop()
        self.thread.join()
        self.service.close()
        self.clock.close()
        self._without_limit.stop()
