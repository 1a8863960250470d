"""The published label folders: boxes become library entries, for any orientation of the stored images."""

import json

import numpy as np
import pytest
from tests.support.drawn_files import Errors, Material, write_labels
from tests.support.refusals import expect_refusal

from polysight.materials import train
from polysight.polarimetry import ratio_from_permittivity
from polysight_shared.errors import ErrorCode

# Permittivity, and where it is part of the name the thickness in millimetres; metal has no permittivity.
MATERIALS = {
    "Copper plate": Material("copper", None),
    "acrylic_3mm": Material("acrylic", 4.0 - 0.4j, 3.0),
    "ceramic": Material("ceramic", 4.75 - 2.43j),
}
# Corners x0, y0, x1, y1 in pixels.
BOXES = {"Copper plate": (10, 12, 40, 50), "acrylic_3mm": (60, 20, 85, 40), "ceramic": (100, 90, 130, 140)}


def write_scan(folder, seed=1, name="scan_7", **more):
    errors = Errors(amplitude=0.005, phase_rad=0.01)
    return write_labels(folder, name, BOXES, MATERIALS, angle_deg=60.0, errors=errors, seed=seed, **more)


@pytest.mark.parametrize("upside_down", [False, True])
def test_boxes_give_the_materials_ratios_relative_to_metal(tmp_path, upside_down):
    scan = train.read_labelled_scan(write_scan(tmp_path, upside_down=upside_down))
    orientation = train.image_orientation([scan])
    assert ("last row" in orientation) == upside_down
    entries = {e.name: e for e in train.make_entries_of_boxes(scan.orient(orientation), 60.0)}
    assert set(entries) == set(BOXES)
    for name, e in entries.items():
        eps = MATERIALS[name].permittivity
        true = 1.0 if eps is None else complex(ratio_from_permittivity(eps, np.radians(60.0)))
        # Three standard deviations. The part of the errors that all pixels of a box share is 0.35 % and 7 mrad,
        # together 0.8 %; the ratio contains it four times (H and V of the box and of the metal): 1.6 %.
        assert np.median(e.p.real) + 1j * np.median(e.p.imag) == pytest.approx(true, rel=0.05)
        assert e.scan == "scan_7"
        assert e.incidence_deg == 60.0
        assert e.reference == "Copper plate"
        assert e.simulated
        assert e.h.size == train.PUBLISHED_PIXELS


@pytest.mark.parametrize("orientation", list(train.ORIENTATIONS))
def test_the_orientation_of_stored_images_is_recognised(tmp_path, orientation):
    folder = write_scan(tmp_path)
    # The inverse of each reading: it turns an image in the usual orientation into one that must be read that way.
    turn_image = {
        "x to the right, y along the rows": lambda a: a,
        "y from the last row": lambda a: a[::-1],
        "x and y swapped": lambda a: a.T,
        "x and y swapped, y from the last row": lambda a: a[::-1].T,
    }[orientation]
    for name in ("sar_h.npy", "sar_v.npy"):
        np.save(folder / name, turn_image(np.load(folder / name)))
    assert train.image_orientation([train.read_labelled_scan(folder)]) == orientation


def test_a_scan_without_metal_and_damaged_files_are_refused_by_name(tmp_path):
    folder = write_scan(tmp_path)
    content = json.loads((folder / "scan_7.json").read_text())
    del content["labels"]["Copper plate"]
    (folder / "scan_7.json").write_text(json.dumps(content))
    with expect_refusal(ErrorCode.NO_DATA, "scan_7"):
        train.make_entries_of_boxes(train.read_labelled_scan(folder), 60.0)
    np.save(folder / "sar_h.npy", np.ones(3))
    with expect_refusal(ErrorCode.TYPE_WRONG, "sar_h.npy", "float64"):
        train.read_labelled_scan(folder)
    np.save(folder / "sar_h.npy", np.ones((3, 3), complex))
    with expect_refusal(ErrorCode.MISMATCH, (3, 3)):
        train.read_labelled_scan(folder)
    np.save(folder / "sar_h.npy", np.array([{}], dtype=object), allow_pickle=True)
    with expect_refusal(ErrorCode.FILE_UNREADABLE, "sar_h.npy"):
        train.read_labelled_scan(folder)
    (folder / "scan_7.json").unlink()
    with expect_refusal(ErrorCode.FILE_MISSING):
        train.read_labelled_scan(folder)


def test_a_published_box_with_a_corner_that_is_not_finite_is_refused(tmp_path):
    """The remedy is to fetch the file again, not to draw the box again: that is the advice for a user's own boxes."""
    folder = write_scan(tmp_path)
    file = folder / "scan_7.json"
    content = json.loads(file.read_text())
    # 1e400 is beyond the range of a float: Python reads it as infinity.
    for corner in ("NaN", "Infinity", "1e400"):
        content["labels"]["ceramic"] = [100, 90, 130, "corner"]
        file.write_text(json.dumps(content).replace('"corner"', corner))
        with expect_refusal(ErrorCode.VALUE_INVALID, "labels.ceramic", "finite", "fetch it again") as refusal:
            train.read_labelled_scan(folder)
        assert "polysight label" not in refusal.value.remedy


# Squares of the values, which are about 1, leave the range of float32 (1e-38 to 3e38) with the first and last factor.
@pytest.mark.parametrize("factor", [1e-33, 1.0, 1e30])
def test_the_orientation_does_not_depend_on_the_unit_of_the_images(tmp_path, factor, recwarn):
    folder = write_scan(tmp_path, upside_down=True)
    for name in ("sar_h.npy", "sar_v.npy"):
        np.save(folder / name, (factor * np.load(folder / name)).astype(np.complex64))
    assert "last row" in train.image_orientation([train.read_labelled_scan(folder)])
    assert not list(recwarn)


def test_a_missing_image_is_reported_in_words(tmp_path):
    folder = write_scan(tmp_path)
    (folder / "sar_v.npy").unlink()
    with expect_refusal(ErrorCode.FILE_UNREADABLE, "sar_v.npy: not an image: No such file or directory"):
        train.read_labelled_scan(folder)


def test_label_folders_are_listed_and_the_angle_is_read_from_texts(tmp_path):
    write_scan(tmp_path)
    write_scan(tmp_path, name="another")
    (tmp_path / "empty").mkdir()
    assert [f.name for f in train.label_folders(tmp_path)] == ["another", "scan_7"]
    assert train.label_folders(tmp_path / "none") == []
    assert train.find_angle_in_text(["a scan", "plates_at_55deg"]) == 55.0
    assert train.find_angle_in_text(["60 degrees"]) == 60.0
    assert train.find_angle_in_text(["scan 12"]) is None
