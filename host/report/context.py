"""What a report is made of: plain arrays and dicts, so that the report knows nothing of how they came about."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.shared.raster import RasterPlan

Image = npt.NDArray[np.complexfloating]
Labels = npt.NDArray[np.int32]


@dataclass(frozen=True)
class ReportContext:
    """Everything a report shows. What is None or empty is left out of it.

    Attributes
    ----------
    title
        Heading, the scan's or scene's name.
    simulated
        Stamps SIMULATED on the page, every figure and every table.
    x_m, y_m
        Pixel centres, rig frame, metres, [nx] and [ny]. Figures show millimetres from the image centre.
    h, v, p
        complex [ny, nx]: the two channels and their metal-referenced ratio.
    valid
        bool [ny, nx]; invalid pixels are drawn grey.
    metal_referenced
        Whether h, v, p are relative to metal (0 dB = metal) or in arbitrary units.
    materials
        Rows as `polysight.host.materials.MaterialsResult.rows` makes them, in the order of their labels.
    segments
        int32 [ny, nx], 0 = nothing, else the row's label.
    pixel_names
        Row label to (names str [n] of the interior's pixels in image order, interior bool [ny, nx]), for the
        pixel-wise map; may be empty.
    truth
        Plates known beforehand: dicts with name, box_mm (x0, y0, x1, y1 from the image centre), permittivity
        (complex or None for metal). None when unknown.
    metal_how
        One sentence: which patch is the metal reference and how it was chosen.
    pixel_accuracy
        Share of interior pixels named right, where the truth is known.
    library_note
        Where the classifier's library comes from and how well it does on scans left out.
    quality
        The content of quality.json. Known keys: `boards` {name: {frames_expected, frames_received, ...,
        synchronisation: {stage: {quantity: std}}}} and `seconds_per_stage` {stage: s}. Further keys are listed as
        they are.
    config
        Short summary, key to text or number, in the order to show.
    provenance
        Scan id, times, versions; key to text.
    notes
        Sentences shown at the top, such as what never ran on hardware.
    plan
        Where the positions of the scan were; with `quality`'s `masked_columns` it makes the map of what was masked.
    rx_gains
        Board to its RX: gain_db and phase_deg against the first, which were divided out.
    rig_file
        The whole rig file as text.
    """

    title: str
    simulated: bool
    x_m: npt.NDArray[np.float64]
    y_m: npt.NDArray[np.float64]
    h: Image
    v: Image
    p: Image
    valid: npt.NDArray[np.bool_] | None = None
    metal_referenced: bool = True
    materials: list[dict[str, Any]] = field(default_factory=list)
    segments: Labels | None = None
    pixel_names: dict[int, tuple[npt.NDArray[np.str_], npt.NDArray[np.bool_]]] = field(default_factory=dict)
    truth: list[dict[str, Any]] | None = None
    metal_how: str = ""
    pixel_accuracy: float | None = None
    library_note: str = ""
    quality: dict[str, Any] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    plan: RasterPlan | None = None
    rx_gains: dict[str, list[dict[str, float]]] = field(default_factory=dict)
    rig_file: str = ""
