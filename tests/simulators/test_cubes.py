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
        # Chosen; it would not hold if a disturbance, such as leakage, were missing in one of the two.
        assert error < 0.01
        assert compute_relative_error(raw, cube_without_leakage) > 3 * error


def test_the_echo_of_v_drifts_as_in_the_scene_and_h_and_the_direct_path_do_not() -> None:
    drifting = SCENE.with_disturbances(hv_drift=[0.2, 30.0])
    echoes = {b: [synced_cube(RIG, s, b, noise=0.0, direct=False) for s in (drifting, SCENE)] for b in ("RH", "RV")}
    assert np.array_equal(echoes["RH"][0], echoes["RH"][1])
    factor = echoes["RV"][0] / echoes["RV"][1]
    # Row 5 runs backwards, so that its first column is the last position.
    first = factor[0, 0, 0, 0]
    last = factor[0, -1, 0, 0]
    # From the first to the last of 66 positions.
    share_of_scan = 65 / 66
    assert abs(last) - abs(first) == pytest.approx(0.2 * share_of_scan, rel=1e-3)
    assert np.degrees(np.angle(last / first)) == pytest.approx(30.0 * share_of_scan, rel=1e-3)
    drifting_direct = synced_cube(RIG, drifting, "RV", noise=0.0) - echoes["RV"][0]
    constant_direct = synced_cube(RIG, SCENE, "RV", noise=0.0) - echoes["RV"][1]
    # Rounding of single precision.
    assert np.abs(drifting_direct - constant_direct).max() < 1e-5


def test_the_noise_is_that_of_averaged_bursts(tmp_path: Path) -> None:
    for board, raw in synchronise_by_the_host(SCENE, tmp_path).items():
        quiet = synced_cube(RIG, SCENE, board, noise=0.0)
        drawn = decimate_cube(synced_cube(RIG, SCENE, board) - quiet)
        power = np.mean(np.abs(find_deviation(raw, quiet)) ** 2)
        assert power == pytest.approx(np.mean(np.abs(drawn) ** 2), rel=0.05)
        ideal = SCENE.with_disturbances(ideal=True)
        noise_only = synced_cube(RIG, ideal, board, noise=0.3) - synced_cube(RIG, ideal, board)
        assert np.mean(np.abs(noise_only) ** 2) == pytest.approx(0.09, rel=0.05)


@pytest.mark.parametrize("count", [3, 20])
def test_few_frequencies_and_channels_are_a_subset_of_all(count: int) -> None:
    samples = np.linspace(0, 191, count).astype(int)
    full_cube = synced_cube(RIG, SCENE, "RV", noise=0.0)[[2]][..., samples]
    part = synced_cube(RIG, SCENE, "RV", sample_frequencies_hz(RIG)[samples], rx=[2], noise=0.0)
    assert part.shape == (1, 6, 11, count)
    assert np.abs(part - full_cube).max() < 1e-3 * np.abs(full_cube).max()


def test_an_ideal_rig_gives_the_reference_cube_and_a_constant_direct_path() -> None:
    ideal = SCENE.with_disturbances(ideal=True)
    echo = synced_cube(RIG, ideal, "RH", direct=False)
    assert np.abs(echo - reference_cube(RIG, SCENE)["RH"]).max() < 1e-5
    direct = synced_cube(RIG, ideal, "RH") - echo
    assert np.abs(direct[0] - 1).max() < 1e-5
    assert np.abs(synced_cube(RIG, ideal.with_disturbances(direct_loss_db="absent"), "RH") - echo).max() < 1e-6


def test_the_same_seed_gives_the_same_bytes_and_a_power_cycle_keeps_the_specimens() -> None:
    first = synced_cube(RIG, SCENE, "RH", seed=5)
    second_cube = synced_cube(RIG, SCENE, "RH", seed=5)
    cycle = synced_cube(RIG, SCENE, "RH", seed=6)
    assert first.tobytes() == second_cube.tobytes()
    assert first.tobytes() != cycle.tobytes()
    ideal = SCENE.with_disturbances(ideal=True)
    assert np.array_equal(synced_cube(RIG, ideal, "RH", seed=5), synced_cube(RIG, ideal, "RH", seed=6))
