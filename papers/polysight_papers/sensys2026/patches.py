"""Pixels of patches as the rig would give them: Fresnel at Table 2's permittivities, with errors.

The reflection of material m seen in scan i, pixel k, divided by the scan's metal reference, is in each channel

    r_m (1 + a) exp(j b) / ((1 + a_ref) exp(j b_ref)).

a (speckle, gain over the plane) and b (synchronisation) are normal, independent in H and V. Half of their variance is
one draw for a whole patch (its placement), half is drawn for each pixel; the reference, a mean over many pixels, has
the first half alone and is shared by all patches of a scan. The standard deviation of b is the paper's residual phase
of synchronisation (POLySIGHT). That of a is not in it: it is set, for each group of materials, so that the paper's KNN
on |H| alone, judged by the paper's split by pixel, reaches the published accuracy of H alone. Nothing else is set.

`spread_table` shows the effect of the spread of specimens on names, and the Bayes limit (a table of Fig. 18).
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials import (
    DISCRIMINANT_MODEL,
    MODELS,
    PAPER_MODEL,
    Entry,
    Library,
    Model,
    Samples,
    calibration_error,
    make_features,
    score,
    split_by_angle,
)
from polysight.polarimetry import fresnel
from polysight_papers.sensys2026.item import Published, Table, percent, published_values, table2

Complex = npt.NDArray[np.complex128]
SCANS = 8
PIXELS = 12
"""Scans (the placements of Fig. 17), and pixels of a patch: a material has 96, the paper's "about 80 to 120"."""


@dataclass(frozen=True)
class Group:
    """Materials of one classification task, and the incidence angle in the paper."""

    name: str
    materials: tuple[Published, ...]
    angle_deg: float


def groups() -> dict[str, Group]:
    """Solids at 60 degrees, liquids at 55, powders at 60: rows 1 to 23, 24 to 32 and 33 to 36 of Table 2.

    The paper counts eight liquids; its table has nine, all of which are used here.
    """
    rows = table2()
    return {
        g.name: g
        for g in (
            Group("solids", rows[:23], 60.0),
            Group("liquids", rows[23:32], 55.0),
            Group("powders", rows[32:], 60.0),
        )
    }


@dataclass(frozen=True)
class Errors:
    """Standard deviations of a pixel's relative amplitude and phase, and the share of their variance common to a patch.

    `spread`: relative standard deviations of real part and loss between specimens; each scan has its own specimens.
    """

    amplitude: float
    phase_rad: float
    shared: float = 0.5
    spread: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Pixels:
    """Metal-referenced pixels of one draw; `h` and `v` complex [scans, materials, pixels]."""

    materials: tuple[Published, ...]
    angle_deg: float
    h: Complex
    v: Complex

    def samples(self) -> Samples:
        """Return the pixels as samples for classifiers; a scan is a group."""
        scan, material, _ = np.indices(self.h.shape)
        names = np.array([m.name for m in self.materials])
        # A row for each pixel: four features, material, scan (the group), number of the patch, specimen.
        return Samples(
            make_features(self.h, self.v, self.h / self.v).reshape(-1, 4),
            names[material.ravel()],
            np.array([f"scan {i + 1}" for i in scan.ravel()]),
            (scan * len(self.materials) + material).ravel(),
            np.array([f"specimen {i + 1}" for i in scan.ravel()]),
            (self.angle_deg,),
        )

    def library(self) -> Library:
        """Return a library with one entry for each patch."""
        entries = [
            Entry(
                name=m.name,
                scan=f"scan {i + 1}",
                h=np.abs(self.h[i, j]).astype(np.float32),
                v=np.abs(self.v[i, j]).astype(np.float32),
                p=(self.h[i, j] / self.v[i, j]).astype(np.complex64),
                incidence_deg=self.angle_deg,
                simulated=True,
                thickness_mm=m.thickness_mm,
                permittivity=(m.permittivity.real, -m.permittivity.imag),
                specimen=f"specimen {i + 1}",
            )
            for i in range(self.h.shape[0])
            for j, m in enumerate(self.materials)
        ]
        return Library(tuple(entries), {}, "simulated pixels of patches")


def specimens(materials: tuple[Published, ...], spread: tuple[float, float], z: npt.NDArray[np.float64]) -> Complex:
    """Return permittivities at z [2, ..., materials] standard deviations.

    The real part is normal, but at least 1; the loss is log-normal with the published value as its mean.
    """
    eps = np.array([m.permittivity for m in materials], np.complex128)
    width = np.sqrt(np.log1p(spread[1] ** 2))
    real = np.maximum(eps.real * (1 + spread[0] * z[0]), 1.0)
    return np.asarray(real + 1j * eps.imag * np.exp(width * z[1] - width**2 / 2), np.complex128)


def draw(
    materials: tuple[Published, ...],
    angle_deg: float,
    errors: Errors,
    seed: int,
    scans: int = SCANS,
    pixels: int = PIXELS,
) -> Pixels:
    """Draw `pixels` pixels of every material in every scan; the same seed gives the same errors up to their size."""
    rng = np.random.default_rng([seed, round(angle_deg * 100)])
    # Factors on the standard deviation: of a pixel's own error, and of the one common to its patch.
    pixel_factor = np.sqrt(1 - errors.shared)
    patch_factor = np.sqrt(errors.shared)

    def channel(r: Complex) -> Complex:
        """Return the ratio to metal in one channel, [scan, material, pixel], for reflection factors `r`.

        Relative amplitude errors and phase errors have a part common to the patch, one of each pixel, and one of the
        reference plate, which a whole scan shares.
        """
        shape = (scans, len(materials), 1)
        parts = []
        for std in (errors.amplitude, errors.phase_rad):
            error = patch_factor * rng.standard_normal(shape) + pixel_factor * rng.standard_normal((*shape[:2], pixels))
            parts.append((std * error, std * patch_factor * rng.standard_normal((scans, 1, 1))))
        (a, a_ref), (b, b_ref) = parts
        return np.broadcast_to(r, shape[:2])[..., None] * (1 + a) / (1 + a_ref) * np.exp(1j * (b - b_ref))

    # The same specimens under every angle: their generator does not depend on it.
    specimen_rng = np.random.default_rng([seed, 1])
    eps = specimens(materials, errors.spread, specimen_rng.standard_normal((2, scans, len(materials))))
    r_s, r_p = fresnel(eps, np.radians(angle_deg))
    # H is the s polarisation and V the p polarisation; metal reflects -1 in both.
    return Pixels(materials, angle_deg, channel(-r_s), channel(-r_p))


def h_accuracy(group: Group, errors: Errors, seeds: tuple[int, ...]) -> float:
    """Return the share of pixels that the paper's KNN names right from |H| alone, split by pixel, mean over draws."""
    drawn = (draw(group.materials, group.angle_deg, errors, seed).samples() for seed in seeds)
    return float(np.mean([score(s, PAPER_MODEL, "H", by_pixel=True).pixels for s in drawn]))


def count_draws(quick: bool) -> int:
    """Return the number of draws on which errors are calibrated; chosen."""
    if quick:
        return 1
    return 3


@cache
def calibrated_errors(group_name: str, draws: int = 3, shared: float = 0.5) -> Errors:
    """Return the errors with which the paper's KNN on |H| alone has the published accuracy; V and P are not used.

    Bisection over the logarithm of the amplitude error, on draws that no result is made from.
    """
    group = groups()[group_name]
    target = published_values()["classification"][group_name]["h_percent"] / 100
    seeds = tuple(range(1000, 1000 + draws))
    start = Errors(0.0, published_values()["phase_std_rad"], shared)

    def excess(log_amplitude: float) -> float:
        return h_accuracy(group, replace(start, amplitude=float(np.exp(log_amplitude))), seeds) - target

    # From nearly no error to one of 30 %, to 1 % of the error: chosen.
    solution = scipy.optimize.root_scalar(excess, bracket=(np.log(1e-4), np.log(0.3)), method="bisect", xtol=0.01)
    return replace(start, amplitude=float(np.exp(solution.root)))


SPREADS = ((0.0, 0.0), (0.01, 0.05), (0.02, 0.1), (0.05, 0.2))
"""Relative standard deviations of real part and loss. In Fig. 17 of the paper two plates of one material differ by 1
and 4 % in the real part, 23 and 14 % in the loss."""
# Specimens of each material in the library. Chosen: it decides how well their spread is known.
LIBRARY_SCANS = 24
TEST_SCANS = 160
"""Enough for a calibration error of 0.01 to 0.03 with exact probabilities (4 to 23 names a scan)."""
# Any seeds, other than those of the calibrated errors and of one another.
_LIBRARY_SEED = 41
_TEST_SEED = 500
# Nodes of the specimens' distribution in each dimension (real part, loss), to 3.5 standard deviations.
_GRID = 21
Real = npt.NDArray[np.float64]


class SpecimenScore(NamedTuple):
    """Judgement of the discriminant on new specimens.

    `right` and `bound`: shares of patches named right, by it and by Bayes' rule. `calibration`: expected calibration
    error. `strangers`: patches of materials that it had not learnt, (named, of how many) of all, and the same of those
    that lie outside every known material's 95 % region.
    """

    right: float
    bound: float
    calibration: float
    strangers: tuple[int, int, int, int]


def draw_at_angles(group: str, angles_deg: tuple[float, ...], errors: Errors, seed: int, scans: int) -> Samples:
    """Return the pixels of a group under one angle, or the same specimens' pixels under several, joined."""
    joined_samples, *further_samples = (
        draw(groups()[group].materials, a, errors, seed, scans).samples() for a in angles_deg
    )
    for next_samples in further_samples:
        joined_samples = joined_samples.join(next_samples)
    return joined_samples


@cache
def add_spread(group: str, angles_deg: tuple[float, ...], spread: tuple[float, float], quick: bool) -> SpecimenScore:
    """Judge the discriminant on new specimens and scans, and Bayes' rule on the same errors."""
    test_scans = TEST_SCANS
    if quick:
        test_scans = 6
    errors = replace(calibrated_errors(group, count_draws(quick)), spread=spread)
    taught = draw_at_angles(group, angles_deg, errors, _LIBRARY_SEED, LIBRARY_SCANS)
    test = draw_at_angles(group, angles_deg, errors, _TEST_SEED, test_scans)
    model = MODELS[DISCRIMINANT_MODEL]("H+V+P").fit(taught)
    named, right, sure = by_patch(model, test)
    calibration = calibration_error(sure[named], right[named])
    share = float((named & right).mean())
    bound = bayes(group, angles_deg, errors, quick)
    return SpecimenScore(share, bound, calibration, count_named_strangers(taught, test, quick))


def by_patch(model: Model, test: Samples) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_], Real]:
    """Name all patches, scan by scan; return for each whether it got a name, whether the nearest material is right, and
    the confidence, [patch]. Distances are in units of the model's limit: a patch beyond 1 from all gets no name.
    """
    rows = []
    for scan in np.unique(test.groups):
        scan_samples = test.take(test.groups == scan)
        classifications = model.by_scan(scan_samples.x, scan_samples.patches)
        truth = scan_samples.names[[np.flatnonzero(scan_samples.patches == p)[0] for p in classifications.patches]]
        rows.append((classifications.distance <= 1, classifications.names == truth, classifications.confidence))
    named, right, sure = (np.concatenate(column) for column in zip(*rows, strict=True))
    return named, right, sure


def bayes(group: str, angles_deg: tuple[float, ...], errors: Errors, quick: bool = False) -> float:
    """Return the share of patches of 12 pixels that Bayes' rule names right, knowing all distributions.

    The specimens' distribution is integrated on a grid; on ln|H|, ln|V| and arg P the errors are normal.
    """
    materials = groups()[group].materials
    if max(errors.spread):
        z = np.linspace(-3.5, 3.5, _GRID)
    else:
        z = np.zeros(1)
    weight = np.exp(-(z**2) / 2)
    nodes = np.stack(np.meshgrid(z, z, indexing="ij")).reshape(2, -1, 1)
    weights = np.outer(weight, weight).ravel() / weight.sum() ** 2
    std = np.tile([errors.amplitude, errors.amplitude, errors.phase_rad * np.sqrt(2)], len(angles_deg))
    # A patch's mean over its pixels. The scan's reference counts as known: its error is left out.
    std = std * np.sqrt(errors.shared + (1 - errors.shared) / PIXELS)
    # [node, material, feature]; `measured` is [trial, feature], `difference` [trial, node, material, feature].
    mean = _compute_features(
        specimens(materials, errors.spread, np.broadcast_to(nodes, (2, z.size**2, len(materials)))), angles_deg
    )
    rng = np.random.default_rng(0)
    right = []
    # Trials of each material; chosen.
    trials = 250
    if quick:
        trials = 40
    for k in range(len(materials)):
        eps = specimens(materials, errors.spread, rng.standard_normal((2, trials, len(materials))))[:, k]
        measured = _compute_features(eps, angles_deg) + std * rng.standard_normal((trials, std.size))
        difference = measured[:, None, None] - mean[None]
        # Every third feature is a phase.
        difference[..., 2::3] = (difference[..., 2::3] + np.pi) % (2 * np.pi) - np.pi
        q = np.sum((difference / std) ** 2, axis=-1)
        likelihood = np.einsum("tnm,n->tm", np.exp(-(q - q.min(axis=(1, 2), keepdims=True)) / 2), weights)
        right.append((likelihood.argmax(axis=1) == k).mean())
    return float(np.mean(right))


def _compute_features(eps: npt.NDArray[np.complex128], angles_deg: tuple[float, ...]) -> Real:
    """Return ln|r_s|, ln|r_p| and arg(r_s / r_p) under each angle, [..., 3 * angles]."""
    columns = []
    for angle in angles_deg:
        r_s, r_p = fresnel(eps, np.radians(angle))
        columns += [np.log(np.abs(r_s)), np.log(np.abs(r_p)), np.angle(r_s / r_p)]
    return np.stack(columns, axis=-1)


def count_named_strangers(taught: Samples, test: Samples, quick: bool) -> tuple[int, int, int, int]:
    """Count patches of unlearnt materials: named of all, named of those outside every 95 % region.

    Returns the two pairs (named, of how many).
    """
    named = []
    outside = []
    # Chosen: each scan has a patch of every material.
    most_scans = 6
    if quick:
        most_scans = 2
    scans = np.unique(test.groups)[:most_scans]
    for name in np.unique(test.names):
        taught_others = taught.take(taught.names != name)
        model = MODELS[DISCRIMINANT_MODEL]("H+V+P").fit(taught_others)
        for scan in scans:
            scan_samples = test.take(test.groups == scan)
            classifications = model.by_scan(scan_samples.x, scan_samples.patches)
            strange = np.unique(scan_samples.patches[scan_samples.names == name])
            named += (classifications.distance[np.searchsorted(classifications.patches, strange)] <= 1).tolist()
            outside += _find_outside(scan_samples.take(np.isin(scan_samples.patches, strange)), taught_others).tolist()
    far = np.array(outside)
    return int(np.sum(named)), len(named), int(np.array(named)[far].sum()), int(far.sum())


def _find_outside(test_samples: Samples, training_samples: Samples) -> npt.NDArray[np.bool_]:
    """Return true for patches outside the regions of 95 % of each known material's patches, [patch].

    Of ln|H|, ln|V| and arg 1/P of patches, normal with mean and covariance from so many patches (Hotelling's law).
    """
    features, _ = _patch_features(test_samples)
    means, names = _patch_features(training_samples)
    out = np.ones(len(features), np.bool_)
    for name in np.unique(names):
        means_of_material = means[names == name]
        n, d = means_of_material.shape
        difference = features - means_of_material.mean(axis=0)
        q = np.einsum("pd,de,pe->p", difference, np.linalg.inv(np.cov(means_of_material.T)), difference)
        out &= q > (n + 1) * (n - 1) * d / (n * (n - d)) * scipy.stats.f.ppf(0.95, d, n - d)
    return out


def _patch_features(samples: Samples) -> tuple[Real, npt.NDArray]:
    """Return mean ln|H|, ln|V| and arg 1/P under each angle, [patch, 3 * angles], and the patches' names.

    1/P, because samples hold it instead of P (`make_features`).
    """
    h, v, inverse = split_by_angle(samples.x)
    x = np.concatenate([np.log(h), np.log(v), np.angle(inverse)], axis=1)
    order = np.unique(samples.patches)
    means = np.array([x[samples.patches == p].mean(axis=0) for p in order])
    return means, np.array([samples.names[samples.patches == p][0] for p in order])


def spread_table(quick: bool) -> Table:
    """Return the table of accuracy and bound for spreads and tasks."""
    tasks = (("solids", (60.0,)), ("solids", (60.0, 55.0)), ("liquids", (55.0,)), ("powders", (60.0,)))
    spreads = SPREADS
    if quick:
        tasks = tasks[3:]
        spreads = SPREADS[::3]
    rows = []
    for group, angles in tasks:
        for spread in spreads:
            f = add_spread(group, angles, spread, quick)
            row_title = f"{len(groups()[group].materials)} {group}{', two angles' if len(angles) > 1 else ''}"
            label = f"{100 * spread[0]:g} / {100 * spread[1]:g} %"
            rows.append(
                (
                    row_title,
                    label,
                    percent(f.right),
                    percent(f.bound),
                    f"{f.calibration:.3f}",
                    "{} of {}".format(*f.strangers[:2]),
                    "{} of {}".format(*f.strangers[2:]),
                )
            )
    head = (
        "Task",
        "spread of real part / loss",
        "patches right",
        "Bayes bound",
        "calibration error",
        "strangers named",
        "those outside every 95 % region",
    )
    caption = (
        f"Patches of specimens that were never learnt, {LIBRARY_SCANS} other specimens of each material in the library,"
        f" the noise of Fig. 18; {DISCRIMINANT_MODEL}. The bound knows every material's distribution, the errors' sizes"
        " and the scan's reference. Strangers are each material in turn, left out of the library."
    )
    return Table(caption, head, tuple(rows))
