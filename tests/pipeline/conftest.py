"""Small simulated scans, and what the whole flow makes of them."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import pytest

from polysight.host.cli.main import main
from polysight.shared.config import Instrument, load_instrument
from polysight.shared.tables import decode, to_builtins
from polysight.simulators.scene import decode_scene, simulate

REPO = Path(__file__).resolve().parents[2]
COPPER = {"name": "copper", "centre_mm": [-40.0, 10.0], "size_mm": [50.0, 50.0], "metal": True}
PET = {"name": "PET", "centre_mm": [40.0, -10.0], "size_mm": [50.0, 50.0], "permittivity": [3.78, 0.7]}
EVERYWHERE = {"name": "copper", "centre_mm": [0.0, 0.0], "size_mm": [500.0, 400.0], "metal": True}


def rig_of(**tables: dict[str, Any]) -> Instrument:
    """The published rig with some tables changed."""
    table = to_builtins(load_instrument(REPO / "instrument.toml"))
    for name, more in tables.items():
        table[name] |= more
    return decode(table, Instrument, "test")


def scene_of(*plates: dict[str, Any], columns: int, rows: int, pulses: int = 2, **more: Any) -> dict[str, Any]:
    """A scene of plates on a coarse grid."""
    return {
        "name": "small",
        "grid": {"columns": columns, "rows": rows, "step_x_mm": 14.0, "step_y_mm": 8.0},
        "burst": {"pulses": pulses},
        "image": {"columns": 50, "rows": 40, "pixel_mm": 4.0},
        "plates": list(plates),
        **more,
    }


def told_by(*arguments: object) -> str:
    """What a command of the host says; it must succeed."""
    said = StringIO()
    with redirect_stdout(said):
        assert main([str(word) for word in arguments]) == 0
    return said.getvalue()


def content(path: Path) -> dict[str, Any]:
    """Of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


@pytest.fixture(scope="session")
def scan_of() -> Callable[..., Path]:
    """`scan_of(folder, scene, rig)`: a simulated scan, in a scan folder."""

    def make(folder: Path, scene: dict[str, Any], rig: Instrument | None = None, **more: Any) -> Path:
        return simulate(rig or rig_of(), decode_scene(scene, "test"), folder, **more)

    return make


@pytest.fixture(scope="session")
def two_plates(scan_of: Callable[..., Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scan of copper and PET."""
    return scan_of(tmp_path_factory.mktemp("two") / "scan", scene_of(COPPER, PET, columns=15, rows=17))
