"""Inspect a recording of a DCA1000: layout, range profile, clipping, missing antennas, order of I and Q.

An unknown layout is guessed (and called a guess): of all layouts that fit, the one whose spectra have the least
disorder. A file of whole packets, with headers, is recognised and placed by byte count first. `pcap.py` reads packet
captures; `polysight.host.jobs.recordings` prints and plots the report. `kind_of` recognises other kinds of files.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polysight.host.capture import dca1000
from polysight.host.capture.dca1000 import MAX_PACKET_BYTES, MAX_PAYLOAD_BYTES, Status
from polysight.host.capture.earlier_records import counter_differences
from polysight.host.capture.layouts import (
    SAMPLES_TRIED,
    Guess,
    Shape,
    candidates,
    decode,
    guess_shapes,
    spectra,
    spectral_disorder,
)
from polysight.host.capture.packet_log import PacketLog
from polysight.host.capture.placement import Placed, place_record
from polysight.shared.config import Instrument
from polysight.shared.error_codes import ErrorCode
from polysight.shared.errors import DataError

MAX_BYTES = 256 << 20
"""Part of a file that is read: eleven rows of the published scan."""
_HEADERS_READ = 16  # to recognise a file of whole packets
_FULL_SCALE = 32767  # ADC counts
_MUCH_DC = 0.05 * _FULL_SCALE
_CLEARLY = 0.08  # difference in disorder by which another layout contradicts the given one
_WHITE = 0.94  # of the disorder of white noise
_UNIFORM = 0.45 * _FULL_SCALE  # standard deviation of values that fill the whole range
MAGIC = {
    b"\x7fELF": "a program", b"\x89PNG": "a picture (PNG)", b"\xff\xd8\xff": "a picture (JPEG)", b"%PDF": "a PDF",
    b"PK\x03\x04": "an archive (zip)", b"\x1f\x8b": "compressed (gzip)", b"\x89HDF": "HDF5",
    b"BZh": "compressed (bzip2)", b"\xfd7zXZ": "compressed (xz)", b"\x93NUMPY": "a numpy array",
    b"RIFF": "sound or video (RIFF)", b"MATLAB 5.0": "a MATLAB file",
}  # fmt: skip


def kind_of(head: bytes) -> str:
    """Describe the kind of file that begins with these bytes: `a picture (PNG)`, `text`, or `unknown bytes`."""
    for magic, kind in MAGIC.items():
        if head.startswith(magic):
            return kind
    if not head:
        return "empty"
    text = head.decode("utf-8", "ignore")
    return "text" if len(text.encode()) > len(head) - 4 and _printable(text) else "unknown bytes"


def _printable(text: str) -> bool:
    return all(c.isprintable() or c.isspace() for c in text)


def is_mirrored(power: NDArray[np.float64]) -> bool:
    """True if a complex spectrum, float64 [bin], is at negative frequencies: I and Q are swapped.

    For complex 1x (IF up to 0.9 sample rates) power in the upper half is no proof, so the last quarter is compared with
    the first: returns come from near. The bins next to zero are left out.
    """
    n, rim = power.size, 3
    return bool(power[n - n // 4 : n - rim].sum() > 4 * power[rim + 1 : n // 4 + 1].sum())


def is_offset_binary(words: NDArray[np.int16]) -> bool:
    """True if inverting the sign bit reduces the spread of the values clearly."""
    some = words[: 1 << 20]
    return bool(some.size and (some ^ np.int16(-0x8000)).std() < some.std() / 4)


def packets_in_file(payload: NDArray[np.uint8]) -> list[bytes]:
    """Return the packets of a file of consecutive full packets, the last perhaps short; [] for any other file.

    Some programs write packets as they come: 1456 bytes of payload, each behind ten bytes of counters.
    """
    count = min(_HEADERS_READ, payload.size // MAX_PACKET_BYTES)
    if count < 2:
        return []
    some = payload[: count * MAX_PACKET_BYTES].reshape(count, MAX_PACKET_BYTES)
    heads = [dca1000.decode_packet_header(row.tobytes()) for row in some]
    (sequence, byte_count), k = heads[0], range(count)
    if heads != [(sequence + i, byte_count + i * MAX_PAYLOAD_BYTES) for i in k]:
        return []
    pieces = [payload[a : a + MAX_PACKET_BYTES].tobytes() for a in range(0, payload.size, MAX_PACKET_BYTES)]
    return [piece for piece in pieces if len(piece) > dca1000.PACKET_HEADER_BYTES]


def place_packets(packets: list[bytes]) -> tuple[NDArray[np.uint8], Placed]:
    """Place a record of unknown length, from the lowest to the highest byte count.

    Returns its bytes, uint8 [n], and the result. Raises DataError if the packets are not of one record.
    """
    counts = np.array([dca1000.decode_packet_header(p)[1] for p in packets])
    ahead = counter_differences(counts, int(counts[0]), dca1000.BYTE_COUNT_BITS)
    sizes = np.array([len(p) for p in packets]) - dca1000.PACKET_HEADER_BYTES
    size = int((ahead + sizes).max() - ahead.min())
    if size > 1 << 34:
        what = f"byte counts span {size} bytes: more than one record, or corrupted packets"
        raise DataError(what, code=ErrorCode.FILE_DAMAGED)
    log = PacketLog(size)
    for packet in packets:
        log.add(np.frombuffer(packet, dtype=np.uint8)[None, :], np.array([len(packet)]), 0)
    placed, out = place_record(log)
    return out, placed


@dataclass(frozen=True)
class Known:
    """Known properties of a recording; None is guessed."""

    lanes: int | None = None
    is_complex: bool | None = None
    samples: int | None = None
    rx: int = 4
    q_first: bool | None = None
    adjacent: bool | None = None

    @staticmethod
    def of_shape(shape: Shape, q_first: bool | None = False) -> Known:
        """Return all properties of a recording in this layout."""
        return Known(shape.lanes, shape.is_complex, shape.samples, shape.rx, q_first, shape.adjacent)

    @staticmethod
    def of_instrument(rig: Instrument) -> Known:
        """Return the properties of a rig's recordings; I first, as mmWave Studio configures it."""
        return Known.of_shape(Shape.of_instrument(rig))


@dataclass
class Report:
    """Content of a recording.

    `profile_db` is the power range profile, Hann window, mean over chirps and antennas, in dB over its median;
    float64 [samples], or half as many for real samples. `rx_profile_db` is the same for every antenna over the same
    median. `rx_rms` and `rx_dc` are one value per antenna, ADC counts. `guessed` names properties that were not given,
    `guesses` are the layouts that fit, likeliest first, `not_a_capture` is the reason why the file is no recording.
    """

    path: Path
    bytes: int
    lanes: int
    is_complex: bool
    rx: int
    chirps: int
    samples: int
    q_first: bool
    peak_bin: int
    peak_db: float
    clipped: int
    rx_dc: list[float]
    rx_rms: list[float]
    left_over_bytes: int
    profile_db: NDArray[np.float64]
    rx_profile_db: NDArray[np.float64]
    guessed: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    card: CardReport | None = None
    simulated: bool = False
    adjacent: bool = False
    guesses: list[Guess] = field(default_factory=list)
    not_a_capture: str = ""


@dataclass
class CardReport:
    """A card in a packet capture: replies (code, status), FPGA version, status, the record."""

    address: str
    replies: list[tuple[str, int]]
    version: str
    status: Status
    record: Placed | None
    tail_bytes: int
    tail_after_s: float


def inspect_bin(path: Path, known: Known = Known()) -> Report:
    """Inspect a payload file; remark on properties that contradict `known`.

    Raises DataError if the file is missing or shorter than one chirp.
    """
    try:
        size = path.stat().st_size
        payload = np.fromfile(path, dtype=np.uint8, count=MAX_BYTES)
    except OSError as e:
        raise unreadable(path, e) from None
    packets = packets_in_file(payload)
    report = inspect_payload(path, place_packets(packets)[0] if packets else payload, known)
    if packets:
        report.remarks.append("whole packets, not payload: programs must remove the counters of each packet first")
    if size > MAX_BYTES:
        report.remarks.append(f"only the first {MAX_BYTES >> 20} MiB of {size >> 20} MiB were read")
    return report


def unreadable(path: Path, e: OSError) -> DataError:
    """Return the error for a recording that cannot be read."""
    what = f"{path}: cannot be read: {e.strerror}"
    return DataError(what, "the path is wrong", "give a recording", code=ErrorCode.FILE_UNREADABLE)


def inspect_payload(path: Path, payload: NDArray[np.uint8], known: Known) -> Report:
    """Inspect payload bytes, uint8 [n]; `path` is for the report. Raises DataError as :func:`inspect_bin`."""
    lanes, is_complex, samples, rx, q_first = known.lanes, known.is_complex, known.samples, known.rx, known.q_first
    given: dict[str, object] = {"lanes": lanes, "complex or real": is_complex, "samples": samples}
    shapes = candidates(lanes, is_complex, samples, rx, payload.size, known.adjacent)
    if not shapes:
        raise DataError(
            f"{path}: {payload.size} bytes are less than a chirp of {samples or min(SAMPLES_TRIED)} samples x {rx} RX",
            "empty or truncated file",
            "record again; `polysight inspect` needs at least one chirp",
            code=ErrorCode.NOT_ENOUGH_DATA,
        )
    words = payload[: payload.size // 2 * 2].view("<i2")
    remarks = []
    if is_offset_binary(words):
        remarks.append("offset binary, not two's complement: read with inverted sign bits")
        words = words ^ np.int16(-0x8000)
    values = words.view(np.uint8)
    guesses = guess_shapes(values, shapes)
    shape = guesses[0].shape
    remarks += _contradiction(values, shape)
    mirrored = shape.is_complex and is_mirrored(spectra(decode(values, shape)).mean(axis=(0, 1)))
    if shape.is_complex and q_first is None:
        given["I/Q order"], q_first = None, mirrored
    q_first = bool(q_first)
    cube = decode(values, shape, q_first)
    power = spectra(cube).mean(axis=1)
    profile, each = _over_median(power)
    # Without the bins that a constant offset fills, on both sides of zero.
    peak = 2 + int(np.argmax(profile[2:-1] if shape.is_complex else profile[2:]))
    report = Report(
        path=path,
        bytes=int(payload.size),
        lanes=shape.lanes,
        is_complex=shape.is_complex,
        rx=rx,
        chirps=payload.size // shape.chirp_bytes,
        samples=shape.samples,
        q_first=q_first,
        peak_bin=peak,
        peak_db=float(profile[peak]),
        clipped=int(((words >= _FULL_SCALE) | (words <= -_FULL_SCALE - 1)).sum()),
        rx_dc=[float(v) for v in np.abs(cube.mean(axis=(1, 2)))],
        rx_rms=[float(v) for v in np.sqrt(np.mean(np.abs(cube) ** 2, axis=(1, 2)))],
        left_over_bytes=int(payload.size % shape.chirp_bytes),
        profile_db=profile,
        rx_profile_db=each,
        guessed=[name for name, value in given.items() if value is None],
        adjacent=shape.adjacent,
        guesses=guesses,
        not_a_capture=_not_a_capture(payload, words, guesses),
    )
    if mirrored != q_first and shape.is_complex:
        report.remarks.append("most power is at negative frequencies: I and Q seem to be swapped")
    report.remarks += remarks + _remarks(report)
    return report


def _contradiction(values: NDArray[np.uint8], shape: Shape) -> list[str]:
    """Return a remark if another layout fits clearly better than the given one."""
    others = [s for s in candidates(None, None, None, shape.rx, values.size) if s != shape]
    better = guess_shapes(values, [shape, *others])[0].shape
    gain = spectral_disorder(values, shape) - spectral_disorder(values, better)
    return [f"the data look like {better}, not {shape}: wrong lanes, or another chirp"] if gain > _CLEARLY else []


def _not_a_capture(payload: NDArray[np.uint8], words: NDArray[np.int16], guesses: list[Guess]) -> str:
    """Return why these bytes were not written by a card; "" if they may have been."""
    head = payload[:8].tobytes()
    for magic, kind in MAGIC.items():
        if head.startswith(magic):
            return f"it begins as {kind}"
    if not (words != words[:1]).any():
        return f"every value is {'zero' if not words[0] else 'the same'}"
    if payload[:2].tobytes() in (b"\xff\xfe", b"\xfe\xff") and _is_text(payload[:4096].tobytes()):
        return "it begins as text (UTF-16)"
    some = words[: 1 << 20].astype(np.float64)
    # The entropy of a periodogram of white noise is Euler's 1 - 0.577 short of that of equal bins.
    white = min(g.disorder / (1 - 0.423 / np.log(g.shape.bins)) for g in guesses) > _WHITE
    if white and some.std() > _UNIFORM:
        return "its values are uniformly distributed and white in every layout: compressed or random bytes"
    return ""


def _is_text(raw: bytes) -> bool:
    """True if bytes with a byte order mark are printable in UTF-16."""
    try:
        return _printable(raw[: len(raw) // 2 * 2].decode("utf-16"))
    except UnicodeDecodeError:
        return False


def _over_median(power: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the mean over antennas, and every antenna, in dB over the median of the mean. `power` is [rx, bin]."""
    mean = power.mean(axis=0)
    floor = max(float(np.median(mean)), 1e-12)
    return 10 * np.log10(np.maximum(mean, 1e-12) / floor), 10 * np.log10(np.maximum(power, 1e-12) / floor)


def _remarks(r: Report) -> list[str]:
    found = []
    if r.bytes and max(r.rx_rms) == 0:
        found.append("every sample is zero: nothing was recorded")
    elif silent := [k for k, v in enumerate(r.rx_rms) if v < 0.01 * max(r.rx_rms)]:
        found.append(f"RX {', '.join(map(str, silent))} have no signal: antennas off, or another lane layout")
    if r.clipped:
        found.append(f"{r.clipped} values are at full scale: the receiver clips, lower its gain")
    if r.left_over_bytes:
        found.append(f"{r.left_over_bytes} bytes after the last complete chirp: truncated, or another layout")
    if r.rx_dc and max(r.rx_dc) > _MUCH_DC:
        found.append(f"constant offset of {max(r.rx_dc):.0f} counts, which this radar's high-pass filter would remove")
    if r.peak_db < 10 and max(r.rx_rms) > 0:
        found.append("no clear peak in the range profile: noise, or a wrong layout")
    return found
