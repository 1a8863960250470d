"""`polysight plan`: print a forecast, or the best plans within a time, as text or JSON.

`measure_noise` and `measure_row_overhead` take noise and standstill from a recorded scan (`--like`). `PlanChanges`
holds the values of a plan that differ from the rig file; `format_rig_lines` returns them as lines for a rig file.
`propose` varies speed, steps and burst, and keeps the aperture.
"""

from __future__ import annotations

import json
import math
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from polysight.calibration import read_board_rows
from polysight.planning.forecast import (
    MAX_STEPS_PER_S,
    ROW_OVERHEAD_S,
    Forecast,
    Noise,
    ScanTime,
    fills_whole_packets,
    find_warnings,
    forecast,
    measuring_s,
    predict_burst,
    predict_noise,
    row_motion_s,
    scan_time,
    tail_s,
    turn_s,
)
from polysight.planning.scene_warnings import Plate, read_scene, warn_of_scene
from polysight.radar import INTER_FRAME_US, TRIGGER_MARGIN_US, chirp_us
from polysight.store import EVENTS, RawSource, ScanFolder, read_events
from polysight.surfaces import VisibleNormals, visible_normals
from polysight.sync import BoardSetup, synchronise_row
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import ConfigError, DataError, ErrorCode
from polysight_shared.findings import Finding
from polysight_shared.messages import Capture
from polysight_shared.raster import burst_duration_s
from polysight_shared.tables import decode, to_builtins

# Keys of [stage] that the Pi takes from its own rig file: acceleration, and the limit of the speed.
_PI_KEYS = ("speed_mm_s", "accel_mm_s2")
# Longest time of a plan, as of --minutes; chosen.
_MOST_MINUTES = 100_000.0
# Steps that are compared, as multiples of the rig file's; chosen.
_STEP_MULTIPLES = (1, 2, 3, 4, 5)
# Largest share of the time between two points that a burst may take; chosen, the rest allows for jitter of the speed.
_MAX_DUTY = 0.95
# Largest travel during a burst; chosen. Where the paths to TX and RX leave the object at angles a to its normal in x
# with sin a_tx + sin a_rx = 1, it turns the echo's phase by half a cycle: the average over the burst loses 3.9 dB.
_MAX_TRAVEL_WAVELENGTHS = 0.5
# Largest number of frames in a row, as in host/polysight/radar/commands.py.
_MAX_FRAMES = 65535
# Characters of a line of warnings; chosen.
_WIDTH = 118
# Rows from which the noise is measured; chosen.
_NOISE_ROWS = 5
_SIMULATED = "the simulated rig's (not measured on hardware; set it with --like SCAN or --snr-db)"


@dataclass(frozen=True)
class PlanChanges:
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
            extent = size or (grid[count] - 1) * grid[step]
            grid[step] = getattr(self, step) or grid[step]
            steps = extent / grid[step]
            if not math.isfinite(steps):
                raise ConfigError(
                    f"{extent:g} mm in steps of {grid[step]:g} mm",
                    "their number is beyond any scan",
                    "plan a wider step",
                    code=ErrorCode.VALUE_INVALID,
                )
            grid[count] = getattr(self, count) or 1 + round(steps)
        if min(grid["columns"], grid["rows"]) < 2:
            raise ConfigError(
                f"{grid['columns']} x {grid['rows']} positions",
                "an image needs an aperture in both directions",
                "plan two rows of two positions, or more",
                code=ErrorCode.VALUE_INVALID,
            )
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
        try:
            return decode(table, Instrument, "this plan")
        except ConfigError as e:
            cause = f"these numbers, put into the rig file {rig.name!r}, break one of its rules"
            raise ConfigError(e.what, cause, "give others: `polysight plan --help` lists them", code=e.code) from None


def format_rig_lines(plan: Instrument, original: Instrument) -> str:
    """Return the lines of the rig file that differ between `plan` and `original`; "" if none differs."""
    new = to_builtins(plan)
    old = to_builtins(original)
    parts = []
    for section, keys in new.items():
        if not isinstance(keys, dict):
            continue
        # Strings, numbers and booleans of JSON are those of TOML.
        lines = [f"{key} = {json.dumps(value)}" for key, value in keys.items() if value != old[section].get(key)]
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
    for rig_with_steps in _vary_steps(rig):
        plans = _vary_bursts(rig_with_steps, minutes, row_overhead_s)
        # The level of a point over the noise, where a burst's motion weakens it most: at the aperture's ends.
        scored = [(predict_noise(plan, noise).image_db - predict_burst(plan).edge_loss_db, plan) for plan in plans]
        if scored:
            best.append(max(scored, key=lambda scored_plan: scored_plan[0]))
    best.sort(key=lambda scored_plan: -scored_plan[0])
    usable = (plan for _, plan in best if not any(_rules_out(w) for w in find_warnings(plan, noise, scene_mm)))
    return [forecast(plan, noise, row_overhead_s, scene_mm) for plan in islice(usable, count)]


def _rules_out(warning: Finding) -> bool:
    """True if no plan with this warning is proposed."""
    return warning.level == "error" or warning.where == "aliasing"


def _vary_steps(rig: Instrument) -> Iterator[Instrument]:
    """Yield the rig file with other steps."""
    for nx in _STEP_MULTIPLES:
        for ny in _STEP_MULTIPLES:
            steps = PlanChanges(step_x_mm=nx * rig.grid.step_x_mm, step_y_mm=ny * rig.grid.step_y_mm)
            try:
                yield steps.apply(rig)
            except ConfigError:
                # The aperture, rounded to whole steps, exceeds the travel.
                continue


def _vary_bursts(rig: Instrument, minutes: float, row_overhead_s: float) -> Iterator[Instrument]:
    """Yield plans with as many pulses as fit, at the slowest speed that keeps the time.

    They use the rig's pulse period and the radars' shortest, and the highest number of pulses whose rows end in a short
    packet, which marks the end. A burst with several chirps a frame is not changed.
    """
    if rig.burst.chirps > 1:
        for speed in _list_speeds(rig, minutes):
            plan = _set_burst(rig, speed, rig.burst.pulses, rig.burst.period_us)
            if _find_max_pulses(plan) >= rig.burst.pulses and scan_time(plan, row_overhead_s).minutes <= minutes:
                yield plan
                return
        return
    for period in {rig.burst.period_us, min(rig.burst.period_us, shortest_period_us(rig))}:
        for speed in _list_speeds(rig, minutes):
            # The plan has two pulses for now: the largest number that fits does not depend on it.
            plan = _set_burst(rig, speed, 2, period)
            max_pulses = _find_max_pulses(plan)
            pulses_with_short_packet = (n for n in range(max_pulses, 1, -1) if not fills_whole_packets(plan, n))
            pulses = next(pulses_with_short_packet, max_pulses)
            # A faster stage leaves time for still fewer pulses.
            if pulses < 2:
                break
            plan = _set_burst(rig, speed, pulses, period)
            if scan_time(plan, row_overhead_s).minutes <= minutes:
                yield plan
                break


def _set_burst(rig: Instrument, speed_mm_s: float, pulses: int, period_us: float) -> Instrument:
    """Replace speed and burst without validation, which would take long; the values keep the rig file's rules."""
    stage = msgspec.structs.replace(rig.stage, speed_mm_s=speed_mm_s)
    burst = msgspec.structs.replace(rig.burst, pulses=pulses, period_us=period_us)
    return msgspec.structs.replace(rig, stage=stage, burst=burst)


def _find_max_pulses(rig: Instrument) -> int:
    """Return the most pulses that a burst may have by time, by its travel, and by the radar's frames in a row."""
    pulses_in_time = _MAX_DUTY * 1e6 * rig.grid.step_x_mm / rig.stage.speed_mm_s / rig.burst.period_us
    wavelengths_per_us = predict_burst(rig).travel_wavelengths / (1e6 * burst_duration_s(rig.burst))
    # The burst ends with the last chirp of its last frame.
    frame_us = (rig.burst.chirps - 1) * rig.burst.chirp_us
    pulses_in_travel = 1 + (_MAX_TRAVEL_WAVELENGTHS / wavelengths_per_us - frame_us) / rig.burst.period_us
    return min(int(pulses_in_time), int(pulses_in_travel), _MAX_FRAMES // rig.grid.columns)


def _list_speeds(rig: Instrument, minutes: float) -> Iterator[float]:
    """Yield whole speeds, mm/s, ascending, from the slowest that can keep the time to the limit of stage and travel."""
    row_mm = (rig.grid.columns - 1) * rig.grid.step_x_mm
    slowest = max(1, int(rig.grid.rows * row_mm / (60 * minutes)))
    for speed in range(slowest, int(MAX_STEPS_PER_S / rig.stage.steps_per_mm) + 1):
        stage = msgspec.structs.replace(rig.stage, speed_mm_s=float(speed))
        if not stage.misfit(rig.grid):
            yield float(speed)


def _format_duration(seconds: float) -> str:
    """Return a duration in seconds, minutes or hours."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 6000:
        return f"{seconds / 60:.1f} min"
    return f"{seconds / 3600:.2f} h"


def _format_bytes(count: float) -> str:
    if count >= 1e9:
        return f"{count / 1e9:.2f} GB"
    return f"{count / 1e6:.0f} MB"


def _format_pair(values: tuple[float, float], digits: int = 1, infinite: str = "none") -> str:
    """Return two lengths as `x x y`, and `infinite` for infinite ones."""
    return " x ".join(infinite if math.isinf(v) else f"{v:.{digits}f}" for v in values)


def describe(f: Forecast) -> str:
    """Return the text of one forecast: two columns, the second continued on lines without a keyword."""
    grid = f.rig.grid
    burst = f.rig.burst
    stage = f.rig.stage
    response = f.response
    width_mm = (grid.columns - 1) * grid.step_x_mm
    height_mm = (grid.rows - 1) * grid.step_y_mm
    lines = [
        (
            "scan",
            f"{grid.columns} x {grid.rows} positions, steps {grid.step_x_mm:g} x {grid.step_y_mm:g} mm,"
            f" {width_mm:g} x {height_mm:g} mm",
        ),
        # One chirp a frame has no `chirp_us`.
        (
            "",
            f"{stage.speed_mm_s:g} mm/s, {burst.chirps_a_position} chirps a position,"
            f" {burst.chirp_us or burst.period_us:g} us apart",
        ),
        *_describe_time(f.time),
        ("pulses", f.rig.pi.pulse_source),
        ("raw data", f"{_format_bytes(f.raw_bytes)} of {len(f.rig.recorded)} boards"),
        (
            "resolution",
            f"{_format_pair(response.width_mm)} mm at half power (x by y), with the rig file's window and taper;"
            f" limit of the geometry {_format_pair(response.limit_mm)} mm",
        ),
        (
            "",
            f"the paper's r lambda / L: {_format_pair(response.paper_mm)} mm (docs/decisions/0002-imaging.md explains"
            " the difference)",
        ),
        ("field", f"without aliases over {_format_pair(f.field.alias_free_mm, 0, 'unlimited')} mm"),
        ("", f"flat plates need {_format_pair(f.field.mirror_zone_mm, 0)} mm of aperture beyond them on every side"),
        ("normals", _describe_normals(visible_normals(f.rig))),
        (
            "motion",
            f"{f.burst.travel_mm:.2f} mm during a burst, {f.burst.travel_wavelengths:.2f} wavelengths;"
            f" a burst fills {f.burst.duty:.0%} of the time to the next position",
        ),
        (
            "noise",
            f"direct path {f.noise.position_db:.1f} dB above the noise in a position's average (one channel, one"
            f" sample), standard deviation of its phase {f.noise.direct_phase_rad:.4f} rad",
        ),
        ("", f"a point as strong as the direct path is {f.noise.image_db:.1f} dB above the noise in the image"),
        ("", f"source: {f.noise_source}"),
    ]
    text_lines = [f"{name:11s}{text}" for name, text in lines]
    for warning in f.warnings:
        kind = "REFUSED" if warning.level == "error" else "note"
        text_lines += textwrap.wrap(f"{kind}, {warning.where}: {warning.what}", _WIDTH, subsequent_indent="  ")
    return "\n".join(text_lines) + "\n"


def _describe_time(time: ScanTime) -> list[tuple[str, str]]:
    """Return the two lines about the duration."""
    seconds = {name: _format_duration(value) for name, value in vars(time).items()}
    return [
        ("time", f"{_format_duration(time.total_s)}, without homing and retakes: {seconds['measuring_s']} measuring,"),
        (
            "",
            f"{seconds['ramps_s']} ramps, {seconds['turns_s']} turns, {seconds['tail_s']} waiting for last packets,"
            f" {seconds['overhead_s']} between rows, {seconds['approach_s']} approach",
        ),
    ]


def _describe_normals(normals: VisibleNormals) -> str:
    """Describe the tilts at which curved and tilted surfaces are seen."""
    text = f"surfaces tilted by up to {normals.x_deg:.0f} degrees in x, {normals.y_deg:.0f} in y are seen"
    limits = zip(normals.alias_deg, (normals.x_deg, normals.y_deg), strict=True)
    aliases_deg = [alias for alias, tilt in limits if alias < tilt]
    if aliases_deg:
        text += f"; beyond {min(aliases_deg):.0f} degrees their phases alias: take a smaller step"
    return text


def _format_table(plans: list[Forecast]) -> str:
    """Format proposals as a table, one a line, numbered from 1."""
    lines = ["    time      mm/s  chirps  period us  steps mm     grid       image dB  motion  alias-free mm   raw"]
    for i, f in enumerate(plans, 1):
        grid = f.rig.grid
        burst = f.rig.burst
        lines.append(
            f"{i:2d}  {_format_duration(f.time.total_s):9s} {f.rig.stage.speed_mm_s:4g}  {burst.pulses:6d}"
            f"  {burst.period_us:9g}  {f'{grid.step_x_mm:g} x {grid.step_y_mm:g}':11s}"
            f"  {f'{grid.columns} x {grid.rows}':9s}  {f.noise.image_db:8.1f}"
            f"  {f.burst.travel_wavelengths:4.2f} w  {_format_pair(f.field.alias_free_mm, 0, 'unlimited'):13s}"
            f"  {_format_bytes(f.raw_bytes)}"
        )
    return "\n".join(lines) + "\n"


def _replace_infinite(values: tuple[float, float]) -> list[float | None]:
    """Return the values with None for infinite ones, which JSON lacks."""
    return [float(v) if math.isfinite(v) else None for v in values]


def forecast_values(f: Forecast) -> dict[str, Any]:
    """Return a forecast as plain values for JSON; infinite ones as None."""
    grid = f.rig.grid
    burst = f.rig.burst
    stage = f.rig.stage
    time = f.time
    response = f.response
    normals = visible_normals(f.rig)
    return {
        "possible": f.possible,
        "speed_mm_s": stage.speed_mm_s,
        "accel_mm_s2": stage.accel_mm_s2,
        "pulses": burst.pulses,
        "chirps": burst.chirps,
        "period_us": burst.period_us,
        "columns": grid.columns,
        "rows": grid.rows,
        "step_x_mm": grid.step_x_mm,
        "step_y_mm": grid.step_y_mm,
        "time_s": {
            "total": time.total_s,
            "approach": time.approach_s,
            "measuring": time.measuring_s,
            "ramps": time.ramps_s,
            "turns": time.turns_s,
            "last_packets": time.tail_s,
            "standstill": time.overhead_s,
        },
        "raw_bytes": f.raw_bytes,
        "point_width_mm": _replace_infinite(response.width_mm),
        "point_limit_mm": _replace_infinite(response.limit_mm),
        "point_paper_mm": _replace_infinite(response.paper_mm),
        "alias_free_mm": _replace_infinite(f.field.alias_free_mm),
        "mirror_zone_mm": _replace_infinite(f.field.mirror_zone_mm),
        "visible_normals_deg": [normals.x_deg, normals.y_deg],
        "alias_tilt_deg": _replace_infinite(normals.alias_deg),
        "burst_ms": f.burst.duration_ms,
        "between_positions_ms": f.burst.between_ms,
        "burst_travel_mm": f.burst.travel_mm,
        "burst_travel_wavelengths": f.burst.travel_wavelengths,
        "burst_edge_loss_db": f.burst.edge_loss_db,
        "position_snr_db": f.noise.position_db,
        "direct_phase_rad": f.noise.direct_phase_rad,
        "image_snr_db": f.noise.image_db,
        "noise_source": f.noise_source,
        "warnings": [{"topic": w.where, "text": w.what, "refused": w.level == "error"} for w in f.warnings],
    }


def measure_noise(source: RawSource) -> Noise:
    """Measure the direct path over noise of a scan's weaker receiver in a few of its rows.

    Raises DataError if the scan has no rows, or bursts of a single chirp.
    """
    # Imported here, because importing matplotlib takes a second.
    from polysight.report import SyncReport

    rig = source.instrument
    rx = len(rig.antennas.rx_mm)
    ratios = []
    for board in rig.receivers:
        setup = BoardSetup.from_rig(rig, board)
        report = SyncReport(rig.chirp.sample_rate_hz, rig.chirp.linear_samples, rx)
        for _, words, valid in read_board_rows(source, board.name, _NOISE_ROWS):
            report.add(synchronise_row(words, valid, setup))
        ratios.append(report.snr)
    if not np.isfinite(ratios).all():
        raise DataError(
            f"scan {source.scan_id}: its noise cannot be measured",
            "it has no rows, or bursts of a single chirp",
            "give another scan with --like, or the ratio with --snr-db",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    kind = "simulated scan" if source.simulated else "scan"
    return Noise(float(10 * np.log10(min(ratios))), f"measured on {kind} {source.scan_id}")


def measure_row_overhead(folder: Path) -> float | None:
    """Measure the standstill between a scan's rows, seconds, on the clock of the triggers.

    It is the median time from a row's last trigger to the next row's first, minus the motion. None if the Pi's events
    have no two consecutive rows, or the data was simulated without a Pi.
    """
    scan = ScanFolder.load(folder)
    if scan.started.pi is None:
        return None
    rig = scan.instrument
    # Times of the first and last trigger of each take of a row, in the order taken.
    triggers_ns: dict[tuple[int, int], tuple[int, int]] = {}
    for event in read_events(folder / EVENTS).events:
        if isinstance(event, Capture):
            take = (event.row_index, event.take)
            first_ns, _ = triggers_ns.setdefault(take, (event.edge_ns, event.edge_ns))
            triggers_ns[take] = (first_ns, event.edge_ns)
    gaps_s = []
    for (take, (_, last_ns)), (next_take, (first_ns, _)) in pairwise(triggers_ns.items()):
        # The gap before a retake of the same row is of another kind and does not count. The gap at which a scan was
        # resumed counts, but it hardly changes the median.
        if next_take[0] == take[0] + 1:
            gaps_s.append((first_ns - last_ns) / 1e9)
    if not gaps_s:
        return None
    # Between the triggers the stage brakes, turns, waits for the last packet and accelerates.
    ramps_s = row_motion_s(rig.grid, rig.stage) - measuring_s(rig)
    motion_s = ramps_s + turn_s(rig.grid, rig.stage) + tail_s(rig)
    return max(0.0, float(np.median(gaps_s)) - motion_s)


@dataclass(frozen=True)
class PlanOptions:
    """Options of the command besides `PlanChanges`.

    Attributes
    ----------
    minutes, count
        Time for which plans are proposed (None: only the forecast), and their largest number.
    like, snr_db, row_overhead_s
        Scan whose noise and standstill are taken, and either of them as a number, which comes first.
    scene_mm, scene
        Size of the scene in the object plane, and a scene file whose plates are checked, with its values of the rig.
    """

    minutes: float | None = None
    count: int = 5
    like: Path | None = None
    snr_db: float | None = None
    row_overhead_s: float | None = None
    scene_mm: tuple[float, float] | None = None
    scene: Path | None = None
    as_json: bool = False


def forecast_scene(
    rig: Instrument,
    changes: PlanChanges,
    scene: Path | None,
    noise: Noise | None = None,
    row_overhead_s: float = ROW_OVERHEAD_S,
    scene_mm: tuple[float, float] | None = None,
) -> Forecast:
    """Predict a scan, with warnings about the plates of a scene file, if there is one. Raises ConfigError.

    The scene file's own grid, burst, image, stage and distance replace the rig's; then `changes` are applied.
    Other parameters as of :func:`forecast`.
    """
    scene_rig, plates = _apply_scene(rig, scene)
    return _check_plates(forecast(changes.apply(scene_rig), noise, row_overhead_s, scene_mm), plates)


def _apply_scene(rig: Instrument, scene: Path | None) -> tuple[Instrument, list[Plate]]:
    """Return the rig with a scene file's values, and its plates; without a scene the rig itself. Raises ConfigError."""
    if scene is None:
        return rig, []
    return read_scene(scene, rig)


def _check_plates(prediction: Forecast, plates: list[Plate]) -> Forecast:
    """Return the forecast with the warnings about the plates of a scene."""
    notes = tuple(warn_of_scene(prediction.rig, plates))
    return replace(prediction, warnings=prediction.warnings + notes)


def run_plan(config: Path, changes: PlanChanges, options: PlanOptions) -> int:
    """Print the forecast, or proposals if `minutes` is given; return 1 if the plan would be refused or none fits.

    Raises PolysightError if the rig file, a value or the scan of --like is invalid.
    """
    original = load_instrument(config)
    noise, overhead = _choose_assumptions(options)
    if options.minutes is None:
        predicted = forecast_scene(original, changes, options.scene, noise, overhead, options.scene_mm)
        if options.as_json:
            sys.stdout.write(json.dumps(forecast_values(predicted), indent=1) + "\n")
        else:
            sys.stdout.write(describe(predicted))
        return int(not predicted.possible)
    rig, plates = _apply_scene(original, options.scene)
    proposals = propose(changes.apply(rig), options.minutes, options.count, noise, overhead, options.scene_mm)
    plans = [_check_plates(proposal, plates) for proposal in proposals]
    if options.as_json:
        content = {"minutes": options.minutes, "plans": [forecast_values(p) for p in plans]}
        sys.stdout.write(json.dumps(content, indent=1) + "\n")
    elif plans:
        lines = format_rig_lines(plans[0].rig, original)
        if lines:
            differences = f"Its lines in the rig file, all that differ:\n\n{lines}"
        else:
            differences = "It is the rig file's plan.\n"
        sys.stdout.write(
            f"Best plans within {options.minutes:g} minutes for this aperture, least noise in the image first"
            f" (dB: point over noise; motion: wavelengths during a burst)\n\n{_format_table(plans)}\n"
            f"The first plan in full:\n\n{describe(plans[0])}\n{differences}"
        )
    else:
        rig = changes.apply(rig)
        cause, remedy = _explain_no_plan(rig, options.minutes, noise, overhead, options.scene_mm)
        sys.stderr.write(
            f"polysight plan: no plan within {options.minutes:g} minutes without aliases\n"
            f"  why: {cause}\n  do: {remedy}\n"
        )
    return int(not plans)


def _explain_no_plan(
    rig: Instrument, minutes: float, noise: Noise, row_overhead_s: float, scene_mm: tuple[float, float] | None
) -> tuple[str, str]:
    """Return why no plan was found, and what to do: more time where that helps, otherwise other steps."""
    if not propose(rig, _MOST_MINUTES, count=1, noise=noise, row_overhead_s=row_overhead_s, scene_mm=scene_mm):
        grid = rig.grid
        return (
            f"steps of {grid.step_x_mm:g} x {grid.step_y_mm:g} mm and multiples of them have aliases in this scene, or"
            " the aperture does not fit the stage: more time does not help",
            "give smaller steps (--step-x-mm, --step-y-mm) or a smaller --scene-mm",
        )
    plans: list[Forecast] = []
    while not plans:
        minutes *= 2
        plans = propose(rig, minutes, len(_STEP_MULTIPLES) ** 2, noise, row_overhead_s, scene_mm)
    enough = math.ceil(min(plan.time.minutes for plan in plans))
    return (
        "this aperture takes longer on this stage, and larger steps have aliases in this scene",
        f"--minutes {enough} are enough; or give a smaller --width-mm or --height-mm, a smaller --scene-mm, or a higher"
        " --accel-mm-s2",
    )


def _choose_assumptions(options: PlanOptions) -> tuple[Noise, float]:
    """Return the noise and standstill: as given, else of the scan of --like, else the simulated rig's."""
    noise = Noise(source=_SIMULATED)
    overhead_s = ROW_OVERHEAD_S
    if options.like is not None:
        noise = measure_noise(ScanFolder.load(options.like))
        measured_s = measure_row_overhead(options.like)
        overhead_s = ROW_OVERHEAD_S if measured_s is None else measured_s
    if options.snr_db is not None:
        noise = Noise(options.snr_db, "given")
    if options.row_overhead_s is not None:
        overhead_s = options.row_overhead_s
    return noise, overhead_s
