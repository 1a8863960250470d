"""`polysight sync-report` recovers known disturbances, and agrees with the residuals in quality.json."""

import numpy as np
import pytest
from tests.support.processes import read_output
from tests.support.rigs import load_published_rig, load_rig_table, make_rig_with
from tests.support.scenes import EVERYWHERE, make_scene
from tests.support.store.facts import load_facts

from polysight.calibration.files import BoardFilter, FilterFile, SourceScan, make_header, write_calibration
from polysight.store import manifest
from polysight_shared.files import read_json

COLUMNS = 10
ROWS = 3
PULSES = 8
# Each board samples SYNC_IN up to this much late, uniformly distributed.
SYNC_NS = 5.0
# The true corners of the receivers' filters; those that were programmed are 175 and 350 kHz.
TRUE_KHZ = [350.0, 1400.0]
# Names of the figures in sync.json, and of the same figures in quality.json.
NAMES = {"frequency_hz_std": "frequency_std_hz", "phase_rad_std": "phase_std_rad", "amplitude_std": "amplitude_std"}


@pytest.fixture(scope="module")
def scan(make_scan, tmp_path_factory):
    """A scan whose filters were measured before it."""
    folder = tmp_path_factory.mktemp("sync")
    true_filter = BoardFilter(
        corners_khz=TRUE_KHZ,
        standard_error_khz=[1.0, 1.0],
        programmed_khz=[175.0, 350.0],
        if_from_khz=100.0,
        if_to_khz=1900.0,
        chirps=640,
        residual_db=0.05,
    )
    head = make_header("hpf", [SourceScan("sweep", "sweep", simulated=True, rows=3)])
    path = write_calibration(FilterFile(**head, boards={"RH": true_filter, "RV": true_filter}), folder / "calibration")
    true_rig = make_rig_with(chirp={"hpf1_khz": TRUE_KHZ[0], "hpf2_khz": TRUE_KHZ[1]}, calibration={"hpf": str(path)})
    scene_changes = {"seed": 3, "disturbances": {"direct_snr_db": 20.0, "sync_uncertainty_ns": SYNC_NS}}
    scan = make_scan(
        folder / "scan", make_scene(EVERYWHERE, columns=COLUMNS, rows=ROWS, pulses=PULSES, **scene_changes), true_rig
    )
    _believe_programmed(scan)
    return scan


def _believe_programmed(scan):
    """Set the filters in the scan's manifest to the programmed ones, those of the published rig."""
    facts = load_facts(scan)
    facts[0]["instrument"]["chirp"] |= {"hpf1_khz": 175.0, "hpf2_khz": 350.0}
    (scan / "manifest.jsonl").write_bytes(b"".join(manifest.encode_line(fact) for fact in facts))


def test_a_scan_with_two_antennas_has_a_report_and_an_image(make_scan, tmp_path):
    rig_with_two_rx = make_rig_with(antennas={"rx_mm": load_rig_table()["antennas"]["rx_mm"][:2]})
    scene = make_scene(EVERYWHERE, columns=COLUMNS, rows=ROWS, pulses=PULSES)
    scan = make_scan(tmp_path / "scan", scene, rig_with_two_rx)
    read_output("sync-report", scan, "--out", tmp_path / "report")
    read_output("image", scan, "--out", tmp_path / "image")
    assert (tmp_path / "report" / "sync.json").exists()
    assert (tmp_path / "image" / "image.npz").exists()


def test_residuals_are_the_simulated_ones_and_those_of_processing(scan, tmp_path):
    output = read_output("sync-report", scan, "--out", tmp_path / "report")
    read_output("image", scan, "--out", tmp_path / "image")
    report = read_json(tmp_path / "report" / "sync.json")
    quality = read_json(tmp_path / "image" / "quality.json")
    assert report["simulated"] is True
    slope = load_published_rig().chirp.slope_hz_per_s
    for name in ("RH", "RV"):
        figures = report["boards"][name]
        stages = report["boards"][name]["stages"]
        assert figures["positions"] == COLUMNS * ROWS
        assert figures["chirps"] == COLUMNS * ROWS * PULSES
        assert str(figures["chirps"]) in output
        # Two boards sample the trigger, each uniformly within SYNC_NS: a standard deviation of SYNC_NS / sqrt(12) each.
        # The phase of the direct path is then uniform within +- pi: pi / sqrt(3).
        two_boards_hz = slope * SYNC_NS * 1e-9 * np.sqrt(2 / 12)
        assert stages["received"]["frequency_hz_std"] == pytest.approx(two_boards_hz, rel=0.15)
        assert stages["received"]["phase_rad_std"] == pytest.approx(np.pi / np.sqrt(3), rel=0.15)
        # Only noise is left if the filter's true response was removed. Otherwise the slope of the response would turn
        # the random frequencies into random amplitudes.
        for stage in ("aligned", "averaged", "referenced"):
            figures_of_stage = stages[stage]
            # Measured: amplitudes of 0.0014 to 0.0025, and phases of up to 1.3 times their bound of 0.0015 to 0.0043.
            assert figures_of_stage["amplitude_std"] < 0.004
            assert figures_of_stage["phase_rad_std"] < 1.5 * figures_of_stage["phase_rad_bound"]
            assert 1.5 * figures_of_stage["phase_rad_bound"] < 0.01
        for stage, values in quality["boards"][name]["synchronisation"].items():
            expected = {NAMES[k]: v for k, v in stages[stage].items() if k in NAMES}
            assert values == pytest.approx(expected, rel=1e-9)
