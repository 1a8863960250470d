"""Measure a patch's ratio in sub-bands of the sweep and fit layers to it; fit a concentration to a polarisation angle.

Ratios in sub-bands of the sweep distinguish thin layers, whose reflection changes with frequency, from thick ones. The
error of a ratio has a part common to all sub-bands of a patch (leakage, metal reference, edges and tilt) and an
independent part in each (noise, sidelobes). Differences between sub-bands are therefore known better than each ratio,
and the full covariance of all sub-bands is stored.

`add_bands` measures the ratios for materials.json, which calls a patch a segment. `bands_of_row` reads them from a
segment, and `fit_row` fits the unknown layer of a stack to them.

The polarisation angle Phi = arctan |P| (Eq. 8 of the POLySIGHT paper) falls steadily as sugar is dissolved (section
9.4). `fit_concentration` fits a straight line through known concentrations, which gives unknown ones with a prediction
interval. It is judged by cross-validation: all patches of one concentration are left out together.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
from msgspec import structs

from polysight.imaging import Image, Images, Mask, SubBand
from polysight.materials.analyse import Optics, level, smooth_inside
from polysight.materials.layers import (
    METAL_PERMITTIVITY,
    THICKNESS_RANGE_M,
    Bands,
    Layer,
    LayerFit,
    Spectrum,
    fit_layer,
)
from polysight.materials.library import Library
from polysight.materials.measure import LEAST_STD, NOT_PASSIVE, compute_median_ratio, measure_scatter, relative_errors
from polysight.materials.metal import MetalReference, divide_by_reference
from polysight.materials.result import MaterialsResult, ratio_slopes
from polysight.polarimetry import PlaneReference, inverse_spread, remove_leakage
from polysight.results import BandFigures, ComplexNumber, PatchFigures, ScanMaterials
from polysight_shared.config import Chirp
from polysight_shared.errors import DataError, ErrorCode

AMPLITUDE_ERROR = 0.1
"""Relative standard deviation of |H| of a patch by its size, edges and tilt, which do not affect ratios."""
BAND_SHARE = 0.75
"""Error of V / H of one sub-band relative to the others, divided by the spread over pixels of its difference from V / H
of the whole sweep.

The constants below are measured in simulated scenes of layered plates (benchmarks/layers), unless chosen.
"""
BAND_STD = 5e-4
"""Smallest error of V / H of one sub-band relative to the others, even with uniform pixels; chosen."""
BAND_AMPLITUDE_SHARE = 0.5
BAND_AMPLITUDE_STD = 3e-3
"""Error of ln |H| of one sub-band relative to the others, divided by the spread over pixels of its ratio to |H| of the
whole sweep; and the smallest error. In 42 scenes with metal among sheets the smallest error alone is too small, and a
share of 0.35 to 0.75 is right.
"""
LAYERED_STD_RAD = 2.5e-3
"""Error of the incidence angle with layered plates: echoes from inside make their plane look farther away, by 2.5 mm in
simulated scenes of layered plates only."""
PHASE_PER_ANGLE = 4.5
"""Phase of V / H in radians per radian of that error: the plane is out of focus, and H's board and V's see it from
different points. Measured in the same scenes."""

Real = npt.NDArray[np.float64]
# A concentration in a material's name.
_PERCENT = re.compile(r"(\d+(?:\.\d+)?)\s*%")


def add_bands(
    result: MaterialsResult,
    bands: Sequence[SubBand],
    images: Sequence[Images],
    optics: Optics,
    plane: PlaneReference | None = None,
) -> MaterialsResult:
    """Return the result with each patch's ratios in sub-bands; unchanged without sub-bands.

    `plane` is metal scanned separately, imaged in the same sub-bands. Parameters and errors as :func:`list_band_rows`.
    """
    if not bands:
        return result
    parts = None if plane is None else plane.bands
    return replace(
        result, bands=list_band_rows(result, bands, images, result.inversion.leakage, optics.smooth_px, parts)
    )


def list_band_rows(
    result: MaterialsResult,
    bands: Sequence[SubBand],
    images: Sequence[Images],
    leakage: tuple[complex, complex],
    smooth_px: float,
    references: Sequence[PlaneReference] | None = None,
) -> dict[int, list[BandFigures]]:
    """Return each patch's ratio in each sub-band, for materials.json.

    Parameters
    ----------
    result
        Patches and metal reference, from the whole sweep.
    bands, images
        Sub-bands and their image pairs, [K].
    leakage, smooth_px
        Leakage to remove, of p into H and of s into V; width of the filter against speckle, as for the whole sweep.
    references
        Metal scanned separately, for each sub-band; None: the metal region of the scene.

    Returns
    -------
    Patch number to K entries. Values are None if the sub-band shows no pixel of the patch or of the metal: its
    footprint differs from the whole sweep's.

    Raises
    ------
    DataError
        if the reference was not imaged in these sub-bands.
    """
    if references is not None and len(references) != len(bands):
        raise DataError(
            f"the metal reference has {len(references)} sub-bands, not {len(bands)}",
            "a sub-band is divided by metal in the same part of the sweep",
            f"give a reference with --bands {len(bands)}",
            code=ErrorCode.MISMATCH,
        )
    parts: dict[int, list[BandFigures]] = {patch_result.patch.label: [] for patch_result in result.patches}
    for k, (band, band_images) in enumerate(zip(bands, images, strict=True)):
        reference = references[k] if references is not None else None
        h, v, error = _divide_by_metal(result, band_images, leakage, smooth_px, reference)
        for patch_result in result.patches:
            pixels = patch_result.patch.interior & band_images.valid
            full_band = (result.h[pixels], result.v[pixels])
            parts[patch_result.patch.label].append(_measure_band(band, h[pixels], v[pixels], full_band, error))
    std_by_label = {
        patch_result.patch.label: _estimate_common_std(result, patch_result.patch.interior)
        for patch_result in result.patches
    }
    return {label: _add_covariance(rows, result, std_by_label[label]) for label, rows in parts.items()}


def _estimate_common_std(result: MaterialsResult, interior: Mask) -> float:
    """Return the error of V / H that all sub-bands of a plate have in common, from the scatter over the plate.

    It is the standard deviation of the real part, and of the imaginary part; NaN if it is not known.
    """
    images = result.calibrated
    scatter = measure_scatter(interior, result.h, result.v, images.x_m, images.y_m)
    if scatter is None:
        return float("nan")
    inverse = 1 / compute_median_ratio(result.h[interior], result.v[interior])
    amplitude, phase = relative_errors(scatter, result.ripple)
    return float(np.hypot(abs(inverse) * np.hypot(amplitude, phase) / np.sqrt(2), LEAST_STD))


def _add_covariance(rows: list[BandFigures], result: MaterialsResult, common: float) -> list[BandFigures]:
    """Add the covariance of the errors to a patch's sub-bands; `common` is that of :func:`_estimate_common_std`."""
    ratios = [row.ratio.value for row in rows if row.ratio is not None]
    if len(ratios) < len(rows) or not math.isfinite(common):
        return rows
    # Effects on real and imaginary part of each band's V / H: of six independent errors of leakage and metal reference,
    # and of the plate's common error.
    slopes = ratio_slopes(result.inversion, result.prior, 1 / np.array(ratios, np.complex128)).reshape(2 * len(rows), 6)
    plate_covariance = common * np.tile(np.eye(2), (len(rows), 1))
    variances = np.repeat([(row.own_std or 0.0) ** 2 for row in rows], 2)
    covariance = slopes @ slopes.T + plate_covariance @ plate_covariance.T + np.diag(variances)
    std = np.sqrt(np.diag(covariance).reshape(-1, 2).mean(axis=1))
    return [
        structs.replace(row, inverse_ratio_std=float(std[k]), covariance=covariance[2 * k : 2 * k + 2].tolist())
        for k, row in enumerate(rows)
    ]


def _divide_by_metal(
    result: MaterialsResult,
    images: Images,
    leakage: tuple[complex, complex],
    smooth_px: float,
    reference: PlaneReference | None,
) -> tuple[Image, Image, float]:
    """Return H and V of a sub-band, [ny, nx], relative to metal, and the reference's relative standard error.

    All are NaN if the sub-band shows no metal.
    """
    metal = replace(result.metal, mask=result.metal.mask & images.valid)
    if not metal.mask.any():
        nothing = np.full(images.valid.shape, complex(np.nan, np.nan))
        return nothing, nothing, float("nan")
    # Illuminated as if every patch lay level.
    pair, _ = level(images, result.segmentation, result.tilts)
    h = np.where(images.valid, pair.h, complex(np.nan, np.nan)).astype(pair.h.dtype)
    v = np.where(images.valid, pair.v, complex(np.nan, np.nan)).astype(pair.v.dtype)
    relative = remove_leakage(divide_by_reference(replace(pair, h=h, v=v), metal, reference), leakage)
    h = smooth_inside(relative.h, result.segmentation, smooth_px)
    v = smooth_inside(relative.v, result.segmentation, smooth_px)
    return h, v, _measure_reference_spread(h, v, metal, reference)


def _measure_band(band: SubBand, h: Image, v: Image, sweep_channels: tuple[Image, Image], error: float) -> BandFigures:
    """Return ratio of a patch's pixels [n] in a sub-band, its standard deviations, and |H|; None without usable pixels.

    `sweep_channels` are H and V of the same pixels of the whole sweep, `error` the metal reference's relative error.
    """
    # The ratio is H / V, standard deviations are those of V / H: a relative error of the metal counts times |V / H|.
    ratio = compute_median_ratio(h, v)
    std = math.hypot(inverse_spread(h, v), error / abs(ratio)) if ratio else float("nan")
    if not (math.isfinite(abs(ratio)) and math.isfinite(std)):
        return BandFigures(first_hz=band.first_hz, last_hz=band.last_hz)
    with np.errstate(divide="ignore", invalid="ignore"):
        # Spreads of the differences to the whole sweep.
        spread = inverse_spread(np.ones_like(h), v / h - sweep_channels[1] / sweep_channels[0])
        spread_h = _relative_spread(np.abs(h / sweep_channels[0]))
    own_amplitude_std = None
    if math.isfinite(spread_h):
        own_amplitude_std = math.hypot(BAND_AMPLITUDE_STD, BAND_AMPLITUDE_SHARE * spread_h)
    return BandFigures(
        first_hz=band.first_hz,
        last_hz=band.last_hz,
        ratio=ComplexNumber.from_complex(ratio),
        inverse_ratio_std=std,
        own_std=math.hypot(BAND_STD, BAND_SHARE * spread) if math.isfinite(spread) else std,
        amplitude_h=float(np.nanmedian(np.abs(h))),
        own_amplitude_std=own_amplitude_std,
    )


def _relative_spread(values: Real) -> float:
    """Return the relative standard deviation of positive values [n] (1.48 MAD); NaN without a finite one."""
    values = values[np.isfinite(values)]
    if values.size == 0:
        return float("nan")
    middle = np.median(values)
    return float(1.4826 * np.median(np.abs(values - middle)) / middle)


def bands_of_row(
    row: PatchFigures,
    chirp: Chirp,
    count: int = 1,
    amplitude_error: float = AMPLITUDE_ERROR,
    theta_std_rad: float = 0.0,
) -> Bands | None:
    """Return the input of :func:`polysight.materials.layers.fit_layer` from a segment of materials.json.

    Parameters
    ----------
    row
        The segment.
    chirp
        Chirp of the scan.
    count
        Number of sub-bands: as in the segment, or 1 for the whole sweep.
    amplitude_error
        Relative standard deviation of |H|, common to all sub-bands; 0: |H| is not used.
    theta_std_rad
        Standard deviation of the incidence angle.

    Returns
    -------
    None if the segment has no usable ratio.

    Raises
    ------
    DataError
        if the segment was not processed with so many sub-bands.
    """
    parts = [row] if count == 1 else list(row.bands or ())
    if len(parts) != count:
        raise DataError(
            f"segment {row.label} has {len(parts) or 'no'} sub-bands, {count} are needed",
            "sub-bands are imaged from the recorded rows",
            f"process the scan again with --bands {count}",
            code=ErrorCode.MISMATCH,
        )
    ratios = [part.ratio.value for part in parts if part.ratio is not None]
    errors = [part.inverse_ratio_std for part in parts if part.inverse_ratio_std]
    if len(ratios) < count or len(errors) < count:
        return None
    inverse = 1 / np.array(ratios, np.complex128)
    sigma = np.array(errors)
    spectrum = Spectrum.from_chirp(chirp, count)
    amplitudes = [part.amplitude_h for part in parts]
    shared = [part.covariance for part in row.bands or () if part.covariance]
    covariance = None
    if count > 1 and len(shared) == count:
        covariance = np.array([line for lines in shared for line in lines], np.float64)
    else:
        # One band, or a product of an earlier release without covariance: K bands are then no better than one.
        sigma = np.sqrt(count) * sigma
    theta_std = 0.0
    phase_per_angle = 0.0
    if theta_std_rad:
        theta_std = float(np.hypot(theta_std_rad, LAYERED_STD_RAD))
        phase_per_angle = PHASE_PER_ANGLE
    bands = Bands(
        spectrum, inverse, sigma, covariance=covariance, theta_std_rad=theta_std, phase_per_angle=phase_per_angle
    )
    if not amplitude_error or any(a is None for a in amplitudes):
        return bands
    h = np.array(amplitudes, np.float64)
    if covariance is None:
        return replace(bands, amplitude_h=h, sigma_h=np.sqrt(count) * amplitude_error * h)
    # Products of earlier releases have only the least error.
    relative_std = np.array([part.own_amplitude_std or BAND_AMPLITUDE_STD for part in row.bands or ()])
    return replace(bands, amplitude_h=h, sigma_h=relative_std * h, common_h=amplitude_error)


# Texts that `parse_layer` reads, for help and errors.
LAYER_FORMS = (
    "NAME,REAL,LOSS,MM (known; without MM a half space), NAME,metal, NAME,?,MM (unknown), NAME,?,A-B (its thickness"
    " too, from A to B mm), NAME,?,? (of any thickness) or NAME,? (unknown half space)"
)
# A range of thicknesses, such as 0.5-2.
_RANGE = re.compile(r"([0-9.eE+]+)\s*-\s*([0-9.eE+]+)")


def parse_layer(text: str) -> Layer:
    """Parse a layer in one of `LAYER_FORMS`. Raises ValueError for another form."""
    name, *numbers = (part.strip() for part in text.split(","))
    if numbers == ["metal"]:
        return Layer(name, METAL_PERMITTIVITY)
    if numbers and numbers[0] == "?" and len(numbers) <= 2:
        return _parse_unknown_layer(name, *numbers[1:])
    if len(numbers) not in (2, 3):
        raise ValueError(text)
    real, loss, *thickness = (float(part) for part in numbers)
    if not (np.isfinite(real) and np.isfinite(loss)):
        raise ValueError(text)
    return Layer(name, complex(real, -loss), _convert_to_metres(thickness[0]) if thickness else None)


def _parse_unknown_layer(name: str, size: str = "") -> Layer:
    """Return an unknown layer of this thickness in mm: a number, a range, "?", or "" for a half space.

    Raises ValueError for another text.
    """
    if not size:
        return Layer(name)
    if size == "?":
        return Layer(name, thickness_range_m=THICKNESS_RANGE_M)
    if between := _RANGE.fullmatch(size):
        low, high = (_convert_to_metres(float(mm)) for mm in between.groups())
        if low >= high:
            raise ValueError(size)
        return Layer(name, thickness_range_m=(low, high))
    return Layer(name, None, _convert_to_metres(float(size)))


def _convert_to_metres(mm: float) -> float:
    """Return a thickness in metres. Raises ValueError unless it is positive and finite."""
    if not 0 < mm < np.inf:
        raise ValueError(mm)
    return mm / 1e3


def fit_row(
    row: PatchFigures,
    chirp: Chirp,
    stack: Sequence[Layer],
    bands: int | None = None,
    amplitude_error: float = AMPLITUDE_ERROR,
    theta_std_rad: float = 0.0,
) -> LayerFit | None:
    """Fit the unknown layer of a stack to a segment of materials.json.

    Parameters
    ----------
    row, chirp
        The segment, and the chirp of its scan.
    stack
        Layers in the order the wave meets them, one unknown.
    bands
        Sub-bands to use; None: those of the segment if a thickness is fitted, else the whole sweep.
    amplitude_error
        Relative standard deviation of |H|; 0: it is not used.
    theta_std_rad
        Standard deviation of the incidence angle.

    Returns
    -------
    None for the metal reference, a segment without a usable ratio, or one that is not a plate (noise, several
    materials).

    Raises
    ------
    DataError
        if the segment has not so many sub-bands, or there are fewer data than unknowns.
    PolysightError
        if the stack has not exactly one unknown layer, or a thickness is missing.
    """
    # Segments refused as half spaces alone may be layers.
    if row.metal_reference or (row.refused is not None and row.refused.what not in NOT_PASSIVE):
        return None
    if bands is None:
        has_thickness = any(layer.thickness_range_m for layer in stack)
        bands = max(1, len(row.bands or ())) if has_thickness else 1
    data = bands_of_row(row, chirp, bands, amplitude_error, theta_std_rad)
    if data is None:
        return None
    return fit_layer(data, stack, float(np.radians(row.incidence_deg or np.nan)))


def incidence_std_rad(materials: ScanMaterials | None) -> float:
    """Return the standard deviation of the incidence angle in materials.json, radians; 0 if it is not there."""
    budget = materials.error_budget if materials is not None else None
    std_deg = budget.incidence.std_deg if budget and budget.incidence else None
    return float(np.radians(std_deg or 0.0))


def format_layer_content(fit: LayerFit) -> dict[str, Any]:
    """Return a fit as plain values for JSON; permittivities as [eps', eps''], lengths in millimetres."""
    has_thickness = fit.std_thickness_m > 0
    # Units of eps', eps'' and the thickness (millimetres a metre).
    units = np.array([1.0, 1.0, 1e3])[: 3 if has_thickness else 2]
    if fit.covariance is None:
        covariance = None
    else:
        covariance = (fit.covariance * np.outer(units, units)).tolist()
    return {
        **_describe_solution(fit),
        "std_real": fit.std_real,
        "std_loss": fit.std_loss,
        "thickness_std_mm": 1e3 * fit.std_thickness_m if has_thickness else None,
        "covariance": covariance,
        "freedom": fit.freedom,
        "ambiguous": fit.ambiguous,
        "rivals": [_describe_solution(r) for r in fit.rivals],
        "at_limit": list(fit.at_limit),
        "warnings": fit.warnings(),
    }


def _describe_solution(fit: LayerFit) -> dict[str, Any]:
    """Return permittivity, thickness and chi-square of a solution as plain values for JSON."""
    return {
        "permittivity": [fit.permittivity.real, -fit.permittivity.imag],
        "thickness_mm": None if fit.thickness_m is None else 1e3 * fit.thickness_m,
        "chi2": fit.chi2,
    }


def polarisation_angle_rad(p: npt.ArrayLike) -> Real:
    """Return the polarisation angle arctan |P| of metal-referenced ratios [any] (Eq. 8), radians; pi / 4 for metal."""
    return np.arctan(np.abs(np.asarray(p)))


@dataclass(frozen=True)
class Line:
    """Concentration as a linear function of the polarisation angle, by least squares.

    Attributes
    ----------
    slope, intercept
        Concentration in percent by weight = intercept + slope * angle in radians.
    mean_rad, spread_rad2
        Mean of the angles and sum of their squared deviations.
    residual_std
        Standard deviation about the line, percent.
    patches
        Number of patches fitted.
    """

    slope: float
    intercept: float
    mean_rad: float
    spread_rad2: float
    residual_std: float
    patches: int

    @classmethod
    def through(cls, angle_rad: npt.ArrayLike, percent: npt.ArrayLike) -> Line:
        """Fit the line. Raises DataError with fewer than three patches or two concentrations."""
        x = np.asarray(angle_rad, np.float64)
        y = np.asarray(percent, np.float64)
        if x.size < 3 or np.unique(y).size < 2 or np.ptp(x) == 0:
            raise DataError(
                f"{x.size} patches of {np.unique(y).size} concentrations",
                "a line with an interval needs three patches and two concentrations with different angles",
                "measure more concentrations",
                code=ErrorCode.NOT_ENOUGH_DATA,
            )
        slope, intercept = (float(c) for c in np.polyfit(x, y, 1))
        residual = y - (intercept + slope * x)
        std = float(np.sqrt((residual**2).sum() / (x.size - 2)))
        sum_of_squares = float(((x - x.mean()) ** 2).sum())
        return cls(slope, intercept, float(x.mean()), sum_of_squares, std, int(x.size))

    def percent(self, angle_rad: npt.ArrayLike) -> Real:
        """Return the concentrations, percent by weight, in the shape of the angles."""
        return self.intercept + self.slope * np.asarray(angle_rad, np.float64)

    def interval(self, angle_rad: npt.ArrayLike, confidence: float = 0.9) -> tuple[Real, Real]:
        """Return the prediction intervals of new patches: lower and upper ends, percent by weight, as `angle_rad`.

        Student's t over the residuals, wider away from the calibration's middle (Draper and Smith, Applied Regression
        Analysis, section 1.4).
        """
        x = np.asarray(angle_rad, np.float64)
        t = float(scipy.special.stdtrit(self.patches - 2, 0.5 + confidence / 2))
        width = t * self.residual_std * np.sqrt(1 + 1 / self.patches + (x - self.mean_rad) ** 2 / self.spread_rad2)
        middle = self.percent(x)
        return middle - width, middle + width


@dataclass(frozen=True)
class LeftOutPatch:
    """Estimate of one patch by a line fitted without its concentration.

    `name` is that of the material; the others are percent by weight: known, estimated, ends of the prediction interval.
    """

    name: str
    true_percent: float
    percent: float
    low: float
    high: float


@dataclass(frozen=True)
class ConcentrationResult:
    """The line through all patches, and the estimates with each concentration left out."""

    line: Line
    left_out: tuple[LeftOutPatch, ...]

    @property
    def median_error(self) -> float:
        """Median absolute error over left-out patches, percent by weight."""
        return float(np.median([abs(r.percent - r.true_percent) for r in self.left_out]))

    @property
    def covered(self) -> float:
        """Share of left-out patches whose interval holds the truth."""
        return float(np.mean([r.low <= r.true_percent <= r.high for r in self.left_out]))


def concentrations(names: Iterable[str], known_concentrations: Mapping[str, float] | None = None) -> dict[str, float]:
    """Return material name to percent by weight: as given, or the number before a percent sign in the name.

    Names without either are omitted.
    """
    concentration_of_name: dict[str, float] = {}
    for name in names:
        percent = _PERCENT.search(name)
        if known_concentrations and name in known_concentrations:
            concentration_of_name[name] = known_concentrations[name]
        elif percent:
            concentration_of_name[name] = float(percent[1])
    return concentration_of_name


def fit_concentration(
    library: Library, known_concentrations: Mapping[str, float] | None = None, confidence: float = 0.9
) -> ConcentrationResult:
    """Fit a line through a library's patches of known concentration, and judge it with each one left out.

    The concentration is in the names of the patches (``"sugar (3.8%)"``) or in `known_concentrations`, percent
    (``{"water": 0.0}``). `confidence` is that of the intervals.

    Raises DataError with fewer than three known concentrations, or patches of several incidence angles.
    """
    percent_by_name = concentrations(library.names, known_concentrations)
    entries = [e for e in library.entries if e.name in percent_by_name]
    values = {percent_by_name[e.name] for e in entries}
    if len(values) < 3:
        raise DataError(
            f"{len(values)} known concentrations in this library",
            "three are needed to leave one out; names contain them as in 'sugar (3.8%)'",
            "add scans, or give the concentration of a name: --value water=0",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    angles = [e.incidence_deg for e in entries]
    if max(angles) - min(angles) > 1.0:
        raise DataError(
            f"patches under incidence angles of {min(angles):.1f} to {max(angles):.1f} degrees",
            "the polarisation angle changes with the incidence angle",
            "use scans of one geometry",
            code=ErrorCode.MISMATCH,
        )
    x = np.array([float(np.median(polarisation_angle_rad(e.p))) for e in entries])
    y = np.array([percent_by_name[e.name] for e in entries])
    rows: list[LeftOutPatch] = []
    for value in sorted(values):
        test = y == value
        line = Line.through(x[~test], y[~test])
        low, high = line.interval(x[test], confidence)
        names = [entries[i].name for i in np.flatnonzero(test)]
        estimates = zip(names, line.percent(x[test]), low, high, strict=True)
        rows += [LeftOutPatch(name, value, float(percent), float(lo), float(hi)) for name, percent, lo, hi in estimates]
    return ConcentrationResult(Line.through(x, y), tuple(rows))


def _measure_reference_spread(h: Image, v: Image, metal: MetalReference, reference: PlaneReference | None) -> float:
    """Return the relative spread of the metal's pixels, in the scene or scanned separately; 0 if it is not known."""
    if reference is None:
        spread = inverse_spread(h[metal.mask], v[metal.mask])
    else:
        spread = reference.spread
    return spread if np.isfinite(spread) else 0.0
