"""Boxes with names: refused ones, and the content of a label file."""

import json

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight import materials
from polysight.process import Inputs, convert_boxes_to_patches
from polysight.settings import DEFAULT
from polysight_shared.errors import ErrorCode

# 50 pixels of 2 mm: -50 to 50 mm
X_M = Y_M = np.linspace(-0.049, 0.049, 50)
COPPER = (-40.0, -10.0, -10.0, 10.0)
OAK = (10.0, -10.0, 40.0, 10.0)
NAN = float("nan")


def check_boxes(boxes, **more):
    return materials.check_labels(materials.Labels(boxes, "mm", **more), X_M, Y_M)


INVALID = ErrorCode.VALUE_INVALID
CONFLICT = ErrorCode.VALUES_CONFLICT


@pytest.mark.parametrize(
    ("boxes", "more", "code", "values"),
    [
        ({"copper": COPPER, "oak": (10, -10, 50.5, 10)}, {}, INVALID, ("oak", "0.5 mm", "-50.0 to 50.0")),
        ({"copper": COPPER, "oak": (200, 200, 240, 240)}, {}, INVALID, ("oak", "-50.0 to 50.0")),
        ({"copper": COPPER, "oak": (-15, -10, 40, 10)}, {}, CONFLICT, ("copper", "oak", "5.0 x 20.0 mm")),
        ({"copper": COPPER, "oak": (10, 10, 40, 10)}, {}, INVALID, ("oak",)),
        ({"copper": COPPER, "oak": (40, -10, 10, 10)}, {}, INVALID, ("oak", "x0", "x1")),
        ({"copper": COPPER, "oak": (NAN, -10, 10, 10)}, {}, INVALID, ("oak", "nan")),
        ({"copper": COPPER, "oak": (10, -10, float("inf"), 10)}, {}, INVALID, ("oak", "inf")),
        ({"copper": COPPER, "oak": (10.2, 0.2, 10.4, 0.4)}, {}, ErrorCode.NO_DATA, ("oak",)),
        ({"oak": OAK, "Oak": COPPER}, {}, ErrorCode.NAME_TAKEN, ("Oak", "oak", "#2")),
        ({"oak": OAK, "glass": COPPER}, {}, ErrorCode.KEY_MISSING, ("--metal", "oak, glass")),
        ({"brass": OAK, "copper": COPPER}, {}, ErrorCode.KEY_MISSING, ("--metal", "brass, copper")),
        ({"oak": OAK, "copper": COPPER}, {"metal": "silver"}, ErrorCode.KEY_UNKNOWN, ("silver", "oak, copper")),
        ({"copper": COPPER, "a\x07b": OAK}, {}, INVALID, (r"'a\x07b'",)),
        ({"copper": COPPER, "n" * 300: OAK}, {}, INVALID, ("300", "80")),
        ({"copper": COPPER, " ": OAK}, {}, INVALID, ("name ''",)),
        ({"copper": COPPER, "Unknown": OAK}, {}, INVALID, ("Unknown",)),
        ({"copper": COPPER, "17": OAK}, {}, INVALID, ("17",)),
        ({"copper": COPPER, "oak#": OAK}, {}, INVALID, ("specimen ''",)),
    ],
)
def test_boxes_and_names_that_cannot_be_used_for_training_are_refused(boxes, more, code, values):
    with expect_refusal(code, *values) as refusal:
        check_boxes(boxes, **more)
    assert refusal.value.why
    assert refusal.value.remedy


def test_boxes_may_touch_and_reach_the_edge_of_the_image():
    boxes = check_boxes({"copper": (-50.0, -50.0, 0.0, 50.0), "oak": (0.0, -50.0, 50.0, 50.0)})
    assert (boxes.metal, list(boxes.boxes)) == ("copper", ["copper", "oak"])
    segmentation, names = boxes.patches(X_M, Y_M)
    assert [p.pixels for p in segmentation.patches] == [1250, 1250]
    assert names == {1: "copper", 2: "oak"}


def test_a_box_where_nothing_was_scanned_is_refused():
    valid = np.ones((50, 50), bool)
    valid[:, 25:] = False
    with expect_refusal(ErrorCode.NO_DATA, "oak"):
        materials.check_labels(materials.Labels({"copper": COPPER, "oak": OAK}, "mm"), X_M, Y_M, valid)


def test_one_box_needs_no_metal_and_a_second_piece_has_a_name_of_its_own():
    assert check_boxes({"oak": OAK}).metal is None
    boxes = check_boxes(
        {"copper": COPPER, "oak": (10, -10, 20, 10), "oak#2": (30, -10, 40, 10)}, specimens={"oak": "1"}
    )
    assert [boxes.specimen(name) for name in boxes.boxes] == [None, "1", "2"]


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("  ha\u0308rtes  Holz\n", "h\u00e4rtes Holz"),
        ("\u6a61\u6728", "\u6a61\u6728"),
        ("cerise\u0301 #2", "ceris\u00e9#2"),
        ("n = 1.5", "n = 1.5"),
    ],
)
def test_names_of_any_script_are_kept_in_one_form(text, name):
    assert materials.normalise_box_name(text) == name
    assert materials.clean_name(name.partition("#")[0]) == name.partition("#")[0]


@pytest.mark.parametrize("mark", ["\u200b", "\u00ad", "\u2060", "\ufeff"])
def test_invisible_characters_are_not_part_of_a_name(mark):
    with expect_refusal(ErrorCode.VALUE_INVALID):
        materials.clean_name(f"rubber{mark}")


def test_label_files_are_read_back_and_pixels_become_millimetres(tmp_path):
    path = tmp_path / "labels.json"
    labels = check_boxes({"copper": COPPER, "\u6a61\u6728": OAK}, specimens={"\u6a61\u6728": "board 7"})
    path.write_bytes(materials.pack_labels(labels))
    assert materials.read_labels(path) == labels
    assert "\u6a61\u6728" in path.read_text(encoding="utf-8")
    path.write_text(json.dumps({"labels": {"copper": [5, 20, 20, 30]}}))  # as earlier releases wrote them
    labels_of_pixels = materials.read_labels(path)
    assert (labels_of_pixels.unit, labels_of_pixels.by_hand, labels_of_pixels.metal) == ("pixel", False, None)
    assert labels_of_pixels.is_metal("copper")
    assert labels_of_pixels.convert_to_mm(X_M, Y_M).boxes["copper"] == pytest.approx(COPPER)
    assert (
        labels_of_pixels.patches(X_M, Y_M)[0].patches[0].mask.sum()
        == labels_of_pixels.convert_to_mm(X_M, Y_M).patches(X_M, Y_M)[0].labels.sum()
    )


@pytest.mark.parametrize(
    "more", [{"unit": "inch"}, {"metal": "silver"}, {"specimens": {"silver": "1"}}, {"specimens": [1]}, {"metal": 3}]
)
def test_keys_of_another_form_are_refused(tmp_path, more):
    path = tmp_path / "labels.json"
    path.write_text(json.dumps({"labels": {"copper": [5, 20, 20, 30]}, **more}))
    with expect_refusal(ErrorCode.VALUE_INVALID, path, next(iter(more))):
        materials.read_labels(path)


def test_boxes_by_hand_are_judged_before_a_scan_is_processed_with_them():
    overlapping = materials.Labels({"copper": COPPER, "oak": (-15.0, -10.0, 40.0, 10.0)}, "mm", by_hand=True)
    with expect_refusal(ErrorCode.VALUES_CONFLICT, "copper", "oak"):
        convert_boxes_to_patches(DEFAULT, Inputs(overlapping), X_M, Y_M)
    labels = materials.Labels({"tin": COPPER, "oak": OAK}, "mm", "tin", by_hand=True)
    patches = convert_boxes_to_patches(DEFAULT, Inputs(labels), X_M, Y_M)
    assert (patches.metal, patches.names) == (1, {1: "tin", 2: "oak"})


def test_libraries_keep_the_specimen_and_old_files_have_none(tmp_path):
    ones = np.ones(3, np.float32)
    entry = materials.Entry("oak", "a", ones, ones, np.ones(3, np.complex64), 55.0, simulated=False, specimen="board 7")
    materials.Library((entry,)).save(tmp_path / "l.npz")
    assert materials.Library.load(tmp_path / "l.npz").entries[0].specimen == "board 7"
    with np.load(tmp_path / "l.npz") as archive:
        content = dict(archive)
    meta = json.loads(content["meta"].tobytes())
    del meta["entries"][0]["specimen"]
    np.savez(tmp_path / "old.npz", **(content | {"meta": np.frombuffer(json.dumps(meta).encode(), np.uint8)}))
    assert materials.Library.load(tmp_path / "old.npz").entries[0].specimen is None


@pytest.mark.parametrize("oak", [(0.0, -20.0, 20.0, 20.0), (-20.0, 5.0, 20.0, 20.0), (5.0, 5.0, 20.0, 20.0)])
def test_boxes_next_to_or_above_each_other_do_not_overlap(oak):
    copper = (-20.0, -20.0, 0.0, 0.0)
    assert set(check_boxes({"copper": copper, "oak": oak}).boxes) == {"copper", "oak"}
    overlapping_oak = (min(oak[0], -0.5), min(oak[1], -0.5), *oak[2:])
    with expect_refusal(CONFLICT, "overlap"):
        check_boxes({"copper": copper, "oak": overlapping_oak})
