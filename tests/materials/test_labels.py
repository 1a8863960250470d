"""Named boxes in an image: which boxes and names are refused, and what label files and libraries keep of them."""

import json

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight import materials
from polysight.process import Inputs, convert_boxes_to_patches
from polysight.settings import DEFAULT
from polysight_shared.errors import ErrorCode

# Centres of 50 pixels of 2 mm: the image reaches from -50 to 50 mm along both axes. Boxes are x0, y0, x1, y1 in mm.
X_M = Y_M = np.linspace(-0.049, 0.049, 50)
COPPER = (-40.0, -10.0, -10.0, 10.0)
OAK = (10.0, -10.0, 40.0, 10.0)
NAN = float("nan")


def check_boxes(boxes, **fields):
    """Return labels with these boxes if they can be used on the image above; `fields` are the other fields."""
    return materials.check_labels(materials.Labels(boxes, "mm", **fields), X_M, Y_M)


INVALID = ErrorCode.VALUE_INVALID
CONFLICT = ErrorCode.VALUES_CONFLICT


# `values` are texts in the message.
@pytest.mark.parametrize(
    ("boxes", "fields", "code", "values"),
    [
        # Beyond the edge of the image, by 0.5 mm and completely
        ({"copper": COPPER, "oak": (10, -10, 50.5, 10)}, {}, INVALID, ("oak", "0.5 mm", "-50.0 to 50.0")),
        ({"copper": COPPER, "oak": (200, 200, 240, 240)}, {}, INVALID, ("oak", "-50.0 to 50.0")),
        # Copper ends at x = -10: an overlap of 5 x 20 mm
        ({"copper": COPPER, "oak": (-15, -10, 40, 10)}, {}, CONFLICT, ("copper", "oak", "5.0 x 20.0 mm")),
        # No height, corners exchanged, not finite
        ({"copper": COPPER, "oak": (10, 10, 40, 10)}, {}, INVALID, ("oak",)),
        ({"copper": COPPER, "oak": (40, -10, 10, 10)}, {}, INVALID, ("oak", "x0", "x1")),
        ({"copper": COPPER, "oak": (NAN, -10, 10, 10)}, {}, INVALID, ("oak", "nan")),
        ({"copper": COPPER, "oak": (10, -10, float("inf"), 10)}, {}, INVALID, ("oak", "inf")),
        # Between the centres of pixels, which lie at 9, 11, ... mm
        ({"copper": COPPER, "oak": (10.2, 0.2, 10.4, 0.4)}, {}, ErrorCode.NO_DATA, ("oak",)),
        # Two names that differ only in their case: the message proposes Oak#2 for the second one.
        ({"oak": OAK, "Oak": COPPER}, {}, ErrorCode.NAME_TAKEN, ("Oak", "oak", "Oak#2")),
        # No box has the name of a metal; two boxes have one; the metal that is named has no box.
        ({"oak": OAK, "glass": COPPER}, {}, ErrorCode.KEY_MISSING, ("--metal", "oak, glass")),
        ({"brass": OAK, "copper": COPPER}, {}, ErrorCode.KEY_MISSING, ("--metal", "brass, copper")),
        ({"oak": OAK, "copper": COPPER}, {"metal": "silver"}, ErrorCode.KEY_UNKNOWN, ("silver", "oak, copper")),
        # Names with a control character, with more than 80 characters, empty, reserved, a number, and with an empty
        # specimen
        ({"copper": COPPER, "a\x07b": OAK}, {}, INVALID, (r"'a\x07b'",)),
        ({"copper": COPPER, "n" * 300: OAK}, {}, INVALID, ("300", "80")),
        ({"copper": COPPER, " ": OAK}, {}, INVALID, ("name ''",)),
        ({"copper": COPPER, "Unknown": OAK}, {}, INVALID, ("Unknown",)),
        ({"copper": COPPER, "17": OAK}, {}, INVALID, ("17",)),
        ({"copper": COPPER, "oak#": OAK}, {}, INVALID, ("specimen ''",)),
    ],
)
def test_boxes_and_names_that_cannot_be_used_for_training_are_refused(boxes, fields, code, values):
    with expect_refusal(code, *values) as refusal:
        check_boxes(boxes, **fields)
    assert refusal.value.why
    assert refusal.value.remedy


def test_boxes_may_touch_and_reach_the_edge_of_the_image():
    boxes = check_boxes({"copper": (-50.0, -50.0, 0.0, 50.0), "oak": (0.0, -50.0, 50.0, 50.0)})
    assert boxes.metal == "copper"
    assert list(boxes.boxes) == ["copper", "oak"]
    segmentation, names = boxes.patches(X_M, Y_M)
    # Each is one half of the 50 x 50 pixels.
    assert [p.pixels for p in segmentation.patches] == [1250, 1250]
    assert names == {1: "copper", 2: "oak"}


def test_a_box_where_nothing_was_scanned_is_refused():
    # Oak lies at positive x, in the columns from 25 on.
    valid = np.ones((50, 50), bool)
    valid[:, 25:] = False
    with expect_refusal(ErrorCode.NO_DATA, "oak"):
        materials.check_labels(materials.Labels({"copper": COPPER, "oak": OAK}, "mm"), X_M, Y_M, valid)


def test_a_single_box_needs_no_metal():
    assert check_boxes({"oak": OAK}).metal is None


def test_the_specimen_of_a_box_is_given_or_stands_after_a_hash_in_its_name():
    boxes = {"copper": COPPER, "oak": (10, -10, 20, 10), "oak#2": (30, -10, 40, 10)}
    labels = check_boxes(boxes, specimens={"oak": "1"})
    assert labels.specimen("copper") is None
    assert labels.specimen("oak") == "1"
    assert labels.specimen("oak#2") == "2"


@pytest.mark.parametrize(
    ("text", "name"),
    [
        # A letter and its accent become one character. Spaces at the ends are removed, and several spaces become one.
        # The second text is Japanese for rubber wood.
        ("  ha\u0308rtes  Holz\n", "h\u00e4rtes Holz"),
        ("\u6a61\u6728", "\u6a61\u6728"),
        ("cerise\u0301 #2", "ceris\u00e9#2"),
        ("n = 1.5", "n = 1.5"),
    ],
)
def test_names_of_any_script_are_kept_in_one_form(text, name):
    assert materials.normalise_box_name(text) == name
    # The name of the material, before the hash, already has the form in which it is kept.
    material, _, _ = name.partition("#")
    assert materials.clean_name(material) == material


# Zero-width space, soft hyphen, word joiner and byte-order mark
@pytest.mark.parametrize("invisible", ["\u200b", "\u00ad", "\u2060", "\ufeff"])
def test_a_name_with_an_invisible_character_is_refused(invisible):
    with expect_refusal(ErrorCode.VALUE_INVALID):
        materials.clean_name(f"rubber{invisible}")


def test_label_files_are_read_back(tmp_path):
    path = tmp_path / "labels.json"
    labels = check_boxes({"copper": COPPER, "\u6a61\u6728": OAK}, specimens={"\u6a61\u6728": "board 7"})
    path.write_bytes(materials.pack_labels(labels))
    assert materials.read_labels(path) == labels
    # The file has the characters themselves, not their codes.
    assert "\u6a61\u6728" in path.read_text(encoding="utf-8")


def test_boxes_of_label_files_of_earlier_releases_are_in_pixels(tmp_path):
    path = tmp_path / "labels.json"
    path.write_text(json.dumps({"labels": {"copper": [5, 20, 20, 30]}}))
    labels = materials.read_labels(path)
    assert labels.unit == "pixel"
    assert not labels.by_hand
    assert labels.metal is None
    assert labels.is_metal("copper")
    # Pixel 5 begins 10 mm after the edge at -50 mm, and so on: the box of copper above.
    labels_in_mm = labels.convert_to_mm(X_M, Y_M)
    assert labels_in_mm.boxes["copper"] == pytest.approx(COPPER)
    segmentation, _ = labels.patches(X_M, Y_M)
    segmentation_in_mm, _ = labels_in_mm.patches(X_M, Y_M)
    # Copper is the only patch: the label of its pixels is 1, that of all others 0.
    (copper,) = segmentation.patches
    np.testing.assert_array_equal(segmentation_in_mm.labels, copper.mask.astype(int))


@pytest.mark.parametrize(
    "field", [{"unit": "inch"}, {"metal": "silver"}, {"specimens": {"silver": "1"}}, {"specimens": [1]}, {"metal": 3}]
)
def test_a_label_file_with_an_invalid_unit_metal_or_specimen_is_refused(tmp_path, field):
    path = tmp_path / "labels.json"
    path.write_text(json.dumps({"labels": {"copper": [5, 20, 20, 30]}, **field}))
    (key,) = field
    with expect_refusal(ErrorCode.VALUE_INVALID, path, key):
        materials.read_labels(path)


def test_boxes_drawn_by_hand_are_checked_before_a_scan_is_processed_with_them():
    overlapping = materials.Labels({"copper": COPPER, "oak": (-15.0, -10.0, 40.0, 10.0)}, "mm", by_hand=True)
    with expect_refusal(ErrorCode.VALUES_CONFLICT, "copper", "oak"):
        convert_boxes_to_patches(DEFAULT, Inputs(overlapping), X_M, Y_M)
    labels = materials.Labels({"tin": COPPER, "oak": OAK}, "mm", metal="tin", by_hand=True)
    patches = convert_boxes_to_patches(DEFAULT, Inputs(labels), X_M, Y_M)
    assert patches.metal == 1
    assert patches.names == {1: "tin", 2: "oak"}


def test_libraries_keep_the_specimen_and_old_files_have_none(tmp_path):
    entry = materials.Entry(
        name="oak",
        scan="a",
        h=np.ones(3, np.float32),
        v=np.ones(3, np.float32),
        p=np.ones(3, np.complex64),
        incidence_deg=55.0,
        simulated=False,
        specimen="board 7",
    )
    materials.Library((entry,)).save(tmp_path / "l.npz")
    assert materials.Library.load(tmp_path / "l.npz").entries[0].specimen == "board 7"
    with np.load(tmp_path / "l.npz") as archive:
        content = dict(archive)
    meta = json.loads(content["meta"].tobytes())
    del meta["entries"][0]["specimen"]
    old_meta = json.dumps(meta).encode()
    content["meta"] = np.frombuffer(old_meta, np.uint8)
    np.savez(tmp_path / "old.npz", **content)
    assert materials.Library.load(tmp_path / "old.npz").entries[0].specimen is None


# In the second box the lower left corner of oak is moved 0.5 mm into copper.
@pytest.mark.parametrize(
    ("oak", "overlapping_oak"),
    [
        # Right of copper
        ((0.0, -20.0, 20.0, 20.0), (-0.5, -20.0, 20.0, 20.0)),
        # Above copper: y points up.
        ((-20.0, 5.0, 20.0, 20.0), (-20.0, -0.5, 20.0, 20.0)),
        # To the right and above
        ((5.0, 5.0, 20.0, 20.0), (-0.5, -0.5, 20.0, 20.0)),
    ],
)
def test_boxes_next_to_or_above_each_other_do_not_overlap(oak, overlapping_oak):
    copper = (-20.0, -20.0, 0.0, 0.0)
    assert set(check_boxes({"copper": copper, "oak": oak}).boxes) == {"copper", "oak"}
    with expect_refusal(CONFLICT, "overlap"):
        check_boxes({"copper": copper, "oak": overlapping_oak})
