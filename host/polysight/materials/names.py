"""Names of patches and of their pixels, by what one scan or several say of a patch's ratio.

A name is a material of the library, materials of the literature together ("like PTFE or paraffin wax (literature)"), a
possible layer, or unknown. The probabilities of a patch's names sum to one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.catalogue import load_catalogue
from polysight.materials.kinds import (
    USUAL_LIBRARY_SHARE,
    Kinds,
    Odds,
    RatioEvidence,
    move_to_angle_of_kinds,
    split_complex,
    weigh_kinds,
)
from polysight.materials.measure import format_permittivity

Real = npt.NDArray[np.float64]

UNKNOWN = "unknown"
INCLUSIONS = 0.05
"""Share of a patch's pixels that may be of another material; a pixel's prior is its patch's name otherwise."""
UNKNOWN_BUDGET = 0.03
"""Relative error of V / H beside the spread of its pixels if the error budget of its scan is not known."""
LIKELY = 0.005
"""Materials of less probability are not listed."""
LAYER = "possible layer"
"""Name of a patch that is rather a thin plate than a half space."""
MOST_NAMES = 3
"""Largest number of names in a statement about the literature."""
MOST_OF_IT = 0.8
"""Share of the literature's probability that such a statement holds at least."""


@dataclass(frozen=True)
class PatchName:
    """Name of one patch, with its confidence and reason.

    Attributes
    ----------
    name
        Material, "like ... (literature)", "possible layer", or "unknown".
    confidence
        Probability of that name; for the KNN the share of its pixels.
    votes
        Share of the pixels with each name, largest first.
    distance
        Distance to the material, in units of its threshold: above 1 is unknown.
    pixels
        Usable pixels.
    probabilities
        Of each likely name and of "unknown", largest first; their sum is 1. Empty for models without probabilities.
    why
        Reason of the name in one sentence (:func:`add_explanation`); empty if permittivities are not known.
    nearest
        The library's nearest material, also of an unknown patch; None without usable pixels.
    literature
        Probability of each likely material of the literature, largest first.
    from_literature
        True if the name is of the literature.
    """

    name: str
    confidence: float
    votes: dict[str, float]
    distance: float
    pixels: int
    probabilities: dict[str, float] = field(default_factory=dict)
    why: str = ""
    nearest: str | None = None
    literature: dict[str, float] = field(default_factory=dict)
    from_literature: bool = False

    @property
    def source(self) -> Literal["library", "literature"] | None:
        """Where the name is from; None if it is no material's."""
        if self.name in (UNKNOWN, LAYER):
            return None
        return "literature" if self.from_literature else "library"


@dataclass(frozen=True)
class NamedPatch:
    """Names of a patch's pixels [n], their distances over the threshold [n], and the patch's verdict.

    `confidence` [n]: probability of each pixel's likeliest material, 0 for unusable pixels; None: the model gives none.
    """

    names: npt.NDArray[np.str_]
    distance: Real
    verdict: PatchName
    confidence: Real | None = None


def name_of_literature(kinds: Kinds, odds: Odds) -> tuple[str, npt.NDArray[np.bool_]]:
    """Return what the literature's materials are called together, and which of them the name means, bool [kind].

    Few materials that hold most of the literature's probability are named; otherwise their families, a family of one
    likely material by that material. The name is empty if more than `MOST_NAMES` would be needed.
    """
    foreign = np.where(kinds.ours, 0.0, odds.kinds)
    names = np.array(kinds.names)
    families = np.array([kind.family or kind.name for kind in kinds.kinds])
    for groups in (names, families):
        labels, member = np.unique(groups, return_inverse=True)
        share = np.bincount(member, foreign)
        order = np.argsort(-share, kind="stable")[:MOST_NAMES]
        material_count = 1 + int(np.searchsorted(np.cumsum(share[order]), MOST_OF_IT * foreign.sum()))
        if material_count > MOST_NAMES or not foreign.any():
            continue
        meant = np.isin(member, order[:material_count]) & ~kinds.ours
        group_names = []
        for group in order[:material_count]:
            of_group = np.where(member == group, foreign, 0.0)
            likeliest = int(of_group.argmax())
            one_holds_most = of_group[likeliest] >= MOST_OF_IT * share[group]
            group_names.append(str(names[likeliest]) if one_holds_most else str(labels[group]))
        return f"like {_join_with_or(group_names)} (literature)", meant
    return "", np.zeros(len(names), np.bool_)


def _join_with_or(names: Sequence[str]) -> str:
    *first, last = names
    return f"{', '.join(first)} or {last}" if first else last


def name_patch(
    kinds: Sequence[Kinds], kind_evidence: Sequence[RatioEvidence], inverse_ratios: npt.NDArray[np.complex128]
) -> NamedPatch:
    """Name a patch and its pixels by what one scan, or several under different angles, say of its ratio.

    The patch's name is what has the largest probability: a material of the library, those of the literature together, a
    thin plate, or none of these. A material whose value lies outside of the patch's own 99 % region (errors and
    specimens together) is never the name. A pixel is, but for `INCLUSIONS`, of its patch's material.

    Parameters
    ----------
    kinds
        What patches may be, at each scan's angle.
    kind_evidence
        What the scans say of the patch, in their order.
    inverse_ratios
        complex [n, scan]: V / H of the pixels, NaN where not usable.
    """
    good = np.isfinite(inverse_ratios).all(axis=1)
    if not good.any():
        return nothing_named(good.size)
    kind_evidence = [
        move_to_angle_of_kinds(evidence, kind) for evidence, kind in zip(kind_evidence, kinds, strict=True)
    ]
    odds = weigh_kinds(kinds, kind_evidence)
    at_first = kinds[0]
    names = np.array(at_first.names)
    foreign_name, in_foreign_name = name_of_literature(at_first, odds)
    verdict = replace(_find_verdict(at_first, odds, foreign_name, in_foreign_name), pixels=int(good.sum()))

    # Pixels get the corrections of their patch: leakage, tilt, and the common change over the plane.
    middle = np.median(inverse_ratios[good].real, axis=0) + 1j * np.median(inverse_ratios[good].imag, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        correction = np.array([evidence.inverse_ratio for evidence in kind_evidence]) / middle
    corrected = inverse_ratios * np.where(np.isfinite(correction), correction, 1.0)
    called = np.where(at_first.ours, names, np.where(in_foreign_name, foreign_name, UNKNOWN))
    pixel_names, pixel_distance, confidence = _name_pixels(kinds, kind_evidence, corrected, odds.kinds, called)
    return NamedPatch(pixel_names, pixel_distance, replace(verdict, votes=share_of_pixels(pixel_names)), confidence)


def _find_verdict(kinds: Kinds, odds: Odds, foreign_name: str, in_foreign_name: npt.NDArray[np.bool_]) -> PatchName:
    """Return the patch's name and its probabilities, without votes of pixels.

    `foreign_name` is what the literature's materials are called together, `in_foreign_name` bool [kind] those meant.
    """
    probability = {}
    distances = {}
    literature = {}
    for k, name in enumerate(kinds.names):
        distances[name] = float(odds.distance[k])
        if kinds.ours[k]:
            probability[name] = float(odds.kinds[k])
        else:
            literature[name] = float(odds.kinds[k])
    nearest = min(probability, key=lambda name: distances[name], default=None)
    if foreign_name:
        probability[foreign_name] = float(odds.kinds[in_foreign_name].sum())
        distances[foreign_name] = float(odds.distance[in_foreign_name].min())
    if kinds.sheet_share:
        probability[LAYER] = odds.sheet
    likely = _sort_likeliest_first(probability)
    # Names of little probability count as unknown, so that the sum stays one.
    likely[UNKNOWN] = round(1.0 - sum(likely.values()), 4)
    likely = _sort_likeliest_first(likely, least=0.0)

    name = next(iter(likely))
    distance = distances.get(name, np.inf)
    if name in (UNKNOWN, LAYER) and nearest is not None:
        distance = distances[nearest]
    return PatchName(
        name=name,
        confidence=likely[name],
        votes={},
        distance=distance,
        pixels=0,
        probabilities=likely,
        nearest=nearest,
        literature=_sort_likeliest_first(literature),
        from_literature=name == foreign_name,
    )


def _sort_likeliest_first(probability: Mapping[str, float], least: float = LIKELY) -> dict[str, float]:
    """Return the probabilities of at least `least`, rounded, largest first."""
    ordered = sorted(probability.items(), key=lambda item: -item[1])
    return {name: round(p, 4) for name, p in ordered if p >= least}


def share_of_pixels(pixel_names: npt.NDArray[np.str_]) -> dict[str, float]:
    """Return the share of the pixels with each name, largest first."""
    names, count = np.unique(pixel_names, return_counts=True)
    by_share = sorted(zip(names.tolist(), count.tolist(), strict=True), key=lambda row: (-row[1], row[0]))
    return {name: number / pixel_names.size for name, number in by_share}


def evidence_of_pixels(inverse_ratios: npt.NDArray[np.complex128], kinds: Kinds) -> RatioEvidence:
    """Return what pixels alone say of a patch whose scan's error budget is not known.

    Their spread is not divided by the root of their number: errors inside a patch are as wide as the patch.
    `inverse_ratios` complex [n] is V / H of the pixels, NaN where not usable.
    """
    good = inverse_ratios[np.isfinite(inverse_ratios)]
    if not good.size:
        return RatioEvidence(kinds.theta_rad, 0j, np.eye(2), USUAL_LIBRARY_SHARE)
    middle = complex(np.median(good.real), np.median(good.imag))
    std = float(np.hypot(np.std(good), UNKNOWN_BUDGET * abs(middle)))
    return RatioEvidence(kinds.theta_rad, middle, std**2 / 2 * np.eye(2), USUAL_LIBRARY_SHARE)


def nothing_named(pixels: int) -> NamedPatch:
    """Return a patch without any usable pixel."""
    verdict = PatchName(UNKNOWN, 0.0, {}, np.inf, 0)
    return NamedPatch(np.full(pixels, UNKNOWN), np.full(pixels, np.inf), verdict)


def _name_pixels(
    kinds: Sequence[Kinds],
    kind_evidence: Sequence[RatioEvidence],
    inverse_ratios: npt.NDArray[np.complex128],
    patch_odds: Real,
    called: npt.NDArray[np.str_],
) -> tuple[npt.NDArray, Real, Real]:
    """Return name, distance over the threshold, and probability of the name of each pixel, [n] each.

    `inverse_ratios` complex [n, scan] are V / H of the pixels with the corrections of their patch, `patch_odds` [kind]
    the probabilities of the patch's kinds, and `called` [kind] the name that each kind gets.
    """
    good = np.isfinite(inverse_ratios).all(axis=1)
    first = kinds[0]
    has_name = called != UNKNOWN
    parts = 2 * len(kind_evidence)
    values = split_complex(inverse_ratios[good]).reshape(-1, parts)
    pixel_covariance = np.cov(values.T) if len(values) > 2 else np.zeros((parts, parts))
    effects = np.concatenate([kind.effects[has_name] for kind in kinds], axis=1)
    errors = (
        scipy.linalg.block_diag(*(evidence.covariance for evidence in kind_evidence))
        + pixel_covariance
        + 1e-10 * np.eye(parts)
    )
    inverse = np.linalg.inv(effects @ effects.mT + errors)
    middles = np.stack([kind.t[has_name] for kind in kinds], axis=1)
    usable: npt.NDArray[np.complex128] = np.where(good.reshape(-1, 1), inverse_ratios, 0)
    difference = split_complex(usable[:, None, :] - middles).reshape(inverse_ratios.shape[0], -1, parts)
    distance2 = np.einsum("nki,kij,nkj->nk", difference, inverse, difference)
    ours = np.take(first.ours, np.flatnonzero(has_name))
    prior = (1 - INCLUSIONS) * patch_odds[has_name] + INCLUSIONS * ours / max(ours.sum(), 1)
    likelihood = prior * np.sqrt(np.linalg.det(inverse)) * np.exp(-0.5 * np.minimum(distance2, 1400))
    labels, member = np.unique(called[has_name], return_inverse=True)
    label_odds = likelihood @ np.equal.outer(member, np.arange(labels.size))
    label = label_odds.argmax(axis=1)
    row = np.arange(inverse_ratios.shape[0])
    least_distance2 = np.where(np.equal.outer(label, member), distance2, np.inf).min(axis=1)
    distance = np.where(good, np.sqrt(least_distance2 / scipy.special.chdtri(parts, 0.01)), np.inf)
    share = label_odds[row, label] / np.maximum(label_odds.sum(axis=1), 1e-300)
    names = np.where(distance <= 1, labels[label], UNKNOWN)
    return names, distance, np.where(good, share * min(1.0, float(patch_odds[has_name].sum()) + INCLUSIONS), 0.0)


def add_explanation(
    named: NamedPatch,
    permittivity: complex | None,
    covariance: npt.NDArray[np.float64] | None,
    known: Mapping[str, complex],
) -> NamedPatch:
    """Return the patch with the reason of its name, one sentence for a reader who knows materials.

    `permittivity` is eps' - j eps'' of the patch, `covariance` [2, 2] that of its real and imaginary part; None if it
    has none. `known` are the library's permittivities.
    """
    name = named.verdict
    estimate = _format_estimate(permittivity, covariance)
    nearest = name.nearest
    if name.name in known:
        nearest = name.name
    nearest_text = ""
    near = ""
    if nearest is not None:
        nearest_text = _add_permittivity(nearest, known.get(nearest))
        near = f"; nearest: {nearest_text}"
    if name.name == UNKNOWN:
        explanation = f"not in the library: {estimate}{near}" if estimate else f"not in the library{near}"
    elif name.name == LAYER:
        if estimate:
            explanation = f"{estimate} as a half space, but rather a thin plate{near}"
        else:
            explanation = f"rather a thin plate{near}"
    elif name.from_literature:
        values = _list_values(name.literature)
        explanation = f"{estimate} is like {values} of the literature; not measured by this library{near}"
    else:
        explanation = f"{estimate} matches the library's {nearest_text}{_list_rivals(name)}"
        if not estimate:
            explanation = f"it looks like the library's {nearest_text}{_list_rivals(name)}"
    return replace(named, verdict=replace(name, why=explanation))


def _list_rivals(name: PatchName) -> str:
    """Say which other names are likely; nothing of the KNN, which has no probabilities."""
    other_names = [f"{n} {100 * p:.0f} %" for n, p in name.probabilities.items() if n not in (name.name, UNKNOWN)]
    if other_names:
        return f"; it could also be {' or '.join(other_names[:2])}"
    if name.probabilities:
        return "; no other material is likely"
    return ""


def _format_estimate(permittivity: complex | None, covariance: npt.NDArray[np.float64] | None) -> str:
    if permittivity is None:
        return ""
    text = f"permittivity {format_permittivity(permittivity)}"
    if covariance is None or not np.isfinite(covariance).all():
        return text
    real, loss = np.sqrt(np.diag(covariance))
    return f"{text} (+- {real:.2f}, {loss:.2f})"


def _list_values(literature: Mapping[str, float]) -> str:
    """The likeliest materials of the literature with their permittivities."""
    values = {material.name: material.permittivity for material in load_catalogue()}
    return ", ".join(_add_permittivity(name, values.get(name)) for name in list(literature)[:MOST_NAMES])


def _add_permittivity(name: str, permittivity: complex | None) -> str:
    if permittivity is None:
        return name
    return f"{name} ({format_permittivity(permittivity)})"
