"""Reduced samples of one board, and its image.

`BoardSamples` reduces each row to the range gate, stores it and images the rows with the imager that `choose_imager`
selects. The samples of an ideal mirror on the object plane (`mirror_samples`) give the footprint, by which images are
divided.

Range gate (`reduction`): the 192 samples x_t of a chirp, at the frequencies f_t and relative to the direct path, become
the few samples that describe the scene. A pixel is the matched filter at its excess path d (beyond the direct path):

    S(d) = sum_t w_t x_t exp(-j 2 pi f_t d / c)          window w_t

All d lie in a gate [d_1, d_2] of few range cells. With the swept band B, the functions exp(-j 2 pi f d / c) of d in the
gate span about B (d_2 - d_1) / c + 1 dimensions (Landau and Pollak 1962): each is a combination of those at a few
evenly spaced f_m, with M from least squares over the gate.

    w_t exp(-j 2 pi f_t d / c) = sum_m M_mt exp(-j 2 pi f_m d / c),  so  S(d) = sum_m (M x)_m exp(-j 2 pi f_m d / c)

M x is computed once per position; the imagers use only M x at f_m. Six samples more than the time-bandwidth product
make the error 1e-6 of the peak (derivation: docs/decisions/0002-imaging.md).

Rows of raw chirps are decimated first, to one sample for every four (`sync.decimate`). `Reduction.maps` gives the maps
for these: those that agree best with the maps for all samples.

The direct path is a constant in x, close to the gate. Windowing alone does not remove it, so its amplitude is estimated
(generalised least squares with the gate as coloured noise) and subtracted.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from polysight.imaging import geometry
from polysight.imaging.direct import DirectImager
from polysight.imaging.spectral import SLACK_M, IncrementalImager, SpectralImager
from polysight.sync import FOLD, SyncedRow, decimation, sample_frequencies_hz
from polysight_shared.config import Board, Chirp, Instrument
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.raster import plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# `Reduction.maps` is fitted to echoes at excess paths from -_MARGIN_M to _MARGIN_M behind the gate, and at least to
# _PASSED_M behind the middle of the paths that decimation passes (it passes 1 m). _ECHO is the echoes' amplitude
# relative to the noise (chosen).
_MARGIN_M = 0.1
_PASSED_M = 1.0
_ECHO = 30.0
# Noise power of a sample relative to echoes from the gate, for the estimate of the direct path (chosen).
_NOISE_POWER = 1e-3

Image = NDArray[np.complex64]
_log = logging.getLogger(__name__)
# Largest number of multiplications in one matrix product: above it OpenBLAS first copies both matrices, which takes a
# fifth longer.
_MAX_PRODUCT = 1_000_000
# The columns of such a product fill groups of this size: 22 columns take an eighth longer than 24 (OpenBLAS, AVX2).
_COLUMN_GROUP = 8


@dataclass(frozen=True)
class Reduction:
    """Linear maps of a scan's range gate.

    Attributes
    ----------
    frequencies_hz
        float64 [m].
    matrix
        complex128 [m, sample]: removal of the direct path, then M of the module. Samples outside the linear part have
        the weight 0.
    direct
        complex128 [sample]: `direct @ x` is the amplitude of the direct path.
    model
        complex128 [m, m]: an echo of path d and amplitude 1 becomes `model @ exp(+j 2 pi frequencies_hz d / c)`.
    gate_m
        Smallest and largest excess path in the gate.
    sweep_hz
        float64 [sample]: frequency of every sample of the chirp.
    """

    frequencies_hz: NDArray[np.float64]
    matrix: NDArray[np.complex128]
    direct: NDArray[np.complex128]
    model: NDArray[np.complex128]
    gate_m: tuple[float, float]
    sweep_hz: NDArray[np.float64]

    def maps(self, sweep_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
        """Return matrix and direct for samples at `sweep_hz`, complex128 [m + 1, sample]: all, or one for every four.

        Maps for decimated samples are fitted by least squares to noise and echoes. Differences of their results from
        those for all samples (published chirp): 3e-4 for echoes that decimation passes (up to 1 m behind the direct
        path), 2e-4 for echoes within the gate. For white noise 0.2 to 0.4 %; 2 % at the first and last frequency, which
        the window makes weak (0.06 % in the matched filter); 5 % in the amplitude of the direct path.
        """
        maps = np.vstack([self.matrix, self.direct])
        if sweep_hz.shape == self.sweep_hz.shape:
            return maps
        step_hz = self.sweep_hz[1] - self.sweep_hz[0]
        # The chirp's samples that were decimated: each result is in the middle of `FOLD` samples.
        first = round((sweep_hz[0] - self.sweep_hz[0]) / step_hz - (FOLD - 1) / 2)
        linear = slice(first, first + FOLD * sweep_hz.size)
        # Decimation passes paths about `middle_m`, half way between the direct path (0) and the middle of the gate.
        middle_m = sum(self.gate_m) / 4
        decimated = decimation(FOLD * sweep_hz.size, middle_m * step_hz / SPEED_OF_LIGHT_M_S)
        paths = np.linspace(-_MARGIN_M, max(self.gate_m[1] + _MARGIN_M, middle_m + _PASSED_M), 4 * sweep_hz.size)
        echoes = np.exp(2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(self.sweep_hz[linear], paths))
        signals = np.concatenate([np.eye(len(echoes)), _ECHO / np.sqrt(paths.size) * echoes], axis=1)
        solution = np.linalg.lstsq((decimated @ signals).T, (maps[:, linear] @ signals).T, rcond=None)[0]
        return solution.T.astype(np.complex128)


@lru_cache(maxsize=8)
def reduction(chirp: Chirp, gate_m: tuple[float, float], window: geometry.Window = "hann", extra: int = 6) -> Reduction:
    """Return the linear maps of a range gate.

    Parameters
    ----------
    chirp
        Chirp of the samples.
    gate_m
        Smallest and largest excess path, metres.
    window
        Fast-time window over the linear samples, as for scipy; "boxcar" for none.
    extra
        Frequency samples beyond the time-bandwidth product.
    """
    a, b = chirp.linear_samples
    sweep = sample_frequencies_hz(chirp)[a:b]
    weight = geometry.make_window(window, b - a)
    weight = weight / weight.sum()
    band = sweep[-1] - sweep[0]
    product = (gate_m[1] - gate_m[0]) * band / SPEED_OF_LIGHT_M_S
    frequencies = np.linspace(sweep[0], sweep[-1], int(np.ceil(product)) + extra)
    # Paths so close (chosen) that the fits hold between them. `rcond` drops combinations that differ only by rounding.
    delay_s = np.linspace(*gate_m, max(64, 8 * frequencies.size)) / SPEED_OF_LIGHT_M_S
    target = np.exp(-2j * np.pi * np.outer(delay_s, sweep)) * weight
    basis = np.exp(-2j * np.pi * np.outer(delay_s, frequencies))
    m = np.linalg.lstsq(basis, target, rcond=1e-6)[0]

    echoes = np.exp(2j * np.pi * np.outer(sweep, delay_s)) / np.sqrt(delay_s.size)
    covariance = echoes @ echoes.conj().T + _NOISE_POWER * np.eye(b - a)
    direct = np.linalg.solve(covariance, np.ones(b - a)).conj()
    direct /= direct.sum()

    # The direct path is a constant in x. Its estimate `direct @ x` is subtracted from each sample before the map `m`.
    matrix = np.zeros((frequencies.size, chirp.samples), complex)
    matrix[:, a:b] = m - np.outer(m.sum(axis=1), direct)
    direct_of_all = np.zeros(chirp.samples, complex)
    direct_of_all[a:b] = direct
    # Echoes at the samples' frequencies are combinations of echoes at the few frequencies.
    wave = np.exp(2j * np.pi * np.outer(delay_s, frequencies))
    samples_from_few = np.linalg.lstsq(wave, np.exp(2j * np.pi * np.outer(delay_s, sweep)), rcond=1e-9)[0].T
    model = (matrix[:, a:b] @ samples_from_few).astype(np.complex128)
    return Reduction(frequencies, matrix, direct_of_all, model, gate_m, sample_frequencies_hz(chirp))


class Imager(Protocol):
    """Matched filter of an aperture at its pixels, and its adjoint; sums, not means.

    With the forward model A, `samples(x)` is A x and `image(y)` is A^H y.
    """

    @property
    def aperture(self) -> geometry.Aperture:
        """Positions, antennas, frequencies and pixels."""
        ...

    def image(self, samples: Any) -> Any:
        """Image weighted samples, complex64 [rx, frequency, row, column], 0 where masked: complex [ny, nx]."""
        ...

    def image_constant_echo(self, echo: Any, weights: Any) -> Any:
        """Image an echo, complex [rx, frequency], at every position, times weights [row, column]."""
        ...

    def samples(self, image: Any) -> Any:
        """Return the echoes of pixels, complex [ny, nx]: complex [rx, frequency, row, column]."""
        ...


def choose_imager(aperture: geometry.Aperture) -> tuple[Imager, str | None]:
    """Choose the imager: spectral if the aperture is regular, else the slower direct sum with a notice (else None)."""
    reason = geometry.find_irregularity(aperture)
    if reason is None:
        return SpectralImager(aperture), None
    rx, _, rows, columns = aperture.shape
    # The notice assumes ten million terms a second.
    sums = rx * rows * columns * aperture.grid.x_m.size * aperture.grid.y_m.size
    notice = f"imaging by direct sum, {sums:.1e} terms, about {sums / 1e7:.0f} s per board: {reason}"
    return DirectImager(aperture), notice


def mirror_samples(antennas: geometry.Antennas, z_m: float, chirp: Chirp) -> NDArray[np.complex128]:
    """Return a mirror's samples [rx, sample]: phase relative to the direct path, amplitude 1 / path in metres."""
    path = antennas.mirror_m(z_m)
    phase = 2j * np.pi * np.outer(path - antennas.direct_m, sample_frequencies_hz(chirp)) / SPEED_OF_LIGHT_M_S
    return (np.exp(phase) / path[:, None]).astype(np.complex128)


def mirror_reduced(
    antennas: geometry.Antennas, z_m: float, chirp: Chirp, reduction: Reduction
) -> NDArray[np.complex128]:
    """Return the samples of a mirror after the range gate, [rx, frequency]."""
    return mirror_samples(antennas, z_m, chirp) @ reduction.matrix.T


class ReducedRow(NamedTuple):
    """A row of a board after the range gate, columns from the smallest x.

    samples complex64 [rx, frequency, column], direct path complex64 [rx, column], valid bool [column].
    """

    samples: NDArray[np.complex64]
    direct: NDArray[np.complex64]
    valid: NDArray[np.bool_]


class BoardSamples:
    """Samples of one board, [rx, frequency, row, column], columns from the smallest x; missing ones are 0 and masked.

    Parameters
    ----------
    rig, board
        Rig of the scan, and one of its receiving boards.
    grid
        Pixels.
    reduction
        Range gate.
    taper
        float32 [row, column]: weight of every position.
    live
        Keep running sums over rows for :meth:`current`.
    """

    def __init__(
        self,
        rig: Instrument,
        board: Board,
        grid: geometry.ImageGrid,
        reduction: Reduction,
        taper: NDArray[np.float32],
        live: bool = False,
    ) -> None:
        self.board = board
        self.taper = taper
        self._plan = plan_raster(rig.grid)
        self._grid = grid
        self._reduction = reduction
        # Maps for pairs of real numbers and the samples they use, by the row's number of samples.
        self._maps: dict[int, tuple[slice, NDArray[np.float32]]] = {}
        self._filters = geometry.design_burst_filters(rig)
        self._antennas = geometry.Antennas.from_rig(rig, board)
        self._chirp = rig.chirp
        # Samples of an ideal mirror on the rig file's plane after the range gate, [rx, frequency].
        self.mirror = mirror_reduced(self._antennas, float(np.mean(grid.z_m)), rig.chirp, reduction)
        # Stage offsets [row, column, 3], and the x of each row's first position as planned [row], metres.
        self._offsets = geometry.scan_offsets_m(rig)
        self._planned = geometry.fit_row_starts_m(self._offsets)
        rx = len(self._antennas.rx_m)
        shape = taper.shape
        # Reduced samples [rx, frequency, row, column] and the direct path [rx, row, column], as received.
        self._cube = np.zeros((rx, reduction.frequencies_hz.size, *shape), np.complex64)
        self._direct = np.zeros((rx, *shape), np.complex64)
        # True for rows in which an RX has a signal, [rx, row]; otherwise its samples are zero in the whole row.
        self.has_rx = np.zeros((rx, shape[0]), bool)
        # Phase by which the samples of each row are turned in images, complex [row]; 1: as recorded.
        self._turns = np.ones(shape[0], np.complex64)
        # True for positions with data, [row, column].
        self.valid = np.zeros(shape, bool)
        # Imager of all rows; None if the aperture is irregular, or before it is needed.
        self._final: SpectralImager | None = None
        # Spectra of the rows along x, for the final image of a live scan
        self._spectra = np.zeros(0, np.complex64)
        # Rows whose spectra are out of date
        self._stale = set(range(shape[0]))
        # Image of the rows so far, once it was formed
        self._image: tuple[Image, Image, str | None] | None = None
        # Result of `range_slope` for the rows so far, once it was formed.
        self._slope: tuple[Image, Image] | None = None
        # True if a row was recorded at other places than planned, so that the live image cannot use its spectra.
        self._moved = False
        self._live = None
        if live and geometry.find_irregularity(self.aperture) is None:
            self._live = IncrementalImager(self.aperture, self.mirror)
            # Compute kernels now instead of after the last row
            self._prepare()

    @property
    def aperture(self) -> geometry.Aperture:
        """Geometry of antennas, positions and pixels."""
        return geometry.Aperture(self._antennas, self._offsets, self._reduction.frequencies_hz, self._grid)

    @property
    def model(self) -> NDArray[np.complex128]:
        """Effect of the range gate on an echo, [frequency, frequency], see :attr:`Reduction.model`."""
        return self._reduction.model

    @property
    def weights(self) -> NDArray[np.float32]:
        """Taper of each position, 0 where not usable, float32 [row, column]."""
        return self.taper * self.usable

    @property
    def used_rx(self) -> NDArray[np.bool_]:
        """RX that the image uses, bool [rx]: those with a signal in the largest number of rows.

        The rows of another RX would give a part of the aperture more weight, and plates a halo.
        """
        rows = self.has_rx.sum(axis=1)
        return np.asarray(rows == rows.max())

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Positions in the image, bool [row, column]: valid ones, but not in rows in which a used RX is dead."""
        dead = self.has_rx.any(axis=0) & np.any(~self.has_rx[self.used_rx], axis=0)
        return self.valid & ~dead[:, None]

    def _rx_factors(self) -> NDArray[np.complex64]:
        """Return the turn of each row over the gain of each RX, [rx, row]; 0 if the RX is not used, or the row is not.

        Samples are relative to the mean direct path of the RX with a signal. If an RX fails during the scan, this mean
        changes, and with it the gains of the others.
        """
        rows_used = self.usable.any(axis=1)
        direct = (self._direct * self.valid).sum(axis=2, dtype=np.complex128)
        factors = np.zeros(direct.shape, np.complex64)
        for has_rx in np.unique(self.has_rx[:, rows_used], axis=1).T:
            rows = rows_used & (self.has_rx == has_rx[:, None]).all(axis=0)
            gains = direct[:, rows].sum(axis=1) / self.valid[rows].sum() * self._antennas.direct_m
            # Without a direct path there is no gain to remove.
            gains[gains == 0] = 1
            factors[:, rows] = (self.used_rx / gains)[:, None]
        return factors * self._turns

    def _compute_row_weights(self, index: int) -> NDArray[np.float32]:
        """Return one row of the taper, 0 where not valid, [column]."""
        return self.taper[index] * self.valid[index]

    @property
    def count(self) -> np.float32:
        """Divisor of a sum over positions and RX."""
        return np.float32((self.weights.sum() or 1.0) * self.used_rx.sum())

    def add_row(self, index: int, row: SyncedRow, offsets_m: NDArray[np.float64] | None = None) -> None:
        """Add a row; a row added again replaces the earlier one.

        Parameters
        ----------
        index
            Index of the row in the plan.
        row
            Positions in order of recording.
        offsets_m
            float64 [position, 2 or 3], same order: measured mean stage offsets; None: as planned.

        Raises
        ------
        DataError
            if the row is not in the plan, or has another number of positions.
        """
        if not 0 <= index < self._plan.rows:
            raise _wrong_row_error(f"row {index} of board {self.board.name!r} is not in this scan")
        if row.valid.shape != (self._plan.columns,):
            raise _wrong_row_error(
                f"row {index} of board {self.board.name} has {row.valid.size} positions, the plan {self._plan.columns}"
            )
        forward = slice(None, None, self._plan.row(index).direction)
        reduced = self._apply_gate(row.samples, row.sweep_hz)
        if row.turn is not None:
            reduced = geometry.undo_burst_motion(reduced, row.valid, row.turn, self._filters)
        reduced = reduced[..., forward]
        valid = row.valid[forward]
        self._put(index, ReducedRow(reduced[:, :-1], reduced[:, -1], valid), offsets_m, forward)

    def put(self, index: int, row: ReducedRow) -> None:
        """Add a row from :meth:`read_reduced`, reduced by the same range gate."""
        self._put(index, row)

    def read_reduced(self, index: int) -> ReducedRow:
        """Return a row after the range gate."""
        return ReducedRow(self._cube[:, :, index], self._direct[:, index], self.valid[index])

    def _put(
        self,
        index: int,
        row: ReducedRow,
        offsets_m: NDArray[np.float64] | None = None,
        forward: slice = slice(None),
    ) -> None:
        """Replace a row in the samples and the live image; `forward` brings `offsets_m` into the order of columns."""
        self._add_to_live_image(index, -1)
        self._cube[:, :, index] = row.samples
        self._direct[:, index] = row.direct
        if not row.valid.all():
            self._cube[:, :, index, ~row.valid] = 0
            self._direct[:, index, ~row.valid] = 0
        self.valid[index] = row.valid
        if offsets_m is not None:
            self._offsets[index, :, : offsets_m.shape[1]] = offsets_m[forward]
            self._final = None
            self._moved = True
            deviation = abs(geometry.fit_row_starts_m(self._offsets)[index] - self._planned[index])
            if deviation > SLACK_M or geometry.find_irregularity(self.aperture) is not None:
                self._live = None
        self.has_rx[:, index] = self._cube[:, :, index].any(axis=(1, 2))
        if not self.has_rx[:, index].all() and row.valid.any():
            # Running sums hold the constant echo of all RX.
            self._live = None
        self._stale.add(index)
        self._image = None
        self._slope = None
        self._add_to_live_image(index, 1)

    def _apply_gate(self, samples: NDArray[np.complex64], sweep_hz: NDArray[np.float64]) -> NDArray[np.complex64]:
        """Apply the range gate to a row; return samples and the direct path, [rx, frequency + 1, position]."""
        # Reversed positions are put into the order of memory: their product would be slow.
        if samples.strides[1] < 0:
            return self._apply_gate(samples[:, ::-1], sweep_hz)[..., ::-1]
        if sweep_hz.size not in self._maps:
            self._maps[sweep_hz.size] = _pair_maps(self._reduction.maps(sweep_hz))
        used_samples, maps = self._maps[sweep_hz.size]
        pairs = np.asarray(samples, np.complex64).view(np.float32)[..., used_samples]
        gated = np.empty((*pairs.shape[:2], maps.shape[1]), np.float32)
        step = max(1, _MAX_PRODUCT // maps.size)
        for first in range(0, pairs.shape[1], step):
            np.matmul(pairs[:, first : first + step], maps, out=gated[:, first : first + step])
        count = self._reduction.frequencies_hz.size + 1
        return gated.view(np.complex64)[..., :count].mT

    def _prepare(self) -> None:
        """Create the spectral imager of all rows if the aperture is regular; keep it while positions do not change."""
        if self._final is None and geometry.find_irregularity(self.aperture) is None:
            # The slack equals that of the live imager, so that both share their spectra.
            self._final = SpectralImager(self.aperture, slack_m=SLACK_M)
            if self._live is not None:
                self._spectra = np.zeros((*self._cube.shape[:3], self._final.lattice.band.size), np.complex64)
                self._stale = set(range(len(self.valid)))

    def _compute_row_spectra(self, imager: SpectralImager, index: int) -> NDArray[np.complex64]:
        """Return the spectra of a row, [rx, frequency, k]; row by row, so that results are bit-exact in any order."""
        if index in self._stale:
            row = self._cube[:, :, index] * self._compute_row_weights(index)
            self._spectra[:, :, index] = imager.spectra_of_row(row, index)
            self._stale.remove(index)
        return self._spectra[:, :, index]

    def keep(self, positions: NDArray[np.bool_]) -> None:
        """Mask all positions except those in `positions` [row, column], as if they had not been scanned."""
        self.valid &= positions
        self._invalidate()

    def copy_samples(self, coarse: BoardSamples, steps: tuple[int, int]) -> None:
        """Copy the samples of a coarser scan, one for every `steps` (rows, columns) of this; others are missing."""
        rows, columns = steps
        self._cube[:, :, ::rows, ::columns] = coarse._cube
        self._direct[:, ::rows, ::columns] = coarse._direct
        self.valid[::rows, ::columns] = coarse.usable
        self.has_rx[:, ::rows] = coarse.has_rx
        # Positions between recorded ones are evenly spaced; a row between two has the shift of the one before.
        count_y = len(self.valid)
        count_x = len(self.valid[0])
        column_index = np.arange(count_x) / columns
        for index in range(count_y):
            coarse_offset = coarse._offsets[index // rows]
            for axis in range(3):
                self._offsets[index, :, axis] = np.interp(
                    column_index, np.arange(len(coarse_offset)), coarse_offset[:, axis]
                )
        y_m = coarse._offsets[:, 0, 1]
        self._offsets[..., 1] = np.interp(np.arange(count_y) / rows, np.arange(len(y_m)), y_m)[:, None]
        self._final = None
        self._invalidate()

    def turn_rows(self, angles_rad: NDArray[np.float64]) -> None:
        """Turn the phase of each row's samples, [row], in images formed later; replaces the turns of earlier calls."""
        turns = np.exp(1j * angles_rad).astype(np.complex64)
        if not np.array_equal(turns, self._turns):
            self._turns = turns
            self._invalidate()

    def fill(self, samples: NDArray[np.complex64]) -> None:
        """Fill all positions that are not usable with calibrated samples (as of :meth:`calibrate_samples`)."""
        gains = np.where(self.used_rx, self.rx_calibration(), 0).astype(np.complex64)
        filled = np.where(self.usable, self.calibrate_samples(), samples)
        self._cube = filled * gains[:, None, None, None]
        self._direct[:] = (gains / self._antennas.direct_m)[:, None, None]
        self.has_rx[:] = self.used_rx[:, None]
        # `calibrate_samples` has turned the rows.
        self._turns[:] = 1
        self.valid[:] = True
        self._invalidate()

    def _invalidate(self) -> None:
        """Discard everything that was computed from the samples."""
        self._live = None
        self._image = None
        self._slope = None
        self._stale = set(range(len(self.valid)))

    def _add_to_live_image(self, index: int, sign: int) -> None:
        """Add a row to the live image, or subtract it (`sign` -1)."""
        if self._live is None or not self._compute_row_weights(index).any():
            return
        weights = sign * self._compute_row_weights(index)
        if self._final is not None and not self._moved:
            spectra_of_weights = self._final.spectra_of_row(weights.astype(np.complex64), index)
            self._live.add_spectra(index, sign * self._compute_row_spectra(self._final, index), spectra_of_weights)
        else:
            start = float(geometry.fit_row_starts_m(self._offsets)[index])
            self._live.add_row(index, self._cube[:, :, index] * weights, weights, start)

    def rx_calibration(self) -> NDArray[np.complex128]:
        """Return the complex gain of each RX, [rx]: the mean direct path of usable positions times its length.

        It is 1 without a direct path, and NaN for an RX that is not used.
        """
        total = (self._direct * self.usable).sum(axis=(1, 2), dtype=np.complex128)
        gain = total / max(1, int(self.usable.sum())) * self._antennas.direct_m
        return np.where(self.used_rx, np.where(gain == 0, 1, gain), np.nan)

    def calibrate_samples(self) -> NDArray[np.complex64]:
        """Return the samples divided by the gain of each RX, not weighted, [rx, frequency, row, column]."""
        return self._cube * self._rx_factors()[:, None, :, None]

    def image_current_sums(self) -> tuple[Image, Image, str | None]:
        """Return :meth:`image` from running sums if there are any: fast, and equal within 1e-6 of the peak."""
        if self._live is None:
            return self.image()
        image = self._live.image_of_sum(1 / self.rx_calibration())
        return image / self.count, self._live.image_summed_constant_echo() / self.count, None

    def image(self, grid: geometry.ImageGrid | None = None) -> tuple[Image, Image, str | None]:
        """Return image and footprint of the rows so far, complex64 [ny, nx], and a notice if imaging is slow.

        The result is bit-exact for the same rows in any order.

        Parameters
        ----------
        grid
            Other pixels than the rig file's, within the range gate.
        """
        if grid is not None:
            return self._form_images(grid)
        if self._image is None:
            self._image = self._form_images(None)
        return self._image

    def _form_images(self, grid: geometry.ImageGrid | None) -> tuple[Image, Image, str | None]:
        """Form :meth:`image`; of a live scan from the spectra of its rows, which are kept."""
        factors = self._rx_factors()
        if grid is None:
            self._prepare()
        imager, notice = self._choose_imager(grid)
        image: Any
        if not isinstance(imager, SpectralImager):
            image = imager.image(self._cube * (factors[:, None, :, None] * self.weights))
        elif imager is self._final and self._live is not None:
            for index in range(len(self.valid)):
                self._compute_row_spectra(imager, index)
            image = imager.image_of_spectra(self._spectra, (1 / self.rx_calibration()).astype(np.complex64))
        else:
            image = np.zeros(imager.aperture.grid.shape, np.complex64)
            # All rows together, unless an RX dies within the scan.
            for column in np.unique(factors[:, factors.any(axis=0)], axis=1).T:
                rows = (factors == column[:, None]).all(axis=0)
                image += imager.form_weighted_image(self._cube, self.weights * rows[:, None], column)
        return (image / self.count).astype(np.complex64), self._image_constant(imager, self._mirror(grid)), notice

    def range_profile(self, point_m: NDArray[np.float64], shifts_m: NDArray[np.float64]) -> NDArray[np.complex64]:
        """Return the matched filter for paths longer by `shifts_m` than that of a point, complex64 [shift].

        All positions are focused on `point_m` [3], rig frame. An echo from there has its peak at the shift 0, echoes
        from behind it at positive shifts.
        """
        relative_m = point_m - self._offsets.reshape(-1, 3)
        weights = (self.weights / self.count).ravel()
        excess = self._antennas.excess_m(relative_m[:, 0], relative_m[:, 1], relative_m[:, 2])
        f = self._reduction.frequencies_hz
        cube = self.calibrate_samples().reshape(*self._cube.shape[:2], -1) * weights
        phasor = np.exp(-2j * np.pi / SPEED_OF_LIGHT_M_S * f[None, :, None] * excess[:, None, :])
        focused = (cube * phasor).sum(axis=(0, -1))
        return (np.exp(-2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(shifts_m, f)) @ focused).astype(np.complex64)

    def range_slope(self, grid: geometry.ImageGrid | None = None) -> tuple[Image, Image]:
        """Return the derivative of image and footprint by range (excess path), without carrier; 1 / m.

        The matched filter of path d is S(d) = sum_m y_m exp(-j 2 pi f_m d / c), so its derivative is the image of the
        samples times -j 2 pi (f_m - f) / c, with f the middle of the sweep. `grid` as of :meth:`image`.
        """
        if grid is not None:
            return self._form_slope_images(grid)
        if self._slope is None:
            self._slope = self._form_slope_images(None)
        return self._slope

    def _form_slope_images(self, grid: geometry.ImageGrid | None) -> tuple[Image, Image]:
        """Form :meth:`range_slope`."""
        imager, _ = self._choose_imager(grid)
        factors = self._compute_range_slope_factors()
        gains = self._rx_factors()[:, None, :, None]
        image: Any = imager.image(self._cube * (gains * factors[:, None, None] * self.weights))
        return (image / self.count).astype(np.complex64), self._make_constant_image(self._mirror(grid) * factors, grid)

    def dispersion(self, grid: geometry.ImageGrid | None = None) -> Image:
        """Return the change of ln(image / footprint) from the first to the last frequency, complex64 [ny, nx].

        NaN where no echo is seen. For an echo that grows as 1 + s (f - f0) the slope of :meth:`range_slope` exceeds the
        mirror's by -j 2 pi s var(f) / c. The variance var(f) of the window follows from the mirror's second derivative.

        Parameters
        ----------
        grid
            As of :meth:`image`.
        """
        image, footprint, _ = self.image(grid)
        slope, mirror_slope = self.range_slope(grid)
        mirror_bend = self._make_constant_image(self._mirror(grid) * self._compute_range_slope_factors() ** 2, grid)
        f = self._reduction.frequencies_hz
        sweep_per_m = -2j * np.pi * (f[-1] - f[0]) / SPEED_OF_LIGHT_M_S
        with np.errstate(divide="ignore", invalid="ignore"):
            mirror_change = mirror_slope / footprint
            # var(f) times (-j 2 pi / c)^2.
            variance = mirror_bend / footprint - mirror_change**2
            change = (slope / image - mirror_change) / variance * sweep_per_m
        return np.where(np.isfinite(change), change, complex(np.nan, np.nan)).astype(np.complex64)

    def mirror_image(self, behind_m: float) -> Image:
        """Return the footprint of a mirror `behind_m` behind the rig file's plane, complex64 [ny, nx]."""
        return self._make_constant_image(self._reduce_mirror(float(np.mean(self._grid.z_m)) + behind_m))

    def mirror_slope(self, behind_m: float) -> Image:
        """Return the derivative of :meth:`mirror_image` by range, see :meth:`range_slope`."""
        echo = self._reduce_mirror(float(np.mean(self._grid.z_m)) + behind_m)
        return self._make_constant_image(echo * self._compute_range_slope_factors())

    def _make_constant_image(self, echo: NDArray[np.complexfloating], grid: geometry.ImageGrid | None = None) -> Image:
        """Return the image of an echo [rx, frequency] that every valid position has, as a mean."""
        return self._image_constant(self._choose_imager(grid)[0], echo)

    def _image_constant(self, imager: Imager, echo: NDArray[np.complexfloating]) -> Image:
        """Return the image of an echo [rx, frequency] at every usable position, as a mean over these and the RX."""
        image: Any = imager.image_constant_echo((echo * self.used_rx[:, None]).astype(np.complex64), self.weights)
        return (image / self.count).astype(np.complex64)

    def _compute_range_slope_factors(self) -> NDArray[np.complex64]:
        """Return the factors of the samples in :meth:`range_slope`, [frequency], 1 / m."""
        f = self._reduction.frequencies_hz
        return (-2j * np.pi * (f - f.mean()) / SPEED_OF_LIGHT_M_S).astype(np.complex64)

    def _mirror(self, grid: geometry.ImageGrid | None) -> NDArray[np.complex128]:
        """Return the samples of a mirror on the plane of the pixels after the range gate, [rx, frequency]."""
        return self.mirror if grid is None else self._reduce_mirror(float(np.mean(grid.z_m)))

    def _reduce_mirror(self, z_m: float) -> NDArray[np.complex128]:
        """Return the samples of a mirror on the plane at `z_m` after the range gate, [rx, frequency]."""
        return mirror_reduced(self._antennas, z_m, self._chirp, self._reduction)

    def _choose_imager(self, grid: geometry.ImageGrid | None) -> tuple[Imager, str | None]:
        """Return the imager of the rig file's grid or of another one, and a notice if it is slow."""
        if grid is None and self._final is not None:
            return self._final, None
        imager, notice = choose_imager(replace(self.aperture, grid=grid or self._grid))
        if notice:
            _log.warning("%s: %s", self.board.name, notice)
        return imager, notice


def _pair_maps(maps: NDArray[np.complex128]) -> tuple[slice, NDArray[np.float32]]:
    """Return complex maps [map, sample] as real ones for pairs (re, im), float32 [2 sample, 2 map], and their slice.

    With x as pairs, `pairs[..., slice] @ real_maps` are the pairs of `maps @ x`: a real product is 1.5 times as fast as
    such a narrow complex one. The slice leaves out samples at the ends with weight 0. Columns of zeros fill the last
    group of `_COLUMN_GROUP`.
    """
    used_range = np.flatnonzero(maps.any(axis=0))[[0, -1]]
    maps = np.pad(maps[:, used_range[0] : used_range[1] + 1], ((0, -len(maps) % (_COLUMN_GROUP // 2)), (0, 0)))
    paired = np.empty((maps.shape[1], 2, maps.shape[0], 2), np.float32)
    # Real part of the result, then its imaginary part.
    paired[:, 0, :, 0] = maps.real.T
    paired[:, 1, :, 0] = -maps.imag.T
    paired[:, 0, :, 1] = maps.imag.T
    paired[:, 1, :, 1] = maps.real.T
    return slice(2 * used_range[0], 2 * used_range[1] + 2), paired.reshape(2 * maps.shape[1], -1)


def _wrong_row_error(problem: str) -> DataError:
    return DataError(
        problem,
        "the data were recorded with another rig file",
        "use the rig file of this scan",
        code=ErrorCode.MISMATCH,
    )
