"""A small simulated rig that plays a counting pattern, for tests of how rows are armed and taken."""

from __future__ import annotations

import json
from typing import Any

import tomli_w

from polysight.shared.config import Instrument, load_instrument
from tests.support.rigs import rig_table

COLUMNS, ROWS, PULSES = 8, 3, 4


def small_table(**limits: float) -> dict[str, Any]:
    """The rig file's tables for a scan of three rows of eight positions, with short limits."""
    table = rig_table()
    table["grid"] |= {"columns": COLUMNS, "rows": ROWS}
    table["burst"] |= {"pulses": PULSES}
    table["limits"] |= {"end_of_record_s": 1.0, "row_retakes": 2, **limits}
    return table


def start_rig(bench, table: dict[str, Any], *faults: str) -> tuple[Any, Instrument]:
    """The simulated rig, running with faults `[BOARD.]KEY=VALUE`, and its rig file."""
    (bench.folder / "rig.toml").write_text(tomli_w.dumps(table))
    answer = [word for fault in faults for word in ("--fault", fault)]
    rig = bench.start(
        "python", "-m", "polysight.simulators.rig", "--config", "rig.toml", "--dir", bench.folder / "rig", "--pattern",
        "--time-scale", "40", "--with-pi", *answer,
    )  # fmt: skip
    return rig, load_instrument(bench.folder / rig.wait_ready())


def counts(bench, rig) -> dict[str, Any]:
    """What the simulated cards counted, after the rig has ended."""
    rig.end()
    found: dict[str, Any] = {}
    for path in (bench.folder / "rig").glob("cards-*.json"):
        found |= json.loads(path.read_text())["boards"]
    return found
