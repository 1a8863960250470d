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

# Paths of the echoes in excess of the direct path, metres: about those of the published scene.
GATE = (0.30, 0.47)


def _sweep(chirp):
    """Frequencies of the samples, Hz."""
    return chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)


@given(st.floats(*GATE), st.floats(*GATE))
def test_few_samples_give_every_matched_filter_output_of_all(rig, echo_m, pixel_m):
    chirp = rig.chirp
    first, end = chirp.linear_samples
    sweep_hz = _sweep(chirp)
    gate = reduction(chirp, GATE)
    samples = np.exp(2j * np.pi * sweep_hz * echo_m / C)
    window = scipy.signal.get_window("hann", end - first + 2, fftbins=False)[1:-1]
    # The filter that is matched to an echo of the path `pixel_m`, over all samples and over the few of the gate
    weighted = window / window.sum() * samples[first:end]
    from_all = (weighted * np.exp(-2j * np.pi * sweep_hz[first:end] * pixel_m / C)).sum()
    from_few = (gate.matrix @ samples * np.exp(-2j * np.pi * gate.frequencies_hz * pixel_m / C)).sum()
    # An echo leaks a little into the estimate of the direct path, which the gate subtracts: 4e-6 is measured.
    assert abs(from_few - from_all) < 1e-3
    # Few: eight here, instead of 192 samples
    assert len(gate.frequencies_hz) <= 10


def test_few_frequencies_and_many_differ_by_less_than_1e_4_of_the_peak(rig):
    """Both gates subtract the same direct path: only the number of their frequencies differs."""
    chirp = rig.chirp
    gate = reduction(chirp, GATE, extra=5)
    finer = reduction(chirp, GATE, extra=30)
    pixels_m = np.linspace(*GATE, 200)
    # An echo about the middle of the gate
    samples = np.exp(2j * np.pi * _sweep(chirp) * 0.36 / C)
    from_few = np.exp(-2j * np.pi * np.outer(pixels_m, gate.frequencies_hz) / C) @ (gate.matrix @ samples)
    from_many = np.exp(-2j * np.pi * np.outer(pixels_m, finer.frequencies_hz) / C) @ (finer.matrix @ samples)
    assert np.abs(from_few - from_many).max() < 1e-4


@given(st.floats(*GATE))
def test_the_model_predicts_an_echo_after_the_gate(rig, echo_m):
    """The model turns the echo at the few frequencies into the result of the gate for all samples."""
    gate = reduction(rig.chirp, GATE)
    reduced = gate.matrix @ np.exp(2j * np.pi * _sweep(rig.chirp) * echo_m / C)
    predicted = gate.model @ np.exp(2j * np.pi * gate.frequencies_hz * echo_m / C)
    np.testing.assert_allclose(predicted, reduced, atol=1e-4)


@pytest.mark.parametrize(("gate_m", "noise"), [(GATE, 5e-3), ((0.2, 0.9), 3e-2)])
def test_decimated_samples_give_what_all_samples_give(rig, gate_m, noise):
    """Echoes in the gate, the direct path, clutter behind it and noise give the same; other echoes are suppressed.

    The last row of the weights estimates the direct path, the others the samples of the gate. The parameter `noise` is
    the limit of the difference of the weights, relative to all weights: 2.4e-3 and 2.7e-2 are measured.
    """
    first, end = rig.chirp.linear_samples
    gate = reduction(rig.chirp, gate_m)
    sweep_hz = _sweep(rig.chirp)[first:end]
    all_weights = gate.maps(_sweep(rig.chirp))[:, first:end]
    block_weights = gate.maps(block_frequencies_hz(rig.chirp))
    nearest_echo = np.exp(2j * np.pi * gate_m[0] / C * sweep_hz)
    level = np.abs(all_weights[:-1] @ nearest_echo).max()
    # Decimation keeps a band around the echoes and the direct path (0 m): its middle is half of the gate's middle. It
    # may be off: it is estimated from noisy samples.
    for error_m in (-0.1, 0.0, 0.1):
        middle_m = sum(gate_m) / 4 + error_m
        decimated_weights = block_weights @ decimation(end - first, middle_m * rig.chirp.hz_per_sample / C)
        difference = decimated_weights - all_weights

        def find_errors(path_m, difference=difference):
            return np.abs(difference @ np.exp(2j * np.pi * path_m / C * sweep_hz))

        direct_path_and_gate_m = (0.0, *np.linspace(*gate_m, 30))
        # Relative to an echo of amplitude 1; 1.4e-4 is measured.
        assert max(find_errors(path_m).max() for path_m in direct_path_and_gate_m) < 6e-4
        # Clutter behind the scene: 2.2e-4 is measured.
        assert max(find_errors(path_m).max() for path_m in (0.7, 0.9, 1.1)) < 2e-3
        # Echoes far outside of the band are suppressed to 2 % of an echo in the gate.
        assert max(find_errors(path_m)[:-1].max() for path_m in (1.5, 2.0, 2.5)) < 0.02 * level
        assert np.linalg.norm(difference[:-1]) < noise * np.linalg.norm(all_weights[:-1])


@pytest.mark.parametrize("window", ["hann", "boxcar"])
def test_the_direct_path_vanishes_and_is_measured(rig, window):
    gate = reduction(rig.chirp, GATE, window)
    direct = np.full(256, 3.0 + 4.0j)
    np.testing.assert_allclose(gate.matrix @ direct, 0, atol=1e-9)
    assert gate.direct @ direct == pytest.approx(3 + 4j)
    # An echo in the gate hardly changes the estimate of the direct path: by 6e-5 of its amplitude (measured).
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
        # Random pixels from random positions of the stage: 31 x 31 positions in steps of 4 mm reach 60 mm to each side.
        stage_x_m, stage_y_m = rng.uniform(-0.06, 0.06, (2, 500))
        x = rng.choice(grid.x_m, 500) - stage_x_m
        y = rng.choice(grid.y_m, 500) - stage_y_m
        excess = antennas.excess_m(x, y, grid.z_m)
        assert low - 1e-4 <= excess.min()
        assert excess.max() <= high + 1e-9
