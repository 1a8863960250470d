"""Decode the card's bytes to complex IF samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

Gaps = Sequence[tuple[int, int]]


def row_words(
    payload: bytes | memoryview | NDArray[np.uint8],
    missing: Gaps,
    frames: int,
    samples: int,
    rx: int = 4,
) -> tuple[NDArray[np.int16], NDArray[np.bool_]]:
    """Return the words of a 4-lane recording in their own order, without a copy, as `polysight.sync` takes them.

    Parameters, `valid` and errors as of :func:`decode_row`; the words are int16 [frame, sample, 2, rx], I before Q,
    undefined for invalid frames.
    """
    words = _words(payload, frames * samples * rx * 2).reshape(frames, samples, 2, rx)
    return words, valid_frames(missing, frames, samples * rx * 4)


def raw_words(frames: NDArray[np.complex64]) -> NDArray[np.int16]:
    """Encode complex frames [rx, frame, sample] in ADC counts as words: int16 [frame, sample, 2, rx]."""
    rx, count, samples = frames.shape
    out = np.empty((count, samples, 2, rx), np.int16)
    for part, values in enumerate((frames.real, frames.imag)):
        np.rint(values.transpose(1, 2, 0), out=out[:, :, part], casting="unsafe")
    return out


def decode_row(
    payload: bytes | memoryview | NDArray[np.uint8],
    missing: Gaps,
    frames: int,
    samples: int,
    rx: int = 4,
    swap_iq: bool = False,
) -> tuple[NDArray[np.complex64], NDArray[np.bool_]]:
    """Decode a 4-lane recording (AWR2243, xWR12xx/14xx): per sample I of every RX, then Q of every RX.

    Parameters
    ----------
    payload
        Bytes as sent, int16 little-endian, at least frames x samples x rx x 4; more are ignored.
    missing
        Byte ranges (start, stop) that are missing.
    frames, samples, rx
        Frames of one chirp, ADC samples of a chirp, RX antennas.
    swap_iq
        True if the recording has Q first.

    Returns
    -------
    samples
        complex64 [rx, frame, sample], ADC counts; zero for frames with a missing byte.
    valid
        bool [frame], False for frames with a missing byte.

    Raises
    ------
    DataError
        if the payload is shorter than the shape requires.
    """
    words, valid = row_words(payload, missing, frames, samples, rx)
    out = _complex(words.transpose(2, 3, 0, 1), swap_iq)
    out[:, ~valid] = 0
    return out, valid


def decode_two_lane(
    payload: bytes | memoryview | NDArray[np.uint8], chirps: int, samples: int, rx: int = 4, swap_iq: bool = False
) -> NDArray[np.complex64]:
    """Decode a 2-lane recording (xWR16xx/18xx/68xx): a whole chirp of RX0, then RX1..., as I0 I1 Q0 Q1 I2 I3 Q2 Q3.

    `samples` must be even. Returns complex64 [rx, chirp, sample], ADC counts. Raises DataError as :func:`decode_row`.
    """
    if samples % 2:
        what = f"a 2-lane chirp has an even number of samples, not {samples}"
        raise DataError(what, "wrong number of samples given", code=ErrorCode.VALUE_INVALID)
    words = _words(payload, chirps * samples * rx * 2).reshape(chirps, rx, samples // 2, 2, 2)
    return _complex(words.transpose(3, 1, 0, 2, 4).reshape(2, rx, chirps, samples), swap_iq)


def _complex(parts: NDArray[np.int16], swap_iq: bool = False) -> NDArray[np.complex64]:
    """Join I and Q, int16 [2, rx, chirp, sample] (with `swap_iq` Q and I)."""
    out = np.empty(parts.shape[1:], dtype=np.complex64)
    out.real, out.imag = parts[::-1] if swap_iq else parts
    return out


def valid_frames(missing: Gaps, frames: int, frame_bytes: int) -> NDArray[np.bool_]:
    """Return bool [frame], True if no byte of the frame is missing. `missing` as in :func:`decode_row`."""
    valid = np.ones(frames, dtype=np.bool_)
    for start, stop in missing:
        if stop > start:
            valid[start // frame_bytes : (stop - 1) // frame_bytes + 1] = False
    return valid


def _words(payload: bytes | memoryview | NDArray[np.uint8], count: int) -> NDArray[np.int16]:
    raw = np.frombuffer(payload, dtype=np.uint8)
    if raw.size < count * 2:
        raise DataError(
            f"recording of {raw.size} bytes is shorter than the {count * 2} bytes its shape needs",
            "truncated file, or wrong numbers of frames, samples or RX",
            "check the chirp and burst of the rig file the recording was made with",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    return raw[: count * 2].view("<i2")
