"""The check plate: a plate of known permittivity in every scan, measured as any other patch."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from polysight.results.materials import PatchFigures
from polysight.results.verdict import reason
from polysight_shared.config import CheckPlate
from polysight_shared.findings import Finding

# The distance of a good scan, in standard deviations, is below the first limit with 95 % and below the second with
# 99.7 % probability: square roots of quantiles of chi-squared with two degrees of freedom.
WARNING_SIGMAS = 2.45
ACTION_SIGMAS = 3.41
# Weights by which reasons are ordered; chosen. A plate that was measured wrongly is a stronger reason than a missing
# one.
_MISSING_WEIGHT = 2.0
_ACTION_WEIGHT = 3.8


class CheckResult(msgspec.Struct, frozen=True, kw_only=True):
    """Check plate of one scan.

    Attributes
    ----------
    name
        Name of the plate in the rig file.
    level
        "good", "warning" (expected in 5 % of good scans), "action" (in 0.3 %), or "missing".
    expected, expected_std
        Permittivity [eps', loss] of the rig file and its standard errors.
    measured, measured_std
        Permittivity as measured on the patch; None if it is missing.
    sigmas
        Distance of measured and expected permittivity in standard deviations: sqrt(d^T C^-1 d), with their difference d
        and the sum C of both covariances.
    why
        Why the plate is missing.
    """

    name: str
    level: str
    expected: tuple[float, float]
    expected_std: tuple[float, float]
    measured: tuple[float, float] | None = None
    measured_std: tuple[float, float] | None = None
    sigmas: float | None = None
    why: str = ""


def check_plate(plate: CheckPlate, patches: Sequence[PatchFigures]) -> CheckResult | None:
    """Compare the patch at the place of the check plate with its permittivity; None without a plate in the rig file."""
    if not plate.name:
        return None
    # This is the result for a plate that was not measured.
    missing = CheckResult(name=plate.name, level="missing", expected=plate.permittivity, expected_std=plate.std)
    x_mm, y_mm = plate.place_mm
    patch = next((patch for patch in patches if _contains(patch, x_mm, y_mm)), None)
    if patch is None:
        return msgspec.structs.replace(missing, why=f"no patch at x {x_mm:g}, y {y_mm:g} mm from the image's centre")
    value = patch.permittivity
    if value is None or value.covariance is None:
        return msgspec.structs.replace(missing, why=f"patch {patch.label} there has no permittivity")
    covariance = np.array(value.covariance, np.float64)
    # Convert the covariance of (real, imaginary part) to that of (eps', loss): the loss is minus the imaginary part.
    covariance[0, 1] *= -1
    covariance[1, 0] *= -1
    total = covariance + np.diag(np.square(plate.std))
    difference = np.array([value.real, -value.imag]) - plate.permittivity
    sigmas = float(np.sqrt(difference @ np.linalg.solve(total, difference)))
    level = "good"
    if sigmas > ACTION_SIGMAS:
        level = "action"
    elif sigmas > WARNING_SIGMAS:
        level = "warning"
    return msgspec.structs.replace(
        missing,
        level=level,
        measured=(value.real, -value.imag),
        measured_std=(math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1])),
        sigmas=round(sigmas, 3),
    )


def _contains(patch: PatchFigures, x_mm: float, y_mm: float) -> bool:
    """True if a place is inside the bounding box of a patch."""
    x0, y0, x1, y1 = patch.box_mm
    return x0 <= x_mm <= x1 and y0 <= y_mm <= y1


def check_reasons(result: CheckResult | None) -> list[Finding]:
    """Judge the check plate: "care" beyond the action limit, and where it is missing."""
    if result is None or result.level in ("good", "warning"):
        return []
    remedy = "scan it again; if it stays, check calibration, antennas and the metal reference (polysight doctor)"
    if result.measured is None:
        problem = f"the check plate {result.name} was not measured: {result.why}"
        return [reason("care", problem, "the rig file says that it lies in every scan", remedy, _MISSING_WEIGHT)]
    real, loss = result.measured
    known_real, known_loss = result.expected
    problem = (
        f"the check plate {result.name} was measured as {real:.2f}, loss {loss:.2f}, instead of {known_real:.2f}, loss"
        f" {known_loss:.2f}: {result.sigmas:.1f} standard deviations"
    )
    cause = "only three good scans in a thousand differ by so much: the rig has changed"
    return [reason("care", problem, cause, remedy, _ACTION_WEIGHT)]
