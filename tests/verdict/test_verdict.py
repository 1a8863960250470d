"""The verdict: the worst reason decides, reasons come in order of weight, and JSON gives back what was written."""

import itertools
import math
import re

import pytest

from polysight.results.verdict import (
    Coverage,
    NoResult,
    Verdict,
    apart_reasons,
    background_reasons,
    brightness_reasons,
    dark_reference_reasons,
    direct_path_reasons,
    disturbance_reasons,
    disturbed_reasons,
    drift_reasons,
    fit_reasons,
    fringe_reasons,
    halo_reasons,
    incidence_reasons,
    join_reasons,
    leakage_reasons,
    level_reasons,
    metal_reasons,
    moved_reasons,
    passivity_reasons,
    percent,
    plane_reasons,
    read_verdict,
    reason,
    reconstruction_reasons,
    recording_reasons,
    signal_reasons,
    tilt_reasons,
)
from polysight_shared.findings import Finding

GAINS = Finding("error", "a gain", "leakage", "measure it")
ALL = [
    reason("care", "a", "because", "do a", 1.0),
    reason("care", "b", "because", "do b", 3.0),
    reason("none", "c", "because", "do c", 0.1),
]


@pytest.mark.parametrize("order", list(itertools.permutations(ALL)))
def test_the_worst_reason_decides_and_weight_orders(order):
    verdict = join_reasons(order)
    assert verdict.level == "none"
    assert [r.what for r in verdict.reasons] == ["c", "b", "a"]
    assert join_reasons(r for r in order if r.level == "warning").level == "care"


def test_only_no_result_hides_names_and_permittivities():
    assert [join_reasons(ALL[:n]).usable for n in range(4)] == [True, True, True, False]


def test_without_reasons_all_is_good():
    assert join_reasons([]) == Verdict("good")
    assert join_reasons([]).lines() == ["verdict:  good"]


def test_json_gives_back_what_was_written():
    verdict = join_reasons(ALL)
    content = {"verdict": verdict.to_dict(), "other": 1}
    again = read_verdict(content)
    assert again is not None
    assert again.to_dict() == verdict.to_dict()
    assert all(set(r) == {"what", "why", "do"} for r in content["verdict"]["reasons"])


@pytest.mark.parametrize("content", [{}, {"verdict": 1}, {"verdict": {"level": "perfect"}}, {"verdict": {"level": []}}])
def test_content_without_a_known_level_has_no_verdict(content):
    assert read_verdict(content) is None


@pytest.mark.parametrize("reasons", [None, 3, "noise", {"what": "x"}, [1, None]])
def test_damaged_reasons_are_left_out(reasons):
    assert read_verdict({"verdict": {"level": "care", "reasons": reasons}}) == Verdict("care")


def test_no_result_has_an_exit_status_of_its_own():
    error = join_reasons(ALL).error("the images are kept")
    assert isinstance(error, NoResult)
    assert error.exit_status == 7
    assert "c" in error.what
    assert "the images are kept" in error.remedy


def level(reasons):
    return join_reasons(reasons).level


@pytest.mark.parametrize(
    ("likely", "certain", "given", "contradicted", "only_patch", "want"),
    [
        (True, True, False, False, False, "good"),
        (True, False, False, False, False, "care"),
        (False, False, False, True, False, "none"),
        (False, False, False, False, True, "none"),
        (False, False, True, False, True, "good"),
        (False, False, True, True, True, "care"),
        (False, False, True, True, False, "none"),
    ],
)
def test_metal_is_never_judged_by_itself(likely, certain, given, contradicted, only_patch, want):
    assert level(metal_reasons("patch 3", likely, certain, given, contradicted, only_patch)) == want


def test_evidence_without_a_limit_has_its_level():
    assert level(signal_reasons({}, 0)) == "none"
    assert level(signal_reasons({1: "noise"}, 1)) == "none"
    assert level(signal_reasons({1: "noise"}, 2)) == "care"
    assert level(leakage_reasons(True, False, 0.5)) == "good"
    assert level(plane_reasons(False, 0.0, (0.0, 0.0), 0.3)) == "care"
    assert level(recording_reasons(Coverage(27, 27, 2700, 2700, ("line 6: damaged",)), 0.0)) == "care"


def test_what_is_not_known_is_not_held_against_a_result():
    assert level(direct_path_reasons("RH", None, None, 1.0)) == "good"
    assert level(level_reasons({"H": None})) == "good"


def test_every_reason_says_what_why_and_what_to_do():
    reasons = [
        *recording_reasons(Coverage(9, 5, 900, 400, ("x",)), 0.3),
        *direct_path_reasons("RH", -20.0, None, 1.0),
        *direct_path_reasons("RH", -6.0, 0.3, 1.0),
        *signal_reasons({1: "noise"}, 2),
        *signal_reasons({}, 0),
        *metal_reasons("patch 1", False, False, False, True, False),
        *metal_reasons("patch 1", False, False, True, True, False),
        *metal_reasons("patch 1", True, False, False, False, False),
        *leakage_reasons(False, True, 0.1),
        *plane_reasons(False, 0.0, (0.0, 0.0), 0.3),
        *plane_reasons(True, 14.0, (0.0, 0.0), 0.3),
        *plane_reasons(True, 9.0, (0.9, 0.0), 0.3),
        *level_reasons({"H": 9.0, "V": 0.1}),
        *incidence_reasons(57.0, 54.9),
        *tilt_reasons({1: 1.0, 4: -2.0}),
        *brightness_reasons({1: 0.4, 4: -0.4}),
        *apart_reasons((3.0, -1.0)),
        *drift_reasons(0.1, 0.05),
        *halo_reasons(0.02),
        *background_reasons(0.1),
        *fit_reasons((0.1, 0.05), 0.0),
        *fit_reasons((0.1, 0.05), 0.1),
        *fringe_reasons(0.9),
        *disturbed_reasons({2: 0.2}),
        *moved_reasons(1.0),
    ]
    assert len(reasons) >= 24
    for r in reasons:
        assert all((r.what, r.why, r.do))
        assert not any(text.endswith(".") for text in (r.what, r.do))


def rows(recorded, masked=0.0):
    return recording_reasons(Coverage(1000, recorded, 1000, recorded), masked)


def path(snr_db=5.5, phase_rad=0.004, share=1.0):
    return direct_path_reasons("RH", snr_db, phase_rad, share)


def plane(offset_mm=0.0, tilt_deg=(0.0, 0.0)):
    return plane_reasons(True, offset_mm, tilt_deg, 0.1)


@pytest.mark.parametrize(
    ("judge", "inside", "outside", "levels"),
    [
        (rows, 1000, 999, ("good", "care")),
        (rows, 500, 499, ("care", "none")),
        (lambda masked: rows(1000, masked), 0.005, 0.0051, ("good", "care")),
        (lambda masked: rows(1000, masked), 0.5, 0.501, ("care", "none")),
        (path, 0.0, -0.01, ("good", "care")),
        (path, -14.0, -14.01, ("care", "none")),
        (lambda clipped: disturbance_reasons("RH", clipped, 0.0, 0.0), 0.05, 0.051, ("good", "care")),
        (lambda disturbed: disturbance_reasons("RH", 0.0, disturbed, 0.0), 0.05, 0.051, ("good", "care")),
        (lambda positions: disturbance_reasons("RH", 0.01, 0.0, positions), 0.005, 0.0051, ("good", "care")),
        (lambda db: dark_reference_reasons("the given box", 4, db), 5.9, 6.1, ("good", "care")),
        (lambda phase: path(phase_rad=phase), 0.05, 0.0501, ("good", "care")),
        (lambda share: path(share=share), 0.5, 0.499, ("good", "none")),
        (lambda level: level_reasons({"H": level}), 0.4, 0.399, ("good", "care")),
        (lambda level: level_reasons({"H": level}), 3.0, 3.01, ("good", "care")),
        (plane, 3.0, 3.01, ("good", "care")),
        (plane, -3.0, -3.01, ("good", "care")),
        (plane, 13.0, 13.01, ("care", "none")),
        (plane, -13.0, -13.01, ("care", "none")),
        (lambda tilt: plane(0.0, (0.0, tilt)), 0.5, 0.501, ("good", "care")),
        (lambda tilt: plane(0.0, (tilt, 0.0)), -0.5, -0.501, ("good", "care")),
        (lambda across: tilt_reasons({1: across}), 0.5, 0.501, ("good", "care")),
        (lambda ln: brightness_reasons({1: ln}), 0.2, 0.201, ("good", "care")),
        (lambda ln: brightness_reasons({1: ln}), -0.2, -0.201, ("good", "care")),
        (lambda mm: apart_reasons((0.0, mm)), 1.0, 1.01, ("good", "care")),
        (lambda drift: drift_reasons(0.0, drift), 0.035, 0.0351, ("good", "care")),
        (fringe_reasons, 0.5, 0.501, ("good", "care")),
        (lambda error: disturbed_reasons({1: error}), 0.05, 0.051, ("good", "care")),
        (moved_reasons, 0.5, 0.501, ("good", "care")),
        (halo_reasons, 0.005, 0.0051, ("good", "care")),
        (background_reasons, 0.04, 0.0401, ("good", "care")),
        (lambda ripple: fit_reasons((ripple, 0.0), 0.0), 0.03, 0.0301, ("good", "care")),
        (lambda relief: fit_reasons((0.0, 0.0), relief), 0.035, 0.0351, ("good", "care")),
        (lambda error: leakage_reasons(False, False, error), 0.0199, 0.02, ("good", "care")),
        (lambda angle: incidence_reasons(angle, 55.0), 55.299, 55.301, ("good", "care")),
        (lambda angle: incidence_reasons(angle, 55.0), 54.701, 54.699, ("good", "care")),
    ],
)
def test_each_limit_just_inside_and_just_outside(judge, inside, outside, levels):
    assert (level(judge(inside)), level(judge(outside))) == levels


@pytest.mark.parametrize(
    ("reasons", "said", "never"),
    [
        (brightness_reasons({1: 0.4}), ("patch 1 is 49 % brighter",), "darker"),
        (brightness_reasons({1: -0.4}), ("patch 1 is 33 % darker",), "brighter"),
        (level_reasons({"H": 10.0}), ("H: the direct path is weak", "+20 dB", "weakens the direct path"), "weaker"),
        (level_reasons({"V": 0.1}), ("V: the direct path is strong", "-20 dB", "weaker than the"), "weakens"),
        (plane(20.0), ("+20 mm",), "-20"),
        (plane(-20.0), ("-20 mm",), "+20"),
        (plane(-4.0), ("-4.0 mm",), "+4"),
        (plane(0.0, (-0.9, 0.2)), ("0.9 degrees",), "0.2"),
        (tilt_reasons({1: 0.6, 4: -2.0}), ("patch 4", "-2.0 degrees", "(2 patches in all)"), "patch 1"),
        (tilt_reasons({1: 0.6, 4: 0.1}), ("patch 1", "+0.6 degrees"), "in all"),
        (signal_reasons({1: "noise", 3: "noise"}, 3), ("patches 1, 3 not judged: noise",), "patch 1"),
        (passivity_reasons({3: GAINS, 5: GAINS}), ("patches 3, 5 have no permittivity: a gain; leakage",), "patch "),
        (disturbed_reasons({3: 0.2, 1: 0.1, 2: 0.01}), ("within patches 1, 3,", "up to 20 %"), "2,"),
        (rows(1000, 0.25), ("25.0 % of the recorded",), "absent"),
        (path(-3.0), ("RH: the direct path is weak, -3 dB",), "missing"),
        (path(share=0.25), ("missing (25 % of the positions",), "weak"),
    ],
)
def test_a_reason_shows_the_figure_with_its_sign_and_the_patches_concerned(reasons, said, never):
    (only_reason,) = reasons
    text = f"{only_reason.what}; {only_reason.why}"
    assert all(part in text for part in said), text
    assert never not in text, text


def test_reasons_come_from_the_recording_to_the_names():
    """The cause of the others first: without a direct path all is meaningless, without metal every permittivity."""
    assert order(
        path(-20.0), signal_reasons({}, 0), metal_reasons("metal", False, False, False, True, False), plane(20.0)
    ) == ["direct path is missing", "no patch", "no metal", "off the rig"]
    reasons = (
        recording_reasons(Coverage(10, 10, 10, 10, ("a damaged line",))),
        rows(900),
        rows(1000, 0.2),
        level_reasons({"H": 9.0}),
        path(-3.0),
        metal_reasons("metal", True, False, False, False, False),
        path(phase_rad=0.1),
        passivity_reasons({1: GAINS}),
        signal_reasons({1: "noise"}, 2),
        incidence_reasons(57.0, 55.0),
        brightness_reasons({1: 0.4}),
        plane(4.0),
        leakage_reasons(False, False, 0.1),
        plane(0.0, (1.0, 0.0)),
        tilt_reasons({1: 1.0}),
    )
    assert order(*reasons) == [
        "a damaged",
        "rows are",
        "masked",
        "relative to",
        "is weak, -3",
        "likely metal",
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


PARTS = (
    "direct path is missing", "no patch", "no metal", "a damaged", "rows are", "masked", "relative to", "is weak, -3",
    "likely metal", "residual phase", "no permittivity", "not judged", "incidence angle", "brighter", "the angle was",
    "off the rig", "leakage", "plane is", "across",
)  # fmt: skip


def order(*reasons):
    """Parts of the reasons' texts as the verdict lists them, given in reverse."""
    listed = join_reasons([r for group in reversed(reasons) for r in group]).reasons
    return [next(part for part in PARTS if part in r.what) for r in listed]


STRANGE = (math.nan, math.inf, -math.inf, 0.0, None)


@pytest.mark.parametrize("x", STRANGE)
def test_no_verdict_shows_a_number_that_is_none(x):
    """Each rule with a figure that is not finite: what is not known is said so, or not judged."""
    number = 0.0 if x is None else x
    reasons = [
        *direct_path_reasons("RH", x, x, 1.0),
        *direct_path_reasons("RH", x, 0.2, 1.0),
        *level_reasons({"H": x, "V": 30.0}),
        *leakage_reasons(False, False, number),
        *plane_reasons(True, number, (0.0, 0.0), 0.1),
        *plane_reasons(True, 1.0, (number, 0.0), 0.1),
        *plane_reasons(True, 1.0, (0.0, number), 0.1),
        *plane_reasons(False, 1.0, (0.0, 0.0), number),
        *tilt_reasons({1: number, 2: 3.0}),
        *brightness_reasons({1: number, 2: 0.4}),
        *fringe_reasons(number),
        *disturbed_reasons({1: number, 2: 0.3}),
        *moved_reasons(number),
        *incidence_reasons(number, 55.0),
        *incidence_reasons(55.0, x),
        *reconstruction_reasons([("RH", 0.3, x)]),
    ]
    assert len(reasons) > 4
    text = " ".join(join_reasons(reasons).lines())
    assert not re.search(r"\b(nan|inf)\b", text), text


def test_a_terminal_shows_the_heaviest_reasons_and_how_many_more_there_are():
    assert join_reasons(ALL).lines(1)[1:] == ["  - c: because", "    do: do c", "  - and 2 more, see the report"]
    assert join_reasons(ALL).lines(3) == join_reasons(ALL).lines()
    assert "more" not in "".join(join_reasons(ALL).lines())


@pytest.mark.parametrize(
    ("part", "whole", "digits", "shown"),
    [
        (1, 1, 0, "100 %"), (2, 1, 0, "100 %"), (0, 0, 1, "100 %"), (0, 7, 1, "0.0 %"), (1, 3, 2, "33.33 %"),
        (99_999, 100_000, 0, "99 %"), (99_999, 100_000, 1, "99.9 %"), (99_999, 100_000, 2, "99.99 %"),
    ],
)  # fmt: skip
def test_100_percent_is_shown_only_if_nothing_is_missing(part, whole, digits, shown):
    assert percent(part, whole, digits) == shown
