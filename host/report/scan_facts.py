"""scan.json: what products were made from and with: scan, rig file, versions, gains that were divided out."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from polysight.host.imaging import ChannelImages
from polysight.host.report.products import write_json
from polysight.host.store.scan_folder import versions
from polysight.host.store.sources.source import Scan
from polysight.shared.config import Instrument
from polysight.shared.tables import to_builtins

SCAN = "scan.json"


def rx_gains(images: ChannelImages) -> dict[str, list[dict[str, float]]]:
    """Gain and phase of each RX against its board's first one, by board: from the direct path, divided out."""
    out = {}
    for board, gains in images.rx_calibration.items():
        relative = gains / gains[0]
        out[board] = [
            {"gain_db": float(20 * np.log10(abs(g))), "phase_deg": float(np.degrees(np.angle(g)))} for g in relative
        ]
    return out


def write_scan_facts(out: Path, source: Scan, rig: Instrument, images: ChannelImages) -> dict[str, Any]:
    """Write scan.json, and return its content. `rig` is the one the images were made with."""
    facts = {
        "scan_id": source.scan_id,
        "simulated": source.simulated,
        "processed_utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "versions": versions(),
        "rx_gains": rx_gains(images),
        "instrument": to_builtins(rig),
    }
    write_json(out / SCAN, facts)
    return facts
