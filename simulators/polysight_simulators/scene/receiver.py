"""Effects of a receiving board on the ideal IF signal: timing, crystal, chirp shape, filter, gains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polysight_shared.config import Board, Chirp, Instrument
from polysight_simulators.scene.draws import pulse_uniform, stream_key
from polysight_simulators.scene.scene_file import Disturbances, Scene

Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]


def sync_delay_s(d: Disturbances, seed: int, board: Board, pulses: NDArray[np.int64]) -> Real:
    """Return the delay from SYNC_IN edge to chirp start: fixed latency plus sampling by the board's clock, [pulse]."""
    jitter = pulse_uniform(stream_key(seed, "sync", board.name), pulses)
    return 1e-9 * (d.sync_latency_ns + getattr(d.sync_skew_ns, board.role) + d.sync_uncertainty_ns * jitter)


def high_pass(if_hz: Real, chirp: Chirp) -> tuple[Complex, Complex]:
    """Return the IF high-pass filter and its derivative per Hz at IF frequencies, any shape.

    Two first-order sections, H = prod 1 / (1 - j f_c / f): -3 dB and +45 degrees at each section's corner.
    """
    f = np.where(np.abs(if_hz) < 1e-3, 1e-3, if_hz)
    h, log_slope = np.ones(np.shape(f), np.complex128), np.zeros(np.shape(f), np.complex128)
    for corner in (chirp.hpf1_khz * 1e3, chirp.hpf2_khz * 1e3):
        u = corner / f
        section = np.empty(np.shape(f), np.complex128)  # 1 / (1 - j u), without a complex division
        section.real = 1.0 / (1.0 + u * u)
        section.imag = u * section.real
        h *= section
        log_slope.real += section.imag * u / f  # -j u section / f
        log_slope.imag -= section.real * u / f
    return h, h * log_slope


@dataclass(frozen=True)
class Receiver:
    """A receiving board in one power cycle.

    Attributes
    ----------
    gains
        complex64 [rx], relative to the nominal channel.
    phase
        Phase of the chirp relative to the transmitter's, rad [sample].
    if_error_hz
        Its derivative, Hz [sample]: crystal and programmed offsets, slope error, bend and ripple.
    """

    board: Board
    chirp: Chirp
    gains: NDArray[np.complex64]
    phase: Real
    if_error_hz: Real


def power_on(rig: Instrument, scene: Scene, board: Board, seed: int) -> Receiver:
    """Return a receiving board after power-up, with gains and chirp shape from the seed and the board's name."""
    d, chirp = scene.disturbances, rig.chirp
    rng = np.random.default_rng(stream_key(seed, "power", board.name))
    spread_db = rng.uniform(-1, 1, len(rig.antennas.rx_mm)) * d.rx_gain_spread_db
    spread_rad = np.radians(rng.uniform(-1, 1, len(rig.antennas.rx_mm)) * d.rx_phase_spread_deg)
    board_db = d.hv_gain_db / 2 if board.role == "receive_h" else -d.hv_gain_db / 2
    gains = 10 ** ((spread_db + board_db) / 20) * np.exp(1j * spread_rad)

    t = np.arange(chirp.samples) / chirp.sample_rate_hz
    ppm = getattr(d.crystal_ppm, board.role) - d.crystal_ppm.transmit
    # A relative crystal error p raises the start frequency by p f and the slope by 2 p K.
    # Under native control the host programs the start frequencies of the rig file, without further offset.
    programmed_hz = 0.0 if rig.radar.control == "native" else d.if_offset_hz
    constant = programmed_hz + board.start_offset_hz - rig.transmitter.start_offset_hz
    constant += ppm * 1e-6 * chirp.first_sample_hz
    slope = 2e-6 * ppm * chirp.slope_hz_per_s
    phase = 2 * np.pi * (constant * t + slope * t**2 / 2)
    error = constant + slope * t

    # Ripple after the start of the ramp: a decaying oscillation of the IF. Bend before its end: a parabola.
    ramp_s = chirp.adc_start_us * 1e-6 + t
    swing = d.ripple_hz * rng.uniform(0.7, 1.3) * np.exp((-1 / (d.ripple_us * 1e-6) + 2j * np.pi / 8e-6) * ramp_s)
    swing *= np.exp(2j * np.pi * rng.uniform())
    error += swing.real
    phase += 2 * np.pi * (swing / (-1 / (d.ripple_us * 1e-6) + 2j * np.pi / 8e-6)).real
    height = d.bend_hz * rng.uniform(0.8, 1.2) * rng.choice([-1.0, 1.0])
    into = np.maximum(0.0, 1 + (ramp_s - chirp.ramp_end_us * 1e-6) / (d.bend_us * 1e-6))
    error += height * into**2
    phase += 2 * np.pi * height * into**3 / 3 * d.bend_us * 1e-6
    return Receiver(board, chirp, gains.astype(np.complex64), phase - phase[0], error)


def per_chirp(receiver: Receiver, delay_s: Real, phase_rad: Real, hpf: bool) -> tuple[NDArray[np.complex64], Real]:
    """Return the factor of each chirp before the filter, and its IF shift (0 without filter), both [chirp, sample].

    For a receiver that starts `delay_s` after the transmitter, all paths are shorter by that time:
    exp(-j 2 pi (f0 + K t) delay).
    """
    chirp = receiver.chirp
    t = np.arange(chirp.samples) / chirp.sample_rate_hz
    f = chirp.first_sample_hz + chirp.slope_hz_per_s * t
    turns = (receiver.phase + phase_rad[:, None]) / (2 * np.pi) - f * delay_s[:, None]
    turns -= np.rint(turns)
    factor = np.empty(turns.shape, np.complex64)
    angle = (2 * np.pi * turns).astype(np.float32)  # less than a turn: single precision is enough
    factor.real, factor.imag = np.cos(angle), np.sin(angle)
    shift = receiver.if_error_hz - chirp.slope_hz_per_s * delay_s[:, None]
    return factor, shift if hpf else np.zeros_like(shift)
