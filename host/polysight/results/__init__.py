"""The result of a processed scan as typed declarations: the JSON products, and the verdict on them.

`ScanMaterials`, `ScanQuality` and `ScanFacts` are the content of materials.json, quality.json and scan.json; their
`read` takes files of any release. `PatchFigures` declares each figure of a patch once, with name, unit and title
(`Column`); `declared_figures` lists them for tables, exports and datasets. With the verdict "no result" a
`ScanMaterials` cannot hold names or permittivities. `rules` holds the rules of the verdict, `join_reasons`
joins what they find. `to_plain` converts all of it to JSON types.
"""

from polysight.results import rules
from polysight.results.check_plate import (
    ACTION_SIGMAS,
    WARNING_SIGMAS,
    CheckResult,
    check_plate,
    check_reasons,
)
from polysight.results.json_files import damage_error, json_text, one_line, read_object, to_plain
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
    declared_figures,
)
from polysight.results.quality import (
    Backlash,
    BoardImaging,
    BoardQuality,
    CalibrationSource,
    FrequencyRange,
    GivenImages,
    IncidenceAngles,
    MetalPlate,
    Pair,
    RawDropped,
    ReconstructedPositions,
    Recording,
    Residual,
    RxGain,
    ScanFacts,
    ScanQuality,
)
from polysight.results.verdict import (
    Coverage,
    NoResult,
    Verdict,
    join_reasons,
    percent,
    reason,
)

__all__ = [
    "ACTION_SIGMAS",
    "WARNING_SIGMAS",
    "Backlash",
    "BandFigures",
    "BoardImaging",
    "BoardQuality",
    "CalibrationSource",
    "CheckResult",
    "ComplexNumber",
    "Coverage",
    "ErrorBudget",
    "Figure",
    "FrequencyRange",
    "GivenImages",
    "IncidenceAngles",
    "IncidenceError",
    "LeakageError",
    "MetalPlate",
    "MetalScore",
    "MetalSource",
    "NoResult",
    "Pair",
    "PatchFigures",
    "PermittivityFigures",
    "PlaneError",
    "RawDropped",
    "ReconstructedPositions",
    "Recording",
    "Residual",
    "RxGain",
    "ScanFacts",
    "ScanMaterials",
    "ScanQuality",
    "TruthFigures",
    "Verdict",
    "check_plate",
    "check_reasons",
    "damage_error",
    "declared_figures",
    "join_reasons",
    "json_text",
    "one_line",
    "percent",
    "read_object",
    "reason",
    "rules",
    "to_plain",
]
