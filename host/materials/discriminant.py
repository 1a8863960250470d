"""Materials as distributions, told apart by all that errors and specimens do: pixel, patch, specimen, scan.

On ln|H|, ln|V| and arg P errors of gain and of phase are additive. A pixel of material m in patch p of scan s is

    z = mean_m + F_m d + g_s + u_p + e,

with e the pixel's own error (speckle), u_p that of the whole patch (its placement, uneven illumination), g_s that of
the scan's metal reference, which all patches of the scan inherit, and d the deviation of the specimen from its
material in ln eps' and ln eps'', which F_m turns into features (`specimens.py`): a linear model with random effects
(Searle, Casella and McCulloch, Variance Components, chapter 5). Where V nearly vanishes its error is additive, and is
taken so (`softened`). The covariances are estimated from the library: by residual mean squares of pixels, patches and
scans, and patches' by expectation maximisation into placement and specimen. A decision weighs each as it should:

* a pixel on its own carries all of them;
* a patch is named from the mean of its pixels, in which e has averaged out;
* the patches of a scan are named together. g_s, and what the error budget leaves of leakage, angle and reference, is
  the same for all of them, so that its estimate and the names are found in turns (expectation maximisation).

The result is a probability of each material and of none of them (`none_of_these.py`).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import scipy

from polysight.host.materials.common_error import CommonError, Patches, costs, explanations, probabilities
from polysight.host.materials.none_of_these import cost_of_none
from polysight.host.materials.samples import Model, NamedScan, Real, Samples, SceneErrors, by_angle
from polysight.host.materials.specimens import apparent_permittivity, effect, fit_spread, relative, without

REJECTED = 0.02
"""Share of the known materials' pixels, and of their patches, that may be called unknown."""
NONE = 0.02
"""Probability, before anything is measured, that a patch is none of the library's materials."""
METAL_LIKE = 0.25
"""|1/P - 1| of a patch below this: the reference or another metal. It has no error of its own, so it tells of none."""
_ROUNDS = 30
_BEYOND = 1.001  # the least distance of what is unknown
_LN_2PI = float(np.log(2 * np.pi))


class ErrorDiscriminant(Model):
    """The discriminant of the module's text.

    Parameters
    ----------
    channels
        One of `CHANNELS`.
    """

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
        tells = ~self._metal_like(samples.x, patch)
        if not tells.any():
            tells[:] = True

        offset, self.level = _two_way(mean, material, scan, tells)
        self.pixels = float(np.median(count))
        self.placements = np.bincount(material).astype(float)
        self.plates = np.array([np.unique(plate[material == k]).size for k in range(self.names.size)], np.float64)
        residual = mean - self.level[material] - offset[scan]
        scans = np.unique(scan[tells]).size
        dof = max(int(tells.sum()) - np.unique(material[tells]).size - scans + 1, 1)
        pixel, told = d - mean[patch], tells[patch]
        self.within = self._independent(_covariance(pixel[told], max(int(told.sum() - tells.sum()), 1)))
        self._effects = self._effect_of_specimens()
        self._fit_patches(residual[tells] * np.sqrt(tells.sum() / dof), material[tells], plate[tells], dof)
        each = max(tells.sum() / scans, 1.0)
        common = self._independent(_covariance(offset[np.unique(scan[tells])], max(scans - 1, 1)))
        self.scan = _positive(common - self.between / each) + 1e-8 * np.eye(width)
        self._set_thresholds(
            (mean - self.level[material])[tells], material[tells], (d - self.level[of])[told], of[told], float(dof)
        )
        return self

    @property
    def distributions(self) -> ErrorDiscriminant:
        """The materials' distributions: itself. Other models have one beside, for what is unknown."""
        return self

    @property
    def permittivities(self) -> dict[str, complex]:
        """Name to the half space that looks like the material; without metals, and where angles are not known."""
        if not len(self.angles_rad):
            return {}
        kinds = zip(self.names, self._anchor_t, strict=True)
        return {str(n): apparent_permittivity(t, self.angles_rad) for n, t in kinds if bool((abs(t - 1) > 0.1).all())}

    def by_pixel(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Name of each pixel on its own, and its distance over the threshold."""
        q, cost = costs(self._deviations(x) - self.level, self._pixel_covariances())
        best = cost.argmin(axis=1)
        return self.names[best], np.sqrt(q[np.arange(len(x)), best] / self.pixel_level)

    def distance(self, x: Real, names: npt.NDArray) -> Real:
        """Distance of each pixel to the material it was named by whatever classifier, over the threshold."""
        q, _ = costs(self._deviations(x) - self.level, self._pixel_covariances())
        return np.sqrt(q[np.arange(len(x)), np.searchsorted(self.names, names)] / self.pixel_level)

    def by_scan(
        self, x: Real, patches: npt.NDArray, errors: SceneErrors | None = None, others: float | None = None
    ) -> NamedScan:
        """Names in one scan: what all patches' errors have in common is found, and taken off.

        `errors` come to the library's own; they are of one angle, and left out with several.
        With `others`, pixels are named by their patch, up to so large a share.
        """
        _, patch = np.unique(patches, return_inverse=True)
        ids = np.unique(patches)
        d = self._deviations(x) - self.level
        mean = np.stack([d[patch == i].mean(axis=0) for i in range(ids.size)])
        tells = ~self._metal_like(x, patch)
        pixels = float(min([self.pixels, *np.bincount(patch).tolist()]))
        own = self._patch_covariances(pixels)
        mine = np.zeros((ids.size, *self.scan.shape))
        if errors is not None and errors.own.shape[1:] == mine.shape[1:]:
            mine = errors.own
        else:
            errors = None
        placed = self.within / pixels + self.between + mine
        found = explanations(
            Patches(mean, own + mine[:, None], tells),
            self._before(ids.size, errors),
            lambda error: self._none(x, patch, placed, error),
        )
        probability, share, distance2 = np.zeros((ids.size, self.names.size + 1)), 0.0, 0.0
        for weight, error in found:
            q, cost = costs(mean - error.shift[:, None], own + (mine + error.spread)[:, None])
            each = probabilities(cost, self._none(x, patch, placed, error))
            probability += weight * _doubted(each, q - self.patch_level)
            known = weight * np.maximum(probabilities(cost, np.full(ids.size, np.inf))[:, :-1], 1e-12)  # were it one
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
        """Covariance of placements, and of each material's specimens, from patches' residuals."""
        width = residual.shape[1]
        total = self._independent(_covariance(residual, len(residual)))
        shrink = width / (width + dof)
        self.spread, placement = fit_spread(
            residual, material, plate, self._effects, total, gains_alike=self.channels == "H+V+P"
        )
        placement = self._independent(placement) * self._gain_and_phase
        placement = (1 - shrink) * placement + shrink * np.diag(np.diag(placement))
        self.between = _positive(placement - self.within / self.pixels) + 1e-8 * np.eye(width)

    def _effect_of_specimens(self) -> Real:
        """What specimens' deviations do to the features of each material, [materials, features, 2]."""
        every = np.stack([effect(t, self.angles_rad) for t in self._anchor_t])
        apart = every.reshape(*self._anchor_t.shape, 3, 2).transpose(0, 3, 1, 2)
        return self._chosen(apart).swapaxes(1, 2)

    def _before(self, count: int, errors: SceneErrors | None) -> CommonError:
        """The error that so many patches have in common before any is seen: zero, as uncertain as scans differ."""
        width = len(self.scan)
        design, prior = np.tile(np.eye(width), (count, 1, 1)), self.scan
        if errors is not None:
            design = np.concatenate([design, errors.design], axis=2)
            both = np.zeros((design.shape[2],) * 2)
            both[:width, :width], both[width:, width:] = prior, errors.covariance
            prior = both
        return CommonError(design, np.zeros(len(prior)), prior, np.asarray(np.linalg.inv(prior), np.float64))

    def _none(self, x: Real, patch: npt.NDArray[np.intp], covariances: Real, scene: CommonError) -> Real:
        """Minus twice the log likelihood of each patch as any other half space, [patch]; see `none_of_these.py`.

        `covariances` [patch, d, d] of the patches' own errors; the scene's come to them, as for the materials.
        """
        h, _, t = by_angle(x)
        log_h = np.stack([np.log(np.maximum(h[patch == i], 1e-6)).mean(axis=0) for i in range(patch.max() + 1)])
        middle = np.stack([t[patch == i].mean(axis=0) for i in range(patch.max() + 1)])
        covariances = covariances + scene.spread
        if self.channels != "H+V+P" or not len(self.angles_rad):  # no wave to compare with: as at the threshold
            return np.asarray(
                self.patch_level + np.linalg.slogdet(covariances)[1] + covariances.shape[1] * _LN_2PI, np.float64
            )
        log_h, middle = without(log_h, middle, scene.shift.reshape(*middle.shape, 3))
        return cost_of_none(log_h, middle, covariances, self.angles_rad) - 2 * np.log(
            NONE / (1 - NONE) * self.names.size
        )

    def _anchor(self, x: Real, of: npt.NDArray[np.intp]) -> None:
        """Where each material's features are expanded: its pixels' means."""
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
        """From every material's anchor, [n, materials, features]."""
        h, v, t = by_angle(x)
        if self.channels == "V":  # alone, by its own logarithm
            return np.log(np.maximum(v, 1e-6))[:, None] - self._anchor_v
        log_h = np.log(np.maximum(h, 1e-6))[:, None] - self._anchor_h
        return self._chosen(relative(log_h, t[:, None] - self._anchor_t, self._anchor_t))

    def _chosen(self, every: Real) -> Real:
        """The columns of the channels from ln|H|, ln|V|, arg P [..., angles, 3], as [..., features]."""
        h, v, angle = (every[..., i] for i in range(3))
        columns = {"H": (h,), "V": (v,), "P": (v - h, angle), "H+V+P": (h, v, angle)}[self.channels]
        return np.stack(columns, axis=-1).reshape(*every.shape[:-2], -1)

    @staticmethod
    def _metal_like(x: Real, patch: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
        """Patches 0, 1, ... whose median V / H, by real and imaginary part, is nearly 1 under every angle, bool."""
        q = by_angle(x)[2]
        parts = [q[patch == i] for i in range(patch.max() + 1)]
        middle = np.stack([np.median(p.real, axis=0) + 1j * np.median(p.imag, axis=0) for p in parts])
        return np.asarray((np.abs(middle - 1) < METAL_LIKE).all(axis=1), np.bool_)

    def _independent(self, covariance: Real) -> Real:
        """Errors of scans under several angles are independent; what a specimen does under them is not."""
        return np.where(self._same_angle, covariance, 0.0)

    def _patch_covariances(self, pixels: float) -> Real:
        """Of the mean of so many pixels about each material's mean, [materials, d, d].

        The mean is itself known from so many placements and specimens only.
        """
        known = (1 + 1 / self.placements)[:, None, None]
        differ = self._effects * (self.spread * (1 + 1 / self.plates[:, None]))[:, None]
        return self.within / pixels + self.between * known + differ @ self._effects.mT

    def _pixel_covariances(self) -> Real:
        return self._patch_covariances(1.0) + self.scan

    def _set_thresholds(self, patches: Real, material: npt.NDArray, pixels: Real, of: npt.NDArray, dof: float) -> None:
        """Squared distances that known materials pass with probability REJECTED.

        Hotelling's distribution for a mean and a covariance that were estimated, or what the library's own patches
        keep (each left out of its material's mean), whichever is larger. Too few patches for either: no threshold.
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


def _two_way(mean: Real, material: npt.NDArray, scan: npt.NDArray, tells: npt.NDArray) -> tuple[Real, Real]:
    """Least squares of patch means = material + scan: offsets [scans, d], of mean zero, and levels [materials, d]."""
    offset, level = np.zeros((scan.max() + 1, mean.shape[1])), np.zeros((material.max() + 1, mean.shape[1]))
    for _ in range(_ROUNDS):
        for k in np.unique(material):
            at = material == k
            level[k] = (mean[at] - offset[scan[at]] * tells[at, None]).mean(axis=0)
        for s in np.unique(scan[tells]):
            at = (scan == s) & tells
            offset[s] = (mean[at] - level[material[at]]).mean(axis=0)
        offset -= offset[np.unique(scan[tells])].mean(axis=0)
    return offset, level


def _covariance(residual: Real, dof: int) -> Real:
    return residual.T @ residual / max(dof, 1)


def _positive(a: Real) -> Real:
    """The nearest matrix without negative eigenvalues."""
    values, vectors = np.linalg.eigh((a + a.T) / 2)
    return (vectors * np.maximum(values, 0)) @ vectors.T


def _doubted(probability: Real, beyond: Real) -> Real:
    """Probabilities [n, materials + 1] where a patch may be what no model here describes: gain, edges, damage.

    `beyond` [n, materials] is how much farther in chi-square a patch lies from a material than its patches do but for
    2 in 100. There half of its probability goes to none of them, and farther out soon all: what is called unknown for
    its distance has no likelier name.
    """
    known = probability[:, :-1] * scipy.special.expit(-beyond)
    return np.concatenate([known, 1 - known.sum(axis=1, keepdims=True)], axis=1)
