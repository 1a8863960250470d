"""The report on the errors that remain after synchronisation."""

import json

import numpy as np
import pytest

from polysight.report.sync_report import SyncReport, write_sync_report
from polysight.sync import PUBLISHED_STD, STAGES, SyncedRow

# Standard deviations of the errors in frequency (Hz), phase (rad) and amplitude (relative) after each step; chosen.
SCALES = {"received": (8e4, 1.8, 0.1), "aligned": (80.0, 0.013, 0.01), "averaged": (20.0, 0.003, 0.003)}


def draw_row(snr_db=7.2, n=4000, seed=0):
    """A row of `n` positions with errors of known size, without echoes.

    7.2 dB is the ratio of the direct path to the noise of a chirp that the paper's figures of one tone imply.
    """
    rng = np.random.default_rng(seed)
    errors = {name: rng.standard_normal((3, n)) * np.array(scale)[:, None] for name, scale in SCALES.items()}
    errors["referenced"] = np.zeros((3, 0))
    valid = np.ones(n, bool)
    zero = np.zeros(n)
    noise = np.full(n, 500.0**2 * 10 ** (-snr_db / 10))
    return SyncedRow(
        samples=np.zeros((4, n, 1), np.complex64),
        sweep_hz=np.zeros(1),
        valid=valid,
        chirps=np.full(n, 16),
        direct_hz=zero,
        direct_amplitude=zero + 500,
        errors=errors,
        noise=noise,
    )


def make_report(*rows, rx=4):
    report = SyncReport(2.15e6, (0, 192), rx)
    for r in rows:
        report.add(r)
    return report


def test_spreads_are_those_of_the_errors():
    summary = make_report(draw_row(seed=1), draw_row(seed=2)).summary()
    assert summary["chirps"] == 2 * 4000 * 16
    for name, scale in SCALES.items():
        stage = summary["stages"][name]
        assert stage["samples"] == 8000
        stds = [stage[f"{q}_std"] for q in ("frequency_hz", "phase_rad", "amplitude")]
        # Deviations of 8000 samples are known to 1 / sqrt(2 x 8000) = 0.8 per cent.
        assert stds == pytest.approx(scale, rel=0.03)
    assert "referenced" not in summary["stages"]


def test_the_papers_figures_are_the_bound_of_one_tone_at_7_2_db():
    # The bound of one chirp is four times that of the average of 16. The limits are the rounding of what is published.
    frequency_hz, phase_rad, _ = 4 * np.array(make_report(draw_row(7.2), rx=1).bounds()["averaged"])
    assert frequency_hz == pytest.approx(PUBLISHED_STD["frequency_hz"], rel=0.01)
    assert phase_rad == pytest.approx(PUBLISHED_STD["phase_rad"], rel=0.02)


def test_four_receivers_and_16_chirps_are_worth_64_times_the_power():
    """Bounds fall with the root of the power: by 2 for four receivers, by 4 for 16 chirps."""
    of_four_rx = make_report(draw_row(7.2)).bounds()
    of_one_rx = make_report(draw_row(7.2), rx=1).bounds()
    assert of_four_rx["averaged"] == pytest.approx(np.array(of_one_rx["averaged"]) / 2)
    # An aligned chirp is compared with the mean of its 16, of which a sixteenth is its own error.
    assert np.array(of_one_rx["aligned"]) == pytest.approx(4 * np.sqrt(15 / 16) * np.array(of_one_rx["averaged"]))
    assert of_four_rx["aligned"] == pytest.approx(np.array(of_one_rx["aligned"]) / 2)


@pytest.mark.parametrize("chirps", [2, 3, 16])
def test_the_bound_of_an_aligned_chirp_is_that_of_its_deviation_from_the_burst(chirps):
    """The mean of a burst is taken out of its chirps' errors: with two chirps half of the variance is left."""
    noisy = draw_row(7.2)
    noisy.chirps[:] = chirps
    report = make_report(noisy)
    one_chirp = np.sqrt(chirps) * np.array(report.bounds()["averaged"])
    errors = np.random.default_rng(0).standard_normal((3, 20_000, chirps)) * one_chirp[:, None, None]
    errors -= errors.mean(axis=2, keepdims=True)
    assert errors.std(axis=(1, 2)) == pytest.approx(np.array(report.bounds()["aligned"]), rel=0.02)


@pytest.mark.parametrize("simulated", [True, False])
def test_a_report_is_a_text_a_picture_for_each_board_and_its_numbers(tmp_path, simulated):
    text = write_sync_report(tmp_path, {"RH": make_report(draw_row())}, "scan one", simulated)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["sync-RH.png", "sync.json", "sync.txt"]
    assert (tmp_path / "sync-RH.png").read_bytes().startswith(b"\x89PNG")
    facts = json.loads((tmp_path / "sync.json").read_text())
    assert facts["simulated"] is simulated
    assert set(facts["boards"]["RH"]["stages"]) < set(STAGES)
    assert ("simulated" in text) is simulated
    # What the paper has.
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
    text = write_sync_report(tmp_path, {"RH": make_report(empty)}, "nothing", True)
    assert "0 chirps at 0 positions" in text
