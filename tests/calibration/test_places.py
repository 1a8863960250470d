"""Positions of boards and plane: a displaced rig is recovered from a scan of points, and processing uses the result."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
import tomli_w
from tests.support.kept import assert_kept
from tests.support.processes import read_output
from tests.support.refusals import expect_refusal

from polysight.calibration import places
from polysight.calibration.files import Calibration, PlacesFile, load_calibration, open_raw, read_calibration
from polysight.calibration.places import Prior, TargetPoint, fit_places, load_echoes, places_file, read_target
from polysight.imaging.geometry import Antennas
from polysight.jobs.calibrate import take_antenna_places
from polysight_shared.errors import ErrorCode
from polysight_shared.geometry import specular_midpoint_m

# How the true rig differs from its rig file: shifts of the boards (mm), and the object plane farther away
SHIFTS = {"RH": (1.5, -1.0, 0.8), "RV": (-1.2, 0.7, -1.4)}
DEEPER_MM = 1.7

# The target: five points, measured on it. It lies on the object plane with this offset and rotation, which are unknown.
POINTS = [(-60.0, -50.0), (60.0, -45.0), (0.0, 0.0), (-55.0, 55.0), (50.0, 60.0)]
TARGET_OFFSET_MM = (4.0, -3.0)
TARGET_TURN_DEG = 0.5


def place_target(points):
    """x and y of the target's points on the object plane."""
    cos = np.cos(np.radians(TARGET_TURN_DEG))
    sin = np.sin(np.radians(TARGET_TURN_DEG))
    offset_x, offset_y = TARGET_OFFSET_MM
    return [(cos * x - sin * y + offset_x, sin * x + cos * y + offset_y) for x, y in points]


@pytest.fixture(scope="module")
def case(tmp_path_factory, make_rig, make_scan):
    """A scan of a displaced rig: its folder, the file of the target, the rig of the rig file, and the true rig.

    The scan's manifest contains the rig of the rig file.
    """

    def shift_boards(table):
        for board in table["boards"]:
            if board["name"] in SHIFTS:
                board["mount"].append({"shift_mm": SHIFTS[board["name"]]})
        table["geometry"]["object_distance_mm"] += DEEPER_MM

    tables = {
        "grid": {"columns": 18, "rows": 12, "step_x_mm": 13.0, "step_y_mm": 13.0},
        "image": {"columns": 64, "rows": 64, "pixel_mm": 2.5},
    }
    rig_of_file = make_rig(**tables)
    true_rig = make_rig(shift_boards, **tables)
    points = [{"position_mm": [float(x), float(y)], "amplitude": [0.5, 0.0]} for x, y in place_target(POINTS)]
    folder = make_scan(tmp_path_factory.mktemp("places") / "scan", true_rig, rig_of_file, points=points, seed=5)
    target = folder.parent / "target.toml"
    target.write_text(tomli_w.dumps({"name": "five balls", "points": [{"position_mm": list(p)} for p in POINTS]}))
    return folder, target, rig_of_file, true_rig


@pytest.fixture(scope="module")
def places_run(case, tmp_path_factory):
    """Output of the command, and the file it writes."""
    folder, target, _, _ = case
    out = tmp_path_factory.mktemp("out") / "c"
    bytes_before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    options = ("--target", target, "--out", out)
    output = read_output("calibrate", "direct-path", folder, *options)
    # The scan is not changed
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == bytes_before
    return output, next(out.iterdir())


@pytest.fixture(scope="module")
def file(places_run):
    """The calibration file of that scan."""
    return read_calibration(places_run[1], PlacesFile, "direct_path")


def test_the_estimated_places_change_only_on_purpose(file):
    figures = msgspec.to_builtins(file)
    of_the_run = ("made_utc", "sources", "versions")
    kept_figures = {name: value for name, value in figures.items() if name not in of_the_run}
    # Numbers near 0 may differ by 0.01: millimetres and degrees.
    assert_kept(Path(__file__).parent / "kept" / "places.json", kept_figures, absolute=0.01)


def test_a_displaced_rig_is_recovered_within_its_standard_errors(case, file):
    _, _, rig_of_file, true_rig = case
    # The target's place is relative to the mirror point of the rig file's rig, which the shifts move.
    true_middle_mm = np.array(specular_midpoint_m(true_rig, true_rig.receivers[0])) * 1e3
    middle_mm = np.array(specular_midpoint_m(rig_of_file, rig_of_file.receivers[0])) * 1e3
    target_mm = (true_middle_mm - middle_mm)[:2] + TARGET_OFFSET_MM
    h = file.boards["RH"]
    v = file.boards["RV"]
    deeper_mm = file.object_distance_mm - file.object_distance_was_mm
    values = np.array([*h.shift_mm, *v.shift_mm, deeper_mm, *file.target_mm, file.target_turn_deg])
    errors = np.array(
        [
            *h.standard_error_mm,
            *v.standard_error_mm,
            file.object_distance_standard_error_mm,
            *file.target_standard_error_mm,
            file.target_turn_standard_error_deg,
        ]
    )
    truth = np.array([*SHIFTS["RH"], *SHIFTS["RV"], DEEPER_MM, *target_mm, TARGET_TURN_DEG])
    # Nine values in mm and one in degrees
    assert np.all(errors < [0.3] * 9 + [0.05])
    np.testing.assert_array_less(np.abs(values - truth), 5 * errors)
    # The fraction of the echoes' power that the estimated places explain; 0.998 is measured.
    assert file.explained > 0.9
    for name, board in file.boards.items():
        antennas = Antennas.from_rig(true_rig, true_rig.by_name(name))
        direct_mm = np.linalg.norm(antennas.rx_m[0] - antennas.tx_m) * 1e3
        # The rig file's direct path was wrong by more than half a millimetre.
        assert abs(board.direct_path_was_mm - direct_mm) > 0.5
        assert board.direct_path_mm == pytest.approx(direct_mm, abs=5 * board.direct_path_standard_error_mm)


def test_a_target_that_was_laid_up_to_12_mm_beside_its_place_is_found(case):
    """The place is found on a coarse grid, to half a step, and the fit starts there.

    From a start farther away the fit would end at a wrong place, at which the phases of the echoes agree as well.
    """
    folder, _, believed, _ = case
    centre = np.array(specular_midpoint_m(believed, believed.receivers[0]))
    points_mm = np.array(POINTS)
    laid_mm = (-11.0, 8.5)
    # Depth of the plane, x and y of the target, and its turn
    unknowns = np.array([0.0, *laid_mm, 0.0])
    boards = []
    for loaded in load_echoes(open_raw(folder), believed).values():
        # A few positions suffice without noise.
        board = replace(loaded, samples=loaded.samples[:, ::20], offsets_m=loaded.offsets_m[::20])
        echoes = places._model_echoes(board, np.zeros(3), places._place_points(centre, points_mm, unknowns))
        boards.append(replace(board, samples=echoes.sum(axis=1).reshape(board.samples.shape)))
    found_mm = places._find_target(boards, centre, points_mm)
    assert np.abs(np.subtract(found_mm, laid_mm)).max() <= places._STEP_MM / 2


def test_an_active_calibration_corrects_every_antenna(case, file):
    _, _, rig_of_file, true_rig = case
    corrected = Calibration(places=file).rig(rig_of_file)
    # The limit is about two of the largest standard errors that the test above allows.
    assert corrected.geometry.object_distance_mm == pytest.approx(true_rig.geometry.object_distance_mm, abs=0.5)
    for name in SHIFTS:
        true_m = Antennas.from_rig(true_rig, true_rig.by_name(name)).rx_m
        corrected_m = Antennas.from_rig(corrected, corrected.by_name(name)).rx_m
        np.testing.assert_allclose(corrected_m, true_m, atol=0.6e-3)
    assert corrected.transmitter == rig_of_file.transmitter


def test_a_calibration_is_refused_after_a_change_of_mounts_in_the_rig_file(case, file):
    _, _, _, rig_with_other_mounts = case
    with expect_refusal(ErrorCode.MISMATCH):
        Calibration(places=file).rig(rig_with_other_mounts)


def test_the_command_shows_the_changes_and_the_line_for_the_rig_file(places_run, file):
    output, path = places_run
    assert f"{file.object_distance_was_mm:.2f} -> {file.object_distance_mm:.2f}" in output
    assert f'direct_path = "{path}"' in output
    assert file.sources[0].simulated
    assert load_calibration({"direct_path": path}).places == file


@pytest.fixture(scope="module")
def few_echoes(case):
    """Samples at 60 positions only, for speed."""
    folder, _, rig_of_file, _ = case
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("polysight.calibration.places.POSITIONS", 60)
        return load_echoes(open_raw(folder), rig_of_file)


def test_an_undetermined_unknown_stays_near_the_rig_file(case, few_echoes):
    """A prior that is much tighter than the data determines the result: standard errors do not exceed it."""
    _, _, rig_of_file, _ = case
    prior = Prior(board_mm=0.001, plane_mm=0.001)
    fit = fit_places(few_echoes, rig_of_file, [TargetPoint(p) for p in POINTS], prior)
    # Three shifts of each of two boards, and the plane
    boards_and_plane_mm = fit.values[:7]
    assert np.all(np.abs(boards_and_plane_mm) < 0.1)
    assert np.all(fit.errors <= prior.scale(boards=2) * (1 + 1e-6))


def test_another_target_is_refused(case, few_echoes):
    """Three points where the target has none."""
    _, _, rig_of_file, _ = case
    other_target = [TargetPoint((-20.0, 31.0)), TargetPoint((0.0, 0.0)), TargetPoint((20.0, 31.0))]
    fit = fit_places(few_echoes, rig_of_file, other_target)
    with expect_refusal(ErrorCode.MISMATCH):
        places_file(rig_of_file, fit, points=len(other_target), sources=[])


def test_a_target_needs_three_points(tmp_path):
    path = tmp_path / "target.toml"
    path.write_text("[[points]]\nposition_mm = [0.0, 1.0]\n")
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA, path, 1):
        read_target(path)


def test_of_another_rig_file_only_the_places_of_antennas_and_plane_are_used(make_rig):
    scanned = make_rig(grid={"columns": 5})
    other_rig = make_rig(geometry={"object_distance_mm": 600.0})
    rig_of_scan = take_antenna_places(scanned, other_rig)
    assert (rig_of_scan.geometry, rig_of_scan.grid) == (other_rig.geometry, scanned.grid)
