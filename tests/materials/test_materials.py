"""Library, classifier and permittivity: round trip, refusal of pickles, known materials recovered, unknown ones."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight import materials
from polysight.materials.analyse import Optics
from polysight.materials.classify import Weights
from polysight.materials.library import FORMAT, compute_ratio_distance, name_by_majority
from polysight.materials.measure import compute_median_ratio
from polysight.materials.result import pixel_features
from polysight.materials.segment import TruthPlate
from polysight.polarimetry import fresnel
from polysight.results import to_plain
from polysight_papers.sensys2026.item import table2
from polysight_shared.errors import DataError, ErrorCode

THETA = np.radians(55.0)


def test_library_round_trips(tmp_path, library):
    library.save(tmp_path / "l.npz")
    reloaded = materials.Library.load(tmp_path / "l.npz")
    assert reloaded.names == library.names
    assert reloaded.scans == library.scans
    assert reloaded.fit == json.loads(json.dumps(library.fit))
    assert reloaded.note == "synthetic images"
    assert reloaded.simulated
    for entry, reloaded_entry in zip(library.entries, reloaded.entries, strict=True):
        assert reloaded_entry.name == entry.name
        assert reloaded_entry.scan == entry.scan
        assert reloaded_entry.permittivity == entry.permittivity
        assert reloaded_entry.versions == entry.versions
        np.testing.assert_array_equal(entry.h, reloaded_entry.h)
        np.testing.assert_array_equal(entry.p, reloaded_entry.p)
    assert [p.name for p in tmp_path.iterdir()] == ["l.npz"]


def test_a_library_of_an_earlier_release_whose_entries_have_a_seed_is_read(tmp_path, library):
    library.save(tmp_path / "new.npz")
    with np.load(tmp_path / "new.npz") as saved:
        arrays = dict(saved)
    content = json.loads(arrays["meta"].tobytes())
    assert all("seed" not in entry for entry in content["entries"])
    for seed, entry in enumerate(content["entries"]):
        # One of them has none.
        entry["seed"] = None if seed == 0 else seed
    arrays["meta"] = np.frombuffer(json.dumps(content).encode(), np.uint8)
    np.savez(tmp_path / "old.npz", **arrays)
    old = materials.Library.load(tmp_path / "old.npz")
    assert [entry.name for entry in old.entries] == [entry.name for entry in library.entries]


class Bomb:
    """An object whose pickle fails the test when it is loaded."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was executed",))


def write_library_without_pixels(path, content):
    """Write a library whose description is `content`, and which has no pixels."""
    meta = np.frombuffer(json.dumps(content).encode(), np.uint8)
    np.savez(path, meta=meta, h=np.zeros(0), v=np.zeros(0), p=np.zeros(0))


def test_pickles_and_damaged_files_are_refused(tmp_path, library):
    pickle_in_archive = tmp_path / "bomb.npz"
    meta = np.array([Bomb()], object)
    np.savez(pickle_in_archive, meta=meta, h=np.zeros(0), v=np.zeros(0), p=np.zeros(0), allow_pickle=True)
    plain_pickle = tmp_path / "raw.npz"
    plain_pickle.write_bytes(pickle.dumps(Bomb()))
    library.save(tmp_path / "good.npz")
    cut_file = tmp_path / "cut.npz"
    cut_file.write_bytes((tmp_path / "good.npz").read_bytes()[:2000])
    of_later_release = tmp_path / "other.npz"
    write_library_without_pixels(of_later_release, {"format": "polysight-library-99"})
    with_pixels_missing = tmp_path / "short.npz"
    write_library_without_pixels(
        with_pixels_missing, {"format": FORMAT, "fit": {}, "note": "", "entries": [{"pixels": 3, "name": "a"}]}
    )
    codes = {
        pickle_in_archive: ErrorCode.FILE_UNREADABLE,
        plain_pickle: ErrorCode.FILE_UNREADABLE,
        cut_file: ErrorCode.FILE_UNREADABLE,
        of_later_release: ErrorCode.VERSION_UNSUPPORTED,
        with_pixels_missing: ErrorCode.FILE_DAMAGED,
        tmp_path / "absent.npz": ErrorCode.FILE_MISSING,
    }
    for path, code in codes.items():
        with expect_refusal(code, path):
            materials.Library.load(path)


def test_all_but_one_of_nine_plates_are_named_right(name_placement):
    accuracies = []
    predicted_accuracies = []
    for seed in range(5):
        result = name_placement(seed)
        accuracies.append(materials.pixel_accuracy(result))
        predicted_accuracies.append(materials.predict_pixel_accuracy(result))
        named = [r for r in result.patches if r.patch_name is not None]
        # The metal reference has no name of the library.
        assert len(named) == 8
        right_names = [r for r in named if r.patch_name.name == r.truth.name]
        assert len(right_names) >= 7
        # The pixels of one wrong plate are an eighth of all: 0.87 is the least of the five scenes.
        assert materials.pixel_accuracy(result) > 0.75
        for r in named:
            assert 0 < r.patch_name.confidence <= 1
            assert sum(r.patch_name.votes.values()) == pytest.approx(1)
    # Six scans are few training data: the classifier may state too small probabilities, but not too large ones. Its
    # mean prediction is 0.93.
    assert np.mean(predicted_accuracies) > 0.75
    assert np.mean(predicted_accuracies) < np.mean(accuracies) + 0.05


def test_without_names_or_probabilities_no_share_of_right_pixels_is_predicted(synthetic, library, analyse_placement):
    without_names = analyse_placement(1000)
    assert materials.predict_pixel_accuracy(without_names) is None
    # Votes of nearest neighbours are not probabilities.
    named_by_votes = synthetic(seed=4).analyse(classifier=materials.Classifier(library, model="knn"))
    assert materials.predict_pixel_accuracy(named_by_votes) is None


def test_the_ratio_of_both_channels_distinguishes_more_materials_than_one_channel(library):
    """The ratio P alone names 95 % of the pixels right; |H|, |V| and P together are not worse."""
    fit = library.fit["angles"]["55"]
    assert fit["by_channel"]["p"] > fit["by_channel"]["h"] + 0.1
    assert fit["pixel_accuracy"] >= fit["by_channel"]["p"]


def test_unusable_libraries_are_refused(library):
    with expect_refusal(ErrorCode.NO_DATA):
        materials.Classifier(materials.Library(()))
    with expect_refusal(ErrorCode.VALUE_INVALID):
        materials.Classifier(materials.Library(library.entries, {"weights": {"h": 1}}))
    with expect_refusal(ErrorCode.NO_DATA):
        materials.make_library([])


def test_distances_of_ratios_are_symmetric_and_keep_the_triangle_inequality():
    rng = np.random.default_rng(3)
    a, b, c = rng.standard_normal((3, 200)) + 1j * rng.standard_normal((3, 200))
    for measure in ("paper", "inverse", "log"):
        ab = compute_ratio_distance(a, b, measure)
        bc = compute_ratio_distance(b, c, measure)
        ac = compute_ratio_distance(a, c, measure)
        np.testing.assert_allclose(ab, compute_ratio_distance(b, a, measure), rtol=1e-9)
        assert (ac <= ab + bc + 1e-9).all()
        np.testing.assert_allclose(compute_ratio_distance(a, a, measure), 0, atol=1e-12)
    # A gain error of 3 % is the same distance for every material.
    np.testing.assert_allclose(compute_ratio_distance(a, 1.03 * a, "log"), np.log(1.03), rtol=1e-9)


def test_pixels_that_are_not_finite_are_unknown(library):
    # |H| of the second pixel is not a number, and 1 / P of the third is infinite.
    features = pixel_features([0.5, np.nan, 0.5], [0.1, 0.1, 0.1], [4 + 1j, 4 + 1j, 0])
    named, empty = materials.Classifier(library, Weights()).scan([features, pixel_features([], [], [])])
    assert named.pixel_names[1] == named.pixel_names[2] == materials.UNKNOWN
    assert named.pixel_names[0] != materials.UNKNOWN
    assert np.isinf(named.distance[1:]).all()
    assert empty.patch_name.name == materials.UNKNOWN


def test_a_majority_names_the_patch():
    names = np.array(["a", "b", "a", "c"])
    distance = np.array([0.1, 0.2, 0.3, 9.0])
    patch_of_pixel = np.array([7, 7, 7, 9])
    majority_names = name_by_majority(names, distance, patch_of_pixel)
    assert majority_names.patches.tolist() == [7, 9]
    assert majority_names.names.tolist() == ["a", "c"]
    # The share of the majority, and the median distance
    assert majority_names.confidence == pytest.approx([2 / 3, 1.0])
    assert majority_names.distance.tolist() == [0.2, 9.0]


def draw_channels(rng, h, v, pixels, noise):
    """Return both channels of a patch with complex noise; `noise` is the standard deviation of each part."""
    parts = noise * rng.standard_normal((4, pixels))
    return h + parts[0] + 1j * parts[1], v + parts[2] + 1j * parts[3]


# Number 1 is metal. The paper does not give the imaginary part of number 23, cork.
@pytest.mark.parametrize("row", [m for m in table2() if m.number not in (1, 23)], ids=lambda m: m.name)
def test_permittivity_of_table2_is_recovered_with_noise(row):
    rng = np.random.default_rng(row.number)
    r_s, r_p = fresnel(row.permittivity, THETA)
    h, v = draw_channels(rng, r_s, r_p, pixels=150, noise=0.003)
    estimate = materials.estimate_permittivity(h, v, THETA)
    # The largest errors are 0.7 % of eps' (cane sugar) and 0.017 of eps'' (rubber).
    assert estimate.value.real == pytest.approx(row.permittivity.real, rel=0.05)
    assert estimate.value.imag == pytest.approx(row.permittivity.imag, abs=0.15)
    assert estimate.real_range[0] <= estimate.value.real <= estimate.real_range[1]
    assert estimate.pixels == 150


def test_metal_and_a_patch_without_pixels_have_no_permittivity():
    rng = np.random.default_rng(0)
    h, v = draw_channels(rng, 1.0, 1.0, pixels=150, noise=0.01)
    estimate = materials.estimate_permittivity(h, v, THETA)
    assert estimate.value is None
    # Distance of V / H from that of metal, 1. Noise of 0.01 in each part over 150 pixels leaves about 0.002.
    assert estimate.metal_distance < 0.05
    assert materials.estimate_permittivity(np.zeros(0, complex), np.zeros(0, complex), THETA).value is None


def test_median_ratio_is_unbiased_where_v_nearly_vanishes():
    """Near the Brewster angle V is about as large as its noise, and the mean of H / V does not exist.

    The estimate is still right, also with a few outliers.
    """
    rng = np.random.default_rng(1)
    r_s, r_p = fresnel(2.61 - 0.01j, THETA)
    h, v = draw_channels(rng, r_s, r_p, pixels=20000, noise=0.03)
    # 2.5 % of the pixels are outliers. The median is wrong by 0.0027, and the inverse of the mean of H / V by 0.08.
    v[:500] = 50.0
    assert abs(1 / compute_median_ratio(h, v) - r_p / r_s) < 0.006


def test_rows_are_plain_json(name_placement):
    result = name_placement(3)
    rows = json.loads(json.dumps(to_plain(result.rows()), allow_nan=False))
    # The conversion above refuses NaN and infinity, which JSON does not have.
    assert len(rows) == 9
    metal = next(r for r in rows if r["metal_reference"])
    assert metal["permittivity"] is None
    assert metal["metal_like"]
    assert metal["truth"]["metal"]
    dielectric_row = next(r for r in rows if not r["metal_reference"])
    low, high = dielectric_row["permittivity"]["real_p30_p70"]
    assert low <= high
    assert dielectric_row["incidence_deg"] == pytest.approx(55.0)


def test_the_truth_of_a_scene_does_not_change_its_results(synthetic, library, name_placement):
    scene = synthetic(seed=4)
    with_truth = name_placement(4)
    without_truth = materials.analyse(scene.pair, Optics(THETA), classifier=materials.Classifier(library))
    assert [r.patch_name for r in with_truth.patches] == [r.patch_name for r in without_truth.patches]
    assert all(r.truth is None for r in without_truth.patches)
    assert materials.pixel_accuracy(without_truth) is None


def test_plates_are_read_from_a_truth_file(tmp_path):
    path = tmp_path / "truth.json"
    plate = {"name": "PET", "centre_mm": [10, -20], "size_mm": [45, 30], "permittivity": [3.78, 0.7]}
    metal_plate = {"name": "Cu", "centre_mm": [0, 0], "size_mm": [1, 1], "metal": True}
    path.write_text(json.dumps({"plates": [plate, metal_plate]}))
    pet, copper = materials.read_truth(path)
    assert pet.permittivity == 3.78 - 0.7j
    # x0, y0, x1, y1: the centre and half of the size on either side
    assert pet.box_mm == (-12.5, -35.0, 32.5, -5.0)
    assert copper.metal
    with pytest.raises(DataError):
        materials.read_truth(tmp_path / "absent.json")


def test_table_2_of_the_paper_is_complete():
    rows = table2()
    assert [r.number for r in rows] == list(range(1, 37))
    by_name = {r.name: r for r in rows}
    assert by_name["PET (0.5 mm)"].permittivity == 3.78 - 0.70j
    assert by_name["PET (0.5 mm)"].thickness_mm == 0.5
    assert by_name["Ceramic"].permittivity == 4.75 - 2.43j
    assert by_name["Water (with glass)"].permittivity == 3.66 - 0.43j
    assert "not given" in by_name["Cork"].note


def test_a_scene_of_metal_alone_has_no_share_of_right_pixels(name_placement):
    """Metal is the reference and is not named: no pixel is right or wrong."""
    result = name_placement(0)
    metal = TruthPlate("copper", (0.0, 0.0, 1.0, 1.0), None, metal=True)
    of_metal = replace(result, patches=tuple(replace(r, truth=metal) for r in result.patches))
    assert materials.pixel_accuracy(of_metal) is None
    assert materials.predict_pixel_accuracy(of_metal) is None
