"""SYNC_IN of the simulated radars: the pulses that start frames, and the stage's position at each."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, strategies as st
from tests.support.rigs import load_published_rig

from polysight_shared.raster import plan_raster
from polysight_shared.wires import WireMotion
from polysight_simulators.cards.sync_in import Pulse, StageTrack, SyncInput
from polysight_simulators.scene import SimulatedRig, decode_scene, row_offsets_mm

RIG = load_published_rig()
# Shortest time between two frames: the ramp, 128.5 us, and 150 us.
DEAD_NS = 128_500 + 150_000


def make_pulses(times: list[int]) -> list[Pulse]:
    return [Pulse(i, t) for i, t in enumerate(times)]


@given(st.lists(st.integers(0, 600_000), max_size=40))
def test_frames_never_start_closer_than_the_radar_can_and_every_other_pulse_is_counted(gaps: list[int]) -> None:
    times = list(np.cumsum(gaps, dtype=int))
    sync = SyncInput(RIG)
    started = sync.select_starting(make_pulses(times))
    assert all(b.t_ns - a.t_ns >= DEAD_NS for a, b in pairwise(started))
    assert len(started) + sync.too_soon == len(times)


def test_the_stage_is_where_its_last_motion_line_before_the_pulse_puts_it() -> None:
    track = StageTrack(RIG)
    # From 1 s on it moves at 20 mm/s from x = 100 mm; from 3 s on it rests at 140 mm, 2 mm higher in y.
    track.add(WireMotion(t_ns=1_000_000_000, x_um=100_000, y_um=250_000, vx_um_s=20_000))
    track.add(WireMotion(t_ns=3_000_000_000, x_um=140_000, y_um=252_000, vx_um_s=0))
    assert not track.moving
    # Offsets are relative to the middle of the stage, (400, 250) mm.
    x, y = track.offsets_mm([1_000_000_000, 2_000_000_000, 2_999_999_999, 4_000_000_000])
    assert x == pytest.approx([-300.0, -280.0, -260.0, -260.0], abs=1e-6)
    assert y == pytest.approx([0.0, 0.0, 0.0, 2.0])


def test_without_burst_motion_all_pulses_of_a_burst_are_at_its_middle() -> None:
    moving = StageTrack(RIG)
    frozen = StageTrack(RIG, burst_motion=False)
    trigger = 1_000_000_000
    # As the Pi sends them: 0.2 ms after the trigger, 1.5 ms apart.
    times = [trigger + 200_000 + k * 1_500_000 for k in range(16)]
    for track in (moving, frozen):
        track.add(WireMotion(t_ns=0, x_um=400_000, y_um=250_000, vx_um_s=20_000))
        track.trigger(trigger)
        # The next trigger may be known already.
        track.trigger(trigger + 100_000_000)
    x, _ = moving.offsets_mm(times)
    frozen_x_mm, _ = frozen.offsets_mm(times)
    # 15 periods of 1.5 ms at 20 mm/s
    assert np.ptp(x) == pytest.approx(15 * 1.5e-3 * 20)
    assert np.ptp(frozen_x_mm) == 0.0
    assert frozen_x_mm[0] == pytest.approx(np.mean(x))


@pytest.mark.parametrize("disturbances", [{}, {"backlash_mm": 0.3}, {"backlash_mm": -2.5, "burst_motion": False}])
def test_the_cards_and_a_simulated_scan_have_the_same_positions_of_a_row(disturbances: dict[str, object]) -> None:
    radar = SimulatedRig(RIG, decode_scene({"name": "t"}, "t").with_disturbances(**disturbances))
    d = radar.scene.disturbances
    for index in (10, 11):
        row = plan_raster(RIG.grid).row(index)
        track = StageTrack(RIG, d.burst_motion, d.backlash_mm)
        bursts = [make_burst_at_point(track, index, row.column(i), 10**9 + i * 10**8) for i in range(row.points)]
        sent = [pulse for burst in bursts for pulse in burst]
        offsets_mm = track.offsets_mm([pulse.t_ns for pulse in sent])
        # The stage reports its position in micrometres.
        for card_mm, scan_mm in zip(offsets_mm, row_offsets_mm(radar, row), strict=True):
            np.testing.assert_allclose(card_mm, scan_mm, atol=1e-3)
        first = index * row.points * RIG.burst.pulses
        assert [p.number for p in track.number_by_plan(sent)] == list(range(first, first + len(sent)))


def make_burst_at_point(track: StageTrack, row: int, column: int, t_ns: int) -> list[Pulse]:
    """Let the stage raise its trigger at a point of the plan; return the pulses of its burst, with any numbers."""
    plan = plan_raster(RIG.grid)
    centre = (RIG.stage.centre_x_mm, RIG.stage.centre_y_mm)
    x = (column - (plan.columns - 1) / 2) * plan.step_x_mm + centre[0]
    y = plan.row(row).y_mm + centre[1]
    track.add(
        WireMotion(
            t_ns=t_ns,
            x_um=round(1000 * x),
            y_um=round(1000 * y),
            vx_um_s=plan.row(row).direction * 20_000,
        )
    )
    track.trigger(t_ns)
    return [Pulse(10**6 + k, t_ns + 200_000 + k * 1_500_000) for k in range(RIG.burst.pulses)]


@given(st.integers(0, RIG.grid.rows - 1), st.integers(0, RIG.grid.columns - 1), st.integers(0, 10**12))
def test_the_number_of_a_pulse_depends_on_its_position_and_not_on_its_time(row: int, column: int, t_ns: int) -> None:
    # Odd rows run backwards.
    point = column if row % 2 == 0 else RIG.grid.columns - 1 - column
    first = (row * RIG.grid.columns + point) * RIG.burst.pulses
    track = StageTrack(RIG)
    for base_ns in (0, 10**11):
        numbered = track.number_by_plan(make_burst_at_point(track, row, column, t_ns + base_ns))
        assert [p.number for p in numbered] == list(range(first, first + RIG.burst.pulses))
