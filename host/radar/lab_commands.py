"""Sub-blocks beyond a scan's: reading back, calibration data, continuous streaming, advanced frames.

Layouts: ICD (messages.py), at the printed page in each docstring; the bytes are those of TI's library. Not run on
hardware yet.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import ClassVar

from polysight.host.radar.commands import FRAME_TICK_US, HARDWARE_TRIGGER, Command, start_code
from polysight.shared.config import HPF_FIRST_KHZ, HPF_SECOND_KHZ

CALIBRATION_PARTS, CALIBRATION_PART_BYTES = 3, 224  # ICD 70
RESTORED_CALIBRATIONS = 0x14E0  # ADC offset, both filters, RX gain, I/Q: what TI recommends to restore (ICD 72)
ALL_CALIBRATIONS = 0x1FF0  # of the RF init (ICD 63)


@dataclass(frozen=True)
class ReadProfile(Command):
    """Read back a profile: the answer has the form in which it was set (ICD 175)."""

    ID = 0x0120
    index: int = 0

    def data(self) -> bytes:
        """Index."""
        return struct.pack("<2H", self.index, 0)


@dataclass(frozen=True)
class ReadChirp(Command):
    """Read back a chirp (ICD 176)."""

    ID = 0x0121
    index: int = 0

    def data(self) -> bytes:
        """First and last index."""
        return struct.pack("<2H", self.index, self.index)


@dataclass(frozen=True)
class ReadFrame(Command):
    """Read back the frame configuration (ICD 176)."""

    ID = 0x0122

    def data(self) -> bytes:
        """Nothing."""
        return b""


@dataclass(frozen=True)
class InitCalibrations(Command):
    """Which calibrations the next RF init runs; what is left out must have been restored (ICD 63)."""

    ID = 0x0089
    mask: int = ALL_CALIBRATIONS

    def data(self) -> bytes:
        """Mask."""
        return struct.pack("<3I", self.mask, 0, 0)


@dataclass(frozen=True)
class SaveCalibration(Command):
    """Ask for one of three parts of the calibration data (ICD 70)."""

    ID = 0x00AB
    part: int

    def data(self) -> bytes:
        """Part."""
        return struct.pack("<2H", 0, self.part)


@dataclass(frozen=True)
class RestoreCalibration(Command):
    """Give one of three parts of the calibration data back; event 0x1004 follows the last one (ICD 66)."""

    ID = 0x008B
    part: int
    content: bytes

    def __str__(self) -> str:
        return f"part {self.part} of its calibration data"

    def data(self) -> bytes:
        """How many parts, which one, and its 224 bytes; TI's library sends the count where the ICD reserves a field."""
        return struct.pack("<2H", CALIBRATION_PARTS, self.part) + self.content


@dataclass(frozen=True)
class StreamTone(Command):
    """Continuous streaming: one frequency without a ramp, for tests of the RF (ICD 94)."""

    ID = 0x0103
    start_hz: float
    sample_rate_hz: float
    rx_gain_db: int
    hpf1_khz: float = HPF_FIRST_KHZ[0]
    hpf2_khz: float = HPF_SECOND_KHZ[0]
    tx_backoff_db: int = 0
    rf_gain_target_db: int = 30

    def data(self) -> bytes:
        """Start, back-off, phase, rate, filters, gain; the VCO is left to the firmware."""
        hpf = HPF_FIRST_KHZ.index(self.hpf1_khz), HPF_SECOND_KHZ.index(self.hpf2_khz)
        gain = self.rx_gain_db | (30, 33, 36).index(self.rf_gain_target_db) << 6
        back_off = self.tx_backoff_db * 0x010101
        rate = round(self.sample_rate_hz / 1e3)
        return struct.pack("<3IH4BH", start_code(self.start_hz), back_off, 0, rate, *hpf, gain, 0, 0)


@dataclass(frozen=True)
class StreamData(Command):
    """The main core sends samples without a break, or no longer (ICD 279)."""

    ID = 0x4046
    on: bool

    def data(self) -> bytes:
        """On."""
        return struct.pack("<2H", self.on, 0)


@dataclass(frozen=True)
class StreamEnable(Command):
    """The RF core streams continuously, or no longer (ICD 97)."""

    ID = 0x0104
    on: bool

    def data(self) -> bytes:
        """On."""
        return struct.pack("<2H", self.on, 0)


@dataclass(frozen=True)
class SubFrame:
    """Bursts of an advanced frame: in each `loops` times `chirps` chirps from `first_chirp` on."""

    first_chirp: int
    chirps: int
    loops: int
    burst_period_us: float
    bursts: int
    period_us: float

    def data(self) -> bytes:
        """32 bytes (ICD 98-100)."""
        burst, period = (round(t / FRAME_TICK_US) for t in (self.burst_period_us, self.period_us))
        return struct.pack(
            "<4HI4HI2I", 0, self.first_chirp, self.chirps, self.loops, burst, 0, self.bursts, 1, 0, period, 0, 0
        )


@dataclass(frozen=True)
class AdvancedFrame(Command):
    """Up to four sub-frames; with hardware triggers every burst wants a pulse of its own (ICD 97-107)."""

    ID = 0x0105
    sub_frames: tuple[SubFrame, ...]
    frames: int
    trigger: int = HARDWARE_TRIGGER
    MOST: ClassVar[int] = 4

    def data(self) -> bytes:
        """Sub-frames, frames, trigger. Raises ValueError when there are none or too many."""
        if not 1 <= len(self.sub_frames) <= self.MOST:
            raise ValueError(f"an advanced frame has 1..{self.MOST} sub-frames, not {len(self.sub_frames)}")
        parts = b"".join(s.data() for s in self.sub_frames).ljust(32 * self.MOST, b"\0")
        return (
            struct.pack("<4B", len(self.sub_frames), 0, 0, 0)
            + parts
            + struct.pack("<2H3I", self.frames, self.trigger, 0, 0, 0)
        )


@dataclass(frozen=True)
class AdvancedFrameApply(Command):
    """Makes the main core take over an advanced frame's sizes (ICD 303)."""

    ID = 0x40C1
    sub_frames: tuple[SubFrame, ...]
    samples: int

    def data(self) -> bytes:
        """Chirps, words of a chirp and chirps of a packet, of each sub-frame."""
        parts = b"".join(
            struct.pack("<IHBB", s.chirps * s.loops * s.bursts, 2 * self.samples, 1, 0) for s in self.sub_frames
        )
        return struct.pack("<4B", len(self.sub_frames), 0, 0, 0) + parts.ljust(32, b"\0")
