"""`patches.npz` has all that names depend on: a scan that is named again from it gets the same names."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.imaging import Images
from polysight.materials import UNKNOWN, Classifier, match_patches, pack_patches, read_patches
from polysight.materials.kinds import RatioCase
from polysight_shared.errors import ErrorCode


def name_from_file(result, scene, classifier, path):
    """Return the names of a result's patches, by number, after it was written to a file and read again."""
    path.write_bytes(pack_patches(result, scene.x_m, scene.y_m, simulated=True))
    patches = read_patches(path)
    matched = [m for m in match_patches([patches]) if m.label in patches.evidence]
    renamed = classifier.scan([m.features for m in matched], [m.evidence for m in matched])
    return {match.label: named.patch_name for match, named in zip(matched, renamed, strict=True)}


def test_a_scan_that_is_named_again_from_its_file_gets_the_same_names(synthetic, library, name_placement, tmp_path):
    scene = synthetic(seed=3)
    classifier = Classifier(library)
    analysis = name_placement(3)
    renamed = name_from_file(analysis, scene, classifier, tmp_path / "patches.npz")
    for r in analysis.patches:
        if r.named is not None:
            assert renamed[r.patch.label].name == r.named.patch_name.name
            # Files have single precision.
            assert renamed[r.patch.label].probabilities == pytest.approx(r.named.patch_name.probabilities, abs=1e-3)


def test_both_cases_of_metal_that_may_be_painted_are_kept(synthetic, analyse_placement, tmp_path):
    """One patch has two cases; the others have none."""
    scene = synthetic(3)
    analysis = analyse_placement(1000)
    first, *others = analysis.evidence
    cases = (RatioCase(0.25, 0.3 - 0.1j, np.diag([1e-4, 2e-4])), RatioCase(0.75, 0.2 + 0.1j, 1e-4 * np.eye(2)))
    evidence = {**analysis.evidence, first: replace(analysis.evidence[first], cases=cases)}
    path = tmp_path / "patches.npz"
    path.write_bytes(pack_patches(replace(analysis, evidence=evidence), scene.x_m, scene.y_m, simulated=True))
    read = read_patches(path).evidence
    for case, expected in zip(read[first].cases, cases, strict=True):
        assert (case.probability, case.inverse_ratio) == (expected.probability, expected.inverse_ratio)
        assert case.covariance == pytest.approx(expected.covariance)
    assert others
    assert not any(read[label].cases for label in others)


@pytest.mark.parametrize("gain", [0.8, 1.25])
def test_brightness_that_all_plates_share_does_not_change_their_names(
    gain, synthetic, library, name_placement, tmp_path
):
    """A low or tilted metal plate makes all others brighter or darker in both channels, but does not change V / H."""
    scene = synthetic(seed=3)
    classifier = Classifier(library)
    plain = name_placement(3)
    is_metal = plain.segmentation.labels == plain.metal.label
    factor = np.where(is_metal, 1.0, gain)
    pair = Images(scene.h * factor, scene.v * factor, scene.x_m, scene.y_m, np.ones(scene.h.shape, bool))
    analysis = scene.analyse(classifier=classifier, pair=pair)
    renamed = name_from_file(analysis, scene, classifier, tmp_path / "patches.npz")
    names_before = {r.patch.label: r.named.patch_name.name for r in plain.patches if r.named is not None}
    names_after = {label: patch_name.name for label, patch_name in renamed.items() if label in names_before}
    # A patch may become unknown, but no other material. Here all eight keep their names; two may become unknown.
    for label, name in names_after.items():
        assert name in (names_before[label], UNKNOWN)
    kept = [label for label, name in names_after.items() if name == names_before[label]]
    assert len(kept) >= 0.7 * len(names_before)


def test_a_file_of_an_earlier_release_without_errors_of_its_patches_is_read(
    synthetic, library, name_placement, tmp_path
):
    scene = synthetic(seed=3)
    analysis = name_placement(3)
    path = tmp_path / "patches.npz"
    path.write_bytes(pack_patches(analysis, scene.x_m, scene.y_m, simulated=True))
    with np.load(path) as z:
        old_arrays = {k: z[k] for k in z if not k.startswith("evidence_")}
    meta = json.loads(old_arrays["meta"].tobytes())
    del meta["judged"]
    out = io.BytesIO()
    np.savez(out, **{**old_arrays, "meta": np.frombuffer(json.dumps(meta).encode(), np.uint8)})
    path.write_bytes(out.getvalue())
    patches = read_patches(path)
    assert not patches.evidence
    assert len(patches.patches) == len(analysis.patches)
    matched = match_patches([patches])
    for named, match in zip(Classifier(library).scan([m.features for m in matched]), matched, strict=True):
        name = named.patch_name.name
        assert name == match.truth or name not in library.names


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        # Probabilities that are not positive or whose sum is not 1, and rows that lack a number
        (lambda cases: cases * [-1, 1, 1, 1, 1, 1, 1], "probabilities"),
        (lambda cases: cases * [2, 1, 1, 1, 1, 1, 1], "probabilities"),
        (lambda cases: cases[:, :, :-1], "reshape"),
        (lambda cases: cases[:, 0, 0], "reshape"),
    ],
)
def test_a_file_whose_cases_of_paint_are_damaged_is_refused(synthetic, analyse_placement, tmp_path, change, reason):
    scene = synthetic(seed=3)
    path = tmp_path / "patches.npz"
    path.write_bytes(pack_patches(analyse_placement(1000), scene.x_m, scene.y_m, simulated=True))
    with np.load(path) as z:
        arrays = {k: z[k] for k in z}
    # Each patch: probability, t and covariance with paint, and without.
    case = np.array([0.5, 1.5, 0.1, 0.01, 0.0, 0.0, 0.01])
    cases = np.tile(case, (len(arrays["evidence_cases"]), 2, 1))
    with path.open("wb") as file:
        np.savez(file, **{**arrays, "evidence_cases": cases})
    assert all(len(evidence.cases) == 2 for evidence in read_patches(path).evidence.values())
    with path.open("wb") as file:
        np.savez(file, **{**arrays, "evidence_cases": change(cases)})
    with expect_refusal(ErrorCode.FILE_UNREADABLE, reason):
        read_patches(path)


def test_a_file_whose_errors_are_of_fewer_patches_is_refused(synthetic, analyse_placement, tmp_path):
    scene = synthetic(seed=3)
    path = tmp_path / "patches.npz"
    path.write_bytes(pack_patches(analyse_placement(1000), scene.x_m, scene.y_m, simulated=True))
    with np.load(path) as z:
        arrays = {k: z[k] for k in z}
    out = io.BytesIO()
    np.savez(out, **{**arrays, "evidence_ratio": arrays["evidence_ratio"][:-1]})
    path.write_bytes(out.getvalue())
    with expect_refusal(ErrorCode.FILE_UNREADABLE, path):
        read_patches(path)


@pytest.mark.parametrize("position_mm", [np.inf, np.nan])
def test_a_file_with_a_position_that_is_not_finite_is_refused(synthetic, analyse_placement, tmp_path, position_mm):
    """Otherwise the search for the same pixels in another scan would end in a ValueError."""
    scene = synthetic(seed=3)
    path = tmp_path / "patches.npz"
    path.write_bytes(pack_patches(analyse_placement(1000), scene.x_m, scene.y_m, simulated=True))
    with np.load(path) as z:
        arrays = {k: z[k] for k in z}
    places_mm = arrays["places_mm"].copy()
    places_mm[0, 0] = position_mm
    with path.open("wb") as file:
        np.savez(file, **{**arrays, "places_mm": places_mm})
    with expect_refusal(ErrorCode.FILE_UNREADABLE, "not finite"):
        read_patches(path)
