"""Simulated radars: frames of the three boards for given stage offsets.

The signal of a chirp is the sum of direct path and object, times a factor per chirp, through the high-pass filter H:

    s[n, k] = factor[n, k] (H(f_n,k) F[n, k] + H'(f_n,k) F1[n, k]) gain + noise

for chirp n and sample k. F is the undisturbed signal, f_n,k the middle of its IF band plus that chirp's frequency
offset, and F1 = (dF/dt) / (2 pi j) - middle F. This is the filter's response to first order around the middle of a
signal of about 50 kHz bandwidth; the error is H'' df^2 / 2, below 1e-3 for the published offset of about 1 MHz.

The effects of a receiving board (:class:`Receiver`) are timing, crystal, chirp shape, filter and gains.
:class:`PatternSource` gives frames with a counting pattern, for bit-exact tests.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from polysight_shared.config import Board, Chirp, Instrument
from polysight_shared.raster import FIRST_PULSE_DELAY_S, mean_burst_travel_mm
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene.field import ObjectField, build_field, node_matrix
from polysight_simulators.scene.optics import antennas, direct_factor
from polysight_simulators.scene.scene_file import (
    Disturbances,
    Scene,
    apply_scene,
    draw_normal,
    draw_uniform,
    stream_key,
)

Real = NDArray[np.floating]
Complex = NDArray[np.complexfloating]


def sync_delay_s(d: Disturbances, seed: int, board: Board, pulses: NDArray[np.int64]) -> Real:
    """Return the delay from SYNC_IN edge to chirp start, seconds [pulse].

    It is a fixed latency, the board's own skew, and the wait for the board's clock to sample the edge, drawn by pulse.
    """
    jitter = draw_uniform(stream_key(seed, "sync", board.name), pulses)
    return 1e-9 * (d.sync_latency_ns + getattr(d.sync_skew_ns, board.role) + d.sync_uncertainty_ns * jitter)


def high_pass(if_hz: Real, chirp: Chirp) -> tuple[Complex, Complex]:
    """Return the IF high-pass filter and its derivative per Hz at IF frequencies, any shape.

    Two first-order sections, H = prod 1 / (1 - j f_c / f): -3 dB and +45 degrees at each section's corner.
    """
    # At zero IF, where the filter passes nothing, a division by zero is avoided.
    f = np.where(np.abs(if_hz) < 1e-3, 1e-3, if_hz)
    h = np.ones(np.shape(f), np.complex128)
    log_slope = np.zeros(np.shape(f), np.complex128)
    for corner in (chirp.hpf1_khz * 1e3, chirp.hpf2_khz * 1e3):
        u = corner / f
        # 1 / (1 - j u), without a complex division.
        section = np.empty(np.shape(f), np.complex128)
        section.real = 1.0 / (1.0 + u * u)
        section.imag = u * section.real
        h *= section
        # d log(section) / df = -j u section / f.
        log_slope.real += section.imag * u / f
        log_slope.imag -= section.real * u / f
    return h, h * log_slope


@dataclass(frozen=True)
class Receiver:
    """A receiving board in one power cycle.

    Attributes
    ----------
    board, chirp
        The board and the chirp of the rig file.
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


# Period of the ripple after the start of the ramp; chosen.
_RIPPLE_PERIOD_S = 8e-6


def power_on(rig: Instrument, scene: Scene, board: Board, seed: int) -> Receiver:
    """Return a receiving board after power-up, with gains and chirp shape from the seed and the board's name."""
    d = scene.disturbances
    chirp = rig.chirp
    rng = np.random.default_rng(stream_key(seed, "power", board.name))
    spread_db = rng.uniform(-1, 1, len(rig.antennas.rx_mm)) * d.rx_gain_spread_db
    spread_rad = np.radians(rng.uniform(-1, 1, len(rig.antennas.rx_mm)) * d.rx_phase_spread_deg)
    if board.role == "receive_h":
        board_db = d.hv_gain_db / 2
    else:
        board_db = -d.hv_gain_db / 2
    gains = 10 ** ((spread_db + board_db) / 20) * np.exp(1j * spread_rad)

    t = np.arange(chirp.samples) / chirp.sample_rate_hz
    ppm = getattr(d.crystal_ppm, board.role) - d.crystal_ppm.transmit
    # A relative crystal error p raises the start frequency by p f and the slope K by 2 p K: steps and clock both scale.
    # Under native control the host programs the start frequencies of the rig file, without further offset.
    programmed_hz = 0.0 if rig.radar.control == "native" else d.if_offset_hz
    constant = programmed_hz + board.start_offset_hz - rig.transmitter.start_offset_hz
    constant += ppm * 1e-6 * chirp.first_sample_hz
    slope = 2e-6 * ppm * chirp.slope_hz_per_s
    phase = 2 * np.pi * (constant * t + slope * t**2 / 2)
    error = constant + slope * t

    # The IF has a ripple after the start of the ramp, a decaying oscillation, and a bend before the end of the ramp, a
    # parabola. They differ from board to board by up to 30 % and 20 % (chosen). The phase is the integral of the
    # frequency error.
    ramp_s = chirp.adc_start_us * 1e-6 + t
    decay_per_s = -1 / (d.ripple_us * 1e-6) + 2j * np.pi / _RIPPLE_PERIOD_S
    swing = d.ripple_hz * rng.uniform(0.7, 1.3) * np.exp(decay_per_s * ramp_s)
    swing *= np.exp(2j * np.pi * rng.uniform())
    error += swing.real
    phase += 2 * np.pi * (swing / decay_per_s).real
    height = d.bend_hz * rng.uniform(0.8, 1.2) * rng.choice([-1.0, 1.0])
    # From 0 where the bend begins to 1 at the end of the ramp.
    progress = np.maximum(0.0, 1 + (ramp_s - chirp.ramp_end_us * 1e-6) / (d.bend_us * 1e-6))
    error += height * progress**2
    phase += 2 * np.pi * height * progress**3 / 3 * d.bend_us * 1e-6
    return Receiver(board, chirp, gains.astype(np.complex64), phase - phase[0], error)


def echo_drift(rig: Instrument, d: Disturbances, board: Board, chirps: NDArray[np.int64]) -> NDArray[np.complex64]:
    """Return the factor of a board's echo by chirp [n]: V drifts linearly over the scan, with a factor of 1 halfway.

    `chirps` [n] are their numbers, 0 at the scan's first one.
    """
    if board.role != "receive_v":
        return np.ones(len(chirps), np.complex64)
    share, degrees = d.hv_drift
    chirps_of_scan = rig.grid.columns * rig.grid.rows * rig.burst.chirps_a_position
    passed = chirps / chirps_of_scan - 0.5
    return ((1 + share * passed) * np.exp(1j * np.radians(degrees) * passed)).astype(np.complex64)


def compute_chirp_factors(
    receiver: Receiver, delay_s: Real, phase_rad: Real, hpf: bool
) -> tuple[NDArray[np.complex64], Real]:
    """Return the factor of each chirp before the filter, and its IF shift (0 without filter), both [chirp, sample].

    `phase_rad` [chirp]: phase of each chirp. `hpf`: True if there is a high-pass filter. The shift is in Hz.
    For a receiver that starts `delay_s` after the transmitter, all paths are shorter by that time:
    exp(-j 2 pi (f0 + K t) delay).
    """
    chirp = receiver.chirp
    t = np.arange(chirp.samples) / chirp.sample_rate_hz
    f = chirp.first_sample_hz + chirp.slope_hz_per_s * t
    turns = (receiver.phase + phase_rad[:, None]) / (2 * np.pi) - f * delay_s[:, None]
    turns -= np.rint(turns)
    factor = np.empty(turns.shape, np.complex64)
    # Less than a turn: single precision is enough.
    angle = (2 * np.pi * turns).astype(np.float32)
    factor.real = np.cos(angle)
    factor.imag = np.sin(angle)
    shift = receiver.if_error_hz - chirp.slope_hz_per_s * delay_s[:, None]
    return factor, shift if hpf else np.zeros_like(shift)


# Chirps per batch: their arrays fit in the cache; chosen.
_BATCH = 64
# Largest count of the ADC's 16 bits.
_FULL_SCALE = 32767
# Leakage from TX to RX on the transmit board: its delay (6 cm), and its amplitude relative to the receivers' direct
# path. Both are chosen: a short path is strong, and the filter weakens its low tone.
_LEAKAGE_DELAY_S = 0.2e-9
_LEAKAGE_AMPLITUDE = 2.0


class _ReceivingBoard:
    """Properties of a receiving board that are constant for all chirps.

    Attributes
    ----------
    receiver, field
        Gains and errors of the board, and the object's echo.
    middle_hz
        Middle of the signal's IF band, between the direct path and the field's centre path.
    direct
        complex64 [2, rx, sample]: F and F1 of the direct path, with the channels' gains.
    expand
        complex64 [2, node, sample]: matrices from the field's nodes to the object's F and F1.
    """

    def __init__(self, rig: Instrument, scene: Scene, board: Board, seed: int, cache_dir: Path | None) -> None:
        chirp = rig.chirp
        self.receiver = power_on(rig, scene, board, seed)
        t = np.arange(chirp.samples) / chirp.sample_rate_hz
        f = sample_frequencies_hz(rig)
        self.field: ObjectField = build_field(rig, scene, board, f, cache_dir)
        ant = antennas(rig, board)
        tau = ant.direct_m / SPEED_OF_LIGHT_M_S
        centre = self.field.centre_path_m / SPEED_OF_LIGHT_M_S
        self.middle_hz = float(chirp.slope_hz_per_s * (tau.mean() + centre) / 2)
        # [rx]: free-space loss relative to RX1.
        amplitude = direct_factor(board, scene) * ant.direct_m[0] / ant.direct_m
        amplitude = amplitude * scene.disturbances.direct_gain
        direct = amplitude[:, None] * np.exp(
            2j * np.pi * (f[0] * tau[:, None] + chirp.slope_hz_per_s * np.outer(tau, t))
        )
        gains = self.receiver.gains[:, None]
        shift = chirp.slope_hz_per_s * tau[:, None] - self.middle_hz
        self.direct = (gains * direct * np.stack([np.ones_like(shift), shift])).astype(np.complex64)
        # Values and derivatives by frequency; a derivative by time is the chirp's slope times that.
        values, slopes = node_matrix(self.field, f)
        carrier = np.exp(2j * np.pi * f * centre)
        # F and F1 without the carrier.
        f1 = (chirp.slope_hz_per_s * centre - self.middle_hz) * values
        f1 = f1 + slopes * chirp.slope_hz_per_s / 2j / np.pi
        self.expand = np.stack([values * carrier, f1 * carrier]).astype(np.complex64)


class SimulatedRig:
    """The radars of a rig with a scene, for one power cycle.

    Parameters
    ----------
    rig
        The rig; the scene's overrides are applied here.
    scene
        Plates, points and disturbances.
    seed
        Seed of gains, timing, phases and noise; None: the scene's. The same seed gives the same data for the same chirp
        numbers in any batches.
    cache_dir
        Folder that caches object fields between runs; None: no cache.

    Attributes
    ----------
    clipped
        Number of clipped samples, by board.
    outside
        Number of chirps outside the simulated aperture, by board; they contain only the direct path.
    """

    def __init__(self, rig: Instrument, scene: Scene, seed: int | None = None, cache_dir: Path | None = None) -> None:
        self.rig = apply_scene(rig, scene)
        self.scene = scene
        self.seed = scene.seed if seed is None else seed
        self._cache_dir = cache_dir
        self._boards: dict[str, _ReceivingBoard] = {}
        self._next_chirp = {b.name: 0 for b in rig.boards}
        self.clipped = {b.name: 0 for b in rig.boards}
        self.outside = {b.name: 0 for b in rig.boards}

    def prepare(self, *board_names: str) -> None:
        """Compute the object fields of these boards (default: both receivers) now instead of at the first chirp."""
        for name in board_names or [b.name for b in self.rig.receivers]:
            if self.rig.by_name(name).role != "transmit":
                self._make_receiving_board(name)

    def chirps(
        self,
        board_name: str,
        x_mm: NDArray[np.floating],
        y_mm: NDArray[np.floating],
        first_chirp: int | None = None,
    ) -> NDArray[np.int16]:
        """Return frames of one chirp each, as the board sends them to its card.

        Parameters
        ----------
        board_name
            Name of the board.
        x_mm, y_mm
            True stage offset during each chirp, millimetres from the middle of the grid, [n].
        first_chirp
            Number of the first chirp since power-up (`burst.chirps` for each SYNC_IN pulse before it), which determines
            timing, phase and noise. None: continue after this board's last call.

        Returns
        -------
        int16 [n, samples, 8]: I of RX1..RX4, then Q of RX1..RX4.

        Raises
        ------
        KeyError
            if the rig has no such board.
        """
        d = self.scene.disturbances
        signal = self.signals(board_name, x_mm, y_mm, first_chirp)
        n, rx, samples = signal.shape
        out = np.empty((n, samples, 2 * rx), dtype=np.int16)
        scale = np.float32(_FULL_SCALE / d.adc_full_scale)
        for start in range(0, n, _BATCH):
            batch = signal[start : start + _BATCH]
            parts = batch.view(np.float32).reshape(*batch.shape, 2).transpose(0, 2, 3, 1)
            counts = np.rint(parts * scale)
            extreme = np.abs(counts).max(initial=0.0)
            if extreme > _FULL_SCALE:
                self.clipped[board_name] += int(np.sum(np.abs(counts) > _FULL_SCALE))
                np.clip(counts, -_FULL_SCALE - 1, _FULL_SCALE, out=counts)
            out[start : start + _BATCH] = counts.reshape(len(batch), samples, 2 * rx)
        return out

    def signals(
        self,
        board_name: str,
        x_mm: NDArray[np.floating],
        y_mm: NDArray[np.floating],
        first_chirp: int | None = None,
    ) -> NDArray[np.complex64]:
        """Return :meth:`chirps` before the ADC: complex64 [n, rx, sample], direct path of RX1 about 1, with noise."""
        board = self.rig.by_name(board_name)
        x_mm, y_mm = np.broadcast_arrays(np.asarray(x_mm, np.float64), np.asarray(y_mm, np.float64))
        if first_chirp is None:
            first = self._next_chirp[board_name]
        else:
            first = first_chirp
        self._next_chirp[board_name] = first + len(x_mm)
        out = np.empty((len(x_mm), len(self.rig.antennas.rx_mm), self.rig.chirp.samples), dtype=np.complex64)
        for start in range(0, len(x_mm), _BATCH):
            batch = slice(start, min(start + _BATCH, len(x_mm)))
            chirps = np.arange(first + batch.start, first + batch.stop, dtype=np.int64)
            self._fill_with_noise(board, chirps, out[batch])
            if board.role == "transmit":
                out[batch] += self._simulate_own_leakage()
            else:
                self._add_received(board, x_mm[batch] / 1e3, y_mm[batch] / 1e3, chirps, out[batch])
        return out

    def burst_mm(self, direction: int) -> NDArray[np.floating]:
        """Return the stage travel from a trigger point to each chirp there, millimetres [chirp], signed.

        Without burst motion every chirp is at the mean position of the burst. With backlash, rows towards -x are
        shifted along +x.
        """
        burst = self.rig.burst
        stage = self.rig.stage
        d = self.scene.disturbances
        backlash_mm = d.backlash_mm if direction < 0 else 0.0
        if not d.burst_motion:
            return np.full(burst.chirps_a_position, direction * mean_burst_travel_mm(burst, stage) + backlash_mm)
        time_after_trigger_s = FIRST_PULSE_DELAY_S + np.array(burst.chirp_times_s)
        return direction * stage.speed_mm_s * time_after_trigger_s + backlash_mm

    def _make_receiving_board(self, name: str) -> _ReceivingBoard:
        """Return the simulation of a receiving board, made at its first use."""
        if name not in self._boards:
            board = self.rig.by_name(name)
            self._boards[name] = _ReceivingBoard(self.rig, self.scene, board, self.seed, self._cache_dir)
        return self._boards[name]

    def _add_received(
        self,
        board: Board,
        x_m: NDArray[np.floating],
        y_m: NDArray[np.floating],
        chirps: NDArray[np.int64],
        out: NDArray[np.complex64],
    ) -> None:
        """Add direct path and echoes to `out`, [chirp, rx, sample].

        `x_m`, `y_m` are stage offsets from the middle of the grid, `chirps` their numbers since power-up; [chirp].
        """
        d = self.scene.disturbances
        simulated = self._make_receiving_board(board.name)
        chirp = self.rig.chirp
        # One SYNC_IN pulse starts several chirps, which share its delay.
        pulses = chirps // self.rig.burst.chirps
        delay = sync_delay_s(d, self.seed, board, pulses) - sync_delay_s(d, self.seed, self.rig.transmitter, pulses)
        if d.random_phase:
            turns = draw_uniform(stream_key(self.seed, "phase", board.name), chirps)
        else:
            turns = 0.0 * delay
        factor, shift = compute_chirp_factors(simulated.receiver, delay, 2 * np.pi * turns, d.hpf)
        is_covered = simulated.field.covers(x_m, y_m)
        self.outside[board.name] += int(np.sum(~is_covered))
        # [chirp, rx, node]: the field at the frequencies at which it was computed.
        nodes = np.zeros((len(x_m), *simulated.direct.shape[1:2], simulated.expand.shape[1]), dtype=np.complex64)
        if is_covered.any():
            gains = echo_drift(self.rig, d, board, chirps[is_covered])[:, None] * simulated.receiver.gains
            nodes[is_covered] = simulated.field.interpolate(x_m[is_covered], y_m[is_covered]) * gains[:, :, None]
        # One small product per chirp: BLAS runs larger ones in threads, which is slow while other processes run.
        # [chirp, 2, rx, sample]
        ideal = np.matmul(nodes[:, None], simulated.expand)
        ideal += simulated.direct
        if not d.hpf:
            out += factor[:, None] * ideal[:, 0]
            return
        h, slope = high_pass(simulated.middle_hz + shift, chirp)
        ideal[:, 0] *= (factor * h).astype(np.complex64)[:, None]
        ideal[:, 1] *= (factor * slope).astype(np.complex64)[:, None]
        out += ideal[:, 0]
        out += ideal[:, 1]

    def _fill_with_noise(self, board: Board, chirps: NDArray[np.int64], out: NDArray[np.complex64]) -> None:
        """Fill `out` with receiver noise: each channel has the same signal-to-noise ratio for any gain."""
        snr_db = self.scene.disturbances.direct_snr_db
        if snr_db is None:
            out[...] = 0
            return
        draw_normal(stream_key(self.seed, "noise", board.name), int(chirps[0]), out.view(np.float32))
        sigma = np.sqrt(0.5 * 10 ** (-snr_db / 10))
        if board.role == "transmit":
            out *= np.float32(sigma)
        else:
            gains = self._make_receiving_board(board.name).receiver.gains
            out *= (sigma * np.abs(gains)).astype(np.float32)[:, None]

    def _simulate_own_leakage(self) -> NDArray[np.complex64]:
        """Return the signal of the transmitting board: its own leakage, a tone near zero IF through the filter."""
        chirp = self.rig.chirp
        t = np.arange(chirp.samples) / chirp.sample_rate_hz
        tone_hz = chirp.slope_hz_per_s * _LEAKAGE_DELAY_S
        tone = _LEAKAGE_AMPLITUDE * np.exp(2j * np.pi * (tone_hz * t + chirp.first_sample_hz * _LEAKAGE_DELAY_S))
        if self.scene.disturbances.hpf:
            tone *= high_pass(np.array(tone_hz), chirp)[0]
        return tone.astype(np.complex64)


def sample_frequencies_hz(rig: Instrument) -> NDArray[np.floating]:
    """Return the transmit frequency at each ADC sample, Hz [sample]."""
    return rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * np.arange(rig.chirp.samples)


class SignalSource(Protocol):
    """Source of frames."""

    def chirps(
        self, board_name: str, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64], first_chirp: int | None = None
    ) -> NDArray[np.int16]:
        """Return frames of one chirp each, int16 [n, samples, 8], for stage offsets x_mm [n], y_mm [n].

        `first_chirp` is the number of the first chirp since power-up. The eight values of a sample are I of
        RX1..RX4, then Q of RX1..RX4.
        """
        ...


def pattern_frames(board: int, first: int, n: int, samples: int) -> NDArray[np.int16]:
    """Return frames `first` .. `first + n - 1` of the counting pattern, int16 [n, samples, 8].

    Every 32-bit word is `board << 28 | word count since the first frame`, little-endian, which detects any byte that is
    lost, doubled or misplaced, in 1 GiB per board.
    """
    words = samples * 4
    count = np.arange(n * words, dtype="<u4")
    # May wrap at 32 bits without effect on 28 bits.
    count += np.uint32(first * words % (1 << 28))
    count &= np.uint32((1 << 28) - 1)
    count |= np.uint32(board << 28)
    return count.view("<i2").reshape(n, samples, 8)


class PatternSource:
    """Source of :func:`pattern_frames` at any stage position: frame k comes from SYNC_IN pulse k."""

    def __init__(self, rig: Instrument) -> None:
        self._samples = rig.chirp.samples
        self._board = {b.name: i for i, b in enumerate(rig.boards)}
        self._next = dict.fromkeys(self._board, 0)

    def chirps(
        self, board_name: str, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64], first_chirp: int | None = None
    ) -> NDArray[np.int16]:
        """Return the frames of len(x_mm) chirps from number `first_chirp` on; None: continue after the last call."""
        del y_mm
        if first_chirp is None:
            first = self._next[board_name]
        else:
            first = first_chirp
        self._next[board_name] = first + len(x_mm)
        return pattern_frames(self._board[board_name], first, len(x_mm), self._samples)
