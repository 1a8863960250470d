"""Effect of the spread of specimens on names, beside the Bayes limit (a table of Fig. 18)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials import DISCRIMINANT, MODELS, Model, Samples, SceneErrors, by_angle, calibration_error
from polysight.polarimetry import fresnel
from polysight_papers.sensys2026.item import Table, percent
from polysight_papers.sensys2026.patches import Errors, calibrated_errors, draw, groups, specimens

SPREADS = ((0.0, 0.0), (0.01, 0.05), (0.02, 0.1), (0.05, 0.2))
"""Relative standard deviations of real part and loss; Fig. 17 of the paper has 1 and 4 % / 23 and 14 %."""
LIBRARY_SCANS = 24
TEST_SCANS = 160
"""Enough for a calibration error of 0.01 to 0.03 with exact probabilities (4 to 23 names a scan)."""
_TEST_SEED = 500
_GRID = 21  # nodes a dimension of the specimens' distribution, to 3.5 standard deviations
Real = npt.NDArray[np.float64]


class Found(NamedTuple):
    """Shares of patches named right, and by Bayes' rule; expected calibration error; unknown materials with a name.

    `strangers` is (named, of how many), of all and of those that lie outside every known material's 95 % region.
    """

    right: float
    bound: float
    calibration: float
    strangers: tuple[int, int, int, int]


def both_angles(group: str, angles_deg: tuple[float, ...], errors: Errors, seed: int, scans: int) -> Samples:
    """Pixels of a group under one angle, or under two of the same specimens."""
    one, *more = (draw(groups()[group].materials, a, errors, seed, scans).samples() for a in angles_deg)
    for other in more:
        one = one.joined(other)
    return one


@cache
def with_spread(group: str, angles_deg: tuple[float, ...], spread: tuple[float, float], quick: bool) -> Found:
    """Judge the discriminant on new specimens and scans, and Bayes' rule on the same errors."""
    errors = replace(calibrated_errors(group, 1 if quick else 3), spread=spread)
    taught = both_angles(group, angles_deg, errors, 41, LIBRARY_SCANS)
    test = both_angles(group, angles_deg, errors, _TEST_SEED, 6 if quick else TEST_SCANS)
    model = MODELS[DISCRIMINANT]("H+V+P").fit(taught)
    named, right, sure = by_patch(model, test)
    calibration = calibration_error(sure[named], right[named])
    share = float((named & right).mean())
    return Found(share, bayes(group, angles_deg, errors, quick), calibration, strangers_named(taught, test, quick))


def by_patch(
    model: Model, test: Samples, budget: Callable[[Samples], SceneErrors | None] = lambda _: None
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_], Real]:
    """Name all patches, scan by scan; return for each: named, right (by the nearest material), confidence, [patch].

    `budget` returns the error budget of a scan.
    """
    rows = []
    for scan in np.unique(test.groups):
        mine = test.take(test.groups == scan)
        found = model.by_scan(mine.x, mine.patches, budget(mine))
        truth = mine.names[[np.flatnonzero(mine.patches == p)[0] for p in found.patches]]
        rows.append((found.distance <= 1, found.names == truth, found.confidence))
    named, right, sure = (np.concatenate(column) for column in zip(*rows, strict=True))
    return named, right, sure


def bayes(group: str, angles_deg: tuple[float, ...], errors: Errors, quick: bool = False) -> float:
    """Return the share of patches of 12 pixels that Bayes' rule names right, knowing all distributions.

    The specimens' distribution is integrated on a grid; on ln|H|, ln|V| and arg P the errors are normal.
    """
    materials = groups()[group].materials
    z = np.linspace(-3.5, 3.5, _GRID) if max(errors.spread) else np.zeros(1)
    weight = np.exp(-(z**2) / 2)
    nodes = np.stack(np.meshgrid(z, z, indexing="ij")).reshape(2, -1, 1)
    weights = np.outer(weight, weight).ravel() / weight.sum() ** 2
    std = np.tile([errors.amplitude, errors.amplitude, errors.phase_rad * np.sqrt(2)], len(angles_deg))
    std = std * np.sqrt(errors.shared + (1 - errors.shared) / 12)
    mean = _features(
        specimens(materials, errors.spread, np.broadcast_to(nodes, (2, z.size**2, len(materials)))), angles_deg
    )
    rng, right = np.random.default_rng(0), []
    trials = 40 if quick else 250
    for k in range(len(materials)):
        eps = specimens(materials, errors.spread, rng.standard_normal((2, trials, len(materials))))[:, k]
        seen = _features(eps, angles_deg) + std * rng.standard_normal((trials, std.size))
        off = seen[:, None, None] - mean[None]
        off[..., 2::3] = (off[..., 2::3] + np.pi) % (2 * np.pi) - np.pi
        q = np.sum((off / std) ** 2, axis=-1)
        likelihood = np.einsum("tnm,n->tm", np.exp(-(q - q.min(axis=(1, 2), keepdims=True)) / 2), weights)
        right.append((likelihood.argmax(axis=1) == k).mean())
    return float(np.mean(right))


def _features(eps: npt.NDArray[np.complex128], angles_deg: tuple[float, ...]) -> Real:
    columns = []
    for angle in angles_deg:
        r_s, r_p = fresnel(eps, np.radians(angle))
        columns += [np.log(np.abs(r_s)), np.log(np.abs(r_p)), np.angle(r_s / r_p)]
    return np.stack(columns, axis=-1)


def strangers_named(taught: Samples, test: Samples, quick: bool) -> tuple[int, int, int, int]:
    """Count patches of unlearnt materials: named of all, named of those outside every 95 % region.

    Returns the two pairs (named, of how many).
    """
    named, outside = [], []
    scans = np.unique(test.groups)[: 2 if quick else 6]
    for name in np.unique(test.names):
        others = taught.take(taught.names != name)
        model = MODELS[DISCRIMINANT]("H+V+P").fit(others)
        for scan in scans:
            mine = test.take(test.groups == scan)
            found = model.by_scan(mine.x, mine.patches)
            strange = np.unique(mine.patches[mine.names == name])
            named += (found.distance[np.searchsorted(found.patches, strange)] <= 1).tolist()
            outside += _outside(mine.take(np.isin(mine.patches, strange)), others).tolist()
    far = np.array(outside)
    return int(np.sum(named)), len(named), int(np.array(named)[far].sum()), int(far.sum())


def _outside(seen: Samples, known: Samples) -> npt.NDArray[np.bool_]:
    """Return true for patches outside the regions of 95 % of each known material's patches, [patch].

    Of ln|H|, ln|V| and arg P of patches, normal with mean and covariance from so many patches (Hotelling's law).
    """
    at, _ = _patch_features(seen)
    means, names = _patch_features(known)
    out = np.ones(len(at), np.bool_)
    for name in np.unique(names):
        own = means[names == name]
        n, d = own.shape
        off = at - own.mean(axis=0)
        q = np.einsum("pd,de,pe->p", off, np.linalg.inv(np.cov(own.T)), off)
        out &= q > (n + 1) * (n - 1) * d / (n * (n - d)) * scipy.stats.f.ppf(0.95, d, n - d)
    return out


def _patch_features(samples: Samples) -> tuple[Real, npt.NDArray]:
    """Return mean ln|H|, ln|V| and arg P under each angle, [patch, 3 * angles], and the patches' names."""
    h, v, inverse = by_angle(samples.x)
    x = np.concatenate([np.log(h), np.log(v), np.angle(inverse)], axis=1)
    order = np.unique(samples.patches)
    means = np.array([x[samples.patches == p].mean(axis=0) for p in order])
    return means, np.array([samples.names[samples.patches == p][0] for p in order])


def spread_table(quick: bool) -> Table:
    """Return the table of accuracy and bound for spreads and tasks."""
    tasks = (("solids", (60.0,)), ("solids", (60.0, 55.0)), ("liquids", (55.0,)), ("powders", (60.0,)))
    rows = []
    for group, angles in tasks[3:] if quick else tasks:
        for spread in SPREADS[:: 3 if quick else 1]:
            f = with_spread(group, angles, spread, quick)
            seen = f"{len(groups()[group].materials)} {group}{', two angles' if len(angles) > 1 else ''}"
            label = f"{100 * spread[0]:g} / {100 * spread[1]:g} %"
            rows.append((
                seen, label, percent(f.right), percent(f.bound), f"{f.calibration:.3f}",
                "{} of {}".format(*f.strangers[:2]), "{} of {}".format(*f.strangers[2:]),
            ))  # fmt: skip
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
        f" the noise of Fig. 18; {DISCRIMINANT}. The bound knows every material's distribution, the errors' sizes and"
        " the scan's reference. Strangers are each material in turn, left out of the library."
    )
    return Table(caption, head, tuple(rows))
