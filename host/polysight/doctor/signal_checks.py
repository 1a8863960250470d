"""Checks of the captured signals: level of the samples, direct path and order of the RX, and trigger skew."""

from __future__ import annotations

import numpy as np

from polysight.calibration import FULL_SCALE, DirectSignal, band_hz, find_direct, jitter_hz, unwrap_if
from polysight.capture import SILENT_SHARE
from polysight.doctor.context import CheckContext, error, not_checked, ok, warning
from polysight_shared.config import Board, Instrument
from polysight_shared.findings import Finding

# Share of chirps that may be clipped; chosen.
_MAX_CLIPPED = 0.01
# Least rms of the samples, ADC counts; chosen.
_MIN_RMS = 4.0
# Share of chirps in which the direct path must be found; chosen.
_MIN_DETECTED = 0.9
# Largest delay that the trigger clock of 5 ns and some ppm of the crystals can cause.
_MAX_DELAY_S = 10e-9
# Delays of one receiver after the other above which there is a warning, and an error; chosen.
_SKEW_WARNING_S = 10e-9
_SKEW_ERROR_S = 20e-9
# Two trigger clocks of 5 ns give a standard deviation of 2 ns; twice that is a warning.
_MAX_JITTER_S = 4e-9


def check_level(context: CheckContext, board: Board) -> Finding:
    """Check for clipped chirps, which cannot be synchronised, and for an RX without a signal."""
    captured = context.captured.get(board.name)
    if captured is None or not captured.valid.any():
        return not_checked("no complete chirp was captured")
    # The axes are [chirp, sample, I or Q, RX]. The rms of the complex samples of an RX is the root of the sum of the
    # mean squares of I and Q.
    words = captured.words[captured.valid]
    clipped = int(((words >= FULL_SCALE) | (words <= -FULL_SCALE)).any(axis=(1, 2, 3)).sum())
    rms = np.sqrt(np.mean(words.astype(np.float64) ** 2, axis=(0, 1, 2)) * 2)
    peak = int(np.abs(words.astype(np.int32)).max())
    observed = f"rms {rms.min():.0f}..{rms.max():.0f} counts over the RX, peak {peak} of {FULL_SCALE}"
    facts = {"clipped_chirps": clipped, "chirps": len(words), "rms": [round(float(r), 1) for r in rms], "peak": peak}
    if clipped:
        finding = error if clipped > _MAX_CLIPPED * len(words) else warning
        return finding(
            f"{observed}; {clipped} of {len(words)} chirps are clipped",
            "a strong reflection reaches the receiver, or its gain is too high",
            "lower the RX gain (radar.rx_gain_db, or the profile in mmWave Studio), or move the reflector away",
            **facts,
        )
    if silent := [f"RX{k}" for k, level in enumerate(rms, 1) if level < max(_MIN_RMS, SILENT_SHARE * rms.max())]:
        remedy = f"check the RX mask of the profile; `polysight card reset {board.name} --radar`, and arm it again"
        return error(f"no signal in {', '.join(silent)}: {observed}", "an RX is off, or sends zeros", remedy, **facts)
    return ok(observed, **facts)


def check_direct_path(context: CheckContext, board: Board) -> Finding:
    """Check that the direct path is detected, lies within the band, and at the IF that the rig file predicts."""
    captured = context.captured.get(board.name)
    if board.role == "transmit":
        return not_checked("the transmitter has no direct path to itself")
    if captured is None or not captured.valid.any():
        return not_checked("no complete chirp was captured")
    signal = find_direct(context.rig, board, captured.words, captured.valid)
    if signal.found:
        context.signals[board.name] = signal
    return judge_direct_path(context.rig, board, signal)


def judge_direct_path(rig: Instrument, board: Board, signal: DirectSignal) -> Finding:
    """Judge a board's direct path."""
    low, high = band_hz(rig)
    expected = signal.expected_hz
    is_outside = not low <= expected <= high
    predicted = f"{expected / 1e3:.0f} kHz expected from the rig file"
    facts = {"expected_hz": expected, "band_hz": [low, high], "chirps": signal.chirps, "heard": signal.if_hz.size}
    if not signal.found and not signal.rx_order:
        missed_chirps = signal.chirps - signal.if_hz.size
        observed = f"no direct path in {missed_chirps} of {signal.chirps} chirps; {predicted}"
        if is_outside:
            cause = "its IF is outside the receiver's band, so it is filtered out or aliased"
            return error(observed, cause, _suggest_start_offset(rig, board, expected), **facts)
        return error(
            observed,
            "the transmitter is off or not armed, something stands between the boards, or the start frequencies"
            " differ by more than in the rig file",
            "clear the line of sight from TX to RX; check that the transmitting board is armed, and the start"
            " frequencies of both boards",
            **facts,
        )
    if signal.rx_order:
        order = list(signal.rx_order)
        return error(
            f"the RX are recorded in another order than the rig file's: {order}",
            "lanes are exchanged, or another program lists the RX in its own order",
            f"write rx_order = {order} for {board.name} ([[boards]] of the rig file)",
            **facts,
        )
    if_hz = unwrap_if(signal.if_hz, rig)
    jitter = jitter_hz(rig)
    median = float(np.median(if_hz))
    std = float(if_hz.std())
    observed = f"at {median / 1e3:.0f} kHz, std {std / 1e3:.0f} kHz, {signal.if_hz.size} of {signal.chirps} chirps"
    facts |= {"if_hz": median, "std_hz": std, "amplitude": float(np.sqrt(np.median(signal.power)))}
    if is_outside:
        return error(
            f"{observed}; {predicted}, outside {low / 1e3:.0f}..{high / 1e3:.0f} kHz",
            "this is an alias: the anti-aliasing filter attenuates it, and the high-pass filter is inverted at the"
            " wrong frequency",
            _suggest_start_offset(rig, board, expected),
            **facts,
        )
    if median - jitter < low or median + jitter > high or signal.if_hz.size < _MIN_DETECTED * signal.chirps:
        return error(
            f"{observed}: too near the edge of {low / 1e3:.0f}..{high / 1e3:.0f} kHz",
            f"5 ns of trigger jitter move it by {jitter / 1e3:.0f} kHz, so that some chirps are lost",
            _suggest_start_offset(rig, board, median),
            **facts,
        )
    # A positive value means that the board starts early, as if its start offset were larger. The part that the crystals
    # cause is known from the drift and was subtracted.
    early_s = -signal.start_delay_s(rig)[0]
    if abs(early_s) > _MAX_DELAY_S:
        start = board.start_offset_hz + early_s * rig.chirp.slope_hz_per_s
        return warning(
            f"{observed}; {predicted}, {early_s * 1e9:+z.1f} ns away",
            "start_offset_hz in the rig file is not the programmed one, the geometry is wrong, or the board is"
            " triggered at another time than the transmitter",
            f"if the board was programmed so: start_offset_hz = {start:.0f} for {board.name}",
            **facts,
        )
    return ok(f"{observed}; {predicted}", **facts)


def _suggest_start_offset(rig: Instrument, board: Board, if_hz: float) -> str:
    """Return the remedy: the start offset that moves a direct path with this true IF to the middle of the band."""
    return f"start_offset_hz = {board.start_offset_hz + sum(band_hz(rig)) / 2 - if_hz:.0f} for {board.name}"


def check_skew(context: CheckContext) -> Finding:
    """Check that both receivers start their chirps at the same time."""
    if any(b.name not in context.signals for b in context.rig.receivers):
        return not_checked("the direct path of a receiver is missing")
    return judge_skew(context.rig, context.signals)


def judge_skew(rig: Instrument, signals: dict[str, DirectSignal]) -> Finding:
    """Judge the difference of the receivers' start times.

    Start times relative to the transmitter are computed from the start frequencies, and only as exact as these.
    """
    h, v = rig.receivers
    # Mean and standard error of the delay of each board, s.
    delay = {b.name: signals[b.name].start_delay_s(rig) for b in (h, v)}
    h_delay, h_error = delay[h.name]
    v_delay, v_error = delay[v.name]
    skew = v_delay - h_delay
    uncertainty = float(np.hypot(h_error, v_error))
    jitter = max(float(unwrap_if(signals[b.name].if_hz, rig).std()) for b in (h, v)) / rig.chirp.slope_hz_per_s
    ppm = {b.name: signals[b.name].crystal_ppm(rig) for b in (h, v)}
    observed = f"{v.name} starts {skew * 1e9:+z.2f} +- {uncertainty * 1e9:.2f} ns after {h.name}; " + ", ".join(
        f"{name} {mean * 1e9:+z.1f} ns after the transmitter, crystal {ppm[name]:+z.2f} ppm"
        for name, (mean, _) in delay.items()
    )
    facts = {
        "skew_ns": skew * 1e9,
        "standard_error_ns": uncertainty * 1e9,
        "jitter_ns": jitter * 1e9,
        "later_ns": {name: mean * 1e9 for name, (mean, _) in delay.items()},
        "crystal_ppm": ppm,
    }
    cause = "cables of unequal length, a slow edge, or a start_offset_hz that differs from the programmed one"
    remedy = "use a clock buffer (docs/how-to/wiring.md); compare SYNC_IN at the boards with an oscilloscope"
    if abs(skew) > _SKEW_WARNING_S:
        finding = error if abs(skew) > _SKEW_ERROR_S else warning
        return finding(observed, cause, remedy, **facts)
    if jitter > _MAX_JITTER_S:
        return warning(
            f"{observed}; {jitter * 1e9:.1f} ns from chirp to chirp",
            "more jitter than two clocks of 5 ns cause: noise or slow edges on SYNC_IN",
            remedy,
            **facts,
        )
    return ok(observed, **facts)
