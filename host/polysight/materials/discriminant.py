"""The discriminant of error sources: materials as distributions over pixels, patches, specimens and scans.

It learns from a library how far specimens, placements and scans of a material lie apart, and judges the library by
naming scans that were left out. Scans of the rig are named by the joint inversion (`names.py`), which takes the
materials and their spread from here.

On ln|H|, ln|V| and arg P errors of gain and of phase are additive. A pixel of material m in patch p of scan s is

    z = mean_m + F_m d + g_s + u_p + e,

with e the pixel's own error (speckle), u_p the error of the whole patch (placement, uneven illumination), g_s that of
the scan's metal reference, common to all its patches, and d the deviation of the specimen from its material in ln eps'
and ln eps'', which F_m converts to features (`specimens.py`): a linear model with random effects (Searle, Casella and
McCulloch, Variance Components, chapter 5). If V nearly vanishes its error is additive: ln|V| counts relative to a scale
that stays above zero (`soft_modulus` of `specimens.py`). Logarithms of less than 1e-6 of metal are cut. The covariances
are estimated from the library: by residual mean squares of pixels, patches and scans; that of patches is divided into
placement and specimen by expectation maximisation. A decision uses them as follows:

* a single pixel has all errors;
* a patch is named from the mean of its pixels, in which e averages out;
* g_s and the names of a scan's patches are estimated in turns (expectation maximisation).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.library import Model, NamedScan, Real, Samples, compute_patch_medians, split_by_angle
from polysight.materials.specimens import (
    METAL_SPECIMENS,
    METAL_WITHOUT_ERROR,
    apparent_permittivity,
    effect,
    fit_spread,
    relative,
)

REJECTED_SHARE = 0.02
"""Share of the known materials' pixels, and of their patches, that are called unknown. Chosen: a smaller share accepts
more foreign materials."""
# Largest numbers of iterations of the common error and of the two-way fit; chosen.
COMMON_ERROR_ROUNDS = 30
TWO_WAY_ROUNDS = 30
# Least distance of unknown patches: just above 1, the threshold.
UNKNOWN_DISTANCE = 1.001
LN_2PI = float(np.log(2 * np.pi))


def costs(deviations: Real, covariances: Real) -> tuple[Real, Real]:
    """Return squared distances and minus twice the log likelihoods, [n, materials] each.

    `deviations` from each material are [n, materials, d], their `covariances` [materials, d, d] or
    [n, materials, d, d].
    """
    inverse = np.linalg.inv(covariances)
    distance2 = np.sum(deviations * (inverse @ deviations[..., None])[..., 0], axis=-1)
    return distance2, distance2 - np.linalg.slogdet(inverse)[1] + deviations.shape[2] * LN_2PI


def shares_of_materials(cost: Real) -> Real:
    """Return the probability of each material, [n, materials], if it is one of them; `cost` as of :func:`costs`."""
    weight = np.exp(-0.5 * (cost - cost.min(axis=1, keepdims=True)))
    return weight / weight.sum(axis=1, keepdims=True)


def estimate_common_error(mean: Real, own_errors: Real, prior: Real, level: float) -> tuple[Real, Real]:
    """Estimate the error that all patches of a scan share; return its mean [d] and covariance [d, d].

    `mean` [patch, materials, d] are the deviations of patches from the materials, `own_errors` [materials, d, d] the
    covariances of these, `prior` [d, d] that of the error. Patches whose squared distance to every material is above
    `level` have little weight. Expectation maximisation: a patch of uncertain material counts with the moments of the
    mixture. From a single patch the error cannot be estimated: its prior is returned.
    """
    value = np.zeros(len(prior))
    covariance = prior
    if len(mean) < 2:
        return value, covariance
    for _ in range(COMMON_ERROR_ROUNDS):
        distance2, cost = costs(mean - value, own_errors + covariance)
        share = shares_of_materials(cost)
        weight = scipy.special.expit(level - distance2.min(axis=1))
        # Mean and covariance of each patch over the materials: p patches, k materials, d and e features.
        middle = np.einsum("pk,pkd->pd", share, mean)
        difference = mean - middle[:, None]
        spread = np.einsum("pk,pkde->pde", share, own_errors + difference[..., :, None] * difference[..., None, :])
        information = weight[:, None, None] * np.linalg.inv(spread)
        covariance = np.linalg.inv(np.linalg.inv(prior) + information.sum(axis=0))
        last_value = value
        value = covariance @ (information @ middle[..., None]).sum(axis=0)[:, 0]
        if np.abs(value - last_value).max() < 1e-7:
            break
    return value, covariance


class ErrorDiscriminant(Model):
    """The discriminant of error sources, see the module's docstring; `channels` is one of `CHANNELS`.

    `fit` sets the following; d is the number of features, and the formula's F_m, g, u and e are the module's.

    Attributes
    ----------
    names
        Materials, sorted, str [materials].
    angles_rad
        Incidence angles; empty if not known.
    level
        float64 [materials, d]: mean of each material, as a deviation from its anchor (`_set_anchors`).
    within, between, scan
        float64 [d, d]: covariances of e, of u by placement, and of g.
    spread
        float64 [materials, 2]: variances of ln eps' and of ln eps'' between specimens.
    pixels
        Usual number of pixels of a patch.
    placements, plates
        float64 [materials]: number of patches and of specimens of each material in the library.
    patch_level, pixel_level
        Squared distances beyond which a patch and a pixel are unknown.
    """

    knows_scans = True

    def __init__(self, channels: str = "H+V+P") -> None:
        self.channels = channels

    def fit(self, samples: Samples) -> ErrorDiscriminant:
        """Estimate means and covariances; of `samples`, `groups` are the scans and `plates` the specimens."""
        # Deviations of the pixels from their material's anchor, and their means over patches.
        self.names, material_index = np.unique(samples.names, return_inverse=True)
        self.angles_rad = [math.radians(a) for a in samples.angles_deg]
        self._set_anchors(samples.x, material_index)
        d = self._compute_deviations(samples.x)[np.arange(material_index.size), material_index]
        width = d.shape[1]
        _, patch, count = np.unique(samples.patches, return_inverse=True, return_counts=True)
        # First pixel of each patch: the pixels are written backwards, so that the first one stays.
        first = np.zeros(count.size, np.intp)
        first[patch[::-1]] = np.arange(material_index.size)[::-1]
        material = material_index[first]
        scan = np.unique(samples.groups, return_inverse=True)[1][first]
        plate = samples.plates[first]
        mean = np.stack([np.bincount(patch, c) for c in d.T], axis=1) / count[:, None]
        # Metal-like patches have no error of their own, and do not show the errors of scans.
        informative = ~self._find_metal_like(samples.x, patch)
        if not informative.any():
            informative[:] = True

        # Means of materials and offsets of scans; the rest of a patch's mean is its own error.
        offset, self.level = _fit_two_way(mean, material, scan, informative)
        self.pixels = float(np.median(count))
        self.placements = np.bincount(material).astype(float)
        self.plates = np.array([np.unique(plate[material == k]).size for k in range(self.names.size)], np.float64)
        residual = mean - self.level[material] - offset[scan]
        scans = np.unique(scan[informative]).size
        dof = max(int(informative.sum()) - np.unique(material[informative]).size - scans + 1, 1)
        # Covariances: within patches, between patches, and of the scans' offsets.
        pixel = d - mean[patch]
        is_used = informative[patch]
        self.within = self._decorrelate_angles(
            _compute_covariance(pixel[is_used], max(int(is_used.sum() - informative.sum()), 1))
        )
        self._effects = self._compute_specimen_effects()
        # The only patch of a material is its mean: its residual is zero whatever its error.
        repeated = informative & (np.bincount(material[informative], minlength=self.names.size)[material] > 1)
        if not repeated.any():
            repeated = informative
        # The fit of the means reduced the variance of the residuals: they are scaled up for it.
        self._fit_patches(residual[repeated] * np.sqrt(repeated.sum() / dof), material[repeated], plate[repeated], dof)
        patches_per_scan = max(informative.sum() / scans, 1.0)
        common = self._decorrelate_angles(_compute_covariance(offset[np.unique(scan[informative])], max(scans - 1, 1)))
        # A scan's offset is a mean over its patches, whose own errors are in it. The added variance, far below any real
        # one, keeps the matrix invertible.
        self.scan = _clip_eigenvalues(common - self.between / patches_per_scan) + 1e-8 * np.eye(width)
        self._set_thresholds(
            (mean - self.level[material])[repeated],
            material[repeated],
            (d - self.level[material_index])[repeated[patch]],
            material_index[repeated[patch]],
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
        # METAL_SPECIMENS is the largest |t - 1| of a metal. t is V / H relative to metal, at each angle.
        dielectric = (abs(self._anchor_t - 1) > METAL_SPECIMENS).all(axis=1)
        kinds = zip(self.names[dielectric], self._anchor_t[dielectric], strict=True)
        return {str(name): apparent_permittivity(t, self.angles_rad) for name, t in kinds}

    def distances(self) -> Real:
        """Return the distances of the materials in standard deviations of a patch, [material, material].

        Of the models of all channels only: the features are ln|H|, ln|V| and arg P.
        """
        log_h = self._anchor_h[:, None] - self._anchor_h
        differences = self._select_channels(relative(log_h, self._anchor_t[:, None] - self._anchor_t, self._anchor_t))
        patch_covariance = self._patch_covariances(self.pixels) + self.scan
        inverse = np.linalg.inv((patch_covariance[:, None] + patch_covariance) / 2)
        # Axes are a and b material, d and e feature.
        return np.sqrt(np.einsum("abd,abde,abe->ab", differences, inverse, differences))

    def classify_pixels(self, x: Real) -> tuple[npt.NDArray, Real]:
        """Classify each pixel independently: return name, str [n], and distance over the threshold, float64 [n]."""
        distance2, cost = costs(self._compute_deviations(x) - self.level, self._compute_pixel_covariances())
        best = cost.argmin(axis=1)
        return self.names[best], np.sqrt(distance2[np.arange(len(x)), best] / self.pixel_level)

    def pixel_probabilities(self, x: Real) -> Real:
        """Return the probability of each material for pixels classified independently, [n, materials]."""
        _, cost = costs(self._compute_deviations(x) - self.level, self._compute_pixel_covariances())
        return shares_of_materials(cost)

    def by_scan(self, x: Real, patches: npt.NDArray) -> NamedScan:
        """Name the patches and pixels of one scan, with an estimate of the error common to all patches.

        Pixels are named independently of each other. `patches` [n] is the patch number of each pixel.
        """
        ids, patch = np.unique(patches, return_inverse=True)
        deviations = self._compute_deviations(x) - self.level
        mean = np.stack([deviations[patch == i].mean(axis=0) for i in range(ids.size)])
        # All patches count as having the smallest one's number of pixels, at most the library's usual number.
        pixels = float(min([self.pixels, *np.bincount(patch).tolist()]))
        patch_covariances = self._patch_covariances(pixels)
        informative = ~self._find_metal_like(x, patch)
        shift, spread = estimate_common_error(mean[informative], patch_covariances, self.scan, self.patch_level)

        distance2, cost = costs(mean - shift, patch_covariances + spread)
        probability = _append_none(shares_of_materials(cost), distance2 - self.patch_level)
        row = np.arange(ids.size)
        best = cost.argmin(axis=1)
        distances = np.sqrt(distance2 / self.patch_level)
        is_none = probability[:, -1] > probability[row, best]
        distance = np.where(is_none, np.maximum(distances[row, best], UNKNOWN_DISTANCE), distances[row, best])

        pixel_distance2, pixel_cost = costs(deviations - shift, self._patch_covariances(1.0) + spread)
        material_of_pixel = pixel_cost.argmin(axis=1)
        pixel_distance = np.sqrt(pixel_distance2[np.arange(len(x)), material_of_pixel] / self.pixel_level)
        return NamedScan(
            pixel_names=self.names[material_of_pixel],
            pixel_distance=pixel_distance,
            patches=ids,
            names=self.names[best],
            confidence=probability[row, best],
            distance=distance,
            distances=distances,
            probabilities=probability,
            materials=self.names,
        )

    def _fit_patches(self, residual: Real, material: npt.NDArray, plate: npt.NDArray, dof: int) -> None:
        """Set `spread` and `between` from the residuals of patches [patches, d] with this number of degrees of freedom.

        With few degrees of freedom correlations between features are shrunk. With all channels the gain errors of H and
        V are taken as equally large.
        """
        width = residual.shape[1]
        total = self._decorrelate_angles(_compute_covariance(residual, len(residual)))
        shrink = width / (width + dof)
        self.spread, placement = fit_spread(
            residual, material, plate, self._effects, total, gains_alike=self.channels == "H+V+P"
        )
        placement = self._decorrelate_angles(placement) * self._both_gains_or_phases
        placement = (1 - shrink) * placement + shrink * np.diag(np.diag(placement))
        # The added variance, far below any real one, keeps the matrix invertible.
        self.between = _clip_eigenvalues(placement - self.within / self.pixels) + 1e-8 * np.eye(width)

    def _compute_specimen_effects(self) -> Real:
        """Return the effect F_m of specimens' deviations on the features of each material, [materials, features, 2]."""
        # [materials, 3 * angles, 2], ordered as [materials, 2, angles, 3], as `_select_channels` takes them.
        anchor_effects = np.stack([effect(t, self.angles_rad) for t in self._anchor_t])
        effect_matrices = anchor_effects.reshape(*self._anchor_t.shape, 3, 2).transpose(0, 3, 1, 2)
        return self._select_channels(effect_matrices).swapaxes(1, 2)

    def _set_anchors(self, x: Real, material: npt.NDArray[np.intp]) -> None:
        """Set the anchor of each material, the point that its features are deviations from: the mean of its pixels.

        `material` [n] is the index of each pixel's material. Set also which pairs of features are of one angle, and
        which are both gains or both phases, [features, features]; the others are taken as uncorrelated.
        """
        # |H|, |V| and t = V / H relative to metal, complex; [n, angles] each.
        h, v, t = split_by_angle(x)
        logs = np.log(np.maximum(h, 1e-6)), np.log(np.maximum(v, 1e-6))
        is_of_material = [material == k for k in range(self.names.size)]
        self._anchor_h, self._anchor_v, self._anchor_t = (
            np.stack([c[members].mean(axis=0) for members in is_of_material]) for c in (*logs, t)
        )
        features_per_angle = self._select_channels(np.zeros((1, 3))).size
        angle = np.arange(features_per_angle * h.shape[1]) // features_per_angle
        self._same_angle = angle[:, None] == angle[None]
        phase = np.tile({"P": [0, 1], "H+V+P": [0, 0, 1]}.get(self.channels, [0]), h.shape[1])
        self._both_gains_or_phases = (phase[:, None] == phase[None]).astype(float)

    def _compute_deviations(self, x: Real) -> Real:
        """Return the deviations from every material's anchor, [n, materials, features]."""
        h, v, t = split_by_angle(x)
        # V alone is judged by its own logarithm.
        if self.channels == "V":
            return np.log(np.maximum(v, 1e-6))[:, None] - self._anchor_v
        log_h = np.log(np.maximum(h, 1e-6))[:, None] - self._anchor_h
        # `relative` converts deviations of ln|H| and of t to those of ln|H|, ln|V| and arg P.
        return self._select_channels(relative(log_h, t[:, None] - self._anchor_t, self._anchor_t))

    def _select_channels(self, features: Real) -> Real:
        """Select the model's channels of ln|H|, ln|V|, arg P [..., angles, 3]; return [..., features]."""
        h = features[..., 0]
        v = features[..., 1]
        angle = features[..., 2]
        columns = {"H": (h,), "V": (v,), "P": (v - h, angle), "H+V+P": (h, v, angle)}[self.channels]
        return np.stack(columns, axis=-1).reshape(*features.shape[:-2], -1)

    @staticmethod
    def _find_metal_like(x: Real, patch: npt.NDArray[np.intp]) -> npt.NDArray[np.bool_]:
        """Return true for patches 0, 1, ... whose median V / H is nearly 1 under all angles, bool [patch]."""
        inverse_ratio = split_by_angle(x)[2]
        middle = np.stack(
            [compute_patch_medians(t.real, patch) + 1j * compute_patch_medians(t.imag, patch) for t in inverse_ratio.T],
            axis=1,
        )
        return np.asarray((np.abs(middle - 1) < METAL_WITHOUT_ERROR).all(axis=1), np.bool_)

    def _decorrelate_angles(self, covariance: Real) -> Real:
        """Remove correlations between angles: errors of their scans are independent (effects of specimens are not)."""
        return np.where(self._same_angle, covariance, 0.0)

    def _patch_covariances(self, pixels: float) -> Real:
        """Return the covariance of the mean of `pixels` pixels about each material's mean, [materials, d, d].

        It includes the error of the material's mean, known from a limited number of placements and specimens.
        """
        placement_factor = (1 + 1 / self.placements)[:, None, None]
        scaled_effects = self._effects * (self.spread * (1 + 1 / self.plates[:, None]))[:, None]
        return self.within / pixels + self.between * placement_factor + scaled_effects @ self._effects.mT

    def _compute_pixel_covariances(self) -> Real:
        """Return the covariance of one pixel about each material's mean with all errors, [materials, d, d]."""
        return self._patch_covariances(1.0) + self.scan

    def _set_thresholds(
        self, patches: Real, material: npt.NDArray, pixels: Real, pixel_material: npt.NDArray, dof: float
    ) -> None:
        """Set the squared distances that known materials exceed with probability `REJECTED_SHARE`.

        `patches` and `pixels` are deviations from their material's mean, [patches, d] and [n, d], `material` and
        `pixel_material` its index.

        A threshold is the larger of two: that of Hotelling's distribution, for an estimated mean and covariance, and
        the quantile of the library's own patches (each left out of its material's mean). Without enough patches there
        is no threshold.
        """
        width = patches.shape[1]
        freedom = max(dof - width + 1, 1)
        if dof > width:
            law = float(width * dof / freedom * scipy.special.fdtri(width, freedom, 1 - REJECTED_SHARE))
        else:
            law = np.inf
        left_out = (self.placements / np.maximum(self.placements - 1, 1))[:, None]

        def find_left_out_quantile(deviations: Real, index: npt.NDArray, covariances: Real) -> float:
            """Return the squared distance that a share `REJECTED_SHARE` of the library's own deviations exceeds."""
            d = deviations * left_out[index]
            distance2 = np.einsum("nd,nde,ne->n", d, np.linalg.inv(covariances)[index], d)
            return float(np.quantile(distance2, 1 - REJECTED_SHARE))

        self.patch_level = max(
            law, find_left_out_quantile(patches, material, self._patch_covariances(self.pixels) + self.scan)
        )
        self.pixel_level = max(law, find_left_out_quantile(pixels, pixel_material, self._compute_pixel_covariances()))


def _fit_two_way(mean: Real, material: npt.NDArray, scan: npt.NDArray, informative: npt.NDArray) -> tuple[Real, Real]:
    """Fit patch means [patches, d] = material + scan by least squares, in turns.

    Return the offsets [scans, d] and the levels [materials, d]. Only `informative` patches, bool [patches], have an
    offset; the offsets of scans with such patches have a mean of zero, those of the others are zero.
    """
    offset = np.zeros((scan.max() + 1, mean.shape[1]))
    level = np.zeros((material.max() + 1, mean.shape[1]))
    is_of_material = np.arange(len(level))[:, None] == material
    is_of_scan = (np.arange(len(offset))[:, None] == scan) & informative
    material_mean = is_of_material / np.maximum(is_of_material.sum(axis=1, keepdims=True), 1)
    scan_mean = is_of_scan / np.maximum(is_of_scan.sum(axis=1, keepdims=True), 1)
    informed = is_of_scan.any(axis=1)
    for _ in range(TWO_WAY_ROUNDS):
        level = material_mean @ (mean - offset[scan] * informative[:, None])
        offset = scan_mean @ (mean - level[material])
        offset[informed] -= offset[informed].mean(axis=0)
    return offset, level


def _compute_covariance(residual: Real, dof: int) -> Real:
    """Return the covariance [d, d] of residuals [n, d] with this number of degrees of freedom."""
    return residual.T @ residual / max(dof, 1)


def _clip_eigenvalues(a: Real) -> Real:
    """Return the nearest matrix without negative eigenvalues."""
    values, vectors = np.linalg.eigh((a + a.T) / 2)
    return (vectors * np.maximum(values, 0)) @ vectors.T


def _append_none(probability: Real, unknown_probability: Real) -> Real:
    """Return the probabilities [n, materials + 1] with, last, that of none of the materials.

    `unknown_probability` [n, materials] is the chi-square of a patch minus the threshold that 2 % of a material's
    patches exceed. At the threshold half of the probability goes to none of the materials, far beyond it all, so that a
    patch called unknown for its distance has no likelier name.
    """
    member_probability = probability * scipy.special.expit(-unknown_probability)
    return np.concatenate([member_probability, 1 - member_probability.sum(axis=1, keepdims=True)], axis=1)
