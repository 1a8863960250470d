"""Sequence of commands for a board, from the rig file.

The order follows ICD section 3 and the notes of each sub-block; docs/spec/mmwavelink.md. Not run on hardware yet.
"""

from __future__ import annotations

from dataclasses import dataclass

from polysight.radar import commands as c
from polysight_shared.config import HPF_FIRST_KHZ, HPF_SECOND_KHZ, Board, Instrument

TRIGGER_MARGIN_US = 200.0
"""Time from the end of a frame's period to the next pulse; 150 us to 300 us are recommended (ICD 93)."""


@dataclass(frozen=True)
class Program:
    """The commands of one board, in order.

    Attributes
    ----------
    basic
        After the power-up of the RF core.
    waveform
        After the calibration of the RF core.
    """

    basic: tuple[c.Command, ...]
    waveform: tuple[c.Command, ...]
    samples: int
    frame_period_us: float
    chirps: int = 1
    transmits: bool = False

    def frames(self, count: int, trigger: int = c.HARDWARE_TRIGGER) -> tuple[c.Command, ...]:
        """Return the frame commands: for the RF core, then for the main core."""
        frame = c.Frame(count, self.frame_period_us, self.samples, self.chirps, trigger=trigger)
        return (frame, c.FrameApply(self.samples, self.chirps))


def frame_period_us(rig: Instrument) -> float:
    """Return the frame period, with a margin before the next pulse of a burst, microseconds."""
    return rig.burst.period_us - TRIGGER_MARGIN_US


def chirp_us(rig: Instrument) -> float:
    """Return the duration of a chirp: idle, ramp, and 10 ns that a ramp takes longer than programmed (ICD 82)."""
    return rig.radar.idle_us + rig.chirp.ramp_end_us + c.CHIRP_TICK_US


def tx_mask(rig: Instrument, board: Board) -> int:
    """Return the bit mask of a board's transmitters: one on the transmitting board, none on the others."""
    return 1 << board.tx_antenna if board.name == rig.transmitter.name else 0


def program(rig: Instrument, board: Board) -> Program:
    """Return the commands for a board. Raises ValueError if a value exceeds its field."""
    chirp, tx = rig.chirp, tx_mask(rig, board)
    native = rig.radar.native[board.name]
    rx = (1 << len(rig.antennas.rx_mm)) - 1
    commands = Program(
        basic=(
            c.Channels(rx, tx),
            c.AdcOutput(chirp.if_mode),
            c.LdoBypass(native.ldo_bypass),
            c.DataFormat(rx),
            c.LOW_POWER_OFF,
            c.APLL_BANDWIDTH,
            c.RF_DEVICE,
        ),
        waveform=(
            c.Profile(
                chirp.start_hz + board.start_offset_hz,
                chirp.slope_hz_per_s,
                rig.radar.idle_us,
                chirp.adc_start_us,
                chirp.ramp_end_us,
                chirp.samples,
                chirp.sample_rate_hz,
                chirp.hpf1_khz or HPF_FIRST_KHZ[0],  # 0: a simulated rig without filters
                chirp.hpf2_khz or HPF_SECOND_KHZ[0],
                rig.radar.rx_gain_db,
                rig.radar.rf_gain_target_db,
                rig.radar.tx_backoff_db,
            ),
            c.Chirp(tx),
            c.DATA_PATH,
            c.DATA_PATH_CLOCK,
            c.HSI_CLOCK,
            c.LANE_ENABLE,
            c.LVDS_LANES,
        ),
        samples=chirp.samples,
        frame_period_us=frame_period_us(rig),
        chirps=rig.burst.chirps,
        transmits=bool(tx),
    )
    for command in (*commands.basic, *commands.waveform):
        command.block()  # raises ValueError for a value that exceeds its field
    return commands
