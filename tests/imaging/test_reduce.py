"""The range gate: few frequency samples give the matched filter of all samples, and the direct path is removed."""

import numpy as np
import pytest
import scipy.signal
from hypothesis import given, strategies as st

from polysight.imaging.geometry import Antennas, find_scene_gate_m, image_grid
from polysight.imaging.samples import reduction
from polysight.sync import block_frequencies_hz, decimation
from polysight_shared.raster import plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S as C

GATE = (0.30, 0.47)


def _sweep(chirp):
    return chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)


@given(st.floats(*GATE), st.floats(*GATE))
def test_few_samples_give_every_matched_filter_output_of_all(rig, echo_m, pixel_m):
    chirp = rig.chirp
    a, b = chirp.linear_samples
    gate = reduction(chirp, GATE)
    x = np.exp(2j * np.pi * _sweep(chirp) * echo_m / C)
    weight = scipy.signal.get_window("hann", b - a + 2, fftbins=False)[1:-1]
    all_samples = (weight / weight.sum() * x[a:b] * np.exp(-2j * np.pi * _sweep(chirp)[a:b] * pixel_m / C)).sum()
    few = (gate.matrix @ x * np.exp(-2j * np.pi * gate.frequencies_hz * pixel_m / C)).sum()
    # The echo leaks into the estimate of the direct path
    assert abs(few - all_samples) < 1e-3
    assert len(gate.frequencies_hz) <= 10


def test_without_the_direct_path_removal_the_error_is_below_1e_4_of_the_peak(rig):
    chirp = rig.chirp
    gate = reduction(chirp, GATE, extra=5)
    finer = reduction(chirp, GATE, extra=30)
    pixels = np.linspace(*GATE, 200)
    x = np.exp(2j * np.pi * _sweep(chirp) * 0.36 / C)
    from_few = np.exp(-2j * np.pi * np.outer(pixels, gate.frequencies_hz) / C) @ (gate.matrix @ x)
    from_many = np.exp(-2j * np.pi * np.outer(pixels, finer.frequencies_hz) / C) @ (finer.matrix @ x)
    assert np.abs(from_few - from_many).max() < 1e-4


@given(st.floats(*GATE))
def test_the_model_predicts_an_echo_after_the_gate(rig, echo_m):
    gate = reduction(rig.chirp, GATE)
    reduced = gate.matrix @ np.exp(2j * np.pi * _sweep(rig.chirp) * echo_m / C)
    np.testing.assert_allclose(gate.model @ np.exp(2j * np.pi * gate.frequencies_hz * echo_m / C), reduced, atol=1e-4)


@pytest.mark.parametrize(("gate_m", "noise"), [(GATE, 5e-3), ((0.2, 0.9), 3e-2)])
def test_decimated_samples_give_what_all_samples_give(rig, gate_m, noise):
    """It holds for echoes in the gate, the direct path, clutter behind it and noise; other echoes are suppressed."""
    a, b = rig.chirp.linear_samples
    gate = reduction(rig.chirp, gate_m)
    sweep = _sweep(rig.chirp)[a:b]
    all_weights = gate.maps(_sweep(rig.chirp))[:, a:b]
    few = gate.maps(block_frequencies_hz(rig.chirp))
    level = np.abs(all_weights[:-1] @ np.exp(2j * np.pi * gate_m[0] / C * sweep)).max()
    # The middle of the band that noise and echoes give
    for off_m in (-0.1, 0.0, 0.1):
        middle_m = sum(gate_m) / 4 + off_m
        decimated = decimation(b - a, middle_m * rig.chirp.hz_per_sample / C)

        def off(path_m, blocks=few @ decimated):
            return np.abs((blocks - all_weights) @ np.exp(2j * np.pi * path_m / C * sweep))

        assert max(off(d).max() for d in (0.0, *np.linspace(*gate_m, 30))) < 6e-4
        assert max(off(d).max() for d in (0.7, 0.9, 1.1)) < 2e-3
        assert max(off(d)[:-1].max() for d in (1.5, 2.0, 2.5)) < 0.02 * level
        assert np.linalg.norm((few @ decimated - all_weights)[:-1]) < noise * np.linalg.norm(all_weights[:-1])


@pytest.mark.parametrize("window", ["hann", "boxcar"])
def test_the_direct_path_vanishes_and_is_measured(rig, window):
    gate = reduction(rig.chirp, GATE, window)
    direct = np.full(256, 3.0 + 4.0j)
    np.testing.assert_allclose(gate.matrix @ direct, 0, atol=1e-9)
    assert gate.direct @ direct == pytest.approx(3 + 4j)
    echo = np.exp(2j * np.pi * _sweep(rig.chirp) * 0.35 / C)
    assert abs(gate.direct @ echo) < 2e-3


def test_the_gate_contains_every_pixel_at_every_position(make_rig):
    rig = make_rig()
    grid = image_grid(rig)
    plan = plan_raster(rig.grid)
    for board in rig.receivers:
        antennas = Antennas.from_rig(rig, board)
        low, high = find_scene_gate_m((antennas,), plan, grid)
        rng = np.random.default_rng(0)
        u = rng.uniform(-0.06, 0.06, (2, 500))
        x = rng.choice(grid.x_m, 500) - u[0]
        y = rng.choice(grid.y_m, 500) - u[1]
        excess = antennas.excess_m(x, y, grid.z_m)
        assert low - 1e-4 <= excess.min()
        assert excess.max() <= high + 1e-9
