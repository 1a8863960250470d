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
from polysight.materials.patch_files import PATCHES_FILE, match_patches, pack_patches, read_patches
from polysight.materials.train import make_entries
from polysight_papers.sensys2026.patches import Errors, draw, groups
from polysight_shared.errors import ErrorCode

ANGLES = (55.0, 60.0)


@pytest.fixture(scope="module")
def powders():
    """A fitted library of four materials under two angles, drawn pixel by pixel."""
    materials = groups()["powders"].materials
    errors = Errors(amplitude=0.03, phase_rad=0.05)
    entries = []
    for angle in ANGLES:
        drawn = draw(materials, angle, errors, seed=3, scans=4, pixels=6).library()
        # A scan has one angle: those of the second angle get names of their own.
        entries += [replace(entry, scan=f"{entry.scan} at {entry.incidence_deg:g}") for entry in drawn.entries]
    return fit_library(Library(tuple(entries), {}, "drawn"))


@pytest.fixture(scope="module")
def two_angles(synthetic, analyse_placement):
    """Return a library of nine plates in two placements under both angles, and a third placement's patches by angle."""
    entries = []
    for angle in ANGLES:
        for seed in (1000, 1001):
            scan = TrainingScan(f"{angle:g}-{seed}", analyse_placement(seed, angle), simulated=True)
            entries += make_entries(scan)
    scene = synthetic(seed=1)
    packed_patches = {}
    for angle in ANGLES:
        result = analyse_placement(1, angle)
        packed_patches[angle] = pack_patches(result, scene.x_m, scene.y_m, simulated=True)
    return Library(tuple(entries)), packed_patches


@pytest.fixture
def folders(two_angles, tmp_path):
    """Folder with library.npz and, for each angle, the file of `polysight process` that naming needs."""
    library, packed_patches = two_angles
    library.save(tmp_path / "library.npz")
    for angle, content in packed_patches.items():
        (tmp_path / f"{angle:g}").mkdir()
        (tmp_path / f"{angle:g}" / PATCHES_FILE).write_bytes(content)
    return tmp_path


@pytest.fixture
def scans(folders):
    """The patches of the two scans, in the order of the angles."""
    return [read_patches(folders / f"{angle:g}" / PATCHES_FILE) for angle in ANGLES]


def test_models_are_judged_for_each_angle_and_for_both_and_the_discriminant_is_used(powders, tmp_path):
    powders.save(tmp_path / "powders.npz")
    library = Library.load(tmp_path / "powders.npz")
    assert set(library.fit["angles"]) == {"55", "60", "55+60"}
    for fit in library.fit["angles"].values():
        assert fit["model"] == DISCRIMINANT_MODEL
        assert set(fit["judged"]) == set(MODELS)
        # Mean difference of confidence and share of right names. Four scans of four materials are 16 patches, of which
        # a share has an error of up to sqrt(0.25 / 16) = 0.125. The largest difference is 0.15.
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
    errors = Errors(amplitude=0.003, phase_rad=0.005)
    drawn = draw(groups()["powders"].materials, 60.0, errors, seed=3, scans=2, pixels=6)
    library = fit_library(drawn.library())
    # Four materials: chance is 0.25. The pixel accuracy is 0.98.
    assert library.fit_for([60.0])["pixel_accuracy"] > 0.8
    # Patches are numbered like the materials.
    pixels = drawn.samples()
    pixels_of_second_patch = pixels.take(pixels.patches == 1)
    (named,) = Classifier(library).scan([pixels_of_second_patch.x])
    assert named.patch_name.name == drawn.materials[1].name


def test_another_model_can_be_chosen_and_the_report_names_it(powders):
    knn = Classifier(powders, model="knn", angles_deg=[60.0])
    assert knn.model == PAPER_MODEL
    assert describe_classifier(knn).startswith(PAPER_MODEL)
    # The name of the discriminant in libraries of earlier releases.
    of_earlier_release = Classifier(powders, model="linear discriminant", angles_deg=[60.0])
    assert of_earlier_release.model == DISCRIMINANT_MODEL
    with expect_refusal(ErrorCode.VALUE_INVALID, "guess"):
        Classifier(powders, model="guess", angles_deg=[60.0])


def test_an_angle_the_library_does_not_hold_is_refused(powders):
    with expect_refusal(ErrorCode.MISMATCH, "50.0"):
        Classifier(powders, angles_deg=[50.0])
    with expect_refusal(ErrorCode.KEY_MISSING, "55, 60"):
        Classifier(powders)


def test_scans_whose_angles_differ_by_up_to_a_degree_are_of_one_angle(powders):
    """The angle of a group is the mean of its scans' angles: 55 and 56 are one group, 57.1 is another."""
    entries = [replace(powders.entries[0], incidence_deg=angle) for angle in (55.0, 56.0, 57.1)]
    library = Library(tuple(entries), {}, "drawn")
    assert library.angles_deg == (55.5, 57.1)
    assert library.at_angle(54.5).entries == tuple(entries[:2])


@pytest.mark.parametrize("model", ["knn", "discriminant"])
def test_patches_under_two_angles_are_named_together(two_angles, scans, model):
    matched = match_patches(scans)
    assert len(matched) == 9
    library, _ = two_angles
    named = Classifier(library, model=model, angles_deg=ANGLES).scan([m.features for m in matched])
    is_right = [patch.patch_name.name == match.truth for patch, match in zip(named, matched, strict=True)]
    # The nearest neighbours name all nine right, the discriminant eight.
    assert sum(is_right) >= 8
    for patch in named:
        assert 0 < patch.patch_name.confidence <= 1
        assert sum(patch.patch_name.votes.values()) == pytest.approx(1)


def test_patches_of_two_scans_are_paired_by_their_places_alone(scans):
    second_scan = scans[1]
    reordered = replace(second_scan, patches=second_scan.patches[::-1])
    assert [m.label for m in match_patches([scans[0], reordered])] == [m.label for m in match_patches(scans)]
    # 300 mm is the width of the whole image.
    moved_patches = tuple(replace(p, centre_mm=(p.centre_mm[0] + 300, 0.0)) for p in second_scan.patches)
    assert match_patches([scans[0], replace(second_scan, patches=moved_patches)]) == []
    scan_without_first_patch = replace(second_scan, patches=second_scan.patches[1:])
    assert len(match_patches([scans[0], scan_without_first_patch])) == 8


def test_a_pixel_that_is_not_finite_is_unknown_and_so_is_a_patch_without_usable_pixels(two_angles, scans):
    library, _ = two_angles
    classifier = Classifier(library, model="discriminant", angles_deg=[55.0])
    features = scans[0].patches[0].features.copy()
    features[0, 2] = np.nan
    first_is_nan, empty, all_nan = classifier.scan([features, np.zeros((0, 4)), np.full((2, 4), np.nan)])
    assert first_is_nan.pixel_names[0] == UNKNOWN
    assert np.isinf(first_is_nan.distance[0])
    assert first_is_nan.patch_name.pixels == len(features) - 1
    assert empty.patch_name.name == all_nan.patch_name.name == UNKNOWN
    assert all_nan.pixel_names.tolist() == [UNKNOWN] * 2


def test_the_command_names_the_patches_of_two_scans(folders, capsys):
    arguments = ["classify", str(folders / "55"), str(folders / "60"), "--library", str(folders / "library.npz")]
    assert main([*arguments, "--model", "discriminant", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["source"] == "simulated"
    assert answer["incidence_deg"] == pytest.approx(ANGLES)
    assert answer["model"] == DISCRIMINANT_MODEL
    # All of the nine patches but one are named right, as above.
    is_right = [p["name"] == p["truth"] for p in answer["patches"]]
    assert sum(is_right) >= 8
    assert main([*arguments, "--model", "knn"]) == 0
    out = capsys.readouterr().out
    assert out.startswith("simulated: 9 patches at 55.0 and 60.0 degrees")
    assert "of 9 patches named right" in out
    assert PAPER_MODEL in out


def test_patches_exchanged_between_two_angles_are_reported(folders, scans, capsys):
    """Wood and ceramic have exchanged their places before the second scan: no material fits both angles."""
    path = folders / "60" / PATCHES_FILE
    with np.load(path) as stored:
        content = dict(stored)
    features = content["features"].copy()

    # The file has the pixels of all patches one after the other.
    rows_by_truth = {}
    first_row = 0
    for patch in scans[1].patches:
        rows_by_truth[patch.truth] = slice(first_row, first_row + len(patch.features))
        first_row += len(patch.features)
    wood_rows = rows_by_truth["wood (thin)"]
    ceramic_rows = rows_by_truth["ceramic"]

    # The patches differ in their number of pixels: every pixel gets the median of the other patch.
    wood_median = np.median(features[wood_rows], axis=0)
    ceramic_median = np.median(features[ceramic_rows], axis=0)
    features[wood_rows] = ceramic_median
    features[ceramic_rows] = wood_median
    content["features"] = features
    np.savez(path, **content)

    command = ["classify", str(folders / "55"), str(folders / "60"), "--library", str(folders / "library.npz")]
    assert main([*command, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    exchanged = [p for p in answer["patches"] if p["truth"] in ("wood (thin)", "ceramic")]
    assert [p["name"] for p in exchanged] == ["unknown", "unknown"]
    assert len(answer["contradictions"]) == 2
    assert main(command) == 0
    assert capsys.readouterr().out.count("contradicts itself") == 2


def test_the_command_names_one_scan_and_refuses_folders_without_processed_patches(folders, capsys):
    library = ["--library", str(folders / "library.npz")]
    assert main(["classify", str(folders / "60"), *library]) == 0
    assert "9 patches at 60.0 degrees" in capsys.readouterr().out
    assert main(["classify", str(folders / "60"), str(folders), *library]) != 0
    assert "polysight process" in capsys.readouterr().err
    (folders / "60" / PATCHES_FILE).write_bytes(b"no archive")
    assert main(["classify", str(folders / "60"), *library]) != 0
    assert PATCHES_FILE in capsys.readouterr().err


def test_the_discriminant_starts_without_scikit_learn(powders, tmp_path):
    """scikit-learn takes a second or two to load, and is loaded only when it is used."""
    path = tmp_path / "l.npz"
    powders.save(path)
    # The exit status is 1 if scikit-learn was loaded.
    code = (
        "import sys; from pathlib import Path; from polysight.materials import Classifier, Library;"
        f"Classifier(Library.load(Path({str(path)!r})), model='discriminant', angles_deg=[55.0]);"
        "sys.exit('sklearn' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
