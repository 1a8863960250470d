"""Positions of boards and plane: a displaced rig is recovered from a scan of points, and processing uses the result."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
import tomli_w
from tests.support.kept import assert_kept
from tests.support.processes import read_output
from tests.support.refusals import expect_refusal

from polysight.calibration.files import Calibration, PlacesFile, load_calibration, open_raw, read_calibration
from polysight.calibration.places import Prior, TargetPoint, fit_places, load_echoes, places_file, read_target
from polysight.imaging.geometry import Antennas
from polysight.jobs.calibrate import take_antenna_places
from polysight_shared.errors import ErrorCode
from polysight_shared.geometry import specular_midpoint_m

SHIFTS = {"RH": (1.5, -1.0, 0.8), "RV": (-1.2, 0.7, -1.4)}
DEEPER_MM = 1.7
POINTS = [(-60.0, -50.0), (60.0, -45.0), (0.0, 0.0), (-55.0, 55.0), (50.0, 60.0)]
LAID_MM = (4.0, -3.0)
TURN_DEG = 0.5


def measure_positions(points):
    """Measured positions of a target's points."""
    c = np.cos(np.radians(TURN_DEG))
    s = np.sin(np.radians(TURN_DEG))
    return [(c * x - s * y + LAID_MM[0], s * x + c * y + LAID_MM[1]) for x, y in points]


@pytest.fixture(scope="module")
def case(tmp_path_factory, make_rig, make_scan):
    """A scan of a displaced rig whose manifest contains the same rig file."""

    def shift_boards(table):
        for board in table["boards"]:
            if board["name"] in SHIFTS:
                board["mount"].append({"shift_mm": SHIFTS[board["name"]]})
        table["geometry"]["object_distance_mm"] += DEEPER_MM

    tables = {
        "grid": {"columns": 18, "rows": 12, "step_x_mm": 13.0, "step_y_mm": 13.0},
        "image": {"columns": 64, "rows": 64, "pixel_mm": 2.5},
    }
    believed = make_rig(**tables)
    true = make_rig(shift_boards, **tables)
    points = [{"position_mm": [float(x), float(y)], "amplitude": [0.5, 0.0]} for x, y in measure_positions(POINTS)]
    folder = make_scan(tmp_path_factory.mktemp("places") / "scan", true, believed, points=points, seed=5)
    target = folder.parent / "target.toml"
    target.write_text(tomli_w.dumps({"name": "five balls", "points": [{"position_mm": list(p)} for p in POINTS]}))
    return folder, target, believed, true


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
    return read_calibration(places_run[1], PlacesFile, "direct_path")


def test_the_places_found_change_only_on_purpose(file):
    figures = msgspec.to_builtins(file)
    of_the_run = ("made_utc", "sources", "versions")
    kept_figures = {name: value for name, value in figures.items() if name not in of_the_run}
    assert_kept(Path(__file__).parent / "kept" / "places.json", kept_figures, 0.01)


def test_a_displaced_rig_is_recovered_within_its_standard_errors(case, file):
    _, _, believed, true = case
    middle = [np.array(specular_midpoint_m(rig, rig.receivers[0])) * 1e3 for rig in (true, believed)]
    target = (middle[0] - middle[1])[:2] + LAID_MM
    deeper = file.object_distance_mm - file.object_distance_was_mm
    rest = (file.target_turn_standard_error_deg, file.object_distance_standard_error_mm)
    values = [*(v for n in SHIFTS for v in file.boards[n].shift_mm), deeper, *file.target_mm, file.target_turn_deg]
    errors = [*(v for n in SHIFTS for v in file.boards[n].standard_error_mm), rest[1]]
    errors += [*file.target_standard_error_mm, rest[0]]
    truth = np.array([*SHIFTS["RH"], *SHIFTS["RV"], DEEPER_MM, *target, TURN_DEG])
    assert np.all(np.array(errors) < [0.3] * 9 + [0.05])
    np.testing.assert_array_less(np.abs(values - truth), 5 * np.array(errors))
    assert file.explained > 0.9
    for name, board in file.boards.items():
        antennas = Antennas.from_rig(true, true.by_name(name))
        direct_mm = np.linalg.norm(antennas.rx_m[0] - antennas.tx_m) * 1e3
        # The error that was removed
        assert abs(board.direct_path_was_mm - direct_mm) > 0.5
        assert board.direct_path_mm == pytest.approx(direct_mm, abs=5 * board.direct_path_standard_error_mm)


def test_an_active_calibration_corrects_every_antenna(case, file):
    _, _, believed, true = case
    corrected = Calibration(places=file).rig(believed)
    assert corrected.geometry.object_distance_mm == pytest.approx(true.geometry.object_distance_mm, abs=0.5)
    for name in SHIFTS:
        expected_m = Antennas.from_rig(true, true.by_name(name)).rx_m
        thought = Antennas.from_rig(corrected, corrected.by_name(name)).rx_m
        np.testing.assert_allclose(thought, expected_m, atol=0.6e-3)
    assert corrected.transmitter == believed.transmitter


def test_it_is_refused_after_a_change_of_mounts_in_the_rig_file(case, file):
    with expect_refusal(ErrorCode.MISMATCH):
        Calibration(places=file).rig(case[3])


def test_the_command_shows_the_changes_and_the_line_for_the_rig_file(places_run, file):
    output, path = places_run
    assert f"{file.object_distance_was_mm:.2f} -> {file.object_distance_mm:.2f}" in output
    assert f'direct_path = "{path}"' in output
    assert file.sources[0].simulated
    assert load_calibration({"direct_path": path}).places == file


@pytest.fixture(scope="module")
def few_echoes(case):
    """Samples at few positions."""
    folder, _, believed, _ = case
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("polysight.calibration.places.POSITIONS", 60)
        return load_echoes(open_raw(folder), believed)


def test_an_undetermined_unknown_stays_near_the_rig_file(case, few_echoes):
    """A prior that is much tighter than the data determines the result: standard errors do not exceed it."""
    prior = Prior(0.001, 0.001)
    fit = fit_places(few_echoes, case[2], [TargetPoint(p) for p in POINTS], prior)
    assert np.all(np.abs(fit.values[:7]) < 0.1)
    assert np.all(fit.errors <= prior.scale(2) * (1 + 1e-6))


def test_another_target_is_refused(case, few_echoes):
    other_targets = [TargetPoint((20.0 * k, 31.0 * (k % 2))) for k in range(-1, 2)]
    with expect_refusal(ErrorCode.MISMATCH):
        places_file(case[2], fit_places(few_echoes, case[2], other_targets), 3, [])


def test_a_target_needs_three_points(tmp_path):
    path = tmp_path / "target.toml"
    path.write_text("[[points]]\nposition_mm = [0.0, 1.0]\n")
    with expect_refusal(ErrorCode.NOT_ENOUGH_DATA, path, 1):
        read_target(path)


def test_another_rig_files_places_are_taken_and_nothing_else(make_rig):
    scanned = make_rig(grid={"columns": 5})
    other_rig = make_rig(geometry={"object_distance_mm": 600.0})
    rig_of_scan = take_antenna_places(scanned, other_rig)
    assert (rig_of_scan.geometry, rig_of_scan.grid) == (other_rig.geometry, scanned.grid)
