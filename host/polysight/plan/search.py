"""Search for the best plans within a time, and describe how plans differ from the rig file.

`Changes` holds the values of a plan that differ from the rig file; `rig_lines` writes them as lines for a rig file.
`propose` varies speed, steps and burst, and keeps the aperture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import msgspec
import numpy as np

from polysight.plan.forecast import (
    MAX_STEPS_PER_S,
    Forecast,
    Noise,
    PlanWarning,
    find_warnings,
    forecast,
    predict_burst,
    predict_noise,
)
from polysight.plan.timing import ROW_OVERHEAD_S, scan_time, whole_packets
from polysight.radar import INTER_FRAME_US, TRIGGER_MARGIN_US, chirp_us
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError
from polysight_shared.tables import decode, to_builtins

# Keys of [stage] that the Pi takes from its own rig file: acceleration, and the limit of the speed.
_PI_KEYS = ("speed_mm_s", "accel_mm_s2")
_STEP_MULTIPLES = (1, 2, 3, 4, 5)  # of the rig file's steps
_MAX_DUTY = 0.95  # of a burst in the time between two points
_MAX_TRAVEL_WAVELENGTHS = 0.5
_MAX_FRAMES = 65535  # of a row (host/polysight/radar/commands.py)


@dataclass(frozen=True)
class Changes:
    """Values of a plan that replace those of the rig file; None keeps the rig file's value.

    A new step keeps the size of the aperture, rounded to whole steps, if neither a number of positions nor a size is
    given.
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
        """Return the changed rig file. Raises ConfigError if a value breaks a rule of the rig file."""
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


def rig_lines(plan: Instrument, original: Instrument) -> str:
    """Return the lines of the rig file that differ between `plan` and `original`; "" if none differs."""
    new, old = to_builtins(plan), to_builtins(original)
    parts = []
    for section, keys in new.items():
        if not isinstance(keys, dict):
            continue
        lines = [f"{key} = {value}" for key, value in keys.items() if value != old[section].get(key)]
        if section == "stage" and any(old[section][key] != keys[key] for key in _PI_KEYS):
            lines.append("# set speed_mm_s and accel_mm_s2 also in the Pi's rig file, then restart polysight-pi there")
        if lines:
            parts.append("\n".join([f"[{section}]", *lines, ""]))
    return "\n".join(parts)


def shortest_period_us(rig: Instrument) -> float:
    """Return the shortest pulse period of the radars (host/polysight/radar/commands.py), rounded up to 10 us."""
    return 10 * float(np.ceil((chirp_us(rig) + INTER_FRAME_US + TRIGGER_MARGIN_US) / 10))


def propose(
    rig: Instrument,
    minutes: float,
    count: int = 5,
    noise: Noise | None = None,
    row_overhead_s: float = ROW_OVERHEAD_S,
    scene_mm: tuple[float, float] | None = None,
) -> list[Forecast]:
    """Search for the plans with the least noise in the image within a time and without aliases, best first.

    Each plan has the best speed and burst for its pair of steps, and the rig file's aperture. The stage moves at most
    half a wavelength during a burst. At most `count` plans; fewer, or none, if `minutes` (without homing) are too few.
    Other parameters as :func:`forecast`.
    """
    noise = noise or Noise()
    best: list[tuple[float, Instrument]] = []
    for changed in _grids(rig):
        candidates = _bursts(changed, minutes, row_overhead_s)
        scored = [(predict_noise(p, noise).image_db - predict_burst(p).edge_loss_db, p) for p in candidates]
        if scored:
            best.append(max(scored, key=lambda t: t[0]))
    best.sort(key=lambda t: -t[0])
    usable = (p for _, p in best if not any(_excludes(w) for w in find_warnings(p, noise, scene_mm)))
    return [forecast(p, noise, row_overhead_s, scene_mm) for p in islice(usable, count)]


def _excludes(warning: PlanWarning) -> bool:
    return warning.refused or warning.topic == "aliasing"


def _grids(rig: Instrument) -> Iterator[Instrument]:
    """Yield the rig file with other steps."""
    for nx in _STEP_MULTIPLES:
        for ny in _STEP_MULTIPLES:
            steps = Changes(step_x_mm=nx * rig.grid.step_x_mm, step_y_mm=ny * rig.grid.step_y_mm)
            try:
                yield steps.apply(rig)
            except ConfigError:
                continue  # the aperture, rounded to whole steps, exceeds the travel


def _bursts(rig: Instrument, minutes: float, row_overhead_s: float) -> Iterator[Instrument]:
    """Yield plans with as many pulses as fit, at the slowest speed that keeps the time.

    They use the rig's pulse period and the radars' shortest, once with the maximum number of pulses and once with the
    highest number that fills whole packets. A burst with several chirps a frame is not changed.
    """
    if rig.burst.chirps > 1:
        for speed in _speeds(rig, minutes):
            plan = _with_burst(rig, speed, rig.burst.pulses, rig.burst.period_us)
            if _max_pulses(plan) >= rig.burst.pulses and scan_time(plan, row_overhead_s).minutes <= minutes:
                yield plan
                return
        return
    for period in {rig.burst.period_us, min(rig.burst.period_us, shortest_period_us(rig))}:
        for whole in (False, True):
            for speed in _speeds(rig, minutes):
                plan = _with_burst(rig, speed, 2, period)
                pulses = _max_pulses(plan)
                if whole:
                    pulses = next((n for n in range(pulses, 1, -1) if whole_packets(plan, n)), 0)
                if pulses < 2:
                    break
                plan = _with_burst(rig, speed, pulses, period)
                if scan_time(plan, row_overhead_s).minutes <= minutes:
                    yield plan
                    break


def _with_burst(rig: Instrument, speed_mm_s: float, pulses: int, period_us: float) -> Instrument:
    """Replace speed and burst without validation, for speed; the values keep the rig file's rules."""
    stage = msgspec.structs.replace(rig.stage, speed_mm_s=speed_mm_s)
    burst = msgspec.structs.replace(rig.burst, pulses=pulses, period_us=period_us)
    return msgspec.structs.replace(rig, stage=stage, burst=burst)


def _max_pulses(rig: Instrument) -> int:
    by_time = _MAX_DUTY * 1e6 * rig.grid.step_x_mm / rig.stage.speed_mm_s / rig.burst.period_us
    travel = predict_burst(rig).travel_wavelengths
    by_travel = 1 + _MAX_TRAVEL_WAVELENGTHS * (rig.burst.chirps_a_position - 1) / travel
    return min(int(by_time), int(by_travel), _MAX_FRAMES // rig.grid.columns)


def _speeds(rig: Instrument, minutes: float) -> Iterator[float]:
    """Yield whole speeds, mm/s, ascending, from the slowest that can keep the time to the limit of stage and travel."""
    length = (rig.grid.columns - 1) * rig.grid.step_x_mm
    slowest = max(1, int(rig.grid.rows * length / (60 * minutes)))
    for speed in range(slowest, int(MAX_STEPS_PER_S / rig.stage.steps_per_mm) + 1):
        stage = msgspec.structs.replace(rig.stage, speed_mm_s=float(speed))
        if not stage.misfit(rig.grid):
            yield float(speed)
