"""Bursts of one pulse with many chirps are synchronised like bursts of many pulses (simulated)."""

import msgspec
import numpy as np
import pytest
from tests.support.rigs import load_published_rig

from polysight.capture import view_row_words
from polysight.sync import BoardSetup, synchronise_row
from polysight_shared.raster import Burst, plan_raster
from polysight_simulators.scene import SimulatedRig, decode_scene
from polysight_simulators.scene.simulated_scan import row_offsets_mm

COLUMNS = 24

# Sixteen chirps of a position: one for each of 16 pulses, or all of them for one pulse
MANY_PULSES = Burst(pulses=16, period_us=1500.0)
ONE_PULSE = Burst(pulses=1, chirps=16, chirp_us=143.0, period_us=2800.0)
SCENE = decode_scene({"name": "the direct path and its disturbances", "seed": 7}, "test")


def make_rig_with_burst(burst: Burst, speed_mm_s: float):
    rig = load_published_rig()
    return msgspec.structs.replace(
        rig,
        burst=burst,
        grid=msgspec.structs.replace(rig.grid, columns=COLUMNS, rows=1),
        stage=msgspec.structs.replace(rig.stage, speed_mm_s=speed_mm_s, travel_speed_mm_s=120.0),
    )


def synchronise_burst(burst: Burst, speed_mm_s: float):
    """A simulated row of the direct path alone, synchronised."""
    rig = make_rig_with_burst(burst, speed_mm_s)
    radar = SimulatedRig(rig, SCENE)
    row = plan_raster(rig.grid).row(0)
    x, y = row_offsets_mm(radar, row)
    words = radar.chirps("RH", x, y, 0)
    payload = words.reshape(-1).view(np.uint8)
    nothing_missing = []
    decoded, valid = view_row_words(payload, nothing_missing, len(x), rig.chirp.samples, len(rig.antennas.rx_mm))
    return synchronise_row(decoded, valid, BoardSetup.from_rig(rig, rig.by_name("RH")))


@pytest.mark.parametrize(("burst", "speed_mm_s"), [(MANY_PULSES, 20.0), (ONE_PULSE, 20.0), (ONE_PULSE, 100.0)])
def test_every_position_is_synchronised(burst, speed_mm_s):
    synced = synchronise_burst(burst, speed_mm_s)
    assert synced.valid.all()
    assert synced.valid.size == COLUMNS


def test_chirps_of_one_frame_share_their_trigger_error():
    """A frame starts up to 5 ns after its pulse on each board, which shifts the frequency of all its chirps."""
    spread_hz = {}
    for name, burst in (("many pulses", MANY_PULSES), ("one pulse", ONE_PULSE)):
        rig = make_rig_with_burst(burst, speed_mm_s=20.0)
        scene = decode_scene({"name": "x", "seed": 7, "disturbances": {"direct_snr_db": 60.0}}, "test")
        radar = SimulatedRig(rig, scene)
        # Four positions at the middle of the grid; the first RX
        x_mm = np.zeros(16 * 4)
        y_mm = np.zeros(16 * 4)
        chirps = radar.signals("RH", x_mm, y_mm, 0)[:, 0]
        # The frequency of the direct path in each chirp, and its scatter among the 16 of a position
        spectrum = np.abs(np.fft.fft(chirps * np.hanning(chirps.shape[1]), 1 << 16))
        peak_bin = spectrum.argmax(axis=1).reshape(4, 16)
        bin_hz = rig.chirp.sample_rate_hz / (1 << 16)
        spread_hz[name] = peak_bin.std(axis=1).mean() * bin_hz
    # 5 ns at 38.8 MHz/us move the frequency by 194 kHz. The scatter measured is 72 kHz with many pulses, 0 with one.
    assert spread_hz["many pulses"] > 30e3
    assert spread_hz["one pulse"] < 1e3


def test_sixteen_chirps_in_one_frame_fit_five_times_the_speed():
    """2 mm at 100 mm/s are 20 ms; sixteen pulses 1.5 ms apart last 24 ms."""
    assert MANY_PULSES.chirps_a_position == ONE_PULSE.chirps_a_position == 16
    assert len(ONE_PULSE.chirp_times_s) == 16
    assert ONE_PULSE.chirp_times_s[-1] == pytest.approx(15 * 143e-6)
    assert MANY_PULSES.chirp_times_s[-1] == pytest.approx(15 * 1500e-6)


@pytest.mark.parametrize(
    ("values", "named_in_message"),
    [
        # The time from chirp to chirp is missing.
        ({"chirps": 16}, "chirp_us"),
        # A frame of 16 chirps of 143 us needs a period of 16 * 143 + 300 = 2588 us.
        ({"chirps": 16, "chirp_us": 143.0, "period_us": 2000.0}, "2588"),
    ],
)
def test_a_frame_that_does_not_fit_its_period_is_refused(values, named_in_message):
    with pytest.raises(ValueError, match=named_in_message):
        Burst(**{"pulses": 1, "period_us": 2800.0, **values})
