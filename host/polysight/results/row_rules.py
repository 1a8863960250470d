"""Rules of the verdict on the phases and places of rows, as those of `rules.py`: jumps, drift, displaced rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from polysight.results.quality import PhaseJump
from polysight.results.verdict import is_known, reason
from polysight_shared.findings import Finding

ALIKE_RAD = 0.2
"""Difference of the jumps of both boards between the same rows, up to which they are one jump; chosen."""


def judge_phase_jumps(jumps: Mapping[str, Sequence[PhaseJump]]) -> list[Finding]:
    """Judge jumps of the phase of the echoes of each board."""
    shared = _find_shared_jumps(jumps)
    reasons = []
    if shared:
        reasons.append(reason(
            "care", f"the phase of the echo jumps {_list_jumps(shared)} in both boards equally",
            "the whole array or the object was knocked, or a row was skipped: a cable of one board cannot cause "
            "this; the jump was removed from the images as measured between the rows, and the errors contain what "
            "may be left",
            "fix the stage and the object, and scan again", weight=4.7,
        ))  # fmt: skip
    shared_rows = {jump.row for jump in shared}
    for board, jumps_of_board in jumps.items():
        own = [jump for jump in jumps_of_board if jump.row not in shared_rows]
        if not own:
            continue
        reasons.append(reason(
            "care", f"{board}: the phase of the echo jumps {_list_jumps(own)}",
            "a cable or connector is loose or was touched, or the board was knocked; the direct path does not show "
            "this; the jump was removed from the images as measured between the rows, and the errors contain what "
            "may be left",
            "fix cables and boards, and scan again", weight=4.7,
        ))  # fmt: skip
    return reasons


def _find_shared_jumps(jumps: Mapping[str, Sequence[PhaseJump]]) -> list[PhaseJump]:
    """Return the jumps that all boards have before the same row, alike within `ALIKE_RAD`, with their mean angle."""
    if len(jumps) < 2:
        return []
    jumps_of_first, *jumps_of_others = jumps.values()
    shared = []
    for jump in jumps_of_first:
        alike = [other for of_board in jumps_of_others for other in of_board if _is_alike(jump, other)]
        # A board has one jump before a row at most.
        if len(alike) == len(jumps_of_others):
            shared.append(PhaseJump(jump.row, float(np.mean([jump.angle_rad, *(other.angle_rad for other in alike)]))))
    return shared


def _is_alike(jump: PhaseJump, other: PhaseJump) -> bool:
    """Return true if another board's jump comes before the same row, and their angles agree within `ALIKE_RAD`."""
    return other.row == jump.row and abs(other.angle_rad - jump.angle_rad) < ALIKE_RAD


def _list_jumps(jumps: Sequence[PhaseJump]) -> str:
    """Return sizes and rows of jumps as text."""
    return ", ".join(f"by {np.degrees(jump.angle_rad):+z.0f} degrees before row {jump.row}" for jump in jumps)


def judge_displaced_rows(rms_mm: float) -> list[Finding]:
    """Judge how far rows are from where the stage was commanded, root mean square; 0: nothing is found."""
    if not is_known(rms_mm) or rms_mm <= 0:
        return []
    return [reason(
        "care", f"rows of the stage are {rms_mm:.1f} mm (rms) from where they were commanded",
        "both boards show the same shifts from row to row: the stage loses steps, has play or slips along y; plates are"
        " blurred, and their V / H changes from row to row",
        "check the belt or screw, the current and the speed of the stage's y axis; scan again", weight=4.6,
    )]  # fmt: skip


def judge_phase_drift(range_rad: float, left_rad: float) -> list[Finding]:
    """Judge a drift of one board's phase that was removed: its range over the plates, and the error that is left."""
    if not is_known(range_rad) or range_rad <= 0:
        return []
    return [reason(
        "care", f"the phase of V / H drifts over the rows by {np.degrees(range_rad):.0f} degrees",
        "the phase of one board changes during the scan: a cable that bends or warms up, or a board that warms up; it"
        f" was removed from the images, and the errors contain what may be left, {np.degrees(left_rad):.0f} degrees",
        "let the boards warm up for half an hour; fix the cables so that the stage does not bend them", weight=4.65,
    )]  # fmt: skip
