"""Names of the library, of the literature and of possible layers: their probabilities and texts."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.foreign import judge_scene
from hypothesis import given, settings, strategies as st

from polysight.materials import LAYER, UNKNOWN, clean_name
from polysight.materials.kinds import (
    Kind,
    Kinds,
    PatchDispersion,
    RatioCase,
    RatioEvidence,
    compute_layer_odds,
    draw_sheets,
    inverse_ratio,
    list_literature_kinds,
    move_to_angle_of_kinds,
)
from polysight.materials.names import Odds, add_explanation, may_be_thin, name_patch, summarise_literature, weigh_kinds
from polysight.polarimetry import fresnel, multilayer, permittivity_from_ratio
from polysight_shared.errors import DataError

# t is V / H relative to metal. Scans are under one of these two incidence angles.
ANGLES = tuple(np.radians([55.0, 65.0]))
LIBRARY = {"acrylic": 4.0 - 0.4j, "rubber": 5.06 - 1.11j, "wood": 2.61 - 0.01j, "glass": 7.26 - 0.85j}
KINDS = (*(Kind(name, eps) for name, eps in LIBRARY.items()), *list_literature_kinds(tuple(LIBRARY)))
AT_ANGLES = tuple(Kinds(KINDS, angle, with_sheets=True) for angle in ANGLES)


def name_ratios(*ratios: complex, std: float = 0.004, share: float = 0.5):
    """Return the name of a patch with these V / H, one for each angle.

    `std` is the error of each part, `share` the probability before the measurement that it is of the library.
    """
    kinds = AT_ANGLES[: len(ratios)]
    covariance = std**2 * np.eye(2)
    evidence = [RatioEvidence(kind.theta_rad, t, covariance, share) for kind, t in zip(kinds, ratios, strict=True)]
    pixels = np.tile(np.array(ratios, np.complex128), (20, 1))
    return name_patch(kinds, evidence, pixels)


@settings(max_examples=40, deadline=None)
@given(st.floats(1.05, 12.0), st.floats(0.0, 8.0), st.floats(0.002, 0.05), st.integers(1, 2))
def test_probabilities_sum_to_one_and_the_name_has_the_largest(real, loss, std, scans):
    ratios = inverse_ratio(complex(real, -loss), np.array(ANGLES[:scans]))
    patch_name = name_ratios(*ratios, std=std).patch_name
    probabilities = patch_name.probabilities
    assert sum(probabilities.values()) == pytest.approx(1, abs=1e-9)
    assert patch_name.confidence == probabilities[patch_name.name]
    assert patch_name.confidence == max(probabilities.values())


@settings(max_examples=40, deadline=None)
@given(st.floats(1.05, 12.0), st.floats(0.0, 8.0))
def test_a_name_of_the_literature_is_never_one_of_the_library(real, loss):
    patch_name = name_ratios(complex(inverse_ratio(complex(real, -loss), ANGLES[0]))).patch_name
    if patch_name.source == "library":
        assert patch_name.name in LIBRARY
    else:
        assert patch_name.name not in LIBRARY
        assert patch_name.name in (UNKNOWN, LAYER) or patch_name.source == "literature"
        # Such a name cannot be given to a box, so no library can contain it.
        with pytest.raises(DataError):
            clean_name(patch_name.name)


def test_a_patch_that_only_the_literature_explains_is_named_as_like_it():
    # Sapphire has 9.41 in the catalogue.
    sapphire = complex(inverse_ratio(9.41 - 0.002j, ANGLES[0]))
    patch_name = name_ratios(sapphire, std=0.001, share=0.2).patch_name
    assert patch_name.source == "literature"
    assert "sapphire" in patch_name.literature


@pytest.mark.parametrize(("share", "is_material_named"), [(0.79, False), (0.81, True)])
def test_a_family_is_named_by_a_material_that_has_four_fifths_of_its_probability(share, is_material_named):
    """The patch is a polymer with 0.6, of which one polymer has `share`, and a laminate with 0.4, all alike."""
    kinds = AT_ANGLES[0].kinds
    polymers = [k for k, kind in enumerate(kinds) if kind.family == "polymer"]
    laminates = [k for k, kind in enumerate(kinds) if kind.family == "laminate"]
    probability = np.zeros(len(kinds))
    probability[polymers] = 0.6 * (1 - share) / (len(polymers) - 1)
    probability[polymers[3]] = 0.6 * share
    probability[laminates] = 0.4 / len(laminates)
    odds = Odds(kinds=probability, sheet=0.0, other=0.0, distance=np.zeros(len(kinds)))
    name = kinds[polymers[3]].name if is_material_named else "polymer"
    assert summarise_literature(AT_ANGLES[0], odds)[0] == f"like {name} or laminate (literature)"


def test_a_second_angle_makes_a_true_name_surer():
    ratios = inverse_ratio(LIBRARY["acrylic"], np.array(ANGLES))
    by_one_angle = name_ratios(ratios[0], std=0.03).patch_name
    by_two_angles = name_ratios(*ratios, std=0.03).patch_name
    assert by_two_angles.name == "acrylic"
    assert by_two_angles.confidence > by_one_angle.probabilities["acrylic"]


def test_a_thin_plate_that_fits_no_half_space_is_a_possible_layer():
    ratios_of_sheets, _ = draw_sheets(ANGLES[0])
    # Of 97 % of the drawn sheets |V / H| is smaller.
    far_ratio = ratios_of_sheets[np.argsort(np.abs(ratios_of_sheets))[int(0.97 * ratios_of_sheets.size)]]
    names = [name_ratios(complex(far_ratio)).patch_name.name, name_ratios(-0.25 + 0.2j).patch_name.name]
    assert LAYER in names
    assert not set(names) & set(LIBRARY)


def compute_layer_probability(plates: int, brightness_std: float) -> tuple[float, float]:
    """Return the median probability of a possible layer: for drawn thin plates, and for half spaces of the same ratios.

    The plates are sheets of 0.5 to 3 mm in air. Only their brightness |H| distinguishes them from the half spaces.
    """
    rng = np.random.default_rng(5)
    probabilities = []
    while len(probabilities) < plates:
        eps = rng.uniform(2, 5) * (1 - 1j * rng.uniform(0.001, 0.05))
        r_s, r_p = multilayer([eps, 1.0], [rng.uniform(0.5e-3, 3e-3), np.inf], 78e9, ANGLES[0])
        t = complex(r_p / r_s)
        half_space = permittivity_from_ratio(t, ANGLES[0])
        # A ratio that no usual half space has shows the sheet without its brightness.
        if not (half_space.real > 1.3 and -3 < half_space.imag < 0):
            continue
        # Differences of ln |H| from that of the half space: of the sheet, and of the half space itself
        r_s_of_half_space, _ = fresnel(half_space, ANGLES[0])
        difference_of_sheet = np.log(np.abs(r_s)) - np.log(np.abs(r_s_of_half_space))
        layer_probabilities = []
        for true_difference in (difference_of_sheet, 0.0):
            measured_difference = float(true_difference + brightness_std * rng.standard_normal())
            evidence = RatioEvidence(ANGLES[0], t, 0.01**2 * np.eye(2), 0.5, measured_difference, brightness_std)
            layer_probabilities.append(weigh_kinds(AT_ANGLES[:1], (evidence,)).sheet)
        probabilities.append(layer_probabilities)
    thin, thick = np.median(probabilities, axis=0)
    return float(thin), float(thick)


def test_brightness_distinguishes_thin_plates_from_half_spaces_of_the_same_ratio():
    thin, thick = compute_layer_probability(60, brightness_std=0.05)
    # A layer is the likelier explanation of most thin plates (the median is 0.71), and of hardly any half space.
    assert thin > 0.5
    assert thick < 0.05


def test_brightness_of_unevenly_lit_plates_is_weak_evidence():
    thin, thick = compute_layer_probability(60, brightness_std=0.6)
    # The probabilities are 0.16 and 0.14. In the test above they are 0.71 and less than 0.05.
    assert abs(thin - thick) < 0.2


def test_a_patch_that_is_a_layer_with_more_than_a_fifth_of_probability_gets_no_permittivity():
    """If more than a fifth of the patches with a permittivity were layers, the stated 95 % regions would hold the truth
    less often than that.

    Here all patches have the same ratio, and the brightness decides: that of a half space gives a permittivity.
    """
    eps = 3.0 - 0.03j
    r_s, r_p = multilayer([eps, 1.0], [0.9e-3, np.inf], 78e9, ANGLES[0])
    of_half_space = RatioEvidence(ANGLES[0], complex(r_p / r_s), 0.01**2 * np.eye(2), 0.5, 0.0, 0.05)
    # ln |H| minus that of a half space
    brightness_differences = np.linspace(0.0, 0.4, 81)
    evidences = [replace(of_half_space, brightness_off=float(difference)) for difference in brightness_differences]
    probability_of_layer = np.array([weigh_kinds(AT_ANGLES[:1], (evidence,)).sheet for evidence in evidences])
    # Some of the patches are far below the limit of a fifth, and some are a little above it.
    assert probability_of_layer[0] < 0.1
    assert np.any((probability_of_layer > 0.25) & (probability_of_layer < 0.5))
    assert [may_be_thin(evidence, AT_ANGLES[0]) for evidence in evidences] == (probability_of_layer > 0.2).tolist()


# About the linear part of the published rig's sweep
BAND_HZ = (76.3e9, 79.75e9)


def make_dispersion(change: np.ndarray, std: float = 0.01) -> PatchDispersion:
    """Return a change over the sweep, of ln |H| and of both parts of ln(V / H), each with the same error."""
    return PatchDispersion(change, np.full(3, std), BAND_HZ)


def test_a_change_over_the_sweep_distinguishes_layers_from_half_spaces():
    """Half spaces reflect all frequencies alike; a plate before a half space does not."""
    rng = np.random.default_rng(7)
    centre_hz = np.mean(BAND_HZ)
    width_hz = BAND_HZ[1] - BAND_HZ[0]
    layered = []
    for _ in range(100):
        plate_eps = rng.uniform(2, 7) * (1 - 1j * rng.uniform(0.001, 0.05))
        half_space_eps = rng.uniform(2, 9) * (1 - 1j * rng.uniform(0, 1.5))
        permittivities = [plate_eps, half_space_eps]
        thicknesses_m = [rng.uniform(1e-3, 5e-3), np.inf]
        # The change over a tenth of the sweep, times ten: a plate's phase changes by several turns over the whole.
        low_hz = centre_hz - 0.05 * width_hz
        high_hz = centre_hz + 0.05 * width_hz
        low = np.log(np.array(multilayer(permittivities, thicknesses_m, low_hz, ANGLES[0])))
        high = np.log(np.array(multilayer(permittivities, thicknesses_m, high_hz, ANGLES[0])))
        change_of_s, change_of_p = (high - low) / 0.1
        change_of_ratio = change_of_p - change_of_s
        change = np.array([change_of_s.real, change_of_ratio.real, change_of_ratio.imag])
        layered.append(float(np.mean(compute_layer_odds(make_dispersion(change), ANGLES[0]))))
    # The odds of layers have a median of 1e17.
    assert np.median(layered) > 1e3
    # Half spaces show only the error of the measurement.
    errors = 0.01 * rng.standard_normal((100, 3))
    half_spaces = [float(np.mean(compute_layer_odds(make_dispersion(error), ANGLES[0]))) for error in errors]
    assert np.median(half_spaces) < 0.1
    assert max(half_spaces) < 1


def test_an_uncertain_change_over_the_sweep_is_not_evidence():
    for std in (30.0, 1e60):
        odds = compute_layer_odds(make_dispersion(np.array([0.5, -0.4, 0.6]), std=std), ANGLES[0])
        # Odds of 1 are no evidence; an error of 30 leaves 1 - 3e-5.
        assert np.median(odds) == pytest.approx(1, abs=1e-3)


def test_a_change_of_any_size_has_finite_odds():
    for change in (0.0, 1.0, 1e3, 1e9):
        odds = compute_layer_odds(make_dispersion(np.full(3, change), std=0.006), ANGLES[0])
        assert np.isfinite(odds).all()
        assert (odds > 0).all()


def test_a_ratio_of_a_half_space_that_changes_over_the_sweep_is_named_a_layer():
    wood = Kind("wood", 2.6 - 0.1j)
    kinds = Kinds([wood, *list_literature_kinds()], ANGLES[0], with_sheets=True)
    t = complex(inverse_ratio(2.6 - 0.1j, ANGLES[0]))

    def name_with_change(change: np.ndarray):
        evidence = RatioEvidence(ANGLES[0], t, 1e-5 * np.eye(2), 0.5, dispersion=make_dispersion(change))
        return name_patch((kinds,), (evidence,), np.array([[t]])).patch_name

    constant = name_with_change(np.zeros(3))
    assert constant.name == "wood"
    # The confidence is 0.988: a ratio that is exactly that of wood leaves little to other materials.
    assert constant.confidence > 0.9
    assert name_with_change(np.array([0.2, -0.1, 0.3])).name == LAYER


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dishes", "sheets"])
def test_pieces_that_reflect_at_two_faces_get_no_name_of_the_library_and_no_wrong_permittivity(kind):
    pieces = judge_scene(kind, 1)
    # Every name of the library is wrong here; one with a probability of at least 0.8 would mislead a user.
    assert not [p for p in pieces if p.source == "library" and p.confidence >= 0.8]
    # A sheet whose brightness happens to peak in the middle of the sweep looks like a half space.
    confidently_wrong = [p for p in pieces if p.misled]
    assert len(confidently_wrong) <= 1
    called_layers = [p for p in pieces if p.thin or p.name == LAYER]
    assert len(called_layers) >= 4


def test_each_reason_of_a_name_has_a_subject():
    """The subject is the permittivity, and "it" for a patch without one."""
    sapphire = 9.41 - 0.002j
    named = name_ratios(complex(inverse_ratio(sapphire, ANGLES[0])), std=0.001, share=0.2)
    for permittivity, beginning in ((None, "it is like "), (sapphire, "permittivity 9.41 - j0.00 is like ")):
        explained = add_explanation(named, permittivity, covariance=None, library=LIBRARY)
        assert explained.patch_name.why.startswith(beginning)


@pytest.mark.parametrize(("unknown", "rival"), [(0.5, "a material that the library lacks 50 %"), (0.001, "no other")])
def test_a_likely_unknown_material_is_listed_as_a_rival(unknown, rival):
    named = name_ratios(complex(inverse_ratio(LIBRARY["acrylic"], ANGLES[0])))
    patch_name = replace(named.patch_name, probabilities={"acrylic": 1 - unknown, UNKNOWN: unknown})
    named_with_rival = replace(named, patch_name=patch_name)
    explained = add_explanation(named_with_rival, LIBRARY["acrylic"], covariance=None, library=LIBRARY)
    reason = explained.patch_name.why
    assert reason.partition("; ")[2].removeprefix("it could also be ").startswith(rival)


def test_names_relative_to_metal_that_may_be_painted_have_the_mean_probability_of_both_cases():
    """The patch is rubber if the metal is bare and glass if it is painted.

    t is V / H relative to the metal; paint on the metal changes every t. One broad error of t that holds both cases
    would hold other materials, too.
    """
    covariance = 0.004**2 * np.eye(2)
    bare, painted = (
        RatioEvidence(ANGLES[0], complex(inverse_ratio(LIBRARY[name], ANGLES[0])), covariance, 0.5)
        for name in ("rubber", "glass")
    )
    p_painted = 0.4
    p_bare = 0.6
    cases = (
        RatioCase(p_painted, painted.inverse_ratio, covariance),
        RatioCase(p_bare, bare.inverse_ratio, covariance),
    )
    offset = painted.inverse_ratio - bare.inverse_ratio
    parts_of_offset = np.array([offset.real, offset.imag])
    # Mean and covariance of both cases together: two values with these probabilities add the variance of a choice
    # between them to that of each.
    middle = bare.inverse_ratio + p_painted * offset
    spread = p_painted * p_bare * np.outer(parts_of_offset, parts_of_offset)
    both = RatioEvidence(ANGLES[0], middle, covariance + spread, 0.5, cases=cases)
    pixels = np.full((20, 1), middle)
    as_bare, as_painted, as_both = (name_patch(AT_ANGLES[:1], [e], pixels).patch_name for e in (bare, painted, both))
    assert (as_bare.name, as_painted.name) == ("rubber", "glass")
    for name in LIBRARY:
        if_bare = as_bare.probabilities.get(name, 0.0)
        if_painted = as_painted.probabilities.get(name, 0.0)
        expected = p_bare * if_bare + p_painted * if_painted
        # Probabilities below half a per cent are left out of the lists.
        assert as_both.probabilities.get(name, 0.0) == pytest.approx(expected, abs=0.005)
    # The same holds together with a scan at another angle, whose metal is bare.
    other_t = complex(inverse_ratio(LIBRARY["rubber"], ANGLES[1]))
    other_scan = RatioEvidence(ANGLES[1], other_t, covariance, 0.5)
    odds = weigh_kinds(AT_ANGLES, [both, other_scan])
    odds_if_bare = weigh_kinds(AT_ANGLES, [bare, other_scan])
    odds_if_painted = weigh_kinds(AT_ANGLES, [painted, other_scan])
    assert odds.kinds == pytest.approx(p_bare * odds_if_bare.kinds + p_painted * odds_if_painted.kinds)


def test_both_cases_of_metal_that_may_be_painted_move_to_the_angle_of_the_kinds():
    cases = (RatioCase(0.5, 0.3 - 0.1j, np.eye(2)), RatioCase(0.5, 0.2 - 0.1j, np.eye(2)))
    moved = move_to_angle_of_kinds(RatioEvidence(ANGLES[0], 0.3 - 0.1j, np.eye(2), 0.5, cases=cases), AT_ANGLES[1])
    assert moved.cases[0].inverse_ratio == moved.inverse_ratio
    for case, moved_case in zip(cases, moved.cases, strict=True):
        permittivity = permittivity_from_ratio(case.inverse_ratio, ANGLES[0])
        assert moved_case.inverse_ratio == pytest.approx(complex(inverse_ratio(permittivity, ANGLES[1])))
