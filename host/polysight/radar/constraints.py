"""Constraints of the AWR2243 on a rig file, checked before anything is sent to a board.

Each has a name, a formula, limits and a value. Sources: ICD at its printed page; docs/spec/mmwavelink.md.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from typing import NamedTuple

from polysight.radar.commands import SLOPE_HZ_PER_S_PER_CODE, START_HZ_PER_CODE, slope_code, start_code
from polysight.radar.program import chirp_us, frame_period_us
from polysight_shared.config import HPF_FIRST_KHZ, Board, Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError
from polysight_shared.geometry import direct_path_m
from polysight_shared.raster import MIN_PERIOD_US, WIDTH_US
from polysight_shared.units import SPEED_OF_LIGHT_M_S

BAND_HZ = (0x5471C71B * START_HZ_PER_CODE, 0x5A000000 * START_HZ_PER_CODE)  # 76..81 GHz, to the code (ICD 81)
INTER_FRAME_US = 300.0
AFTER_FRAME_US = 150.0
FRAME_PERIOD_US = (MIN_PERIOD_US, 1.342e6)
SAMPLE_MEMORY_BYTES = 16384
TRIGGER_UNCERTAINTY_S = 5e-9  # of one board against the pulse (ICD 92)
PASSBAND = 0.9  # of the sample rate
MAX_SLOPE_CODE = 5510
_LARGEST = 1.7e308
MAX_RATE_HZ = {"complex1x": 22.5e6, "complex2x": 45e6}  # regular ADC mode, 20 MHz IF (ICD 85)


class Constraint(NamedTuple):
    """One rule: `low <= value <= high`, all in `unit`; a limit of None does not apply."""

    name: str
    formula: str
    value: float
    low: float | None
    high: float | None
    unit: str
    remedy: str

    @property
    def holds(self) -> bool:
        """True if the value is within the limits."""
        return (self.low is None or self.value >= self.low) and (self.high is None or self.value <= self.high)

    def __str__(self) -> str:
        low = "" if self.low is None else f"{self.low:.12g} <= "
        high = "" if self.high is None else f" <= {self.high:.12g}"
        return f"{self.name}: {low}{self.formula} = {self.value:.12g}{high} {self.unit}".rstrip()


def direct_if_hz(rig: Instrument, board: Board) -> float:
    """Return the IF of the direct path without timing errors: slope x path / c + start frequency difference, hertz.

    Frequencies are rounded to the radar's codes; the path is the mean over the board's antennas.
    """
    paths = direct_path_m(rig, board)
    slope = slope_code(rig.chirp.slope_hz_per_s) * SLOPE_HZ_PER_S_PER_CODE
    start, transmitted = (
        start_code(rig.chirp.start_hz + b.start_offset_hz) * START_HZ_PER_CODE for b in (board, rig.transmitter)
    )
    return slope * sum(paths) / len(paths) / SPEED_OF_LIGHT_M_S + start - transmitted


def constraints(rig: Instrument, frames: int) -> list[Constraint]:
    """Return every constraint on a rig for rows of `frames` frames; if values are not finite, only those.

    Raises nothing for any rig file. A rig file that keeps all constraints can be encoded by `program`.
    """
    if unusable := list(_finite(rig)):
        return unusable
    return [*_timing(rig, frames), *_chirp(rig), *(c for b in rig.boards for c in _of_board(rig, b))]


def require(rig: Instrument, frames: int) -> None:
    """Raise ConfigError if a constraint is broken, with each broken one and its remedy."""
    broken = [c for c in constraints(rig, frames) if not c.holds]
    if broken:
        raise ConfigError(
            "the radars would refuse or misinterpret these settings: " + "; ".join(str(c) for c in broken),
            "the rig file exceeds the limits of the AWR2243",
            "; ".join(dict.fromkeys(c.remedy for c in broken)),
            code=ErrorCode.VALUE_INVALID,
        )


def _finite(rig: Instrument) -> Iterator[Constraint]:
    """Yield a broken constraint for each value that is infinite or not a number."""
    tables = {"chirp": rig.chirp, "burst": rig.burst, "radar": rig.radar}
    tables |= {f"boards.{b.name}": b for b in rig.boards}
    for table, part in tables.items():
        for key in part.__struct_fields__:
            value = getattr(part, key)
            if isinstance(value, int | float) and not -_LARGEST <= value <= _LARGEST:
                name, shown = f"{table}.{key}", value if isinstance(value, float) else inf
                yield Constraint(name, "a number", shown, -_LARGEST, _LARGEST, "", f"give a number in {name}")


def _timing(rig: Instrument, frames: int) -> Iterator[Constraint]:
    period, chirps = frame_period_us(rig), chirp_us(rig)
    longer_period = "raise burst.period_us"
    yield Constraint("frames", "frames of a row", frames, 1, 65535, "", "reduce the points or pulses of a row")
    yield Constraint("frame period", "frame period", period, *FRAME_PERIOD_US, "us", longer_period)
    yield Constraint(
        "chirps", "chirps of a frame", rig.burst.chirps, 1, 255, "", "set burst.chirps to 1..255"
    )  # ICD 91
    if rig.burst.chirps > 1:
        apart = f"set radar.idle_us to {rig.burst.chirp_us - chirps + rig.radar.idle_us:g}, or burst.chirp_us"
        yield Constraint(
            "chirp spacing", "idle + ramp - chirp_us", chirps - rig.burst.chirp_us, -0.006, 0.006, "us", apart
        )
    rest = period - rig.burst.chirps * chirps
    yield Constraint(
        "inter-frame time", "frame period - chirps", rest, INTER_FRAME_US, None, "us", longer_period
    )  # ICD 91
    gap = rig.burst.period_us - period
    yield Constraint(
        "pulse gap", "pulse period - frame period", gap, AFTER_FRAME_US, None, "us", longer_period
    )  # ICD 93
    yield Constraint("pulse width", "SYNC_IN pulse", rig.burst.width_us, *WIDTH_US, "us", "set burst.width_us")


def _chirp(rig: Instrument) -> Iterator[Constraint]:
    c = rig.chirp
    end = c.adc_start_us + (c.samples / c.sample_rate_hz * 1e6 if c.sample_rate_hz else inf)
    yield Constraint(
        "ADC window", "ADC start + samples / rate", end, None, c.ramp_end_us, "us", "raise chirp.ramp_end_us"
    )
    memory = c.samples * len(rig.antennas.rx_mm) * 4
    yield Constraint(
        "sample memory", "samples x RX x 4", memory, None, SAMPLE_MEMORY_BYTES, "bytes", "lower chirp.samples"
    )
    yield Constraint("samples", "words a chirp", 2 * c.samples, 64, 8192, "", "set chirp.samples")  # error 1023
    limit = MAX_RATE_HZ[c.if_mode]
    yield Constraint("sample rate", "rate", c.sample_rate_hz, 2e6, limit, "Hz", "set chirp.sample_rate_hz")
    remainder = abs(c.sample_rate_hz / 1e3 - round(c.sample_rate_hz / 1e3)) * 1e3
    yield Constraint(
        "sample rate step", "distance to whole kHz", remainder, None, 1e-3, "Hz", "give whole kHz in sample_rate_hz"
    )
    slope = slope_code(c.slope_hz_per_s)
    yield Constraint("slope", "code of the slope", slope, 1, MAX_SLOPE_CODE, "", "lower chirp.slope_hz_per_s")
    yield Constraint("ADC start", "ADC start", c.adc_start_us, 0, 40.95, "us", "lower chirp.adc_start_us")
    yield Constraint("ramp", "ramp end", c.ramp_end_us, 0, 5000, "us", "lower chirp.ramp_end_us")
    yield Constraint("idle", "idle time", rig.radar.idle_us, 0, 5242.87, "us", "lower radar.idle_us")
    simulated = all(n.place.startswith("tcp://127.") for n in rig.radar.native.values())
    if not simulated or (c.hpf1_khz and c.hpf2_khz):  # only simulated radars work without filters
        lowest = min(c.hpf1_khz, c.hpf2_khz)
        corner = "set corners of the devices: chirp.hpf1_khz of at least 175 and hpf2_khz of at least 350"
        yield Constraint("high-pass filters", "lower corner", lowest, HPF_FIRST_KHZ[0], None, "kHz", corner)
    gain = rig.radar.rx_gain_db
    # ICD table 5.24; the 24..52 dB of error 52 are not reached at every temperature and RF target.
    yield Constraint("RX gain", "RX gain", gain, 32, 52, "dB", "set radar.rx_gain_db to 32..52, even")
    yield Constraint("RX gain step", "RX gain modulo 2", gain % 2, None, 0, "dB", "set an even radar.rx_gain_db")
    yield Constraint("TX back-off", "back-off", rig.radar.tx_backoff_db, 0, 20, "dB", "lower radar.tx_backoff_db")


def _of_board(rig: Instrument, board: Board) -> Iterator[Constraint]:
    c, here = rig.chirp, f" of {board.name}"
    start = start_code(c.start_hz + board.start_offset_hz) * START_HZ_PER_CODE
    top = start + slope_code(c.slope_hz_per_s) * SLOPE_HZ_PER_S_PER_CODE * c.ramp_end_us * 1e-6
    offset = f"change start_offset_hz{here}, or the chirp"
    yield Constraint(f"start frequency{here}", "start + offset", start, *BAND_HZ, "Hz", offset)
    yield Constraint(f"sweep{here}", "start + offset + slope x ramp end", top, *BAND_HZ, "Hz", offset)
    if board.name in rig.radar.native:
        native = rig.radar.native[board.name]
        named = (
            native.usb_serial and native.ldo_bypass_acknowledged == native.usb_serial
        )  # a USB path does not identify a board
        unacknowledged = native.ldo_bypass and not named
        yield Constraint(
            f"LDO bypass{here}",
            "bypass without this board's acknowledgement",
            int(unacknowledged),
            None,
            0,
            "",
            f"disable ldo_bypass{here}: with the 1.3 V RF supplies of most TI boards it may destroy the device. Only if"
            " you measured 1.0 V, write the board's USB serial number into ldo_bypass_acknowledged",
        )
    if board.role == "transmit":
        return
    found, spread = direct_if_hz(rig, board), c.slope_hz_per_s * TRIGGER_UNCERTAINTY_S
    low, high = (
        (0.0, PASSBAND * c.sample_rate_hz)
        if c.if_mode == "complex1x"
        else (-PASSBAND / 2 * c.sample_rate_hz, PASSBAND / 2 * c.sample_rate_hz)
    )
    better = board.start_offset_hz + (low + high) / 2 - found
    yield Constraint(
        f"IF budget{here}",
        "slope x direct path / c + start offsets, with +-5 ns of trigger",
        found,
        low + spread,
        high - spread,
        "Hz",
        f"set start_offset_hz{here}; with {better:.0f} its direct path is in the middle of the band",
    )
