"""What of the rig file may change while a scan is under way: how the Pi and the boards are reached, and the limits.

Nothing of it shapes the data. Everything else stays as the scan was begun, or its rows would not be of one scan.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from polysight.shared.config import Instrument
from polysight.shared.errors import ConfigError
from polysight.shared.tables import decode, to_builtins

SECTIONS = ("pi", "limits")
ADDRESSES = ("card_address", "host_address", "command_port", "data_port")
"""Of each board; `radar.servers` holds the addresses of their control servers."""


SERIAL = ("port", "baud")
"""Of the stage: the Pi has its own. Calibration is not compared either: a scan keeps copies of its files."""


def connection_of(rig: Instrument) -> dict[str, Any]:
    """That part of a rig file, as `scan_resumed` records it."""
    table = to_builtins(rig)
    return {
        **{section: table[section] for section in SECTIONS},
        "boards": {b["name"]: {key: b[key] for key in ADDRESSES} for b in table["boards"]},
        "servers": table["radar"]["servers"],
    }


def reconnected(begun: Instrument, connection: Mapping[str, Any]) -> Instrument:
    """The rig a scan was begun with, reached another way. Raises ConfigError."""
    return decode(_with(to_builtins(begun), connection), Instrument, "scan_resumed")


def check_same_scan(begun: Instrument, given: Instrument, name: str) -> None:
    """Refuse a rig file that differs in more than that from the one a scan was begun with; `name` is for the message.

    Raises
    ------
    ConfigError
        naming every key in which it does.
    """
    table, other = to_builtins(begun), _with(to_builtins(given), connection_of(begun))
    other["stage"] = {**other["stage"], **{key: table["stage"][key] for key in SERIAL}}
    other["calibration"] = table["calibration"]
    found = list(_differences(table, other, ""))
    if found:
        raise ConfigError(
            f"{name} is not the rig file of this scan: {'; '.join(found)}",
            "a scan goes on as it was begun: only [pi], [limits] and the addresses of the boards may change",
            "put these back; what has to change needs a new scan",
        )


def _with(table: dict[str, Any], connection: Mapping[str, Any]) -> dict[str, Any]:
    boards = [{**b, **connection["boards"].get(b["name"], {})} for b in table["boards"]]
    radar = {**table["radar"], "servers": connection["servers"]}
    return {**table, **{section: connection[section] for section in SECTIONS}, "boards": boards, "radar": radar}


def _differences(begun: Any, given: Any, key: str) -> Iterator[str]:
    """`key is A in the scan, B in the file`, for every number or text."""
    if isinstance(begun, dict) and isinstance(given, dict):
        for name in dict.fromkeys([*begun, *given]):
            yield from _differences(begun.get(name), given.get(name), f"{key}.{name}".lstrip("."))
    elif isinstance(begun, list) and isinstance(given, list) and len(begun) == len(given):
        for k, pair in enumerate(zip(begun, given, strict=True)):
            yield from _differences(*pair, f"{key}[{k}]")
    elif begun != given:
        yield f"{key} is {_told(begun)} in the scan and {_told(given)} there"


def _told(value: Any) -> str:
    return "not given" if value is None else repr(value)
