"""Small simulated scans of rigs whose truth differs from what their rig file says."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any
from zlib import crc32

import pytest

from polysight.shared.config import Instrument
from polysight.shared.tables import to_builtins
from polysight.simulators.scene import decode_scene, simulate
from tests.support.rigs import Change, rig_with


def rig_of(change: Change | None = None, **tables: dict[str, Any]) -> Instrument:
    """The published rig with short bursts, changed: whole tables, then by hand."""
    tables["burst"] = {"pulses": 4, **tables.get("burst", {})}
    return rig_with(change, **tables)


def believe(folder: Path, rig: Instrument) -> None:
    """Let a scan folder's manifest say that it was taken with this rig."""
    path = folder / "manifest.jsonl"
    first, rest = path.read_text().split("\n", 1)
    fact = json.loads(first)
    del fact["crc"]
    fact["instrument"] = to_builtins(rig)
    plain = json.dumps(fact, sort_keys=True, separators=(",", ":"))
    fact["crc"] = f"{crc32(plain.encode()):08x}"
    path.write_text(json.dumps(fact, sort_keys=True, separators=(",", ":")) + "\n" + rest)


@pytest.fixture(scope="session")
def make_rig() -> Callable[..., Instrument]:
    return rig_of


@pytest.fixture(scope="session")
def scan_of() -> Callable[..., Path]:
    """A simulated scan of the true rig, in a folder that says it was the believed one."""

    def make(folder: Path, true: Instrument, believed: Instrument | None = None, **scene: Any) -> Path:
        simulate(true, decode_scene({"name": "test", **scene}, "test"), folder)
        if believed is not None:
            believe(folder, believed)
        return folder

    return make


@pytest.fixture(scope="session")
def believe_rig() -> Callable[[Path, Instrument], None]:
    """`believe_rig(folder, rig)`: let a scan folder say that it was taken with this rig."""
    return believe
