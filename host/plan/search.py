"""Plans that differ from the rig file, and the best of them within a time.

`Changes` is what a plan has otherwise than the rig file; `rig_lines` writes the differences as lines of a rig file.
`propose` tries speeds, steps and bursts, and keeps the aperture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import msgspec
import numpy as np

from polysight.host.plan.forecast import (
    MAX_STEPS_PER_S,
    Caution,
    Forecast,
    Noise,
    burst_facts,
    cautions,
    forecast,
    noise_facts,
)
from polysight.host.plan.timing import ROW_OVERHEAD_S, payload_bytes, scan_time
from polysight.host.radar import INTER_FRAME_US, TRIGGER_MARGIN_US, chirp_us
from polysight.shared.config import Instrument
from polysight.shared.errors import ConfigError
from polysight.shared.tables import decode, to_builtins

ON_THE_PI = ("speed_mm_s", "accel_mm_s2")
"""Of [stage]: the Pi drives with its own rig file's acceleration, and refuses speeds above that file's."""
_MULTIPLES = (1, 2, 3, 4, 5)  # of the rig file's steps
_MARGIN = 0.95  # of the time between two points that a burst may fill
_MOST_TRAVEL_WAVELENGTHS = 0.5
MAX_FRAMES = 65535
"""Of a row, that a radar counts (host/radar/constraints.py)."""


@dataclass(frozen=True)
class Changes:
    """What a plan has otherwise than the rig file; None leaves the rig file's.

    A new step keeps the aperture's size, as near as whole steps come to it, unless the number of positions or a size is
    given too.
    """

    speed_mm_s: float | None = None
    pulses: int | None = None
    period_us: float | None = None
    step_x_mm: float | None = None
    step_y_mm: float | None = None
    columns: int | None = None
    rows: int | None = None
    width_mm: float | None = None
    height_mm: float | None = None
    accel_mm_s2: float | None = None
    object_distance_mm: float | None = None

    def apply(self, rig: Instrument) -> Instrument:
        """The rig file with these numbers.

        Raises
        ------
        ConfigError
            when a number breaks a rule of the rig file.
        """
        table = to_builtins(rig)
        grid = table["grid"]
        for axis, count, size in (("x", "columns", self.width_mm), ("y", "rows", self.height_mm)):
            step = f"step_{axis}_mm"
            extent = (grid[count] - 1) * grid[step] if size is None else size
            grid[step] = getattr(self, step) or grid[step]
            grid[count] = getattr(self, count) or 1 + round(extent / grid[step])
        for section, key in (
            ("stage", "speed_mm_s"),
            ("stage", "accel_mm_s2"),
            ("burst", "pulses"),
            ("burst", "period_us"),
            ("geometry", "object_distance_mm"),
        ):
            value = getattr(self, key)
            if value is not None:
                table[section][key] = value
        return decode(table, Instrument, f"{rig.name}, changed")


def rig_lines(plan: Instrument, begun_with: Instrument) -> str:
    """The lines that make a plan of the rig file it began with: every number that differs; "" when none does."""
    new, old = to_builtins(plan), to_builtins(begun_with)
    parts = []
    for section, keys in new.items():
        if not isinstance(keys, dict):
            continue
        lines = [f"{key} = {value}" for key, value in keys.items() if value != old[section].get(key)]
        if section == "stage" and any(old[section][key] != keys[key] for key in ON_THE_PI):
            lines.append("# speed_mm_s and accel_mm_s2: into the Pi's rig file too, then restart polysight-pi there")
        if lines:
            parts.append("\n".join([f"[{section}]", *lines, ""]))
    return "\n".join(parts)


def shortest_period_us(rig: Instrument) -> float:
    """Shortest pulse period that the radars take (host/radar/constraints.py), up to the next 10 us."""
    return 10 * float(np.ceil((chirp_us(rig) + INTER_FRAME_US + TRIGGER_MARGIN_US) / 10))


def propose(
    rig: Instrument,
    minutes: float,
    count: int = 5,
    noise: Noise | None = None,
    row_overhead_s: float = ROW_OVERHEAD_S,
    scene_mm: tuple[float, float] | None = None,
) -> list[Forecast]:
    """The plans with the least noise in the image that take no longer and have no aliases, best first.

    For each pair of steps the best speed and burst; the aperture stays as large as the rig file's. Bursts never take
    more than half a wavelength of travel.

    Parameters
    ----------
    rig
        Rig file, with what shall not be changed.
    minutes
        Time there is, homing not included.
    count
        Plans wanted; fewer, or none, where the time is too short.
    noise, row_overhead_s, scene_mm
        As for :func:`polysight.host.plan.forecast`.
    """
    noise = noise or Noise()
    best: list[tuple[float, Instrument]] = []
    for changed in _grids(rig):
        tried = [(_score(p, noise), p) for p in _bursts(changed, minutes, row_overhead_s)]
        if tried:
            best.append(max(tried, key=lambda t: t[0]))
    best.sort(key=lambda t: -t[0])
    good = (p for _, p in best if not any(_rules_out(w) for w in cautions(p, noise, scene_mm)))
    return [forecast(p, noise, row_overhead_s, scene_mm) for p in islice(good, count)]


def _rules_out(caution: Caution) -> bool:
    return caution.refused or caution.topic == "aliasing"


def _score(rig: Instrument, noise: Noise) -> float:
    return noise_facts(rig, noise).image_db - burst_facts(rig).edge_loss_db


def _grids(rig: Instrument) -> Iterator[Instrument]:
    """The rig file with other steps."""
    for nx in _MULTIPLES:
        for ny in _MULTIPLES:
            steps = Changes(step_x_mm=nx * rig.grid.step_x_mm, step_y_mm=ny * rig.grid.step_y_mm)
            try:
                yield steps.apply(rig)
            except ConfigError:
                continue  # whole steps make this aperture larger than the travel


def _bursts(rig: Instrument, minutes: float, row_overhead_s: float) -> Iterator[Instrument]:
    """As many pulses as travel and time to the next position allow, at the slowest speed that keeps the time.

    At the rig's period and the radars' shortest; all that fit, and as many as make a row whole packets. A burst of
    frames of many chirps stays as it is.
    """
    if rig.burst.chirps > 1:
        for speed in _speeds(rig, minutes):
            plan = _with(rig, speed, rig.burst.pulses, rig.burst.period_us)
            fits = _most_pulses(plan) >= rig.burst.pulses
            if fits and scan_time(plan, row_overhead_s).minutes <= minutes:
                yield plan
                return
        return
    for period in {rig.burst.period_us, min(rig.burst.period_us, shortest_period_us(rig))}:
        for whole in (False, True):
            for speed in _speeds(rig, minutes):
                plan = _with(rig, speed, 2, period)
                pulses = _most_pulses(plan)
                if whole:
                    pulses = next((n for n in range(pulses, 1, -1) if _whole(plan, n)), 0)
                if pulses < 2:
                    break
                plan = _with(rig, speed, pulses, period)
                if scan_time(plan, row_overhead_s).minutes <= minutes:
                    yield plan
                    break


def _with(rig: Instrument, speed_mm_s: float, pulses: int, period_us: float) -> Instrument:
    """Another speed and burst, quickly: that they keep the rig file's rules is known."""
    stage = msgspec.structs.replace(rig.stage, speed_mm_s=speed_mm_s)
    burst = msgspec.structs.replace(rig.burst, pulses=pulses, period_us=period_us)
    return msgspec.structs.replace(rig, stage=stage, burst=burst)


def _most_pulses(rig: Instrument) -> int:
    fits = _MARGIN * 1e6 * rig.grid.step_x_mm / rig.stage.speed_mm_s / rig.burst.period_us
    travel = burst_facts(rig).travel_wavelengths
    still = 1 + _MOST_TRAVEL_WAVELENGTHS * (rig.burst.chirps_a_position - 1) / travel
    return min(int(fits), int(still), MAX_FRAMES // rig.grid.columns)


def _whole(rig: Instrument, pulses: int) -> bool:
    return pulses * rig.grid.columns * rig.frame_bytes % payload_bytes(rig) == 0


def _speeds(rig: Instrument, minutes: float) -> Iterator[float]:
    """Whole speeds, ascending, from one that might keep the time to what stage and travel allow."""
    length = (rig.grid.columns - 1) * rig.grid.step_x_mm
    slowest = max(1, int(rig.grid.rows * length / (60 * minutes)))
    for speed in range(slowest, int(MAX_STEPS_PER_S / rig.stage.steps_per_mm) + 1):
        at = msgspec.structs.replace(rig.stage, speed_mm_s=float(speed))
        if not at.misfit(rig.grid):
            yield float(speed)
