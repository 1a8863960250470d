"""`polysight label`: boxes come from options or from answers; they are written, or refused with a reason."""

import json
from dataclasses import replace

import numpy as np
import pytest
from tests.support.products import write_judged_products
from tests.support.refusals import expect_refusal

from polysight.cli.main import build_parser, main
from polysight.jobs.label import Edits, apply_edits, label
from polysight.materials import read_labels
from polysight.products import find_labels, find_products, replace_products, write_image, write_json
from polysight_shared.errors import ErrorCode

# Names for patches 1 and 2; the second is "oak" in Chinese.
NAMED = ["--from-patches", "--rename", "1=copper", "--rename", "2=\u6a61\u6728"]


@pytest.fixture
def products(tmp_path):
    """Products of a scan with three patches: the metal reference, one named PET, one not judged."""
    return write_judged_products(tmp_path / "out", "good")


def load_boxes(folder):
    return read_labels(folder / "labels.json")


def script_answers(*answers):
    """Return a function that answers questions in this order, and the list of questions that it was asked.

    After the last answer the input ends.
    """
    remaining = list(answers)
    questions = []

    def ask(question):
        questions.append(question)
        if not remaining:
            raise EOFError
        return remaining.pop(0)

    return ask, questions


def test_patches_get_names_by_their_numbers(products, capsys):
    assert main(["label", str(products), *NAMED]) == 0
    output = capsys.readouterr().out
    named_boxes = load_boxes(products)
    assert list(named_boxes.boxes) == ["copper", "\u6a61\u6728"]
    assert (named_boxes.unit, named_boxes.metal) == ("mm", "copper")
    assert named_boxes.by_hand
    # 9 mm inside the patch, which is x -50 to -20 mm and y -20 to 20 mm.
    assert named_boxes.boxes["copper"] == pytest.approx((-41.0, -11.0, -29.0, 11.0))
    assert "left out, without a name: 3" in output
    assert "\u6a61\u6728" in output
    assert (products / "labels.png").read_bytes().startswith(b"\x89PNG")
    _, found_boxes = find_labels(products)
    assert found_boxes == named_boxes


def test_boxes_are_drawn_moved_renamed_and_removed(products):
    scan = str(products)
    assert main(["label", scan, "--box", "sheet=-40,-10,-30,10", "--box", "oak=0,0,10,10", "--metal", "sheet"]) == 0
    assert main(["label", scan, "--rename", "sheet=tin plate", "--specimen", "oak=board 7"]) == 0
    assert main(["label", scan, "--box", "oak#left=20,0,30,10"]) == 0
    named_boxes = load_boxes(products)
    assert list(named_boxes.boxes) == ["tin plate", "oak", "oak#left"]
    assert named_boxes.metal == "tin plate"
    assert [named_boxes.specimen(n) for n in named_boxes.boxes] == [None, "board 7", "left"]
    assert main(["label", scan, "--remove", "oak", "--box", "oak=0,-20,10,-5"]) == 0
    assert load_boxes(products).boxes["oak"] == (0, -20, 10, -5)
    assert load_boxes(products).specimen("oak") is None


def test_a_patch_declared_as_metal_is_named_metal(products):
    assert main(["label", str(products), "--from-patches", "--metal", "1", "--rename", "2=oak"]) == 0
    named_boxes = load_boxes(products)
    assert list(named_boxes.boxes) == ["metal", "oak"]
    assert named_boxes.metal == "metal"
    assert main(["label", str(products), "--from-patches", "--metal", "1", "--rename", "1=x", "--rename", "2=oak"]) == 0
    assert load_boxes(products).metal == "x"


def test_a_box_without_an_echo_is_reported_by_a_note(products, capsys):
    result = find_products(products)
    # In the right third of the image amplitudes are 40 dB lower.
    dim = np.where(result.x_m > 0.02, 0.01, 1.0).astype(np.float32)
    write_image(
        products / "image.npz",
        replace(result.images, h=result.h * dim, v=result.v * dim, p_sigma=None),
    )
    assert main(["label", str(products), "--box", "oak=-40,-10,-20,10", "--metal", "oak"]) == 0
    assert "note: dark" not in capsys.readouterr().out
    assert main(["label", str(products), "--box", "nothing=30,-10,50,10"]) == 0
    assert "note: as dark as empty background: nothing;" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "code", "value"),
    [
        (["--box", "oak=0,0,100,10"], ErrorCode.VALUE_INVALID, "oak"),
        (["--box", "oak=0,0,10,10", "--box", "oak=20,0,30,10"], ErrorCode.NAME_TAKEN, "oak"),
        (["--from-patches", "--rename", "1=oak", "--rename", "2=oak"], ErrorCode.NAME_TAKEN, "oak"),
        (["--box", "oak=0,0,10,10", "--metal", "copper"], ErrorCode.KEY_UNKNOWN, "copper"),
        (["--rename", "1=oak"], ErrorCode.KEY_UNKNOWN, "1"),
        (["--remove", "oak"], ErrorCode.KEY_UNKNOWN, "oak"),
        (["--from-patches"], ErrorCode.NO_DATA, "labels.json"),
        (["--box", "oak=0,0,10,10", "--list"], ErrorCode.VALUES_CONFLICT, "--list"),
    ],
)
def test_labels_that_cannot_be_used_are_refused_and_nothing_is_written(products, words, code, value):
    args = build_parser().parse_args(["label", str(products), *words])
    with expect_refusal(code, value):
        args.run(args)
    assert not (products / "labels.json").exists()


def test_a_folder_without_an_image_is_to_be_processed_first(tmp_path):
    with expect_refusal(ErrorCode.FILE_MISSING, tmp_path):
        label(tmp_path, Edits(), list_only=True)


def test_a_person_is_asked_for_each_patch(products, capsys):
    ask, questions = script_answers("m", "PET", "pet", "PET", "2")
    assert label(products, Edits(), ask=ask) == 0
    assert list(load_boxes(products).boxes) == ["metal", "PET", "PET#2"]
    assert load_boxes(products).metal == "metal"
    assert "named PET 80 %" in questions[1]
    # Two names that differ only in capitals are reported.
    assert "the name pet" in capsys.readouterr().out
    ask, _ = script_answers("yes", "oak", "glass", "", "nothing", "glass")
    assert label(products, Edits(), ask=ask) == 0
    assert load_boxes(products).metal == "glass"
    labels_before = (products / "labels.json").read_bytes()
    for answers, code in ((["no"], ErrorCode.VALUE_INVALID), (["yes", "copper"], ErrorCode.KEY_MISSING)):
        ask, _ = script_answers(*answers)
        with expect_refusal(code):
            label(products, Edits(), ask=ask)
    assert (products / "labels.json").read_bytes() == labels_before


def test_without_a_terminal_patches_are_listed(products, capsys):
    # The standard input of pytest is not a terminal.
    assert main(["label", str(products)]) == 0
    output = capsys.readouterr().out
    assert "x -41.0 to -29.0, y -11.0 to 11.0 mm  the metal reference" in output
    assert "--from-patches" in output
    assert not (products / "labels.json").exists()


def test_labels_of_a_scan_folder_are_saved_in_the_folder_of_its_rows(tmp_path):
    scan = tmp_path / "scan"
    write_judged_products(scan / "products", "good")
    (scan / "manifest.jsonl").write_text("")
    for folder_given in (scan, scan / "products"):
        assert main(["label", str(folder_given), *NAMED]) == 0
        path, _ = find_labels(folder_given)
        assert path.resolve() == (scan / "labels.json").resolve()
    assert not (scan / "products" / "labels.json").exists()


@pytest.mark.parametrize(("scan_id", "is_kept"), [("one", True), ("another", False)])
def test_boxes_drawn_by_hand_are_kept_only_with_new_products_of_the_same_scan(products, scan_id, is_kept):
    write_json(products / "scan.json", {"scan_id": "one", "simulated": True})
    assert main(["label", str(products), *NAMED]) == 0
    drawn = load_boxes(products)
    with replace_products(products, scan_id) as new:
        (new / "labels.json").write_text(json.dumps({"labels": {"patch": [0, 0, 3, 3]}}))
    assert (load_boxes(products) == drawn) == is_kept
    assert (products / "labels.png").exists() == is_kept


def test_a_file_with_the_names_of_the_classifier_does_not_count_as_labels(products):
    (products / "labels.json").write_text(json.dumps({"labels": {"metal": [0, 0, 3, 3]}}))
    assert find_labels(products) is None


def test_boxes_that_another_command_saved_meanwhile_are_not_overwritten(products, monkeypatch):
    """Otherwise both commands would report that their box is saved, although one box would be lost."""

    def edit_during_another_command(*args):
        monkeypatch.undo()
        assert main(["label", str(products), "--box", "oak=20,0,40,20", "--metal", "oak"]) == 0
        return apply_edits(*args)

    monkeypatch.setattr("polysight.jobs.label.apply_edits", edit_during_another_command)
    with expect_refusal(ErrorCode.MISMATCH, products):
        label(products, Edits(boxes=[("glass", (-40.0, 0.0, -20.0, 20.0))]))
    assert list(load_boxes(products).boxes) == ["oak"]
    label(products, Edits(boxes=[("glass", (-40.0, 0.0, -20.0, 20.0))]))
    assert list(load_boxes(products).boxes) == ["oak", "glass"]
