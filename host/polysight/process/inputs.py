"""Inputs of processing that the settings name: a file of labelled boxes, the scan of a metal plate, and the library."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy.typing as npt

from polysight.materials import SAME_ANGLE_DEG, SIMULATED_LIBRARY, Classifier, KnownScene, Labels, Library, check_labels
from polysight.polarimetry import PlaneReference
from polysight.settings import Settings
from polysight_shared.config import Instrument
from polysight_shared.geometry import incidence_deg


@dataclass(frozen=True)
class Inputs:
    """Content of the label file and of the processed scan of a metal plate; None if the settings do not name it."""

    labels: Labels | None = None
    reference: PlaneReference | None = None


# Settings that name no files.
NO_INPUTS = Inputs()


def convert_boxes_to_patches(settings: Settings, inputs: Inputs, x_m: npt.ArrayLike, y_m: npt.ArrayLike) -> KnownScene:
    """Return the boxes of the label file as patches of an image with axes `x_m`, `y_m`, and the metal in the scene.

    If the settings give a metal box, it is the metal. Otherwise, with the scan of a metal plate, no metal in the scene
    is used; without it, the metal is the first box that the labels declare to be metal. Without a label file, patches
    are searched for later.

    Raises DataError if a box contains no pixel, and if labels drawn by hand are invalid (`check_labels`).
    """
    labels = inputs.labels
    if labels is None:
        return KnownScene(metal=settings.metal_box_mm)
    if labels.by_hand:
        labels = check_labels(labels, x_m, y_m)
    patches, names = labels.patches(x_m, y_m)
    if inputs.reference is not None or settings.metal_box_mm is not None:
        return KnownScene(patches, settings.metal_box_mm, names)
    metal = next((number for number, name in names.items() if labels.is_metal(name)), None)
    return KnownScene(patches, metal, names)


def explain_unnamed(settings: Settings, rig: Instrument, will_be: bool = False) -> str:
    """Return the reason why nothing was named in scans of a rig, as sentences; "" if names are given.

    With `will_be` the sentences are about a scan that is processed later.

    Raises DataError if the library cannot be loaded.
    """
    verb = "will be" if will_be else "was"
    if settings.model == "none":
        return f"Nothing {verb} named: naming was left out (--model none)."
    path = library_path(settings)
    # This is the angle of H; the angle of V is nearly the same.
    angle = incidence_deg(rig, rig.receivers[0])
    known_angles = _load_library(path, _find_stamp(path)).angles_deg
    # An empty library is refused later, by `Classifier`.
    if not known_angles or any(abs(library_angle - angle) <= SAME_ANGLE_DEG for library_angle in known_angles):
        return ""
    return (
        f"Nothing {verb} named: the scan looks at {angle:.1f} degrees of incidence, and {path.name} contains"
        f" {' and '.join(f'{a:g}' for a in known_angles)} degrees only (|P| changes by a tenth in a degree)."
        " Train a library at this angle, and process the scan again with --library."
    )


def load_classifier(settings: Settings, rig: Instrument) -> Classifier | None:
    """Return the classifier for scans of a rig; None without naming, see :func:`explain_unnamed`. Raises DataError."""
    if explain_unnamed(settings, rig):
        return None
    path = library_path(settings)
    return _fit_classifier(path, _find_stamp(path), settings.model, incidence_deg(rig, rig.receivers[0]))


# A scan needs the classifier twice: to check its settings before its rows are read, and to name its patches afterwards.
# Two classifiers are kept, because scans of two angles may be processed in turn.
@lru_cache(2)
def _fit_classifier(path: Path, stamp: tuple[int, int], model: str | None, angle_deg: float) -> Classifier:
    """Return the classifier of the library that the file `path` held at `stamp`."""
    return Classifier(_load_library(path, stamp), model=model, angles_deg=[angle_deg])


@lru_cache(1)
def _load_library(path: Path, stamp: tuple[int, int]) -> Library:  # noqa: ARG001 (a changed file has another stamp)
    """Return the library that the file `path` held at `stamp`."""
    return Library.load(path)


def _find_stamp(path: Path) -> tuple[int, int]:
    """Return time of the last change (ns) and size of a file, which a new file does not share; zeros without a file."""
    try:
        status = path.stat()
    except OSError:
        # `Library.load` raises the error that says what is wrong.
        return (0, 0)
    return (status.st_mtime_ns, status.st_size)


def library_path(settings: Settings) -> Path:
    """Return the file of the settings' reference library; the simulated one if they name none."""
    return settings.path("library") or SIMULATED_LIBRARY
