"""Commands of a radar's RF core and main core: values in SI-like units, encoded as sub-blocks.

Layouts and codes: ICD (messages.py), at the printed page in each docstring; reserved fields are zero. The commands for
calibration data are in `calibration_data`. Not run on hardware yet.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal

from polysight.radar.messages import SubBlock
from polysight_shared.config import HPF_FIRST_KHZ, HPF_SECOND_KHZ

START_HZ_PER_CODE = 3.6e9 / 2**26  # ICD 81
SLOPE_HZ_PER_S_PER_CODE = 3.6e9 * 900 / 2**26 * 1e6  # ICD 83: 48.279 kHz/us
CHIRP_TICK_US, FRAME_TICK_US = 0.01, 0.005
STOP_AT_FRAME_END, START, STOP_WHILE_WAITING = 0, 1, 4  # ICD 178
SOFTWARE_TRIGGER, HARDWARE_TRIGGER = 1, 2  # ICD 92
IfMode = Literal["complex1x", "complex2x"]


class Command(ABC):
    """A command of the host: one sub-block."""

    ID: ClassVar[int]

    @property
    def name(self) -> str:
        """Name of the command, for logs."""
        return type(self).__name__

    @abstractmethod
    def data(self) -> bytes:
        """Return the data after number and length. Raises struct.error if a value exceeds its field."""

    def block(self) -> SubBlock:
        """Return the sub-block. Raises ValueError with the command if a value exceeds its field."""
        try:
            return SubBlock(self.ID, self.data())
        except struct.error as e:
            raise ValueError(f"{self}: a value does not fit its field: {e}") from None


def start_code(start_hz: float) -> int:
    """Return the code of a start frequency."""
    return round(start_hz / START_HZ_PER_CODE)


def slope_code(slope_hz_per_s: float) -> int:
    """Return the code of a ramp's slope."""
    return round(slope_hz_per_s / SLOPE_HZ_PER_S_PER_CODE)


def gain_code(rx_gain_db: int, rf_gain_target_db: int) -> int:
    """Return the code of RX gain and RF gain target."""
    return rx_gain_db | (30, 33, 36).index(rf_gain_target_db) << 6


@dataclass(frozen=True)
class Fixed(Command):
    """A command with constant data."""

    ID: int  # type: ignore[misc]
    label: str
    content: bytes = b""

    def __str__(self) -> str:
        return self.label

    @property
    def name(self) -> str:
        """The label."""
        return self.label

    def data(self) -> bytes:
        """Return the constant data."""
        return self.content


RF_POWER_UP = Fixed(0x4000, "RfPowerUp")  # ICD 269; must never be sent again (ICD 20)
RF_INIT = Fixed(0x00C0, "RfInit")
GET_RF_VERSION = Fixed(0x0220, "GetRfVersion")
GET_DIE_ID = Fixed(0x0223, "GetDieId")  # ICD 188
GET_MAIN_VERSION = Fixed(0x40E0, "GetMainVersion")
GET_TEMPERATURES = Fixed(0x02EA, "GetTemperatures")
# Read back profile 0, chirp 0 and the frame; the answers have the form of Profile, Chirp and Frame (ICD 175-176).
READ_PROFILE = Fixed(0x0120, "ReadProfile", struct.pack("<2H", 0, 0))
READ_CHIRP = Fixed(0x0121, "ReadChirp", struct.pack("<2H", 0, 0))
READ_FRAME = Fixed(0x0122, "ReadFrame")

# Regular ADC mode; low power would limit the IF to 7.5 MHz (ICD 54).
LOW_POWER_OFF = Fixed(0x0083, "LowPower", struct.pack("<2H", 0, 0))
# Clock of the data lanes: code 9 is 600 Mbit/s at both edges (ICD 56).
HSI_CLOCK = Fixed(0x0085, "HsiClock", struct.pack("<2H", 9, 0))
# Faults (1) and monitoring (1 << 2) reported to the host with a 32-bit CRC, also start and end of frames; no watchdog,
# as hardware triggers require (ICD 57-58).
RF_DEVICE = Fixed(0x0086, "RfDevice", struct.pack("<I6BH", 1 | 1 << 2, 0, 0, 0, 0, 1, 0, 0))
# Bandwidth of synthesizer (icp 1, rz 8) and clock PLL (icp 0x26, rz 9): default row of table 5.15, 266 MHz/us (ICD 69).
APLL_BANDWIDTH = Fixed(0x008D, "ApllBandwidth", struct.pack("<6B5H", 1, 8, 0x26, 9, 0, 0, 0, 0, 0, 0, 0))
# LVDS with ADC data in packet 0, packet 1 suppressed (ICD 272).
DATA_PATH = Fixed(0x4042, "DataPath", struct.pack("<8B", 1, 1, 0, 2, 0, 0, 0, 0))
# Four lanes, as a DCA1000 requires (ICD 275), 600 Mbit/s at both edges (ICD 276).
LANE_ENABLE = Fixed(0x4043, "LaneEnable", struct.pack("<2H", 0b1111, 0))
DATA_PATH_CLOCK = Fixed(0x4044, "DataPathClock", struct.pack("<BBH", 1, 1, 0))
# Lanes in the order of receivers, most significant bit first (ICD 277).
LVDS_LANES = Fixed(0x4045, "LvdsLanes", struct.pack("<2H", 0, 1))
# Events of the main core with a 32-bit CRC from now on, no log (ICD 293).
DEVICE_CONFIGURATION = Fixed(0x404C, "DeviceConfiguration", struct.pack("<BBHII", 1, 0, 0, 0, 0))


@dataclass(frozen=True)
class Channels(Command):
    """Powered antennas, as bit masks; a single chip, its 40 MHz output off (ICD 50)."""

    ID = 0x0080
    rx: int = 0b1111
    tx: int = 0

    def data(self) -> bytes:
        """Pack RX, TX, cascading, pins."""
        return struct.pack("<4H", self.rx, self.tx, 0, 1 << 5)


@dataclass(frozen=True)
class AdcOutput(Command):
    """16-bit samples, complex 1x (image filtered) or 2x (with image) (ICD 53)."""

    ID = 0x0082
    if_mode: IfMode

    def data(self) -> bytes:
        """Pack bits, full scale reduction 0, format."""
        return struct.pack("<IHH", 2 | (1 if self.if_mode == "complex1x" else 2) << 16, 0, 0)


@dataclass(frozen=True)
class LdoBypass(Command):
    """RF LDO bypass, which may damage a device with the usual 1.3 V RF supplies (ICD 202).

    `constraints` refuses `bypass` without an acknowledgement for the board.
    """

    ID = 0x02CC
    bypass: bool = False

    def data(self) -> bytes:
        """Pack bypass, supply monitor 0 %, IO supply 3.3 V."""
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
        """Pack the profile: the firmware selects the VCO, no phase shift, TX starts at the ramp's knee."""
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
            gain_code(self.rx_gain_db, self.rf_gain_target_db),
            0,
        )


@dataclass(frozen=True)
class Chirp(Command):
    """Chirp 0 of profile 0, unchanged, with the transmitters of a bit mask (ICD 88)."""

    ID = 0x0101
    tx: int

    def data(self) -> bytes:
        """Pack first and last index, profile, four variations, all zero, and TX."""
        return struct.pack("<4HI4H", 0, 0, 0, 0, 0, 0, 0, 0, self.tx)


@dataclass(frozen=True)
class Frame(Command):
    """Frames of `loops` chirps, started one by one by edges of SYNC_IN, or all at once by software (ICD 90-94).

    TI's library writes the number of 16-bit words per chirp (2 x `samples`) into a field that the ICD calls reserved.
    """

    ID = 0x0102
    frames: int
    period_us: float
    samples: int
    loops: int = 1
    trigger_delay_us: float = 0.0
    trigger: int = HARDWARE_TRIGGER

    def data(self) -> bytes:
        """Pack chirps, loops, frames, words, period, trigger, delay."""
        period, delay = (round(t / FRAME_TICK_US) for t in (self.period_us, self.trigger_delay_us))
        words = 2 * self.samples
        return struct.pack("<6HIHHI", 0, 0, 0, self.loops, self.frames, words, period, self.trigger, 0, delay)


@dataclass(frozen=True)
class FrameControl(Command):
    """Start or stop frames (ICD 178). `STOP_WHILE_WAITING` is forbidden while a frame runs."""

    ID = 0x0140
    action: int

    def data(self) -> bytes:
        """Pack the action."""
        return struct.pack("<2H", self.action, 0)


@dataclass(frozen=True)
class DataFormat(Command):
    """16-bit complex samples, I first, receivers interleaved (ICD 271)."""

    ID = 0x4041
    rx: int = 0b1111

    def data(self) -> bytes:
        """Pack RX, bits, format, I/Q order, interleaving."""
        return struct.pack("<3HBBI", self.rx, 2, 1, 0, 0, 0)


@dataclass(frozen=True)
class FrameApply(Command):
    """Apply the frame's size in the main core (ICD 303). Must follow every `Frame`."""

    ID = 0x40C0
    samples: int
    chirps: int = 1

    def data(self) -> bytes:
        """Pack chirps of a frame and 16-bit words of a chirp."""
        return struct.pack("<IHH", self.chirps, 2 * self.samples, 0)


@dataclass(frozen=True)
class FileChunk(Command):
    """Part of a firmware image; the first one starts with type and length (ICD 302)."""

    ID = 0x4080
    part: bytes

    def __str__(self) -> str:
        return f"{len(self.part)} bytes of a file"

    def data(self) -> bytes:
        """Return the part."""
        return self.part
