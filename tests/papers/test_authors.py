"""`polysight reproduce --authors` on files of the published form that the simulator made."""

import json
import os
import pickle
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from tests.support.drawn_files import Errors, Material, write_labels, write_material
from tests.support.paths import RIG_FILE
from tests.support.refusals import expect_refusal

from polysight.cli.main import main
from polysight.materials import Library, classify
from polysight.materials.library import Entry
from polysight.polarimetry import ratio_from_permittivity
from polysight_papers.sensys2026 import dataset_items as authors_items
from polysight_papers.sensys2026.dataset import (
    IMAGES,
    LABELS,
    MATERIALS,
    AuthorsData,
    find_row,
    read_authors,
    read_names,
)
from polysight_papers.sensys2026.dataset_items import (
    AXIAL_RATIO,
    METAL_FACTOR,
    Judgements,
    authors_fig20,
    authors_recipe,
    authors_table2,
    pair_scans,
    select_repeated,
    task_samples,
    without_leakage,
)
from polysight_papers.sensys2026.dataset_sugar import authors_fig21
from polysight_papers.sensys2026.item import table2
from polysight_shared.config import load_instrument
from polysight_shared.errors import DataError, ErrorCode

CHOSEN = (1, 3, 12, 15, 27, 28, 30, 32, 34, 36)
ERRORS = Errors(0.004, 0.01, leakage=0.05)
ROWS = {m.number: m for m in table2()}


def make_material(number):
    m = ROWS[number]
    return Material(m.name, None if number == 1 else m.permittivity, m.thickness_mm)


def list_angles(number):
    if number <= 23:
        return (60, 55)
    if number <= 32:
        return (55,)
    return (60,)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """materials/ with three sets, labels/ with two scans, and an unknown material."""
    folder = tmp_path_factory.mktemp("authors") / "dataset"
    seed = 0
    for k in range(3):
        for number in CHOSEN:
            for angle in list_angles(number):
                seed += 1
                write_material(
                    folder=folder / "materials",
                    material=make_material(number),
                    angle_deg=angle,
                    scan=f"set{k}_{angle}",
                    pixels=60,
                    errors=ERRORS,
                    seed=seed,
                )
    write_material(
        folder=folder / "materials",
        material=Material("unobtainium", 3.0 - 0.1j),
        angle_deg=60,
        scan="set0_60",
        pixels=60,
        errors=ERRORS,
        seed=999,
    )
    boxes = {"copper": (10, 10, 40, 40), "Acrylic (3 mm)": (60, 10, 90, 40), "ceramic": (10, 60, 40, 90)}
    named = {"copper": make_material(1), "Acrylic (3 mm)": make_material(3), "ceramic": make_material(12)}
    for k in range(2):
        write_labels(
            folder=folder / "labels",
            scan=f"scan{k}",
            boxes=boxes,
            materials=named,
            angle_deg=60,
            errors=ERRORS,
            seed=500 + k,
            upside_down=True,
        )
    return folder


@pytest.fixture(scope="module")
def out(dataset, tmp_path_factory):
    folder = tmp_path_factory.mktemp("page")
    with pytest.MonkeyPatch.context() as patch:
        # Few pixels and weights: the page is tested, not the classifier
        patch.setattr(authors_items, "JUDGED_PIXELS", 240)
        patch.setattr(classify, "WEIGHT_GRID", (1.0,))
        assert main(["reproduce", "--authors", str(dataset), "--out", str(folder)]) == 0
    return folder


def test_table_2_is_recovered_from_both_kinds_of_files(out):
    content = json.loads((out / "table2.json").read_text())
    assert content["simulated"] is True
    rows_by_number = {(r["source"], r["number"]): r for r in content["materials"]}
    assert {n for s, n in rows_by_number if s == MATERIALS} == set(CHOSEN)
    assert {n for s, n in rows_by_number if s == LABELS} == {1, 3, 12}
    for (_, number), row in rows_by_number.items():
        assert row["metal_like"] == (number == 1)
        if number == 1:
            continue
        true = ROWS[number].permittivity
        without_leakage = complex(*row["without_leakage"].values())
        assert abs(without_leakage - true) < 0.08 * abs(true)
        # The files contain leakage
        assert abs(complex(*row["as_is"].values()) - true) > abs(without_leakage - true)


def test_the_figures_are_compared_with_the_published_values(out):
    solids = json.loads((out / "fig18.json").read_text())["solids, materials/"]
    assert solids["published_percent"] == 95.74
    assert solids["scores"][0]["split"] == "by pixel (optimistic)"
    assert solids["scores"][1]["split"] == "whole scans left out, 3 scans"
    assert solids["scores"][1]["pixels"] > 0.9
    assert solids["judged_with_scans_left_out"] == 4
    labels = json.loads((out / "fig18.json").read_text())["solids, labels/"]
    # Two scans are too few to leave one out
    assert labels["scores"][1] is None
    channels = json.loads((out / "fig20.json").read_text())
    assert channels["H, materials/"]["by_pixel"] < channels["H+V+P, materials/"]["by_pixel"]
    sugar = json.loads((out / "fig21.json").read_text())[MATERIALS]
    assert sugar["published_median_error_percent"] == 1.548
    assert 0 < sugar["median_error_percent"] < 3
    assert len(sugar["left_out"]) == 12


def test_sugar_is_judged_at_the_angle_with_the_most_solutions_whatever_else_was_scanned_at_another(tmp_path):
    def make_entry(name, percent, angle_deg):
        ratio = np.full(4, np.tan(np.radians(40 + percent / 10)), np.complex64)
        v = np.ones(4, np.float32)
        return Entry(name, scan="1", h=np.abs(ratio), v=v, p=ratio, incidence_deg=angle_deg, simulated=True)

    solutions = [make_entry(f"sugar ({percent}%)", percent, 60.0) for percent in (2, 4, 6, 8)]
    solids = [make_entry(f"solid {k}", 0, 55.0) for k in range(9)]
    library = Library((make_entry("sugar (2%)", 2, 55.0), *solids, *solutions))
    data = AuthorsData(tmp_path, load_instrument(RIG_FILE), {MATERIALS: library}, {}, ())
    judged = authors_fig21(data).data[MATERIALS]
    assert judged["angle_deg"] == 60.0
    assert len(judged["left_out"]) == len(solutions)


def test_the_page_says_that_the_files_were_simulated_and_what_was_left_out(out, dataset):
    page = (out / "reproduce.html").read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(?!data:|#)', page)
    assert "SIMULATED FILES" in page
    assert "unobtainium" in page
    assert "y from the last row" in page
    assert "Fig. 18" in page
    assert "“copper” = 1" in page
    assert "How the noise was set" not in page
    assert (out / "fig20.csv").read_text().startswith("simulated files: ")
    assert not read_authors(dataset, RIG_FILE).sources[MATERIALS].names.count("unobtainium")


def test_the_meaning_of_a_name_can_be_given(dataset, tmp_path):
    names = tmp_path / "names.json"
    names.write_text('{"unobtainium": 20}')
    data = read_authors(dataset, RIG_FILE, names=names)
    assert ROWS[20].name in data.sources[MATERIALS].names
    names.write_text('{"unobtainium": 99}')
    with expect_refusal(ErrorCode.VALUE_INVALID, 99):
        read_names(names)


def test_every_row_of_table_2_means_itself_and_a_stranger_none():
    for m in table2():
        assert find_row(m.name, m.thickness_mm) == m.number
    assert find_row("copper_plate") == 1
    assert find_row("PET", 0.5) == 5
    assert find_row("pet_1mm") == 6
    assert find_row("Cane Sugar (3.8%, \\w glass)") == 29
    assert find_row("unobtainium") is None
    # Two rows
    assert find_row("PLA") is None


def test_images_made_here_are_turned_to_lie_as_the_authors_own(dataset, tmp_path):
    # Ours have the other sign of phase
    h = np.load(dataset / "labels" / "scan0" / "sar_h.npy").conj()
    v = np.load(dataset / "labels" / "scan0" / "sar_v.npy").conj()
    folder = tmp_path / "scan0"
    folder.mkdir()
    our_images = {"h": np.rot90(h, 1), "v": np.rot90(v, 1), "valid": np.ones(h.shape, bool)}
    np.savez(folder / "image.npz", **our_images)
    data = read_authors(dataset, RIG_FILE, images=tmp_path)
    authors_entries = {(e.name, e.scan): e for e in data.sources[LABELS].entries}
    for e in data.sources[IMAGES].entries:
        assert e.scan == "scan0"
        np.testing.assert_allclose(e.p, authors_entries[e.name, e.scan].p, rtol=1e-4)
    assert any("scan1: no image made here" in n for n in data.notices)


class Hostile:
    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


def test_a_hostile_or_damaged_file_is_refused_and_named_and_stops_no_other(dataset, tmp_path):
    shutil.copytree(dataset, tmp_path / "dataset")
    target = tmp_path / "ran"
    (tmp_path / "dataset" / "materials" / "evil_60.pkl").write_bytes(pickle.dumps({"name": Hostile(target)}))
    (tmp_path / "dataset" / "labels" / "scan1" / "sar_v.npy").write_bytes(b"cut")
    data = read_authors(tmp_path / "dataset", RIG_FILE)
    assert not target.exists()
    assert any("evil_60.pkl: refused" in n and "system" in n for n in data.notices)
    assert any("sar_v.npy" in n for n in data.notices)
    assert data.sources[LABELS].scans == ("scan0",)
    assert len(data.sources[MATERIALS].entries) == len(read_authors(dataset, RIG_FILE).sources[MATERIALS].entries)


def test_pairs_of_scans_share_no_scan_and_both_angles_are_seen(dataset):
    data = read_authors(dataset, RIG_FILE)
    first = data.select(MATERIALS, range(1, 24), 60.0)
    second = data.select(MATERIALS, range(1, 24), 55.0)
    a, b = pair_scans(first, second)
    assert a.scans == b.scans
    assert len(a.scans) == 3
    samples = task_samples(data, MATERIALS, "solids, two angles")
    assert samples is not None
    assert samples.x.shape[1] == 8
    repeated_samples = select_repeated(samples)
    assert repeated_samples is not None
    first_library = Library(tuple(e for e in first.entries if e.scan == first.scans[0]))
    assert pair_scans(first_library, second)[0].scans == (f"{first.scans[0]} and {second.scans[0]}",)


def test_nothing_to_classify_is_refused(dataset):
    data = read_authors(dataset, RIG_FILE)
    with expect_refusal(ErrorCode.NO_DATA):
        authors_fig20(Judgements(replace(data, sources={})))


def test_leakage_is_taken_out_exactly_and_the_recipe_undoes_its_own_constants():
    t = np.array([1.0, 3 - 1j, 8 + 2j])
    np.testing.assert_allclose(without_leakage((t + 0.05) / (1 + 0.05 * t), 0.05), t)
    eps = 4.0 - 0.5j
    p = complex(ratio_from_permittivity(eps, np.radians(60.0))) * 0.8
    measured = np.full(9, (p + 0.05) / (1 + 0.05 * p))
    assert authors_recipe(measured, 60.0) == pytest.approx(eps, rel=1e-6)


@pytest.mark.parametrize("source", [MATERIALS, IMAGES])
def test_the_recipe_takes_out_only_leakage_that_is_there(dataset, source):
    """Images made here have no leakage any more."""
    acrylic = ROWS[3]
    p = complex(ratio_from_permittivity(acrylic.permittivity, np.radians(60.0))) / METAL_FACTOR
    if source != IMAGES:
        p = (p + AXIAL_RATIO) / (1 + AXIAL_RATIO * p)
    ones = np.ones(9, np.float32)
    entry = Entry(acrylic.name, "a scan", ones, ones, np.full(9, p, np.complex64), 60.0, simulated=True)
    data = replace(read_authors(dataset, RIG_FILE), sources={source: Library((entry,))})
    (row,) = authors_table2(data).data["materials"]
    assert row["authors_recipe"] == pytest.approx(acrylic.permittivity, rel=1e-5)


def test_a_library_is_made_of_both_sources_without_leakage(dataset, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(classify, "WEIGHT_GRID", (1.0,))
    out = tmp_path / "library.npz"
    assert main(["train", "--authors", str(dataset), "--out", str(out)]) == 0
    library = Library.load(out)
    assert library.simulated
    assert library.names == tuple(sorted(ROWS[n].name for n in CHOSEN))
    assert "scan1" in library.scans
    assert set(library.fit["angles"]) == {"55", "60"}
    for e in library.entries:
        eps = next(m for m in ROWS.values() if m.name == e.name).permittivity
        if e.name == "Metal":
            true = 1
        else:
            true = complex(ratio_from_permittivity(eps, np.radians(e.incidence_deg)))
        assert np.median(e.p.real) + 1j * np.median(e.p.imag) == pytest.approx(true, rel=0.08)
        np.testing.assert_allclose(abs(e.p), e.h / e.v, rtol=1e-5)
    output = capsys.readouterr()
    assert "unobtainium" in output.err
    assert "60 degrees: on scans left out" in output.out


def test_training_on_one_scan_of_each_material_claims_no_accuracy(tmp_path, capsys, monkeypatch):
    """Metal is the reference of both scans, so that its recognition is not a result."""
    monkeypatch.setattr(classify, "WEIGHT_GRID", (1.0,))
    for k, material_index in enumerate((3, 12)):
        for number in (1, material_index):
            write_material(
                folder=tmp_path / "materials",
                material=make_material(number),
                angle_deg=60,
                scan=f"set{k}",
                pixels=30,
                errors=ERRORS,
                seed=10 * k + number,
            )
    out = tmp_path / "library.npz"
    assert main(["train", "--authors", str(tmp_path), "--out", str(out)]) == 0
    output = capsys.readouterr().out
    assert "1.0" not in output
    assert "100" not in output
    assert "{" not in output
    assert "accuracy not known" in output
    library = Library.load(out)
    assert library.fit["angles"]["60"]["pixel_accuracy"] is None
    assert "100.0 %" not in classify.describe_classifier(classify.Classifier(library))


@pytest.mark.parametrize(
    "stand",
    [
        # Materials of each scan at 60 degrees, and pixels of a box.
        [[(1, 60), (3, 60)], [(12, 60)]], [[(3, 60), (15, 60), (12, 60)]], [[(3, 1), (15, 1)]],
        [[(3, 2), (15, 2)], [(3, 60)]], [[(3, 20), (15, 40)]], [[(1, 9), (3, 7)], [(1, 5)], [(12, 1)]],
    ],
)  # fmt: skip
@pytest.mark.parametrize("make", [authors_items.authors_fig18, authors_fig20])
def test_few_scans_of_few_pixels_give_figures_or_are_refused(tmp_path, monkeypatch, stand, make):
    monkeypatch.setattr(authors_items, "JUDGED_PIXELS", 240)
    monkeypatch.setattr(classify, "WEIGHT_GRID", (1.0,))
    for seed in range(3):
        folder = tmp_path / f"{seed}" / "materials"
        for k, boxes in enumerate(stand):
            for number, pixels in boxes:
                drawn = 100 * seed + 10 * k + number
                write_material(
                    folder=folder,
                    material=make_material(number),
                    angle_deg=60,
                    scan=f"set{k}",
                    pixels=pixels,
                    errors=ERRORS,
                    seed=drawn,
                )
        try:
            table = make(Judgements(read_authors(folder.parent, RIG_FILE))).tables[0]
        except DataError:
            continue
        assert "nan" not in str(table.rows)


def test_refusals(dataset, tmp_path, capsys):
    assert main(["reproduce", "--authors", str(dataset), "--out", str(tmp_path / "a"), "fig3"]) == 2
    assert "cannot be made from the published files" in capsys.readouterr().err
    assert main(["reproduce", "--authors", str(tmp_path), "--out", str(tmp_path / "a")]) == 3
    assert "neither materials/" in capsys.readouterr().err
    assert main(["reproduce", "--names", "x.json", "--out", str(tmp_path / "a")]) == 2


@pytest.mark.parametrize(("patches", "pixels_of_each"), [(5, 300), (10, 150), (60, 25), (400, 6)])
def test_a_task_is_judged_with_equally_many_pixels_of_each_patch(patches, pixels_of_each):
    ones = np.ones(310, np.float32)
    entries = [
        Entry(name=f"{i % 2}", scan=f"{i}", h=ones, v=ones, p=ones + 0j, incidence_deg=60.0, simulated=True)
        for i in range(patches)
    ]
    samples = authors_items._samples(Library(tuple(entries)))
    assert np.bincount(samples.patches).tolist() == [pixels_of_each] * patches
