"""Scan folders: append-only, self-validating, resumable; and every layout of recorded rows, read through one `Source`.

`ScanFolder` is a scan of ours; `open_source` recognises any layout. The `Source` protocol is rig, plan, the rows that
hold data, `read_row` and facts about the recording; `raw_source` asks for one with the chirps still in it.
"""

from polysight.host.store.scan_folder import MANIFEST, ScanFolder, versions
from polysight.host.store.source import CubeRow, RawSource, RowData, Scan, Source, raw_source
from polysight.host.store.sources.open import is_source, open_source
from polysight.host.store.sources.published_settings import mirrored

__all__ = [
    "MANIFEST",
    "CubeRow",
    "RawSource",
    "RowData",
    "Scan",
    "ScanFolder",
    "Source",
    "is_source",
    "mirrored",
    "open_source",
    "raw_source",
    "versions",
]
