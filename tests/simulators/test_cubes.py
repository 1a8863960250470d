"""Simulated samples equal those of a raw scan that the host synchronised, except for one factor and the noise."""

from pathlib import Path

import numpy as np
import pytest
from tests.support.rigs import load_published_rig

from polysight.pipeline import Pipeline
from polysight.store.scan_folder import ScanFolder
from polysight.sync.decimate import flatten, fold
from polysight_simulators.scene import Scene, decode_scene, reference_cube, simulate, synced_cube
from polysight_simulators.scene.radar import sample_frequencies_hz

RIG = load_published_rig()
SCENE = decode_scene(
    {
        "name": "t",
        "grid": {"columns": 11, "rows": 6, "step_x_mm": 14.0, "step_y_mm": 12.0},
        "plates": [
            {"name": "copper", "centre_mm": [-40.0, 10.0], "size_mm": [50.0, 50.0], "metal": True},
            {
                "name": "PET",
                "centre_mm": [40.0, -10.0],
                "size_mm": [50.0, 50.0],
                "permittivity": [3.78, 0.7],
                "tilt_deg": [0.5, -0.3],
                "height_mm": 1.0,
                "rough_mm": 0.1,
            },
        ],
    },
    "t",
)


def synchronise_by_the_host(scene: Scene, folder: Path) -> dict[str, np.ndarray]:
    """Return the synchronised samples of a raw scan, [rx, row, column, block of four samples] in ADC counts."""
    pipeline = Pipeline(ScanFolder.load(simulate(RIG, scene, folder / "scan")))
    rows_of_board: dict[str, list[np.ndarray]] = {"RH": [], "RV": []}
    for index in pipeline.source.rows():
        for board, row in pipeline.synchronise_row(index).items():
            assert row.valid.all()
            # Odd rows run backwards.
            samples = row.samples[:, ::-1] if index % 2 else row.samples
            rows_of_board[board].append(samples)
    return {board: np.stack(rows, axis=1) for board, rows in rows_of_board.items()}


def decimate_cube(cube: np.ndarray) -> np.ndarray:
    """Return the linear samples of a cube as the host decimates them: one value for each block of four."""
    return flatten(fold(np.ascontiguousarray(cube[..., slice(*RIG.chirp.linear_samples)], np.complex64)))


def find_deviation(raw: np.ndarray, cube: np.ndarray) -> np.ndarray:
    """Return the raw samples, divided by the one factor that fits best, less those of the cube."""
    cube = decimate_cube(cube)
    best_factor = np.vdot(cube, raw) / np.vdot(cube, cube)
    return raw / best_factor - cube


def compute_relative_error(raw: np.ndarray, cube: np.ndarray) -> float:
    """Return the RMS deviation relative to the RMS of the cube."""
    return float(np.sqrt(np.mean(np.abs(find_deviation(raw, cube)) ** 2) / np.mean(np.abs(cube) ** 2)))


def test_a_synced_cube_equals_the_synchronised_raw_scan(tmp_path: Path) -> None:
    leakage = {"leakage_h": [0.1, 0.15], "leakage_v": [-0.1, 0.1]}
    scene = SCENE.with_disturbances(direct_snr_db="off", hv_drift=[0.2, 30.0], **leakage)
    assert RIG.chirp.linear_samples[0] == 0
    for board, raw in synchronise_by_the_host(scene, tmp_path).items():
        cube = synced_cube(RIG, scene, board)
        cube_without_leakage = synced_cube(RIG, scene.with_disturbances(leakage_h="off", leakage_v="off"), board)
        error = compute_relative_error(raw, cube)
        # Measured: 0.004. If a disturbance were missing in one of the two it would be larger: 0.02 without leakage.
        assert error < 0.01
        assert compute_relative_error(raw, cube_without_leakage) > 3 * error


def test_the_echo_of_v_drifts_as_in_the_scene_and_h_and_the_direct_path_do_not() -> None:
    amplitude_drift = 0.2
    phase_drift_deg = 30.0
    drifting = SCENE.with_disturbances(hv_drift=[amplitude_drift, phase_drift_deg])
    h_drifting = synced_cube(RIG, drifting, "RH", noise=0.0, direct=False)
    h_constant = synced_cube(RIG, SCENE, "RH", noise=0.0, direct=False)
    v_drifting = synced_cube(RIG, drifting, "RV", noise=0.0, direct=False)
    v_constant = synced_cube(RIG, SCENE, "RV", noise=0.0, direct=False)
    assert np.array_equal(h_drifting, h_constant)
    # [rx, row, column, sample]
    factor = v_drifting / v_constant
    # Row 5 runs backwards, so that its first column is the last position.
    first = factor[0, 0, 0, 0]
    last = factor[0, -1, 0, 0]
    # The drift is that of the whole scan: from the first to the last of 66 positions it is 65 / 66 of it.
    share_of_scan = 65 / 66
    assert abs(last) - abs(first) == pytest.approx(amplitude_drift * share_of_scan, rel=1e-3)
    assert np.degrees(np.angle(last / first)) == pytest.approx(phase_drift_deg * share_of_scan, rel=1e-3)
    drifting_direct = synced_cube(RIG, drifting, "RV", noise=0.0) - v_drifting
    constant_direct = synced_cube(RIG, SCENE, "RV", noise=0.0) - v_constant
    # Rounding of single precision.
    assert np.abs(drifting_direct - constant_direct).max() < 1e-5


def test_the_noise_is_that_of_averaged_bursts(tmp_path: Path) -> None:
    for board, raw in synchronise_by_the_host(SCENE, tmp_path).items():
        quiet = synced_cube(RIG, SCENE, board, noise=0.0)
        drawn = decimate_cube(synced_cube(RIG, SCENE, board) - quiet)
        power = np.mean(np.abs(find_deviation(raw, quiet)) ** 2)
        # Mean powers of 66 positions x 4 RX x 48 blocks; they differ by up to 2.6 % (measured).
        assert power == pytest.approx(np.mean(np.abs(drawn) ** 2), rel=0.05)
        ideal = SCENE.with_disturbances(ideal=True)
        noise_only = synced_cube(RIG, ideal, board, noise=0.3) - synced_cube(RIG, ideal, board)
        # `noise` is the rms amplitude.
        assert np.mean(np.abs(noise_only) ** 2) == pytest.approx(0.3**2, rel=0.05)


@pytest.mark.parametrize("count", [3, 20])
def test_few_frequencies_and_channels_are_a_subset_of_all(count: int) -> None:
    samples = np.linspace(0, 191, count).astype(int)
    full_cube = synced_cube(RIG, SCENE, "RV", noise=0.0)
    expected = full_cube[2:3, :, :, samples]
    part = synced_cube(RIG, SCENE, "RV", sample_frequencies_hz(RIG)[samples], rx=[2], noise=0.0)
    assert part.shape == (1, 6, 11, count)
    # 2e-5 is measured, far below the noise of a scan.
    assert np.abs(part - expected).max() < 1e-3 * np.abs(expected).max()


def test_an_ideal_rig_gives_the_reference_cube_and_a_constant_direct_path() -> None:
    ideal = SCENE.with_disturbances(ideal=True)
    echo = synced_cube(RIG, ideal, "RH", direct=False)
    direct = synced_cube(RIG, ideal, "RH") - echo
    without_direct_path = synced_cube(RIG, ideal.with_disturbances(direct_loss_db="absent"), "RH")
    # Equal within rounding of single precision, 6e-8. The direct path of the first RX has the amplitude 1.
    assert np.abs(echo - reference_cube(RIG, SCENE)["RH"]).max() < 1e-5
    assert np.abs(direct[0] - 1).max() < 1e-5
    assert np.abs(without_direct_path - echo).max() < 1e-6


def test_the_same_seed_gives_the_same_bytes_and_a_power_cycle_keeps_the_specimens() -> None:
    first = synced_cube(RIG, SCENE, "RH", seed=5)
    second_cube = synced_cube(RIG, SCENE, "RH", seed=5)
    cycle = synced_cube(RIG, SCENE, "RH", seed=6)
    assert first.tobytes() == second_cube.tobytes()
    assert first.tobytes() != cycle.tobytes()
    ideal = SCENE.with_disturbances(ideal=True)
    assert np.array_equal(synced_cube(RIG, ideal, "RH", seed=5), synced_cube(RIG, ideal, "RH", seed=6))
