"""A rig file with a few numbers of its scan changed."""

from __future__ import annotations

from dataclasses import dataclass

from shared.config import Instrument, decode, to_builtins


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


def rig_lines(rig: Instrument) -> str:
    """The lines that put a plan into a rig file."""
    g, b, s = rig.grid, rig.burst, rig.stage
    return (
        f"[burst]\npulses = {b.pulses}\nperiod_us = {b.period_us}\n\n"
        f"[grid]\ncolumns = {g.columns}\nrows = {g.rows}\nstep_x_mm = {g.step_x_mm}\nstep_y_mm = {g.step_y_mm}\n\n"
        f"[stage]\nspeed_mm_s = {s.speed_mm_s}\n"
    )
