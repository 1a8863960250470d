"""Material files in the form of the published data set."""

from __future__ import annotations

import pickle
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from polysight.materials import Entry


def write_materials(folder: Path, entries: Iterable[Entry]) -> None:
    """Write simulated or measured entries relative to an ideal metal, as `<number>_<angle>.pkl`."""
    folder.mkdir(parents=True, exist_ok=True)
    ones = np.ones(1, np.complex64)
    for number, entry in enumerate(entries):
        content = {
            "name": entry.name, "collection_name": entry.scan, "incident_angle": entry.incidence_deg,
            "ref_name": "metal", "values": [entry.p.conj(), entry.h.astype(np.complex64), entry.v.astype(np.complex64)],
            "ref_values": [ones, ones, ones], "simulated": entry.simulated,
        }  # fmt: skip
        (folder / f"{number}_{entry.incidence_deg:.0f}.pkl").write_bytes(pickle.dumps(content))
