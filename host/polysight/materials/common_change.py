"""Changes of the gain of V over H during a scan, from the slopes of ln(V / H) over the plates.

The stage moves the whole rig, so that ln(V / H) is constant over a plate, except for four causes. The slopes of
ln(V / H) that they make differ:

- a drift of the gains is a function of y, because rows are scanned one after the other;
- a second path beside the direct path makes fringes over the stage's plane, of any direction, as large in amplitude as
  in phase. Long ones change the gain from plate to plate; short ones lay copies of plates on each other;
- images of H and V that are not in the same place give all plates the same slope;
- each plate has slopes of its own: it is uneven, disturbed, or a copy of another lies on it.

The first two are one field g(x, y), drift and fringes together, seen by its derivatives (Gaussian process; Rasmussen
and Williams, Gaussian Processes for Machine Learning, 2006, 9.4). The uncertainty that the plates' slopes leave is in
the error of every plate.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from polysight.materials.measure import Scatter

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

STABLE = 0.5
"""Probability of a rig that does not drift; what drifts in amplitude does so in phase. Chosen: an even drift has slopes
like those that all plates have by themselves. With 0.8 such a drift is missed, with 0.4 the half widths of undisturbed
scenes are 8 % larger than with 0.6 (scenes of the independent generator)."""
DRIFTS: dict[bool, tuple[float, ...]] = {True: (0.002,), False: (0.03, 0.06)}
"""Standard deviations of the drift of ln(V / H) over a scan, each part, equally probable (chosen): of a stable rig, and
of one that drifts, as usual or by 15 % and 9 degrees."""
# Tried with equal probabilities.
DRIFT_LENGTHS_M = (0.05, 0.07, 0.15)
"""Lengths over which a drift changes, along the slow axis of the scan: half a wave is 0.13 to 0.4 m."""
SLOPE_SEEN = 0.88
"""Slope of ln(V / H) within a plate's image over the slope of the gain over the scan. A pixel sees the gain averaged
over a Fresnel zone, of which near a plate's edge only the plate's side echoes: it sees the gain nearer the middle. In
100 drifting scenes of the independent generator the changes between plates are 1.1 to 1.2 times what slopes tell."""
FRINGES = {0.0: 0.95, 0.05: 0.025, 0.15: 0.025}
"""Standard deviations of fringes in ln(V / H) by a second path beside the direct path, each part, with their prior
probabilities; the published rig shows 10 to 20 %."""
FRINGE_LENGTHS_M = (0.03, 0.05)
"""Correlation lengths of fringes whose period is 0.2 to 0.3 m. Shorter ones average out over a plate."""
COMMON_SLOPES = {0.15: 0.7, 0.5: 0.2, 2.0: 0.1}
"""Standard deviations of the slope of ln(V / H) that all plates have by themselves, per metre, with their prior
probabilities (chosen): H and V that see the same place (0.1 to 0.3 in scenes of the independent generator), images some
millimetres apart (0.5), and a small aperture (1 to 3)."""
OWN_SLOPES = (0.05, 1.0, 3.0)
"""Standard deviations of the slope that each plate has of its own, per metre: flat plates, uneven or disturbed ones.
All are equally probable: with flat plates preferred the published picture's ripple counts as fringes, and the half
widths of its plates are 30 instead of 19 %."""
ALIKE_BOTH_WAYS = 0.7
"""Probability that the plates' own slopes are as large along x as along y; chosen. Bent plates have them along y alone,
in which direction H and V see different places."""
BORDER_SLOPE_STD = 100.0
"""Standard deviation of the slope of a plate at the border of the image: it says nothing."""
LEAST_SLOPE_STD = 1e-3
"""Least standard deviation of a slope, per metre."""
RIPPLE_M = 0.015
"""Error of a plate's ln(V / H) over its own slopes: copies of other plates turn their phase against the plate by
50 to 100 radians per metre. 15 mm fits the errors of plates of the independent generator best (20 and 30 are worse)."""
PHASE_OF_CHANGE = 0.75
"""Errors of a plate's phase by drift, fringes and its own slopes, over those that the slopes tell. The phase's slopes
are larger than the amplitude's, its errors are not: the interval that holds 68 % is 0.73 of what the amplitude needs in
scenes of the own simulator where these errors dominate, 0.83 in those of the independent generator."""
USUAL_RIPPLE = 2.0
"""Weight of the scene's usual slopes against a plate's own three; chosen."""


@dataclass(frozen=True)
class CommonChange:
    """Change of ln(V / H) over the scan.

    Attributes
    ----------
    value, std
        complex [plate]: ln(V / H) at each plate relative to the origin by drift and fringes, and the standard
        deviations of its real and of its imaginary part.
    drift, drift_std
        complex [plate]: the part of them that drift makes.
    ripple
        float64 [plate]: error of each part of the plate's ln(V / H) by its own slopes.
    fringes
        Probability of fringes by a second path beside the direct path.
    drifts
        Probability that the gains drift, by more than those of a stable rig.
    """

    value: Complex
    std: Complex
    drift: Complex
    drift_std: Complex
    ripple: Real
    fringes: float
    drifts: float

    def largest_drift(self) -> tuple[float, float]:
        """Return the largest root mean square of the drift at a plate, of its real and of its imaginary part."""
        if not self.drift.size:
            return 0.0, 0.0
        amplitude = np.hypot(self.drift.real, self.drift_std.real)
        phase = np.hypot(self.drift.imag, self.drift_std.imag)
        return float(amplitude.max()), float(phase.max())

    def log_ratio(self, plate: int) -> tuple[complex, tuple[float, float]]:
        """Return ln(V / H) of a plate relative to the origin, and the standard deviations of both of its parts."""
        std = complex(self.std[plate])
        ripple = float(self.ripple[plate])
        of_phase = PHASE_OF_CHANGE * float(np.hypot(std.imag, ripple))
        return complex(self.value[plate]), (float(np.hypot(std.real, ripple)), of_phase)


def estimate_common_change(
    plates: Sequence[Scatter], origin_m: tuple[float, float], at_border: Sequence[bool] = ()
) -> CommonChange:
    """Estimate the change of ln(V / H) over the scan from the slopes of all plates of a scene.

    It is zero at `origin_m`, (x, y) of the metal reference. The slopes of plates `at_border` of the image (one value
    for each plate; none if empty) tell nothing; these plates have an estimate as all others.
    """
    border = np.array(at_border, bool) if at_border else np.zeros(len(plates), bool)
    places_m = np.array([plate.centre_m for plate in plates], np.float64).reshape(-1, 2)
    smooth_fields = _Fields.collect(places_m, np.array(origin_m, np.float64))
    parts = []
    noises = []
    for part in (np.real, np.imag):
        slopes = np.array([part(plate.slope) for plate in plates], np.float64).reshape(-1, 2).T
        noise = np.array([part(plate.slope_std) for plate in plates], np.float64).reshape(-1, 2).T
        noises.append(np.maximum(noise, LEAST_SLOPE_STD))
        parts.append(smooth_fields.explain(slopes, noises[-1] + BORDER_SLOPE_STD * border))
    # Fringes, and slopes that all plates have alike, are as large in amplitude as in phase.
    log_weight = parts[0].log_evidence + parts[1].log_evidence + smooth_fields.log_prior
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    real = parts[0].average(weight)
    imag = parts[1].average(weight)
    return CommonChange(
        value=(real.mean + 1j * imag.mean)[0],
        std=(real.std + 1j * imag.std)[0],
        drift=(real.drift + 1j * imag.drift)[0],
        drift_std=(real.drift_std + 1j * imag.drift_std)[0],
        ripple=RIPPLE_M * _estimate_own_slopes((real.remaining[0], imag.remaining[0]), noises, border),
        fringes=float(sum(w for w, (size, _, _, _) in zip(weight, smooth_fields.shared, strict=True) if size > 0)),
        drifts=float(sum(w for w, (_, _, _, stable) in zip(weight, smooth_fields.shared, strict=True) if not stable)),
    )


def _estimate_own_slopes(remaining: Sequence[Real], noises: Sequence[Real], border: npt.NDArray[np.bool_]) -> Real:
    """Return the root mean square of each plate's own slopes beyond their errors, [plate], per metre.

    `remaining` and `noises` are those of the real part and of the imaginary part, [2, plate] each, along x and y. What
    disturbs a plate does so alike both ways and in both parts. Unevenness changes the brightness of H and V along y
    alone, in which direction they see different places; it is antisymmetric about the middle and no error of the
    median: these slopes are left out.
    """
    (real_x, _), (imag_x, imag_y) = remaining
    (noise_real_x, _), (noise_imag_x, noise_imag_y) = noises
    slopes = np.stack([real_x, imag_x, imag_y])
    errors = np.stack([noise_real_x, noise_imag_x, noise_imag_y])
    usual = float(
        np.mean([_estimate_excess_variance(s[~border], e[~border]) for s, e in zip(slopes, errors, strict=True)])
    )
    # Plates at the border, whose slopes tell nothing, get the usual size.
    excess = np.where(border, len(slopes) * usual, np.maximum(np.sum(slopes**2 - errors**2, axis=0), 0.0))
    return np.sqrt((USUAL_RIPPLE * usual + excess) / (USUAL_RIPPLE + len(slopes)))


def _estimate_excess_variance(slopes: Real, errors: Real) -> float:
    """Return the variance of slopes [plate] about zero beyond their errors; 0 with fewer than three plates.

    It is robust: one plate that hardly reflects V, whose slopes are large, is no ripple.
    """
    if slopes.size < 3:
        return 0.0
    scatter = 1.4826 * float(np.median(np.abs(slopes)))
    # Larger by the freedom that what all plates share has taken: it was fitted to the same slopes (two, chosen).
    return max(0.0, scatter**2 - float(np.median(errors)) ** 2) * slopes.size / (slopes.size - 2)


@dataclass(frozen=True)
class _Field:
    """Covariances of a smooth field of unit variance on the plane, relative to its value at the origin.

    Attributes
    ----------
    of_slopes
        [2 plate, 2 plate]: of its slopes as the plates' images show them, those along x before those along y.
    with_slopes
        [plate, 2 plate]: of its values with its slopes.
    of_itself
        [plate]: variances of its values.
    """

    of_slopes: Real
    with_slopes: Real
    of_itself: Real

    @classmethod
    def along(cls, axes: tuple[int, int], length_m: float, places_m: Real, origin_m: Real) -> _Field:
        """Return a field with a Gaussian covariance of length `length_m`, at places [plate, 2].

        `axes` has 1 for each of x and y along which the field changes, and 0 for one along which it is constant.
        """
        count = len(places_m)
        distance = (places_m[:, None] - places_m[None]) * np.array(axes)
        from_origin = (places_m - origin_m) * np.array(axes)
        covariance = np.exp(-0.5 * np.sum(distance**2, axis=-1) / length_m**2)
        with_origin = np.exp(-0.5 * np.sum(from_origin**2, axis=-1) / length_m**2)
        # Derivatives of the Gaussian covariance by one place and by both.
        product = distance[..., :, None] * distance[..., None, :] / length_m**2
        of_slopes = covariance[..., None, None] * (np.diag(axes) - product) / length_m**2
        with_slopes = (covariance[..., None] * distance + (with_origin[:, None] * from_origin)[None]) / length_m**2
        return cls(
            of_slopes=SLOPE_SEEN**2 * of_slopes.transpose(2, 0, 3, 1).reshape(2 * count, 2 * count),
            with_slopes=SLOPE_SEEN * with_slopes.transpose(0, 2, 1).reshape(count, 2 * count),
            of_itself=2 - 2 * with_origin,
        )


@dataclass(frozen=True)
class _Fields:
    """Drift and fringes at the places of the plates, and the prior of what both parts of ln(V / H) share.

    Attributes
    ----------
    drifts
        Fields of unit variance along y, one for each of `DRIFT_LENGTHS_M`.
    fringes
        Length in metres to the field of unit variance over the plane.
    shared
        Size and length of the fringes, the size of the slopes that all plates have alike, and whether the rig is
        stable.
    log_prior
        Logarithm of the prior probability of each of `shared`.
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
        cases = itertools.product(FRINGES.items(), FRINGE_LENGTHS_M, COMMON_SLOPES.items(), (True, False))
        for (size, share), length_m, (common, share_of_common), stable in cases:
            shared.append((size, length_m, common, stable))
            prior.append(share * share_of_common * (STABLE if stable else 1 - STABLE))
        return cls(
            drifts=[_Field.along((0, 1), length_m, places_m, origin_m) for length_m in DRIFT_LENGTHS_M],
            fringes={length_m: _Field.along((1, 1), length_m, places_m, origin_m) for length_m in FRINGE_LENGTHS_M},
            shared=shared,
            log_prior=np.log(prior),
        )

    def explain(self, slopes: Real, noise: Real) -> _Explained:
        """Return what the slopes [2, plate] of one part and their errors tell, for each of `shared`."""
        parts = [_list_arrays(self._explain(slopes, noise, *shared)) for shared in self.shared]
        return _Explained(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    def _explain(
        self, slopes: Real, noise: Real, fringe: float, fringe_m: float, common: float, stable: bool
    ) -> _Explained:
        """Return the same for one of `shared`, averaged over drifts and the plates' own slopes by their evidence.

        `fringe` and `fringe_m` are size and length of the fringes, `common` that of the slopes that all plates have.
        """
        count = slopes.shape[1]
        measured = slopes.ravel()
        fringes = self.fringes[fringe_m]
        of_common_causes = common**2 * np.kron(np.eye(2), np.ones((count, count))) + fringe**2 * fringes.of_slopes
        own_slopes, share = _estimate_own_variances(count)
        cases = []
        for field, drift in itertools.product(self.drifts, DRIFTS[stable]):
            explained = of_common_causes + drift**2 * field.of_slopes
            total = explained + (noise.ravel() ** 2 + own_slopes)[:, :, None] * np.eye(2 * count)
            # Gaussian process: `answer` weighs the slopes, its products with covariances are the expected values.
            inverse = np.asarray(np.linalg.inv(total), np.float64)
            answer = inverse @ measured
            of_drift = drift**2 * field.with_slopes
            of_all = of_drift + fringe**2 * fringes.with_slopes
            variance_of_drift = drift**2 * field.of_itself
            case = _Explained(
                log_evidence=np.log(share / len(DRIFTS[stable]))
                - 0.5 * answer @ measured
                + 0.5 * np.linalg.slogdet(inverse)[1],
                mean=answer @ of_all.T,
                square=_compute_mean_square(answer, inverse, of_all, variance_of_drift + fringe**2 * fringes.of_itself),
                drift=answer @ of_drift.T,
                drift_square=_compute_mean_square(answer, inverse, of_drift, variance_of_drift),
                remaining=slopes - (answer @ explained).reshape(-1, 2, count),
            )
            cases.append(case)
        return _Explained.average_over(cases)


def _estimate_own_variances(count: int) -> tuple[Real, Real]:
    """Return variances of the plates' own slopes along x and y, [case, 2 plate], and the probability of each case."""
    variances = []
    shares = []
    for along_x, along_y in itertools.product(OWN_SLOPES, OWN_SLOPES):
        variances.append(np.repeat([along_x**2, along_y**2], count))
        share = (1 - ALIKE_BOTH_WAYS) / len(OWN_SLOPES) ** 2
        if along_x == along_y:
            share += ALIKE_BOTH_WAYS / len(OWN_SLOPES)
        shares.append(share)
    return np.array(variances), np.array(shares)


def _compute_mean_square(answer: Real, inverse: Real, with_slopes: Real, of_itself: Real) -> Real:
    """Return the mean square of a field at each plate, [case, plate], from its covariance with the slopes."""
    explained_variance = np.sum(with_slopes @ inverse * with_slopes, axis=-1)
    return np.maximum(of_itself - explained_variance, 0.0) + (answer @ with_slopes.T) ** 2


@dataclass(frozen=True)
class _Explained:
    """Drift and fringes expected from the slopes of one part (real or imaginary), for some cases.

    Attributes
    ----------
    log_evidence
        [case]: logarithm of the probability density of the slopes, but for a constant factor.
    mean, square
        [case, plate]: mean and mean square of drift and fringes at each plate.
    drift, drift_square
        [case, plate]: mean and mean square of the drift alone.
    remaining
        [case, 2, plate]: slopes along x and y that are left.
    """

    log_evidence: Real
    mean: Real
    square: Real
    drift: Real
    drift_square: Real
    remaining: Real

    @classmethod
    def average_over(cls, parts: Sequence[_Explained]) -> _Explained:
        """Return one case for all cases of `parts`, weighed by their evidence."""
        together = cls(*(np.concatenate(arrays) for arrays in zip(*map(_list_arrays, parts), strict=True)))
        largest = float(together.log_evidence.max())
        weight = np.exp(together.log_evidence - largest)
        average = together.average(weight / weight.sum())
        return replace(average, log_evidence=np.array([largest + np.log(weight.sum())]))

    def average(self, weight: Real) -> _Explained:
        """Return one case, the average with weights [case]."""
        return _Explained(*(np.tensordot(weight, array, 1)[None] for array in _list_arrays(self)))

    @property
    def std(self) -> Real:
        """Standard deviation of drift and fringes, [case, plate]."""
        return np.sqrt(np.maximum(self.square - self.mean**2, 0.0))

    @property
    def drift_std(self) -> Real:
        """Standard deviation of the drift alone, [case, plate]."""
        return np.sqrt(np.maximum(self.drift_square - self.drift**2, 0.0))


def _list_arrays(explained: _Explained) -> tuple[Real, ...]:
    """Return the values of the fields, in the order in which the class declares them."""
    return tuple(getattr(explained, field.name) for field in fields(explained))
