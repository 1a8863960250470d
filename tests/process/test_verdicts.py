"""Scenes that differ from the rig file get the right verdict and reason, and error bars that contain the truth."""

import json

import msgspec
import numpy as np
import pytest
from benchmarks.coverage import Cubes
from tests.support.pipelines import make_pipeline

from polysight.materials import match_truth, read_true_plates
from polysight.process import read_given_images
from polysight.products import ProcessedScan
from polysight.products.maps import nominal_incidence_rad
from polysight.store import open_source
from polysight_simulators.scene import decode_scene
from polysight_simulators.scene.simulated_scan import simulate, truth

PLATES = {
    "ceramic": ([-62.0, 32.0], [4.75, 2.43]), "acrylic": ([0.0, 34.0], [4.0, 0.4]), "PET": ([62.0, 32.0], [3.78, 0.7]),
    "wood": ([-62.0, -32.0], [2.61, 0.01]), "metal": ([0.0, -34.0], None), "rubber": ([62.0, -32.0], [5.06, 1.11]),
}  # fmt: skip


def make_scene(names=tuple(PLATES), disturbances=None, **scene):
    plates = [
        {"name": n, "centre_mm": PLATES[n][0], "size_mm": [46.0, 46.0]}
        | ({"metal": True} if PLATES[n][1] is None else {"permittivity": PLATES[n][1]})
        for n in names
    ]
    raw = {
        "name": "world", "object_distance_mm": 499.0, "plates": plates, "image": {"columns": 110, "rows": 86},
        "grid": {"columns": 43, "rows": 41, "step_x_mm": 10.0, "step_y_mm": 6.0},
        "disturbances": disturbances or {},
    }  # fmt: skip
    return decode_scene(raw | scene, "world")


def form_images(source):
    pipeline = make_pipeline(source)
    return pipeline, pipeline.form_images()


@pytest.fixture(scope="module")
def examine(rig):
    """`examine(scene)`: a perfectly synchronised scene, processed and judged with the shipped rig file."""

    def make(scene):
        source = Cubes(rig, scene)
        pipeline, images = form_images(source)
        findings = pipeline.examine(images)
        plates = read_true_plates(truth(source.instrument, scene, scene.seed))
        true = match_truth([r.patch for r in findings.analysis.patches], plates)
        return findings, true

    return make


@pytest.fixture(scope="module")
def plain_scene(examine):
    """Results for all plates with a rig whose leakage was measured."""
    return examine(make_scene(disturbances={"leakage_measured": 0.003}))


def compute_distances(findings, true):
    """Squared distance of each patch's true permittivity in its region."""
    out = []
    for r in findings.analysis.patches:
        plate = true.get(r.patch.label)
        e = r.permittivity
        if plate is not None and plate.permittivity is not None and e.value is not None:
            difference = e.value - plate.permittivity
            pair = np.array([difference.real, difference.imag])
            out.append(float(pair @ np.linalg.solve(e.covariance, pair)))
    return np.array(out)


def join_reasons(findings):
    return "; ".join(r.what for r in findings.verdict.reasons)


def has_no_results(findings):
    return all(r.name is None and r.permittivity is None and r.ratio is None for r in findings.analysis.rows())


def test_a_measured_rig_and_a_plain_scene_are_good(plain_scene):
    findings, true = plain_scene
    assert findings.verdict.level == "good", join_reasons(findings)
    assert np.sqrt(compute_distances(findings, true).mean() / 2) < 1.5
    assert sum(r.patch_name is not None and r.patch_name.name.startswith(true[r.patch.label].name)
               for r in findings.analysis.patches) >= 4  # fmt: skip
    (reference,) = [r for r in findings.analysis.rows() if r.metal_reference]
    assert reference.name is None  # not judged by itself


def test_an_undeclared_thin_sheet_is_reported_and_affects_no_other_patch(examine):
    # A millimetre of acrylic is half a wavelength thick: it hardly reflects, and has the ratio of another material.
    scene = make_scene(disturbances={"leakage_measured": 0.003})
    plates = tuple(msgspec.structs.replace(p, thickness_mm=1.0) if p.name == "acrylic" else p for p in scene.plates)
    findings, true = examine(msgspec.structs.replace(scene, plates=plates))
    (label,) = [label for label, plate in true.items() if plate.name == "acrylic"]
    assert findings.verdict.level == "care"
    assert f"patch {label} " in join_reasons(findings)
    other_items = {k: plate for k, plate in true.items() if k != label}
    assert np.sqrt(compute_distances(findings, other_items).mean() / 2) < 1.5


# Two plates: test_products_without_a_result_hold_images_and_no_name
@pytest.mark.parametrize("names", [("ceramic", "acrylic", "PET", "wood", "rubber"), ("ceramic",)])
def test_without_metal_there_is_no_result(examine, names):
    findings, _ = examine(make_scene(names))
    assert findings.verdict.level == "none"
    assert not findings.analysis.metal.certain
    assert "metal" in join_reasons(findings)
    assert has_no_results(findings)


@pytest.mark.parametrize("leak", [(0.0, 0.0), (0.0, 0.05), (-0.05, 0.05)])
def test_unmeasured_leakage_is_in_the_error_bars(examine, leak):
    findings, true = examine(
        make_scene(disturbances={"leakage_h": list(leak), "leakage_v": list(leak), "crystal_ppm": {}})
    )
    if leak == (0.0, 0.0):  # the rig file must not say that there is no leakage
        assert findings.verdict.level == "good"
        return
    inversion = findings.analysis.inversion
    if findings.verdict.level == "good":
        # The plates determine the leakage well enough by themselves
        assert all(
            p.permittivity.real_std < 0.05 * p.permittivity.value.real
            for p in findings.analysis.patches
            if p.patch_name
        )
    else:
        assert findings.verdict.level == "care"
    for leakage, std in zip(inversion.leakage, inversion.leakage_std, strict=True):
        assert abs(leakage - complex(*leak)) < 4 * std
    assert {e.dominated_by for e in inversion.patches} <= {"leakage", "metal reference", "scatter"}
    assert np.sqrt(compute_distances(findings, true).mean() / 2) < 1.5


@pytest.mark.parametrize("shift_mm", [10.0, -8.0])
def test_a_shifted_plane_is_found_and_reported(examine, shift_mm):
    findings, true = examine(make_scene(plane_shift_mm=shift_mm, disturbances={"leakage_measured": 0.003}))
    assert 1e3 * findings.plane.offset_m == pytest.approx(shift_mm, abs=0.5)
    assert "plane" in join_reasons(findings)
    assert compute_distances(findings, true).max() < 14.0
    assert np.sqrt(compute_distances(findings, true).mean() / 2) < 1.5


@pytest.mark.parametrize(
    "heights_mm",
    [
        {"wood": -12.0, "rubber": -18.0},
        {"wood": -6.0, "rubber": -4.0},
        {"acrylic": -7.0, "ceramic": -22.0, "wood": -9.0},
    ],
    ids=lambda heights: " ".join(f"{height:.0f}" for height in heights.values()),
)
def test_plates_of_other_heights_are_not_a_tilt_and_keep_their_permittivities(examine, heights_mm):
    # 12 mm nearer to the radars the angle of incidence is larger by 0.7 degrees.
    scene = make_scene(disturbances={"leakage_measured": 0.003})
    plates = tuple(msgspec.structs.replace(p, height_mm=heights_mm.get(p.name, 0.0)) for p in scene.plates)
    findings, true = examine(msgspec.structs.replace(scene, plates=plates))
    raised = findings.plane.to_dict()["raised_mm"]
    assert sorted(raised) == pytest.approx(sorted(heights_mm.values()), abs=0.5)
    np.testing.assert_allclose(np.degrees(findings.plane.tilt_rad), 0, atol=0.2)
    assert findings.verdict.level == "good"
    assert compute_distances(findings, true).max() < 14.0
    assert np.sqrt(compute_distances(findings, true).mean() / 2) < 1.5


def test_a_raised_plate_keeps_its_angle_in_images_and_maps(rig, tmp_path):
    scene = make_scene(disturbances={"leakage_measured": 0.003})
    plates = tuple(msgspec.structs.replace(p, height_mm=-20.0 * (p.name == "rubber")) for p in scene.plates)
    pipeline, _ = form_images(Cubes(rig, msgspec.structs.replace(scene, plates=plates)))
    pipeline.finish(tmp_path)
    scan = ProcessedScan(tmp_path)
    image_file = read_given_images(tmp_path / "image.npz", pipeline.rig)
    np.testing.assert_array_equal(image_file.images.raised_m, scan.images.raised_m)
    pixel_angles = np.degrees(nominal_incidence_rad(scan))
    on_rubber = scan.images.raised_m < -0.015
    assert on_rubber.any()
    # tan(angle) times the distance, 499 and 479 mm, is the same.
    np.testing.assert_allclose(
        np.tan(np.radians(pixel_angles[on_rubber])) * 479, np.tan(np.radians(pixel_angles[0, 0])) * 499, rtol=1e-3
    )


def test_a_tilted_plane_is_found(examine):
    findings, true = examine(make_scene(plane_tilt_deg=[0.8, -0.6], disturbances={"leakage_measured": 0.003}))
    np.testing.assert_allclose(np.degrees(findings.plane.tilt_rad), [0.8, -0.6], atol=0.2)
    assert "tilted" in join_reasons(findings)
    assert np.sqrt(compute_distances(findings, true).mean() / 2) < 1.5


def test_a_weak_direct_path_is_reported(examine):
    findings, _ = examine(make_scene(disturbances={"direct_loss_db": 12.0}))
    assert findings.verdict.level == "care"
    assert "direct path" in join_reasons(findings)


def test_an_empty_table_is_not_a_result(examine):
    findings, _ = examine(make_scene(()))
    assert findings.verdict.level == "none"
    assert has_no_results(findings)


@pytest.mark.parametrize("plates", [tuple(PLATES), ()], ids=["plates", "noise"])
def test_without_a_direct_path_there_is_no_result(rig, tmp_path, plates):
    small = {"columns": 31, "rows": 25, "step_x_mm": 14.0, "step_y_mm": 10.0}
    folder = simulate(rig, make_scene(plates, {"direct_loss_db": "absent"}, grid=small), tmp_path / "scan")
    pipeline, images = form_images(open_source(folder, None))
    findings = pipeline.examine(images)
    assert findings.verdict.level == "none"
    assert "direct path" in findings.verdict.reasons[0].what
    assert has_no_results(findings)


def test_products_without_a_result_hold_images_and_no_name(rig, tmp_path):
    pipeline, _ = form_images(Cubes(rig, make_scene(("ceramic", "wood"))))
    products = pipeline.finish(tmp_path / "out")
    assert products.exit_status == 7
    content = json.loads((tmp_path / "out/materials.json").read_text())
    quality = json.loads((tmp_path / "out/quality.json").read_text())
    assert content["verdict"]["level"] == quality["verdict"]["level"] == "none"
    assert all(s["name"] is None and s["permittivity"] is None and not s["votes"] for s in content["segments"])
    with np.load(tmp_path / "out/image.npz") as image:
        assert np.isfinite(image["h"]).any()
        assert np.isnan(image["p_sigma"]).all()
    assert msgspec.json.decode((tmp_path / "out/labels.json").read_bytes())["labels"].keys() <= {"patch", "patch (2)"}


def test_p_sigma_covers_the_error_of_p(plain_scene):
    findings, true = plain_scene
    analysis = findings.analysis
    sigma = analysis.p_sigma(findings.images.valid)
    inside = []
    for r in analysis.patches:
        plate = true.get(r.patch.label)
        if plate is None or plate.permittivity is None or abs(1 / r.permittivity.ratio) < 0.03:
            continue
        q = np.sqrt(plate.permittivity - np.sin(analysis.theta_rad[0, 0]) ** 2)
        cos = np.cos(analysis.theta_rad[0, 0])
        p = (cos - q) / (cos + q) * (q + plate.permittivity * cos) / (q - plate.permittivity * cos)
        interior = r.patch.interior
        inside.append(np.mean(np.abs(analysis.calibrated.p[interior] - p) < 2 * np.sqrt(2) * sigma[interior]))
    assert len(inside) >= 3
    assert np.mean(inside) > 0.8
