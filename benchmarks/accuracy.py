"""Accuracy against theory and against the published method: alignment, tones, direct path, image.

Trials of the estimators on simulated signals of known truth, compared with Cramer-Rao bounds; the instrument's image
against a matched filter over all samples in double precision.
"""

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass

import msgspec
import numpy as np
import scipy.signal
from numpy.typing import NDArray

from benchmarks.data import make_synced_row, point_row, published_scene
from benchmarks.measure import Line, add_arguments, keep_on_one_core, show, write
from benchmarks.published import Synchroniser
from polysight.capture.dca1000 import encode_row_words
from polysight.imaging import ImageBuilder, backproject
from polysight.imaging.geometry import Antennas, find_scene_gate_m, row_offsets_m
from polysight.imaging.samples import reduction
from polysight.sync.direct_path import prepare
from polysight.sync.loops import estimate_tone
from polysight.sync.offsets import align_row, reference
from polysight_shared.config import Board, Instrument
from polysight_shared.geometry import rx_positions_m, specular_midpoint_m, tx_position_m
from polysight_shared.raster import plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S

Complex = NDArray[np.complex128]
# Chosen, as IMAGE_SEED below.
SEED = 20260


def _draw_noise(rng: np.random.Generator, shape: tuple[int, ...], snr_db: float) -> Complex:
    """Draw complex white noise of this shape, whose power is `snr_db` below that of a tone of amplitude one."""
    sigma = 10 ** (-snr_db / 20) / np.sqrt(2)
    return sigma * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape))


def _simulate_paths(rig: Instrument, board: Board, cycles_away: float = 0.0) -> tuple[Complex, Complex]:
    """Return direct path and echo of the specular midpoint, each of amplitude one: complex [rx, sample].

    The echo's phase is turned by `cycles_away`, cycles.
    """
    tx = np.array(tx_position_m(rig))
    rx = np.array(rx_positions_m(rig, board))
    point = np.array(specular_midpoint_m(rig, board))
    f = rig.chirp.first_sample_hz + rig.chirp.hz_per_sample * np.arange(rig.chirp.samples)
    direct = np.linalg.norm(rx - tx, axis=1)
    echo = np.linalg.norm(point - tx) + np.linalg.norm(rx - point, axis=1)
    first = np.exp(2j * np.pi * np.outer(direct, f) / SPEED_OF_LIGHT_M_S)
    second = np.exp(2j * np.pi * np.outer(echo, f) / SPEED_OF_LIGHT_M_S)
    return first, second * np.exp(2j * np.pi * cycles_away)


def _quantise_bursts(bursts: NDArray[np.complexfloating]) -> NDArray[np.int16]:
    """Return bursts [position, chirp, rx, sample] as the card's words, int16 [position, chirp, sample, I and Q, rx].

    An amplitude of 1 becomes a thousand counts.
    """
    positions, chirps, rx, samples = bursts.shape
    flat = 1000 * bursts.transpose(2, 0, 1, 3).reshape(rx, positions * chirps, samples)
    return encode_row_words(flat).reshape(positions, chirps, samples, 2, rx)


@dataclass(frozen=True)
class Alignment:
    """Frequency errors of single chirps against the others of their burst, ours and by division, as published."""

    # Of each path over the noise of a channel.
    snr_db: float
    # Rms error without gross ones, and number of gross ones.
    ours_hz: float
    ours_gross: int
    division_hz: float
    division_gross: int
    # Number of chirps that were judged.
    chirps: int


def alignment(rig: Instrument, snr_db: float, positions: int = 120) -> Alignment:
    """Measure the alignment of a burst's chirps: direct path and equal echo, random offsets, noise `snr_db` below each.

    A gross error is one of more than half an FFT bin of the linear samples; both rms errors are without them.
    """
    rng = np.random.default_rng([SEED, round(10 * snr_db)])
    board = rig.receivers[0]
    chirp = rig.chirp
    pulses = rig.burst.pulses
    a, b = chirp.linear_samples
    direct, _ = _simulate_paths(rig, board)
    n = np.arange(chirp.samples)
    bursts = np.empty((positions, pulses, *direct.shape), np.complex64)
    truth = rng.uniform(-0.1, 0.1, (positions, pulses))
    for p in range(positions):
        signal = np.add(*_simulate_paths(rig, board, rng.uniform()))
        turn = np.exp(2j * np.pi * (truth[p][:, None] * n + rng.uniform(size=(pulses, 1))))
        bursts[p] = signal * turn[:, None] + _draw_noise(rng, bursts.shape[1:], snr_db)
    aligned = align_row(_quantise_bursts(bursts), np.ones(truth.shape, bool), chirp.linear_samples)
    method = Synchroniser(rig, board)
    # The method's frequency offsets, cycles a sample [position, chirp].
    divided = np.array([method.offsets(np.swapaxes(burst, 0, 1))[0] for burst in bursts])
    half_bin = 0.5 / (b - a)

    def errors(estimated: NDArray[np.floating]) -> tuple[float, int]:
        """Return rms error in Hz and number of gross errors of frequencies in cycles a sample [position, chirp]."""
        # Only differences within a burst count.
        e = estimated - truth
        e -= np.median(e, axis=1, keepdims=True)
        gross = np.abs(e) > half_bin
        rest = np.where(gross, np.nan, e)
        rest -= np.nanmean(rest, axis=1, keepdims=True)
        return float(np.sqrt(np.nanmean(rest**2)) * chirp.sample_rate_hz), int(gross.sum())

    return Alignment(snr_db, *errors(aligned.frequency), *errors(divided), truth.size)


def measure_one_tone(snr_db: float, trials: int = 4000) -> tuple[float, float]:
    """Return rms error over Cramer-Rao bound of frequency and of phase (at the record's centre), one tone in noise."""
    rng = np.random.default_rng([SEED, 1, round(10 * snr_db)])
    # The linear samples of the published chirp.
    samples = 192
    frequency = rng.uniform(-0.4, 0.4, trials)
    phase = rng.uniform(-np.pi, np.pi, trials)
    t = np.arange(samples) - (samples - 1) / 2
    z = np.exp(1j * (2 * np.pi * frequency[:, None] * t + phase[:, None])) + _draw_noise(rng, (trials, samples), snr_db)
    tone = estimate_tone(z.astype(np.complex64))
    power = 10 ** (-snr_db / 10)
    f_bound = np.sqrt(power / 2 / (t**2).sum()) / (2 * np.pi)
    p_bound = np.sqrt(power / 2 / samples)
    f_error = tone.frequency - frequency
    p_error = np.angle(tone.amplitude * np.exp(-1j * phase))
    return float(np.sqrt((f_error**2).mean()) / f_bound), float(np.sqrt((p_error**2).mean()) / p_bound)


def move_direct_path_to_bin(rig: Instrument, board: Board, bins: float) -> Instrument:
    """Return the rig with its object plane moved so that echo and direct path are `bins` FFT bins apart.

    The echo is that of the specular midpoint at the board's first RX, the FFT one of the linear samples.
    """
    samples = rig.chirp.linear_samples[1] - rig.chirp.linear_samples[0]

    def move_plane(z_mm: float) -> Instrument:
        geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=z_mm)
        return msgspec.structs.replace(rig, geometry=geometry)

    def path_bins(z_mm: float) -> float:
        moved_rig = move_plane(z_mm)
        tx = np.array(tx_position_m(moved_rig))
        rx = np.array(rx_positions_m(moved_rig, board)[0])
        point = np.array(specular_midpoint_m(moved_rig, board))
        excess = np.linalg.norm(point - tx) + np.linalg.norm(rx - point) - np.linalg.norm(rx - tx)
        return float(excess * rig.chirp.hz_per_sample * samples / SPEED_OF_LIGHT_M_S)

    planes = np.linspace(100.0, 1500.0, 1401)
    return move_plane(float(np.interp(bins, [path_bins(z) for z in planes], planes)))


def two_tones(rig: Instrument, board: Board, bins: float, snr_db: float, trials: int = 3000) -> tuple[float, float]:
    """Return the direct path's rms phase error in the presence of an equal echo: in rad, and over its Cramer-Rao bound.

    The bound is of the joint estimate from all RX: the direct path's amplitude, phase and frequency, and the echo's
    complex amplitude and frequency, with the directions of both known, from the geometry. Trials in which the direct
    path was not found are left out.
    """
    rng = np.random.default_rng([SEED, 2, round(10 * snr_db), round(100 * bins)])
    rig = move_direct_path_to_bin(rig, board, bins)
    chirp = rig.chirp
    a, b = chirp.linear_samples
    direct, echo = _simulate_paths(rig, board)
    n = np.arange(chirp.samples) - (a + b - 1) / 2
    frequency = rng.uniform(0.2, 0.6, trials)
    phase, between = rng.uniform(-np.pi, np.pi, (2, trials))
    turn = np.exp(1j * (2 * np.pi * frequency[:, None] * n + phase[:, None]))
    signal = (direct + np.exp(1j * between)[:, None, None] * echo) * turn[:, None]
    received = (signal + _draw_noise(rng, signal.shape, snr_db)).astype(np.complex64)
    aligned = align_row(_quantise_bursts(received[:, None]), np.ones((trials, 1), bool), chirp.linear_samples)
    referenced = reference(aligned, prepare(rig, board), chirp)
    error = np.angle(referenced.amplitude * np.exp(-1j * phase))[referenced.found]
    # Without the direct path's own phase, which is constant.
    error = np.angle(np.exp(1j * (error - np.angle(np.exp(1j * error).mean()))))
    rms = float(np.sqrt((error**2).mean()))
    # Mean over some of the trials' phases between the paths.
    bound = np.sqrt(np.mean([_compute_phase_bound(direct, echo, x, (a, b), snr_db) for x in between[:200]]))
    return rms, rms / float(bound)


def _compute_phase_bound(
    direct: Complex, echo: Complex, between: float, linear: tuple[int, int], snr_db: float
) -> float:
    """Return the Cramer-Rao bound of the direct path's phase, rad^2: from the inverse Fisher information (Kay 1993).

    `direct` and `echo` are complex [rx, sample], `between` the phase between them, `linear` the samples that are used.
    The parameters are the direct path's amplitude, phase and frequency, then real part, imaginary part and frequency of
    the echo.
    """
    inside = slice(*linear)
    d = direct[:, inside]
    e = echo[:, inside] * np.exp(1j * between)
    t = np.arange(d.shape[1]) - (d.shape[1] - 1) / 2
    slopes = np.stack([s.ravel() for s in (d, 1j * d, 1j * t * d, e, 1j * e, 1j * t * e)], axis=1)
    fisher = 2 * 10 ** (snr_db / 10) * (slopes.conj().T @ slopes).real
    return float(np.linalg.inv(fisher)[1, 1])


IMAGE_SEED = 7
# Points of the scene; positions of the grid that are used; pixels that are compared. Chosen: the float64 sum over all
# positions and pixels would take hours.
POINTS = 9
POSITIONS = 2000
PIXELS = 60


def image_error(rig: Instrument, board: Board) -> float:
    """Return the largest difference between the instrument's image and the matched filter, as a share of the peak.

    Compared are the peak and `PIXELS` - 1 drawn pixels. Points lie anywhere in the image, positions anywhere in the
    grid (about 2000, the others masked), and each holds its direct path. The matched filter takes all linear samples
    with the imager's window (Hann), after the direct path is taken out of every position as the range gate does
    (`Reduction.direct`).
    """
    rng = np.random.default_rng(IMAGE_SEED)
    builder = ImageBuilder(rig)
    grid = builder.grid
    plan = plan_raster(rig.grid)
    chirp = rig.chirp
    antennas = Antennas.from_rig(rig, board)
    margin = 0.02
    points = np.column_stack(
        [rng.uniform(a[0] + margin, a[-1] - margin, POINTS) for a in (grid.x_m, grid.y_m)]
        + [np.full(POINTS, float(np.mean(grid.z_m)))]
    )
    sweep = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples, dtype=float)
    used = rng.random((plan.rows, plan.columns)) < POSITIONS / plan.positions
    samples = []
    shifts = []
    for row in plan:
        valid = used[row.index]
        received = np.zeros((len(antennas.rx_m), plan.columns, chirp.samples), np.complex64)
        if valid.any():
            echoes = point_row(rig, antennas, row, points, sweep, valid)
            received[:, valid] = echoes + 1 / antennas.direct_m[:, None, None]
        builder.add_row(board.name, row.index, make_synced_row(rig, received, valid))
        samples.append(received[:, valid])
        shifts.append(np.pad(row_offsets_m(rig, row)[valid], ((0, 0), (0, 1))))
    image, _, _ = builder.boards[board.name].image()
    chosen = rng.choice(image.size, PIXELS, replace=False)
    chosen[0] = np.abs(image).argmax()
    weights = builder.boards[board.name].weights
    # Weights [row, column] go from the smallest x, rows are recorded in their direction.
    taper = np.concatenate([weights[r.index, :: r.direction][used[r.index]] for r in plan])
    true = _match_filter(
        rig=rig,
        board=board,
        samples=np.concatenate(samples, axis=1).astype(complex) / builder.rx_calibration(board.name)[:, None, None],
        shifts_m=np.concatenate(shifts),
        taper=taper.astype(float),
        voxels_m=grid.voxels_m[chosen],
        builder=builder,
    )
    return float(np.abs(image.ravel()[chosen] - true).max() / np.abs(image).max())


def _match_filter(
    rig: Instrument,
    board: Board,
    samples: NDArray[np.complex128],
    shifts_m: NDArray[np.float64],
    taper: NDArray[np.float64],
    voxels_m: NDArray[np.float64],
    builder: ImageBuilder,
) -> NDArray[np.complex128]:
    """Sum over RX, positions and all linear samples, normalised as the imager does, complex128 [voxel].

    `samples` [rx, position, sample], `shifts_m` stage offsets [position, 3], `taper` weights of the positions.
    """
    chirp = rig.chirp
    a, b = chirp.linear_samples
    all_antennas = tuple(Antennas.from_rig(rig, receiver) for receiver in rig.receivers)
    gate = reduction(chirp, find_scene_gate_m(all_antennas, plan_raster(rig.grid), builder.grid))
    antennas = Antennas.from_rig(rig, board)
    window = np.asarray(scipy.signal.get_window("hann", b - a + 2, fftbins=False), float)[1:-1]
    sweep = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(a, b)
    total = np.zeros(len(voxels_m), complex)
    for place, direct, received in zip(antennas.rx_m, antennas.direct_m, samples, strict=True):
        echoes = received[:, a:b] - (received @ gate.direct)[:, None]
        total += backproject(
            echoes * (window / window.sum()) * taper[:, None],
            sweep,
            antennas.tx_m + shifts_m,
            place + shifts_m,
            voxels_m,
            np.full(len(shifts_m), direct),
        )
    return total / (taper.sum() * len(antennas.rx_m))


__all__ = ["add_arguments", "run"]
# Signal-to-noise ratios and the distance of the two tones in FFT bins; chosen. Alignment is measured below what a rig
# has (7.2 dB: the POLySIGHT paper's figures, see benchmarks/static_chirps.py), tones from there on.
ALIGN_SNR_DB = (0.0, 2.5, 5.0)
TONE_SNR_DB = (7.0, 16.0, 22.0, 30.0)
BINS = 2.5
TWO_TONE_SNR_DB = 16.0


def run(args: argparse.Namespace) -> int:
    """Measure all parts on one core and print the table; return 0."""
    rig, _ = published_scene(args.quick)
    # Trials are divided by this number.
    few = 1
    if args.quick:
        few = 20
    with keep_on_one_core():
        aligned = [alignment(rig, snr, positions=240 // few) for snr in ALIGN_SNR_DB]
        tones = {snr: measure_one_tone(snr, trials=30_000 // few) for snr in TONE_SNR_DB}
        pairs = {b.name: two_tones(rig, b, BINS, TWO_TONE_SNR_DB, trials=6000 // few) for b in rig.receivers}
        images = {b.name: image_error(rig, b) for b in rig.receivers}
    lines = [*_alignment_lines(aligned), *_tone_lines(tones, pairs), _image_line(images)]
    show("accuracy, simulated signals of known truth", lines, args.quick)
    write(args.json, "accuracy", lines, alignment=[asdict(a) for a in aligned], measure_one_tone=tones, two_tones=pairs)
    return 0


def _alignment_lines(aligned: Sequence[Alignment]) -> list[Line]:
    """Return the lines of the table about alignment; as in all lines, two limits follow the value: required, aim."""
    ratios = [a.ours_hz / a.division_hz for a in aligned]
    chirps = sum(a.chirps for a in aligned)
    gross = sum(a.ours_gross for a in aligned)
    published_errors = sum(a.division_gross for a in aligned)
    return [
        Line(
            "alignment at 0-5 dB: frequency error over division's",
            " / ".join(f"{a.ours_hz:.0f}" for a in aligned) + " Hz",
            " / ".join(f"{a.division_hz:.0f}" for a in aligned) + " Hz",
            max(ratios),
            1 / 2,
            1 / 3,
            higher_is_better=False,
            note=f"at {ALIGN_SNR_DB} dB a channel, two equal paths; the worst ratio; gross errors of both left out",
        ),
        Line(
            "gross errors of alignment at 0-5 dB",
            f"{gross} of {chirps}",
            f"{published_errors} of {chirps}",
            gross,
            0,
            0,
            higher_is_better=False,
            note="more than half an FFT bin from the truth",
        ),
    ]


def _tone_lines(tones: Mapping[float, tuple[float, float]], pairs: Mapping[str, tuple[float, float]]) -> list[Line]:
    """Return the lines about tones: results of `measure_one_tone` by ratio in dB, and of `two_tones` by board."""
    return [
        Line(
            "one tone, 7-30 dB: rms error over Cramer-Rao",
            " / ".join(f"{max(t):.3f}" for t in tones.values()),
            "",
            max(max(t) for t in tones.values()),
            1.05,
            1.01,
            higher_is_better=False,
            note=f"at {TONE_SNR_DB} dB, the worse of frequency and phase; 30,000 trials know it to 0.4 %",
        ),
        Line(
            f"two tones {BINS} bins apart, {TWO_TONE_SNR_DB:.0f} dB: phase over Cramer-Rao",
            " / ".join(f"{name} {rms:.5f} rad" for name, (rms, _) in pairs.items()),
            "",
            max(ratio for _, ratio in pairs.values()),
            1.2,
            1.05,
            higher_is_better=False,
            note="direct path beside an equal echo, all RX, the worse board; 6,000 trials know it to 0.9 %",
        ),
    ]


def _image_line(images: Mapping[str, float]) -> Line:
    """Return the line about the image error of each board."""
    return Line(
        "image against a float64 matched filter, of the peak",
        " / ".join(f"{name} {e:.1e}" for name, e in images.items()),
        "",
        max(images.values()),
        1e-5,
        1e-6,
        higher_is_better=False,
        note="nine points, 2,000 positions of the full grid, all linear samples, 60 pixels with the peak",
    )
