"""Layouts of recorded samples that a DCA1000 writes for each radar, and a guess of a recording's layout."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from polysight.host.capture.decode import decode_adjacent, decode_real, decode_row, decode_two_lane
from polysight.shared.config import Instrument

Samples = NDArray[np.complex64] | NDArray[np.float32]
SAMPLES_TRIED = (256, 512, 128, 1024, 64)
DRAW = 0.02
"""Difference in disorder below which layouts are not distinguished: the likelier one is taken."""
MAX_CHIRPS = 4096  # enough for the statistics
_CHIRPS_TRIED = 512
_PRIOR = 0.9  # ratio of prior likelihoods of consecutive layouts of `candidates`


@dataclass(frozen=True)
class Shape:
    """Layout of a recording: LVDS lanes, complex or real samples, samples of a chirp, antennas.

    `adjacent`: I and Q of a sample stand side by side (`I0 Q0 I1 Q1`), as public data sets of IWR and AWR16xx, 18xx and
    68xx hold them: with 2 lanes antenna after antenna, with 4 lanes sample after sample.
    """

    lanes: int
    is_complex: bool
    samples: int
    rx: int = 4
    adjacent: bool = False

    @staticmethod
    def of_instrument(rig: Instrument) -> Shape:
        """Return the layout of a rig's recordings."""
        return Shape(4, rig.chirp.if_mode.startswith("complex"), rig.chirp.samples)

    @property
    def chirp_bytes(self) -> int:
        """Bytes of one chirp of all antennas."""
        return self.samples * self.rx * (4 if self.is_complex else 2)

    @property
    def bins(self) -> int:
        """Bins of a chirp's spectrum."""
        return self.samples if self.is_complex else self.samples // 2

    def __str__(self) -> str:
        kind = "complex" if self.is_complex else "real"
        pairs = ", I and Q adjacent" if self.adjacent else ""
        return f"{self.lanes}-lane {kind}, {self.samples} samples x {self.rx} RX{pairs}"


def decode(payload: NDArray[np.uint8], shape: Shape, q_first: bool = False, most: int = MAX_CHIRPS) -> Samples:
    """Decode the first chirps in a layout: complex64 or float32 [rx, chirp, sample]."""
    chirps = min(payload.size // shape.chirp_bytes, most)
    if not shape.is_complex:
        return decode_real(payload, shape.lanes, chirps, shape.samples, shape.rx)
    if shape.adjacent:
        return decode_adjacent(payload, shape.lanes, chirps, shape.samples, shape.rx, q_first)
    if shape.lanes == 4:
        return decode_row(payload, None, chirps, shape.samples, shape.rx, q_first)[0]
    return decode_two_lane(payload, chirps, shape.samples, shape.rx, q_first)


def candidates(
    lanes: int | None,
    is_complex: bool | None,
    samples: int | None,
    rx: int,
    payload_bytes: int,
    adjacent: bool | None = None,
) -> list[Shape]:
    """Return every layout that fits the payload and the given properties, the likeliest first."""
    shapes = (
        Shape(k, c, n, rx, a)
        for n, a, c, k in product(
            SAMPLES_TRIED if samples is None else (samples,),
            (False, True) if adjacent is None else (adjacent,),
            (True, False) if is_complex is None else (is_complex,),
            (4, 2) if lanes is None else (lanes,),
        )
    )
    return [s for s in shapes if s.chirp_bytes <= payload_bytes and (s.is_complex or not s.adjacent)]


@dataclass(frozen=True)
class Guess:
    """A layout, its disorder, and its likelihood among those tried (sum 1)."""

    shape: Shape
    disorder: float
    likelihood: float


def guess_shapes(payload: NDArray[np.uint8], shapes: list[Shape]) -> list[Guess]:
    """Rank the layouts, likeliest first.

    The likelihood falls by e for each :data:`DRAW` of disorder, and a little with each place in the order of `shapes`.
    """
    disorder = np.array([spectral_disorder(payload, shape) for shape in shapes])
    weight = np.exp(-(disorder - disorder.min()) / DRAW) * _PRIOR ** np.arange(len(shapes))
    order = np.argsort(-weight, kind="stable")
    return [Guess(shapes[k], float(disorder[k]), float(weight[k] / weight.sum())) for k in order.tolist()]


def spectral_disorder(payload: NDArray[np.uint8], shape: Shape) -> float:
    """Return the relative entropy of the chirps' spectra, 0..1; the right layout occupies the fewest bins.

    The mean of every chirp is removed, or a constant would make any layout look ordered. In a wrong layout, values
    alternate between antennas, I and Q, or chirps, which spreads a tone over several lines.
    """
    power = spectra(decode(payload, shape, most=_CHIRPS_TRIED), remove_mean=True)
    share = power / np.maximum(power.sum(axis=-1, keepdims=True), 1e-12)
    return float(-(share * np.log(share + 1e-15)).sum(axis=-1).mean() / np.log(power.shape[-1]))


def spectra(cube: Samples, remove_mean: bool = False) -> NDArray[np.float64]:
    """Return power spectra, Hann window: float64 [rx, chirp, bin], half as many bins for real samples."""
    if remove_mean:
        cube = cube - cube.mean(axis=-1, keepdims=True)
    windowed = cube * np.hanning(cube.shape[-1])
    transform = np.fft.fft(windowed, axis=-1) if np.iscomplexobj(cube) else np.fft.rfft(windowed, axis=-1)[..., :-1]
    return np.abs(transform) ** 2
