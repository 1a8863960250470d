"""Levels, direct paths and skew at the limits of their checks, on signals that are given."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.support.rigs import make_programmed_rig

from polysight.calibration import DirectSignal, band_hz, unwrap_if
from polysight.doctor.signal_checks import check_level, judge_direct_path, judge_skew

RIG = make_programmed_rig()
SLOPE = RIG.chirp.slope_hz_per_s
# Middle of the samples that are used, 0 to 191; seconds after the first one.
MIDDLE_S = 95.5 / RIG.chirp.sample_rate_hz
# IF of the direct path, inside the band of 0 to 1935 kHz
EXPECTED_HZ = 900e3
# Chirps of a signal
CHIRPS = 40
# Signals here have no noise: times differ by rounding alone.
ROUNDING_NS = 1e-3


def make_signal(
    delay_ns: float = 0.0,
    ppm: float = 0.0,
    jitter_ns: float = 0.0,
    found: int = CHIRPS,
    chirps: int = CHIRPS,
    **changes: Any,
) -> DirectSignal:
    """A direct path, found in `found` of the chirps, of a board that starts `delay_ns` late with a crystal `ppm` fast.

    The jitter of successive chirps is alternately `jitter_ns` and its negative. `changes` replace other fields.
    """
    # The IF is the difference of both boards' frequencies f0 + K t. With a crystal that is faster by p the frequency
    # rises from f0 (1 + p), and by K (1 + p)^2 a second, because the clock that times the ramp is faster, too.
    offset_hz = ppm * 1e-6 * (RIG.chirp.first_sample_hz + 2 * SLOPE * MIDDLE_S)
    signs = np.where(np.arange(found) % 2, 1.0, -1.0)
    fields: dict[str, Any] = {
        "if_hz": EXPECTED_HZ + offset_hz - SLOPE * 1e-9 * (delay_ns + jitter_ns * signs),
        "power": np.full(found, 100.0), "noise_power": np.full(found, 1.0), "expected_hz": EXPECTED_HZ,
        "drift_hz_per_s": 2e-6 * ppm * SLOPE, "chirps": chirps,
    }  # fmt: skip
    return DirectSignal(**(fields | changes))


@pytest.mark.parametrize(("found", "chirps", "is_found"), [(5, 10, False), (6, 10, True), (1, 1, True), (0, 0, False)])
def test_a_direct_path_is_found_in_more_than_half_of_the_chirps(found, chirps, is_found):
    assert make_signal(found=found, chirps=chirps).found is is_found


@pytest.mark.parametrize("ppm", [0.0, 12.0, -7.5])
@pytest.mark.parametrize("delay_ns", [0.0, 3.0, -8.0])
def test_delay_and_crystal_are_separated(ppm, delay_ns):
    jitter_ns = 2.0
    signal = make_signal(delay_ns, ppm, jitter_ns=jitter_ns)
    assert signal.crystal_ppm(RIG) == pytest.approx(ppm)
    mean_s, error_s = signal.start_delay_s(RIG)
    assert mean_s * 1e9 == pytest.approx(delay_ns, abs=ROUNDING_NS)
    # The standard deviation of +-2 ns in 40 chirps is 2 ns x sqrt(40 / 39); the mean's error is that / sqrt(40).
    assert error_s * 1e9 == pytest.approx(jitter_ns / np.sqrt(CHIRPS - 1), rel=1e-3)
    assert make_signal(found=1, chirps=1).start_delay_s(RIG)[1] == np.inf


@pytest.mark.parametrize("rates", [0, 1, -1, 2])
def test_a_path_beyond_the_band_is_brought_back_by_whole_sample_rates(rates):
    delay_ns = 3.0
    signal = make_signal(delay_ns)
    beyond_hz = EXPECTED_HZ + rates * RIG.chirp.sample_rate_hz
    aliased = make_signal(delay_ns, expected_hz=beyond_hz)
    assert np.array_equal(aliased.if_hz, signal.if_hz)
    found_delay_s, _ = aliased.start_delay_s(RIG)
    assert found_delay_s * 1e9 == pytest.approx(delay_ns, abs=ROUNDING_NS)


def test_the_band_is_nine_tenths_of_the_sample_rate():
    assert band_hz(RIG) == (0.0, pytest.approx(0.9 * RIG.chirp.sample_rate_hz))
    symmetric = make_programmed_rig(chirp={"if_mode": "complex2x"})
    assert band_hz(symmetric) == pytest.approx((-0.45 * 2.15e6, 0.45 * 2.15e6))


def test_frequencies_on_both_sides_of_the_rate_lie_together():
    rate = RIG.chirp.sample_rate_hz
    given = np.array([0.98, 0.99, 0.01, 0.02, 0.97]) * rate
    near = unwrap_if(given, RIG)
    assert np.ptp(near) == pytest.approx(0.05 * rate)
    np.testing.assert_allclose((near - given) / rate, np.round((near - given) / rate), atol=1e-9)
    # Frequencies that lie together already are not changed.
    inside = np.array([0.4, 0.5, 0.6]) * rate
    np.testing.assert_allclose(unwrap_if(inside, RIG), inside)


@pytest.mark.parametrize(
    ("delay_ns", "level"), [(9.9, "ok"), (-9.9, "ok"), (10.1, "warning"), (-10.1, "warning"), (0.0, "ok")]
)
def test_a_board_starts_within_10_ns_of_the_transmitter(delay_ns, level):
    board = RIG.by_role("receive_h")
    finding = judge_direct_path(RIG, board, make_signal(delay_ns))
    assert finding.level == level
    if level == "warning":
        assert f"{-delay_ns:+.1f} ns away" in finding.what
        # A late start looks like a lower start frequency: the remedy gives the offset that would explain it.
        offset_hz = board.start_offset_hz - delay_ns * 1e-9 * SLOPE
        assert f"start_offset_hz = {offset_hz:.0f} for {board.name}" in finding.do


@pytest.mark.parametrize(
    ("expected_hz", "found", "words"),
    [
        # A trigger clock of 5 ns moves the IF by 194 kHz: the IF must be at least this far from both ends of the band,
        # 0 and 1935 kHz. The path must be found in nine tenths of the 40 chirps.
        (195e3, 40, ""), (193e3, 40, "too near the edge"), (1740e3, 40, ""), (1742e3, 40, "too near the edge"),
        (900e3, 36, ""), (900e3, 35, "too near the edge"), (900e3, 20, "no direct path in 20 of 40"),
        (1936e3, 40, "outside 0..1935 kHz"), (-1e3, 40, "outside 0..1935 kHz"), (-1e3, 5, "no direct path in 35 of 40"),
    ],
)  # fmt: skip
def test_a_direct_path_has_room_for_jitter_in_the_band(expected_hz, found, words):
    board = RIG.by_role("receive_h")
    signal = make_signal(expected_hz=expected_hz, if_hz=np.full(found, expected_hz) % RIG.chirp.sample_rate_hz)
    finding = judge_direct_path(RIG, board, signal)
    assert finding.level == ("error" if words else "ok")
    assert words in finding.what
    if "edge" in words or "outside" in words:
        # The remedy moves the path into the middle of the band.
        middle_hz = 967.5e3
        assert f"start_offset_hz = {board.start_offset_hz + middle_hz - expected_hz:.0f}" in finding.do


@pytest.mark.parametrize(
    ("skew_ns", "level"),
    [(9.9, "ok"), (10.1, "warning"), (-10.1, "warning"), (19.9, "warning"), (20.1, "error"), (-20.1, "error")],
)
def test_receivers_start_within_10_ns_of_each_other(skew_ns, level):
    """Both start 30 ns early, which would be too much of one: only their difference is judged here."""
    rh_delay_ns = -30.0
    finding = judge_skew(RIG, {"RH": make_signal(rh_delay_ns), "RV": make_signal(rh_delay_ns + skew_ns)})
    assert finding.level == level
    assert f"RV starts {skew_ns:+.2f} +- 0.00 ns after RH" in finding.what
    assert finding.facts["later_ns"]["RH"] == pytest.approx(rh_delay_ns, abs=ROUNDING_NS)


@pytest.mark.parametrize(("jitter_ns", "level"), [(3.9, "ok"), (4.1, "warning")])
def test_more_jitter_than_4_ns_of_one_receiver_is_a_warning(jitter_ns, level):
    """4 ns are twice the standard deviation that two trigger clocks of 5 ns cause."""
    for rh_jitter_ns, rv_jitter_ns in ((jitter_ns, 0.0), (0.0, jitter_ns)):
        signals = {"RH": make_signal(jitter_ns=rh_jitter_ns), "RV": make_signal(jitter_ns=rv_jitter_ns)}
        finding = judge_skew(RIG, signals)
        assert finding.level == level
        # The error is that of one board's mean, because the other board has no jitter.
        assert finding.facts["standard_error_ns"] == pytest.approx(jitter_ns / (CHIRPS - 1) ** 0.5, rel=1e-3)


def judge_words(words: np.ndarray) -> Any:
    """Judge words int16 [chirp, sample, I or Q, RX], the last chirp of which is not complete."""
    valid = np.ones(len(words), bool)
    valid[-1] = False
    context: Any = SimpleNamespace(captured={"RH": SimpleNamespace(words=words, valid=valid)})
    return check_level(context, RIG.by_role("receive_h"))


def make_words(level: int = 100) -> np.ndarray:
    """Words of 200 complete chirps and one that is not, each of 16 samples; all have this value."""
    return np.full((201, 16, 2, 4), level, np.int16)


@pytest.mark.parametrize("full", [32767, -32767, -32768])
@pytest.mark.parametrize(("clipped", "level"), [(0, "ok"), (1, "warning"), (2, "warning"), (3, "error")])
def test_one_percent_of_clipped_chirps_is_a_warning(full, clipped, level):
    words = make_words()
    for chirp in range(clipped):
        i_or_q = chirp % 2
        words[chirp, 3, i_or_q, 1] = full
    # The incomplete chirp does not count, and one count below full scale is not clipped.
    words[-1] = full
    words[10, 0, 0, 0] = 32766
    finding = judge_words(words)
    assert finding.level == level
    assert finding.facts["clipped_chirps"] == clipped
    assert finding.facts["chirps"] == 200


@pytest.mark.parametrize(
    ("levels", "silent"),
    [
        ((100, 100, 100, 100), ""), ((100, 8, 100, 100), ""), ((100, 100, 6, 100), "RX3"),
        ((0, 100, 0, 100), "RX1, RX3"),
        # The least rms of a signal is 4 counts, I and Q together: 3 x sqrt(2) is above it, 2 x sqrt(2) below.
        ((3, 3, 3, 3), ""), ((2, 2, 2, 2), "RX1, RX2, RX3, RX4"),
    ],
)  # fmt: skip
def test_a_receiver_has_a_signal_of_its_own_and_not_much_less_than_the_others(levels, silent):
    words = make_words()
    words[:] = np.array(levels, np.int16)
    finding = judge_words(words)
    assert finding.level == ("error" if silent else "ok")
    if silent:
        assert f"no signal in {silent}:" in finding.what
    assert finding.facts["rms"] == [round(level * 2**0.5, 1) for level in levels]
    assert finding.facts["peak"] == max(levels)


def test_without_a_complete_chirp_nothing_is_judged():
    # The last chirp of these words, here the only one, is not complete.
    words_of_one_chirp = make_words()[:1]
    assert judge_words(words_of_one_chirp).level == "note"
    context: Any = SimpleNamespace(captured={})
    assert check_level(context, RIG.by_role("receive_h")).level == "note"
