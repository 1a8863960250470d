"""The result of a processed scan as typed declarations: the JSON products, and the verdict on them.

`ScanMaterials`, `ScanQuality` and `ScanFacts` are the content of materials.json, quality.json and scan.json; their
`read` takes files of any release. `PatchFigures` declares each figure of a patch once, with name, unit and title
(`Column`); `figures_of` lists them for tables, exports and datasets. With the verdict "no result" a `ScanMaterials`
cannot hold names or permittivities. The functions `*_reasons` are the rules of the verdict, `verdict_of` joins them.
`plain` converts all of it to JSON types.
"""

from polysight.results.json_files import damaged, json_text, one_line, plain
from polysight.results.materials import (
    BandFigures,
    ComplexNumber,
    ErrorBudget,
    Figure,
    IncidenceError,
    LeakageError,
    MetalScore,
    MetalSource,
    PatchFigures,
    PermittivityFigures,
    PlaneError,
    ScanMaterials,
    TruthFigures,
    figures_of,
)
from polysight.results.quality import (
    Backlash,
    BoardQuality,
    FrequencyRange,
    RawDropped,
    Residual,
    RxGain,
    ScanFacts,
    ScanQuality,
)
from polysight.results.verdict import (
    Coverage,
    NoResult,
    Verdict,
    brightness_reasons,
    direct_path_reasons,
    incidence_reasons,
    leakage_reasons,
    level_reasons,
    metal_reasons,
    passivity_reasons,
    percent,
    plane_reasons,
    recording_reasons,
    signal_reasons,
    tilt_reasons,
    verdict_of,
)

__all__ = [
    "Backlash",
    "BandFigures",
    "BoardQuality",
    "ComplexNumber",
    "Coverage",
    "ErrorBudget",
    "Figure",
    "FrequencyRange",
    "IncidenceError",
    "LeakageError",
    "MetalScore",
    "MetalSource",
    "NoResult",
    "PatchFigures",
    "PermittivityFigures",
    "PlaneError",
    "RawDropped",
    "Residual",
    "RxGain",
    "ScanFacts",
    "ScanMaterials",
    "ScanQuality",
    "TruthFigures",
    "Verdict",
    "brightness_reasons",
    "damaged",
    "direct_path_reasons",
    "figures_of",
    "incidence_reasons",
    "json_text",
    "leakage_reasons",
    "level_reasons",
    "metal_reasons",
    "one_line",
    "passivity_reasons",
    "percent",
    "plain",
    "plane_reasons",
    "recording_reasons",
    "signal_reasons",
    "tilt_reasons",
    "verdict_of",
]
