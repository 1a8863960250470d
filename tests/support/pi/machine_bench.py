"""The Pi's state machine with a stage, a trigger loop, a journal and a clock that a test controls step by step."""

from __future__ import annotations

from typing import Any

from polysight_pi.edges import RowMotion
from polysight_pi.machine import Machine
from polysight_pi.trigger import BurstSent, BurstSpec, Edge, LoopFault, TriggerLoop
from polysight_shared.raster import Row
from polysight_shared.stage_line import Reply
from tests.support.pi.fakes import FakeDriver, FakeLines

# Two pulses at each position; the times are those of the published rig.
SPEC = BurstSpec(pulses=2, period_ns=1_500_000, width_ns=1000)
ROW = Row(index=0, y_mm=0.0, x_start_mm=0.0, step_mm=2.0, points=3)
# Time between two edges: 2 mm at 20 mm/s.
INTERVAL_NS = 100_000_000


class FakeJournal:
    """Keeps the events that the machine adds."""

    def __init__(self) -> None:
        self.events: list[Any] = []

    def add(self, kind: type, **fields: Any) -> None:
        self.events.append(kind(scan_id="", seq=0, t_mono_ns=0, **fields))

    def retry(self) -> None: ...


class Bench:
    """The state machine with a fake stage and journal, and a trigger loop whose edges come from the test."""

    def __init__(self) -> None:
        # Time of the machine's clock, seconds
        self.t = 100.0
        self.lines = FakeLines()
        self.stage = FakeDriver()
        self.journal = FakeJournal()
        # Items that the machine and the trigger loop send to the executor: sent bursts, faults, and functions to call.
        self.posted: list[Any] = []
        # The thread of the loop is not started: the test passes edges to it.
        self.loop = TriggerLoop(self.lines, self.posted.append, lambda: None)
        parts: Any = (self.stage, self.loop, self.journal, self.posted.append, lambda: self.t)
        self.machine = Machine(*parts)
        # Number and time of the last edge.
        self.seqno = 0
        self.edge_ns = 0
        self.row = ROW

    def run_posted(self) -> None:
        """Process all posted items, as the executor does."""
        while self.posted:
            item = self.posted.pop(0)
            if isinstance(item, BurstSent):
                self.machine.on_burst(item)
            elif isinstance(item, LoopFault):
                self.machine.on_loop_fault(item)
            else:
                item()

    def let_time_pass(self, seconds: float) -> None:
        """Advance the clock from deadline to deadline, as the executor does, and let the machine check each of them."""
        end = self.t + seconds
        while self.t < end:
            seconds_to_deadline = self.machine.seconds_left()
            if seconds_to_deadline is None:
                self.t = end
            else:
                # A deadline that is due now must not stop the clock.
                self.t = min(end, self.t + max(seconds_to_deadline, 1e-6))
            self.machine.check_deadlines()
            self.run_posted()

    def begin_and_home(self) -> Bench:
        """Begin a run and home the stage; the state is then `ready`."""
        self.machine.command("BeginRun", 0)
        self.machine.command("Home")
        self.run_posted()
        self.send_reply(Reply("ok", self.stage.number))
        self.send_reply(Reply("done", self.stage.number))
        assert self.machine.state == "ready"
        return self

    def start(self, row: Row = ROW, speed_mm_s: float = 20.0) -> None:
        """Start the first take of a row, which the stage accepts."""
        self.row = row
        take = 1
        self.machine.command("RunRow", row, take, SPEC, speed_mm_s)
        self.send_reply(Reply("ok", self.stage.number))

    def send_reply(self, reply: Reply) -> None:
        self.machine.on_stage(reply)
        self.run_posted()

    def send_status(self, points: int, state: str = "row", x: int = 0, **times_ns: int) -> None:
        fields = {"state": state, "points": str(points), "x": str(x), "y": "0"}
        self.send_reply(Reply("status", fields=fields, **times_ns))

    def end_row(self, dx: int = 0, dy: int = 0, held: int = 0, extra_pulses: int = 0, **times_ns: int) -> None:
        """Send the stage's report that the row has ended.

        It rests `dx` and `dy` steps from the right position, and has sent `extra_pulses` more triggers than points.
        """
        x, y = RowMotion.plan(self.row, self.stage.config, 20.0).end
        fields = {"points": str(self.row.points), "pulses": str(self.row.points + extra_pulses)}
        fields |= {"x": str(x + dx), "y": str(y + dy), "held": str(held)}
        self.send_reply(Reply("done", self.stage.number, fields=fields, **times_ns))

    def send_edge(self) -> None:
        """Send the next edge at the time at which it is expected."""
        self.give_edge(self.edge_ns + INTERVAL_NS)

    def give_edge(self, t_ns: int) -> None:
        """Pass an edge at this time to the trigger loop, and the results to the machine."""
        self.seqno += 1
        self.edge_ns = t_ns
        self.lines.t = max(self.lines.t, t_ns)
        with self.loop._lock:
            self.loop._answer_edge(Edge(t_ns, self.seqno))
        self.run_posted()

    @property
    def armed(self) -> bool:
        """True if the trigger loop answers edges with bursts."""
        return self.loop._job is not None

    def list_events(self, kind: type) -> list[Any]:
        return [e for e in self.journal.events if isinstance(e, kind)]
