"""The verdict: whether a scan's results can be used, with reasons and remedies.

`Verdict` holds a level (`good`, `care`, `none`) and `Reason`s in order of weight. It is written as `verdict` into
quality.json and materials.json, and shown by all commands, the report and the live view. The functions `*_reasons` are
the rules that turn evidence into reasons; `verdict_of` joins the reasons to a verdict.
"""

from polysight.verdict.rules import (
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
from polysight.verdict.verdict import LEVELS, NoResult, Reason, Verdict, read_verdict, verdict_of

__all__ = [
    "LEVELS",
    "Coverage",
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
