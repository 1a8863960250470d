"""Commands of a radar's RF core and main core, their sequence for a board, and the limits of the AWR2243 on a rig file.

Values have the unit in their name, encoded as sub-blocks (`messages`), reserved fields zero. Layouts, codes and limits:
"ICD 81" is the printed page 81 of the document that `messages` names; the order follows its section 3
(docs/spec/mmwavelink.md). The commands for calibration data are in `calibration_data`. Not run on hardware yet.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from typing import ClassVar, Literal, NamedTuple

from polysight.radar.messages import SubBlock
from polysight_shared.config import HPF_FIRST_KHZ, HPF_SECOND_KHZ, Board, Instrument
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.geometry import direct_path_m
from polysight_shared.raster import MIN_PERIOD_US, WIDTH_US
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# One step of a start frequency: 53.6 Hz (ICD 81).
START_HZ_PER_CODE = 3.6e9 / 2**26
# One step of a slope: 48.279 kHz/us (ICD 83).
SLOPE_HZ_PER_S_PER_CODE = 3.6e9 * 900 / 2**26 * 1e6
# Units in which the radar counts the times of a chirp, and of a frame.
CHIRP_TICK_US = 0.01
FRAME_TICK_US = 0.005
# Actions of `FrameControl` (ICD 178).
STOP_AT_FRAME_END = 0
START = 1
STOP_WHILE_WAITING = 4
# Triggers that start a frame (ICD 92).
SOFTWARE_TRIGGER = 1
HARDWARE_TRIGGER = 2
IfMode = Literal["complex1x", "complex2x"]


class Command(ABC):
    """A command of the host: one sub-block."""

    # Number of the sub-block.
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
    """Return the code of RX gain and RF gain target (30, 33 or 36 dB). Raises ValueError for another target."""
    return rx_gain_db | (30, 33, 36).index(rf_gain_target_db) << 6


@dataclass(frozen=True)
class ConstantCommand(Command):
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


# ICD 269; must never be sent again (ICD 20)
RF_POWER_UP = ConstantCommand(0x4000, "RfPowerUp")
RF_INIT = ConstantCommand(0x00C0, "RfInit")
GET_RF_VERSION = ConstantCommand(0x0220, "GetRfVersion")
# ICD 188
GET_DIE_ID = ConstantCommand(0x0223, "GetDieId")
GET_MAIN_VERSION = ConstantCommand(0x40E0, "GetMainVersion")
GET_TEMPERATURES = ConstantCommand(0x02EA, "GetTemperatures")
# Read back profile 0, chirp 0 and the frame; the answers have the form of Profile, Chirp and Frame (ICD 175-176).
READ_PROFILE = ConstantCommand(0x0120, "ReadProfile", struct.pack("<2H", 0, 0))
READ_CHIRP = ConstantCommand(0x0121, "ReadChirp", struct.pack("<2H", 0, 0))
READ_FRAME = ConstantCommand(0x0122, "ReadFrame")

# Regular ADC mode; low power would limit the IF to 7.5 MHz (ICD 54).
LOW_POWER_OFF = ConstantCommand(0x0083, "LowPower", struct.pack("<2H", 0, 0))
# Clock of the data lanes: code 9 is 600 Mbit/s at both edges (ICD 56).
HSI_CLOCK = ConstantCommand(0x0085, "HsiClock", struct.pack("<2H", 9, 0))
# Faults (1) and monitoring (1 << 2) reported to the host with a 32-bit CRC, also start and end of frames; no watchdog,
# as hardware triggers require (ICD 57-58).
RF_DEVICE = ConstantCommand(0x0086, "RfDevice", struct.pack("<I6BH", 1 | 1 << 2, 0, 0, 0, 0, 1, 0, 0))
# Bandwidth of synthesizer (icp 1, rz 8) and clock PLL (icp 0x26, rz 9): default row of table 5.15, 266 MHz/us (ICD 69).
APLL_BANDWIDTH = ConstantCommand(0x008D, "ApllBandwidth", struct.pack("<6B5H", 1, 8, 0x26, 9, 0, 0, 0, 0, 0, 0, 0))
# LVDS with ADC data in packet 0, packet 1 suppressed (ICD 272).
DATA_PATH = ConstantCommand(0x4042, "DataPath", struct.pack("<8B", 1, 1, 0, 2, 0, 0, 0, 0))
# Four lanes, as a DCA1000 requires (ICD 275), 600 Mbit/s at both edges (ICD 276).
LANE_ENABLE = ConstantCommand(0x4043, "LaneEnable", struct.pack("<2H", 0b1111, 0))
DATA_PATH_CLOCK = ConstantCommand(0x4044, "DataPathClock", struct.pack("<BBH", 1, 1, 0))
# Lanes in the order of receivers, most significant bit first (ICD 277).
LVDS_LANES = ConstantCommand(0x4045, "LvdsLanes", struct.pack("<2H", 0, 1))
# Events of the main core with a 32-bit CRC from now on, no log (ICD 293).
DEVICE_CONFIGURATION = ConstantCommand(0x404C, "DeviceConfiguration", struct.pack("<BBHII", 1, 0, 0, 0, 0))


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
        # 2 stands for 16 bits of resolution; the format is in the upper half of the word.
        output = 1 if self.if_mode == "complex1x" else 2
        return struct.pack("<IHH", 2 | output << 16, 0, 0)


@dataclass(frozen=True)
class LdoBypass(Command):
    """RF LDO bypass, which may damage a device with the usual 1.3 V RF supplies (ICD 202).

    `list_constraints` refuses `bypass` without an acknowledgement for the board.
    """

    ID = 0x02CC
    bypass: bool = False

    def data(self) -> bytes:
        """Pack bypass, supply monitor 0 %, IO supply 3.3 V."""
        return struct.pack("<HBB", self.bypass, 0, 0)


@dataclass(frozen=True)
class Profile(Command):
    """A profile, 0..3 (`index`): the chirp's ramp and its ADC window (ICD 79-86).

    The ramp begins `idle_us` after the chirp does; ADC start and ramp end count from the start of the ramp. `hpf1_khz`
    and `hpf2_khz` are the corners of the high-pass filters, `rf_gain_target_db` is the gain that the RF stage aims at,
    `tx_backoff_db` how much less than full power is sent.
    """

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
        # One byte for each of the three transmitters.
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
    """Frames of `loops` chirps, started one by one by edges of SYNC_IN, or all together by software (ICD 90-94).

    `frames` is their number, `period_us` the frame period (:func:`frame_period_us`), `trigger` what starts them. TI's
    library writes the number of 16-bit words per chirp (2 x `samples`) into a field that the ICD calls reserved.
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
        period = round(self.period_us / FRAME_TICK_US)
        delay = round(self.trigger_delay_us / FRAME_TICK_US)
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


TRIGGER_MARGIN_US = 200.0
"""Time from the end of a frame's period to the next pulse; 150 us to 300 us are recommended (ICD 93)."""


@dataclass(frozen=True)
class Program:
    """The commands of one board, in order.

    Attributes
    ----------
    basic
        Commands that follow the power-up of the RF core.
    waveform
        Commands that follow the calibration of the RF core.
    samples, chirps, frame_period_us
        Samples of a chirp, chirps of a frame, and the period of frames.
    transmits
        True for the board whose transmitter is on.
    """

    basic: tuple[Command, ...]
    waveform: tuple[Command, ...]
    samples: int
    frame_period_us: float
    chirps: int = 1
    transmits: bool = False

    def make_frame_commands(self, count: int, trigger: int = HARDWARE_TRIGGER) -> tuple[Command, ...]:
        """Return the frame commands: for the RF core, then for the main core."""
        frame = Frame(count, self.frame_period_us, self.samples, self.chirps, trigger=trigger)
        return (frame, FrameApply(self.samples, self.chirps))


def frame_period_us(rig: Instrument) -> float:
    """Return the frame period, with a margin before the next pulse of a burst, microseconds."""
    return rig.burst.period_us - TRIGGER_MARGIN_US


def chirp_us(rig: Instrument) -> float:
    """Return the duration of a chirp: idle, ramp, and 10 ns that a ramp takes longer than programmed (ICD 82)."""
    return rig.radar.idle_us + rig.chirp.ramp_end_us + CHIRP_TICK_US


def tx_mask(rig: Instrument, board: Board) -> int:
    """Return the bit mask of a board's transmitters: one on the transmitting board, none on the others."""
    if board.name == rig.transmitter.name:
        return 1 << board.tx_antenna
    return 0


def make_program(rig: Instrument, board: Board) -> Program:
    """Return the commands for a board. Raises ValueError if a value exceeds its field."""
    chirp = rig.chirp
    tx = tx_mask(rig, board)
    native = rig.radar.native[board.name]
    rx = (1 << len(rig.antennas.rx_mm)) - 1
    commands = Program(
        basic=(
            Channels(rx, tx),
            AdcOutput(chirp.if_mode),
            LdoBypass(native.ldo_bypass),
            DataFormat(rx),
            LOW_POWER_OFF,
            APLL_BANDWIDTH,
            RF_DEVICE,
        ),
        waveform=(
            Profile(
                start_hz=chirp.start_hz + board.start_offset_hz,
                slope_hz_per_s=chirp.slope_hz_per_s,
                idle_us=rig.radar.idle_us,
                adc_start_us=chirp.adc_start_us,
                ramp_end_us=chirp.ramp_end_us,
                samples=chirp.samples,
                sample_rate_hz=chirp.sample_rate_hz,
                # The chirp has 0 in a simulated rig without filters.
                hpf1_khz=chirp.hpf1_khz or HPF_FIRST_KHZ[0],
                hpf2_khz=chirp.hpf2_khz or HPF_SECOND_KHZ[0],
                rx_gain_db=rig.radar.rx_gain_db,
                rf_gain_target_db=rig.radar.rf_gain_target_db,
                tx_backoff_db=rig.radar.tx_backoff_db,
            ),
            Chirp(tx),
            DATA_PATH,
            DATA_PATH_CLOCK,
            HSI_CLOCK,
            LANE_ENABLE,
            LVDS_LANES,
        ),
        samples=chirp.samples,
        frame_period_us=frame_period_us(rig),
        chirps=rig.burst.chirps,
        transmits=bool(tx),
    )
    for command in (*commands.basic, *commands.waveform):
        # Raises ValueError for a value that exceeds its field.
        command.block()
    return commands


# 76..81 GHz, to the code (ICD 81).
BAND_HZ = (0x5471C71B * START_HZ_PER_CODE, 0x5A000000 * START_HZ_PER_CODE)
# Shortest time from the last chirp to the end of a frame (ICD 91), and from there to the next pulse (ICD 93).
INTER_FRAME_US = 300.0
AFTER_FRAME_US = 150.0
# Least and largest period of frames; the radar counts it in 28 bits of 5 ns.
FRAME_PERIOD_US = (MIN_PERIOD_US, 1.342e6)
# Memory of the radar for the samples of one chirp (docs/spec/mmwavelink.md, with its other limits).
SAMPLE_MEMORY_BYTES = 16384
# Uncertainty of one board's start against the pulse (ICD 92).
TRIGGER_UNCERTAINTY_S = 5e-9
# Share of the sample rate that the receiver passes (docs/spec/mmwavelink.md, with its other limits).
PASSBAND = 0.9
# 266 MHz/us, for which the bandwidth of the synthesizer is set (`APLL_BANDWIDTH`).
MAX_SLOPE_CODE = 5510
# No radar has such values, and sums and products of a few of them are finite.
_LARGEST_NUMBER = 1e30
# Largest sample rates in regular ADC mode, with an IF of 20 MHz (ICD 85).
MAX_RATE_HZ = {"complex1x": 22.5e6, "complex2x": 45e6}


class Constraint(NamedTuple):
    """One rule: `low <= value <= high`, all in `unit`; a limit of None does not apply.

    `name`: its subject; `formula`: the computation of the value in words; `remedy`: the change if it is violated.
    """

    name: str
    formula: str
    value: float
    unit: str
    remedy: str
    low: float | None = None
    high: float | None = None

    @property
    def holds(self) -> bool:
        """True if the value is within the limits."""
        return (self.low is None or self.value >= self.low) and (self.high is None or self.value <= self.high)

    def __str__(self) -> str:
        if self.low is None:
            low = ""
        else:
            low = f"{self.low:.12g} <= "
        if self.high is None:
            high = ""
        else:
            high = f" <= {self.high:.12g}"
        return f"{self.name}: {low}{self.formula} = {self.value:.12g}{high} {self.unit}".rstrip()


def direct_if_hz(rig: Instrument, board: Board) -> float:
    """Return the IF of the direct path without timing errors: slope x path / c + start frequency difference, hertz.

    Frequencies are rounded to the radar's codes; the path is the mean over the board's antennas.
    """
    paths = direct_path_m(rig, board)
    slope = slope_code(rig.chirp.slope_hz_per_s) * SLOPE_HZ_PER_S_PER_CODE
    start = start_code(rig.chirp.start_hz + board.start_offset_hz) * START_HZ_PER_CODE
    transmitted = start_code(rig.chirp.start_hz + rig.transmitter.start_offset_hz) * START_HZ_PER_CODE
    return slope * sum(paths) / len(paths) / SPEED_OF_LIGHT_M_S + start - transmitted


def list_constraints(rig: Instrument, frames: int) -> list[Constraint]:
    """Return every constraint on a rig for rows of `frames` frames; if values are not finite or huge, only those.

    Raises nothing for any rig file. A rig file that keeps all constraints can be encoded by `make_program`.
    """
    if unusable := list(_find_unusable_numbers(rig)):
        return unusable
    board_constraints = [constraint for board in rig.boards for constraint in _list_constraints_of_board(rig, board)]
    return [*_list_timing_constraints(rig, frames), *_list_chirp_constraints(rig), *board_constraints]


def check_constraints(rig: Instrument, frames: int) -> None:
    """Raise ConfigError if a constraint is broken, with each broken one and its remedy."""
    broken = [c for c in list_constraints(rig, frames) if not c.holds]
    if broken:
        raise ConfigError(
            "the radars would refuse or misinterpret these settings: " + "; ".join(str(c) for c in broken),
            "the rig file exceeds the limits of the AWR2243",
            "; ".join(dict.fromkeys(c.remedy for c in broken)),
            code=ErrorCode.VALUE_INVALID,
        )


def _find_unusable_numbers(rig: Instrument) -> Iterator[Constraint]:
    """Yield a broken constraint for each value that is not a number, or beyond `_LARGEST_NUMBER`."""
    tables = {"chirp": rig.chirp, "burst": rig.burst, "radar": rig.radar}
    tables |= {f"boards.{b.name}": b for b in rig.boards}
    for table, part in tables.items():
        for key in part.__struct_fields__:
            value = getattr(part, key)
            if isinstance(value, int | float) and not -_LARGEST_NUMBER <= value <= _LARGEST_NUMBER:
                name = f"{table}.{key}"
                # An integer may be too large for a float.
                shown_value = value if isinstance(value, float) else inf
                yield Constraint(
                    name,
                    "a number",
                    shown_value,
                    "",
                    f"give a number in {name}",
                    low=-_LARGEST_NUMBER,
                    high=_LARGEST_NUMBER,
                )


def _list_timing_constraints(rig: Instrument, frames: int) -> Iterator[Constraint]:
    """Yield the rules on frames, pulses and the chirps between them, for rows of `frames` frames."""
    burst = rig.burst
    period = frame_period_us(rig)
    chirp = chirp_us(rig)
    period_remedy = "raise burst.period_us"
    yield Constraint("frames", "frames of a row", frames, "", "reduce the points or pulses of a row", low=1, high=65535)
    low, high = FRAME_PERIOD_US
    yield Constraint("frame period", "frame period", period, "us", period_remedy, low=low, high=high)
    # ICD 91
    yield Constraint("chirps", "chirps of a frame", burst.chirps, "", "set burst.chirps to 1..255", low=1, high=255)
    if burst.chirps > 1:
        spacing_remedy = f"set radar.idle_us to {burst.chirp_us - chirp + rig.radar.idle_us:g}, or burst.chirp_us"
        # The radar counts time in steps of 10 ns: half a step is rounding, with a little room.
        excess = chirp - burst.chirp_us
        yield Constraint(
            "chirp spacing", "idle + ramp - chirp_us", excess, "us", spacing_remedy, low=-0.006, high=0.006
        )
    # ICD 91
    idle_us = period - burst.chirps * chirp
    yield Constraint("inter-frame time", "frame period - chirps", idle_us, "us", period_remedy, low=INTER_FRAME_US)
    # ICD 93
    gap = burst.period_us - period
    yield Constraint("pulse gap", "pulse period - frame period", gap, "us", period_remedy, low=AFTER_FRAME_US)
    low, high = WIDTH_US
    yield Constraint("pulse width", "SYNC_IN pulse", burst.width_us, "us", "set burst.width_us", low=low, high=high)


def _list_chirp_constraints(rig: Instrument) -> Iterator[Constraint]:
    """Yield the rules on the chirp, its samples, filters and gains, which are the same on all boards."""
    chirp = rig.chirp
    end = inf
    if chirp.sample_rate_hz:
        end = chirp.adc_start_us + chirp.samples / chirp.sample_rate_hz * 1e6
    ramp_remedy = "raise chirp.ramp_end_us"
    yield Constraint("ADC window", "ADC start + samples / rate", end, "us", ramp_remedy, high=chirp.ramp_end_us)
    memory = chirp.samples * len(rig.antennas.rx_mm) * 4
    samples_remedy = "lower chirp.samples"
    yield Constraint("sample memory", "samples x RX x 4", memory, "bytes", samples_remedy, high=SAMPLE_MEMORY_BYTES)
    # Limits of the radar's error 1023 (docs/spec/mmwavelink.md).
    yield Constraint("samples", "words a chirp", 2 * chirp.samples, "", "set chirp.samples", low=64, high=8192)
    limit = MAX_RATE_HZ[chirp.if_mode]
    yield Constraint("sample rate", "rate", chirp.sample_rate_hz, "Hz", "set chirp.sample_rate_hz", low=2e6, high=limit)
    remainder = abs(chirp.sample_rate_hz / 1e3 - round(chirp.sample_rate_hz / 1e3)) * 1e3
    rate_remedy = "give whole kHz in sample_rate_hz"
    yield Constraint("sample rate step", "distance to whole kHz", remainder, "Hz", rate_remedy, high=1e-3)
    slope = slope_code(chirp.slope_hz_per_s)
    yield Constraint("slope", "code of the slope", slope, "", "lower chirp.slope_hz_per_s", low=1, high=MAX_SLOPE_CODE)
    yield Constraint("ADC start", "ADC start", chirp.adc_start_us, "us", "lower chirp.adc_start_us", low=0, high=40.95)
    yield Constraint("ramp", "ramp end", chirp.ramp_end_us, "us", "lower chirp.ramp_end_us", low=0, high=5000)
    yield Constraint("idle", "idle time", rig.radar.idle_us, "us", "lower radar.idle_us", low=0, high=5242.87)
    simulated = all(n.place.startswith("tcp://127.") for n in rig.radar.native.values())
    # Only simulated radars work without filters.
    if not simulated or (chirp.hpf1_khz and chirp.hpf2_khz):
        lowest = min(chirp.hpf1_khz, chirp.hpf2_khz)
        filter_remedy = "set corners of the devices: chirp.hpf1_khz of at least 175 and hpf2_khz of at least 350"
        yield Constraint("high-pass filters", "lower corner", lowest, "kHz", filter_remedy, low=HPF_FIRST_KHZ[0])
    gain = rig.radar.rx_gain_db
    # ICD table 5.24; the radar's error 52 allows 24..52 dB, which are not reached at every temperature and RF target.
    yield Constraint("RX gain", "RX gain", gain, "dB", "set radar.rx_gain_db to 32..52, even", low=32, high=52)
    yield Constraint("RX gain step", "RX gain modulo 2", gain % 2, "dB", "set an even radar.rx_gain_db", high=0)
    back_off = rig.radar.tx_backoff_db
    yield Constraint("TX back-off", "back-off", back_off, "dB", "lower radar.tx_backoff_db", low=0, high=20)


def _list_constraints_of_board(rig: Instrument, board: Board) -> Iterator[Constraint]:
    """Yield the rules on one board: its frequencies, its LDO bypass, and of a receiver the IF of the direct path."""
    chirp = rig.chirp
    suffix = f" of {board.name}"
    start = start_code(chirp.start_hz + board.start_offset_hz) * START_HZ_PER_CODE
    top = start + slope_code(chirp.slope_hz_per_s) * SLOPE_HZ_PER_S_PER_CODE * chirp.ramp_end_us * 1e-6
    offset_remedy = f"change start_offset_hz{suffix}, or the chirp"
    low, high = BAND_HZ
    yield Constraint(f"start frequency{suffix}", "start + offset", start, "Hz", offset_remedy, low=low, high=high)
    sweep_formula = "start + offset + slope x ramp end"
    yield Constraint(f"sweep{suffix}", sweep_formula, top, "Hz", offset_remedy, low=low, high=high)
    if board.name in rig.radar.native:
        native = rig.radar.native[board.name]
        # A USB path does not identify a board.
        acknowledged = native.usb_serial and native.ldo_bypass_acknowledged == native.usb_serial
        yield Constraint(
            f"LDO bypass{suffix}",
            "bypass without this board's acknowledgement",
            int(native.ldo_bypass and not acknowledged),
            "",
            f"disable ldo_bypass{suffix}: with the 1.3 V RF supplies of most TI boards it may destroy the device."
            " Only if you measured 1.0 V, write the board's USB serial number into ldo_bypass_acknowledged",
            high=0,
        )
    if board.role != "transmit":
        yield _make_if_constraint(rig, board)


def _make_if_constraint(rig: Instrument, board: Board) -> Constraint:
    """Return the rule that the direct path lies in the IF band, also with the trigger's uncertainty."""
    chirp = rig.chirp
    direct_hz = direct_if_hz(rig, board)
    spread = chirp.slope_hz_per_s * TRIGGER_UNCERTAINTY_S
    width = PASSBAND * chirp.sample_rate_hz
    low = 0.0
    if chirp.if_mode != "complex1x":
        low = -width / 2
    centred = board.start_offset_hz + low + width / 2 - direct_hz
    return Constraint(
        f"IF budget of {board.name}",
        "slope x direct path / c + start offsets, with +-5 ns of trigger",
        direct_hz,
        "Hz",
        f"set start_offset_hz of {board.name}; with {centred:.0f} its direct path is in the middle of the band",
        low=low + spread,
        high=low + width - spread,
    )
