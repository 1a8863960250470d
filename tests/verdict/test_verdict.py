"""The verdict: the worst reason decides, reasons come in order of weight, and JSON gives back what was written."""

import itertools
import math
import re

import pytest

from polysight.materials import SMEAR
from polysight.results import PhaseJump, row_rules, rules
from polysight.results.verdict import Coverage, NoResult, Verdict, join_reasons, percent, read_verdict, reason
from polysight_shared.findings import Finding

# A finding about patches whose permittivity would be that of a material with gain.
GAIN_FINDING = Finding("error", "a gain", "leakage", "measure it")
# Ripple of V / H over a plate, of ln amplitude and of phase in radians.
RIPPLE = (0.1, 0.05)
# Reasons with their level, what, why, what to do, and weight.
THREE_REASONS = [
    reason("care", "a", "because", "do a", 1.0),
    reason("care", "b", "because", "do b", 3.0),
    reason("none", "c", "because", "do c", 0.1),
]


@pytest.mark.parametrize("order", list(itertools.permutations(THREE_REASONS)))
def test_the_worst_reason_decides_and_reasons_of_one_level_are_in_order_of_weight(order):
    verdict = join_reasons(order)
    assert verdict.level == "none"
    assert [r.what for r in verdict.reasons] == ["c", "b", "a"]
    # The reasons of the level "care" are warnings.
    assert join_reasons(r for r in order if r.level == "warning").level == "care"


def test_only_a_verdict_without_a_result_hides_names_and_permittivities():
    # The third reason is the one of the level "none".
    assert join_reasons([]).usable
    assert join_reasons(THREE_REASONS[:1]).usable
    assert join_reasons(THREE_REASONS[:2]).usable
    assert not join_reasons(THREE_REASONS).usable


def test_a_verdict_without_reasons_is_good():
    assert join_reasons([]) == Verdict("good")
    assert join_reasons([]).lines() == ["verdict:  good"]


def test_a_verdict_is_read_back_from_json():
    verdict = join_reasons(THREE_REASONS)
    content = {"verdict": verdict.to_dict(), "other": 1}
    reread = read_verdict(content)
    assert reread is not None
    assert reread.to_dict() == verdict.to_dict()
    assert all(set(r) == {"what", "why", "do"} for r in content["verdict"]["reasons"])


@pytest.mark.parametrize("content", [{}, {"verdict": 1}, {"verdict": {"level": "perfect"}}, {"verdict": {"level": []}}])
def test_content_without_a_known_level_has_no_verdict(content):
    assert read_verdict(content) is None


@pytest.mark.parametrize("reasons", [None, 3, "noise", {"what": "x"}, [1, None]])
def test_damaged_reasons_are_left_out(reasons):
    assert read_verdict({"verdict": {"level": "care", "reasons": reasons}}) == Verdict("care")


def test_no_result_has_an_exit_status_of_its_own():
    error = join_reasons(THREE_REASONS).error("the images are kept")
    assert isinstance(error, NoResult)
    # Each kind of error has an exit status; 7 is that of a scan without a result.
    assert error.exit_status == 7
    assert "c" in error.what
    assert "the images are kept" in error.remedy


def level(reasons):
    """Return the level of the verdict with these reasons."""
    return join_reasons(reasons).level


def judge_metal(
    patch="patch 5", *, is_likely=False, is_certain=False, is_given=False, contradicted=False, only_patch=False, **paint
):
    """Judge the metal reference of a scene, by default one for which nothing speaks."""
    return rules.judge_metal(patch, is_likely, is_certain, is_given, contradicted, only_patch, **paint)


def make_coverage(recorded, planned, faults=()):
    """Return the coverage of a scan with one frame a row: `faults` are those of its manifest."""
    return Coverage(
        rows_planned=planned,
        rows_recorded=recorded,
        frames_planned=planned,
        frames_received=recorded,
        manifest=faults,
    )


def judge_rows(recorded, masked=0.0):
    """Judge a recording of 1000 planned rows, with this share of masked positions."""
    return rules.judge_recording(make_coverage(recorded, planned=1000), masked)


def judge_path(snr_db=5.5, phase_rad=0.004, share=1.0):
    """Judge the direct path of the board RH; `share` is that of the positions in which it is found."""
    return rules.judge_direct_path("RH", snr_db, phase_rad, share)


def judge_chirps(clipped=0.0, disturbed=0.0, positions_clipped=0.0):
    """Judge the shares of chirps of the board RH that were left out, and of positions without any other chirp."""
    return rules.judge_left_out_chirps("RH", clipped, disturbed, positions_clipped)


def judge_plane(offset_mm=0.0, tilt_deg=(0.0, 0.0), tilt_std_deg=(0.0, 0.0)):
    """Judge a plane of the plates that was measured."""
    return rules.judge_plane(
        is_known_plane=True, offset_mm=offset_mm, tilt_deg=tilt_deg, theta_std_deg=0.1, tilt_std_deg=tilt_std_deg
    )


def judge_plane_not_measured(theta_std_deg=0.3):
    return rules.judge_plane(is_known_plane=False, offset_mm=0.0, tilt_deg=(0.0, 0.0), theta_std_deg=theta_std_deg)


def judge_leakage(relative_error, measured=False, estimated=False):
    return rules.judge_leakage(measured=measured, estimated=estimated, relative_error=relative_error)


@pytest.mark.parametrize(
    ("likely", "certain", "given", "contradicted", "only_patch", "expected"),
    [
        # Found without a user: good only if certain. Given by a user: good unless contradicted.
        (True, True, False, False, False, "good"),
        (True, False, False, False, False, "care"),
        (False, False, False, True, False, "none"),
        (False, False, False, False, True, "none"),
        (False, False, True, False, True, "good"),
        (False, False, True, True, True, "care"),
        (False, False, True, True, False, "none"),
    ],
)
def test_metal_needs_evidence_of_other_patches_or_a_user(likely, certain, given, contradicted, only_patch, expected):
    reasons = judge_metal(
        is_likely=likely, is_certain=certain, is_given=given, contradicted=contradicted, only_patch=only_patch
    )
    assert level(reasons) == expected


def test_reasons_that_depend_on_no_limit_have_a_level_of_their_own():
    assert level(rules.judge_patches({}, patches=0)) == "none"
    # There is no patch, and one region that is not a patch fills most of the picture, or little of it.
    (with_large_region,) = rules.judge_patches({}, patches=0, left_out=1, filled_share=0.9)
    (with_small_region,) = rules.judge_patches({}, patches=0, left_out=1, filled_share=0.1)
    assert with_large_region.what != with_small_region.what
    # The only patch was refused, or one of two
    assert level(rules.judge_patches({1: "noise"}, patches=1)) == "none"
    assert level(rules.judge_patches({1: "noise"}, patches=2)) == "care"
    assert level(judge_leakage(0.5, measured=True)) == "good"
    assert level(judge_plane_not_measured()) == "care"
    # A damaged manifest whose rows are complete
    assert level(rules.judge_recording(make_coverage(27, planned=27, faults=("line 6: damaged",)))) == "care"


def test_a_quantity_that_is_not_known_is_not_a_reason():
    assert level(judge_path(snr_db=None, phase_rad=None)) == "good"
    assert level(rules.judge_levels({"H": None})) == "good"


def test_every_reason_has_its_cause_and_a_remedy():
    reasons = [
        *rules.judge_recording(make_coverage(5, planned=9, faults=("x",)), masked_share=0.3),
        *judge_path(snr_db=-20.0, phase_rad=None),
        *judge_path(snr_db=-6.0, phase_rad=0.3),
        *rules.judge_patches({1: "noise"}, patches=2),
        *rules.judge_patches({}, patches=0),
        *judge_metal(contradicted=True),
        *judge_metal(is_given=True, contradicted=True),
        *judge_metal(is_likely=True),
        *judge_leakage(0.1, estimated=True),
        *judge_plane_not_measured(),
        *judge_plane(14.0),
        *judge_plane(9.0, tilt_deg=(0.9, 0.0)),
        *rules.judge_levels({"H": 9.0, "V": 0.1}),
        *rules.judge_incidence(57.0, 54.9),
        *rules.judge_tilts({1: 1.0, 4: -2.0}),
        *rules.judge_brightness({1: 0.4, 4: -0.4}),
        *rules.judge_image_shift((3.0, -1.0)),
        *rules.judge_drift(amplitude=0.1, phase_rad=0.05, probability=1.0),
        *rules.judge_halo(0.02),
        *rules.judge_background(0.1),
        *rules.judge_flatness(RIPPLE, relief_rad=0.0),
        *rules.judge_flatness(RIPPLE, relief_rad=0.1),
        *rules.judge_flatness(RIPPLE, relief_rad=0.0, is_boxed=True),
        *rules.judge_fringes(0.9),
        *rules.judge_disturbed_plates({2: 0.2}),
        *rules.judge_moved_boards(1.0),
        *row_rules.judge_phase_jumps({"RH": [PhaseJump(9, 0.4), PhaseJump(20, 0.3)], "RV": [PhaseJump(9, 0.5)]}),
        *row_rules.judge_displaced_rows(0.4),
        *row_rules.judge_phase_drift(1.0, 0.1),
    ]
    # Each of the calls above gives one reason or more.
    assert len(reasons) >= 28
    for r in reasons:
        assert all((r.what, r.why, r.do))
        assert not any(text.endswith(".") for text in (r.what, r.do))


@pytest.mark.parametrize(
    ("judge", "inside", "outside", "levels"),
    [
        # A function of one quantity, values of the quantity on either side of a limit, and the levels there.
        (judge_rows, 1000, 999, ("good", "care")),
        (judge_rows, 500, 499, ("care", "none")),
        (lambda masked: judge_rows(1000, masked), 0.005, 0.0051, ("good", "care")),
        (lambda masked: judge_rows(1000, masked), 0.5, 0.501, ("care", "none")),
        (judge_path, 0.0, -0.01, ("good", "care")),
        (judge_path, -14.0, -14.01, ("care", "none")),
        (lambda share: judge_chirps(clipped=share), 0.05, 0.051, ("good", "care")),
        (lambda share: judge_chirps(disturbed=share), 0.05, 0.051, ("good", "care")),
        (lambda share: judge_chirps(clipped=0.01, positions_clipped=share), 0.005, 0.0051, ("good", "care")),
        (lambda db: rules.judge_dark_reference("the given box", 4, db), 5.9, 6.1, ("good", "care")),
        (lambda phase: judge_path(phase_rad=phase), 0.05, 0.0501, ("good", "care")),
        (lambda share: judge_path(share=share), 0.5, 0.499, ("good", "none")),
        (lambda level: rules.judge_levels({"H": level}), 0.4, 0.399, ("good", "care")),
        (lambda level: rules.judge_levels({"H": level}), 3.0, 3.01, ("good", "care")),
        (judge_plane, 3.0, 3.01, ("good", "care")),
        (judge_plane, -3.0, -3.01, ("good", "care")),
        (judge_plane, 13.0, 13.01, ("care", "none")),
        (judge_plane, -13.0, -13.01, ("care", "none")),
        (lambda tilt: judge_plane(tilt_deg=(0.0, tilt)), 0.5, 0.501, ("good", "care")),
        (lambda tilt: judge_plane(tilt_deg=(tilt, 0.0)), -0.5, -0.501, ("good", "care")),
        (lambda across: rules.judge_tilts({1: across}), 0.5, 0.501, ("good", "care")),
        (lambda ln: rules.judge_brightness({1: ln}), 0.2, 0.201, ("good", "care")),
        (lambda ln: rules.judge_brightness({1: ln}), -0.2, -0.201, ("good", "care")),
        (lambda mm: rules.judge_image_shift((0.0, mm)), 1.0, 1.01, ("good", "care")),
        (lambda drift_rad: rules.judge_drift(0.0, drift_rad, probability=1.0), 0.035, 0.0351, ("good", "care")),
        (lambda probability: rules.judge_drift(0.0, 0.05, probability), 0.9, 0.901, ("good", "care")),
        (rules.judge_fringes, 0.5, 0.501, ("good", "care")),
        (lambda error: rules.judge_disturbed_plates({1: error}), 0.025, 0.0251, ("good", "care")),
        (rules.judge_moved_boards, 0.9, 0.901, ("good", "care")),
        (rules.judge_halo, 0.005, 0.0051, ("good", "care")),
        (rules.judge_background, 0.04, 0.0401, ("good", "care")),
        (lambda ripple: rules.judge_flatness((ripple, 0.0), 0.0), 0.03, 0.0301, ("good", "care")),
        (lambda relief: rules.judge_flatness((0.0, 0.0), relief), 0.035, 0.0351, ("good", "care")),
        (judge_leakage, 0.0199, 0.02, ("good", "care")),
        (lambda angle: rules.judge_incidence(angle, 55.0), 55.299, 55.301, ("good", "care")),
        (lambda angle: rules.judge_incidence(angle, 55.0), 54.701, 54.699, ("good", "care")),
    ],
)
def test_the_level_changes_at_each_limit(judge, inside, outside, levels):
    level_inside, level_outside = levels
    assert level(judge(inside)) == level_inside
    assert level(judge(outside)) == level_outside


@pytest.mark.parametrize(
    ("reasons", "expected_texts", "absent_text"),
    [
        # Brightness is ln |H|: exp(0.4) = 1.49 and exp(-0.4) = 0.67.
        (rules.judge_brightness({1: 0.4}), ("patch 1 is 49 % brighter",), "darker"),
        (rules.judge_brightness({1: -0.4}), ("patch 1 is 33 % darker",), "brighter"),
        (
            rules.judge_levels({"H": 10.0}),
            ("H: the direct path is weak", "+20 dB", "weakens the direct path"),
            "weaker",
        ),
        (rules.judge_levels({"V": 0.1}), ("V: the direct path is strong", "-20 dB", "weaker than the"), "weakens"),
        (judge_plane(20.0), ("+20 mm",), "-20"),
        (judge_plane(-20.0), ("-20 mm",), "+20"),
        (judge_plane(-4.0), ("-4.0 mm",), "+4"),
        (judge_plane(tilt_deg=(-0.9, 0.2)), ("0.9 degrees",), "0.2"),
        (rules.judge_tilts({1: 0.6, 4: -2.0}), ("patch 4", "-2.0 degrees", "(2 patches in all)"), "patch 1"),
        (rules.judge_tilts({1: 0.6, 4: 0.1}), ("patch 1", "+0.6 degrees"), "in all"),
        (rules.judge_patches({1: "noise", 3: "noise"}, 3), ("patches 1, 3 not judged: noise",), "patch 1"),
        (
            rules.judge_passivity({3: GAIN_FINDING, 5: GAIN_FINDING}),
            ("patches 3, 5 have no permittivity: a gain; leakage",),
            "patch ",
        ),
        (rules.judge_exchange([2, 5], 3), ("H and V may be exchanged: patches 2, 5",), "3"),
        (rules.judge_disturbed_plates({3: 0.2, 1: 0.1, 2: 0.01}), ("within patches 1, 3:", "up to 20 %"), "2,"),
        (judge_rows(1000, 0.25), ("25.0 % of the recorded",), "absent"),
        (judge_path(-3.0), ("RH: the direct path is weak, -3 dB",), "missing"),
        (judge_path(share=0.25), ("missing (25 % of the positions",), "weak"),
    ],
)
def test_a_reason_shows_the_figure_with_its_sign_and_the_patches_concerned(reasons, expected_texts, absent_text):
    (only_reason,) = reasons
    text = f"{only_reason.what}; {only_reason.why}"
    for expected_text in expected_texts:
        assert expected_text in text
    assert absent_text not in text


def test_a_reference_that_may_be_dielectric_is_not_reported_as_painted():
    """`culprit`, the patch that speaks most against metal, is given only if paint does not explain the patches."""
    (doubt,) = judge_metal(is_given=True, culprit=2, painted=1.0, paint_mm=0.1)
    (paint,) = judge_metal(is_given=True, painted=1.0, paint_mm=0.1)
    assert "may not be metal: relative to it, patch 2" in doubt.what
    assert "may be painted" in paint.what


@pytest.mark.parametrize("labels", [[4], [4, 7]])
def test_smears_are_reported_with_their_own_cause_and_advice(labels):
    assert rules.judge_smears({}) == []
    (reason,) = rules.judge_smears(dict.fromkeys(labels, SMEAR))
    assert all(str(label) in reason.what for label in labels)
    assert reason.why == SMEAR.why
    assert reason.do == SMEAR.do


@pytest.mark.parametrize("given", [True, False])
def test_paint_is_reported_of_a_reference_that_a_user_gave_and_of_one_that_the_program_found(given):
    (paint,) = judge_metal(is_likely=True, is_certain=True, is_given=given, painted=0.9, paint_mm=0.1)
    assert "(patch 5) may be painted: probability 0.90, 0.10 mm" in paint.what
    assert judge_metal(is_likely=True, is_certain=True, is_given=given, painted=0.1, paint_mm=0.1) == []


def test_paint_is_reported_on_a_reference_that_is_only_likely_metal_too():
    likely, paint = judge_metal(is_likely=True, painted=0.9, paint_mm=0.1)
    assert "is probably metal, but this is not certain" in likely.what
    assert "(patch 5) may be painted: probability 0.90, 0.10 mm" in paint.what
    (unpainted,) = judge_metal(is_likely=True, painted=0.1, paint_mm=0.1)
    assert unpainted == likely


@pytest.mark.parametrize(("stronger_v", "plates"), [([], 8), ([3], 1), ([1, 2], 4)])
def test_a_single_plate_or_half_of_them_do_not_show_that_h_and_v_are_exchanged(stronger_v, plates):
    """Layers and liquids behind glass may reflect more V than H."""
    assert rules.judge_exchange(stronger_v, plates) == []


def test_reasons_come_from_the_recording_to_the_names():
    """The reason that causes others comes first: without a direct path nothing has a meaning, without metal no
    permittivity has one.
    """
    assert list_in_order(
        judge_path(-20.0),
        rules.judge_patches({}, patches=0),
        judge_metal(contradicted=True),
        judge_plane(20.0),
    ) == ["direct path is missing", "no patch", "no metal", "off the rig"]
    reasons = (
        rules.judge_recording(make_coverage(10, planned=10, faults=("a damaged line",))),
        judge_rows(900),
        judge_rows(1000, 0.2),
        rules.judge_levels({"H": 9.0}),
        judge_path(-3.0),
        judge_metal(is_likely=True),
        judge_path(phase_rad=0.1),
        rules.judge_passivity({1: GAIN_FINDING}),
        rules.judge_patches({1: "noise"}, 2),
        rules.judge_incidence(57.0, 55.0),
        rules.judge_brightness({1: 0.4}),
        judge_plane(4.0),
        judge_leakage(0.1),
        judge_plane(tilt_deg=(1.0, 0.0)),
        rules.judge_tilts({1: 1.0}),
    )
    assert list_in_order(*reasons) == [
        "a damaged",
        "rows are",
        "masked",
        "relative to",
        "is weak, -3",
        "probably metal",
        "residual phase",
        "no permittivity",
        "not judged",
        "incidence angle",
        "brighter",
        "the angle was",
        "leakage",
        "plane is",
        "across",
    ]


# Parts of texts by which the reasons of the test above are recognised.
PARTS = (
    "direct path is missing", "no patch", "no metal", "a damaged", "rows are", "masked", "relative to", "is weak, -3",
    "probably metal", "residual phase", "no permittivity", "not judged", "incidence angle", "brighter", "the angle was",
    "off the rig", "leakage", "plane is", "across",
)  # fmt: skip


def list_in_order(*groups):
    """Return the `PARTS` of the reasons' texts in the order of the verdict, which gets the reasons in reverse order."""
    reversed_reasons = [r for group in reversed(groups) for r in group]
    return [next(part for part in PARTS if part in r.what) for r in join_reasons(reversed_reasons).reasons]


@pytest.mark.parametrize("x", [math.nan, math.inf, -math.inf, 0.0, None])
def test_no_verdict_shows_a_number_that_is_not_finite(x):
    """A quantity that is not known is reported as such, or not judged."""
    number = 0.0 if x is None else x
    reasons = [
        *judge_path(snr_db=x, phase_rad=x),
        *judge_path(snr_db=x, phase_rad=0.2),
        *rules.judge_levels({"H": x, "V": 30.0}),
        *judge_leakage(number),
        *judge_plane(number),
        *judge_plane(1.0, tilt_deg=(number, 0.0)),
        *judge_plane(1.0, tilt_deg=(0.0, number)),
        *judge_plane_not_measured(theta_std_deg=number),
        *rules.judge_tilts({1: number, 2: 3.0}),
        *rules.judge_brightness({1: number, 2: 0.4}),
        *rules.judge_fringes(number),
        *rules.judge_disturbed_plates({1: number, 2: 0.3}),
        *rules.judge_moved_boards(number),
        *row_rules.judge_displaced_rows(number),
        *row_rules.judge_phase_drift(number, number),
        *rules.judge_incidence(number, 55.0),
        *rules.judge_incidence(55.0, x),
        *rules.judge_reconstruction([("RH", 0.3, x)]),
    ]
    # The second patches of a call have a number that is a reason; some of the calls without one give none.
    assert len(reasons) > 4
    text = " ".join(join_reasons(reasons).lines())
    assert not re.search(r"\b(nan|inf)\b", text), text


def test_a_terminal_shows_the_heaviest_reasons_and_how_many_more_there_are():
    verdict = join_reasons(THREE_REASONS)
    assert verdict.lines(1)[1:] == ["  - c: because", "    do: do c", "  - and 2 more, see the report"]
    assert verdict.lines(3) == verdict.lines()
    assert "more" not in "".join(verdict.lines())


@pytest.mark.parametrize(
    ("part", "whole", "digits", "text"),
    [
        (1, 1, 0, "100 %"), (2, 1, 0, "100 %"), (0, 0, 1, "100 %"), (0, 7, 1, "0.0 %"), (1, 3, 2, "33.33 %"),
        (99_999, 100_000, 0, "99 %"), (99_999, 100_000, 1, "99.9 %"), (99_999, 100_000, 2, "99.99 %"),
    ],
)  # fmt: skip
def test_100_percent_is_shown_only_if_nothing_is_missing(part, whole, digits, text):
    assert percent(part, whole, digits) == text


def test_ripple_inside_given_boxes_names_the_edges_before_the_direct_path():
    """Boxes that reach to within 3 mm of the edges of plates contain their ripple: no second path is needed for it."""
    (boxed_finding,) = rules.judge_flatness(RIPPLE, relief_rad=0.0, is_boxed=True)
    assert boxed_finding.why.startswith("boxes that reach the plates' edges")
    assert "6 mm inside" in boxed_finding.do
    (finding,) = rules.judge_flatness(RIPPLE, relief_rad=0.0)
    assert "boxes" not in finding.why


def test_effects_of_positions_without_data_are_explained_by_these():
    """If five of 73 rows have no data, plates look like copies of others by a second path; the rows are the reason."""
    findings_with_gaps = [
        *rules.judge_copies([7, 13], (122.0, 0.0), -12.0, has_gaps=True),
        *rules.judge_fringes(0.9, has_gaps=True),
        *rules.judge_flatness(RIPPLE, relief_rad=0.0, has_gaps=True),
        *rules.judge_disturbed_plates({2: 0.2}, has_gaps=True),
    ]
    assert len(findings_with_gaps) == 4
    (masked,) = rules.judge_recording(make_coverage(73, planned=73), masked_share=0.034)
    for finding in (*findings_with_gaps, masked):
        assert "--sparse" in finding.do
    for finding in findings_with_gaps:
        assert "positions without data" in finding.why
        assert "second path" not in finding.why
        assert finding.weight < masked.weight
    findings_without_gaps = [
        *rules.judge_copies([7, 13], (122.0, 0.0), -12.0),
        *rules.judge_fringes(0.9),
        *rules.judge_flatness(RIPPLE, relief_rad=0.0),
        *rules.judge_disturbed_plates({2: 0.2}),
    ]
    for finding in findings_without_gaps:
        assert "second path" in finding.why
        assert "--sparse" not in finding.do


# A share of 0.03 of the positions is missing, and is reconstructed already or not. With a share of 0.9 too few are left
# to reconstruct the others from.
@pytest.mark.parametrize(
    ("masked", "is_filled", "is_advised"), [(0.03, False, True), (0.03, True, False), (0.9, False, False)]
)
def test_a_reconstruction_is_advised_where_it_would_help(masked, is_filled, is_advised):
    (finding,) = rules.judge_recording(make_coverage(73, planned=73), masked, is_filled)
    assert ("--sparse" in finding.do) is is_advised


# A tilt of 0.8 degrees is 0.3 above the limit of 0.5: it is reported up to a standard deviation of 0.3.
@pytest.mark.parametrize(("std_deg", "is_reported"), [(0.0, True), (0.29, True), (0.31, False)])
def test_a_tilt_of_the_plane_beyond_its_standard_deviation_is_reported(std_deg, is_reported):
    reasons = judge_plane(tilt_deg=(0.1, -0.8), tilt_std_deg=(0.0, std_deg))
    assert bool(reasons) is is_reported


def test_fringes_are_explained_by_the_background_where_it_disturbs_the_plates():
    """The reason that names the table behind the plates comes first; the fringes that it makes are no second path."""
    (fringes,) = rules.judge_fringes(0.9, behind=0.15)
    (behind,) = rules.judge_background(0.15)
    assert "behind the plates" in fringes.why
    assert fringes.weight < behind.weight


def test_a_jump_of_both_boards_alike_is_reported_once_and_not_explained_by_a_cable():
    """0.41 rad are 23 degrees. Jumps of the boards that differ are reported for each board."""
    findings = row_rules.judge_phase_jumps({"RH": [PhaseJump(26, 0.41)], "RV": [PhaseJump(26, 0.38)]})
    assert [r.what for r in findings] == [
        "the phase of the echo jumps by +23 degrees before row 26 in both boards equally"
    ]
    assert "a cable of one board cannot" in findings[0].why
    findings_of_boards = row_rules.judge_phase_jumps(
        {"RH": [PhaseJump(26, 0.41)], "RV": [PhaseJump(26, -0.38), PhaseJump(40, 0.3)]}
    )
    assert [r.what.split(":")[0] for r in findings_of_boards] == ["RH", "RV"]


def test_displaced_images_after_a_drift_of_the_phase_are_not_explained_by_displaced_boards():
    (finding,) = rules.judge_image_shift((0.1, 1.5), has_drift=True)
    assert "boards are out of place" not in finding.why
    assert "drift" in finding.why
