"""How far a result may be trusted: one verdict for every scan, with its reasons and what to do about each.

`Verdict` holds a level (`good`, `care`, `none`) and `Reason`s in order of weight; it is written as `verdict` into
quality.json and materials.json and shown by every command, the report and the live view. The rules that turn evidence
into reasons are in `rules`.
"""

from polysight.host.verdict.rules import (
    Coverage,
    brightness_reasons,
    direct_path_reasons,
    incidence_reasons,
    leakage_reasons,
    level_reasons,
    metal_reasons,
    passivity_reasons,
    plane_reasons,
    recording_reasons,
    signal_reasons,
    tilt_reasons,
)
from polysight.host.verdict.verdict import LEVELS, Level, NoResult, Reason, Verdict, read_verdict, verdict_of

__all__ = [
    "LEVELS",
    "Coverage",
    "Level",
    "NoResult",
    "Reason",
    "Verdict",
    "brightness_reasons",
    "direct_path_reasons",
    "incidence_reasons",
    "leakage_reasons",
    "level_reasons",
    "metal_reasons",
    "passivity_reasons",
    "plane_reasons",
    "read_verdict",
    "recording_reasons",
    "signal_reasons",
    "tilt_reasons",
    "verdict_of",
]
