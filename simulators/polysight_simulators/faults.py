"""The `[faults]` table of simulated capture cards: the faults, and reading them from files and options."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

import msgspec

from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError
from polysight_shared.tables import decode, read_toml

Probability = Annotated[float, msgspec.Meta(ge=0, le=1)]
Natural = Annotated[int, msgspec.Meta(ge=0)]
Seconds = Annotated[float, msgspec.Meta(ge=0)]
Bit = Annotated[int, msgspec.Meta(ge=0, le=15)]
CommandCode = Annotated[int, msgspec.Meta(ge=1, le=0xFFFF)]


class Faults(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `[faults]` table. Probabilities are per data packet (or frame, pulse, request); numbers count from 0 on.

    The network: `loss`, `duplicate`, `reorder` (swapped with the next packet), `late` (`late_packets` packets
    later), `truncate` (half of it arrives), `corrupt` (a flipped payload bit), `corrupt_header` (a flipped bit in the
    ten header bytes), `lose_packets` (these packets are lost), `link_down` (no packets for s seconds of wire time
    from pulse n on), `request_loss`, `reply_loss` (executed, but without a reply).
    The card: `overflow`, `ddr_full` (half a frame is lost before packetising: no sequence gap, status bits 9 and 7),
    `mute` (no replies), `answers` (no replies after this number), `reply_delay_ms`, `deaf_ms` (after command 0x03),
    `refuse` (these commands fail), `command_status` (this status bit follows the reply to this command),
    `pulse_status` (this status bit is sent at this pulse), `stop_after_packets` (no data packets after this number),
    `end_pulses` (the record ends before this pulse), `reset_pulses` (FPGA resets before this pulse),
    `power_cycle_pulses`, `boot_s`, `stop_discards` (record stop discards an incomplete packet), `first_sequence`,
    `first_byte_count`, `status_loss` (of asynchronous status messages), `twin` (a second card with the same address).
    The radar: `missed_pulse`, `miss_pulses` (these SYNC_IN pulses start no frame), `spurious_edges` (an edge this many
    ms behind this pulse). Its control server:
    `retrigger_fails` (these lines have no effect), `retrigger_resets` (the connection is reset at these lines). Under
    native control: `radar_fault_pulses` (the RF core faults at these pulses).
    """

    loss: Probability = 0.0
    duplicate: Probability = 0.0
    reorder: Probability = 0.0
    late: Probability = 0.0
    late_packets: Annotated[int, msgspec.Meta(ge=1)] = 100
    truncate: Probability = 0.0
    corrupt: Probability = 0.0
    corrupt_header: Probability = 0.0
    lose_packets: tuple[Natural, ...] = ()
    link_down: tuple[tuple[Natural, Seconds], ...] = ()
    request_loss: Probability = 0.0
    reply_loss: Probability = 0.0
    overflow: Probability = 0.0
    ddr_full: Probability = 0.0
    mute: bool = False
    answers: Natural | None = None
    reply_delay_ms: Seconds = 0.0
    deaf_ms: Seconds = 0.0
    refuse: tuple[CommandCode, ...] = ()
    command_status: tuple[tuple[CommandCode, Bit], ...] = ()
    pulse_status: tuple[tuple[Natural, Bit], ...] = ()
    stop_after_packets: Natural | None = None
    end_pulses: tuple[Natural, ...] = ()
    reset_pulses: tuple[Natural, ...] = ()
    power_cycle_pulses: tuple[Natural, ...] = ()
    boot_s: Seconds = 0.0
    stop_discards: bool = False
    first_sequence: Annotated[int, msgspec.Meta(ge=0, lt=1 << 32)] = 1
    first_byte_count: Annotated[int, msgspec.Meta(ge=0, lt=1 << 48)] = 0
    status_loss: Probability = 0.0
    twin: bool = False
    missed_pulse: Probability = 0.0
    spurious_edges: tuple[tuple[Natural, Seconds], ...] = ()
    miss_pulses: tuple[Natural, ...] = ()
    retrigger_fails: tuple[Natural, ...] = ()
    retrigger_resets: tuple[Natural, ...] = ()
    radar_fault_pulses: tuple[Natural, ...] = ()

    @property
    def corrupts(self) -> bool:
        """True if bits are flipped."""
        return bool(self.corrupt or self.corrupt_header)

    @property
    def disturbs_network(self) -> bool:
        """True if single packets can be disturbed (without `link_down`)."""
        some = self.loss or self.duplicate or self.reorder or self.late or self.truncate or self.lose_packets
        return bool(some) or self.corrupts or self.stop_after_packets is not None


# Faults that need a certain radar control.
OF_CONTROL = {"line_server": ("retrigger_fails", "retrigger_resets"), "native": ("radar_fault_pulses",)}


def read_faults(
    path: Path | None,
    settings: list[str],
    boards: tuple[str, ...],
    base: dict[str, Any] | None = None,
    control: str | None = None,
) -> dict[str, Faults]:
    """Read the faults of each board: `base`, overridden by the file, then by the command line.

    Parameters
    ----------
    base
        A `[faults]` table.
    boards
        Names of all boards.
    path
        TOML file: keys in `[faults]` apply to every board, in `[faults.NAME]` to that board.
    settings
        `KEY=VALUE` for every board or `NAME.KEY=VALUE` for one; the value has TOML syntax.
    control
        The rig's `radar.control`; None without radars.

    Raises
    ------
    ConfigError
        for unknown keys, boards or values, and for faults of a radar control that the rig does not have.
    """
    table: dict[str, Any] = dict(base or {})
    if path is not None:
        raw = read_toml(path)
        if set(raw) != {"faults"} or not isinstance(raw["faults"], dict):
            raise ConfigError(
                f"{path}: contains {sorted(raw)}",
                "not a fault file",
                "write one table, [faults]",
                code=ErrorCode.FILE_FOREIGN,
            )
        _merge(table, raw["faults"])
    for setting in settings:
        try:
            _merge(table, tomllib.loads(setting))
        except tomllib.TOMLDecodeError as e:
            raise ConfigError(
                f"--fault {setting!r}: {e}", "not of the form KEY=VALUE", "write for example loss=0.01 or RH.mute=true"
            ) from None
    common = {k: v for k, v in table.items() if not isinstance(v, dict)}
    board_tables = {k: v for k, v in table.items() if isinstance(v, dict)}
    if unknown := sorted(set(board_tables) - set(boards)):
        raise ConfigError(f"faults for unknown boards {unknown}", f"the boards are {list(boards)}", "correct the name")
    faults = {name: decode({**common, **board_tables.get(name, {})}, Faults, f"faults of {name}") for name in boards}
    for name, f in faults.items():
        for required, keys in OF_CONTROL.items():
            if control not in (None, required) and (idle := [key for key in keys if getattr(f, key)]):
                raise ConfigError(
                    f"faults {idle} of {name}: the rig has radar.control = {control!r}",
                    f"they need {required!r}",
                    "leave them out, or change radar.control (--native makes it native)",
                    code=ErrorCode.VALUES_CONFLICT,
                )
    return faults


def _merge(table: dict[str, Any], more: dict[str, Any]) -> None:
    for key, value in more.items():
        if isinstance(value, dict):
            table[key] = {**table.get(key, {}), **value}
        else:
            table[key] = value
