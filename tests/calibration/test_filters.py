"""High-pass corners that differ from the rig file are recovered from scans at several start frequencies."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from tests.support.kept import assert_kept

from polysight.calibration.direct_signal import BIN_HZ, MIN_CHIRPS, average_in_bins
from polysight.calibration.files import FilterFile, load_calibration, read_calibration
from polysight.cli.main import main
from polysight.pipeline import Pipeline
from polysight.store.scan_folder import ScanFolder
from polysight.sync.high_pass_filter import HighPass, high_pass
from polysight_shared.errors import DataError

# Start frequencies of the receivers: they move the direct path over the IF band, so that it samples the filter.
OFFSETS_HZ = (60e3, 250e3, 500e3, 850e3, 1250e3)

# Corners of the simulated filters; the rig file says 175 and 350 kHz.
TRUE_KHZ = (235.0, 700.0)


@pytest.fixture(scope="module")
def scans(tmp_path_factory, make_rig, make_scan):
    """One power cycle of a rig whose filters differ from its rig file, at several start frequencies."""
    folder = tmp_path_factory.mktemp("sweep")
    folders = []
    for k, offset_hz in enumerate(OFFSETS_HZ):

        def set_offsets(table, offset_hz=offset_hz):
            for board in table["boards"]:
                if board["role"] != "transmit":
                    board["start_offset_hz"] = offset_hz

        tables = {"grid": {"columns": 8, "rows": 3}, "burst": {"pulses": 8}, "image": {"columns": 20, "rows": 20}}
        rig_of_file = make_rig(set_offsets, **tables)
        corners = {"hpf1_khz": TRUE_KHZ[0], "hpf2_khz": TRUE_KHZ[1]}
        true_rig = make_rig(set_offsets, chirp=corners, **tables)
        folders.append(make_scan(folder / f"{k}", true_rig, rig_of_file, seed=2, disturbances={"if_offset_hz": 0.0}))
    return folders


@pytest.fixture(scope="module")
def filter_run(scans, tmp_path_factory):
    """The calibration file of the sweep."""
    out = tmp_path_factory.mktemp("found")
    assert main(["calibrate", "hpf", *map(str, scans), "--out", str(out)]) == 0
    return next(out.iterdir())


def test_the_estimated_filters_change_only_on_purpose(filter_run):
    figures = msgspec.to_builtins(read_calibration(filter_run, FilterFile, "hpf"))
    # Numbers near 0 may differ by 0.01: kilohertz and decibels.
    assert_kept(Path(__file__).parent / "kept" / "filters.json", figures["boards"], absolute=0.01)


def test_unknown_corners_are_recovered(scans, filter_run):
    file = read_calibration(filter_run, FilterFile, "hpf")
    for board in file.boards.values():
        corners = np.array(board.corners_khz)
        errors = np.array(board.standard_error_khz)
        # The corners found are 2.6 % off (measured).
        np.testing.assert_allclose(corners, TRUE_KHZ, rtol=0.15)
        assert np.all(np.abs(corners - TRUE_KHZ) < 6 * errors)
        assert np.all(errors < 0.1 * np.array(TRUE_KHZ))
        assert board.programmed_khz == [175.0, 350.0]
        # The fitted filter leaves 0.13 dB (measured).
        assert board.residual_db < 0.5
    assert file.simulated
    assert len(file.sources) == len(scans)


def test_processing_uses_the_filter_that_the_rig_file_names(filter_run, tmp_path, make_rig, make_scan):
    rig = make_rig(
        grid={"columns": 4, "rows": 2}, image={"columns": 20, "rows": 20}, calibration={"hpf": str(filter_run)}
    )
    pipeline = Pipeline(ScanFolder.load(make_scan(tmp_path / "scan", rig)))
    boards = read_calibration(filter_run, FilterFile, "hpf").boards
    for name, setup in pipeline.synchroniser.setups.items():
        measured = HighPass(tuple(1e3 * corner_khz for corner_khz in boards[name].corners_khz))
        assert setup.equaliser.model == measured != high_pass(rig.chirp)
    # The transmitter has no filter.
    assert load_calibration({"hpf": filter_run}).high_pass("LS") is None


def test_a_single_start_frequency_is_refused(scans, tmp_path):
    status = main(["calibrate", "hpf", str(scans[-1]), "--out", str(tmp_path / "c")])
    assert status == DataError.exit_status
    assert not (tmp_path / "c").exists()


def test_bins_have_the_mean_signal_of_their_chirps_without_the_noise():
    """Signals whose amplitude is proportional to the IF, plus a known noise power."""
    rng = np.random.default_rng(1)
    if_hz = rng.uniform(0.2e6, 1.2e6, 3000)
    noise_power = np.full(if_hz.size, 4.0)
    mean_if_hz, level = average_in_bins(if_hz, (if_hz / 1e4) ** 2 + noise_power, noise_power)
    # Over a bin the level changes by the bin over the IF, at most at the lowest one.
    np.testing.assert_allclose(level, mean_if_hz / 1e4, rtol=BIN_HZ / 0.2e6)
    assert np.all(np.diff(mean_if_hz) > 0)


def test_bins_of_few_chirps_of_a_negative_if_or_of_noise_are_left_out():
    few = np.ones(MIN_CHIRPS - 1)
    mean_if_hz, _ = average_in_bins(if_hz=1e5 * few, power=few, noise_power=0 * few)
    assert mean_if_hz.size == 0
    enough = np.ones(MIN_CHIRPS)
    mean_if_hz, _ = average_in_bins(if_hz=-1e5 * enough, power=enough, noise_power=0 * enough)
    assert mean_if_hz.size == 0
    # Half of the power is noise.
    mean_if_hz, _ = average_in_bins(if_hz=1e5 * enough, power=enough, noise_power=enough / 2)
    assert mean_if_hz.size == 0
