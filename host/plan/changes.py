"""A rig file with a few numbers of its scan changed."""

from __future__ import annotations

from dataclasses import dataclass

from polysight.shared.config import Instrument
from polysight.shared.tables import decode, to_builtins


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


ON_THE_PI = ("speed_mm_s", "accel_mm_s2")
"""Of [stage]: the Pi drives with its own rig file's acceleration, and refuses speeds above that file's."""


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
