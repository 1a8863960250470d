"""Discriminant of logarithms that knows where its errors come from: pixel, patch and scan.

On ln|H|, ln|V| and arg P errors of gain and of phase are additive. A pixel of material m in patch p of scan s is

    z = mean_m + g_s + u_p + e,

with e the pixel's own error (speckle), u_p that of the whole patch (its placement, uneven illumination) and g_s that of
the scan's metal reference, which all patches of the scan inherit: a linear model with random effects (Searle, Casella
and McCulloch, Variance Components, chapter 5). The three covariances are estimated from the library by the residual
mean squares of pixels, patches and scans. A decision then weighs each error as it should:

* a pixel on its own carries all three;
* a patch is named from the mean of its pixels, in which e has averaged out;
* the patches of a scan are named together. g_s is the same for all of them, so its estimate and the names are found in
  turns (expectation maximisation); with one patch in the scan nothing is gained and nothing lost.

Several incidence angles are several scans: their errors are taken to be independent.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.stats import f as f_distribution

from polysight.host.materials.samples import Model, NamedScan, Real, Samples, by_angle

REJECTED = 0.01
"""Share of the known materials' pixels, and of their patches, that may be called unknown."""
METAL_LIKE = 0.25
"""|1/P - 1| of a patch below this: the reference or another metal. It has no error of its own, so it tells of none."""
_ROUNDS = 30


class ErrorDiscriminant(Model):
    """The discriminant of the module's text.

    Parameters
    ----------
    channels
        One of `CHANNELS`.
    own
        Share of a material's own covariances in those it is judged by; the rest is the mean of all materials. 0 is a
        linear discriminant; above 0 materials may differ in spread, as they do where V nearly vanishes.
    """

    knows_scans = True

    def __init__(self, channels: str = "H+V+P", own: float = 0.0) -> None:
        self.channels, self.own = channels, own

    def fit(self, samples: Samples) -> ErrorDiscriminant:
        """Estimate means and covariances."""
        z = self._features(samples.x)
        self.names = np.unique(samples.names)
        width = z.shape[1]
        per_angle = width // (samples.x.shape[1] // 4)
        self._same_angle = np.arange(width)[:, None] // per_angle == np.arange(width)[None] // per_angle
        of = np.searchsorted(self.names, samples.names)
        anchor = np.stack([self._middle(z[of == k]) for k in range(len(self.names))])
        d = self._wrapped(z - anchor[of])

        ids, patch = np.unique(samples.patches, return_inverse=True)
        count = np.bincount(patch).astype(float)
        first = np.array([np.flatnonzero(patch == i)[0] for i in range(len(ids))])
        material, scan = of[first], np.unique(samples.groups, return_inverse=True)[1][first]
        mean = np.stack([np.bincount(patch, c) for c in d.T], axis=1) / count[:, None]
        tells = ~self._metal_like(samples.x, patch)
        if not tells.any():
            tells[:] = True

        offset, level = _two_way(mean, material, scan, tells)
        self.mean = anchor + level
        self.pixels = float(np.median(count))
        self.placements = np.bincount(material).astype(float)
        residual = mean - level[material] - offset[scan]
        scans = len(np.unique(scan[tells]))
        dof = max(int(tells.sum()) - len(np.unique(material[tells])) - scans + 1, 1)
        pixel = d - mean[patch]
        told = tells[patch]
        within = _covariance(pixel[told], max(int(told.sum() - tells.sum()), 1))
        between = self._independent(_covariance(residual[tells], dof))
        shrink = width / (width + dof)
        between = (1 - shrink) * between + shrink * np.diag(np.diag(between))
        floor = 1e-8 * np.eye(width)
        self.within, self.between = [], []
        for k in range(len(self.names)):
            w, b = within, between
            if self.own and tells[material == k].any() and (material == k).sum() > 2:
                mine = material == k
                w = (1 - self.own) * w + self.own * _covariance(pixel[of == k], (of == k).sum() - mine.sum())
                b = (1 - self.own) * b + self.own * self._independent(_covariance(residual[mine], mine.sum() - 1))
            self.within.append(self._independent(w))
            self.between.append(_positive(b - self.within[k] / self.pixels) + floor)
        each = max(tells.sum() / scans, 1.0)
        common = self._independent(_covariance(offset[np.unique(scan[tells])], max(scans - 1, 1)))
        self.scan = _positive(common - between / each) + floor
        own_dof = float(np.median(self.placements)) - 1
        free = (1 - self.own) * dof + self.own * own_dof  # a covariance is known from so many placements
        self._set_thresholds((mean - level[material])[tells], material[tells], (d - level[of])[told], of[told], free)
        return self

    def by_pixel(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Name of each pixel on its own, and its distance over the threshold."""
        q, cost = self._costs(self._deviations(x), self._pixel_covariances())
        best = cost.argmin(axis=1)
        return self.names[best], np.sqrt(q[np.arange(len(x)), best] / self.pixel_level)

    def distance(self, x: Real, names: npt.NDArray) -> Real:
        """Distance of each pixel to the material it was named by whatever classifier, over the threshold."""
        q, _ = self._costs(self._deviations(x), self._pixel_covariances())
        return np.sqrt(q[np.arange(len(x)), np.searchsorted(self.names, names)] / self.pixel_level)

    def by_scan(self, x: Real, patches: npt.NDArray, errors: Real | None = None) -> NamedScan:
        """Names in one scan: the reference's error is found from all patches, and what is named is freed of it.

        `errors` [patch, d, d] are covariances that come to each patch's own, in ln|H|, ln|V| and arg P.
        """
        ids, patch = np.unique(patches, return_inverse=True)
        d = self._deviations(x)
        mean = np.stack([d[patch == i].mean(axis=0) for i in range(len(ids))])
        pixels = min([self.pixels, *np.bincount(patch).tolist()])
        tells = ~self._metal_like(x, patch)
        own = [self._patch_covariance(k, pixels) for k in range(len(self.names))]
        offset, spread = self._reference_error(mean[tells], own)
        more = np.zeros((len(ids), *spread.shape)) if errors is None or self.channels != "H+V+P" else errors[ids]
        q, cost = self._costs(self._wrapped(mean - offset), [c + spread for c in own], more)
        at = np.arange(len(ids)), cost.argmin(axis=1)
        alone = [self._patch_covariance(k, 1.0) + spread for k in range(len(self.names))]
        pixel_q, pixel_cost = self._costs(self._wrapped(d - offset), alone)
        of = np.arange(len(x)), pixel_cost.argmin(axis=1)
        return NamedScan(
            self.names[of[1]],
            np.sqrt(pixel_q[of] / self.pixel_level),
            ids,
            self.names[at[1]],
            _probabilities(cost, self.patch_level)[at],
            np.sqrt(q[at] / self.patch_level),
        )

    def _reference_error(self, mean: Real, own: list[Real]) -> tuple[Real, Real]:
        """Error of the scan's metal reference and its covariance, from patches' deviations [patches, materials, d].

        Which material a patch is, is as uncertain as the last round left it; a patch that is none of them counts for
        nothing. Without patches it is zero, as uncertain as it is from scan to scan.
        """
        offset, spread = np.zeros(mean.shape[2]), self.scan
        if len(mean) < 2:
            return offset, spread
        information = np.linalg.inv(np.mean(own, axis=0))
        for _ in range(_ROUNDS):
            _, cost = self._costs(self._wrapped(mean - offset), [c + spread for c in own])
            weight = _probabilities(cost, self.patch_level)[:, :-1]
            precision = np.linalg.inv(self.scan) + weight.sum() * information
            told = np.einsum("pk,pkd->d", weight, self._wrapped(mean))
            before, offset = offset, np.linalg.solve(precision, information @ told)
            spread = np.linalg.inv(precision)
            if np.abs(offset - before).max() < 1e-7:
                break
        return offset, spread

    def _features(self, x: Real) -> Real:
        h, v, q = by_angle(x)
        log_h, log_v, angle = np.log(np.maximum(h, 1e-6)), np.log(np.maximum(v, 1e-6)), -np.angle(q)
        columns = {"H": (log_h,), "V": (log_v,), "P": (log_h - log_v, angle), "H+V+P": (log_h, log_v, angle)}
        chosen = columns[self.channels]
        self._cyclic = np.tile([c is angle for c in chosen], h.shape[1])
        return np.stack(chosen, axis=-1).reshape(len(x), -1)

    def _wrapped(self, d: Real) -> Real:
        return np.where(self._cyclic, (d + np.pi) % (2 * np.pi) - np.pi, d)

    def _middle(self, z: Real) -> Real:
        return np.where(self._cyclic, np.angle(np.exp(1j * z).mean(axis=0)), z.mean(axis=0))

    @staticmethod
    def _metal_like(x: Real, patch: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
        """Patches 0, 1, ... whose median V / H, by real and imaginary part, is nearly 1 under every angle, bool."""
        q = by_angle(x)[2]
        parts = [q[patch == i] for i in range(patch.max() + 1)]
        middle = np.stack([np.median(p.real, axis=0) + 1j * np.median(p.imag, axis=0) for p in parts])
        return np.asarray((np.abs(middle - 1) < METAL_LIKE).all(axis=1), np.bool_)

    def _independent(self, covariance: Real) -> Real:
        return np.where(self._same_angle, covariance, 0.0)

    def _deviations(self, x: Real) -> Real:
        """From every material's mean, [n, materials, features]."""
        return self._wrapped(self._features(x)[:, None] - self.mean)

    def _patch_covariance(self, k: int, pixels: float) -> Real:
        """Of a patch's mean about the material's mean, itself known from so many placements only."""
        return self.within[k] / pixels + self.between[k] * (1 + 1 / self.placements[k])

    def _pixel_covariances(self) -> list[Real]:
        return [self._patch_covariance(k, 1.0) + self.scan for k in range(len(self.names))]

    @staticmethod
    def _costs(d: Real, covariances: list[Real], more: Real | None = None) -> tuple[Real, Real]:
        """Squared distances and minus twice the log likelihoods (less a constant), [n, materials].

        `more` [n, d, d] comes to the covariance of each of n.
        """
        own = np.stack(covariances)
        inverse = np.linalg.inv(own if more is None else own + more[:, None])
        q = np.einsum("nkd,kde,nke->nk" if more is None else "nkd,nkde,nke->nk", d, inverse, d)
        log_det = -np.linalg.slogdet(inverse)[1]
        return q, q + (log_det - log_det.mean(axis=-1, keepdims=True))

    def _set_thresholds(self, patches: Real, material: npt.NDArray, pixels: Real, of: npt.NDArray, dof: float) -> None:
        """Squared distances that known materials pass with probability REJECTED.

        Hotelling's distribution for a mean and a covariance that were estimated, or what the library's own patches
        keep (each left out of its material's mean), whichever is larger. Too few patches for either: no threshold.
        """
        width = patches.shape[1]
        free = max(dof - width + 1, 1)
        law = float(width * dof / free * f_distribution.ppf(1 - REJECTED, width, free)) if dof > width else np.inf
        left_out = (self.placements / np.maximum(self.placements - 1, 1))[:, None]

        def farthest(d: Real, of: npt.NDArray, covariances: list[Real]) -> float:
            d = self._wrapped(d) * left_out[of]
            q = np.einsum("nd,nde,ne->n", d, np.linalg.inv(np.stack(covariances))[of], d)
            return float(np.quantile(q, 1 - REJECTED))

        patch = [self._patch_covariance(k, self.pixels) + self.scan for k in range(len(self.names))]
        self.patch_level = max(law, farthest(patches, material, patch))
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


def _probabilities(cost: Real, level: float) -> Real:
    """Of every material and, last, of none of them, which is as likely as a material at the threshold."""
    every = np.concatenate([cost, np.full((len(cost), 1), level)], axis=1)
    w = np.exp(-0.5 * (every - every.min(axis=1, keepdims=True)))
    return w / w.sum(axis=1, keepdims=True)
