"""Edges of rows are checked by place and time: rows of the simulated stage (the sketch's arithmetic) with faults.

A row is recorded once: what the Pi gets, in its order (edges, replies of the stage, commands of the host). Then it is
replayed to the Pi's state machine with other edges, among them lost, spurious and shifted ones.
"""

import random
from typing import Any, NamedTuple

import msgspec
import pytest
from tests.support.pi.machine_bench import Bench

from polysight_pi.edges import RowMotion
from polysight_shared import messages as m
from polysight_shared.faults import PiFault, StageError
from polysight_shared.raster import Row, Stage
from polysight_shared.stage_line import Command, Immediate, Parameter, Reply
from polysight_shared.wires import WireEdge
from polysight_simulators.stage.motion import NS_PER_TICK, TICK_HZ
from polysight_simulators.stage.python_stage import PythonStage, Rig

POINTS = 60
STEP_MM = 2.0
ROW = Row(index=0, y_mm=0.0, x_start_mm=-300.0, step_mm=STEP_MM, points=POINTS)
# mm/s and mm/s^2: the published rig, and faster and slower ones.
SPEEDS_AND_ACCELERATIONS = [(20, 200), (60, 200), (20, 100), (100, 400)]
# Interval of status requests: a quarter of the stage's heartbeat of 0.5 s.
STATUS_S = 0.125
# Faults with which a row with wrong edges may end. TRIGGER_LINE_LOST comes if edges are missing at two statuses, which
# also late edges after a hold may cause.
FAULTS = (PiFault.EDGE_TIME, PiFault.EDGE_DURING_BURST, PiFault.POINTS_MISMATCH, PiFault.TRIGGER_LINE_LOST)
# Delay of the USB serial port; the time of the line's bytes is known, and the Pi subtracts it.
LINK_S = 0.001


class Happening(NamedTuple):
    """An input of the Pi: an edge of the trigger, a reply of the stage, or a command of the host."""

    t_ns: int
    # "edge", the name of a command, or the reply.
    what: Any


class Recorder:
    """Runs a row on the simulated stage, with the Pi's machine, in virtual time; records everything."""

    def __init__(self, speed_mm_s: float, accel_mm_s2: float, rng: random.Random) -> None:
        self.speed_mm_s = speed_mm_s
        self.config = Stage("none", accel_mm_s2=accel_mm_s2)
        self.happenings: list[Happening] = []
        self._rng = rng
        self._stage = PythonStage(Rig())
        self._tick = 0
        self._sequence = 0
        # Numbers of edges, and of immediate bytes to the stage, that were handed on.
        self._edges = 0
        self._bytes_sent = 0
        accel = round(accel_mm_s2 * self.config.steps_per_mm)
        motion = RowMotion.plan(ROW, self.config, speed_mm_s)
        self._send("HELLO")
        self._send("SET", Parameter.ACCEL, accel)
        self._send("SET", Parameter.HEARTBEAT, 60_000)
        self._send("ENABLE", 1)
        self._send("HOME")
        while b"done" not in self._stage.replies:
            self._advance(0.01)
        self._bench = make_bench(self)
        # Near the row, so that the travel to it is short.
        x = motion.x_start - 2 * motion.run_up
        y = motion.y - 200
        rate = 18_000
        self._send("MOVE", x, y, rate)
        while self._stage.replies.count(b"done") < 2:
            self._advance(0.01)
        self._stage.wires.clear()
        self._stage.replies.clear()
        self._send("ROW", *motion.line)
        self._stage.replies.clear()

    def _send(self, verb: str, *args: int) -> None:
        self._stage.receive(Command(self._sequence, verb, args).encode())
        self._sequence += 1

    def _advance(self, seconds: float) -> None:
        self._tick += round(seconds * TICK_HZ)
        self._stage.advance(self._tick, self._tick * 1000 // TICK_HZ)

    @property
    def edges_ns(self) -> list[int]:
        return [w.t_ns for w in self._stage.wires if isinstance(w, WireEdge) and w.value]

    def run(self, holds: list[tuple[float, float]], early_hold_s: float | None = None) -> list[Happening]:
        """Run the row with these holds: each a time after the first point and a duration, seconds.

        With `early_hold_s` there is instead one hold of 0.6 s, which begins `early_hold_s` seconds after the command
        ROW.
        """
        commands: list[tuple[int, str]] = []
        if early_hold_s is not None:
            begin_ns = self._tick * NS_PER_TICK + round(early_hold_s * 1e9)
            commands = [(begin_ns, "Hold"), (begin_ns + 600_000_000, "Resume")]
        status_asked_ns = 0
        next_status_ns = 0
        while True:
            self._advance(0.001)
            now_ns = self._tick * NS_PER_TICK
            for t_ns in self.edges_ns[self._edges :]:
                self._edges += 1
                self._happen(t_ns, "edge")
                if self._edges == 1:
                    for begin_s, length_s in holds:
                        commands += [(t_ns + round(begin_s * 1e9), "Hold")]
                        commands += [(t_ns + round((begin_s + length_s) * 1e9), "Resume")]
            while commands and commands[0][0] <= now_ns:
                self._happen(now_ns, commands.pop(0)[1])
            for byte in self._bench.stage.sent[self._bytes_sent :]:
                self._bytes_sent += 1
                self._stage.receive(byte.sent)
            if self._stage.replies:
                raw = bytes(self._stage.replies)
                self._stage.replies.clear()
                for line in raw.splitlines(keepends=True):
                    self._reply(Reply.decode(line), status_asked_ns, now_ns)
                if b"done" in raw:
                    return self.happenings
            if now_ns >= next_status_ns:
                status_asked_ns = now_ns
                next_status_ns = now_ns + round(STATUS_S * 1e9)
                self._stage.receive(Immediate.STATUS.sent)

    def _reply(self, reply: Reply, asked_ns: int, now_ns: int) -> None:
        # In a third of cases the Pi reads late, up to 30 ms.
        late_s = LINK_S + self._rng.choice([0.0, 0.0, 0.03]) * self._rng.random()
        written_ns = now_ns + round(late_s * 1e9)
        reply = msgspec.structs.replace(reply, asked_ns=asked_ns, written_ns=written_ns)
        self._happen(written_ns, reply)

    def _happen(self, t_ns: int, what: Any) -> None:
        self.happenings.append(Happening(t_ns, what))
        give(self._bench, what, t_ns)


def make_bench(recorder: Recorder) -> Bench:
    bench = Bench()
    bench.stage.config = recorder.config
    bench.begin_and_home()
    bench.start(ROW, recorder.speed_mm_s)
    return bench


def give(bench: Bench, what: Any, t_ns: int) -> None:
    if what == "edge":
        bench.give_edge(t_ns)
    elif isinstance(what, str):
        bench.machine.command(what)
    elif what.kind == "done":
        bench.send_reply(msgspec.structs.replace(what, sequence=bench.stage.number))
    else:
        bench.send_reply(what)


def replay(recorder: Recorder, edges_ns: list[int]) -> m.RowFinished:
    """Replay the row with these edges instead of the true ones; return how it ends."""
    bench = make_bench(recorder)
    other_happenings = [h for h in recorder.happenings if h.what != "edge"]
    edges = [Happening(t_ns, "edge") for t_ns in edges_ns]
    for t_ns, happening in sorted([*other_happenings, *edges], key=lambda h: h.t_ns):
        if bench.machine.state not in ("running", "held"):
            break
        give(bench, happening, t_ns)
    if bench.machine.state in ("running", "held", "stopping"):
        bench.send_reply(Reply("alarm", number=StageError.STOPPED))
    bench.let_time_pass(2.0)
    return bench.list_events(m.RowFinished)[-1]


def draw_fault(rng: random.Random, recorder: Recorder, interval_ns: int) -> tuple[str, list[int]]:
    """Edges with a fault, and its kind."""
    edges = recorder.edges_ns
    kinds = ["lost", "spurious", "lost and spurious", "shifted", "one step late", "one step early", "late from here on"]
    kind = rng.choice(kinds)
    first_ns = edges[0]
    last_ns = edges[-1]
    # "One step" shifts the row by a point: the first edge is missing, and one follows the last, or the opposite. The
    # added edge has the right interval within 0.8 %, inside the tolerance of 1 %, so that only the place is wrong.
    if kind == "one step late":
        del edges[0]
        edges.append(last_ns + round(interval_ns * rng.uniform(0.992, 1.008)))
    elif kind == "one step early":
        del edges[-1]
        edges.append(first_ns - round(interval_ns * rng.uniform(0.992, 1.008)))
    elif kind == "late from here on":
        begin = rng.randrange(1, len(edges))
        # A shorter delay cannot be distinguished from a longer wait in a hold.
        late_ns = 50_000_000 + round(0.5 * interval_ns * rng.random())
        edges[begin:] = [t_ns + late_ns for t_ns in edges[begin:]]
    elif kind == "shifted":
        # From 2 %, twice the tolerance, to almost an interval.
        shift_ns = round(rng.choice([-1, 1]) * rng.uniform(0.02, 0.9) * interval_ns)
        edges[rng.randrange(len(edges))] += shift_ns
    if "lost" in kind:
        del edges[rng.randrange(len(edges))]
    if "spurious" in kind:
        edges.append(rng.randint(first_ns - 2 * interval_ns, last_ns + interval_ns))
    return kind, sorted(edges)


def are_equal(edges_ns: list[int], sound_ns: list[int], tolerance_ns: float) -> bool:
    """True if these are the sound edges within a tolerance."""
    pairs = zip(edges_ns, sound_ns, strict=False)
    return len(edges_ns) == len(sound_ns) and all(abs(edge - sound) <= tolerance_ns for edge, sound in pairs)


def has_no_hold_at_its_ends(recorder: Recorder) -> bool:
    """True if no hold was in the first or last interval: a wait there hides a shift of the first or last edge."""
    replies = [h.what for h in recorder.happenings if isinstance(h.what, Reply)]
    held_after = [int(r.fields["points"]) for r in replies if r.fields.get("state") == "hold"]
    return all(2 <= points <= POINTS - 2 for points in held_after)


def draw_holds(rng: random.Random, interval_s: float) -> list[tuple[float, float]]:
    """Draw one or two holds, each a time after the first point and a duration, seconds.

    Some are so short that the stage is to continue before it rests.
    """
    holds: list[tuple[float, float]] = []
    begin_s = 0.0
    for _ in range(rng.randint(1, 2)):
        begin_s += rng.uniform(0.0, 7.0) * interval_s
        rest_s = rng.choice([rng.uniform(0.01, 0.3), rng.uniform(0.5, 2.0)])
        holds.append((begin_s, rest_s))
        begin_s += rest_s + 0.5
    return holds


def record(speed_mm_s: float, accel_mm_s2: float, rng: random.Random, is_held: bool) -> Recorder:
    """Record a row, with holds in it if `is_held`."""
    while True:
        recorder = Recorder(speed_mm_s, accel_mm_s2, rng)
        recorder.run(draw_holds(rng, STEP_MM / speed_mm_s) if is_held else [])
        if has_no_hold_at_its_ends(recorder):
            return recorder


@pytest.mark.parametrize("is_held", [False, True])
@pytest.mark.parametrize(("speed_mm_s", "accel_mm_s2"), SPEEDS_AND_ACCELERATIONS)
def test_drawn_edge_faults_are_found(speed_mm_s, accel_mm_s2, is_held, request):
    """Rows with lost, spurious or shifted edges (by 2 % of the interval or more) are faults; others are `done`."""
    rows = 25 if request.config.getoption("--long") else 1
    rng = random.Random(speed_mm_s)
    interval_ns = round(STEP_MM / speed_mm_s * 1e9)
    for _ in range(rows):
        recorder = record(speed_mm_s, accel_mm_s2, rng, is_held)
        sound_ns = recorder.edges_ns
        assert len(sound_ns) == POINTS
        for _ in range(2):
            # The kernel stamps an edge some time after it, never before: up to 0.6 % of an interval.
            jittered_ns = [t_ns + round(rng.uniform(0.0, 0.006) * interval_ns) for t_ns in sound_ns]
            finished = replay(recorder, jittered_ns)
            assert finished.status == "done", finished
        for _ in range(20):
            kind, edges_ns = draw_fault(rng, recorder, interval_ns)
            # A spurious edge that happens to replace the lost one, just beyond the tolerance of 1 %, is no fault.
            if are_equal(edges_ns, sound_ns, 0.012 * interval_ns):
                continue
            finished = replay(recorder, edges_ns)
            assert finished.status == "fault", (kind, [t_ns - sound_ns[0] for t_ns in edges_ns])
            assert finished.fault in FAULTS, finished
            assert finished.reason


@pytest.mark.parametrize("early_hold_s", [0.01, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
def test_a_row_that_was_held_before_its_first_point_is_sound(early_hold_s):
    """The hold is in the travel to the row, where the stage may cross the row's places, or in the run-up."""
    recorder = Recorder(20, 200, random.Random(1))
    recorder.run([], early_hold_s)
    assert any(h.what.fields.get("state") == "hold" for h in recorder.happenings if isinstance(h.what, Reply))
    assert replay(recorder, recorder.edges_ns).status == "done"
