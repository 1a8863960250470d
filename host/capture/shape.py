"""How the values of a recording are laid out, and which layout its statistics speak for."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from polysight.host.capture.decode import decode_real, decode_row, decode_two_lane
from polysight.shared.config import Instrument

Samples = NDArray[np.complex64] | NDArray[np.float32]
SAMPLES_TRIED = (256, 512, 128, 1024, 64)
DRAW = 0.02
"""Layouts whose disorder differs by less are not told apart: the likelier one is taken."""
_MOST_CHIRPS = 4096  # enough for the statistics
_CHIRPS_TRIED = 512


@dataclass(frozen=True)
class Shape:
    """Layout of a recording: LVDS lanes, complex or real samples, samples of a chirp, antennas."""

    lanes: int
    is_complex: bool
    samples: int
    rx: int = 4

    @staticmethod
    def of_instrument(rig: Instrument) -> Shape:
        """What a rig file makes the card send."""
        return Shape(4, rig.chirp.if_mode.startswith("complex"), rig.chirp.samples)

    @property
    def chirp_bytes(self) -> int:
        """Bytes of one chirp of all antennas."""
        return self.samples * self.rx * (4 if self.is_complex else 2)

    def __str__(self) -> str:
        return f"{self.lanes}-lane {'complex' if self.is_complex else 'real'}, {self.samples} samples x {self.rx} RX"


def decode(payload: NDArray[np.uint8], shape: Shape, q_first: bool = False, most: int = _MOST_CHIRPS) -> Samples:
    """The first chirps in a layout: complex64 or float32 [rx, chirp, sample]."""
    chirps = min(payload.size // shape.chirp_bytes, most)
    if not shape.is_complex:
        return decode_real(payload, shape.lanes, chirps, shape.samples, shape.rx)
    if shape.lanes == 4:
        return decode_row(payload, None, chirps, shape.samples, shape.rx, q_first)[0]
    return decode_two_lane(payload, chirps, shape.samples, shape.rx, q_first)


def candidates(
    lanes: int | None, is_complex: bool | None, samples: int | None, rx: int, payload_bytes: int
) -> list[Shape]:
    """Every layout that agrees with what is known and fits into the payload, the likeliest first."""
    shapes = (
        Shape(k, c, n, rx)
        for n, c, k in product(
            SAMPLES_TRIED if samples is None else (samples,),
            (True, False) if is_complex is None else (is_complex,),
            (4, 2) if lanes is None else (lanes,),
        )
    )
    return [s for s in shapes if s.chirp_bytes <= payload_bytes]


def best_shape(payload: NDArray[np.uint8], shapes: list[Shape]) -> Shape:
    """The layout with the least disorder; the earlier, likelier one wins a draw."""
    best, least = shapes[0], np.inf
    for shape in shapes:
        disorder = spectral_disorder(payload, shape)
        if disorder < least - DRAW:
            best, least = shape, disorder
    return best


def spectral_disorder(payload: NDArray[np.uint8], shape: Shape) -> float:
    """Entropy of the chirps' spectra over its largest value, 0..1: the right layout has the fewest bins occupied.

    The mean of every chirp is removed, or a constant would make any layout look ordered. Values in the wrong place
    alternate between antennas, between I and Q, or between chirps, which spreads a tone over several lines.
    """
    power = spectra(decode(payload, shape, most=_CHIRPS_TRIED), remove_mean=True)
    share = power / np.maximum(power.sum(axis=-1, keepdims=True), 1e-12)
    return float(-(share * np.log(share + 1e-15)).sum(axis=-1).mean() / np.log(power.shape[-1]))


def spectra(cube: Samples, remove_mean: bool = False) -> NDArray[np.float64]:
    """Power spectra, Hann window: float64 [rx, chirp, bin], half as many bins for real samples."""
    if remove_mean:
        cube = cube - cube.mean(axis=-1, keepdims=True)
    windowed = cube * np.hanning(cube.shape[-1])
    transform = np.fft.fft(windowed, axis=-1) if np.iscomplexobj(cube) else np.fft.rfft(windowed, axis=-1)[..., :-1]
    return np.abs(transform) ** 2


def is_mirrored(power: NDArray[np.float64]) -> bool:
    """Whether a complex spectrum, float64 [bin], lies at negative frequencies: I and Q are in the other order.

    Where IF up to 0.9 sample rates is kept (complex 1x) the upper half is no proof; much more power in the last quarter
    than in the first is, because returns come from near. The bins next to zero are left out.
    """
    n, rim = power.size, 3
    return bool(power[n - n // 4 : n - rim].sum() > 4 * power[rim + 1 : n // 4 + 1].sum())


def is_offset_binary(words: NDArray[np.int16]) -> bool:
    """Whether the values spread far less once their sign bit is turned round."""
    some = words[: 1 << 20]
    return bool(some.size and (some ^ np.int16(-0x8000)).std() < some.std() / 4)
