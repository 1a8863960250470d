"""The model of a library, several incidence angles together, and the command `polysight classify`."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.cli.main import main
from polysight.materials import UNKNOWN, Classifier, Library, TrainingScan, fit_library
from polysight.materials.classify import DISCRIMINANT_MODEL, MODELS, PAPER_MODEL, describe_classifier
from polysight.materials.result import PATCHES_FILE, match_patches, pack_patches, read_patches
from polysight.materials.train import make_entries
from polysight_papers.sensys2026.patches import Errors, draw, groups
from polysight_shared.errors import ErrorCode

ANGLES = (55.0, 60.0)


@pytest.fixture(scope="module")
def powders():
    """A fitted library of four materials under two angles, drawn pixel by pixel."""
    drawn = [draw(groups()["powders"].materials, a, Errors(0.03, 0.05), 3, 4, 6).library() for a in ANGLES]
    entries = [replace(e, scan=f"{e.scan} at {e.incidence_deg:g}") for lib in drawn for e in lib.entries]
    return fit_library(Library(tuple(entries), {}, "drawn"))


@pytest.fixture(scope="module")
def two_angles(synthetic, analyse_placement):
    """Nine plates under both angles: a library of two placements, and the patches file of one to name, by angle."""
    entries = [
        entry
        for angle in ANGLES
        for seed in range(1000, 1002)
        for entry in make_entries(TrainingScan(f"{angle:g}-{seed}", analyse_placement(seed, angle), True))
    ]
    scene = synthetic(1)
    packed = {
        angle: pack_patches(analyse_placement(1, angle), scene.x_m, scene.y_m, simulated=True) for angle in ANGLES
    }
    return Library(tuple(entries)), packed


@pytest.fixture
def folders(two_angles, tmp_path):
    """Those files of `polysight process` for the two scans that naming needs."""
    library, packed = two_angles
    library.save(tmp_path / "library.npz")
    for angle, content in packed.items():
        (tmp_path / f"{angle:g}").mkdir()
        (tmp_path / f"{angle:g}" / PATCHES_FILE).write_bytes(content)
    return tmp_path


@pytest.fixture
def scans(folders):
    """The patches of the two scans, in the order of the angles."""
    return [read_patches(folders / f"{angle:g}" / PATCHES_FILE) for angle in ANGLES]


def test_models_are_judged_for_each_angle_and_for_both_and_the_one_with_probabilities_names(powders, tmp_path):
    powders.save(tmp_path / "powders.npz")
    library = Library.load(tmp_path / "powders.npz")
    assert set(library.fit["angles"]) == {"55", "60", "55+60"}
    for fit in library.fit["angles"].values():
        assert fit["model"] == DISCRIMINANT_MODEL
        assert set(fit["judged"]) == set(MODELS)
        assert 0 <= fit["calibration_error"] < 0.2
        assert fit["pixel_accuracy"] == fit["judged"][fit["model"]]["pixels"]
        assert "4 scans" in fit["split"]
    for angles in ((55.0,), (60.0,), ANGLES):
        fit = library.fit_for(angles)
        classifier = Classifier(library, angles_deg=angles)
        assert classifier.model == fit["model"]
        answer = describe_classifier(classifier)
        assert fit["model"] in answer
        assert f"{100 * fit['pixel_accuracy']:.1f} % of the pixels" in answer
        assert "optimistic" in answer
        assert "simulated" in answer


def test_two_scans_are_enough_to_learn_from():
    drawn = draw(groups()["powders"].materials, 60.0, Errors(0.003, 0.005), 3, scans=2, pixels=6)
    library = fit_library(drawn.library())
    assert library.fit_for([60.0])["pixel_accuracy"] > 0.8
    named = Classifier(library).scan([s.x for s in [drawn.samples().take(drawn.samples().patches == 1)]])
    assert named[0].patch_name.name == drawn.materials[1].name


def test_another_model_can_be_chosen_and_the_report_names_it(powders):
    knn = Classifier(powders, model="knn", angles_deg=[60.0])
    assert knn.model == PAPER_MODEL
    assert describe_classifier(knn).startswith(PAPER_MODEL)
    earlier = Classifier(powders, model="linear discriminant", angles_deg=[60.0])
    assert earlier.model == DISCRIMINANT_MODEL
    with expect_refusal(ErrorCode.VALUE_INVALID, "guess"):
        Classifier(powders, model="guess", angles_deg=[60.0])


def test_an_angle_the_library_does_not_hold_is_refused(powders):
    with expect_refusal(ErrorCode.MISMATCH, "50.0"):
        Classifier(powders, angles_deg=[50.0])
    with expect_refusal(ErrorCode.KEY_MISSING, "55, 60"):
        Classifier(powders)


def test_angles_up_to_a_degree_apart_are_one(powders):
    entries = [replace(powders.entries[0], incidence_deg=angle) for angle in (55.0, 56.0, 57.1)]
    library = Library(tuple(entries), {}, "drawn")
    assert library.angles_deg == (55.5, 57.1)
    assert library.at_angle(54.5).entries == tuple(entries[:2])


@pytest.mark.parametrize("model", ["knn", "discriminant"])
def test_patches_under_two_angles_are_named_together(two_angles, scans, model):
    matched = match_patches(scans)
    assert len(matched) == 9
    named = Classifier(two_angles[0], model=model, angles_deg=ANGLES).scan([m.features for m in matched])
    assert sum(n.patch_name.name == m.truth for n, m in zip(named, matched, strict=True)) >= 8
    for n in named:
        assert 0 < n.patch_name.confidence <= 1
        assert sum(n.patch_name.votes.values()) == pytest.approx(1)


def test_patches_match_by_place_alone(scans):
    second_scan = scans[1]
    reordered = replace(second_scan, patches=second_scan.patches[::-1])
    assert [m.label for m in match_patches([scans[0], reordered])] == [m.label for m in match_patches(scans)]
    moved_scan = replace(
        second_scan, patches=tuple(replace(p, centre_mm=(p.centre_mm[0] + 300, 0.0)) for p in second_scan.patches)
    )
    assert match_patches([scans[0], moved_scan]) == []
    without = replace(second_scan, patches=second_scan.patches[1:])
    assert len(match_patches([scans[0], without])) == 8


def test_a_pixel_that_cannot_be_used_is_unknown_and_an_empty_patch_too(two_angles, scans):
    classifier = Classifier(two_angles[0], model="discriminant", angles_deg=[55.0])
    x = scans[0].patches[0].features.copy()
    x[0, 2] = np.nan
    broken, empty, all_nan = classifier.scan([x, np.zeros((0, 4)), np.full((2, 4), np.nan)])
    assert broken.pixel_names[0] == UNKNOWN
    assert np.isinf(broken.distance[0])
    assert broken.patch_name.pixels == len(x) - 1
    assert empty.patch_name.name == all_nan.patch_name.name == UNKNOWN
    assert all_nan.pixel_names.tolist() == [UNKNOWN] * 2


def test_two_scans_as_typed(folders, capsys):
    arguments = ["classify", str(folders / "55"), str(folders / "60"), "--library", str(folders / "library.npz")]
    assert main([*arguments, "--model", "discriminant", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["source"] == "simulated"
    assert answer["incidence_deg"] == pytest.approx(ANGLES)
    assert answer["model"] == DISCRIMINANT_MODEL
    assert sum(p["name"] == p["truth"] for p in answer["patches"]) >= 8
    assert main([*arguments, "--model", "knn"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("simulated: 9 patches at 55.0 and 60.0 degrees")
    assert "of 9 patches named right" in out
    assert PAPER_MODEL in out


def test_patches_exchanged_between_two_angles_are_reported(folders, scans, capsys):
    second_scan = scans[1]
    angle = "60"
    truths = {"wood": "ceramic", "ceramic": "wood"}
    patch_by_truth = {p.truth: p for p in second_scan.patches}
    swap = {
        a: b
        for a in patch_by_truth
        for key, other_truth in truths.items()
        if a and key in a
        for b in patch_by_truth
        if b and other_truth in b
    }
    assert len(swap) == 2
    with np.load(folders / angle / PATCHES_FILE) as stored:
        content = dict(stored)
    features = content["features"].copy()
    first = np.cumsum([0, *[len(p.features) for p in second_scan.patches]])
    rows_of_patch = {p.truth: np.arange(first[i], first[i + 1]) for i, p in enumerate(second_scan.patches)}
    first_truth, other_truth = swap
    middle = {name: np.median(features[rows_of_patch[name]], axis=0) for name in swap}
    features[rows_of_patch[first_truth]] = middle[other_truth]
    features[rows_of_patch[other_truth]] = middle[first_truth]
    content["features"] = features
    np.savez(folders / angle / PATCHES_FILE, **content)
    command = ["classify", str(folders / "55"), str(folders / angle), "--library", str(folders / "library.npz")]
    assert main([*command, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    unknown = [p for p in answer["patches"] if p["truth"] in swap]
    assert [p["name"] for p in unknown] == ["unknown", "unknown"]
    assert len(answer["contradictions"]) == 2
    assert main(command) == 0
    assert capsys.readouterr().out.count("contradicts itself") == 2


def test_one_scan_and_wrong_folders_as_typed(folders, capsys):
    library = ["--library", str(folders / "library.npz")]
    assert main(["classify", str(folders / "60"), *library]) == 0
    assert "9 patches at 60.0 degrees" in capsys.readouterr().out
    assert main(["classify", str(folders / "60"), str(folders), *library]) != 0
    assert "polysight process" in capsys.readouterr().err
    (folders / "60" / PATCHES_FILE).write_bytes(b"no archive")
    assert main(["classify", str(folders / "60"), *library]) != 0
    assert PATCHES_FILE in capsys.readouterr().err


def test_the_discriminant_starts_without_scikit_learn(powders, tmp_path):
    """It takes a second or two to load, and is loaded only when it is used."""
    powders.save(tmp_path / "l.npz")
    code = (
        "import sys; from pathlib import Path; from polysight.materials import Classifier, Library;"
        f"Classifier(Library.load(Path({str(tmp_path / 'l.npz')!r})), model='discriminant', angles_deg=[55.0]);"
        "sys.exit('sklearn' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
