"""A line from polarisation angle to concentration: recovered, judged on new data, with correct intervals."""

import json
import pickle
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from tests.support.refusals import expect_refusal

from polysight.cli.main import main
from polysight.materials import Entry, Library
from polysight.materials.sub_bands import Line, concentrations, fit_concentration, polarisation_angle_rad
from polysight_shared.errors import ErrorCode

SUGAR = {"water": 0.0, "sugar (1.3%)": 1.3, "sugar (3.8%)": 3.8, "sugar (5.1%)": 5.1, "sugar (7.4%)": 7.4}


def make_entry(name, angle_rad, scan="a", incidence_deg=55.0):
    p = np.full(9, np.tan(angle_rad) * np.exp(0.3j), np.complex64)
    return Entry(
        name=name,
        scan=scan,
        h=np.ones(9, np.float32),
        v=np.ones(9, np.float32),
        p=p,
        incidence_deg=incidence_deg,
        simulated=True,
    )


def make_library_of_sugar():
    """Five concentrations in three scans each, on a line of -400 percent a radian."""
    return Library(tuple(make_entry(name, 1.2 - p / 400, f"scan{k}") for name, p in SUGAR.items() for k in range(3)))


def write_materials(folder: Path, entries: Iterable[Entry]) -> None:
    """Write entries in the form of the published data set, relative to an ideal metal."""
    folder.mkdir(parents=True, exist_ok=True)
    ones = np.ones(1, np.complex64)
    for number, entry in enumerate(entries):
        content = {
            "name": entry.name, "collection_name": entry.scan, "incident_angle": entry.incidence_deg,
            "ref_name": "metal", "values": [entry.p.conj(), entry.h.astype(np.complex64), entry.v.astype(np.complex64)],
            "ref_values": [ones, ones, ones], "simulated": entry.simulated,
        }  # fmt: skip
        (folder / f"{number}_{entry.incidence_deg:.0f}.pkl").write_bytes(pickle.dumps(content))


def test_angle_of_metal_is_45_degrees():
    assert polarisation_angle_rad(np.exp(1j)) == pytest.approx(np.pi / 4)


def test_an_exact_line_is_recovered_and_concentrations_left_out_are_predicted():
    result = fit_concentration(make_library_of_sugar(), {"water": 0.0})
    assert result.line.slope == pytest.approx(-400.0, rel=1e-4)
    assert result.median_error < 1e-3
    assert len(result.left_out) == 15
    assert {r.true_percent for r in result.left_out} == set(SUGAR.values())


def test_a_concentration_is_judged_without_its_own_patches():
    """One concentration lies off the line, which the error of the line shows."""
    entries = [*make_library_of_sugar().entries, *(make_entry("sugar (9.0%)", 1.25, f"scan{i}") for i in range(3))]
    result = fit_concentration(Library(tuple(entries)), {"water": 0.0})
    judged = [r for r in result.left_out if r.true_percent == 9.0]
    assert all(abs(r.percent - 9.0) > 5.0 for r in judged)


def test_prediction_intervals_cover_as_often_as_they_say():
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(400):
        y = np.repeat([0.0, 1.3, 3.8, 5.1, 6.3], 2)
        x = 1.2 - y / 400 + 0.002 * rng.standard_normal(y.size)
        line = Line.through(x, y)
        truth = rng.uniform(0, 6)
        low, high = line.interval(1.2 - truth / 400 + 0.002 * rng.standard_normal(), 0.9)
        inside.append(low <= truth <= high)
    assert 0.84 < np.mean(inside) < 0.96


def test_concentrations_are_read_from_names_unless_they_are_given():
    assert concentrations(["Cane Sugar (1.3%, w glass)", "salt 12 %", "oil", "water"], {"water": 0.0}) == {
        "Cane Sugar (1.3%, w glass)": 1.3,
        "salt 12 %": 12.0,
        "water": 0.0,
    }


def test_what_cannot_be_fitted_is_refused():
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        fit_concentration(
            Library(tuple(e for e in make_library_of_sugar().entries if e.name in ("sugar (1.3%)", "sugar (3.8%)")))
        )
    mixed = [*make_library_of_sugar().entries, make_entry("sugar (9.9%)", 1.1, incidence_deg=60.0)]
    with expect_refusal(ErrorCode.MISMATCH, "60.0"):
        fit_concentration(Library(tuple(mixed)))
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        Line.through([1.0, 1.0, 1.0], [0.0, 1.0, 2.0])


@pytest.mark.parametrize("form", ["library", "published files"])
def test_a_library_and_published_files_are_taken_as_typed(tmp_path, capsys, form):
    path = tmp_path / "sugar.npz"
    if form == "library":
        make_library_of_sugar().save(path)
    else:
        path = tmp_path / "materials"
        write_materials(path, make_library_of_sugar().entries)
    assert main(["concentration", str(path), "--value", "water=0", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["median_error_percent"] < 1e-3
    assert result["source"] == "simulated"  # in the published form too
    assert main(["concentration", str(path), "--value", "watr=0"]) != 0
    assert "watr" in capsys.readouterr().err
    assert main(["concentration", str(path), "--value", "water=0"]) == 0
    assert "median error" in capsys.readouterr().out


def test_a_material_that_is_not_used_is_named(tmp_path, capsys):
    path = tmp_path / "library.npz"
    known_library = make_library_of_sugar()
    Library((*known_library.entries, make_entry("copper", 0.785), make_entry("water", 0.7)), {}, "").save(path)
    assert main(["concentration", str(path), "--value", "water=0"]) == 0
    (note,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note")]
    assert "copper" in note
    assert "water" not in note
    assert main(["concentration", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["without_concentration"] == ["copper", "water"]


@pytest.mark.parametrize("text", ["water=nan", "water=inf", "water=-1", "water=101", "water=", "water"])
def test_a_concentration_is_a_percentage(capsys, text):
    with pytest.raises(SystemExit):
        main(["concentration", "library.npz", f"--value={text}"])
    assert text in capsys.readouterr().err
