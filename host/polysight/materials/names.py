"""Name patches and their pixels by the ratio t = V / H, relative to metal, that one scan or several measured.

A *kind* is a material that a patch may be of: of the user's library, or of the literature. `Kinds` holds them for one
incidence angle, `Odds` their probabilities for one patch. They are proportional to

    share of the kind x normal density of the measured t about the kind's t

with the covariance of the measurement plus that of specimens of the kind. Thin plates, stacks of layers, and half
spaces that are no kind compete with their own shares and densities.

A name is a material of the library, materials of the literature together ("like PTFE or paraffin wax (literature)"), a
possible layer, or unknown. The probabilities of a patch's names sum to one.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials.catalogue import load_catalogue
from polysight.materials.kinds import (
    SHEET_KERNEL,
    STACK_SHARE,
    USUAL_LIBRARY_SHARE,
    Kinds,
    RatioEvidence,
    compute_brightness_density,
    compute_layer_odds,
    inverse_ratio,
    move_to_angle_of_kinds,
    split_complex,
)
from polysight.polarimetry import permittivity_from_ratio

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]

UNKNOWN = "unknown"
LOOK_ALIKE_ODDS = 1.8
"""Factor by which the odds that a patch is of no kind of the library are raised: materials are more alike than the
smooth densities of `Kinds`. Chosen: in 616 scenes of an independent generator, half of whose plates no library has,
82 % of the names with a probability of 0.8 to 0.95 were right without it, and 87 % with it."""
INCLUSION_SHARE = 0.05
"""Share of a patch's pixels that may be of any material of the library (chosen); the prior of the others is the patch's
probabilities."""
UNKNOWN_BUDGET = 0.03
"""Relative error of V / H, in addition to its pixels' spread, if the scan's error budget is not known; chosen."""
LEAST_PROBABILITY = 0.005
"""Materials of less probability are not listed; chosen."""
LIKELY_UNKNOWN = 0.05
"""With less probability, "a material that the library lacks" is not listed among the other possible names: it always
has a few percent. Chosen."""
LAYER = "possible layer"
"""Name of a patch that is rather a thin plate or a stack of layers than a half space."""
POSSIBLY_THIN = 0.2
"""Probability of layers (thin plate or stack) above which a patch gets no permittivity, which would be wrong with this
probability. Chosen: with a `SHEET_SHARE` of 0.15 none of 383 half spaces of an independent generator had more; of the
published picture's plates only thin wood has."""
MOST_NAMES = 3
"""Largest number of names in "like ... (literature)"; chosen."""
MOST_OF_IT = 0.8
"""Least share of the literature's probability that the names in "like ... (literature)" hold together, and of a
family's probability that one material must hold to be named instead of the family; chosen."""
# Number of half spaces that are drawn to join scans at several angles; chosen.
_HALF_SPACES = 4000


@dataclass(frozen=True)
class PatchName:
    """Name of one patch, with its confidence and reason.

    Attributes
    ----------
    name
        Material, "like ... (literature)", "possible layer", or "unknown".
    confidence
        Probability of that name; for the KNN (the paper's nearest-neighbour classifier) the share of its pixels.
    votes
        Share of the pixels with each name, largest first.
    distance
        Distance to the named material (of several: the least; of an unknown patch or a layer: to the nearest of the
        library), in units of its threshold: above 1 is unknown. inf without usable pixels.
    pixels
        Number of usable pixels.
    probabilities
        Of each likely name and of "unknown", largest first; their sum is 1. Empty for models without probabilities.
    why
        Reason of the name in one sentence; empty until :func:`add_explanation` adds it.
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
        """Origin of the name; None if it is not that of a material."""
        if self.name in (UNKNOWN, LAYER):
            return None
        return "literature" if self.from_literature else "library"


@dataclass(frozen=True)
class NamedPatch:
    """Names of a patch's pixels [n], their distances over the threshold [n], and the name of the patch.

    `confidence` [n]: probability of each pixel's likeliest name but "unknown", 0 for unusable pixels; None: the model
    gives none.
    """

    pixel_names: npt.NDArray[np.str_]
    distance: Real
    patch_name: PatchName
    confidence: Real | None = None


@dataclass(frozen=True)
class Odds:
    """Probabilities that a patch is of each kind, `kinds` [kind], of layers, `sheet`, or of no kind, `other`; sum 1.

    `distance` [kind]: distance of t from the kind over the radius of its 99 % region. Beyond 1 the kind has probability
    0, and what it would have is in `other`. Of several cases it is the least distance.
    """

    kinds: Real
    sheet: float
    other: float
    distance: Real


def weigh_kinds(kinds: Sequence[Kinds], scan_evidence: Sequence[RatioEvidence]) -> Odds:
    """Return the probabilities of materials of a patch from one scan, or from several at different incidence angles.

    Errors of different scans are independent. `kinds` has the same materials for each scan, at the angle of that scan.
    Where the metal may be painted the probabilities are the mean of those with and without paint, by its probability:
    one broad error around both values of t would make materials between them likely, which neither case allows.
    """
    cases = list(itertools.product(*(evidence.split() for evidence in scan_evidence)))
    shares = [float(np.prod([share for share, _ in case])) for case in cases]
    odds = [_weigh_kinds_of_case(kinds, [evidence for _, evidence in case]) for case in cases]
    if len(odds) == 1:
        return odds[0]
    weights = np.array(shares) / sum(shares)
    return Odds(
        kinds=weights @ np.stack([of_case.kinds for of_case in odds]),
        sheet=float(weights @ [of_case.sheet for of_case in odds]),
        other=float(weights @ [of_case.other for of_case in odds]),
        distance=np.min([of_case.distance for of_case in odds], axis=0),
    )


def _weigh_kinds_of_case(kinds: Sequence[Kinds], scan_evidence: Sequence[RatioEvidence]) -> Odds:
    """Return the probabilities of `weigh_kinds` from evidence of one case each."""
    first = kinds[0]
    # Real and imaginary parts of t of all scans make a vector of this size.
    size = 2 * len(scan_evidence)
    errors = scipy.linalg.block_diag(*(evidence.covariance for evidence in scan_evidence))
    t = np.array([evidence.inverse_ratio for evidence in scan_evidence])

    # Normal density of t about each kind's: covariance [kind, size, size] of specimens and errors, difference [kind,
    # size]. The 1e-10, far below any real variance, keep it invertible.
    effects = np.concatenate([kind.effects for kind in kinds], axis=1)
    inverse = np.linalg.inv(effects @ effects.mT + 1e-10 * np.eye(size) + errors)
    difference = split_complex(t - np.stack([kind.t for kind in kinds], axis=1)).reshape(-1, size)
    distance2 = np.einsum("ki,kij,kj->k", difference, inverse, difference)
    weight = first.share * np.sqrt(np.linalg.det(inverse / (2 * np.pi))) * np.exp(-0.5 * distance2)
    library_shares = [evidence.library_share for evidence in scan_evidence]
    library_share = float(np.mean(library_shares)) if first.in_library.any() else 0.0
    library_share = library_share / (library_share + LOOK_ALIKE_ODDS * (1 - library_share))
    weight = weight * np.where(first.in_library, library_share, 1 - library_share)

    # Thin plates: the mean density over the drawn ones, [draw, scan].
    drawn_sheets = np.stack([kind.sheets for kind in kinds], axis=1)
    dispersion_weight = _weigh_dispersion(kinds, scan_evidence)
    density = _evaluate_normal(drawn_sheets, t, errors + SHEET_KERNEL**2 * np.eye(size))
    density = density * _weigh_brightness(kinds, scan_evidence) * dispersion_weight
    sheet = (1 - library_share) * first.sheet_share * float(np.mean(density))
    # Stacks of layers count only where the change over the sweep can distinguish them from half spaces.
    if any(evidence.dispersion is not None for evidence in scan_evidence):
        sheet += (1 - library_share) * STACK_SHARE / np.pi ** len(scan_evidence) * float(np.mean(dispersion_weight))
    other_weight = (1 - library_share) * first.other * _evaluate_other_density(kinds, scan_evidence)
    distance = np.sqrt(distance2 / scipy.special.chdtri(size, 0.01))
    total = float(weight.sum()) + sheet + other_weight
    if not total > 0:
        return Odds(np.zeros(len(weight)), 0.0, 1.0, distance)
    probability = np.where(distance <= 1, weight, 0.0) / total
    sheet = sheet / total
    return Odds(probability, sheet, 1 - sheet - float(probability.sum()), distance)


def may_be_thin(evidence: RatioEvidence, kinds: Kinds) -> bool:
    """Return True if the probability of layers is above `POSSIBLY_THIN`: then the patch gets no permittivity."""
    return weigh_kinds((kinds,), (evidence,)).sheet > POSSIBLY_THIN


def _weigh_dispersion(kinds: Sequence[Kinds], scan_evidence: Sequence[RatioEvidence]) -> Real:
    """Return the product of `compute_layer_odds` over the scans that measured the change over the sweep, [draw]."""
    odds = np.ones(kinds[0].sheets.size)
    for kind, evidence in zip(kinds, scan_evidence, strict=True):
        if evidence.dispersion is not None:
            odds = odds * compute_layer_odds(evidence.dispersion, kind.theta_rad)
    return odds


def _weigh_brightness(kinds: Sequence[Kinds], scan_evidence: Sequence[RatioEvidence]) -> Real:
    """Return the likelihood of |H| for each drawn thin plate over that for a half space, product of scans, [draw]."""
    odds = np.ones(kinds[0].sheets.size)
    for kind, evidence in zip(kinds, scan_evidence, strict=True):
        if np.isfinite(evidence.brightness_off):
            sheet_brightness = evidence.brightness_off - kind.sheet_brightness_off
            density = compute_brightness_density(sheet_brightness, evidence.brightness_std)
            odds = odds * density / compute_brightness_density(evidence.brightness_off, evidence.brightness_std)
    return odds


def _evaluate_normal(draws: Complex, mean: Complex, covariance: Real) -> Real:
    """Return the normal density of draws [draw, scan] about `mean` [scan], with `covariance` [2 scan, 2 scan]."""
    inverse = np.linalg.inv(covariance)
    difference = split_complex(draws - mean).reshape(len(draws), -1)
    scale = np.sqrt(np.linalg.det(inverse / (2 * np.pi)))
    return scale * np.exp(-0.5 * np.einsum("ni,ij,nj->n", difference, inverse, difference))


def _evaluate_other_density(kinds: Sequence[Kinds], scan_evidence: Sequence[RatioEvidence]) -> float:
    """Return the density of the measured t, one per scan, of half spaces that are no listed material.

    With several scans it is averaged over half spaces drawn from the most exact measurement.
    """
    best = min(range(len(scan_evidence)), key=lambda i: float(np.linalg.det(scan_evidence[i].covariance)))
    mean = scan_evidence[best].inverse_ratio
    covariance = scan_evidence[best].covariance
    if len(scan_evidence) == 1:
        return float(kinds[best].compute_half_space_density(np.array(mean), covariance))
    noise = np.random.default_rng(0).multivariate_normal(np.zeros(2), covariance, _HALF_SPACES, method="cholesky")
    t = mean + noise[:, 0] + 1j * noise[:, 1]
    # The draws have the errors already: hardly any is added.
    density = kinds[best].compute_half_space_density(t, 1e-8 * np.eye(2))
    eps = permittivity_from_ratio(t, kinds[best].theta_rad)
    for i, evidence in enumerate(scan_evidence):
        if i != best:
            ratio = inverse_ratio(eps, evidence.theta_rad)
            density = density * _evaluate_normal(
                ratio[:, None], np.array([evidence.inverse_ratio]), evidence.covariance
            )
    return float(np.mean(density))


def format_permittivity(value: complex, digits: int = 2, width: int = 0) -> str:
    """Format a permittivity: `2.89 - j0.43` for a lossy medium, `2.89 + j27.30` for one with gain.

    `digits`: number of digits after the decimal point; `width` is the least width of the real part, for aligned
    columns.
    """
    # Adding zero after rounding removes the sign of a negative zero.
    real = round(float(value.real), digits) + 0.0
    imag = round(float(value.imag), digits) + 0.0
    return f"{real:{width}.{digits}f} {'+' if imag > 0 else '-'} j{abs(imag):.{digits}f}"


def summarise_literature(kinds: Kinds, odds: Odds) -> tuple[str, npt.NDArray[np.bool_]]:
    """Return one name for the likely materials of the literature, and a mask of those it stands for, bool [kind].

    If at most `MOST_NAMES` materials hold most of the literature's probability, the name lists them; otherwise it lists
    their families ("polymer"), or the one material that dominates a family. The name is empty if there are too many
    families, too, or the literature has no probability at all.
    """
    probability = np.where(kinds.in_library, 0.0, odds.kinds)
    names = np.array(kinds.names)
    families = np.array([kind.family or kind.name for kind in kinds.kinds])
    for group_of_kind in (names, families):
        group_names, group_index = np.unique(group_of_kind, return_inverse=True)
        group_probability = np.bincount(group_index, probability)
        likeliest_groups = np.argsort(-group_probability, kind="stable")[:MOST_NAMES]
        cumulative = np.cumsum(group_probability[likeliest_groups])
        group_count = 1 + int(np.searchsorted(cumulative, MOST_OF_IT * probability.sum()))
        if group_count > MOST_NAMES or not probability.any():
            continue
        named_groups = likeliest_groups[:group_count]
        listed_names = []
        for group in named_groups:
            member_probability = np.where(group_index == group, probability, 0.0)
            likeliest = int(member_probability.argmax())
            if member_probability[likeliest] >= MOST_OF_IT * group_probability[group]:
                listed_names.append(str(names[likeliest]))
            else:
                listed_names.append(str(group_names[group]))
        is_listed = np.isin(group_index, named_groups) & ~kinds.in_library
        return f"like {_join_with_or(listed_names)} (literature)", is_listed
    return "", np.zeros(len(names), np.bool_)


def _join_with_or(names: Sequence[str]) -> str:
    """Return `A, B or C`."""
    *first, last = names
    return f"{', '.join(first)} or {last}" if first else last


def name_patch(
    kinds: Sequence[Kinds], kind_evidence: Sequence[RatioEvidence], inverse_ratios: npt.NDArray[np.complex128]
) -> NamedPatch:
    """Name a patch and its pixels by its ratio in one scan, or in several at different incidence angles.

    The name is the likeliest of: each material of the library, those of the literature together, a layer, and none of
    these. A material whose value lies outside of the patch's own 99 % region (errors and specimens together) is
    never the name. Pixels are assumed to be of their patch's material, except for the share `INCLUSION_SHARE`.

    Parameters
    ----------
    kinds
        The possible materials at each scan's angle, at least one of them of the library.
    kind_evidence
        The patch's ratio in each scan, in the same order.
    inverse_ratios
        complex [n, scan]: V / H of the pixels, NaN where not usable.
    """
    usable = np.isfinite(inverse_ratios).all(axis=1)
    if not usable.any():
        return make_patch_without_pixels(usable.size)
    kind_evidence = [
        move_to_angle_of_kinds(evidence, kinds_of_scan)
        for evidence, kinds_of_scan in zip(kind_evidence, kinds, strict=True)
    ]
    odds = weigh_kinds(kinds, kind_evidence)
    # The kinds are the same at every angle; only their ratios differ.
    first_kinds = kinds[0]
    names = np.array(first_kinds.names)
    literature_name, in_literature_name = summarise_literature(first_kinds, odds)
    patch_name = _find_patch_name(first_kinds, odds, literature_name, in_literature_name)
    patch_name = replace(patch_name, pixels=int(usable.sum()))

    # Pixels get the corrections of their patch (leakage, tilt, and the scene's common change of V / H over the plane):
    # their median becomes the patch's corrected ratio.
    pixel_ratios = inverse_ratios[usable]
    middle = np.median(pixel_ratios.real, axis=0) + 1j * np.median(pixel_ratios.imag, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        correction = np.array([evidence.inverse_ratio for evidence in kind_evidence]) / middle
    corrected = inverse_ratios * np.where(np.isfinite(correction), correction, 1.0)
    name_of_kind = np.where(first_kinds.in_library, names, np.where(in_literature_name, literature_name, UNKNOWN))
    pixel_names, pixel_distance, confidence = _name_pixels(kinds, kind_evidence, corrected, odds.kinds, name_of_kind)
    return NamedPatch(
        pixel_names, pixel_distance, replace(patch_name, votes=compute_name_shares(pixel_names)), confidence
    )


def _find_patch_name(
    kinds: Kinds, odds: Odds, literature_name: str, in_literature_name: npt.NDArray[np.bool_]
) -> PatchName:
    """Return the patch's name and its probabilities, without votes of pixels.

    `literature_name` and `in_literature_name` are those of :func:`summarise_literature`.
    """
    probability = {}
    distances = {}
    literature = {}
    for k, name in enumerate(kinds.names):
        distances[name] = float(odds.distance[k])
        if kinds.in_library[k]:
            probability[name] = float(odds.kinds[k])
        else:
            literature[name] = float(odds.kinds[k])
    nearest_name = min(probability, key=lambda name: distances[name], default=None)
    if literature_name:
        probability[literature_name] = float(odds.kinds[in_literature_name].sum())
        distances[literature_name] = float(odds.distance[in_literature_name].min())
    # Sheets are thin plates; stacks of layers count with them.
    if kinds.sheet_share:
        probability[LAYER] = odds.sheet
    likely_names = _sort_likeliest_first(probability)
    # Names of little probability count as unknown, so that the sum stays one.
    likely_names[UNKNOWN] = round(1.0 - sum(likely_names.values()), 4)
    likely_names = _sort_likeliest_first(likely_names, least_probability=0.0)

    name = next(iter(likely_names))
    distance = distances.get(name, np.inf)
    if name in (UNKNOWN, LAYER) and nearest_name is not None:
        distance = distances[nearest_name]
    return PatchName(
        name=name,
        confidence=likely_names[name],
        votes={},
        distance=distance,
        pixels=0,
        probabilities=likely_names,
        nearest=nearest_name,
        literature=_sort_likeliest_first(literature),
        from_literature=name == literature_name,
    )


def _sort_likeliest_first(
    probability: Mapping[str, float], least_probability: float = LEAST_PROBABILITY
) -> dict[str, float]:
    """Return the probabilities of at least `least_probability`, rounded to four digits, largest first."""
    ordered = sorted(probability.items(), key=lambda item: -item[1])
    return {name: round(p, 4) for name, p in ordered if p >= least_probability}


def compute_name_shares(pixel_names: npt.NDArray[np.str_]) -> dict[str, float]:
    """Return the share of the pixels, str [n], with each name, largest first."""
    names, count = np.unique(pixel_names, return_counts=True)
    sorted_by_share = sorted(zip(names.tolist(), count.tolist(), strict=True), key=lambda row: (-row[1], row[0]))
    return {name: number / pixel_names.size for name, number in sorted_by_share}


def derive_evidence_from_pixels(inverse_ratios: npt.NDArray[np.complex128], kinds: Kinds) -> RatioEvidence:
    """Return a patch's ratio and its covariance from its pixels alone, if the error budget of its scan is not known.

    The spread of the pixels is not divided by the root of their number: errors inside a patch are as wide as the patch.
    `inverse_ratios` complex [n] is V / H of the pixels, NaN where not usable. Without usable ones the ratio is 0 with
    a covariance of 1, which says nothing.
    """
    usable_ratios = inverse_ratios[np.isfinite(inverse_ratios)]
    if not usable_ratios.size:
        return RatioEvidence(kinds.theta_rad, 0j, np.eye(2), USUAL_LIBRARY_SHARE)
    middle = complex(np.median(usable_ratios.real), np.median(usable_ratios.imag))
    std = float(np.hypot(np.std(usable_ratios), UNKNOWN_BUDGET * abs(middle)))
    return RatioEvidence(kinds.theta_rad, middle, std**2 / 2 * np.eye(2), USUAL_LIBRARY_SHARE)


def make_patch_without_pixels(pixels: int) -> NamedPatch:
    """Return the name of an unknown patch with this number of `pixels`, none of which is usable."""
    patch_name = PatchName(UNKNOWN, 0.0, {}, np.inf, 0)
    return NamedPatch(np.full(pixels, UNKNOWN), np.full(pixels, np.inf), patch_name)


def _name_pixels(
    kinds: Sequence[Kinds],
    kind_evidence: Sequence[RatioEvidence],
    inverse_ratios: npt.NDArray[np.complex128],
    patch_odds: Real,
    name_of_kind: npt.NDArray[np.str_],
) -> tuple[npt.NDArray, Real, Real]:
    """Return name, distance over the threshold, and probability of the likeliest name of each pixel, [n] each.

    The probability is that of the likeliest name even where the pixel is too far from it and called unknown.

    `inverse_ratios` complex [n, scan] are V / H of the pixels with the corrections of their patch, `patch_odds` [kind]
    the probabilities of the patch's kinds, and `name_of_kind` [kind] the name that each kind gets.
    """
    pixel_count = inverse_ratios.shape[0]
    usable = np.isfinite(inverse_ratios).all(axis=1)
    has_name = name_of_kind != UNKNOWN
    # Number of real and imaginary parts: two for each scan's ratio.
    parts = 2 * len(kind_evidence)

    # Gaussian of each named kind: its specimens differ, the scans have errors, and the pixels scatter. 1e-10, far below
    # any real variance, keeps the matrix invertible.
    values = split_complex(inverse_ratios[usable]).reshape(-1, parts)
    pixel_covariance = np.cov(values.T) if len(values) > 2 else np.zeros((parts, parts))
    scan_covariance = scipy.linalg.block_diag(*(evidence.covariance for evidence in kind_evidence))
    errors = scan_covariance + pixel_covariance + 1e-10 * np.eye(parts)
    # [kind, parts, ways in which specimens differ].
    effects = np.concatenate([kinds_of_scan.effects[has_name] for kinds_of_scan in kinds], axis=1)
    inverse = np.linalg.inv(effects @ effects.mT + errors)

    # Squared Mahalanobis distance of each pixel to each kind, [n, kind].
    means = np.stack([kinds_of_scan.t[has_name] for kinds_of_scan in kinds], axis=1)
    ratios: npt.NDArray[np.complex128] = np.where(usable.reshape(-1, 1), inverse_ratios, 0)
    difference = split_complex(ratios[:, None, :] - means).reshape(pixel_count, -1, parts)
    distance2 = np.einsum("nki,kij,nkj->nk", difference, inverse, difference)

    # Bayes: the prior is the patch's result, and for inclusions any material of the library. The
    # exponent is limited to -700, so that a likelihood is never zero: of zeros alone the first name would be largest.
    is_in_library = np.take(kinds[0].in_library, np.flatnonzero(has_name))
    prior = (1 - INCLUSION_SHARE) * patch_odds[has_name] + INCLUSION_SHARE * is_in_library / max(is_in_library.sum(), 1)
    likelihood = prior * np.sqrt(np.linalg.det(inverse)) * np.exp(-0.5 * np.minimum(distance2, 1400))

    # Kinds of the same name are added up; the name of the largest sum is the pixel's.
    names, name_index = np.unique(name_of_kind[has_name], return_inverse=True)
    name_likelihood = likelihood @ np.equal.outer(name_index, np.arange(names.size))
    best_name = name_likelihood.argmax(axis=1)
    best_likelihood = name_likelihood[np.arange(pixel_count), best_name]
    share = best_likelihood / np.maximum(name_likelihood.sum(axis=1), 1e-300)
    # Kinds without a name take their part from the patch's probability; inclusions give some back.
    probability_of_named = min(1.0, float(patch_odds[has_name].sum()) + INCLUSION_SHARE)
    confidence = np.where(usable, share * probability_of_named, 0.0)

    # A pixel outside of the 99 % region of every kind of that name is unknown.
    least_distance2 = np.where(np.equal.outer(best_name, name_index), distance2, np.inf).min(axis=1)
    distance = np.where(usable, np.sqrt(least_distance2 / scipy.special.chdtri(parts, 0.01)), np.inf)
    return np.where(distance <= 1, names[best_name], UNKNOWN), distance, confidence


def add_explanation(
    named: NamedPatch,
    permittivity: complex | None,
    covariance: npt.NDArray[np.float64] | None,
    library: Mapping[str, complex],
) -> NamedPatch:
    """Return the patch with the reason of its name, one sentence for a reader who knows materials.

    `permittivity` is eps' - j eps'' of the patch, `covariance` [2, 2] that of its real and imaginary part; None if it
    has none. `library` are the permittivities of the library's materials.
    """
    patch_name = named.patch_name
    estimate = _format_estimate(permittivity, covariance)
    nearest_name = patch_name.nearest
    if patch_name.name in library:
        nearest_name = patch_name.name
    nearest_material = ""
    nearest_clause = ""
    if nearest_name is not None:
        nearest_material = _add_permittivity(nearest_name, library.get(nearest_name))
        nearest_clause = f"; nearest: {nearest_material}"

    if patch_name.name == UNKNOWN and estimate:
        explanation = f"not in the library: {estimate}{nearest_clause}"
    elif patch_name.name == UNKNOWN:
        explanation = f"not in the library{nearest_clause}"
    elif patch_name.name == LAYER and estimate:
        explanation = f"{estimate} as a half space, but rather a thin plate{nearest_clause}"
    elif patch_name.name == LAYER:
        explanation = f"rather a thin plate{nearest_clause}"
    elif patch_name.from_literature:
        values = _list_values(patch_name.literature)
        # Metal has no permittivity to tell.
        subject = estimate or "it"
        explanation = f"{subject} is like {values} of the literature; not measured by this library{nearest_clause}"
    elif estimate:
        explanation = f"{estimate} matches the library's {nearest_material}{_list_rivals(patch_name)}"
    else:
        explanation = f"it looks like the library's {nearest_material}{_list_rivals(patch_name)}"
    return replace(named, patch_name=replace(patch_name, why=explanation))


def _list_rivals(patch_name: PatchName) -> str:
    """Return a clause on the other likely names; empty for the KNN, which has no probabilities."""
    rivals = []
    for name, probability in patch_name.probabilities.items():
        least_probability = LIKELY_UNKNOWN if name == UNKNOWN else LEAST_PROBABILITY
        if name == patch_name.name or probability < least_probability:
            continue
        rival = "a material that the library lacks" if name == UNKNOWN else name
        rivals.append(f"{rival} {100 * probability:.0f} %")
    if rivals:
        return f"; it could also be {' or '.join(rivals[:2])}"
    if patch_name.probabilities:
        return "; no other material is likely"
    return ""


def _format_estimate(permittivity: complex | None, covariance: npt.NDArray[np.float64] | None) -> str:
    """Return a permittivity with its standard deviations as text; empty without one."""
    if permittivity is None:
        return ""
    text = f"permittivity {format_permittivity(permittivity)}"
    if covariance is None or not np.isfinite(covariance).all():
        return text
    real, loss = np.sqrt(np.diag(covariance))
    return f"{text} (+- {real:.2f}, {loss:.2f})"


def _list_values(literature: Mapping[str, float]) -> str:
    """Return the likeliest materials of the literature with their permittivities, as text."""
    values = {material.name: material.permittivity for material in load_catalogue()}
    return ", ".join(_add_permittivity(name, values.get(name)) for name in list(literature)[:MOST_NAMES])


def _add_permittivity(name: str, permittivity: complex | None) -> str:
    """Return a material's name, with its permittivity in brackets if it has one."""
    if permittivity is None:
        return name
    return f"{name} ({format_permittivity(permittivity)})"
