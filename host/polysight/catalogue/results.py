"""Results of processed scans for pages and commands.

`read_result` collects all results of a scan, `probe` those at one place of its image, and `compare` the differences
between two scans.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np
import skimage
from numpy.typing import NDArray

from polysight.catalogue.pictures import AMPLITUDE_COLOURS, MAPS, Map, Picture, Pixels, draw_values
from polysight.catalogue.scans import read_generation
from polysight.materials import PATCHES_FILE, SIMULATED_LIBRARY, Library, is_metal
from polysight.pipeline import Pipeline
from polysight.polarimetry import permittivity_from_ratio
from polysight.products import (
    IMAGE,
    MATERIALS,
    QUALITY,
    REPORT,
    SCAN,
    MapValues,
    find_labels,
    find_scan_folder,
    label_folder,
    percentile,
    read_products,
)
from polysight.results import ComplexNumber, PatchFigures, PermittivityFigures, Verdict
from polysight.store import MANIFEST, ScanFolder
from polysight.surfaces import POINTS, SURFACE
from polysight_shared.errors import DataError, ErrorCode, PolysightError

Real = NDArray[np.float64]
EXPORT_FOLDER = "export"
"""Folder, inside that of a scan, for the exports that were requested on a page."""
FILES = (REPORT, IMAGE, MATERIALS, QUALITY, SCAN, PATCHES_FILE, SURFACE, POINTS)
EXPORTS = (".mat", ".csv", ".nc")
# Number of materials of the library that a probe lists; chosen.
MAX_NEAREST = 5
# Reach of the range profile to either side of the place; chosen.
PROFILE_REACH_M = 0.3
# Number of points of the range profile; chosen.
PROFILE_POINTS = 121
# Lowest level of the range profile, relative to its highest; chosen.
PROFILE_FLOOR_DB = -50.0
# Smallest standard deviation of a material's V / H between its patches, in each part. Chosen: a material with a single
# patch shows no deviation.
LEAST_SPREAD = 5e-3
# Colour map of matplotlib for differences: white at zero.
DIFFERENCE_COLOURS = "RdBu"
SIGNIFICANT_STDS = 3.0
"""Standard deviations above which a difference is significant."""
# Smallest result of `measure_scatter`; chosen. Between a scan and a copy of it the scatter would be 0.
LEAST_SCATTER = 0.1
# Largest distance of the centres of one patch in two scans; chosen, smaller than the distance of neighbouring plates.
NEAR_MM = 15.0


# --- all results of a scan ---


class DrawnLabels(msgspec.Struct, frozen=True):
    """Boxes drawn by hand, in millimetres (x0, y0, x1, y1), or the `problem` of their file."""

    boxes: dict[str, tuple[float, float, float, float]] = {}
    metal: str | None = None
    specimens: dict[str, str] = {}
    problem: str = ""


class File(msgspec.Struct, frozen=True):
    """A file that may be downloaded: its folder (`products` or `export`), name and size."""

    of: str
    name: str
    bytes: int


class Result(msgspec.Struct, frozen=True, kw_only=True):
    """A processed scan for its page; `metal` says how the metal reference was chosen.

    `generation` distinguishes these products from those that replace them, `extent_mm` is x from, to, y from, to.
    """

    generation: str
    processed_utc: str
    extent_mm: tuple[float, float, float, float]
    pictures: list[Map]
    metal: str
    verdict: Verdict | None
    patches: list[PatchFigures]
    labels: DrawnLabels | None
    files: list[File]


def read_result(folder: Path) -> Result:
    """Collect the products of a scan folder, or of a folder of products.

    Raises
    ------
    DataError
        if there are none, or one is damaged.
    """
    pixels = Pixels(read_products(folder).folder)
    metal_how = ""
    if pixels.materials is not None and pixels.materials.metal_reference:
        metal_how = pixels.materials.metal_reference.how
    return Result(
        generation=read_generation(pixels.folder),
        processed_utc=pixels.facts.processed_utc or "",
        extent_mm=pixels.extent_mm,
        pictures=[picture for picture in MAPS.values() if pixels.referenced or not picture.needs_metal],
        metal=metal_how,
        verdict=pixels.verdict,
        patches=pixels.segments,
        labels=_load_labels(folder, pixels),
        files=list_files(folder),
    )


def _load_labels(folder: Path, pixels: Pixels) -> DrawnLabels | None:
    """Return the boxes drawn by hand, or the problem of their file; None if there is no such file."""
    try:
        labelled = find_labels(folder)
        if labelled is None:
            return None
        _, labels = labelled
        labels = labels.convert_to_mm(pixels.x_m, pixels.y_m)
    except PolysightError as e:
        return DrawnLabels(problem=f"{label_folder(folder)}: {e.what}")
    return DrawnLabels(dict(labels.boxes), labels.metal, dict(labels.specimens))


def list_files(folder: Path) -> list[File]:
    """Return the downloadable files of a scan's products and exports."""
    products = read_products(folder).folder
    files = []
    for group, group_folder in (("products", products), (EXPORT_FOLDER, folder / EXPORT_FOLDER)):
        if group_folder.is_symlink() or not group_folder.is_dir():
            continue
        for path in sorted(group_folder.iterdir()):
            is_listed = path.name in FILES or path.suffix in EXPORTS
            if is_listed and path.is_file() and not path.is_symlink():
                files.append(File(group, path.name, path.stat().st_size))
    return files


# --- one place ---


class FocusedProfile(msgspec.Struct, frozen=True):
    """Range profile with all positions focused on a place.

    `path_m` are paths minus the path of an echo from the place; `boards` has the level of each board at these paths, dB
    relative to the highest level of all boards.
    """

    path_m: list[float]
    boards: dict[str, list[float]]


class NearMaterial(msgspec.Struct, frozen=True):
    """A material of the library.

    `sigmas` is the distance of its V / H from that of the pixel, in standard deviations; `permittivity` is that of a
    half space with the material's V / H.
    """

    name: str
    sigmas: float | None
    permittivity: ComplexNumber | None


class Probe(msgspec.Struct, frozen=True, kw_only=True):
    """All results at one place; None where there is no value.

    Attributes
    ----------
    place_mm
        Centre of the pixel, from the middle of the image.
    lit
        True if the scan illuminates it.
    h_db, v_db, p, p_sigma
        Levels of H and V, their ratio, and its standard deviation; relative to metal where `referenced`.
    permittivity, permittivity_real_std, permittivity_loss_std
        Permittivity of a half space and its standard deviations, as in the map of permittivities. If it is unknown,
        `why` gives the reason.
    patch
        The patch whose outline holds the place.
    nearest
        The nearest materials of the library, by the distance of their V / H.
    profile
        Range profile focused on the place. If there is none, `profile_why` gives the reason.
    """

    place_mm: tuple[float, float]
    lit: bool
    h_db: float | None
    v_db: float | None
    p: ComplexNumber
    p_sigma: float | None
    referenced: bool
    permittivity: ComplexNumber | None
    permittivity_real_std: float | None
    permittivity_loss_std: float | None
    why: str
    patch: PatchFigures | None
    nearest: list[NearMaterial]
    profile: FocusedProfile | None
    profile_why: str


def probe(folder: Path, x_mm: float, y_mm: float, library: Path | None = None) -> Probe:
    """Read all results of a processed scan at one place, in mm from the middle of the image.

    `library` names materials (None: the simulated one).

    Raises
    ------
    DataError
        if there are no products, or the place lies outside the image.
    """
    pixels = Pixels(read_products(folder).folder)
    row, column = pixels.nearest(x_mm, y_mm)
    pixel_mm = (float(pixels.x_mm[column]), float(pixels.y_mm[row]))
    reason = _explain_no_permittivity(pixels, row, column)
    eps = None
    real_std = None
    loss_std = None
    if not reason:
        eps = _split_parts(complex(pixels.permittivity.value[row, column]))
        real_std = _number(pixels.permittivity.real_std[row, column])
        loss_std = _number(pixels.permittivity.loss_std[row, column])
    nearest_materials = _rank_materials(pixels, row, column, library) if eps else []
    patch = _find_patch(pixels.segments, pixel_mm) if pixels.referenced else None
    profile, profile_why = _focus_profile(folder, float(pixels.x_m[column]), float(pixels.y_m[row]))
    return Probe(
        place_mm=(round(pixel_mm[0], 2), round(pixel_mm[1], 2)),
        lit=bool(pixels.valid[row, column]),
        h_db=_convert_to_db(complex(pixels.h[row, column])),
        v_db=_convert_to_db(complex(pixels.v[row, column])),
        p=_split_parts(complex(pixels.p[row, column])),
        p_sigma=_number(pixels.p_std[row, column]),
        referenced=pixels.referenced,
        permittivity=eps,
        permittivity_real_std=real_std,
        permittivity_loss_std=loss_std,
        why=reason,
        patch=patch,
        nearest=nearest_materials,
        profile=profile,
        profile_why=profile_why,
    )


def _explain_no_permittivity(pixels: Pixels, row: int, column: int) -> str:
    """Return why a pixel has no permittivity; empty if it has one."""
    if not pixels.referenced:
        return "the images are not referenced to metal, or support no result"
    if not pixels.clear[row, column]:
        return "too dark: only noise"
    if not pixels.permittivity.mask[row, column]:
        return "too close to metal, where any large permittivity looks the same, or the edge of a plate"
    return ""


def _find_patch(patches: list[PatchFigures], place_mm: tuple[float, float]) -> PatchFigures | None:
    """Return the patch whose outline encloses a place; None if there is none."""
    for patch in patches:
        outline = patch.outline_mm
        if len(outline) < 3:
            continue
        is_inside = skimage.measure.points_in_poly([place_mm], outline)
        if is_inside.all():
            return patch
    return None


@lru_cache(maxsize=4)
def _average_library(path: Path, changed_ns: int, angle_deg: float) -> dict[str, tuple[complex, float]]:
    """Return material to the mean V / H of its patches in the library, and to their standard deviation in each part.

    `changed_ns` is a part of the cache's key: a file that has changed is read again.
    """
    del changed_ns
    patches: dict[str, list[complex]] = {}
    for entry in Library.load(path).at_angle(angle_deg).entries:
        inverse = 1 / entry.p
        patches.setdefault(entry.name, []).append(complex(np.median(inverse.real), np.median(inverse.imag)))
    ratios = {}
    for name, values in patches.items():
        means = np.array(values)
        spread = 0.0
        if len(means) > 1:
            spread = float(np.sqrt(np.mean(np.abs(means - means.mean()) ** 2) / 2))
        ratios[name] = (complex(means.mean()), spread)
    return ratios


def _rank_materials(pixels: Pixels, row: int, column: int, library: Path | None) -> list[NearMaterial]:
    """Return the library's materials that are nearest to a pixel, by the distance of V / H in standard deviations.

    The standard deviations are those of the pixel and of the material together.
    """
    path = library or SIMULATED_LIBRARY
    try:
        ratios = _average_library(path, path.stat().st_mtime_ns, float(np.degrees(pixels.theta_rad)))
    except (PolysightError, OSError):
        # The library was made at another angle, or cannot be read.
        return []
    # Ratios are compared as V / H = 1 / P, which has the error of P over |P|^2.
    p = complex(pixels.p[row, column])
    p_std = float(pixels.p_std[row, column])
    pixel_std = 0.0
    if np.isfinite(p_std):
        pixel_std = p_std / max(abs(p) ** 2, 1e-9)
    materials = []
    for name, (mean, spread) in ratios.items():
        std = float(np.hypot(pixel_std, max(spread, LEAST_SPREAD)))
        eps = None
        if mean and not is_metal(name):
            half_space = complex(permittivity_from_ratio(1 / mean, pixels.theta_rad))
            if np.isfinite(half_space):
                eps = _split_parts(half_space)
        sigmas = None
        if p:
            sigmas = round(abs(1 / p - mean) / std, 1)
        materials.append(NearMaterial(name, sigmas, eps))
    return sorted(materials, key=_sort_by_sigmas)[:MAX_NEAREST]


def _sort_by_sigmas(material: NearMaterial) -> float:
    """Return the distance of a material as a key for sorting; unknown ones come last."""
    if material.sigmas is None:
        return math.inf
    return material.sigmas


def _focus_profile(folder: Path, x_m: float, y_m: float) -> tuple[FocusedProfile | None, str]:
    """Return the range profile focused on a place, from the scan's kept samples; or None and the reason."""
    scan = find_scan_folder(folder)
    if scan is None or not (scan / MANIFEST).exists():
        return None, "the rows are not in this folder"
    samples = scan / "samples" / "rows.jsonl"
    try:
        pipeline = None
        if samples.exists():
            pipeline = _restore_rows(scan, samples.stat().st_mtime_ns)
    except (PolysightError, OSError) as e:
        return None, str(e).splitlines()[0]
    if pipeline is None:
        return None, "no samples were kept of this scan: `polysight process` makes them"
    shifts = np.linspace(-PROFILE_REACH_M, PROFILE_REACH_M, PROFILE_POINTS)
    point = np.array([x_m, y_m, float(np.mean(pipeline.builder.grid.z_m))])
    levels = {name: np.abs(board.range_profile(point, shifts)) for name, board in pipeline.builder.boards.items()}
    highest = max(float(level.max()) for level in levels.values()) or 1.0
    boards = {}
    for name, level in levels.items():
        level_db = 20 * np.log10(np.maximum(level / highest, 1e-9))
        boards[name] = np.maximum(level_db, PROFILE_FLOOR_DB).round(1).tolist()
    return FocusedProfile(shifts.round(4).tolist(), boards), ""


@lru_cache(maxsize=2)
def _restore_rows(scan: Path, changed_ns: int) -> Pipeline | None:
    """Return a pipeline with the stored samples of every row; None if some rows have none.

    `changed_ns` is a part of the cache's key: changed samples are read again.
    """
    del changed_ns
    pipeline = Pipeline(ScanFolder.load(scan), samples="read")
    rows = list(pipeline.source.rows())
    if rows and all(map(pipeline.samples.restore, rows)):
        return pipeline
    return None


def _convert_to_db(value: complex) -> float | None:
    """Return the level of an amplitude in dB; None for zero and for values that are not finite."""
    if value and np.isfinite(value):
        return round(float(20 * np.log10(abs(value))), 2)
    return None


def _number(value: float) -> float | None:
    """Return a number rounded for JSON; None if it is not finite."""
    if not np.isfinite(value):
        return None
    return round(float(value), 5)


def _split_parts(value: complex) -> ComplexNumber:
    """Return a complex number as its parts, None for those that are not finite."""
    return ComplexNumber(_number(value.real), _number(value.imag))


# --- two scans ---


class PermittivityDifference(msgspec.Struct, frozen=True):
    """Permittivity of the first patch minus that of the second, with standard errors if those of both are known."""

    real: float
    imag: float
    real_std: float | None = None
    imag_std: float | None = None


class PatchPair(msgspec.Struct, frozen=True, kw_only=True):
    """Patches of two scans at one place; `sigmas` is their difference in standard deviations."""

    place_mm: tuple[float, float]
    names: tuple[str | None, str | None]
    labels: tuple[int, int]
    permittivity: tuple[PermittivityFigures | None, PermittivityFigures | None]
    difference: PermittivityDifference | None = None
    sigmas: float | None = None


class ComparisonFigures(msgspec.Struct, frozen=True, kw_only=True):
    """A comparison without its maps; `extent_mm` is that of the first scan: x from, to, y from, to.

    Attributes
    ----------
    patches
        Pairs of patches at one place.
    notes
        Reasons why the two are hard to compare.
    compared, significant_share
        Number of pixels, and the share of them that differs by more than `significant_sigmas`; None: not known.
    scatter
        Scatter of unchanged pixels relative to their stated errors, see :func:`measure_scatter`; None if the errors are
        not known.
    """

    patches: list[PatchPair]
    notes: list[str]
    extent_mm: tuple[float, float, float, float]
    compared: int
    significant_share: float | None
    scatter: float | None
    significant_sigmas: float = SIGNIFICANT_STDS


@dataclass(frozen=True)
class Comparison:
    """Differences of the first scan minus the second, on the first one's pixels [ny, nx].

    Attributes
    ----------
    p, permittivity
        complex128; nan where one of the scans has no value.
    sigmas
        float64: |difference of P| in standard deviations of such differences; nan where the error is not known.
    """

    p: NDArray[np.complex128]
    permittivity: NDArray[np.complex128]
    sigmas: Real
    figures: ComparisonFigures


def compare(first: Path, second: Path) -> Comparison:
    """Compare two folders of products, see :func:`compare_pixels`. Raises DataError."""
    a = Pixels(read_products(first).folder)
    b = Pixels(read_products(second).folder)
    return compare_pixels(a, b, names=(str(first), str(second)))


def compare_pixels(a: Pixels, b: Pixels, names: tuple[str, str]) -> Comparison:
    """Compare two processed scans, pixel by pixel and patch by patch; `names` stand for them in error messages.

    Raises
    ------
    DataError
        if one of them is not referenced to metal, or they show different places.
    """
    for name, pixels in zip(names, (a, b), strict=True):
        if not pixels.referenced:
            raise DataError(
                f"{name}: cannot be compared", "its images are not referenced to metal, or support no result",
                "process it with a metal reference", code=ErrorCode.NO_DATA,
            )  # fmt: skip
    rows, row_inside = _match_axes(a.y_mm, b.y_mm)
    columns, column_inside = _match_axes(a.x_mm, b.x_mm)
    same_place = np.ix_(rows, columns)
    is_in_both = row_inside[:, None] & column_inside[None, :] & a.clear & b.clear[same_place]
    if not is_in_both.any():
        raise DataError(
            "the two scans have no area in common", "their images lie apart, or one of them is dark",
            "choose other scans", code=ErrorCode.MISMATCH,
        )  # fmt: skip
    p = np.where(is_in_both, a.p - b.p[same_place], np.nan).astype(np.complex128)
    known_in_both = is_in_both & a.permittivity.mask & b.permittivity.mask[same_place]
    eps = np.where(known_in_both, a.permittivity.value - b.permittivity.value[same_place], np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        in_stated_errors = np.abs(p) / np.hypot(a.p_std, b.p_std[same_place])
    scatter = measure_scatter(in_stated_errors)
    sigmas = in_stated_errors / scatter
    known_sigmas = sigmas[np.isfinite(sigmas)]
    significant_share = None
    if known_sigmas.size:
        significant_share = float((known_sigmas > SIGNIFICANT_STDS).mean())
    figures = ComparisonFigures(
        patches=_pair_patches(a.segments, b.segments),
        notes=_collect_notes(a, b, scatter),
        extent_mm=a.extent_mm,
        compared=int(np.isfinite(p).sum()),
        significant_share=significant_share,
        scatter=None if np.isnan(scatter) else round(scatter, 3),
    )
    return Comparison(p, eps, sigmas, figures)


def measure_scatter(differences: Real) -> float:
    """Estimate the scatter of unchanged pixels relative to their stated errors, 0.1 to 1; NaN if no error is known.

    `differences` are |difference of P| / stated error. The scatter is below 1, because stated errors include those that
    both scans share (leakage, metal reference, sidelobes), which cancel in a difference. It is estimated from the
    median, so that changes in less than half of the image hardly matter: the median of a complex normal error with unit
    variance in each part is sqrt(2 ln 2).
    """
    finite = differences[np.isfinite(differences)]
    if finite.size == 0:
        return float("nan")
    return float(np.clip(np.median(finite) / np.sqrt(2 * np.log(2)), LEAST_SCATTER, 1.0))


def _match_axes(first: Real, second: Real) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return for each of `first` (mm) the index of the nearest of `second`, and if they agree within half a pixel."""
    nearest_index = np.abs(first[:, None] - second[None, :]).argmin(axis=1)
    pixel = max(abs(second[1] - second[0]), abs(first[1] - first[0]))
    # Half a pixel, and a hundredth of one for rounding.
    return nearest_index, np.abs(first - second[nearest_index]) <= pixel * 0.51


def _collect_notes(a: Pixels, b: Pixels, scatter: float) -> list[str]:
    """Return notes on what limits a comparison of two scans; `scatter` is the result of :func:`measure_scatter`."""
    notes = []
    if scatter < 1:
        notes.append(
            f"unchanged pixels differ by {scatter:.2f} of their stated errors only, because the two scans share most of"
            " these errors; significance is counted in units of that scatter"
        )
    a_deg = float(np.degrees(a.theta_rad))
    b_deg = float(np.degrees(b.theta_rad))
    # |P| changes by about a tenth in a degree; the limit is chosen.
    if abs(a_deg - b_deg) > 0.5:
        notes.append(f"the incidence angles differ: {a_deg:.1f} and {b_deg:.1f} degrees; P depends on them")
    if a.simulated != b.simulated:
        notes.append("one of the two is simulated")
    if not (np.isfinite(a.p_std).any() and np.isfinite(b.p_std).any()):
        notes.append("the errors of one are not known (processed by an earlier release): significance cannot be judged")
    return notes


def _pair_patches(first: list[PatchFigures], second: list[PatchFigures]) -> list[PatchPair]:
    """Return each patch of the first scan with the nearest one of the second, if their centres are at one place."""
    pairs = []
    candidates = [patch for patch in second if not patch.metal_reference]
    for patch in first:
        if patch.metal_reference or not candidates:
            continue
        nearest_patch = min(candidates, key=lambda other, patch=patch: _measure_distance_mm(patch, other))
        if _measure_distance_mm(patch, nearest_patch) <= NEAR_MM:
            pairs.append(_describe_pair(patch, nearest_patch))
    return pairs


def _measure_distance_mm(a: PatchFigures, b: PatchFigures) -> float:
    """Return the distance of the centres of two patches."""
    return float(np.hypot(a.centre_x_mm - b.centre_x_mm, a.centre_y_mm - b.centre_y_mm))


def _describe_pair(a: PatchFigures, b: PatchFigures) -> PatchPair:
    """Compare two patches; the difference has standard errors if both have a covariance, and their sum is regular."""
    pair = PatchPair(
        place_mm=(round(a.centre_x_mm, 1), round(a.centre_y_mm, 1)),
        names=(a.name, b.name),
        labels=(a.label, b.label),
        permittivity=(a.permittivity, b.permittivity),
    )
    if a.permittivity is None or b.permittivity is None:
        return pair
    difference = a.permittivity.value - b.permittivity.value
    covariance = _read_covariance(a.permittivity) + _read_covariance(b.permittivity)
    real = round(difference.real, 4)
    imag = round(difference.imag, 4)
    if not np.isfinite(covariance).all() or np.linalg.det(covariance) <= 0:
        return msgspec.structs.replace(pair, difference=PermittivityDifference(real, imag))
    # The difference d = (real, imaginary) in standard deviations is sqrt(d^T C^-1 d) with the covariance C.
    parts = np.array([difference.real, difference.imag])
    real_std, imag_std = (round(float(std), 4) for std in np.sqrt(np.diag(covariance)))
    return msgspec.structs.replace(
        pair,
        difference=PermittivityDifference(real, imag, real_std, imag_std),
        sigmas=round(float(np.sqrt(parts @ np.linalg.solve(covariance, parts))), 2),
    )


def _read_covariance(permittivity: PermittivityFigures) -> Real:
    """Return the covariance [2, 2] of (real, imaginary); nan if an earlier release did not write it."""
    if permittivity.covariance is None:
        return np.full((2, 2), np.nan)
    return np.array(permittivity.covariance, np.float64)


def draw_comparison(comparison: Comparison, name: str) -> Picture:
    """Draw a map of differences: `p` (|difference of P|), `sigmas`, `permittivity` or `loss` (first minus second).

    Raises DataError where there is no such map.
    """
    maps = {
        "p": np.abs(comparison.p),
        "sigmas": comparison.sigmas,
        "permittivity": comparison.permittivity.real,
        "loss": -comparison.permittivity.imag,
    }
    if name not in maps:
        raise DataError(
            f"no map is called {name[:40]!r}", "the name is wrong", f"one of {', '.join(maps)}",
            code=ErrorCode.VALUE_INVALID,
        )  # fmt: skip
    values = maps[name]
    visible = np.isfinite(values)
    is_signed = name in ("permittivity", "loss")
    # The colours end at this percentile (chosen), so that few extreme pixels do not set them.
    percent = 95 if is_signed else 98
    reach = max(percentile(np.abs(values), visible, percent, default=1.0), 1e-3)
    if name == "sigmas":
        reach = max(reach, 2 * SIGNIFICANT_STDS)
    limits = (-reach, reach) if is_signed else (0.0, reach)
    return draw_values(
        MapValues(values, visible, limits), colours=DIFFERENCE_COLOURS if is_signed else AMPLITUDE_COLOURS
    )
