"""Estimate how the gain of V over H changes during a scan, from the slopes of ln(V / H) over the plates.

V and H are the complex images of both receivers, so ln(V / H) has the logarithm of the ratio of amplitudes as its real
part and the phase difference (radians) as its imaginary part. The stage moves the whole rig. So ln(V / H) would be
constant over a plate, and its slopes (per metre) along x and y would be 0, but for four causes:

- The gains drift. The gain is then a function of y, because rows are scanned one after the other.
- A second path beside the direct path makes fringes over the plane of the stage, in any direction. They are as large in
  amplitude as in phase. Long fringes change the gain from plate to plate; short ones add shifted copies of plates.
- Images of H and V are not in the same place: that gives all plates the same slope.
- A plate has slopes of its own: it is uneven or disturbed, or a copy of another plate lies on it.

Each part of ln(V / H) is treated separately. Drift and fringes are one smooth field g(x, y) of mean zero. The measured
slopes of a plate at p are

    s_j = 0.88 dg/dx_j(p) + slope common to all plates + the plate's own slope + noise        j = x, y

With s the slopes of all plates, S their covariance and C that of g(p) - g(origin) with s, g is expected to change by
C S^-1 s from the origin, the metal reference, to the plate (Gaussian process; Rasmussen and Williams, Gaussian
Processes for Machine Learning, 2006, 9.4). What is left of its variance becomes part of the error of the plate.
The standard deviations of all terms are unknown: each combination of their possible values is a *case*, and results are
averaged over the cases, weighted by their prior probability and the probability density of s.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt
import scipy

from polysight.imaging import Images, Mask
from polysight.materials.measure import Scatter

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

STABLE_PROBABILITY = 0.6
"""Prior probability that the rig does not drift, neither in amplitude nor in phase. Chosen: an even drift makes the
same slope on all plates, as shifted images do. With 0.8 such a drift is missed. With 0.4 the half widths of the error
intervals of undisturbed scenes are 8 % larger than with 0.6 (scenes of the independent generator)."""
DRIFT_STDS: dict[bool, tuple[float, ...]] = {True: (0.002,), False: (0.015, 0.06)}
"""Standard deviations of the drift of either part of ln(V / H) over a scan (chosen). Key: True for a stable rig, False
for one that drifts, as usual (0.015) or by up to 15 % and 9 degrees (0.06: 2.5 of them). Values of one key are equally
probable."""
DRIFT_LENGTHS_M = (0.05, 0.07, 0.15)
"""Correlation lengths of the drift along y, the slow axis of the scan: half a wave of it is 0.13 to 0.4 m long. All
are equally probable."""
SEEN_SLOPE_SHARE = 0.88
"""Slope of ln(V / H) within a plate's image divided by the slope of the gain. A pixel has the gain averaged over a
Fresnel zone. Near a plate's edge only the plate's side of that zone echoes, so the average is nearer the gain in the
middle of the plate. In 100 drifting scenes of the independent generator the gain changed between plates by 1.1 to 1.2
times the integral of the slopes (1 / 0.88 = 1.14)."""
FRINGE_PRIOR = {0.0: 0.95, 0.05: 0.025, 0.15: 0.025}
"""Standard deviation of the fringes in either part of ln(V / H), to its prior probability; 0: no fringes. The published
rig shows 10 to 20 %."""
FRINGE_LENGTHS_M = (0.03, 0.05)
"""Correlation lengths of fringes whose period is 0.2 to 0.3 m. Shorter ones average out over a plate."""
COMMON_SLOPE_PRIOR = {0.15: 0.7, 0.5: 0.2, 2.0: 0.1}
"""Standard deviation of the slope of ln(V / H) that all plates share, per metre, to its prior probability (chosen). H
and V in the same place have 0.1 to 0.3 (scenes of the independent generator), images some millimetres apart 0.5, and
images of a small aperture 1 to 3."""
OWN_SLOPE_STDS = (0.05, 1.0, 3.0)
"""Standard deviations of a plate's own slope, per metre: flat, uneven, and disturbed plates. All three are equally
probable: if flat plates are preferred, the ripple of the published picture counts as fringes, and the half widths of
its plates' intervals are 30 instead of 19 %."""
ALIKE_BOTH_WAYS = 0.7
"""Prior probability that the plates' own slopes have the same standard deviation along x and y; chosen. Bent plates
have slopes along y alone, the direction in which H and V see different places."""
LIKELY_FRINGES = 0.5
WEAK_LEVEL = 0.2
"""If the probability of fringes is above the first, it is computed again without plates whose |V / H| relative to metal
is below the second (chosen), and the smaller one counts. Light from bright edges, or from a table behind, is as strong
as V of such plates."""
BORDER_SLOPE_STD = 100.0
"""Standard deviation of the slope of a plate at the border of the image, per metre: so large that it is not used."""
LEAST_ROW_PIXELS = 4
LEAST_PLATE_ROWS = 5
"""The phase along a plate is measured in rows of its interior with at least as many pixels, if there are at least as
many rows; chosen."""
RIM_ROWS = 3
"""Rows at either end of a plate's interior in which this phase is not measured: a drift of the phase moves the image of
V against that of H, and the effect of the plate's edges reaches farther in; chosen."""
LEAST_SLOPE_STD = 1e-3
"""Smallest standard deviation of a measured slope, per metre."""
RIPPLE_M = 0.015
"""Error of a plate's ln(V / H) divided by the root mean square of its own slopes: the phase of a copy of another plate
changes against the plate's by 50 to 100 radians per metre. 15 mm fits the errors of plates of the independent generator
best (20 and 30 mm are worse)."""
SHARE_OF_CHANGE = 0.85
"""Factor of the estimated errors by drift and fringes. For 4,800 plates of the independent generator the errors are 0.5
to 0.65 of the estimate where there may be a drift, and 0.75 to 1.15 where there is one. With a smaller factor, drifts
drawn at random exceeded their errors too often."""
PHASE_OF_CHANGE = 0.75
"""Factor of the estimated error of a plate's phase by drift, fringes and its own slopes. The slopes of the phase are
larger than those of the amplitude, but its errors are not. Where these errors dominate, the factor at which 68 % lie
within the interval is smaller for the phase: 0.73 of the amplitude's in scenes of the own simulator, 0.83 in those of
the independent generator."""
TWO_SIDED_95 = 1.96
"""Standard deviations on both sides of a normal distribution's mean that hold 95 %."""
# Numbers of the largest array, 16 MB: up to this drifts are computed together. Few plates then take half the time.
MOST_NUMBERS = 2_000_000
# Halvings of the range in which the width of an interval is searched: to 1e-7 of it.
_BISECTIONS = 24
WEIGHT_OF_USUAL = 2.0
"""Weight of the scene's usual squared slope, in the mean with the three squared slopes of a plate; chosen."""


@dataclass(frozen=True)
class CommonChange:
    """Estimated change of ln(V / H) from the origin, the metal reference, to each plate.

    Attributes
    ----------
    value, std
        complex [plate]: change by drift and fringes, and the errors of its real part (real part of `std`) and of its
        imaginary part (imaginary part of `std`): 1.96 of them hold 95 % or more (`_ExpectedFromSlopes.error`).
    drift, drift_std
        complex [plate]: the same by drift alone; `drift_std` are standard deviations.
    ripple
        float64 [plate]: standard deviation of either part of the plate's ln(V / H) by its own slopes.
    fringes
        Probability that there are fringes by a second path beside the direct path; if weak plates alone show them, it
        is that by the other plates.
    drifts
        Probability that the gains drift by more than those of a stable rig.
    """

    value: Complex
    std: Complex
    drift: Complex
    drift_std: Complex
    ripple: Real
    fringes: float
    drifts: float

    def largest_drift(self) -> tuple[float, float]:
        """Return the largest root mean square of the drift over all plates, of its real and of its imaginary part.

        The root mean square at a plate is that of the estimate and its standard deviation. 0 without plates.
        """
        if not self.drift.size:
            return 0.0, 0.0
        amplitude = np.hypot(self.drift.real, self.drift_std.real)
        phase = np.hypot(self.drift.imag, self.drift_std.imag)
        return float(amplitude.max()), float(phase.max())

    def log_ratio(self, plate: int) -> tuple[complex, tuple[float, float]]:
        """Return the change of ln(V / H) from the origin to a plate, and the standard deviations of both parts.

        They include the plate's ripple; that of the phase has the factor `PHASE_OF_CHANGE`.
        """
        std = complex(self.std[plate])
        ripple = float(self.ripple[plate])
        phase_std = PHASE_OF_CHANGE * float(np.hypot(std.imag, ripple))
        return complex(self.value[plate]), (float(np.hypot(std.real, ripple)), phase_std)


def estimate_common_change(
    plates: Sequence[Scatter], origin_m: tuple[float, float], at_border: Sequence[bool] = ()
) -> CommonChange:
    """Estimate the change of ln(V / H) over the scan from the slopes of all plates of a scene.

    The change is zero at `origin_m`, (x, y) of the metal reference, metres. `at_border` is True for plates at the
    border of the image (one value per plate; empty: no plate is). Their slopes are not used, but they get an estimate.
    """
    border = np.array(at_border, bool) if at_border else np.zeros(len(plates), bool)
    places_m = np.array([plate.centre_m for plate in plates], np.float64).reshape(-1, 2)
    smooth_fields = _Fields.collect(places_m, np.array(origin_m, np.float64))
    parts, noises = _explain_parts(smooth_fields, plates, border)
    weight = smooth_fields.weigh(parts)
    real = parts[0].average(weight)
    imag = parts[1].average(weight)
    fringes = smooth_fields.sum_over_fringes(weight)
    weak = np.array([plate.level < WEAK_LEVEL for plate in plates], bool) & ~border
    if fringes > LIKELY_FRINGES and weak.any():
        # A second path changes the gain for strong and weak plates alike, light from edges only the ratio of weak ones.
        strong_parts, _ = _explain_parts(smooth_fields, plates, border | weak)
        fringes = min(fringes, smooth_fields.sum_over_fringes(smooth_fields.weigh(strong_parts)))
    return CommonChange(
        value=(real.mean + 1j * imag.mean)[0],
        std=SHARE_OF_CHANGE * (parts[0].error(weight) + 1j * parts[1].error(weight)),
        drift=(real.drift + 1j * imag.drift)[0],
        drift_std=(real.drift_std + 1j * imag.drift_std)[0],
        ripple=RIPPLE_M * _estimate_own_slopes((real.remaining[0], imag.remaining[0]), noises, border),
        fringes=fringes,
        drifts=float(sum(w for w, (_, _, _, stable) in zip(weight, smooth_fields.shared, strict=True) if not stable)),
    )


def _explain_parts(
    smooth_fields: _Fields, plates: Sequence[Scatter], ignored: npt.NDArray[np.bool_]
) -> tuple[list[_ExpectedFromSlopes], list[Real]]:
    """Explain the slopes of real and imaginary part, but for those of plates that are `ignored`; return noises, too.

    The noises are standard deviations of the slopes, [2, plate] of each part.
    """
    parts = []
    noises = []
    for part in (np.real, np.imag):
        slopes = np.array([part(plate.slope) for plate in plates], np.float64).reshape(-1, 2).T
        noise = np.array([part(plate.slope_std) for plate in plates], np.float64).reshape(-1, 2).T
        noises.append(np.maximum(noise, LEAST_SLOPE_STD))
        parts.append(smooth_fields.explain(slopes, noises[-1] + BORDER_SLOPE_STD * ignored))
    return parts, noises


def _estimate_own_slopes(remaining: Sequence[Real], noises: Sequence[Real], border: npt.NDArray[np.bool_]) -> Real:
    """Return the root mean square of each plate's own slopes beyond their measurement errors, [plate], per metre.

    `remaining` are the slopes without those by common causes, and `noises` their standard deviations: each a pair (real
    part, imaginary part) of arrays [2, plate] along x and y. A disturbance is taken as equally strong in both
    directions and both parts, so that their squares are averaged, with `WEIGHT_OF_USUAL` those usual in the scene.
    The slope of the real part along y is left out. H and V see different places along y, so an uneven plate changes
    their brightness ratio there. This change is antisymmetric about the plate's middle and no error of the median.
    """
    (real_x, _), (imag_x, imag_y) = remaining
    (noise_real_x, _), (noise_imag_x, noise_imag_y) = noises
    slopes = np.stack([real_x, imag_x, imag_y])
    errors = np.stack([noise_real_x, noise_imag_x, noise_imag_y])
    usual_slope = float(
        np.mean([_estimate_excess_variance(s[~border], e[~border]) for s, e in zip(slopes, errors, strict=True)])
    )
    # Plates at the border, whose slopes say nothing about it, get the usual size.
    excess = np.where(border, len(slopes) * usual_slope, np.maximum(np.sum(slopes**2 - errors**2, axis=0), 0.0))
    return np.sqrt((WEIGHT_OF_USUAL * usual_slope + excess) / (WEIGHT_OF_USUAL + len(slopes)))


def _estimate_excess_variance(slopes: Real, errors: Real) -> float:
    """Return the variance of `slopes` [plate] about zero minus that of their `errors`; 0 with fewer than three plates.

    It is computed from medians, so that the large slopes of one plate that hardly reflects V do not count as ripple.
    """
    if slopes.size < 3:
        return 0.0
    scatter = 1.4826 * float(np.median(np.abs(slopes)))
    # The common causes were fitted to the same slopes: n / (n - 2) makes up for the freedom that took (2 is chosen).
    return max(0.0, scatter**2 - float(np.median(errors)) ** 2) * slopes.size / (slopes.size - 2)


@dataclass(frozen=True)
class _Field:
    """Covariances of a smooth field of unit variance on the plane, at the plates.

    A value is the field at a plate minus the field at the origin. A slope is as the plate's image shows it, smaller
    than the field's by `SEEN_SLOPE_SHARE`; slopes along x stand before those along y.

    Attributes
    ----------
    of_slopes
        [2 plate, 2 plate]: covariance of the slopes, 1 / m^2.
    with_slopes
        [plate, 2 plate]: covariance of the values with the slopes, 1 / m.
    of_itself
        [plate]: variance of the values.
    """

    of_slopes: Real
    with_slopes: Real
    of_itself: Real

    @classmethod
    def with_axes(cls, axes: tuple[int, int], length_m: float, places_m: Real, origin_m: Real) -> _Field:
        """Return a field whose covariance is Gaussian with the standard deviation `length_m`, at places [plate, 2].

        `axes` (x, y) has 1 for an axis along which the field changes, and 0 for one along which it is constant.
        """
        count = len(places_m)
        distance = (places_m[:, None] - places_m[None]) * np.array(axes)
        distance_from_origin = (places_m - origin_m) * np.array(axes)
        covariance = np.exp(-0.5 * np.sum(distance**2, axis=-1) / length_m**2)
        covariance_with_origin = np.exp(-0.5 * np.sum(distance_from_origin**2, axis=-1) / length_m**2)
        # With r = p - q, cov(g(p), g(q)) = k(r) = exp(-|r|^2 / (2 L^2)), its derivatives are
        #   cov(dg/dx_i(p), dg/dx_j(q)) = k(r) (delta_ij - r_i r_j / L^2) / L^2     [p, q, i, j]
        #   cov(g(p), dg/dx_j(q)) = k(r) r_j / L^2                                  [p, q, j]
        # and the latter with p = origin, r = origin - q, is subtracted.
        product = distance[..., :, None] * distance[..., None, :] / length_m**2
        slope_covariance = covariance[..., None, None] * (np.diag(axes) - product) / length_m**2
        covariance_with_slopes = (
            covariance[..., None] * distance + (covariance_with_origin[:, None] * distance_from_origin)[None]
        ) / length_m**2
        return cls(
            of_slopes=SEEN_SLOPE_SHARE**2 * slope_covariance.transpose(2, 0, 3, 1).reshape(2 * count, 2 * count),
            with_slopes=SEEN_SLOPE_SHARE * covariance_with_slopes.transpose(0, 2, 1).reshape(count, 2 * count),
            of_itself=2 - 2 * covariance_with_origin,
        )


@dataclass(frozen=True)
class _Fields:
    """Fields of drift and fringes at the plates, and the cases that are weighed against each other.

    Attributes
    ----------
    drifts
        Fields of unit variance that change along y, one for each of `DRIFT_LENGTHS_M`.
    fringes
        Correlation length in metres to the field of unit variance that changes along x and y.
    shared
        Cases that both parts of ln(V / H) share: standard deviation and correlation length (metres) of the fringes,
        standard deviation of the slope that all plates share (per metre), and True if the rig is stable.
    log_prior
        ln of the prior probability of each case of `shared`, but for a common constant.
    """

    drifts: Sequence[_Field]
    fringes: Mapping[float, _Field]
    shared: Sequence[tuple[float, float, float, bool]]
    log_prior: Real

    @classmethod
    def collect(cls, places_m: Real, origin_m: Real) -> _Fields:
        """Return the fields for plates at places [plate, 2], relative to the origin [2]."""
        shared = []
        prior = []
        cases = itertools.product(FRINGE_PRIOR.items(), FRINGE_LENGTHS_M, COMMON_SLOPE_PRIOR.items(), (True, False))
        for (fringe, fringe_prior), fringe_m, (common, common_prior), stable in cases:
            shared.append((fringe, fringe_m, common, stable))
            prior.append(fringe_prior * common_prior * (STABLE_PROBABILITY if stable else 1 - STABLE_PROBABILITY))
        return cls(
            drifts=[_Field.with_axes((0, 1), length_m, places_m, origin_m) for length_m in DRIFT_LENGTHS_M],
            fringes={length_m: _Field.with_axes((1, 1), length_m, places_m, origin_m) for length_m in FRINGE_LENGTHS_M},
            shared=shared,
            log_prior=np.log(prior),
        )

    def weigh(self, parts: Sequence[_ExpectedFromSlopes]) -> Real:
        """Return the probability of each case of `shared`, given both parts of ln(V / H)."""
        # The cases apply to amplitude and phase together, so both evidences count.
        log_weight = parts[0].log_evidence + parts[1].log_evidence + self.log_prior
        weight = np.exp(log_weight - log_weight.max())
        return weight / weight.sum()

    def sum_over_fringes(self, weight: Real) -> float:
        """Return the probability of fringes, by the probability of each case of `shared`."""
        return float(sum(w for w, (fringe, _, _, _) in zip(weight, self.shared, strict=True) if fringe > 0))

    def explain(self, slopes: Real, noise: Real) -> _ExpectedFromSlopes:
        """Explain the slopes [2, plate] of one part of ln(V / H), once for each case of `shared`.

        `noise` [2, plate] is the standard deviation of the slopes.
        """
        explained: dict[tuple[float, float, float, bool], tuple[Real, ...]] = {}
        parts = []
        for fringe, fringe_m, common, stable in self.shared:
            # Without fringes their length makes no difference.
            case = (fringe, fringe_m if fringe > 0 else FRINGE_LENGTHS_M[0], common, stable)
            if case not in explained:
                explained[case] = _list_arrays(self._explain(slopes, noise, *case))
            parts.append(explained[case])
        return _ExpectedFromSlopes(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def _explain(
        self, slopes: Real, noise: Real, fringe: float, fringe_m: float, common: float, stable: bool
    ) -> _ExpectedFromSlopes:
        """Explain the slopes by one case of `shared`, averaged over drifts and the plates' own slopes by their
        evidence.

        The case is given by `fringe`, `fringe_m`, `common` and `stable`, in the order of `shared`.
        """
        count = slopes.shape[1]
        measured = slopes.ravel()
        fringes = self.fringes[fringe_m]
        # One slope that all plates share along x, and an independent one along y.
        shared_slope = np.kron(np.eye(2), np.ones((count, count)))
        common_covariance = common**2 * shared_slope + fringe**2 * fringes.of_slopes
        own_slopes, own_slopes_prior = _list_own_variances(count)
        own_variances = (noise.ravel() ** 2 + own_slopes)[:, :, None] * np.eye(2 * count)
        drifts = list(itertools.product(self.drifts, DRIFT_STDS[stable]))
        drifts_at_once = max(1, MOST_NUMBERS // max(1, own_variances.size))
        parts = []
        for first in range(0, len(drifts), drifts_at_once):
            fields_of_drift = drifts[first : first + drifts_at_once]
            explained = common_covariance + np.stack([drift**2 * field.of_slopes for field, drift in fields_of_drift])
            # S^-1 [drift, own, 2 plate, 2 plate], and `answer` = S^-1 s [drift, own, 2 plate]: the expected value of
            # any quantity is its covariance with the slopes times `answer`.
            inverse = np.asarray(np.linalg.inv(explained[:, None] + own_variances), np.float64)
            answer = inverse @ measured
            drift_covariance = np.stack([drift**2 * field.with_slopes for field, drift in fields_of_drift])
            total_covariance = drift_covariance + fringe**2 * fringes.with_slopes
            variance_of_drift = np.stack([drift**2 * field.of_itself for field, drift in fields_of_drift])
            variance_of_all = variance_of_drift + fringe**2 * fringes.of_itself
            square = _compute_mean_square(answer, inverse, total_covariance, variance_of_all)
            # Without fringes the drift is all there is.
            drift_square = square
            if fringe > 0:
                drift_square = _compute_mean_square(answer, inverse, drift_covariance, variance_of_drift)
            # Prior of the case, and the normal distribution of the slopes with the covariance inverted above.
            log_prior = np.log(own_slopes_prior / len(DRIFT_STDS[stable]))
            log_evidence = log_prior - 0.5 * answer @ measured + 0.5 * np.linalg.slogdet(inverse)[1]
            cases_at_once = log_evidence.size
            cases = _ExpectedFromSlopes(
                log_evidence=log_evidence.ravel(),
                mean=(answer @ total_covariance.mT).reshape(cases_at_once, count),
                square=square.reshape(cases_at_once, count),
                drift=(answer @ drift_covariance.mT).reshape(cases_at_once, count),
                drift_square=drift_square.reshape(cases_at_once, count),
                remaining=slopes - (answer @ explained).reshape(cases_at_once, 2, count),
            )
            parts.append(cases)
        return _ExpectedFromSlopes.average_over(parts)


@functools.cache
def _list_own_variances(count: int) -> tuple[Real, Real]:
    """Return variances of the plates' own slopes, [case, 2 plate] (x before y), and the prior probability of each case.

    A case is a pair of `OWN_SLOPE_STDS`, one along x and one along y.
    """
    variances = []
    priors = []
    for along_x, along_y in itertools.product(OWN_SLOPE_STDS, OWN_SLOPE_STDS):
        variances.append(np.repeat([along_x**2, along_y**2], count))
        prior = (1 - ALIKE_BOTH_WAYS) / len(OWN_SLOPE_STDS) ** 2
        if along_x == along_y:
            prior += ALIKE_BOTH_WAYS / len(OWN_SLOPE_STDS)
        priors.append(prior)
    return np.array(variances), np.array(priors)


def _compute_mean_square(answer: Real, inverse: Real, with_slopes: Real, of_itself: Real) -> Real:
    """Return the expected square of a field at each plate given the slopes, [drift, own, plate].

    `answer` is as in `_Fields._explain`, `inverse` that of the slopes' covariance, [drift, own, 2 plate, 2 plate];
    `with_slopes` [drift, plate, 2 plate] and `of_itself` [drift, plate] are as in `_Field`.
    """
    with_slopes = with_slopes[:, None]
    explained_variance = np.sum(with_slopes @ inverse * with_slopes, axis=-1)
    expected = (with_slopes @ answer[..., None])[..., 0]
    return np.maximum(of_itself[:, None] - explained_variance, 0.0) + expected**2


@dataclass(frozen=True)
class _ExpectedFromSlopes:
    """Drift and fringes expected from the slopes of one part of ln(V / H) (real or imaginary), for some cases.

    Attributes
    ----------
    log_evidence
        [case]: logarithm of the probability density of the slopes, but for a constant.
    mean, square
        [case, plate]: mean and mean square of drift and fringes at each plate.
    drift, drift_square
        [case, plate]: mean and mean square of the drift alone.
    remaining
        [case, 2, plate]: measured slopes along x and y minus those expected from drift, fringes and the common slope.
    """

    log_evidence: Real
    mean: Real
    square: Real
    drift: Real
    drift_square: Real
    remaining: Real

    @classmethod
    def average_over(cls, parts: Sequence[_ExpectedFromSlopes]) -> _ExpectedFromSlopes:
        """Return one case: the average over all cases of `parts`, weighted by their evidence."""
        together = cls(*(np.concatenate(arrays) for arrays in zip(*map(_list_arrays, parts), strict=True)))
        largest = float(together.log_evidence.max())
        weight = np.exp(together.log_evidence - largest)
        average = together.average(weight / weight.sum())
        return replace(average, log_evidence=np.array([largest + np.log(weight.sum())]))

    def average(self, weight: Real) -> _ExpectedFromSlopes:
        """Return one case: the average over the cases with weights [case] that sum to 1."""
        return _ExpectedFromSlopes(*(np.tensordot(weight, array, 1)[None] for array in _list_arrays(self)))

    @property
    def std(self) -> Real:
        """Standard deviation of drift and fringes, [case, plate]."""
        return np.sqrt(np.maximum(self.square - self.mean**2, 0.0))

    def error(self, weight: Real) -> Real:
        """Return the error of the average over cases with weights [case] that sum to 1, [plate].

        It is the root mean square deviation, or, if larger, that of which 1.96 hold 95 % where each case is a normal
        distribution: with a far wider case of a tenth or more, 1.96 times the root mean square hold only 92 to 95 %.
        """
        mean = weight @ self.mean
        root_mean_square = np.sqrt(np.maximum(weight @ self.square - mean**2, 0.0))
        std_of_cases = self.std + 1e-12
        narrow = TWO_SIDED_95 * root_mean_square
        # At most 5 % of any distribution lie beyond sqrt(20) root mean squares (Chebyshev).
        wide = np.sqrt(20) * root_mean_square
        for _ in range(_BISECTIONS):
            half_width = (narrow + wide) / 2
            above = scipy.special.ndtr((mean + half_width - self.mean) / std_of_cases)
            below = scipy.special.ndtr((mean - half_width - self.mean) / std_of_cases)
            is_enough = weight @ (above - below) > 0.95
            wide = np.where(is_enough, half_width, wide)
            narrow = np.where(is_enough, narrow, half_width)
        return narrow / TWO_SIDED_95

    @property
    def drift_std(self) -> Real:
        """Standard deviation of the drift alone, [case, plate]."""
        return np.sqrt(np.maximum(self.drift_square - self.drift**2, 0.0))


def _list_arrays(explained: _ExpectedFromSlopes) -> tuple[Real, ...]:
    """Return the values of the fields, in the order in which the class declares them."""
    return tuple(getattr(explained, field.name) for field in fields(explained))


@dataclass(frozen=True)
class PhaseAlongPlate:
    """Phase of V / H along the inside of a plate.

    Attributes
    ----------
    y_m, phase_rad
        float64 [row]: y of each row of pixels, and the phase of V / H there.
    level
        Mean |V / H|.
    step_h_rad, step_v_rad
        Mean step of the phase of H, and of V, from row to row.
    """

    y_m: Real
    phase_rad: Real
    level: float
    step_h_rad: float
    step_v_rad: float


def measure_along_plates(images: Images, interiors: Sequence[Mask]) -> list[PhaseAlongPlate]:
    """Return the phase of V / H along y of each plate with enough rows; `interiors`: bool [ny, nx] each."""
    plates = []
    for interior in interiors:
        inside = interior & images.usable
        h = np.where(inside, images.h, 0)
        v = np.where(inside, images.v, 0)
        sums = np.asarray((v * np.conj(h)).sum(axis=1), np.complex128)
        rows = np.flatnonzero((np.count_nonzero(inside, axis=1) >= LEAST_ROW_PIXELS) & (sums != 0))[RIM_ROWS:-RIM_ROWS]
        if rows.size < LEAST_PLATE_ROWS:
            continue
        steps_rad = [float(np.angle(np.vdot(image[rows[:-1]], image[rows[1:]]))) for image in (h, v)]
        power_of_h = float(np.sum(np.abs(h[rows]) ** 2))
        plates.append(PhaseAlongPlate(
            y_m=np.asarray(images.y_m, np.float64)[rows], phase_rad=np.unwrap(np.angle(sums[rows])),
            level=float(np.abs(sums[rows]).sum()) / power_of_h, step_h_rad=steps_rad[0], step_v_rad=steps_rad[1],
        ))  # fmt: skip
    return plates
