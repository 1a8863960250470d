"""Materials: find patches in the two images, estimate their permittivities, and name them.

`analyse` takes the images, the `Optics` and known facts of the scene (`KnownScene`, the metal reference among them); it
returns a `MaterialsResult`. On the way: `segment.py` finds patches, `measure.py` measures
them, `metal.py` finds and judges the metal reference, `inversion.py` solves for all permittivities and the rig's errors
together, `kinds.py` says what a patch may be, `names.py` names it, `classify.py` holds the library's models;
`discriminant.py` learns the spread of specimens, placements and scans from a library. `sub_bands.py` and `layers.py`
fit thin layers. `make_library` makes a library of scans, `fit_concentration` a line through solutions. `labels.py`
reads boxes with names and true plates, `catalogue.py` the permittivities of the literature, `train.py` the published
data set.
"""

from typing import TYPE_CHECKING, Any

from polysight.materials.analyse import (
    STEEP,
    KnownScene,
    Optics,
    analyse,
    name_permittivity,
    permittivity_change,
)
from polysight.materials.catalogue import (
    CATALOGUE,
    CatalogueMaterial,
    find_material,
    load_catalogue,
    normalise_name,
    read_catalogue,
    same_material,
)
from polysight.materials.classify import (
    DISCRIMINANT,
    MODELS,
    PAPER,
    SHORT,
    Classifier,
    classifier_sentence,
)
from polysight.materials.copies import find_copies
from polysight.materials.discriminant import REJECTED, ErrorDiscriminant
from polysight.materials.kinds import permittivity_slope
from polysight.materials.labels import (
    METALS,
    SPECIMEN,
    Labels,
    Plates,
    box_name,
    check_labels,
    clean_name,
    find_label_file,
    find_truth,
    format_box,
    image_extent_mm,
    is_metal,
    material_name,
    name_taken,
    no_box,
    pack_labels,
    patches_from_plates,
    read_labels,
    read_truth,
    specimen_seed,
    truth_plates,
)
from polysight.materials.layers import METAL, Layer, LayerFit
from polysight.materials.library import (
    CHANNELS,
    SAME_ANGLE_DEG,
    SIMULATED_LIBRARY,
    Entry,
    Library,
    Model,
    Samples,
    feature_matrix,
    ratio_columns,
    split_by_angle,
)
from polysight.materials.measure import NOT_PASSIVE, Permittivity, estimate_permittivity, format_permittivity
from polysight.materials.names import LAYER, UNKNOWN, NamedPatch, PatchName
from polysight.materials.result import (
    PATCHES,
    MatchedPatch,
    MaterialsResult,
    ScanPatches,
    make_labels,
    match_patches,
    pack_patches,
    pixel_accuracy,
    predict_pixel_accuracy,
    read_patches,
)
from polysight.materials.segment import (
    Box,
    SegmentSettings,
    TruthPlate,
    axis_mm,
    box_mask,
    find_interiors,
    image_centre_mm,
    match_truth,
)
from polysight.materials.sub_bands import (
    AMPLITUDE_ERROR,
    LAYER_FORMS,
    ConcentrationResult,
    add_bands,
    concentrations,
    fit_concentration,
    fit_row,
    incidence_std_rad,
    layer_content,
    parse_layer,
    polarisation_angle_rad,
)
from polysight.materials.train import (
    LabelledScan,
    Score,
    TrainingScan,
    angle_in_text,
    calibration_error,
    entries_of_boxes,
    fit_library,
    image_orientation,
    label_folders,
    make_library,
    read_labelled_scan,
    read_material,
    read_materials,
    score,
    score_unseen_materials,
)
from polysight.materials.training_advice import accuracy_lines

if TYPE_CHECKING:
    from polysight.materials.paper_knn import PaperKNeighborsClassifier

__all__ = [
    "AMPLITUDE_ERROR",
    "CATALOGUE",
    "CHANNELS",
    "DISCRIMINANT",
    "LAYER",
    "LAYER_FORMS",
    "METAL",
    "METALS",
    "MODELS",
    "NOT_PASSIVE",
    "PAPER",
    "PATCHES",
    "REJECTED",
    "SAME_ANGLE_DEG",
    "SHORT",
    "SIMULATED_LIBRARY",
    "SPECIMEN",
    "STEEP",
    "UNKNOWN",
    "Box",
    "CatalogueMaterial",
    "Classifier",
    "ConcentrationResult",
    "Entry",
    "ErrorDiscriminant",
    "KnownScene",
    "LabelledScan",
    "Labels",
    "Layer",
    "LayerFit",
    "Library",
    "MatchedPatch",
    "MaterialsResult",
    "Model",
    "NamedPatch",
    "Optics",
    "PaperKNeighborsClassifier",
    "PatchName",
    "Permittivity",
    "Plates",
    "Samples",
    "ScanPatches",
    "Score",
    "SegmentSettings",
    "TrainingScan",
    "TruthPlate",
    "accuracy_lines",
    "add_bands",
    "analyse",
    "angle_in_text",
    "axis_mm",
    "box_mask",
    "box_name",
    "calibration_error",
    "check_labels",
    "classifier_sentence",
    "clean_name",
    "concentrations",
    "entries_of_boxes",
    "estimate_permittivity",
    "feature_matrix",
    "find_copies",
    "find_interiors",
    "find_label_file",
    "find_material",
    "find_truth",
    "fit_concentration",
    "fit_library",
    "fit_row",
    "format_box",
    "format_permittivity",
    "image_centre_mm",
    "image_extent_mm",
    "image_orientation",
    "incidence_std_rad",
    "is_metal",
    "label_folders",
    "layer_content",
    "load_catalogue",
    "make_labels",
    "make_library",
    "match_patches",
    "match_truth",
    "material_name",
    "name_permittivity",
    "name_taken",
    "no_box",
    "normalise_name",
    "pack_labels",
    "pack_patches",
    "parse_layer",
    "patches_from_plates",
    "permittivity_change",
    "permittivity_slope",
    "pixel_accuracy",
    "polarisation_angle_rad",
    "predict_pixel_accuracy",
    "ratio_columns",
    "read_catalogue",
    "read_labelled_scan",
    "read_labels",
    "read_material",
    "read_materials",
    "read_patches",
    "read_truth",
    "same_material",
    "score",
    "score_unseen_materials",
    "specimen_seed",
    "split_by_angle",
    "truth_plates",
]


def __getattr__(name: str) -> Any:
    """Import the estimator when it is first used: it imports scikit-learn, which most commands do not need."""
    if name != "PaperKNeighborsClassifier":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from polysight.materials.paper_knn import PaperKNeighborsClassifier

    return PaperKNeighborsClassifier
