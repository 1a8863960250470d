"""Materials: patches, permittivity, the reference library and the classifier."""

from polysight.host.materials.analyse import (
    FOUND,
    UNKNOWN_SCENE,
    ImagePair,
    KnownScene,
    MaterialsResult,
    MetalChoice,
    Optics,
    PatchResult,
    analyse,
    image_centre_mm,
    pixel_accuracy,
)
from polysight.host.materials.classify import UNKNOWN, Classifier, NamedPatch, Verdict
from polysight.host.materials.knn import Fit, Weights, fit_weights
from polysight.host.materials.library import Entry, Library
from polysight.host.materials.metal import MetalReference, find_metal, metal_by_label, metal_in_box
from polysight.host.materials.patch_files import patches_from_labels, patches_from_plates, read_labels, write_labels
from polysight.host.materials.permittivity import Permittivity, estimate_permittivity, median_ratio
from polysight.host.materials.segment import Patch, Segmentation, SegmentSettings, segment
from polysight.host.materials.sub_bands import with_bands
from polysight.host.materials.train import TrainingScan, entries_of, fit_library, make_library
from polysight.host.materials.truth import Plates, TruthPlate, read_truth, truth_labels, truth_plates

__all__ = [
    "FOUND",
    "UNKNOWN",
    "UNKNOWN_SCENE",
    "Classifier",
    "Entry",
    "Fit",
    "ImagePair",
    "KnownScene",
    "Library",
    "MaterialsResult",
    "MetalChoice",
    "MetalReference",
    "NamedPatch",
    "Optics",
    "Patch",
    "PatchResult",
    "Permittivity",
    "Plates",
    "SegmentSettings",
    "Segmentation",
    "TrainingScan",
    "TruthPlate",
    "Verdict",
    "Weights",
    "analyse",
    "entries_of",
    "estimate_permittivity",
    "find_metal",
    "fit_library",
    "fit_weights",
    "image_centre_mm",
    "make_library",
    "median_ratio",
    "metal_by_label",
    "metal_in_box",
    "patches_from_labels",
    "patches_from_plates",
    "pixel_accuracy",
    "read_labels",
    "read_truth",
    "segment",
    "truth_labels",
    "truth_plates",
    "with_bands",
    "write_labels",
]
