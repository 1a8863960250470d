"""The result of a processed scan as typed declarations: the JSON products, and the verdict on them.

`ScanMaterials`, `ScanQuality` and `ScanFacts` are the content of materials.json, quality.json and scan.json; their
`read` takes files of any release. `PatchFigures` declares each figure of a patch once, with name, unit and title
(`Column`); `list_declared_figures` lists them for tables, exports and datasets. With the verdict "no result" a
`ScanMaterials` cannot hold names or permittivities. `rules` and `row_rules` hold the rules of the verdict,
`join_reasons` joins what they find. `to_plain` converts all of it to JSON types.
"""

from polysight.results import row_rules as row_rules, rules as rules
from polysight.results.check_plate import (
    ACTION_SIGMAS as ACTION_SIGMAS,
    WARNING_SIGMAS as WARNING_SIGMAS,
    CheckResult as CheckResult,
    check_plate as check_plate,
    check_reasons as check_reasons,
)
from polysight.results.json_files import (
    damage_error as damage_error,
    encode_json as encode_json,
    format_one_line as format_one_line,
    read_object as read_object,
    to_plain as to_plain,
)
from polysight.results.materials import (
    BandFigures as BandFigures,
    ComplexNumber as ComplexNumber,
    ErrorBudget as ErrorBudget,
    Figure as Figure,
    IncidenceError as IncidenceError,
    LeakageError as LeakageError,
    MetalScore as MetalScore,
    MetalSource as MetalSource,
    PatchFigures as PatchFigures,
    PermittivityFigures as PermittivityFigures,
    PlaneError as PlaneError,
    ScanMaterials as ScanMaterials,
    TruthFigures as TruthFigures,
    list_declared_figures as list_declared_figures,
)
from polysight.results.quality import (
    Backlash as Backlash,
    BoardImaging as BoardImaging,
    BoardQuality as BoardQuality,
    CalibrationSource as CalibrationSource,
    FrequencyRange as FrequencyRange,
    GivenImages as GivenImages,
    IncidenceAngles as IncidenceAngles,
    MetalPlate as MetalPlate,
    Pair as Pair,
    PhaseJump as PhaseJump,
    RawDropped as RawDropped,
    ReconstructedPositions as ReconstructedPositions,
    Recording as Recording,
    RemovedDrift as RemovedDrift,
    Residual as Residual,
    RxGain as RxGain,
    ScanFacts as ScanFacts,
    ScanQuality as ScanQuality,
)
from polysight.results.verdict import (
    Coverage as Coverage,
    NoResult as NoResult,
    Verdict as Verdict,
    join_reasons as join_reasons,
    percent as percent,
    reason as reason,
)
