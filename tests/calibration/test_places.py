"""Places of boards and plane: a displaced rig is found out from a scan of points, and processing then has it right."""

import io
from contextlib import redirect_stdout

import numpy as np
import pytest
import tomli_w

from polysight.host.calibration.active import Calibration, load_calibration
from polysight.host.calibration.files import PlacesFile, read
from polysight.host.calibration.places import Prior, TargetPoint, fit_places, look, places_file, read_target
from polysight.host.calibration.rows import open_raw
from polysight.host.cli.main import main
from polysight.host.imaging.geometry import Antennas
from polysight.host.jobs.calibrate import with_places_of
from polysight.shared.errors import ConfigError, DataError
from polysight.shared.geometry import specular_midpoint_m

SHIFTS = {"RH": (1.5, -1.0, 0.8), "RV": (-1.2, 0.7, -1.4)}
DEEPER_MM = 1.7
POINTS = [(-60.0, -50.0), (60.0, -45.0), (0.0, 0.0), (-55.0, 55.0), (50.0, 60.0)]
LAID_MM, TURN_DEG = (4.0, -3.0), 0.5


def laid(points):
    """Where a target's points come to lie."""
    c, s = np.cos(np.radians(TURN_DEG)), np.sin(np.radians(TURN_DEG))
    return [(c * x - s * y + LAID_MM[0], s * x + c * y + LAID_MM[1]) for x, y in points]


@pytest.fixture(scope="module")
def case(tmp_path_factory, make_rig, scan_of):
    """A scan of a displaced rig that says it was taken with the rig file as it is."""

    def displaced(table):
        for board in table["boards"]:
            if board["name"] in SHIFTS:
                board["mount"].append({"shift_mm": SHIFTS[board["name"]]})
        table["geometry"]["object_distance_mm"] += DEEPER_MM

    tables = {
        "grid": {"columns": 18, "rows": 12, "step_x_mm": 13.0, "step_y_mm": 13.0},
        "image": {"columns": 64, "rows": 64, "pixel_mm": 2.5},
    }
    believed, true = make_rig(**tables), make_rig(displaced, **tables)
    points = [{"position_mm": [float(x), float(y)], "amplitude": [0.5, 0.0]} for x, y in laid(POINTS)]
    folder = scan_of(tmp_path_factory.mktemp("places") / "scan", true, believed, points=points, seed=5)
    target = folder.parent / "target.toml"
    target.write_text(tomli_w.dumps({"name": "five balls", "points": [{"position_mm": list(p)} for p in POINTS]}))
    return folder, target, believed, true


@pytest.fixture(scope="module")
def found(case, tmp_path_factory):
    """What the command says, and the file it writes."""
    folder, target, _, _ = case
    out, told = tmp_path_factory.mktemp("out") / "c", io.StringIO()
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    with redirect_stdout(told):
        assert main(["calibrate", "direct-path", str(folder), "--target", str(target), "--out", str(out)]) == 0
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before  # the scan is not touched
    return told.getvalue(), next(out.iterdir())


@pytest.fixture(scope="module")
def file(found):
    return read(found[1], PlacesFile, "direct_path")


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
        antennas = Antennas.of(true, true.by_name(name))
        direct_mm = np.linalg.norm(antennas.rx_m[0] - antennas.tx_m) * 1e3
        assert abs(board.direct_path_was_mm - direct_mm) > 0.5  # what was wrong
        assert board.direct_path_mm == pytest.approx(direct_mm, abs=5 * board.direct_path_standard_error_mm)


def test_in_force_it_puts_every_antenna_where_it_is(case, file):
    _, _, believed, true = case
    corrected = Calibration(places=file).rig(believed)
    assert corrected.geometry.object_distance_mm == pytest.approx(true.geometry.object_distance_mm, abs=0.5)
    for name in SHIFTS:
        there, thought = (Antennas.of(r, r.by_name(name)).rx_m for r in (true, corrected))
        np.testing.assert_allclose(thought, there, atol=0.6e-3)
    assert corrected.transmitter == believed.transmitter


def test_it_is_refused_once_the_rig_files_places_have_changed(case, file):
    _, _, _, true = case
    with pytest.raises(ConfigError, match="other mounts"):
        Calibration(places=file).rig(true)


def test_the_command_says_what_changed_and_what_to_set(found, file):
    told, path = found
    assert "SIMULATED" in told
    assert str(path) in told
    assert f"{file.object_distance_was_mm:.2f} -> {file.object_distance_mm:.2f}" in told
    assert 'direct_path = "' in told
    assert file.sources[0].simulated
    assert load_calibration({"direct_path": path}).places == file


@pytest.fixture(scope="module")
def glimpse(case):
    """What the boards saw at few positions."""
    folder, _, believed, _ = case
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("polysight.host.calibration.places.POSITIONS", 60)
        return look(open_raw(folder), believed)


def test_what_a_scan_cannot_tell_stays_near_the_rig_file(case, glimpse):
    """A prior far tighter than the data holds everything: its standard errors never exceed it."""
    prior = Prior(0.001, 0.001)
    fit = fit_places(glimpse, case[2], [TargetPoint(p) for p in POINTS], prior)
    assert np.all(np.abs(fit.values[:7]) < 0.1)
    assert np.all(fit.errors <= prior.scale(2) * (1 + 1e-6))


def test_another_target_is_refused(case, glimpse):
    wrong = [TargetPoint((20.0 * k, 31.0 * (k % 2))) for k in range(-1, 2)]
    with pytest.raises(DataError, match="explain"):
        places_file(case[2], fit_places(glimpse, case[2], wrong), 3, [])


def test_a_target_needs_three_points(tmp_path):
    path = tmp_path / "target.toml"
    path.write_text("[[points]]\nposition_mm = [0.0, 1.0]\n")
    with pytest.raises(DataError, match="1 points"):
        read_target(path)


def test_another_rig_files_places_are_taken_and_nothing_else(make_rig):
    scanned = make_rig(grid={"columns": 5})
    other = make_rig(geometry={"object_distance_mm": 600.0})
    taken = with_places_of(scanned, other)
    assert (taken.geometry, taken.grid) == (other.geometry, scanned.grid)
