"""Decide which SYNC_IN edges start a frame, and where the stage is then."""

from bisect import bisect_right
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polysight_shared.config import Instrument
from polysight_shared.raster import burst_middle_s, plan_raster
from polysight_shared.units import us_to_ns
from polysight_shared.wires import WireMotion
from polysight_simulators.radars import RadarBoard

# Shortest time between the end of a frame and the next SYNC_IN pulse (AWR2243, hardware trigger: TI mmWave Radar
# Interface Control, page 93).
RECOVERY_US = 150.0
# Number of motion lines, and of triggers, that are kept at least; the oldest are removed at twice this number; chosen.
_KEPT_LINES = 4096


class Pulse(NamedTuple):
    """One SYNC_IN pulse: its number since power-up, and the wire time of its rising edge."""

    number: int
    t_ns: int


class SyncInput:
    """SYNC_IN of one radar: each rising edge starts a frame, unless it comes too soon, or the radar is not armed.

    With `radar.control = "line_server"`, :meth:`arm` arms the radar for the frames of one row; with "native", the
    simulated board decides; otherwise the radar is always armed. `rearmed` counts how often it was armed, `unarmed` and
    `too_soon` the pulses that started no frame.
    """

    def __init__(self, rig: Instrument, radar: RadarBoard | None = None) -> None:
        self._radar = radar
        self._row_frames = rig.grid.columns * rig.burst.pulses
        self._frames_left: int | None = 0 if rig.radar.control == "line_server" else None
        self.rearmed = 0
        self.unarmed = 0
        last_chirp_us = (rig.burst.chirps - 1) * rig.burst.chirp_us
        self._dead_ns = us_to_ns(last_chirp_us + rig.chirp.ramp_end_us + RECOVERY_US)
        self._last_ns: int | None = None
        self.too_soon = 0

    def arm(self) -> None:
        """Arm the radar for the pulses of one row, whatever number of frames the row before has left."""
        self._frames_left = self._row_frames
        self.rearmed += 1

    def select_starting(self, pulses: list[Pulse]) -> list[Pulse]:
        """Return the pulses that start a frame; count the others as `too_soon` (a real radar faults) or `unarmed`."""
        if self._radar is not None:
            return self._trigger_board(self._radar, pulses)
        started = []
        for pulse in pulses:
            if self._frames_left == 0:
                self.unarmed += 1
                continue
            # A time that jumps back by more than the dead time is of a new wire clock: the stage restarted.
            if self._last_ns is not None and abs(pulse.t_ns - self._last_ns) < self._dead_ns:
                self.too_soon += 1
                continue
            self._last_ns = pulse.t_ns
            if self._frames_left is not None:
                self._frames_left -= 1
            started.append(pulse)
        return started

    def _trigger_board(self, radar: RadarBoard, pulses: list[Pulse]) -> list[Pulse]:
        """Return the pulses at which the simulated board starts a frame; count the others."""
        started = []
        for pulse in pulses:
            armed = radar.ready_for_triggers
            if radar.trigger(pulse.t_ns * 1e-9):
                started.append(pulse)
            elif armed:
                self.too_soon += 1
            else:
                self.unarmed += 1
        self.rearmed = radar.armings
        return started


class StageTrack:
    """Position of the stage at any wire time, from its motion lines: x(t) = x + vx (t - t_line).

    Parameters
    ----------
    burst_motion
        False places all pulses of a burst at the burst's middle, as if the stage stood still.
    backlash_mm
        Offset along +x from the reported position while the stage moves towards -x.
    """

    def __init__(self, rig: Instrument, burst_motion: bool = True, backlash_mm: float = 0.0) -> None:
        self._backlash_mm = backlash_mm
        if burst_motion:
            self._middle_ns = None
        else:
            self._middle_ns = round(burst_middle_s(rig.burst) * 1e9)
        self._plan = plan_raster(rig.grid)
        self._burst = rig.burst
        self._triggers: list[int] = []
        self._centre_mm = (rig.stage.centre_x_mm, rig.stage.centre_y_mm)
        self._lines: list[WireMotion] = []
        self._line_times: list[int] = []

    def add(self, motion: WireMotion) -> None:
        """Add one motion line; a time before the last line's means that the stage's clock restarted."""
        if self._lines and motion.t_ns < self._lines[-1].t_ns:
            self._lines.clear()
            self._line_times.clear()
        self._lines.append(motion)
        self._line_times.append(motion.t_ns)
        if len(self._lines) > 2 * _KEPT_LINES:
            del self._lines[:_KEPT_LINES]
            del self._line_times[:_KEPT_LINES]

    def trigger(self, t_ns: int) -> None:
        """Record a trigger of the stage."""
        if self._triggers and t_ns < self._triggers[-1]:
            self._triggers.clear()
        self._triggers.append(t_ns)
        if len(self._triggers) > 2 * _KEPT_LINES:
            del self._triggers[:_KEPT_LINES]

    @property
    def moving(self) -> bool:
        """True if the stage moves along x by its last motion line."""
        return bool(self._lines) and self._lines[-1].vx_um_s != 0

    def number_by_plan(self, pulses: list[Pulse]) -> list[Pulse]:
        """Return the pulses with new numbers, by their place in the plan: row, point and pulse of the burst.

        The numbers count in the order of a scan, so that a retaken row has the same ones. A pulse that belongs to no
        point keeps its number.
        """
        renumbered: list[Pulse] = []
        edge_ns = -1
        first = None
        for pulse in pulses:
            trigger_count = bisect_right(self._triggers, pulse.t_ns)
            if trigger_count and self._triggers[trigger_count - 1] != edge_ns:
                edge_ns = self._triggers[trigger_count - 1]
                first = self._find_first_pulse(edge_ns)
            pulse_of_burst = (pulse.t_ns - edge_ns) // us_to_ns(self._burst.period_us)
            if trigger_count and first is not None and pulse_of_burst < self._burst.pulses:
                pulse = pulse._replace(number=first + pulse_of_burst)
            renumbered.append(pulse)
        return renumbered

    def _find_first_pulse(self, edge_ns: int) -> int | None:
        """Return the number of the first pulse of the point with this trigger; None outside the plan."""
        plan = self._plan
        x, y, _ = self._read_reported_mm([edge_ns])
        column = round(x[0] / plan.step_x_mm + (plan.columns - 1) / 2)
        row = round(y[0] / plan.step_y_mm + (plan.rows - 1) / 2)
        if not (0 <= column < plan.columns and 0 <= row < plan.rows):
            return None
        # The order of columns in a row is its own inverse.
        point = plan.row(row).column(column)
        return (row * plan.columns + point) * self._burst.pulses

    def offsets_mm(self, t_ns: list[int]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return stage offsets from the grid's middle, x_mm [n] and y_mm [n], at wire times; 0 while unknown."""
        x, y, backwards = self._read_reported_mm(t_ns)
        return x + self._backlash_mm * backwards, y

    def _read_reported_mm(self, t_ns: list[int]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
        """Return the reported offsets, and bool [n], True while the stage moves towards -x."""
        x = np.zeros(len(t_ns))
        y = np.zeros(len(t_ns))
        backwards = np.zeros(len(t_ns), np.bool_)
        if not self._lines:
            return x, y, backwards
        for i, pulse_ns in enumerate(t_ns):
            t = pulse_ns
            if self._middle_ns is not None and (trigger_count := bisect_right(self._triggers, t)):
                t = self._triggers[trigger_count - 1] + self._middle_ns
            line = self._lines[max(0, bisect_right(self._line_times, t) - 1)]
            moved_um = line.vx_um_s * max(0, t - line.t_ns) * 1e-9
            x[i] = (line.x_um + moved_um) * 1e-3 - self._centre_mm[0]
            y[i] = line.y_um * 1e-3 - self._centre_mm[1]
            backwards[i] = line.vx_um_s < 0
        return x, y, backwards
