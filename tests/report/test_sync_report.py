"""The report on the errors in frequency, phase and amplitude of chirps after each step of synchronisation.

The chirps of a burst are aligned with each other, then averaged. The errors are compared with the Cramer-Rao bound of a
tone in noise, and with the figures of the POLySIGHT paper.
"""

import json

import numpy as np
import pytest

from polysight.report.sync_report import SyncReport, write_sync_report
from polysight.sync import PUBLISHED_STD, STAGES, SyncedRow

# Standard deviations of the errors in frequency (Hz), phase (rad) and amplitude (relative) after each step.
ERROR_STDS = {"received": (8e4, 1.8, 0.1), "aligned": (80.0, 0.013, 0.01), "averaged": (20.0, 0.003, 0.003)}
POSITIONS = 4000
CHIRPS = 16
# The ratio of the direct path to the noise of a chirp that the paper's figures for one tone imply.
PUBLISHED_SNR_DB = 7.2


def draw_row(seed=0):
    """A row of positions with random errors of these sizes, and noise as in the paper, without echoes."""
    rng = np.random.default_rng(seed)
    errors = {}
    for stage, stds in ERROR_STDS.items():
        errors[stage] = rng.standard_normal((3, POSITIONS)) * np.array(stds)[:, None]
    errors["referenced"] = np.zeros((3, 0))
    direct_amplitude = 500.0
    noise_power = direct_amplitude**2 * 10 ** (-PUBLISHED_SNR_DB / 10)
    return SyncedRow(
        samples=np.zeros((4, POSITIONS, 1), np.complex64),
        sweep_hz=np.zeros(1),
        valid=np.ones(POSITIONS, bool),
        chirps=np.full(POSITIONS, CHIRPS),
        direct_hz=np.zeros(POSITIONS),
        direct_amplitude=np.full(POSITIONS, direct_amplitude),
        errors=errors,
        noise=np.full(POSITIONS, noise_power),
    )


def make_report(*rows, rx=4):
    """The report on rows of a board with `rx` receive antennas."""
    report = SyncReport(sample_rate_hz=2.15e6, linear=(0, 192), rx=rx)
    for row in rows:
        report.add(row)
    return report


def test_the_reported_standard_deviations_are_those_of_the_errors():
    summary = make_report(draw_row(seed=1), draw_row(seed=2)).summary()
    assert summary["chirps"] == 2 * POSITIONS * CHIRPS
    for name, expected_stds in ERROR_STDS.items():
        stage = summary["stages"][name]
        assert stage["samples"] == 2 * POSITIONS
        stds = [stage["frequency_hz_std"], stage["phase_rad_std"], stage["amplitude_std"]]
        # Standard deviations of 8000 samples have an error of 1 / sqrt(2 x 8000) = 0.8 per cent.
        assert stds == pytest.approx(expected_stds, rel=0.03)
    assert "referenced" not in summary["stages"]


def test_the_published_errors_of_a_chirp_are_the_bound_of_one_tone_at_7_2_db():
    bounds_of_average = np.array(make_report(draw_row(), rx=1).bounds()["averaged"])
    frequency_hz, phase_rad, _ = np.sqrt(CHIRPS) * bounds_of_average
    # The bounds are 137.5 Hz and 0.0223 rad. Published are 138 Hz and 0.022 rad, with these rounding errors.
    assert frequency_hz == pytest.approx(PUBLISHED_STD["frequency_hz"], rel=0.01)
    assert phase_rad == pytest.approx(PUBLISHED_STD["phase_rad"], rel=0.02)


def test_four_receivers_and_16_chirps_are_worth_64_times_the_power():
    """Bounds fall with the root of the power: by 2 for four receivers, by 4 for 16 chirps."""
    bounds_of_four_rx = make_report(draw_row(), rx=4).bounds()
    bounds_of_one_rx = make_report(draw_row(), rx=1).bounds()
    averaged = np.array(bounds_of_one_rx["averaged"])
    aligned = np.array(bounds_of_one_rx["aligned"])
    assert bounds_of_four_rx["averaged"] == pytest.approx(averaged / np.sqrt(4))
    # An aligned chirp is compared with the mean of its 16, of which a sixteenth is its own error.
    assert aligned == pytest.approx(np.sqrt(16) * np.sqrt(15 / 16) * averaged)
    assert bounds_of_four_rx["aligned"] == pytest.approx(aligned / np.sqrt(4))


@pytest.mark.parametrize("chirps", [2, 3, 16])
def test_the_bound_of_an_aligned_chirp_is_that_of_its_deviation_from_the_burst(chirps):
    """Of the error of each chirp the mean of its burst is subtracted: with two chirps half of the variance remains."""
    row = draw_row()
    row.chirps[:] = chirps
    bounds = make_report(row).bounds()
    bursts = 20_000
    stds_of_one_chirp = np.sqrt(chirps) * np.array(bounds["averaged"])
    errors = np.random.default_rng(0).standard_normal((3, bursts, chirps)) * stds_of_one_chirp[:, None, None]
    deviations = errors - errors.mean(axis=2, keepdims=True)
    # Standard deviations of 40,000 errors have an error of 0.4 per cent.
    assert deviations.std(axis=(1, 2)) == pytest.approx(np.array(bounds["aligned"]), rel=0.02)


@pytest.mark.parametrize("simulated", [True, False])
def test_a_report_is_a_text_a_file_of_numbers_and_a_picture_for_each_board(tmp_path, simulated):
    text = write_sync_report(tmp_path, {"RH": make_report(draw_row())}, "scan one", simulated)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sync-RH.png", "sync.json", "sync.txt"]
    assert (tmp_path / "sync-RH.png").read_bytes().startswith(b"\x89PNG")
    facts = json.loads((tmp_path / "sync.json").read_text())
    assert facts["simulated"] is simulated
    assert set(facts["boards"]["RH"]["stages"]) < set(STAGES)
    assert ("simulated" in text) is simulated
    # The published error in frequency.
    assert "138 Hz" in text


def test_a_scan_without_a_valid_position_is_reported_as_such(tmp_path):
    empty = SyncedRow(
        samples=np.zeros((4, 3, 1), np.complex64),
        sweep_hz=np.zeros(1),
        valid=np.zeros(3, bool),
        chirps=np.zeros(3, int),
        direct_hz=np.zeros(3),
        direct_amplitude=np.zeros(3),
    )
    text = write_sync_report(tmp_path, {"RH": make_report(empty)}, "nothing", simulated=True)
    assert "0 chirps at 0 positions" in text
