"""Simulate samples after ideal synchronisation, without raw data.

:func:`reference_cube` is the object's echo for an ideal rig. :func:`synced_cube` adds the disturbances that
synchronisation does not remove (leakage, gains, noise, the direct path, backlash) to the averaged samples: hundreds of
scenes take the time of one raw scan.

A synced cube differs from a raw scan that the host synchronised (tests/simulators/test_cubes.py) by one complex factor,
common to all rows, channels and samples. The remaining difference without noise is less than 1 % RMS, due to residuals
of motion within a burst, of the filter, and of the object in the host's direct path. The noise power agrees within 5 %.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from polysight_shared.config import Board, Instrument
from polysight_shared.raster import mean_burst_travel_mm, plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene.field import ObjectField, build_field, node_matrix
from polysight_simulators.scene.optics import Real, antennas, direct_factor
from polysight_simulators.scene.radar import echo_drift, high_pass, power_on, sample_frequencies_hz
from polysight_simulators.scene.scene_file import Scene, apply_scene, stream_key


def reference_cube(rig: Instrument, scene: Scene) -> dict[str, NDArray[np.complex64]]:
    """Return the object's echo after ideal synchronisation, at the true positions.

    All disturbances of the scene are ignored: there are no leakage, gains, noise or direct path. Each position is the
    mean of its burst (x + direction x mean travel). Phases are relative to each RX's own direct path, 2 pi f (tau -
    tau_direct).

    Parameters
    ----------
    rig, scene
        Rig file and scene; the scene's overrides are applied.

    Returns
    -------
    complex64 [rx, row, column, sample] for each receiving board's name; column 0 is the smallest x. A full published
    grid is 573 MB a board.
    """
    ideal = scene.with_disturbances(ideal=True)
    rig = apply_scene(rig, ideal)
    f = sample_frequencies_hz(rig)
    cubes = {}
    for board in rig.receivers:
        field = build_field(rig, ideal, board, f)
        path_m = field.centre_path_m - antennas(rig, board).direct_m
        cubes[board.name] = _sample_field(field, rig, f, path_m, np.ones(len(path_m), np.complex64), 0.0)
    return cubes


def synced_cube(
    rig: Instrument,
    scene: Scene,
    board_name: str,
    frequencies_hz: Real | None = None,
    rx: Sequence[int] | None = None,
    noise: float | None = None,
    direct: bool = True,
    seed: int | None = None,
) -> NDArray[np.complex64]:
    """Return the samples of a scan after ideal synchronisation: relative to the direct path, bursts averaged.

    These disturbances are simulated: leakage, gains and phases of the channels, H over V and its drift, noise, loss of
    the direct path, and backlash. An echo of amplitude A whose path exceeds the direct one by d is
    A exp(+j 2 pi f d / c); the direct path is constant over f.

    Parameters
    ----------
    rig, scene, board_name
        Rig file and scene; the scene's overrides are applied. One of the receiving boards.
    frequencies_hz
        Transmit frequencies, ascending; None: those of all ADC samples. Few are fast.
    rx
        Channels; None for all.
    noise
        RMS noise of an averaged sample of a channel of gain 1, relative to the direct path; None: from `direct_snr_db`,
        averaging and filter compensation.
    direct
        Include the direct path.
    seed
        Seed of the power cycle (gains and noise); None: the scene's. Specimens always use the scene's seed.

    Returns
    -------
    complex64 [rx, row, column, frequency]; column 0 is the smallest x. Amplitudes are relative to the free direct path
    of RX1, which has the index 0.
    """
    rig = apply_scene(rig, scene)
    seed = scene.seed if seed is None else seed
    board = rig.by_name(board_name)
    d = scene.disturbances
    if frequencies_hz is None:
        f = sample_frequencies_hz(rig)
    else:
        f = np.asarray(frequencies_hz, np.float64)
    if rx is None:
        channels = list(range(len(rig.antennas.rx_mm)))
    else:
        channels = list(rx)
    field = build_field(rig, scene, board, f, rx=channels)
    direct_of_all_m = antennas(rig, board).direct_m
    direct_m = direct_of_all_m[channels]
    gains = power_on(rig, scene, board, seed).gains[channels]
    cube = _sample_field(field, rig, f, field.centre_path_m - direct_m, gains, d.backlash_mm)
    cube *= _compute_drift(rig, scene, board)[:, :, None]
    if direct:
        level = direct_factor(board, scene) * d.direct_gain * direct_of_all_m[0] / direct_m
        cube += (gains * level).astype(np.complex64)[:, None, None, None]
    if noise is None:
        noise = _compute_burst_noise(rig, scene, board, seed, field.centre_path_m)
    if noise > 0:
        cube += _draw_noise(cube.shape, noise * np.abs(gains), stream_key(seed, "synced noise", board.name))
    return cube


def _draw_noise(shape: tuple[int, ...], rms_of_channel: Real, key: int) -> NDArray[np.complex64]:
    """Return complex noise of `shape`; its first axis is that of `rms_of_channel`."""
    rng = np.random.default_rng(key)
    noise = rng.standard_normal((*shape[:-1], 2 * shape[-1]), dtype=np.float32).view(np.complex64)
    return noise * (np.sqrt(0.5) * rms_of_channel).astype(np.float32)[:, None, None, None]


def _compute_drift(rig: Instrument, scene: Scene, board: Board) -> NDArray[np.complex64]:
    """Return the drift of a board's echo at every position, [row, column], by the chirps sent before it."""
    plan = plan_raster(rig.grid)
    factors = np.empty((plan.rows, plan.columns), np.complex64)
    for row in plan:
        columns = [row.column(i) for i in range(row.points)]
        positions = row.index * plan.columns + np.arange(row.points)
        factors[row.index, columns] = echo_drift(
            rig, scene.disturbances, board, positions * rig.burst.chirps_a_position
        )
    return factors


def _compute_burst_noise(rig: Instrument, scene: Scene, board: Board, seed: int, echo_m: float) -> float:
    """Return the RMS noise of an averaged sample, divided by the gain of the high-pass filter, which is compensated.

    `echo_m` is the path from TX over the object to RX.
    """
    d = scene.disturbances
    chirp = rig.chirp
    if d.direct_snr_db is None:
        return 0.0
    averaged = 10.0 ** (-d.direct_snr_db / 20) / np.sqrt(rig.burst.chirps_a_position)
    if not d.hpf:
        return float(averaged)
    # The filter's gain is that at the IF half way between direct path and echo.
    delay_s = (antennas(rig, board).direct_m[0] + echo_m) / 2 / SPEED_OF_LIGHT_M_S
    if_hz = chirp.slope_hz_per_s * delay_s + power_on(rig, scene, board, seed).if_error_hz.mean()
    # The first value is the filter, the second its derivative.
    return float(averaged / np.abs(high_pass(np.array(if_hz), chirp)[0]))


def _sample_field(
    field: ObjectField,
    rig: Instrument,
    f: Real,
    path_m_of_rx: Real,
    gains: NDArray[np.complexfloating],
    backlash_mm: float,
) -> NDArray[np.complex64]:
    """Return the field at the true positions, [rx, row, column, frequency], with the phase of path `path_m_of_rx` [rx].

    This path is the field's `centre_path_m`, whose phase was removed, less the direct path. Complex `gains` [rx]
    multiply the samples; in rows towards -x the stage lags behind by `backlash_mm`.
    """
    if np.array_equal(field.nodes_hz, f):
        nodes_to_frequencies = np.eye(len(f))
    else:
        # The second matrix, the derivative, is not needed.
        nodes_to_frequencies = node_matrix(field, f)[0]
    phase_and_gain = np.exp(2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(path_m_of_rx, f)) * gains[:, None]
    # Matrix from the field's own frequencies to those requested, with phase and gain: [rx, node, frequency].
    expand = (nodes_to_frequencies * phase_and_gain[:, None]).astype(np.complex64)
    plan = plan_raster(rig.grid)
    travel = mean_burst_travel_mm(rig.burst, rig.stage)
    cube = np.empty((len(path_m_of_rx), plan.rows, plan.columns, len(f)), dtype=np.complex64)
    for row in plan:
        x = np.array(row.x_mm) + row.direction * travel
        if row.direction < 0:
            x += backlash_mm
        # [position, rx, node], a node being a frequency at which the field was computed.
        nodes = field.interpolate(x / 1e3, np.full(len(x), row.y_mm / 1e3))
        order = [row.column(i) for i in range(row.points)]
        cube[:, row.index, order] = np.einsum("prq,rqk->rpk", nodes, expand, optimize=True)
    return cube
