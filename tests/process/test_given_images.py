"""Images of another program are analysed like a recorded scan, and assumptions are reported."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from msgspec import UNSET
from tests.support.drawn_files import Errors, Material, write_labels
from tests.support.refusals import expect_refusal

from polysight import open_scan
from polysight.cli.main import main
from polysight.imaging import Images
from polysight.jobs.batch import find_scans
from polysight.materials import Labels, Library
from polysight.process import Inputs, analyse_given_images, read_given_images
from polysight.products import ProcessedScan, write_image, write_json
from polysight.settings import Settings
from polysight_shared.errors import DataError, ErrorCode, PolysightError

ANGLE = 55.0
MATERIALS = {
    "copper": Material("copper", None),
    "acrylic": Material("acrylic", 4.0 - 0.4j),
    "ceramic": Material("ceramic", 4.75 - 2.43j),
    "rubber": Material("rubber", 5.06 - 1.11j),
    "PET": Material("PET", 3.78 - 0.70j),
}
# Corners x0, y0, x1, y1 in pixels of images of 150 x 150.
BOXES = {
    "copper": (15, 15, 40, 40), "acrylic": (60, 15, 85, 40), "ceramic": (105, 15, 130, 40),
    "rubber": (15, 90, 40, 115), "PET": (60, 90, 85, 115),
}  # fmt: skip


@pytest.fixture(scope="module")
def labels_folder(tmp_path_factory):
    """`labels/<scan>` of five plates, without leakage."""
    folder = tmp_path_factory.mktemp("labels")
    return write_labels(folder, "plates", BOXES, MATERIALS, angle_deg=ANGLE, errors=Errors(), seed=4)


@pytest.fixture(scope="module")
def pair(labels_folder):
    """The images of that folder with our sign of phase; published ones are conjugate."""
    return {name: np.load(labels_folder / f"sar_{name}.npy").conj() for name in "hv"}


@pytest.fixture
def save_images(tmp_path, pair):
    """`save_images(h=..., x_m=None)` writes the pair to a file, with changed arrays; None leaves one out."""

    def save(name="plates", **changed):
        arrays = {**pair, "incidence_deg": ANGLE, "conjugate": False, **changed}
        np.savez(tmp_path / f"{name}.npz", **{k: v for k, v in arrays.items() if v is not None})
        return tmp_path / f"{name}.npz"

    return save


def analyse_file(path, rig, **settings):
    """Return the results of given images, which are not named."""
    pair = read_given_images(path, rig)
    return analyse_given_images(pair, Settings(model="none", **settings), Inputs(), rig)[0]


def list_permittivities(scan):
    """Return the permittivity of each segment by its place, x and y in whole millimetres."""
    return {(round(s.centre_x_mm), round(s.centre_y_mm)): s.permittivity for s in scan.segments}


def test_plates_of_an_npz_and_of_a_labels_folder_are_the_same(labels_folder, save_images, rig):
    """Only the folder has boxes, and only its images begin with the top row."""
    by_folder = analyse_file(labels_folder, rig)
    by_file = analyse_file(save_images(), rig)
    assert {s.box for s in by_folder.segments} == set(BOXES)
    assert len(by_file.segments) == len(by_folder.segments)
    of_file = {(x, -y): permittivity for (x, y), permittivity in list_permittivities(by_file).items()}
    for (x, y), permittivity in list_permittivities(by_folder).items():
        # Boxes and patches of one plate have their centres within 5 mm; plates are 90 mm apart.
        nearest = min(of_file, key=lambda place: np.hypot(place[0] - x, place[1] - y))
        assert np.hypot(nearest[0] - x, nearest[1] - y) < 5
        assert (permittivity is None) == (of_file[nearest] is None)
        # A box and a patch of one plate differ in their pixels, which scatter.
        if permittivity is not None:
            assert permittivity.real == pytest.approx(of_file[nearest].real, rel=0.05)


def test_a_labels_folder_may_be_renamed(labels_folder, tmp_path, rig):
    renamed = shutil.copytree(labels_folder, tmp_path / "oak")
    expected = read_given_images(labels_folder, rig)
    assert read_given_images(renamed, rig).labels == expected.labels
    assert expected.labels is not None


def test_permittivities_are_those_of_the_plates(labels_folder, rig):
    for segment in analyse_file(labels_folder, rig, incidence_deg=ANGLE).segments:
        estimate = segment.permittivity
        if estimate is not None:
            true = MATERIALS[segment.box].permittivity
            error = abs(complex(estimate.real, estimate.imag) - true)
            # An error of a fifth would make it another material.
            assert error < 0.2 * abs(true)
            # The error of both parts together is within three standard deviations.
            assert error < 3 * np.hypot(estimate.real_std, estimate.imag_std)


def test_images_with_axes_that_fall_have_the_same_results(save_images, pair, rig):
    x = 1.3 + np.arange(150) * 2e-3
    raised_m = np.linspace(-0.01, 0.01, 150 * 150).reshape(150, 150)
    rising = analyse_file(save_images(x_m=x, y_m=x, raised_m=raised_m), rig)
    rotated = {name: image[::-1, ::-1] for name, image in {**pair, "raised_m": raised_m}.items()}
    falling = analyse_file(save_images(x_m=x[::-1], y_m=x[::-1], **rotated), rig)
    np.testing.assert_array_equal(rising.images.h, falling.images.h)
    np.testing.assert_array_equal(rising.images.raised_m, falling.images.raised_m)
    assert list_permittivities(rising) == list_permittivities(falling)
    assert rising.images.x_m[0] == 1.3


def test_the_option_for_the_angle_precedes_the_file_and_the_file_precedes_the_rig(save_images, rig):
    with_angle = save_images()
    without_angle = save_images("bare", incidence_deg=None)
    # The published rig has 54.9 degrees.
    for path, option, expected_deg, source in (
        (with_angle, 60.0, 60.0, "option"),
        (with_angle, None, ANGLE, "file"),
        (without_angle, None, 54.9, "rig file"),
    ):
        scan = analyse_file(path, rig, incidence_deg=option)
        # Angles are compared to a tenth of a degree, as they are written above.
        assert scan.quality.incidence.one_deg == pytest.approx(expected_deg, abs=0.05)
        assert scan.quality.given_images.incidence_from == source
        assert {round(s.incidence_deg, 1) for s in scan.segments} == {round(scan.quality.incidence.one_deg, 1)}


@pytest.mark.parametrize("text", ["plates, incidence 60 deg", "no angle", ""])
def test_the_angle_in_the_description_of_a_labels_folder_precedes_that_of_the_rig(labels_folder, tmp_path, rig, text):
    folder = Path(shutil.copytree(labels_folder, tmp_path / "plates"))
    file = folder / "plates.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"description": text}))
    scan = analyse_file(folder, rig)
    is_reported = any("the incidence angle is not known" in reason.what for reason in scan.verdict.reasons)
    assert scan.quality.given_images.incidence_from == ("file" if "60" in text else "rig file")
    assert is_reported == ("60" not in text)


def test_given_images_have_at_best_the_verdict_care_and_no_results_of_a_recording(save_images, rig):
    axis = np.arange(150) * 2e-3
    scan = analyse_file(save_images(x_m=axis, y_m=axis), rig)
    assert scan.verdict.level == "care"
    assert scan.quality.given_images.assumed == []
    bare = analyse_file(save_images("bare", incidence_deg=None), rig)
    further_reasons = {r.what for r in bare.verdict.reasons} - {r.what for r in scan.verdict.reasons}
    for beginning in ("the incidence angle is not known", "assumed, not in the file: no x_m"):
        assert any(reason.startswith(beginning) for reason in further_reasons)
    assert scan.rig is None
    assert scan.rows is None
    assert scan.plan is None
    assert scan.quality.boards == {}
    assert scan.simulated is False


def test_exchanged_images_are_reported_and_give_no_permittivity(save_images, pair, rig):
    """Eq. 3 gives the same permittivity for P and 1 / P: only the passivity of half spaces distinguishes them."""
    exchanged = read_given_images(save_images(h=pair["v"], v=pair["h"]), rig)
    inputs = Inputs(labels=Labels(BOXES, metal="copper"))
    scan = analyse_given_images(exchanged, Settings(model="none"), inputs, rig)[0]
    assert scan.verdict.level == "none"
    assert any("exchanged" in r.what for r in scan.verdict.reasons[:2])
    assert not any(s.permittivity for s in scan.segments)


def test_pixels_marked_invalid_are_left_out(save_images, pair, rig):
    valid = np.ones((150, 150), bool)
    valid[80:] = False
    without_upper_rows = {name: np.where(valid, image, np.nan) for name, image in pair.items()}
    scan = analyse_file(save_images(valid=valid, **without_upper_rows), rig)
    # Three of the five plates lie below row 80.
    assert len(scan.segments) == 3
    assert not scan.images.valid[80:].any()


# By the name of the case: changed arrays, the code of the refusal, and a text in it
WRONG = {
    "no v": ({"v": None, "sar_v": np.ones(3)}, ErrorCode.KEY_MISSING, "sar_v"),
    "magnitude": ({"h": np.ones((150, 150))}, ErrorCode.TYPE_WRONG, "float64"),
    "cube": ({"h": np.ones((4, 150, 150), complex)}, ErrorCode.MISMATCH, "4 x 150 x 150"),
    "line": ({"h": np.ones((2, 150), complex)}, ErrorCode.MISMATCH, "2 x 150"),
    "two shapes": ({"v": np.ones((150, 149), complex)}, ErrorCode.MISMATCH, "150 x 149"),
    "infinite": ({"v": np.full((150, 150), np.inf + 0j)}, ErrorCode.VALUE_INVALID, 22500),
    "dark": ({"h": np.zeros((150, 150), complex), "v": np.zeros((150, 150), complex)}, ErrorCode.NO_DATA, ""),
    "dark v": ({"v": np.zeros((150, 150), complex)}, ErrorCode.NO_DATA, "v"),
    "beyond single precision": ({"h": np.full((150, 150), 1e30 + 0j)}, ErrorCode.VALUE_INVALID, "1e+30"),
    "below single precision": ({"v": np.full((150, 150), 1e-300 + 0j)}, ErrorCode.VALUE_INVALID, "1e-300"),
    "short axis": ({"x_m": np.arange(149) * 2e-3}, ErrorCode.MISMATCH, 149),
    "uneven axis": ({"x_m": (np.arange(150) * 2e-3) ** 2}, ErrorCode.VALUE_INVALID, "x_m"),
    "millimetres": ({"x_m": np.arange(150) * 2.0, "y_m": np.arange(150) * 2.0}, ErrorCode.VALUE_INVALID, "2000"),
    "words": ({"incidence_deg": np.array("55")}, ErrorCode.VALUE_INVALID, "incidence_deg"),
    "raised as one number": ({"raised_m": np.array(0.01)}, ErrorCode.MISMATCH, "raised_m"),
    "raised by millimetres": ({"raised_m": np.full((150, 150), 12.0)}, ErrorCode.VALUE_INVALID, "raised_m"),
    "raised by nothing": ({"raised_m": np.full((150, 150), np.nan)}, ErrorCode.VALUE_INVALID, "raised_m"),
    "valid as numbers": ({"valid": np.ones((150, 150))}, ErrorCode.MISMATCH, "valid"),
}


@pytest.mark.parametrize(("changed", "code", "named"), WRONG.values(), ids=WRONG.keys())
def test_wrong_files_are_refused_by_name(save_images, rig, changed, code, named):
    path = save_images(**changed)
    with expect_refusal(code, path, named) as caught:
        read_given_images(path, rig)
    assert caught.value.why
    assert caught.value.remedy


WITHOUT_PHASE = {
    "magnitudes": lambda h, v: (np.abs(h) + 0j, np.abs(v) + 0j),
    "real parts": lambda h, v: (h.real + 0j, v.real + 0j),
    "one phase for both": lambda h, v: (h, np.abs(v) * np.exp(1j * np.angle(h))),
}


@pytest.mark.parametrize("remove_phase", WITHOUT_PHASE.values(), ids=WITHOUT_PHASE.keys())
def test_images_without_a_phase_between_the_channels_are_refused(save_images, pair, rig, remove_phase):
    """Without it every loss would be estimated as zero, with a small error."""
    h, v = remove_phase(pair["h"], pair["v"])
    path = save_images(h=h, v=v)
    with expect_refusal(ErrorCode.VALUE_INVALID, path, "no phase between h and v"):
        analyse_file(path, rig)


def test_files_that_are_not_an_archive_are_refused(tmp_path, rig):
    path = tmp_path / "other.npz"
    with expect_refusal(ErrorCode.FILE_MISSING, path):
        read_given_images(path, rig)
    path.write_bytes(b"PK no archive")
    with expect_refusal(ErrorCode.FILE_UNREADABLE, path):
        read_given_images(path, rig)
    np.savez(path, h=np.array([{}], dtype=object), v=np.ones((9, 9), complex))
    with expect_refusal(ErrorCode.FILE_UNREADABLE, path):
        read_given_images(path, rig)


@pytest.mark.parametrize("options", [["--incidence", "pixel"], ["--bands", "3"], ["--sparse"]])
def test_options_that_need_rows_are_refused(save_images, tmp_path, capsys, options):
    assert main(["process", str(save_images()), "--out", str(tmp_path / "out"), *options]) != 0
    assert options[0] in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_every_command_that_reads_products_reads_those_of_given_images(save_images, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["process", str(save_images()), "--out", str(out), "--metal", "-94,-94,40,40"]) == 0
    for command in (
        ["materials", out],
        ["permittivity", out],
        ["classify", out],
        ["report", out],
        ["probe", out, "0,0"],
        ["compare", out, out],
        ["label", out, "--list"],
        ["scans", tmp_path],
        ["export", out, "--csv", "--mat", "--netcdf", "--out", tmp_path / "exported"],
    ):
        capsys.readouterr()
        assert main([str(word) for word in command]) == 0, capsys.readouterr().err
    scan = open_scan(out)
    assert float(scan.image().incidence_deg) == ANGLE
    assert scan.materials().sizes["patch"] == 5
    with pytest.raises(PolysightError):
        _ = scan.rig


def test_the_tilt_of_a_plate_is_read_from_its_phase(save_images, pair, rig):
    """A plate lower by a height makes the path from TX over the plate to RX longer by 2 cos(angle) times the height."""
    # Along x and along y
    degrees = (0.6, -0.8)
    axis = np.arange(150) * 2e-3
    height_m = np.tan(np.radians(degrees[0])) * axis[None, :] + np.tan(np.radians(degrees[1])) * axis[:, None]
    # 78 GHz is about the middle of the sweep.
    wave_number = 2 * np.pi * 78.0e9 / 299792458.0
    # The drawn files have a phase of their own that grows by a turn in 900 pixels along both axes, see write_labels.
    turns = np.arange(150) / 900.0
    ramp = np.exp(-2j * np.pi * np.add.outer(turns, turns))
    pair = {name: image * ramp for name, image in pair.items()}
    tilt_factor = np.exp(-2j * wave_number * np.cos(np.radians(ANGLE)) * height_m)
    tilted = {name: image * tilt_factor for name, image in pair.items()}
    level = analyse_file(save_images("level", x_m=axis, y_m=axis, **pair), rig, incidence_deg=ANGLE)
    rising = analyse_file(save_images("rising", x_m=axis, y_m=axis, **tilted), rig, incidence_deg=ANGLE)
    changes = [
        after.tilt_across_deg - before.tilt_across_deg
        for before, after in zip(level.segments, rising.segments, strict=True)
        if before.tilt_across_deg is not UNSET and after.tilt_across_deg is not UNSET
    ]
    # At least three of the five plates have a tilt in both results.
    assert len(changes) >= 3
    # The limit is a sixteenth of the tilt.
    assert np.median(changes) == pytest.approx(degrees[1], abs=0.05)


def test_a_plate_over_the_plane_is_the_reference_of_every_pixel(save_images, pair, tmp_path):
    """The gains of the images need not be uniform: they are divided out."""
    # The amplitude grows by 65 % over the rows, the phase by 0.3 rad over the columns.
    gain = np.exp(np.add.outer(np.linspace(0, 0.5, 150), np.linspace(0, 0.3j, 150)))
    plate = save_images("plate", h=-gain, v=-0.5 * gain)
    scene = save_images(h=-pair["h"] * gain, v=-0.5 * pair["v"] * gain)
    out = tmp_path / "out"
    assert main(["process", str(scene), "--reference", str(plate), "--out", str(out), "--model", "none"]) == 0
    assert ProcessedScan(out).materials.metal_reference.certain


def test_a_library_is_trained_on_labelled_products_of_given_images(labels_folder, tmp_path):
    for name in ("first", "second"):
        folder = Path(shutil.copytree(labels_folder, tmp_path / name))
        (folder / "plates.json").rename(folder / f"{name}.json")
        assert main(["process", str(folder), "--out", str(tmp_path / "out" / name), "--model", "none"]) == 0
        # Patch 1 is copper, and so on.
        options = []
        for number, box_name in enumerate(BOXES, 1):
            options += ["--rename", f"{number}={box_name}"]
        assert main(["label", str(tmp_path / "out" / name), "--from-patches", "--metal", "1", *options]) == 0
    products = [str(tmp_path / "out" / name) for name in ("first", "second")]
    assert main(["train", *products, "--out", str(tmp_path / "library.npz")]) == 0
    entries = Library.load(tmp_path / "library.npz").entries
    assert {entry.name for entry in entries} == set(BOXES)
    assert {round(entry.incidence_deg, 1) for entry in entries} == {ANGLE}


def test_all_images_of_a_folder_are_found(labels_folder):
    copied_folder = shutil.copytree(labels_folder, labels_folder.parent / "other")
    assert find_scans([labels_folder.parent]) == [copied_folder, labels_folder]


# Folder of the published rig's own picture and its boxes, which is not part of the repository.
PUBLISHED = os.environ.get("POLYSIGHT_PUBLISHED_IMAGES")


@pytest.mark.skipif(PUBLISHED is None, reason="POLYSIGHT_PUBLISHED_IMAGES is not set: the folder of the real picture")
@pytest.mark.parametrize("with_boxes", [True, False])
@pytest.mark.parametrize("form", ["npz", "labels"])
def test_the_published_picture_has_nine_plates_and_copper_is_the_reference(rig, tmp_path, form, with_boxes):
    source = Path(PUBLISHED or "") / "20250612_142257_multi.npz"
    boxes = json.loads(source.with_suffix(".json").read_text())["boxes_px"]
    path = source
    drawn = None
    if form == "npz" and with_boxes:
        drawn = Labels({name: (b[0], b[1], b[2], b[3]) for name, b in boxes.items()})
    if form == "labels":
        path = tmp_path / "multi"
        path.mkdir()
        with np.load(source) as arrays:
            for name in "hv":
                np.save(path / f"sar_{name}.npy", arrays[name])
        (path / "multi.json").write_text(json.dumps({"labels": boxes if with_boxes else {}}))
    pair = read_given_images(path, rig)
    settings = Settings(incidence_deg=ANGLE)
    scan = analyse_given_images(pair, settings, Inputs(labels=drawn), rig)[0]
    assert len(scan.segments) == 9
    assert scan.verdict.level == "care"
    (metal,) = (s for s in scan.segments if s.metal_reference)
    x0, y0, x1, y1 = boxes["copper"]
    # A folder has its top row first.
    row = 150 - (y0 + y1) / 2 if form == "labels" else (y0 + y1) / 2
    # Pixels of 2 mm, from the middle of the image.
    assert (metal.centre_x_mm, metal.centre_y_mm) == pytest.approx((x0 + x1 - 150, 2 * row - 150), abs=4)


@pytest.mark.parametrize("has_scan_file", [True, False], ids=["with scan.json", "alone"])
def test_images_of_a_simulated_scan_are_reported_as_simulated(tmp_path, rig, pair, has_scan_file):
    """Images of this release say so themselves; those of earlier ones have it in scan.json of their folder only."""
    name = "image.npz" if has_scan_file else "copy.npz"
    axis_m = 0.002 * (np.arange(len(pair["h"])) - len(pair["h"]) / 2)
    images = Images(pair["h"], pair["v"], axis_m, axis_m, np.ones(pair["h"].shape, bool), pair["h"] / pair["v"])
    write_image(tmp_path / name, images, simulated=not has_scan_file)
    if has_scan_file:
        write_json(tmp_path / "scan.json", {"scan_id": "s", "simulated": True})
    assert read_given_images(tmp_path / name, rig).simulated
    write_image(tmp_path / "measured.npz", images)
    assert not read_given_images(tmp_path / "measured.npz", rig).simulated


def test_train_on_published_images_says_to_process_them_first(labels_folder, tmp_path, capsys):
    """The advice is not to label the folder itself, which `polysight label` refuses."""
    assert main(["train", str(labels_folder), "--out", str(tmp_path / "own.npz")]) == DataError.exit_status
    err = capsys.readouterr().err
    assert f"do: polysight process {labels_folder} --out out/{labels_folder.name}" in err
    assert f"polysight label {labels_folder}" not in err
