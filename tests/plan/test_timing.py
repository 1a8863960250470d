"""The estimated time of a scan equals the simulated stage's own clock, and adds up row by row."""

import msgspec
import pytest
from hypothesis import given, settings, strategies as st

from polysight.planning import PlanChanges, row_motion_s, scan_time, straight_move_s
from polysight.planning.forecast import fills_whole_packets, tail_s, turn_s
from polysight_pi.edges import RowMotion
from polysight_shared.config import CARD_TAIL_S, Instrument
from polysight_shared.raster import plan_raster
from polysight_shared.stage_line import Command, Parameter
from polysight_shared.wires import WireEdge
from polysight_simulators.stage import TICK_HZ, PythonStage, Rig


class Stage:
    """The simulated stage in virtual time, homed and set up as by the Pi."""

    def __init__(self, rig: Instrument) -> None:
        stage = rig.stage
        steps_per_mm = stage.steps_per_mm
        self.board = PythonStage(Rig(steps_per_mm))
        self._sequence = 0
        self.command("HELLO")
        for parameter, value in (
            (Parameter.ACCEL, stage.accel_mm_s2 * steps_per_mm),
            # A minute, so that the test need not send any.
            (Parameter.HEARTBEAT, 60_000),
            (Parameter.TRAVEL_X, stage.travel_x_mm * steps_per_mm),
            (Parameter.TRAVEL_Y, stage.travel_y_mm * steps_per_mm),
            (Parameter.TRAVEL_SPEED, stage.travel_speed_mm_s * steps_per_mm),
            (Parameter.BACKLASH, stage.backlash_mm * steps_per_mm),
        ):
            self.command("SET", int(parameter), round(value))
        self.command("ENABLE", 1)
        self.seconds("HOME")
        self.board.wires.clear()

    def command(self, verb: str, *args: int) -> None:
        self.board.replies.clear()
        self.board.receive(Command(self._sequence, verb, args).encode())
        self._sequence += 1
        assert self.board.replies.startswith(b"ok"), self.board.replies

    def seconds(self, verb: str, *args: int) -> float:
        """Duration of a motion command."""
        began = self.board.tick
        self.command(verb, *args)
        while b"done" not in self.board.replies:
            assert b"alarm" not in self.board.replies, self.board.replies
            self.board.advance(self.board.tick + TICK_HZ // 1000, 0)
        return (self.board.tick - began) / TICK_HZ


def time_scan(rig: Instrument) -> tuple[float, list[int]]:
    """Motion of a whole scan from the home corner, seconds, and the times of its triggers, ns."""
    stage = Stage(rig)
    total = sum(
        stage.seconds("ROW", *RowMotion.plan(row, rig.stage, rig.stage.speed_mm_s).line)
        for row in plan_raster(rig.grid)
    )
    edges = [w.t_ns for w in stage.board.wires if isinstance(w, WireEdge) and w.value]
    return total, edges


@pytest.mark.parametrize(
    ("speed", "step_x", "step_y", "accel", "backlash"),
    [
        (20.0, 2.0, 2.0, 200.0, 0.0),
        (100.0, 2.0, 2.0, 200.0, 0.0),
        (60.0, 5.0, 10.0, 400.0, 0.0),
        (40.0, 2.0, 2.0, 200.0, 3.0),
        (40.0, 2.0, 6.0, 200.0, 3.0),
    ],
)
def test_the_estimate_is_the_time_of_the_simulated_stage(rig, speed, step_x, step_y, accel, backlash):
    rig = PlanChanges(
        speed_mm_s=speed, step_x_mm=step_x, step_y_mm=step_y, columns=30, rows=5, accel_mm_s2=accel
    ).apply(rig)
    rig = msgspec.structs.replace(rig, stage=msgspec.structs.replace(rig.stage, backlash_mm=backlash))
    estimate = scan_time(rig, 0.0)
    total, edges = time_scan(rig)
    # A row has three legs: to its run-up, the row, and the stop after it. Ramps begin at some steps/s, not at rest,
    # and the clock is read every millisecond. Together these are a few ms a leg, and 20 ms at most.
    legs = 3 * rig.grid.rows
    assert estimate.total_s - estimate.tail_s == pytest.approx(total, abs=0.02 * legs)
    assert len(edges) == rig.grid.rows * rig.grid.columns
    first_edges = edges[:: rig.grid.columns]
    last_edges = edges[rig.grid.columns - 1 :: rig.grid.columns]
    measuring_ns = sum(last - first for first, last in zip(first_edges, last_edges, strict=True))
    assert measuring_ns / 1e9 == pytest.approx(estimate.measuring_s, rel=1e-5)


def test_one_more_row_adds_its_motion_turn_overhead_and_tail(rig):
    # Chosen time that a row takes besides its motion.
    overhead_s = 0.25
    ten = scan_time(PlanChanges(rows=10).apply(rig), overhead_s)
    eleven = scan_time(PlanChanges(rows=11).apply(rig), overhead_s)
    one_row_s = row_motion_s(rig.grid, rig.stage) + turn_s(rig.grid, rig.stage) + overhead_s + tail_s(rig)
    # The first row is half a step nearer to the corner, which the stage reaches sooner.
    approach_change_s = eleven.approach_s - ten.approach_s
    assert eleven.total_s - ten.total_s == pytest.approx(one_row_s + approach_change_s)


@settings(max_examples=50)
@given(st.floats(0.01, 800), st.floats(1, 100), st.floats(10, 2000))
def test_moves_take_no_less_than_at_full_speed_and_no_less_than_acceleration_allows(distance, speed, accel):
    duration_s = straight_move_s(distance, speed, accel)
    at_full_speed_s = distance / speed
    # To the middle with full acceleration, then with full deceleration.
    without_speed_limit_s = 2 * (distance / accel) ** 0.5
    assert duration_s >= at_full_speed_s
    assert duration_s >= without_speed_limit_s * (1 - 1e-12)
    assert duration_s <= at_full_speed_s + without_speed_limit_s


def test_a_row_of_whole_packets_has_no_wait_for_the_last_packet(rig):
    # 350 columns x 13 frames x 4096 bytes = 12,800 packets of 1456 bytes.
    whole_rig = PlanChanges(pulses=13).apply(rig)
    rig_with_short_packet = PlanChanges(pulses=16).apply(rig)
    assert fills_whole_packets(whole_rig)
    assert not fills_whole_packets(rig_with_short_packet)
    assert tail_s(whole_rig) == 0.0
    # The card sends a short packet `CARD_TAIL_S` after the last pulse, which follows the row's last edge by 15 periods
    # of 1.5 ms. Meanwhile the stage runs out: half of what a row takes beyond its 698 mm at 20 mm/s.
    grid = rig_with_short_packet.grid
    run_out_s = (row_motion_s(grid, rig_with_short_packet.stage) - 698 / 20) / 2
    assert tail_s(rig_with_short_packet) == pytest.approx(CARD_TAIL_S + 15 * 1.5e-3 - run_out_s)
