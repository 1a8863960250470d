"""Small simulated scans of rigs that differ from their rig file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tests.support.rigs import Change, make_rig_with
from tests.support.store.facts import load_facts

from polysight.store import MANIFEST, manifest
from polysight_shared.config import Instrument
from polysight_shared.tables import to_builtins
from polysight_simulators.scene import decode_scene, simulate


@pytest.fixture(scope="session")
def make_rig() -> Callable[..., Instrument]:
    """`make_rig(change, **tables)`: the published rig with bursts of four pulses, changed as by `make_rig_with`."""

    def make(change: Change | None = None, **tables: dict[str, Any]) -> Instrument:
        return make_rig_with(change, **{**tables, "burst": {"pulses": 4, **tables.get("burst", {})}})

    return make


@pytest.fixture(scope="session")
def set_rig() -> Callable[[Path, Instrument], None]:
    """`set_rig(folder, rig)`: replace the rig in the manifest of a scan."""

    def change(folder: Path, rig: Instrument) -> None:
        facts = load_facts(folder)
        facts[0]["instrument"] = to_builtins(rig)
        (folder / MANIFEST).write_bytes(b"".join(manifest.encode_line(fact) for fact in facts))

    return change


@pytest.fixture(scope="session")
def make_scan(set_rig: Callable[[Path, Instrument], None]) -> Callable[..., Path]:
    """`make_scan(folder, true_rig, rig_of_file, **scene)`: simulate a scan with the true rig.

    Its manifest contains the rig of the rig file; without one, the true rig.
    """

    def make(folder: Path, true_rig: Instrument, rig_of_file: Instrument | None = None, **scene: Any) -> Path:
        simulate(true_rig, decode_scene({"name": "test", **scene}, "test"), folder)
        if rig_of_file is not None:
            set_rig(folder, rig_of_file)
        return folder

    return make
