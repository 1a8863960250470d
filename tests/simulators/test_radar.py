"""Simulated radars: exact without disturbances, and each disturbance has its effect alone."""

from typing import Any

import msgspec
import numpy as np
import pytest
from tests.support.rigs import load_published_rig

from polysight_shared.config import Board
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene import decode_scene
from polysight_simulators.scene.optics import antennas, field_exact
from polysight_simulators.scene.radar import SimulatedRig, high_pass, power_on, sample_frequencies_hz, sync_delay_s
from polysight_simulators.scene.scene_file import draw_uniform

RIG = load_published_rig()
GRID = {"columns": 9, "rows": 6, "step_x_mm": 10.0, "step_y_mm": 10.0}
PLATE = {"name": "m", "centre_mm": [0.0, 0.0], "size_mm": [45.0, 45.0], "metal": True}
POINT = {"position_mm": [12.0, -9.0], "amplitude": [0.5, 0.0]}


def make_radar(seed: int = 1, tables: dict[str, Any] | None = None, **disturbances: Any) -> SimulatedRig:
    """Return a rig with only the given disturbances."""
    raw = {"name": "t", "grid": GRID, **(tables or {}), "disturbances": {"ideal": True, **disturbances}}
    return SimulatedRig(RIG, decode_scene(raw, "t"), seed)


def make_default_radar(seed: int = 1, **disturbances: Any) -> SimulatedRig:
    """Return a rig with the default disturbances, except as given."""
    raw = {"name": "t", "grid": GRID, "plates": [PLATE], "disturbances": disturbances}
    return SimulatedRig(RIG, decode_scene(raw, "t"), seed)


# The middle of the scan, as x or y of one pulse.
ZERO = np.zeros(1)


# --- ideal -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("board", ["RH", "RV"])
def test_a_point_target_alone_has_phase_2_pi_f_tau(board: str) -> None:
    with_point = make_radar(tables={"points": [POINT]})
    without = make_radar()
    x = np.array([0.0, 33.3, -41.7])
    y = np.array([0.0, 20.0, -24.9])
    echo = with_point.signals(board, x, y) - without.signals(board, x, y)
    ant = antennas(with_point.rig, with_point.rig.by_name(board))
    target = ant.centre_m + np.array([*POINT["position_mm"], 0.0]) / 1e3
    f = sample_frequencies_hz(with_point.rig)
    for n in range(3):
        stage = np.array([x[n], y[n], 0.0]) / 1e3
        for rx in range(4):
            path = np.linalg.norm(target - ant.tx_m - stage) + np.linalg.norm(target - ant.rx_m[rx] - stage)
            expected = np.exp(2j * np.pi * f * path / SPEED_OF_LIGHT_M_S)
            # Differences of up to 3e-4 rad are measured.
            assert np.abs(np.angle(echo[n, rx] * expected.conj())).max() < 1e-3


@pytest.mark.parametrize("board", ["RH", "RV"])
def test_the_direct_path_alone_is_a_pure_tone(board: str) -> None:
    rig = make_radar()
    ant = antennas(rig.rig, rig.rig.by_name(board))
    f = sample_frequencies_hz(rig.rig)
    tone = np.exp(2j * np.pi * np.outer(ant.direct_m, f) / SPEED_OF_LIGHT_M_S)
    # The amplitude is 1 at the first RX, and inversely proportional to the length of the path.
    amplitude = ant.direct_m[0] / ant.direct_m
    expected = amplitude[:, None] * tone
    # Rounding of single precision leaves 6e-8 (measured).
    assert np.abs(rig.signals(board, ZERO, ZERO)[0] - expected).max() < 1e-4


# --- determinism -----------------------------------------------------------------------------------------------------


def test_pulses_do_not_depend_on_the_batch() -> None:
    x = np.linspace(-30, 30, 70)
    y = np.full(70, 5.0)
    all_chirps = make_default_radar().chirps("RH", x, y)
    batched_radar = make_default_radar()
    parts = [batched_radar.chirps("RH", x[a:b], y[a:b]) for a, b in ((0, 1), (1, 17), (17, 70))]
    # Rounding of single precision may change an ADC count by one.
    assert np.abs(all_chirps.astype(int) - np.concatenate(parts)).max() <= 1
    late = make_default_radar().chirps("RH", x[40:], y[40:], first_chirp=40)
    assert np.abs(all_chirps[40:].astype(int) - late).max() <= 1


def test_the_same_seed_repeats_and_another_seed_or_take_does_not() -> None:
    x = np.zeros(4)
    y = np.zeros(4)
    first = make_default_radar(seed=5).chirps("RV", x, y, 0)
    assert np.array_equal(first, make_default_radar(seed=5).chirps("RV", x, y, 0))
    # Another seed, and another number of the first chirp. Equal counts are a coincidence.
    for chirps in (make_default_radar(seed=6).chirps("RV", x, y, 0), make_default_radar(seed=5).chirps("RV", x, y, 4)):
        assert np.mean(first == chirps) < 0.1


def test_random_numbers_of_pulses_are_uniform_and_independent_of_batches() -> None:
    # Mean 1/2 and variance 1/12 of a uniform distribution, no correlation. The limits are five or more standard errors
    # of 100,000 numbers: 0.0009, 0.00024 and 0.003.
    u = draw_uniform(1234, np.arange(100_000))
    assert abs(u.mean() - 0.5) < 0.005
    assert abs(u.var() - 1 / 12) < 0.002
    assert abs(np.corrcoef(u[:-1], u[1:])[0, 1]) < 0.02
    assert draw_uniform(1234, np.array([777]))[0] == u[777]
    assert not np.any(draw_uniform(1235, np.arange(1000)) == u[:1000])


# --- one disturbance at a time ---------------------------------------------------------------------------------------


def test_timing_shifts_the_if_by_slope_times_delay_and_turns_the_phase() -> None:
    on = make_radar(sync_uncertainty_ns=5.0)
    undisturbed = make_radar()
    n = 40
    ratio = on.signals("RH", np.zeros(n), np.zeros(n)) / undisturbed.signals("RH", np.zeros(n), np.zeros(n))
    h = on.rig.by_name("RH")
    tx = on.rig.transmitter
    pulses = np.arange(n)
    d = on.scene.disturbances
    delay = sync_delay_s(d, 1, h, pulses) - sync_delay_s(d, 1, tx, pulses)
    # The delay of each board is uncertain by 5 ns, so that their difference has a range of 10 ns.
    assert 1e-9 < np.ptp(delay) < 10e-9
    expected = np.exp(-2j * np.pi * np.outer(delay, sample_frequencies_hz(on.rig)))
    # Rounding of single precision leaves 3e-7 (measured), and 0.02 Hz in the frequency below.
    assert np.abs(ratio[:, 0] - expected).max() < 1e-4
    turn_per_sample_rad = np.angle(ratio[:, 0, 1:] / ratio[:, 0, :-1]).mean(axis=1)
    if_hz = turn_per_sample_rad / 2 / np.pi * on.rig.chirp.sample_rate_hz
    assert np.allclose(if_hz, -on.rig.chirp.slope_hz_per_s * delay, atol=1.0)


def test_a_common_latency_cancels() -> None:
    delayed = make_radar(sync_latency_ns=160.0).signals("RH", ZERO, ZERO)
    undisturbed = make_radar().signals("RH", ZERO, ZERO)
    # 160 ns of one board alone would turn the phase by thousands of turns.
    assert np.abs(delayed - undisturbed).max() < 1e-5


def test_h_and_v_have_independent_timing_relative_to_the_transmitter() -> None:
    rig = make_radar(sync_uncertainty_ns=5.0)
    n = 2000
    d = rig.scene.disturbances
    pulses = np.arange(n)
    tx = sync_delay_s(d, 1, rig.rig.by_name("LS"), pulses)
    h = sync_delay_s(d, 1, rig.rig.by_name("RH"), pulses)
    v = sync_delay_s(d, 1, rig.rig.by_name("RV"), pulses)
    correlation = np.corrcoef(h - tx, v - tx)[0, 1]
    # The delay of the transmitter is common to both, and has half of the variance of each difference. The standard
    # error of a correlation of 0.5 in 2000 pulses is (1 - 0.5**2) / sqrt(2000) = 0.017; the limit is 3.5 of these.
    assert abs(correlation - 0.5) < 0.06


def test_one_ppm_of_crystal_is_76_khz_and_a_slope_error() -> None:
    """A crystal that is fast by 1e-6 raises the start by 1e-6 of 76 GHz, and the slope, in Hz per second, by 2e-6."""
    on = make_radar(crystal_ppm={"receive_h": 1.0})
    undisturbed = make_radar()
    turn = np.angle(on.signals("RH", ZERO, ZERO)[0, 0] / undisturbed.signals("RH", ZERO, ZERO)[0, 0])
    t = np.arange(256) / on.rig.chirp.sample_rate_hz
    # Cycles over time: the linear part is the frequency, and twice the quadratic part the slope.
    half_slope, frequency_hz, _ = np.polyfit(t, np.unwrap(turn) / 2 / np.pi, 2)
    # The fit is exact within rounding: 0.01 Hz of 76 kHz, and 4e-6 of the slope (measured).
    assert frequency_hz == pytest.approx(1e-6 * on.rig.chirp.first_sample_hz, abs=10)
    assert 2 * half_slope == pytest.approx(2e-6 * on.rig.chirp.slope_hz_per_s, rel=0.01)
    assert np.array_equal(on.signals("RV", ZERO, ZERO), undisturbed.signals("RV", ZERO, ZERO))


def test_start_offset_of_a_board_moves_its_if() -> None:
    offset_hz = 5e5

    def set_offset(board: Board) -> Board:
        return msgspec.structs.replace(board, start_offset_hz=offset_hz if board.name == "RV" else 0.0)

    moved = msgspec.structs.replace(RIG, boards=tuple(map(set_offset, RIG.boards)))
    scene = make_radar().scene
    ratio = SimulatedRig(moved, scene).signals("RV", ZERO, ZERO) / SimulatedRig(RIG, scene).signals("RV", ZERO, ZERO)
    turn_per_sample_rad = np.angle(ratio[0, 0, 1:] / ratio[0, 0, :-1])
    if_change_hz = turn_per_sample_rad / 2 / np.pi * RIG.chirp.sample_rate_hz
    # Single precision leaves 0.1 Hz (measured).
    assert np.allclose(if_change_hz, offset_hz, atol=50)


def test_phase_is_uniform_from_chirp_to_chirp() -> None:
    rig = make_radar(random_phase=True)
    phase = np.angle(rig.signals("RH", np.zeros(4000), np.zeros(4000))[:, 0, 0])
    # 500 of 4000 phases are expected in each of eight parts, with a standard deviation of 21: the limits are five away.
    counts, _ = np.histogram(phase, 8, (-np.pi, np.pi))
    assert counts.min() > 400
    assert counts.max() < 600


@pytest.mark.parametrize("board", ["RH", "RV"])
def test_the_chirp_bends_only_after_the_linear_samples(board: str) -> None:
    for seed in range(3):
        on = make_radar(seed, bend_hz=300e3, ripple_hz=3e3)
        undisturbed = make_radar(seed)
        turn = np.unwrap(np.angle(on.signals(board, ZERO, ZERO)[0, 0] / undisturbed.signals(board, ZERO, ZERO)[0, 0]))
        # The first 192 samples are linear, except for the ripple: the phase deviates from a straight line by 0.005 rad
        # at most (measured), but not by 0.
        k = np.arange(192)
        deviation_rad = turn[:192] - np.polyval(np.polyfit(k, turn[:192], 1), k)
        assert 1e-4 < np.abs(deviation_rad).max() < 0.1
        # At the end the frequency has bent by about 300 kHz.
        last_hz = np.abs(np.diff(turn)[-3:]) / 2 / np.pi * on.rig.chirp.sample_rate_hz
        assert last_hz.min() > 150e3
        assert last_hz.max() < 400e3


def test_each_path_goes_through_the_filter_at_its_own_if() -> None:
    if_offset_hz = 870e3
    on = make_radar(tables={"points": [POINT]}, hpf=True, if_offset_hz=if_offset_hz)
    undisturbed = make_radar(tables={"points": [POINT]}, if_offset_hz=if_offset_hz)
    direct = make_radar(if_offset_hz=if_offset_hz).signals("RH", ZERO, ZERO)[0, 0]
    echo = undisturbed.signals("RH", ZERO, ZERO)[0, 0] - direct
    ant = antennas(on.rig, on.rig.by_name("RH"))
    target = ant.centre_m + np.array([*POINT["position_mm"], 0.0]) / 1e3
    path = np.linalg.norm(target - ant.tx_m) + np.linalg.norm(target - ant.rx_m[0])
    hz_per_m = on.rig.chirp.slope_hz_per_s / SPEED_OF_LIGHT_M_S
    h_direct, _ = high_pass(np.array(if_offset_hz + hz_per_m * ant.direct_m[0]), on.rig.chirp)
    h_echo, _ = high_pass(np.array(if_offset_hz + hz_per_m * path), on.rig.chirp)
    expected = h_direct * direct + h_echo * echo
    # The filter weakens the direct path by 6 %, which is far more than the error (measured: 2e-4).
    assert 0.9 < abs(h_direct) < 0.96
    assert np.abs(on.signals("RH", ZERO, ZERO)[0, 0] - expected).max() < 1e-3


def test_gains_are_within_their_spread_fixed_for_a_power_cycle_and_new_in_the_next() -> None:
    spread_db = 1.0
    spread_deg = 20.0
    # The seed is that of a power cycle.
    on = make_radar(seed=3, rx_gain_spread_db=spread_db, rx_phase_spread_deg=spread_deg)
    undisturbed = make_radar(seed=3)
    gain = on.signals("RV", np.zeros(2), np.zeros(2)) / undisturbed.signals("RV", np.zeros(2), np.zeros(2))
    # One gain for each RX, the same in both pulses and all samples
    gain_of_rx = gain[0, :, 0]
    assert np.allclose(gain, gain_of_rx[None, :, None], atol=1e-5)
    assert np.abs(20 * np.log10(np.abs(gain_of_rx))).max() <= spread_db
    assert np.abs(np.degrees(np.angle(gain_of_rx))).max() <= spread_deg
    # The gains differ: by 5 % here.
    assert np.ptp(np.abs(gain_of_rx)) > 0.01
    board = on.rig.by_name("RV")
    set_gains = power_on(on.rig, on.scene, board, seed=3).gains
    gains_of_next_cycle = power_on(on.rig, on.scene, board, seed=4).gains
    # Equal within rounding of single precision
    assert np.allclose(gain_of_rx, set_gains, atol=1e-5)
    assert not np.allclose(set_gains, gains_of_next_cycle)


def test_h_and_v_differ_by_the_set_gain() -> None:
    gain_db = 1.5
    on = make_radar(hv_gain_db=gain_db)
    h = np.abs(on.signals("RH", ZERO, ZERO)[0, 0]).mean()
    v = np.abs(on.signals("RV", ZERO, ZERO)[0, 0]).mean()
    # Single precision leaves 2e-7 dB (measured).
    assert 20 * np.log10(h / v) == pytest.approx(gain_db, abs=1e-3)


def test_leakage_reaches_direct_path_and_object() -> None:
    tables = {"plates": [{**PLATE, "metal": False, "permittivity": [4.0, 0.4]}]}
    leakage = 0.06 - 0.03j
    leakage_parts = [leakage.real, leakage.imag]
    on = make_radar(tables=tables, leakage_v=leakage_parts)
    undisturbed = make_radar(tables=tables)
    empty_on = make_radar(leakage_v=leakage_parts)
    empty_off = make_radar()
    ratio = empty_on.signals("RV", ZERO, ZERO) / empty_off.signals("RV", ZERO, ZERO)
    # Samples have the conjugate of fields.
    assert np.allclose(ratio, np.conj(1 + leakage), atol=1e-5)
    # One sample of one RX: the echo is the signal of the scene without that of the empty scene.
    sample = 100
    f = sample_frequencies_hz(on.rig)[[sample]]
    echo = (on.signals("RV", ZERO, ZERO) - empty_on.signals("RV", ZERO, ZERO))[0, 0, sample]
    exact = field_exact(on.rig, on.scene, on.rig.by_name("RV"), np.zeros((1, 2)), f)[0, 0]
    # The difference is 7e-4 (measured), although the leakage changes the echo by 30 %.
    assert abs(echo - exact) < 2e-3 * abs(exact)
    echo_without_leakage = (undisturbed.signals("RV", ZERO, ZERO) - empty_off.signals("RV", ZERO, ZERO))[0, 0, sample]
    assert abs(echo / echo_without_leakage - 1) > 0.05
    assert np.array_equal(on.signals("RH", ZERO, ZERO), undisturbed.signals("RH", ZERO, ZERO))


def test_noise_has_the_set_ratio_on_every_channel_and_averages_down() -> None:
    snr_db = 5.5
    on = make_radar(direct_snr_db=snr_db, rx_gain_spread_db=1.0)
    undisturbed = make_radar(rx_gain_spread_db=1.0)
    # 160 pulses are ten bursts.
    n = 160
    clean = undisturbed.signals("RH", ZERO, ZERO)
    noise = on.signals("RH", np.zeros(n), np.zeros(n)) - clean
    # [rx]: means over pulses and samples
    signal_power = np.mean(np.abs(clean) ** 2, axis=(0, 2))
    noise_power = np.mean(np.abs(noise) ** 2, axis=(0, 2))
    # 160 x 256 samples know their power to 0.5 %, 0.02 dB.
    assert np.allclose(10 * np.log10(signal_power / noise_power), snr_db, atol=0.15)
    noise_of_means = noise.reshape(-1, 16, 4, 256).mean(axis=1)
    # The mean of a burst of 16 has 12 dB more. Ten times 4 x 256 samples know their power to 1 %, 0.04 dB.
    snr_of_means_db = 10 * np.log10(signal_power.mean() / np.mean(np.abs(noise_of_means) ** 2))
    assert snr_of_means_db == pytest.approx(snr_db + 10 * np.log10(16), abs=0.2)
    # The real and the imaginary part are independent: 1.5e-4 is measured.
    assert abs(np.mean(noise.real * noise.imag)) < 0.01 * noise_power.mean()


# --- bytes -----------------------------------------------------------------------------------------------------------


def test_frames_contain_i_of_the_four_rx_then_q() -> None:
    full_scale = 4.0
    rig = make_radar(tables={"plates": [PLATE]}, adc_full_scale=full_scale)
    signal = rig.signals("RH", np.zeros(2), np.zeros(2))
    frames = rig.chirps("RH", np.zeros(2), np.zeros(2))
    assert frames.shape == (2, 256, 8)
    assert frames.dtype == np.int16
    counts = signal * 32767 / full_scale
    for rx in range(4):
        # Counts are rounded to whole numbers.
        assert np.abs(frames[:, :, rx] - counts[:, rx].real).max() <= 0.51
        assert np.abs(frames[:, :, 4 + rx] - counts[:, rx].imag).max() <= 0.51


def test_clipping_is_bounded_and_counted() -> None:
    # The direct path has an amplitude of 1: it is clipped at a full scale of 0.5, and not at 2.
    loud = make_radar(adc_full_scale=0.5)
    quiet = make_radar(adc_full_scale=2.0)
    frames = loud.chirps("RH", ZERO, ZERO)
    # Real and imaginary parts
    signal = quiet.signals("RH", ZERO, ZERO).view(np.float32)
    counts = np.rint(np.abs(signal) * np.float32(32767 / 0.5))
    assert frames.max() == 32767
    assert frames.min() == -32768
    # 32767 is the largest count.
    assert loud.clipped["RH"] == (counts > 32767).sum()
    assert loud.clipped["RH"] > 0
    quiet.chirps("RH", ZERO, ZERO)
    assert quiet.clipped == {"LS": 0, "RH": 0, "RV": 0}


def test_a_burst_moves_with_the_stage_or_stays_at_its_mean() -> None:
    moving = make_radar(burst_motion=True)
    radar_at_rest = make_radar()
    # The first pulse comes 0.2 ms after the trigger, the others 1.5 ms apart; the stage moves at 20 mm/s.
    pulse_times_s = 0.2e-3 + np.arange(16) * 1.5e-3
    assert np.allclose(moving.burst_mm(direction=1), 20.0 * pulse_times_s)
    assert np.allclose(radar_at_rest.burst_mm(direction=-1), -20.0 * pulse_times_s.mean())
    for direction in (1, -1):
        assert np.isclose(moving.burst_mm(direction).mean(), radar_at_rest.burst_mm(direction).mean())
