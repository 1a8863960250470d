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
    KnownScene as KnownScene,
    Optics as Optics,
    analyse as analyse,
    name_permittivity as name_permittivity,
    permittivity_change as permittivity_change,
)
from polysight.materials.catalogue import (
    CATALOGUE as CATALOGUE,
    CatalogueMaterial as CatalogueMaterial,
    find_material as find_material,
    is_same_material as is_same_material,
    load_catalogue as load_catalogue,
    normalise_name as normalise_name,
    read_catalogue as read_catalogue,
)
from polysight.materials.classify import (
    DISCRIMINANT_MODEL as DISCRIMINANT_MODEL,
    MODEL_OF_OPTION as MODEL_OF_OPTION,
    MODELS as MODELS,
    PAPER_MODEL as PAPER_MODEL,
    Classifier as Classifier,
    describe_classifier as describe_classifier,
)
from polysight.materials.common_change import (
    PhaseAlongPlate as PhaseAlongPlate,
    measure_along_plates as measure_along_plates,
)
from polysight.materials.copies import find_copies as find_copies
from polysight.materials.discriminant import REJECTED_SHARE as REJECTED_SHARE, ErrorDiscriminant as ErrorDiscriminant
from polysight.materials.kinds import find_permittivity_slope as find_permittivity_slope
from polysight.materials.labels import (
    METAL_WORDS as METAL_WORDS,
    SPECIMEN_SEPARATOR as SPECIMEN_SEPARATOR,
    Labels as Labels,
    Plates as Plates,
    check_labels as check_labels,
    clean_name as clean_name,
    find_label_file as find_label_file,
    find_truth as find_truth,
    format_box as format_box,
    image_extent_mm as image_extent_mm,
    is_metal as is_metal,
    make_name_taken_error as make_name_taken_error,
    make_patches_from_plates as make_patches_from_plates,
    make_unknown_box_error as make_unknown_box_error,
    normalise_box_name as normalise_box_name,
    pack_labels as pack_labels,
    read_labels as read_labels,
    read_true_plates as read_true_plates,
    read_truth as read_truth,
    remove_specimen as remove_specimen,
    specimen_seed as specimen_seed,
)
from polysight.materials.layers import METAL_PERMITTIVITY as METAL_PERMITTIVITY, Layer as Layer, LayerFit as LayerFit
from polysight.materials.library import (
    CHANNELS as CHANNELS,
    SAME_ANGLE_DEG as SAME_ANGLE_DEG,
    SIMULATED_LIBRARY as SIMULATED_LIBRARY,
    Entry as Entry,
    Library as Library,
    Model as Model,
    Samples as Samples,
    invert_ratios as invert_ratios,
    make_features as make_features,
    split_by_angle as split_by_angle,
)
from polysight.materials.measure import (
    NOT_PASSIVE as NOT_PASSIVE,
    STRONGER_V_REASON as STRONGER_V_REASON,
    Permittivity as Permittivity,
    estimate_permittivity as estimate_permittivity,
)
from polysight.materials.metal import WEAK_V_DB as WEAK_V_DB
from polysight.materials.names import (
    LAYER as LAYER,
    UNKNOWN as UNKNOWN,
    NamedPatch as NamedPatch,
    PatchName as PatchName,
    format_permittivity as format_permittivity,
)
from polysight.materials.patch_files import (
    PATCHES_FILE as PATCHES_FILE,
    MatchedPatch as MatchedPatch,
    ScanPatches as ScanPatches,
    match_patches as match_patches,
    pack_patches as pack_patches,
    read_patches as read_patches,
)
from polysight.materials.result import (
    SMEAR as SMEAR,
    STEEP_FINDING as STEEP_FINDING,
    MaterialsResult as MaterialsResult,
    make_labels as make_labels,
    pixel_accuracy as pixel_accuracy,
    predict_pixel_accuracy as predict_pixel_accuracy,
)
from polysight.materials.segment import (
    Box as Box,
    SegmentSettings as SegmentSettings,
    TruthPlate as TruthPlate,
    axis_mm as axis_mm,
    box_mask as box_mask,
    find_interiors as find_interiors,
    image_centre_mm as image_centre_mm,
    match_truth as match_truth,
)
from polysight.materials.sub_bands import (
    AMPLITUDE_ERROR as AMPLITUDE_ERROR,
    LAYER_FORMS as LAYER_FORMS,
    ConcentrationResult as ConcentrationResult,
    add_bands as add_bands,
    concentrations as concentrations,
    fit_concentration as fit_concentration,
    fit_row as fit_row,
    format_layer_content as format_layer_content,
    incidence_std_rad as incidence_std_rad,
    parse_layer as parse_layer,
    polarisation_angle_rad as polarisation_angle_rad,
)
from polysight.materials.train import (
    LabelledScan as LabelledScan,
    Score as Score,
    TrainingScan as TrainingScan,
    calibration_error as calibration_error,
    find_angle_in_text as find_angle_in_text,
    fit_library as fit_library,
    image_orientation as image_orientation,
    label_folders as label_folders,
    make_entries_of_boxes as make_entries_of_boxes,
    make_library as make_library,
    read_labelled_scan as read_labelled_scan,
    read_material as read_material,
    read_materials as read_materials,
    score as score,
    score_unseen_materials as score_unseen_materials,
)
from polysight.materials.training_advice import describe_accuracy as describe_accuracy

if TYPE_CHECKING:
    from polysight.materials.paper_knn import PaperKNeighborsClassifier as PaperKNeighborsClassifier


def __getattr__(name: str) -> Any:
    """Import the estimator when it is first used: it imports scikit-learn, which most commands do not need."""
    if name != "PaperKNeighborsClassifier":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from polysight.materials.paper_knn import PaperKNeighborsClassifier as PaperKNeighborsClassifier

    return PaperKNeighborsClassifier
