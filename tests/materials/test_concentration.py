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

# Name to percent by weight. The names with a number state it; that of water is given to the functions.
SUGAR = {"water": 0.0, "sugar (1.3%)": 1.3, "sugar (3.8%)": 3.8, "sugar (5.1%)": 5.1, "sugar (7.4%)": 7.4}


# A line of the published kind: the polarisation angle is 1.2 rad for water and falls by 1 rad per 400 percent of sugar.
ANGLE_OF_WATER_RAD = 1.2
PERCENT_PER_RAD = -400.0


def compute_polarisation_angle(percent):
    """Return the angle, radians, of this concentration on the line."""
    return ANGLE_OF_WATER_RAD + percent / PERCENT_PER_RAD


def make_entry(name, angle_rad, scan="a", incidence_deg=55.0):
    """Return a patch of nine equal pixels with this polarisation angle, arctan |P|; the phase of P is any."""
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
    """Return a library of five concentrations in three scans each, all exactly on the line."""
    entries = []
    for name, percent in SUGAR.items():
        angle_rad = compute_polarisation_angle(percent)
        entries += [make_entry(name, angle_rad, f"scan{scan}") for scan in range(3)]
    return Library(tuple(entries))


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


def test_the_polarisation_angle_of_metal_is_45_degrees():
    """|P| is 1, whatever its phase."""
    assert polarisation_angle_rad(np.exp(1j)) == pytest.approx(np.pi / 4)


def test_an_exact_line_is_recovered_and_concentrations_left_out_are_predicted():
    result = fit_concentration(make_library_of_sugar(), {"water": 0.0})
    # Entries hold P in single precision: 1e-7 of the angle is 5e-5 percent.
    assert result.line.slope == pytest.approx(PERCENT_PER_RAD, rel=1e-4)
    assert result.median_error < 1e-3
    # Five concentrations in three scans
    assert len(result.left_out) == 15
    assert {r.true_percent for r in result.left_out} == set(SUGAR.values())


def test_a_concentration_is_judged_without_its_own_patches():
    """The patches of one concentration, 9 percent, lie far from the line of the others.

    That line gives 400 * (1.2 - 1.25) = -20 percent for their angle. A line through all patches, with these among them,
    gives 7 percent.
    """
    odd_entries = [make_entry("sugar (9.0%)", 1.25, f"scan{i}") for i in range(3)]
    entries = (*make_library_of_sugar().entries, *odd_entries)
    result = fit_concentration(Library(entries), {"water": 0.0})
    predictions = [r.percent for r in result.left_out if r.true_percent == 9.0]
    # Entries hold P in single precision, as above.
    assert predictions == pytest.approx([-20.0] * 3, abs=1e-3)


def test_prediction_intervals_cover_as_often_as_they_say():
    angle_std_rad = 0.002
    rng = np.random.default_rng(3)
    inside = []
    for _ in range(400):
        known_percent = np.repeat([0.0, 1.3, 3.8, 5.1, 6.3], 2)
        noise_rad = angle_std_rad * rng.standard_normal(known_percent.size)
        line = Line.through(compute_polarisation_angle(known_percent) + noise_rad, known_percent)
        new_percent = rng.uniform(0, 6)
        new_angle_rad = compute_polarisation_angle(new_percent) + angle_std_rad * rng.standard_normal()
        low, high = line.interval(new_angle_rad, confidence=0.9)
        inside.append(low <= new_percent <= high)
    # 0.9 within four standard deviations of the share of 400 draws: sqrt(0.9 * 0.1 / 400) = 0.015.
    assert 0.84 < np.mean(inside) < 0.96


def test_concentrations_are_read_from_names_unless_they_are_given():
    assert concentrations(["Cane Sugar (1.3%, w glass)", "salt 12 %", "oil", "water"], {"water": 0.0}) == {
        "Cane Sugar (1.3%, w glass)": 1.3,
        "salt 12 %": 12.0,
        "water": 0.0,
    }


def test_two_concentrations_or_two_incidence_angles_or_one_polarisation_angle_are_refused():
    entries = make_library_of_sugar().entries
    two_concentrations = tuple(e for e in entries if e.name in ("sugar (1.3%)", "sugar (3.8%)"))
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        fit_concentration(Library(two_concentrations))
    two_incidence_angles = (*entries, make_entry("sugar (9.9%)", 1.1, incidence_deg=60.0))
    with expect_refusal(ErrorCode.MISMATCH, "60.0"):
        fit_concentration(Library(two_incidence_angles))
    # Three concentrations with the same angle: the line through them is vertical.
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA):
        Line.through([1.0, 1.0, 1.0], [0.0, 1.0, 2.0])


@pytest.mark.parametrize("form", ["library", "published files"])
def test_the_command_reads_a_library_and_published_files(tmp_path, capsys, form):
    path = tmp_path / "sugar.npz"
    if form == "library":
        make_library_of_sugar().save(path)
    else:
        path = tmp_path / "materials"
        write_materials(path, make_library_of_sugar().entries)
    assert main(["concentration", str(path), "--value", "water=0", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    # Rounding to single precision, as above
    assert result["median_error_percent"] < 1e-3
    # Published files that the simulator wrote say so, too.
    assert result["source"] == "simulated"
    # A misspelt name is refused, and shown.
    assert main(["concentration", str(path), "--value", "watr=0"]) != 0
    assert "watr" in capsys.readouterr().err
    assert main(["concentration", str(path), "--value", "water=0"]) == 0
    assert "median error" in capsys.readouterr().out


def test_the_command_lists_materials_without_a_concentration(tmp_path, capsys):
    path = tmp_path / "library.npz"
    entries = (*make_library_of_sugar().entries, make_entry("copper", 0.785), make_entry("water", 0.7))
    Library(entries, {}, "").save(path)
    assert main(["concentration", str(path), "--value", "water=0"]) == 0
    (note,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note")]
    assert "copper" in note
    assert "water" not in note
    assert main(["concentration", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["without_concentration"] == ["copper", "water"]


@pytest.mark.parametrize("text", ["water=nan", "water=inf", "water=-1", "water=101", "water=", "water"])
def test_a_concentration_that_is_not_a_number_from_0_to_100_is_refused(capsys, text):
    with pytest.raises(SystemExit):
        main(["concentration", "library.npz", f"--value={text}"])
    assert text in capsys.readouterr().err
