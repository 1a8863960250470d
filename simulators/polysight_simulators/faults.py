"""The `[faults]` table of simulated capture cards: the faults, and reading them from files and options."""

import tomllib
from pathlib import Path
from typing import Annotated, Any

import msgspec

from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.tables import decode, read_toml

Probability = Annotated[float, msgspec.Meta(ge=0, le=1)]
Natural = Annotated[int, msgspec.Meta(ge=0)]
NotNegative = Annotated[float, msgspec.Meta(ge=0)]


class Faults(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `[faults]` table. Probabilities are per data packet (or frame, pulse); numbers count from 0 on.

    The network: `loss`, `duplicate`, `reorder` (swapped with the next packet), `truncate` (half of it arrives),
    `corrupt` (a flipped payload bit), `status_loss` (of asynchronous status messages), `twin` (a second card with the
    same address).
    The card: `overflow` (half a frame is lost before packetising: no sequence gap, status bit 9), `mute` (no replies),
    `boot_s` (ignores requests for so many seconds after a power cycle).
    The radar: `missed_pulse`, `miss_pulses` (these SYNC_IN pulses start no frame), `spurious_edges` (pairs: pulse
    number, and ms after that pulse at which a spurious edge comes). Its control server: `retrigger_fails` (these lines
    `Retrigger`, which arm the radar, have no effect), `retrigger_resets` (the connection is reset at these lines).
    Under native control: `radar_fault_pulses` (the RF core faults at these pulses).
    """

    loss: Probability = 0.0
    duplicate: Probability = 0.0
    reorder: Probability = 0.0
    truncate: Probability = 0.0
    corrupt: Probability = 0.0
    status_loss: Probability = 0.0
    twin: bool = False
    overflow: Probability = 0.0
    mute: bool = False
    boot_s: NotNegative = 0.0
    missed_pulse: Probability = 0.0
    miss_pulses: tuple[Natural, ...] = ()
    spurious_edges: tuple[tuple[Natural, NotNegative], ...] = ()
    retrigger_fails: tuple[Natural, ...] = ()
    retrigger_resets: tuple[Natural, ...] = ()
    radar_fault_pulses: tuple[Natural, ...] = ()

    @property
    def disturbs_network(self) -> bool:
        """True if single packets can be disturbed."""
        return any((self.loss, self.duplicate, self.reorder, self.truncate, self.corrupt))


# Value of `radar.control` in the rig file, and the faults that can only be made with it.
FAULTS_OF_CONTROL = {"line_server": ("retrigger_fails", "retrigger_resets"), "native": ("radar_fault_pulses",)}


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
    for name, board_faults in faults.items():
        for required, keys in FAULTS_OF_CONTROL.items():
            keys_without_effect = [key for key in keys if getattr(board_faults, key)]
            if keys_without_effect and control not in (None, required):
                raise ConfigError(
                    f"faults {keys_without_effect} of {name}: the rig has radar.control = {control!r}",
                    f"they need {required!r}",
                    "leave them out, or change radar.control (--native makes it native)",
                    code=ErrorCode.VALUES_CONFLICT,
                )
    return faults


def _merge(table: dict[str, Any], changes: dict[str, Any]) -> None:
    """Overwrite the keys of `table` with `changes`, in place; the tables of single boards are merged key by key."""
    for key, value in changes.items():
        if isinstance(value, dict):
            table[key] = {**table.get(key, {}), **value}
        else:
            table[key] = value
