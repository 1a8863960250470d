"""Held rows: edges of the simulated stage (the arithmetic of the sketch), judged by the rig file."""

from __future__ import annotations

import random

import pytest

from polysight_pi.edges import EdgeTimes
from polysight_shared.raster import Row, Stage
from polysight_shared.stage_line import Command, Immediate
from polysight_shared.wires import WireEdge
from polysight_simulators.stage.motion import TICK_HZ
from polysight_simulators.stage.python_stage import PythonStage, Rig

POINTS = 30
STEP_MM = 2.0
SPEEDS_AND_ACCELERATIONS = [(20, 200), (60, 200), (20, 100), (100, 400)]


class SimulatedRow:
    """A row of the simulated stage, in virtual time."""

    def __init__(self, speed_mm_s: int, accel_mm_s2: int) -> None:
        self._stage = PythonStage(Rig())
        self._sequence = self._tick = 0
        for verb, *args in (("HELLO",), ("SET", 0, accel_mm_s2 * 200), ("SET", 1, 60_000), ("ENABLE", 1), ("HOME",)):
            self._send(str(verb), *map(int, args))
        self._go_on_until(lambda: b"done" in self._stage.replies)
        self._stage.wires.clear()
        self._stage.replies.clear()
        self._send("ROW", 20_000, round(STEP_MM * 200), POINTS, 0, speed_mm_s * 200)

    def _send(self, verb: str, *args: int) -> None:
        self._stage.receive(Command(self._sequence, verb, args).encode())
        self._sequence += 1

    def _go_on_until(self, is_over) -> None:
        while not is_over():
            self._tick += 2_000
            self._stage.advance(self._tick, self._tick // 2_000)

    def _pass_points(self, points: int) -> None:
        self._go_on_until(lambda: len(self.edges_ns) >= points)

    @property
    def edges_ns(self) -> list[int]:
        return [w.t_ns for w in self._stage.wires if isinstance(w, WireEdge) and w.value]

    def run(self, hold_after: int, wait_s: float, rest_s: float) -> list[int]:
        """Hold some time after this point, resume after a rest; return the times of all edges."""
        self._pass_points(hold_after)
        for seconds, byte in ((wait_s, Immediate.HOLD), (rest_s, Immediate.RESUME)):
            end = self._tick + round(seconds * TICK_HZ)
            self._go_on_until(lambda: self._tick >= end)  # noqa: B023
            self._stage.receive(byte.sent)
        self._go_on_until(lambda: b"done" in self._stage.replies)
        return self.edges_ns


def judge(edges_ns: list[int], speed_mm_s: int, accel_mm_s2: int) -> str:
    times = EdgeTimes(Row(0, 0.0, 0.0, STEP_MM, POINTS), Stage("none", accel_mm_s2=accel_mm_s2), speed_mm_s)
    times.holds = 1
    wrong = [text for edge_ns in edges_ns if (text := times.note(edge_ns))]
    return wrong[0] if wrong else times.judge_holds()


@pytest.mark.parametrize(("speed_mm_s", "accel_mm_s2"), SPEEDS_AND_ACCELERATIONS)
def test_a_held_row_is_sound_and_a_moved_edge_beside_the_hold_is_found(speed_mm_s, accel_mm_s2, request):
    rng = random.Random(speed_mm_s)
    nominal_s = STEP_MM / speed_mm_s
    for _ in range(100 if request.config.getoption("--long") else 3):
        hold_after = rng.randint(1, 15)
        rest_s = rng.choice([rng.uniform(0.01, 0.2), rng.uniform(0.3, 2.0)])
        edges_ns = SimulatedRow(speed_mm_s, accel_mm_s2).run(hold_after, rng.uniform(0.0, nominal_s), rest_s)
        assert len(edges_ns) == POINTS
        assert judge(edges_ns, speed_mm_s, accel_mm_s2) == ""
        moved = rng.randrange(hold_after + 12, POINTS - 1)  # at 100 mm/s the ramps cover 12 points
        shifted_ns = list(edges_ns)
        shifted_ns[moved] += round(rng.choice([-1, 1]) * rng.uniform(0.02, 0.5) * nominal_s * 1e9)
        assert judge(shifted_ns, speed_mm_s, accel_mm_s2) != ""
        doubled_ns = sorted([*edges_ns[:moved], *edges_ns[moved + 1 :], rng.randint(edges_ns[0], edges_ns[-1])])
        assert judge(doubled_ns, speed_mm_s, accel_mm_s2) != ""
