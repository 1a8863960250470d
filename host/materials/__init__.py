"""From the two images to named patches with their permittivity.

`analyse` takes an `ImagePair`, the `Optics`, which metal is the reference (`MetalChoice`) and what is known of the
scene (`KnownScene`); it returns a `MaterialsResult`. A `Classifier` names patches by a `Library` of labelled patches;
`make_library` and `fit_library` make one. `fit_layer` fits thin layers, `fit_concentration` solutions. What is shared
between scans is in `patch_files`; `published` reads the published data set's material and label files.
"""

from polysight.host.materials.analyse import analyse, image_centre_mm, permittivity_change, pixel_accuracy
from polysight.host.materials.classify import (
    DISCRIMINANT,
    MODELS,
    PAPER,
    SHORT,
    UNKNOWN,
    Classifier,
    NamedPatch,
    Verdict,
)
from polysight.host.materials.concentration import (
    ConcentrationResult,
    concentrations,
    fit_concentration,
    polarisation_angle_rad,
)
from polysight.host.materials.inputs import FOUND, UNKNOWN_SCENE, ImagePair, KnownScene, MetalChoice, Optics
from polysight.host.materials.inversion import Inversion, PatchEstimate, Seen, Uncertain, invert, ratio_error
from polysight.host.materials.knn import Fit, Weights, fit_weights
from polysight.host.materials.layers import Layer, LayerFit, fit_layer
from polysight.host.materials.library import SAME_ANGLE_DEG, SIMULATED_LIBRARY, Entry, Library
from polysight.host.materials.measure import Refused
from polysight.host.materials.metal import MetalReference, find_metal, metal_by_label, metal_in_box
from polysight.host.materials.metal_evidence import MetalEvidence, metal_evidence
from polysight.host.materials.patch_files import (
    PATCHES,
    MatchedPatch,
    SeenPatches,
    labels_of,
    match_patches,
    pack_patches,
    patches_from_labels,
    patches_from_plates,
    read_labels,
    read_patches,
    write_labels,
)
from polysight.host.materials.permittivity import Permittivity, estimate_permittivity, format_permittivity, median_ratio
from polysight.host.materials.published import (
    METALS,
    LabelledScan,
    entries_of_boxes,
    is_metal,
    label_folders,
    read_labelled_scan,
    read_material,
    read_materials,
    reading_of,
    told_angle,
)
from polysight.host.materials.result import MaterialsResult, PatchResult
from polysight.host.materials.samples import CHANNELS, Samples, feature_matrix
from polysight.host.materials.segment import Box, Patch, Segmentation, SegmentSettings, axis_mm, box_mask, segment
from polysight.host.materials.sub_bands import AMPLITUDE_ERROR, bands_of_row, with_bands
from polysight.host.materials.train import (
    Score,
    TrainingScan,
    best_model,
    entries_of,
    fit_library,
    make_library,
    score,
    strangers,
)
from polysight.host.materials.truth import (
    TRUTH,
    Plates,
    TruthPlate,
    match_truth,
    read_truth,
    truth_beside,
    truth_labels,
    truth_plates,
)

__all__ = [
    "AMPLITUDE_ERROR",
    "CHANNELS",
    "DISCRIMINANT",
    "FOUND",
    "METALS",
    "MODELS",
    "PAPER",
    "PATCHES",
    "SAME_ANGLE_DEG",
    "SHORT",
    "SIMULATED_LIBRARY",
    "TRUTH",
    "UNKNOWN",
    "UNKNOWN_SCENE",
    "Box",
    "Classifier",
    "ConcentrationResult",
    "Entry",
    "Fit",
    "ImagePair",
    "Inversion",
    "KnownScene",
    "LabelledScan",
    "Layer",
    "LayerFit",
    "Library",
    "MatchedPatch",
    "MaterialsResult",
    "MetalChoice",
    "MetalEvidence",
    "MetalReference",
    "NamedPatch",
    "Optics",
    "Patch",
    "PatchEstimate",
    "PatchResult",
    "Permittivity",
    "Plates",
    "Refused",
    "Samples",
    "Score",
    "Seen",
    "SeenPatches",
    "SegmentSettings",
    "Segmentation",
    "TrainingScan",
    "TruthPlate",
    "Uncertain",
    "Verdict",
    "Weights",
    "analyse",
    "axis_mm",
    "bands_of_row",
    "best_model",
    "box_mask",
    "concentrations",
    "entries_of",
    "entries_of_boxes",
    "estimate_permittivity",
    "feature_matrix",
    "find_metal",
    "fit_concentration",
    "fit_layer",
    "fit_library",
    "fit_weights",
    "format_permittivity",
    "image_centre_mm",
    "invert",
    "is_metal",
    "label_folders",
    "labels_of",
    "make_library",
    "match_patches",
    "match_truth",
    "median_ratio",
    "metal_by_label",
    "metal_evidence",
    "metal_in_box",
    "pack_patches",
    "patches_from_labels",
    "patches_from_plates",
    "permittivity_change",
    "pixel_accuracy",
    "polarisation_angle_rad",
    "ratio_error",
    "read_labelled_scan",
    "read_labels",
    "read_material",
    "read_materials",
    "read_patches",
    "read_truth",
    "reading_of",
    "score",
    "segment",
    "strangers",
    "told_angle",
    "truth_beside",
    "truth_labels",
    "truth_plates",
    "with_bands",
    "write_labels",
]
