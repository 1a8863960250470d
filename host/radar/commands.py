"""The sub-blocks a radar is configured and run with, from units to bytes; the RF core's and the main core's.

Layouts and codes: ICD (messages.py), at the printed page in each docstring. Reserved fields are zero. Not run on
hardware yet.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

from polysight.host.radar.messages import SubBlock
from polysight.shared.config import HPF_FIRST_KHZ, HPF_SECOND_KHZ

START_HZ_PER_CODE = 3.6e9 / 2**26  # ICD 81
SLOPE_HZ_PER_S_PER_CODE = 3.6e9 * 900 / 2**26 * 1e6  # ICD 83: 48.279 kHz/us
CHIRP_TICK_US, FRAME_TICK_US = 0.01, 0.005
STOP_AT_FRAME_END, START, STOP_WHILE_WAITING = 0, 1, 4  # ICD 178
SOFTWARE_TRIGGER, HARDWARE_TRIGGER = 1, 2  # ICD 92
IfMode = Literal["complex1x", "complex2x"]


class Command(ABC):
    """One sub-block that the host sends."""

    ID: ClassVar[int]

    @abstractmethod
    def data(self) -> bytes:
        """What follows number and length. Raises ValueError when a value does not fit its field."""

    def block(self) -> SubBlock:
        """As a sub-block. Raises ValueError naming the command."""
        try:
            return SubBlock(self.ID, self.data())
        except struct.error as e:
            raise ValueError(f"{self}: a value does not fit its field: {e}") from None


def start_code(start_hz: float) -> int:
    """Code of a start frequency."""
    return round(start_hz / START_HZ_PER_CODE)


def slope_code(slope_hz_per_s: float) -> int:
    """Code of a ramp's slope."""
    return round(slope_hz_per_s / SLOPE_HZ_PER_S_PER_CODE)


@dataclass(frozen=True)
class Bare(Command):
    """A command without data: RF power-up, RF init, and the questions for versions and temperatures."""

    ID: int  # type: ignore[misc]

    def __str__(self) -> str:
        return f"command 0x{self.ID:04X}"

    def data(self) -> bytes:
        """Nothing."""
        return b""


RF_POWER_UP = Bare(0x4000)  # ICD 269; must never be sent again (ICD 20)
RF_INIT = Bare(0x00C0)
GET_RF_VERSION = Bare(0x0220)
GET_DIE_ID = Bare(0x0223)  # ICD 188
GET_MAIN_VERSION = Bare(0x40E0)
GET_TEMPERATURES = Bare(0x02EA)


@dataclass(frozen=True)
class Channels(Command):
    """Antennas that are powered, as bit masks; a single chip, its 40 MHz output off (ICD 50)."""

    ID = 0x0080
    rx: int = 0b1111
    tx: int = 0

    def data(self) -> bytes:
        """RX, TX, cascading, pins."""
        return struct.pack("<4H", self.rx, self.tx, 0, 1 << 5)


@dataclass(frozen=True)
class AdcOutput(Command):
    """16-bit samples, complex 1x (image filtered) or 2x (with image) (ICD 53)."""

    ID = 0x0082
    if_mode: IfMode

    def data(self) -> bytes:
        """Bits, full scale not reduced, format."""
        return struct.pack("<IHH", 2 | (1 if self.if_mode == "complex1x" else 2) << 16, 0, 0)


@dataclass(frozen=True)
class LowPower(Command):
    """ADC mode: regular, or low power (IF up to 7.5 MHz) (ICD 54)."""

    ID = 0x0083
    low: bool = False

    def data(self) -> bytes:
        """Reserved, mode."""
        return struct.pack("<2H", 0, self.low)


@dataclass(frozen=True)
class HsiClock(Command):
    """Rate code of the data lanes' clock: 9 is 600 Mbit/s at both edges (ICD 56)."""

    ID = 0x0085
    code: int = 9

    def data(self) -> bytes:
        """Code."""
        return struct.pack("<2H", self.code, 0)


@dataclass(frozen=True)
class RfDevice(Command):
    """Events to the host with a 32-bit CRC; start and end of frames told; watchdog off, as hardware triggers need.

    ICD 57-58.
    """

    ID = 0x0086

    def data(self) -> bytes:
        """Directions of events, their control, watchdog, CRC type."""
        faults_to_host, monitoring_to_host, watchdog = 1, 1 << 2, 0
        return struct.pack("<I6BH", faults_to_host | monitoring_to_host, 0, 0, 0, watchdog, 1, 0, 0)


@dataclass(frozen=True)
class ApllBandwidth(Command):
    """Bandwidth of synthesizer and clock PLL; the default row of table 5.15: 266 MHz/us at most (ICD 69)."""

    ID = 0x008D
    synth_icp: int = 1
    synth_rz: int = 8
    apll_icp: int = 0x26
    apll_rz: int = 9

    def data(self) -> bytes:
        """Trim codes."""
        return struct.pack("<6B5H", self.synth_icp, self.synth_rz, self.apll_icp, self.apll_rz, 0, 0, 0, 0, 0, 0, 0)


@dataclass(frozen=True)
class LdoBypass(Command):
    """RF LDO bypass: with 1.3 V on the RF supplies, as boards usually have it, bypassing may damage the device.

    ICD 202. :mod:`polysight.host.radar.constraints` refuses `bypass` without an acknowledgement for that very board.
    """

    ID = 0x02CC
    bypass: bool = False

    def data(self) -> bytes:
        """Bypass, supply monitor 0 %, IO supply 3.3 V."""
        return struct.pack("<HBB", self.bypass, 0, 0)


@dataclass(frozen=True)
class Profile(Command):
    """A profile, 0..3: the chirp's ramp and its ADC window (ICD 79-86)."""

    ID = 0x0100
    start_hz: float
    slope_hz_per_s: float
    idle_us: float
    adc_start_us: float
    ramp_end_us: float
    samples: int
    sample_rate_hz: float
    hpf1_khz: float
    hpf2_khz: float
    rx_gain_db: int
    rf_gain_target_db: int
    tx_backoff_db: int = 0
    index: int = 0

    def data(self) -> bytes:
        """VCO chosen by the firmware, calibration tables updated, no phase shift, TX from the ramp's knee."""
        back_off = self.tx_backoff_db * 0x010101
        return struct.pack(
            "<HBB6IhhHHBBHHH",
            self.index,
            0,
            0,
            start_code(self.start_hz),
            round(self.idle_us / CHIRP_TICK_US),
            round(self.adc_start_us / CHIRP_TICK_US),
            round(self.ramp_end_us / CHIRP_TICK_US),
            back_off,
            0,
            slope_code(self.slope_hz_per_s),
            0,
            self.samples,
            round(self.sample_rate_hz / 1e3),
            HPF_FIRST_KHZ.index(self.hpf1_khz),
            HPF_SECOND_KHZ.index(self.hpf2_khz),
            0,
            self.rx_gain_db | (30, 33, 36).index(self.rf_gain_target_db) << 6,
            0,
        )


@dataclass(frozen=True)
class Chirp(Command):
    """Chirps `first` to `last` (0..511) of a profile, unchanged, with the transmitters of a bit mask (ICD 88)."""

    ID = 0x0101
    tx: int
    first: int = 0
    last: int = 0
    profile: int = 0

    def data(self) -> bytes:
        """Range of indices, profile, four variations of zero, TX."""
        return struct.pack("<4HI4H", self.first, self.last, self.profile, 0, 0, 0, 0, 0, self.tx)


@dataclass(frozen=True)
class Frame(Command):
    """Frames of `loops` chirps, each started by an edge of SYNC_IN, or all at once by software (ICD 90-94).

    `samples` goes where the ICD has a reserved field and TI's library 16-bit words per chirp: twice as many.
    """

    ID = 0x0102
    frames: int
    period_us: float
    samples: int
    loops: int = 1
    trigger_delay_us: float = 0.0
    trigger: int = HARDWARE_TRIGGER

    def data(self) -> bytes:
        """Chirps, loops, frames, words, period, trigger, delay."""
        period, delay = (round(t / FRAME_TICK_US) for t in (self.period_us, self.trigger_delay_us))
        words = 2 * self.samples
        return struct.pack("<6HIHHI", 0, 0, 0, self.loops, self.frames, words, period, self.trigger, 0, delay)


@dataclass(frozen=True)
class FrameControl(Command):
    """Start or stop frames (ICD 178). `STOP_WHILE_WAITING` is forbidden while a frame runs."""

    ID = 0x0140
    what: int

    def data(self) -> bytes:
        """What."""
        return struct.pack("<2H", self.what, 0)


@dataclass(frozen=True)
class DataFormat(Command):
    """16-bit complex samples, I first, receivers interleaved (ICD 271)."""

    ID = 0x4041
    rx: int = 0b1111

    def data(self) -> bytes:
        """RX, bits, format, I/Q order, interleaving."""
        return struct.pack("<3HBBI", self.rx, 2, 1, 0, 0, 0)


@dataclass(frozen=True)
class DataPath(Command):
    """LVDS, ADC data only (ICD 272)."""

    ID = 0x4042

    def data(self) -> bytes:
        """Interface, packet 0, packet 1 suppressed, 16-bit quality words (unused)."""
        return struct.pack("<8B", 1, 1, 0, 2, 0, 0, 0, 0)


@dataclass(frozen=True)
class LaneEnable(Command):
    """Data lanes, as a bit mask; a DCA1000 takes four (ICD 275)."""

    ID = 0x4043
    lanes: int = 0b1111

    def data(self) -> bytes:
        """Lanes."""
        return struct.pack("<2H", self.lanes, 0)


@dataclass(frozen=True)
class DataPathClock(Command):
    """600 Mbit/s a lane, both edges (ICD 276)."""

    ID = 0x4044

    def data(self) -> bytes:
        """Edges, rate code."""
        return struct.pack("<BBH", 1, 1, 0)


@dataclass(frozen=True)
class LvdsLanes(Command):
    """Lanes in the order of receivers, most significant bit first (ICD 277)."""

    ID = 0x4045

    def data(self) -> bytes:
        """Map, parameters."""
        return struct.pack("<2H", 0, 1)


@dataclass(frozen=True)
class DeviceConfiguration(Command):
    """Events of the main core with a 32-bit CRC from now on (ICD 293)."""

    ID = 0x404C

    def data(self) -> bytes:
        """CRC type, no log."""
        return struct.pack("<BBHII", 1, 0, 0, 0, 0)


@dataclass(frozen=True)
class FrameApply(Command):
    """Makes the main core take over the frame's size (ICD 303). Belongs after every :class:`Frame`."""

    ID = 0x40C0
    samples: int
    chirps: int = 1

    def data(self) -> bytes:
        """Chirps of a frame, 16-bit words of a chirp."""
        return struct.pack("<IHH", self.chirps, 2 * self.samples, 0)


@dataclass(frozen=True)
class FileChunk(Command):
    """A part of the firmware image; the first one begins with type and length (ICD 302)."""

    ID = 0x4080
    part: bytes

    def __str__(self) -> str:
        return f"{len(self.part)} bytes of a file"

    def data(self) -> bytes:
        """The part itself."""
        return self.part
