"""The direct imager focuses a recording of another radar.

The recording is not part of this project: one degree of azimuth (117 pulses, 9.29 to 9.91 GHz, HH) of the Gotcha
Volumetric SAR Data Set, recorded from an aircraft at 10 km by the US Air Force Research Laboratory and released to the
public (C. H. Casteel et al., Proc. SPIE 6568, 2007). `POLYSIGHT_GOTCHA=.../data_3dsar_pass1_az001_HH.mat` runs these.
"""

import os

import numpy as np
import pytest
import scipy.io

from polysight.imaging import backproject
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# The strongest reflector of this degree, on the ground
BRIGHT_M = np.array([-15.6, 21.6, 0.0])


@pytest.fixture(scope="module")
def recording():
    path = os.environ.get("POLYSIGHT_GOTCHA")
    if not path:
        pytest.skip("no recording of another radar: POLYSIGHT_GOTCHA=data_3dsar_pass1_az001_HH.mat (AFRL, public)")
    data = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)["data"]
    antenna = np.stack([data.x, data.y, data.z], axis=1).astype(float)
    # Its phase is conjugated, two-way, relative to the scene's centre.
    return np.conj(data.fp.T), data.freq.astype(float), antenna, 2.0 * data.r0


def _cut(recording, axis, step_m, samples=None, reference_m=None):
    """Amplitude of the image on 61 voxels along one axis, the bright reflector in their middle."""
    s, f, antenna, reference = recording
    voxels = np.tile(BRIGHT_M, (61, 1))
    voxels[:, axis] += (np.arange(61) - 30) * step_m
    image = backproject(
        s if samples is None else samples,
        f,
        antenna,
        antenna,
        voxels,
        reference if reference_m is None else reference_m,
    )
    return np.abs(image) / s.size


def _measure_half_power_width(cut, step_m):
    peak = int(np.argmax(cut))
    low = peak - np.argmax(cut[peak::-1] < cut[peak] / np.sqrt(2))
    high = peak + np.argmax(cut[peak:] < cut[peak] / np.sqrt(2))
    return (high - low - 1) * step_m


def test_recorded_pulses_of_an_aircraft_focus_to_their_bandwidth_and_aperture(recording):
    """Half-power widths 0.886 c / (2 B cos(elevation)) in range (x here) and 0.886 lambda / (2 angle cos) across."""
    _, f, antenna, _ = recording
    elevation = np.arcsin(antenna[58, 2] / np.linalg.norm(antenna[58]))
    angle = np.ptp(np.arctan2(antenna[:, 1], antenna[:, 0]))
    in_range = 0.886 * SPEED_OF_LIGHT_M_S / (2 * np.ptp(f) * np.cos(elevation))
    across = 0.886 * SPEED_OF_LIGHT_M_S / f.mean() / (2 * angle * np.cos(elevation))
    along_x = _cut(recording, 0, 0.02)
    along_y = _cut(recording, 1, 0.06)
    # The peak is near the middle voxel, 30; the place of the reflector is known to decimetres.
    assert abs(int(np.argmax(along_x)) - 30) * 0.02 < 0.1
    assert abs(int(np.argmax(along_y)) - 30) * 0.06 < 0.3
    assert _measure_half_power_width(along_x, 0.02) == pytest.approx(in_range, rel=0.2)
    assert _measure_half_power_width(along_y, 0.06) == pytest.approx(across, rel=0.2)


def test_without_pulse_to_pulse_phase_or_with_a_wrong_range_there_is_no_focus(recording):
    rng = np.random.default_rng(0)
    s, _, _, reference = recording
    focused = _cut(recording, 1, 0.06).max()
    random_phases = np.exp(2j * np.pi * rng.uniform(size=(len(s), 1)))
    assert _cut(recording, 1, 0.06, samples=s * random_phases).max() < focused / 4
    # 20 mm are two thirds of the wavelength of 31 mm.
    wrong_reference_m = reference + rng.normal(0, 0.02, reference.size)
    assert _cut(recording, 1, 0.06, reference_m=wrong_reference_m).max() < focused / 3
