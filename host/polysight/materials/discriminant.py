"""The discriminant of error sources: materials as distributions over pixels, patches, specimens and scans.

On ln|H|, ln|V| and arg P errors of gain and of phase are additive. A pixel of material m in patch p of scan s is

    z = mean_m + F_m d + g_s + u_p + e,

with e the pixel's own error (speckle), u_p the error of the whole patch (placement, uneven illumination), g_s that of
the scan's metal reference, common to all its patches, and d the deviation of the specimen from its material in ln eps'
and ln eps'', which F_m converts to features (`specimens.py`): a linear model with random effects (Searle, Casella and
McCulloch, Variance Components, chapter 5). If V nearly vanishes its error is additive (`softened`). The covariances are
estimated from the library: by residual mean squares of pixels, patches and scans; that of patches is divided into
placement and specimen by expectation maximisation. A decision uses them as follows:

* a single pixel has all errors;
* a patch is named from the mean of its pixels, in which e averages out;
* the patches of a scan are named together: g_s, and the remaining errors of leakage, angle and reference, are common
  to them, so that these errors and the names are estimated in turns (expectation maximisation).

The result is a probability of each material and of none of them (`cost_of_none` in `specimens.py`).

A leakage or gain error moves all patches alike, and a patch gives information on it only if its material is known
(`explanations`). If the library's materials lie in a row, a common error can shift every plate to its neighbour and fit
nearly as well; iterations that start at zero error find only one of these explanations. Here they start at the error
that would make any one patch any one material, and each explanation found is weighted with its evidence (Laplace's
approximation; MacKay, Information Theory, Inference, and Learning Algorithms, chapter 27).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.library import Model, NamedScan, Real, Samples, SceneErrors, by_angle
from polysight.materials.specimens import (
    METAL_SPECIMENS,
    METAL_WITHOUT_ERROR,
    apparent_permittivity,
    cost_of_none,
    effect,
    fit_spread,
    relative,
    without,
)

_ROUNDS, _FIRST_ROUNDS = 30, 3
_TURNS = 2  # alternations of the error and the likelihood of none of the materials
_STARTS, _TRIED = 100, 6  # the most plausible starts, and the best of them for all patches
_UNLIKELY = 12.0  # log evidence below the best one's, after the first rounds, to drop an explanation
_SAME = 1.0  # standard deviations within which two explanations are the same
_LN_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class CommonError:
    """An error common to the patches of a scan, with its covariance and its effect on each patch.

    `design` [patch, d, q] converts the error's q numbers to deviations; `value` [q]; `covariance` [q, q]; `precision`
    [q, q] is that of the prior.
    """

    design: Real
    value: Real
    covariance: Real
    precision: Real

    @property
    def shift(self) -> Real:
        """Deviations by the error, [patch, d]."""
        return np.asarray(self.design @ self.value, np.float64)

    @property
    def spread(self) -> Real:
        """Their covariances, [patch, d, d]."""
        return np.asarray(self.design @ self.covariance @ self.design.mT, np.float64)


@dataclass(frozen=True)
class Patches:
    """Deviations of patches from materials.

    `mean` [patch, materials, d] of their means, `own` [patch, materials, d, d] the covariances of the patches' own
    errors, `informative` bool [patch]: usable to estimate the common error.
    """

    mean: Real
    own: Real
    informative: npt.NDArray[np.bool_]


def explanations(
    seen: Patches, before: CommonError, none: Callable[[CommonError], Real]
) -> list[tuple[float, CommonError]]:
    """Return the common errors that explain a scan, each with its probability, the likeliest first.

    `before` is the prior of the error; `none` returns minus twice the log likelihood [patch] of none of the materials
    under an error. With fewer than two informative patches the result is the prior.
    """
    at = np.flatnonzero(seen.informative)
    if at.size < 2:
        return [(1.0, before)]
    cost = none(before)
    first = [_alternate(seen, start, cost, _FIRST_ROUNDS) for start in (before, *_starts(seen, before, cost))]
    found: list[tuple[float, CommonError]] = []
    for evidence, start in _distinct([(_evidence(seen, e, cost), e) for e in first]):
        if found and evidence < found[0][0] - _UNLIKELY:
            continue
        error, cost_of_none = start, cost
        for _ in range(_TURNS):
            cost_of_none = none(error)
            error = _alternate(seen, error, cost_of_none, _ROUNDS)
        found.append((_evidence(seen, error, cost_of_none), error))
    found = _distinct(found)
    weight = np.exp(np.array([e for e, _ in found]) - found[0][0])
    return [(float(w), error) for w, (_, error) in zip(weight / weight.sum(), found, strict=True)]


def costs(d: Real, covariances: Real) -> tuple[Real, Real]:
    """Return squared distances and minus twice the log likelihoods of deviations [n, materials, d], [n, materials]."""
    inverse = np.linalg.inv(covariances)
    q = np.sum(d * (inverse @ d[..., None])[..., 0], axis=-1)
    return q, q - np.linalg.slogdet(inverse)[1] + d.shape[2] * _LN_2PI


def probabilities(cost: Real, none: Real) -> Real:
    """Return the probability of every material and, last, of none of them, [n, materials + 1]."""
    every = np.concatenate([cost, none[:, None]], axis=1)
    w = np.exp(-0.5 * (every - every.min(axis=1, keepdims=True)))
    return w / w.sum(axis=1, keepdims=True)


def _starts(seen: Patches, before: CommonError, none: Real) -> list[CommonError]:
    """Return start values: the error that makes one patch one material, for the best of all such pairs."""
    at = np.flatnonzero(seen.informative)
    mean, g = seen.mean[at], before.design[at][:, None]  # [patch, materials, d], [patch, 1, d, q]
    inverse = np.linalg.inv(seen.own[at])
    constant = -np.linalg.slogdet(inverse)[1] + mean.shape[2] * _LN_2PI
    weighed = g.mT @ inverse
    covariance = np.linalg.inv(before.precision + weighed @ g)
    value = (covariance @ weighed @ mean[..., None])[..., 0]

    def distances(errors: Real) -> Real:
        """Squared distances [..., patch, materials] under errors [..., q], and of the errors themselves [...]."""
        off = mean - (before.design[at] @ errors[..., None, :, None])[..., None, :, 0]
        return np.einsum("...pkd,pkde,...pke->...pk", off, inverse, off, optimize=True)

    prior = np.einsum("pkq,qr,pkr->pk", value, before.precision, value)
    own = (mean - (g @ value[..., None])[..., 0])[..., None]
    surprise = prior + (own.mT @ inverse @ own)[..., 0, 0]
    nearest = np.unravel_index(np.argsort(surprise, axis=None)[:_STARTS], surprise.shape)
    each = 0.5 * distances(value[nearest]) + constant  # half: the start is about as uncertain as a patch
    fit = np.minimum(each.min(axis=-1), none[at]).sum(axis=-1) + prior[nearest]
    starts = zip(fit, value[nearest], covariance[nearest], strict=True)
    found = [(-float(f), replace(before, value=v, covariance=c)) for f, v, c in starts]
    return [error for _, error in _distinct(found, _TRIED)]


def _alternate(seen: Patches, error: CommonError, none: Real, rounds: int) -> CommonError:
    """Estimate the error from the patches' deviations, alternating with the probabilities of their materials.

    Patches that are probably none of the materials have little weight.
    """
    at = np.flatnonzero(seen.informative)
    design, precision, g = error.design, error.precision, error.design[at]
    mean, own = seen.mean[at], seen.own[at]
    for _ in range(rounds):
        _, cost = costs(mean - error.shift[at][:, None], own + error.spread[at][:, None])
        middle, information = _moments(mean, own, probabilities(cost, none[at])[:, :-1])
        covariance = np.linalg.inv(precision + np.sum(g.mT @ information @ g, axis=0))
        combined = np.sum(g.mT @ (information @ middle[:, :, None]), axis=0)[:, 0]
        before, value = error.value, covariance @ combined
        error = CommonError(design, value, covariance, precision)
        if np.abs(design @ (value - before)).max() < 1e-7:
            break
    return error


def _evidence(seen: Patches, error: CommonError, none: Real) -> float:
    """Return the log evidence of an explanation up to a constant, by Laplace's approximation."""
    at = np.flatnonzero(seen.informative)
    _, cost = costs(seen.mean[at] - error.shift[at][:, None], seen.own[at])
    every = -0.5 * np.concatenate([cost, none[at, None]], axis=1)
    top = every.max(axis=1)
    likelihood = float(np.sum(top + np.log(np.exp(every - top[:, None]).sum(axis=1))))
    prior = -0.5 * float(error.value @ error.precision @ error.value)
    return likelihood + prior + 0.5 * float(np.linalg.slogdet(error.covariance)[1])


def _distinct(found: list[tuple[float, CommonError]], most: int | None = None) -> list[tuple[float, CommonError]]:
    """Drop explanations that equal a likelier one; return at most `most`, the likeliest first."""
    out: list[tuple[float, CommonError]] = []
    for evidence, error in sorted(found, key=lambda f: -f[0]):
        if len(out) == most:
            break
        apart = [(error.value - kept.value, np.linalg.inv(kept.covariance)) for _, kept in out]
        if all(float(a @ inverse @ a) > _SAME**2 for a, inverse in apart):
            out.append((evidence, error))
    return out


def _moments(d: Real, covariances: Real, weight: Real) -> tuple[Real, Real]:
    """Return mean deviation [patch, d] and information [patch, d, d] of patches of uncertain material.

    They are those of the normal distribution with the moments of the mixture, less if it may be none of the materials.
    """
    known, weight = weight.sum(axis=1), weight + 1e-12
    share = weight / weight.sum(axis=1, keepdims=True)
    middle = np.einsum("pk,pkd->pd", share, d)
    off = d - middle[:, None]
    spread = np.einsum("pk,pkde->pde", share, covariances + off[..., :, None] * off[..., None, :])
    return middle, np.asarray(known[:, None, None] * np.linalg.inv(spread), np.float64)


REJECTED = 0.02
"""Share of the known materials' pixels, and of their patches, that are called unknown."""
NONE = 0.02
"""Prior probability that a patch is none of the library's materials."""
_TWO_WAY_ROUNDS = 30
_BEYOND = 1.001  # least distance of unknown patches
_LN_2PI = float(np.log(2 * np.pi))


class ErrorDiscriminant(Model):
    """The discriminant of error sources, see the module's docstring; `channels` is one of `CHANNELS`."""

    knows_scans = True

    def __init__(self, channels: str = "H+V+P") -> None:
        self.channels = channels

    def fit(self, samples: Samples) -> ErrorDiscriminant:
        """Estimate means and covariances."""
        self.names, of = np.unique(samples.names, return_inverse=True)
        self.angles_rad = [math.radians(a) for a in samples.angles_deg]
        self._anchor(samples.x, of)
        d = self._deviations(samples.x)[np.arange(of.size), of]
        width = d.shape[1]
        _, patch, count = np.unique(samples.patches, return_inverse=True, return_counts=True)
        first = np.zeros(count.size, np.intp)
        first[patch[::-1]] = np.arange(of.size)[::-1]
        material, scan, plate = (
            of[first],
            np.unique(samples.groups, return_inverse=True)[1][first],
            samples.plates[first],
        )
        mean = np.stack([np.bincount(patch, c) for c in d.T], axis=1) / count[:, None]
        informative = ~self._metal_like(samples.x, patch)
        if not informative.any():
            informative[:] = True

        offset, self.level = _two_way(mean, material, scan, informative)
        self.pixels = float(np.median(count))
        self.placements = np.bincount(material).astype(float)
        self.plates = np.array([np.unique(plate[material == k]).size for k in range(self.names.size)], np.float64)
        residual = mean - self.level[material] - offset[scan]
        scans = np.unique(scan[informative]).size
        dof = max(int(informative.sum()) - np.unique(material[informative]).size - scans + 1, 1)
        pixel, used = d - mean[patch], informative[patch]
        self.within = self._independent(_covariance(pixel[used], max(int(used.sum() - informative.sum()), 1)))
        self._effects = self._specimen_effects()
        self._fit_patches(
            residual[informative] * np.sqrt(informative.sum() / dof), material[informative], plate[informative], dof
        )
        each = max(informative.sum() / scans, 1.0)
        common = self._independent(_covariance(offset[np.unique(scan[informative])], max(scans - 1, 1)))
        self.scan = _positive(common - self.between / each) + 1e-8 * np.eye(width)
        self._set_thresholds(
            (mean - self.level[material])[informative],
            material[informative],
            (d - self.level[of])[used],
            of[used],
            float(dof),
        )
        return self

    @property
    def distributions(self) -> ErrorDiscriminant:
        """The model itself; other models have a discriminant to recognise unknown patches."""
        return self

    @property
    def permittivities(self) -> dict[str, complex]:
        """Material to permittivity of the half space with its ratio; without metals; empty if angles are not known."""
        if not len(self.angles_rad):
            return {}
        dielectric = (abs(self._anchor_t - 1) > METAL_SPECIMENS).all(axis=1)
        kinds = zip(self.names[dielectric], self._anchor_t[dielectric], strict=True)
        return {str(name): apparent_permittivity(t, self.angles_rad) for name, t in kinds}

    def by_pixel(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Classify each pixel independently: return its name, and its distance over the threshold."""
        q, cost = costs(self._deviations(x) - self.level, self._pixel_covariances())
        best = cost.argmin(axis=1)
        return self.names[best], np.sqrt(q[np.arange(len(x)), best] / self.pixel_level)

    def pixel_probabilities(self, x: Real) -> Real:
        """Return the probability of each material for pixels classified independently, [n, materials]."""
        _, cost = costs(self._deviations(x) - self.level, self._pixel_covariances())
        return probabilities(cost, np.full(len(x), np.inf))[:, :-1]

    def by_scan(
        self, x: Real, patches: npt.NDArray, errors: SceneErrors | None = None, others: float | None = None
    ) -> NamedScan:
        """Name the patches and pixels of one scan, with an estimate of the errors common to all patches.

        `errors` are added to the library's own; they hold for one angle and are ignored with several. With `others`,
        the prior of a pixel is its patch's name, except for this share; without, pixels are independent.
        """
        _, patch = np.unique(patches, return_inverse=True)
        ids = np.unique(patches)
        d = self._deviations(x) - self.level
        mean = np.stack([d[patch == i].mean(axis=0) for i in range(ids.size)])
        informative = ~self._metal_like(x, patch)
        pixels = float(min([self.pixels, *np.bincount(patch).tolist()]))
        own = self._patch_covariances(pixels)
        mine = np.zeros((ids.size, *self.scan.shape))
        if errors is not None and errors.own.shape[1:] == mine.shape[1:]:
            mine = errors.own
        else:
            errors = None
        placed = self.within / pixels + self.between + mine
        found = explanations(
            Patches(mean, own + mine[:, None], informative),
            self._prior(ids.size, errors),
            lambda error: self._none(x, patch, placed, error),
        )
        probability, share, distance2 = np.zeros((ids.size, self.names.size + 1)), 0.0, 0.0
        for weight, error in found:
            q, cost = costs(mean - error.shift[:, None], own + (mine + error.spread)[:, None])
            each = probabilities(cost, self._none(x, patch, placed, error))
            probability += weight * _reduce_distant(each, q - self.patch_level)
            known = weight * np.maximum(probabilities(cost, np.full(ids.size, np.inf))[:, :-1], 1e-12)  # if known
            share, distance2 = share + known, distance2 + known * q
        far = np.sqrt(distance2 / share / self.patch_level)
        at, scene = (np.arange(ids.size), np.argmax(share, axis=1)), found[0][1]
        alone = self._patch_covariances(1.0)[None] + (mine + scene.spread)[:, None]
        pixel_q, pixel_cost = costs(d - scene.shift[patch][:, None], alone[patch])
        if others is not None:
            prior = (1 - others) * probability[:, :-1] + others / self.names.size
            pixel_cost = pixel_cost - 2 * np.log(prior[patch])
        of = np.arange(len(x)), pixel_cost.argmin(axis=1)
        in_library = 1.0 if others is None else 1 - (1 - others) * probability[patch, -1]
        return NamedScan(
            self.names[of[1]],
            np.sqrt(pixel_q[of] / self.pixel_level),
            ids,
            self.names[at[1]],
            probability[at],
            np.where(probability[:, -1] > probability[at], np.maximum(far[at], _BEYOND), far[at]),
            far,
            probability,
            self.names,
            in_library * probabilities(pixel_cost, np.full(len(x), np.inf)).max(axis=1),
        )

    def _fit_patches(self, residual: Real, material: npt.NDArray, plate: npt.NDArray, dof: int) -> None:
        """Estimate the covariance of placements, and of each material's specimens, from patches' residuals."""
        width = residual.shape[1]
        total = self._independent(_covariance(residual, len(residual)))
        shrink = width / (width + dof)
        self.spread, placement = fit_spread(
            residual, material, plate, self._effects, total, gains_alike=self.channels == "H+V+P"
        )
        placement = self._independent(placement) * self._gain_and_phase
        placement = (1 - shrink) * placement + shrink * np.diag(np.diag(placement))
        self.between = _positive(placement - self.within / self.pixels) + 1e-8 * np.eye(width)

    def _specimen_effects(self) -> Real:
        """Return the effect of specimens' deviations on the features of each material, [materials, features, 2]."""
        every = np.stack([effect(t, self.angles_rad) for t in self._anchor_t])
        apart = every.reshape(*self._anchor_t.shape, 3, 2).transpose(0, 3, 1, 2)
        return self._chosen(apart).swapaxes(1, 2)

    def _prior(self, count: int, errors: SceneErrors | None) -> CommonError:
        """Return the prior of the error common to `count` patches: mean zero, covariance of scans and `errors`."""
        width = len(self.scan)
        design, prior = np.tile(np.eye(width), (count, 1, 1)), self.scan
        if errors is not None:
            design = np.concatenate([design, errors.design], axis=2)
            both = np.zeros((design.shape[2],) * 2)
            both[:width, :width], both[width:, width:] = prior, errors.covariance
            prior = both
        return CommonError(design, np.zeros(len(prior)), prior, np.asarray(np.linalg.inv(prior), np.float64))

    def _none(self, x: Real, patch: npt.NDArray[np.intp], covariances: Real, scene: CommonError) -> Real:
        """Return minus twice the log likelihood of each patch as any other half space, [patch].

        `covariances` [patch, d, d] of the patches' own errors; the scene's are added, as for the materials.
        """
        h, _, t = by_angle(x)
        log_h = np.stack([np.log(np.maximum(h[patch == i], 1e-6)).mean(axis=0) for i in range(patch.max() + 1)])
        middle = np.stack([t[patch == i].mean(axis=0) for i in range(patch.max() + 1)])
        covariances = covariances + scene.spread
        if self.channels != "H+V+P" or not len(self.angles_rad):  # no model of half spaces: likelihood at the threshold
            return np.asarray(
                self.patch_level + np.linalg.slogdet(covariances)[1] + covariances.shape[1] * _LN_2PI, np.float64
            )
        log_h, middle = without(log_h, middle, scene.shift.reshape(*middle.shape, 3))
        return cost_of_none(log_h, middle, covariances, self.angles_rad) - 2 * np.log(
            NONE / (1 - NONE) * self.names.size
        )

    def _anchor(self, x: Real, of: npt.NDArray[np.intp]) -> None:
        """Set the expansion point of each material's features: the means of its pixels."""
        h, v, t = by_angle(x)
        logs = np.log(np.maximum(h, 1e-6)), np.log(np.maximum(v, 1e-6))
        each = [of == k for k in range(self.names.size)]
        self._anchor_h, self._anchor_v, self._anchor_t = (
            np.stack([c[at].mean(axis=0) for at in each]) for c in (*logs, t)
        )
        width = len(self._chosen(np.zeros((1, 1, 3)))[0])
        features = width * h.shape[1]
        self._same_angle = np.arange(features)[:, None] // width == np.arange(features)[None] // width
        self.level = np.zeros((self.names.size, features))
        phase = np.tile({"P": [0, 1], "H+V+P": [0, 0, 1]}.get(self.channels, [0]), h.shape[1])
        self._gain_and_phase = (phase[:, None] == phase[None]).astype(float)

    def _deviations(self, x: Real) -> Real:
        """Return the deviations from every material's anchor, [n, materials, features]."""
        h, v, t = by_angle(x)
        if self.channels == "V":  # alone, by its own logarithm
            return np.log(np.maximum(v, 1e-6))[:, None] - self._anchor_v
        log_h = np.log(np.maximum(h, 1e-6))[:, None] - self._anchor_h
        return self._chosen(relative(log_h, t[:, None] - self._anchor_t, self._anchor_t))

    def _chosen(self, every: Real) -> Real:
        """Select the model's channels of ln|H|, ln|V|, arg P [..., angles, 3]; return [..., features]."""
        h, v, angle = (every[..., i] for i in range(3))
        columns = {"H": (h,), "V": (v,), "P": (v - h, angle), "H+V+P": (h, v, angle)}[self.channels]
        return np.stack(columns, axis=-1).reshape(*every.shape[:-2], -1)

    @staticmethod
    def _metal_like(x: Real, patch: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
        """Return true for patches 0, 1, ... whose median V / H is nearly 1 under all angles, bool [patch]."""
        q = by_angle(x)[2]
        parts = [q[patch == i] for i in range(patch.max() + 1)]
        middle = np.stack([np.median(p.real, axis=0) + 1j * np.median(p.imag, axis=0) for p in parts])
        return np.asarray((np.abs(middle - 1) < METAL_WITHOUT_ERROR).all(axis=1), np.bool_)

    def _independent(self, covariance: Real) -> Real:
        """Remove correlations between angles: errors of their scans are independent (effects of specimens are not)."""
        return np.where(self._same_angle, covariance, 0.0)

    def _patch_covariances(self, pixels: float) -> Real:
        """Return the covariance of the mean of `pixels` pixels about each material's mean, [materials, d, d].

        It includes the error of the material's mean, known from a limited number of placements and specimens.
        """
        known = (1 + 1 / self.placements)[:, None, None]
        differ = self._effects * (self.spread * (1 + 1 / self.plates[:, None]))[:, None]
        return self.within / pixels + self.between * known + differ @ self._effects.mT

    def _pixel_covariances(self) -> Real:
        return self._patch_covariances(1.0) + self.scan

    def _set_thresholds(self, patches: Real, material: npt.NDArray, pixels: Real, of: npt.NDArray, dof: float) -> None:
        """Set the squared distances that known materials exceed with probability REJECTED.

        The larger of Hotelling's distribution, for an estimated mean and covariance, and the quantile of the library's
        own patches (each left out of its material's mean). Without enough patches there is no threshold.
        """
        width = patches.shape[1]
        free = max(dof - width + 1, 1)
        law = float(width * dof / free * scipy.special.fdtri(width, free, 1 - REJECTED)) if dof > width else np.inf
        left_out = (self.placements / np.maximum(self.placements - 1, 1))[:, None]

        def farthest(d: Real, of: npt.NDArray, covariances: Real) -> float:
            d = d * left_out[of]
            q = np.einsum("nd,nde,ne->n", d, np.linalg.inv(covariances)[of], d)
            return float(np.quantile(q, 1 - REJECTED))

        self.patch_level = max(law, farthest(patches, material, self._patch_covariances(self.pixels) + self.scan))
        self.pixel_level = max(law, farthest(pixels, of, self._pixel_covariances()))


def _two_way(mean: Real, material: npt.NDArray, scan: npt.NDArray, informative: npt.NDArray) -> tuple[Real, Real]:
    """Least squares of patch means = material + scan: offsets [scans, d], of mean zero, and levels [materials, d]."""
    offset, level = np.zeros((scan.max() + 1, mean.shape[1])), np.zeros((material.max() + 1, mean.shape[1]))
    for _ in range(_TWO_WAY_ROUNDS):
        for k in np.unique(material):
            at = material == k
            level[k] = (mean[at] - offset[scan[at]] * informative[at, None]).mean(axis=0)
        for s in np.unique(scan[informative]):
            at = (scan == s) & informative
            offset[s] = (mean[at] - level[material[at]]).mean(axis=0)
        offset -= offset[np.unique(scan[informative])].mean(axis=0)
    return offset, level


def _covariance(residual: Real, dof: int) -> Real:
    return residual.T @ residual / max(dof, 1)


def _positive(a: Real) -> Real:
    """Return the nearest matrix without negative eigenvalues."""
    values, vectors = np.linalg.eigh((a + a.T) / 2)
    return (vectors * np.maximum(values, 0)) @ vectors.T


def _reduce_distant(probability: Real, beyond: Real) -> Real:
    """Lower the probabilities [n, materials + 1] of distant materials: a patch may be something no model describes.

    `beyond` [n, materials] is the chi-square of a patch minus the threshold that 2 % of a material's patches exceed.
    At the threshold half of the probability goes to none of the materials, far beyond it all, so that a patch called
    unknown for its distance has no likelier name.
    """
    known = probability[:, :-1] * scipy.special.expit(-beyond)
    return np.concatenate([known, 1 - known.sum(axis=1, keepdims=True)], axis=1)
