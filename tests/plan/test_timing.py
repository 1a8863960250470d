"""The estimated time of a scan equals the simulated stage's own clock, and adds up row by row."""

import msgspec
import numpy as np
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
    """The simulated stage with a clock of its own, homed and set up as by the Pi."""

    def __init__(self, rig: Instrument) -> None:
        stage = rig.stage
        steps_per_mm = stage.steps_per_mm
        self.board = PythonStage(Rig(steps_per_mm))
        self._sequence = 0
        self.command("HELLO")
        for parameter, value in (
            (Parameter.ACCEL, stage.accel_mm_s2 * steps_per_mm),
            # A minute, in which the stage needs no sign of life.
            (Parameter.HEARTBEAT, 60_000),
            (Parameter.TRAVEL_X, stage.travel_x_mm * steps_per_mm),
            (Parameter.TRAVEL_Y, stage.travel_y_mm * steps_per_mm),
            (Parameter.TRAVEL_SPEED, stage.travel_speed_mm_s * steps_per_mm),
            (Parameter.BACKLASH, stage.backlash_mm * steps_per_mm),
        ):
            self.command("SET", int(parameter), round(value))
        self.command("ENABLE", 1)
        self.time_motion("HOME")
        self.board.wires.clear()

    def command(self, verb: str, *args: int) -> None:
        self.board.replies.clear()
        self.board.receive(Command(self._sequence, verb, args).encode())
        self._sequence += 1
        assert self.board.replies.startswith(b"ok"), self.board.replies

    def time_motion(self, verb: str, *args: int) -> float:
        """Run a motion command; return its duration in seconds."""
        first_tick = self.board.tick
        self.command(verb, *args)
        while b"done" not in self.board.replies:
            assert b"alarm" not in self.board.replies, self.board.replies
            self.board.advance(self.board.tick + TICK_HZ // 1000, 0)
        return (self.board.tick - first_tick) / TICK_HZ


def time_scan(rig: Instrument) -> tuple[float, list[int]]:
    """Duration of the motion in a whole scan from the home corner, seconds, and the times of its triggers, ns."""
    stage = Stage(rig)
    total_s = 0.0
    for row in plan_raster(rig.grid):
        motion = RowMotion.plan(row, rig.stage, rig.stage.speed_mm_s)
        total_s += stage.time_motion("ROW", *motion.line)
    rising_edges_ns = [wire.t_ns for wire in stage.board.wires if isinstance(wire, WireEdge) and wire.value]
    return total_s, rising_edges_ns


@pytest.mark.parametrize(
    ("speed_mm_s", "step_x_mm", "step_y_mm", "accel_mm_s2", "backlash_mm"),
    [
        (20.0, 2.0, 2.0, 200.0, 0.0),
        (100.0, 2.0, 2.0, 200.0, 0.0),
        (60.0, 5.0, 10.0, 400.0, 0.0),
        (40.0, 2.0, 2.0, 200.0, 3.0),
        (40.0, 2.0, 6.0, 200.0, 3.0),
    ],
)
def test_the_estimate_is_the_time_of_the_simulated_stage(
    rig, speed_mm_s, step_x_mm, step_y_mm, accel_mm_s2, backlash_mm
):
    columns = 30
    rows = 5
    changes = PlanChanges(
        speed_mm_s=speed_mm_s,
        step_x_mm=step_x_mm,
        step_y_mm=step_y_mm,
        columns=columns,
        rows=rows,
        accel_mm_s2=accel_mm_s2,
    )
    rig = changes.apply(rig)
    rig = msgspec.structs.replace(rig, stage=msgspec.structs.replace(rig.stage, backlash_mm=backlash_mm))
    estimate = scan_time(rig, row_overhead_s=0.0)
    total_s, edges_ns = time_scan(rig)
    # A row has three legs: to its run-up, the row, and the stop after it. Ramps begin at some steps/s, not at rest,
    # and the clock is read every millisecond. Together these are 5 to 15 ms a leg (measured).
    legs = 3 * rows
    assert estimate.total_s - estimate.tail_s == pytest.approx(total_s, abs=0.02 * legs)
    assert len(edges_ns) == rows * columns
    edges_of_rows_ns = np.reshape(edges_ns, (rows, columns))
    measuring_ns = (edges_of_rows_ns[:, -1] - edges_of_rows_ns[:, 0]).sum()
    assert measuring_ns / 1e9 == pytest.approx(estimate.measuring_s, rel=1e-5)


def test_one_more_row_adds_its_motion_turn_overhead_and_tail(rig):
    """The overhead is the time that a row takes besides its motion, the tail a wait for the card's last packet."""
    overhead_s = 0.25
    time_of_10_rows = scan_time(PlanChanges(rows=10).apply(rig), overhead_s)
    time_of_11_rows = scan_time(PlanChanges(rows=11).apply(rig), overhead_s)
    one_row_s = row_motion_s(rig.grid, rig.stage) + turn_s(rig.grid, rig.stage) + overhead_s + tail_s(rig)
    # The first row is half a step nearer to the home corner, so that the stage reaches it sooner.
    approach_change_s = time_of_11_rows.approach_s - time_of_10_rows.approach_s
    assert time_of_11_rows.total_s - time_of_10_rows.total_s == pytest.approx(one_row_s + approach_change_s)


@settings(max_examples=50)
@given(distance_mm=st.floats(0.01, 800), speed_mm_s=st.floats(1, 100), accel_mm_s2=st.floats(10, 2000))
def test_a_move_takes_as_long_as_speed_and_acceleration_require_and_not_longer(distance_mm, speed_mm_s, accel_mm_s2):
    duration_s = straight_move_s(distance_mm, speed_mm_s, accel_mm_s2)
    at_full_speed_s = distance_mm / speed_mm_s
    # To the middle with full acceleration, then with full deceleration.
    without_speed_limit_s = 2 * (distance_mm / accel_mm_s2) ** 0.5
    assert duration_s >= at_full_speed_s
    assert duration_s >= without_speed_limit_s * (1 - 1e-12)
    assert duration_s <= at_full_speed_s + without_speed_limit_s


def test_a_row_of_whole_packets_has_no_wait_for_the_last_packet(rig):
    # 350 columns x 13 frames x 4096 bytes = 12,800 packets of 1456 bytes.
    rig_with_whole_packets = PlanChanges(pulses=13).apply(rig)
    assert 350 * 13 * 4096 % 1456 == 0
    assert fills_whole_packets(rig_with_whole_packets)
    assert tail_s(rig_with_whole_packets) == 0.0


def test_a_row_whose_last_packet_is_short_waits_for_it(rig):
    rig_with_short_packet = PlanChanges(pulses=16).apply(rig)
    assert not fills_whole_packets(rig_with_short_packet)
    # The card sends a short packet `CARD_TAIL_S` after the last pulse, which follows the row's last edge by 15 periods
    # of 1.5 ms. Meanwhile the stage runs out: half of what a row takes beyond its 698 mm at 20 mm/s.
    grid = rig_with_short_packet.grid
    run_out_s = (row_motion_s(grid, rig_with_short_packet.stage) - 698 / 20) / 2
    assert tail_s(rig_with_short_packet) == pytest.approx(CARD_TAIL_S + 15 * 1.5e-3 - run_out_s)
