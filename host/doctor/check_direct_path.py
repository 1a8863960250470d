"""The direct path: visible, and where its IF sits."""

from __future__ import annotations

import numpy as np

from polysight.host.calibration.direct_signal import DirectSignal, band_hz, find_direct, jitter_hz, unwrapped
from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, error, not_checked, ok, warning
from polysight.shared.config import Board, Instrument

HEARD = 0.9  # part of the chirps in which it must be found
APART_S = 10e-9  # 5 ns of trigger, and some ppm of crystals


def check_direct_path(bench: Bench, board: Board) -> Finding:
    """Found in most chirps, within the band, and where geometry and start frequencies say."""
    got = bench.captured.get(board.name)
    if board.role == "transmit":
        return not_checked("the transmitter hears only itself")
    if got is None or not got.valid.any():
        return not_checked("no whole frame was captured")
    signal = find_direct(bench.rig, board, got.words, got.valid)
    finding = judge(bench.rig, board, signal)
    if signal.found:
        bench.signals[board.name] = signal
    return finding


def better_offset_hz(rig: Instrument, board: Board, if_hz: float) -> float:
    """The `start_offset_hz` that moves a direct path at this true IF to the middle of the band."""
    return board.start_offset_hz + sum(band_hz(rig)) / 2 - if_hz


def judge(rig: Instrument, board: Board, signal: DirectSignal) -> Finding:
    """What is to be said of a board's direct path."""
    low, high = band_hz(rig)
    expected, spread = signal.expected_hz, jitter_hz(rig)
    predicted = f"{expected / 1e3:.0f} kHz by the rig file"
    facts = {"expected_hz": expected, "band_hz": [low, high], "chirps": signal.chirps, "heard": signal.if_hz.size}
    remedy = f"start_offset_hz = {better_offset_hz(rig, board, expected):.0f} for {board.name}"
    outside = not low <= expected <= high
    if not signal.found:
        return error(
            f"no direct path in {signal.chirps - signal.if_hz.size} of {signal.chirps} chirps; expected at {predicted}",
            "its IF lies outside the receiver's band, so it is filtered away or aliased"
            if outside
            else "the transmitter is off or not armed, something stands between the boards, or the start frequencies"
            " differ by more than the rig file says",
            remedy
            if outside
            else "free the line of sight from TX to RX, check that the transmitting board is armed too, and the start"
            " frequencies of both",
            **facts,
        )
    if_hz = unwrapped(signal.if_hz, rig)
    middle, std = float(np.median(if_hz)), float(if_hz.std())
    told = f"at {middle / 1e3:.0f} kHz, std {std / 1e3:.0f} kHz, {signal.if_hz.size} of {signal.chirps} chirps"
    facts |= {"if_hz": middle, "std_hz": std, "amplitude": float(np.sqrt(np.median(signal.power)))}
    if outside:
        return error(
            f"{told}; {predicted} is outside {low / 1e3:.0f}..{high / 1e3:.0f} kHz",
            "what is seen is an alias: the anti-aliasing filter weakens it, and the high-pass filter is undone wrongly",
            remedy,
            **facts,
        )
    offset = better_offset_hz(rig, board, middle)
    if middle - spread < low or middle + spread > high or signal.if_hz.size < HEARD * signal.chirps:
        return error(
            f"{told}: too near the edge of {low / 1e3:.0f}..{high / 1e3:.0f} kHz",
            f"the start frequencies put it there; 5 ns of trigger are {spread / 1e3:.0f} kHz, so some chirps are lost",
            f"start_offset_hz = {offset:.0f} for {board.name}",
            **facts,
        )
    apart = -signal.later_s(rig)[0]  # what the crystals explain is taken off
    if abs(apart) > APART_S:
        return warning(
            f"{told}; {predicted}, {apart * 1e9:+.1f} ns away",
            "start_offset_hz in the rig file is not what the board was programmed with, the geometry is wrong, or the"
            " board is triggered at another time than the transmitter",
            "if the board was programmed so: start_offset_hz ="
            f" {board.start_offset_hz + apart * rig.chirp.slope_hz_per_s:.0f} for {board.name}",
            **facts,
        )
    return ok(f"{told}; {predicted}", **facts)
