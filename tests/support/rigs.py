"""The published rig, and rigs that differ from it."""

from collections.abc import Callable
from typing import Any

import msgspec

from polysight_shared.config import Instrument, load_instrument
from polysight_shared.tables import decode, to_builtins
from tests.support.paths import RIG_FILE

# Start offset of a receiver that puts the direct path into the middle of the IF band.
MID_BAND_OFFSET_HZ = 790e3
Change = Callable[[dict[str, Any]], None]


def load_published_rig() -> Instrument:
    """Return the rig of instrument.toml."""
    return load_instrument(RIG_FILE)


def time_by_the_program(rig: Instrument) -> Instrument:
    """Return the rig without one-shot and return wire, as it was published: the program makes the width of pulses."""
    pi = msgspec.structs.replace(rig.pi, one_shot=False, pulses_in=None)
    return msgspec.structs.replace(rig, pi=pi)


def time_by_spi(rig: Instrument) -> Instrument:
    """Return the rig with SYNC_IN on the SPI output MOSI (GPIO 10), and the input MISO (GPIO 9) as its return wire."""
    pi = msgspec.structs.replace(rig.pi, wiring="spi", sync_out=(10,), pulses_in=9, one_shot=False)
    return msgspec.structs.replace(rig, pi=pi)


def load_rig_table() -> dict[str, Any]:
    """Return the published rig as plain values, to be changed and written or decoded."""
    return to_builtins(load_published_rig())


def make_rig_with(change: Change | None = None, **tables: dict[str, Any]) -> Instrument:
    """Return the published rig with some keys of tables replaced, and then changed by a function.

    `make_rig_with(grid={"columns": 3}, burst={"pulses": 2})`; `change` gets the whole rig as plain values.
    """
    table = load_rig_table()
    for name, keys in tables.items():
        table[name] |= keys
    if change is not None:
        change(table)
    return decode(table, Instrument, "test")


def set_stage_port(rig: Instrument, port: str) -> Instrument:
    """Return the rig with its stage at another serial port."""
    return msgspec.structs.replace(rig, stage=msgspec.structs.replace(rig.stage, port=port))


def make_programmed_rig(offset_hz: float = MID_BAND_OFFSET_HZ, **tables: dict[str, Any]) -> Instrument:
    """Return a rig as :func:`make_rig_with`, with this start offset of every receiver.

    By default the direct path is in the middle of the band.
    """

    def program(table: dict[str, Any]) -> None:
        for board in table["boards"]:
            board["start_offset_hz"] = 0.0 if board["role"] == "transmit" else offset_hz

    return make_rig_with(program, **tables)
