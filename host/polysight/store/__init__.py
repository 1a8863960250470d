"""Scan folders (append-only, self-validating, resumable), and a common `Source` protocol for all recorded layouts.

`ScanFolder` reads and writes our own scans: `manifest` is the log of facts, `events` the Pi's event log, `raw` deletes
raw data of processed rows, `sample_rows` checks kept samples, `replace` places rows again from their packets,
`validation` checks a folder.
`open_source` opens any known layout (our own, and the published data in `sources`) as a `Source`: rig, plan, rows with
data, `read_row`, and facts about the recording. `raw_source` requires a source that contains the chirps.
"""

from polysight.store import manifest
from polysight.store.append_only import crc32, sync_folder
from polysight.store.events import EventWriter, read_events
from polysight.store.manifest import (
    MANIFEST,
    BoardRow,
    Fact,
    LogDigest,
    Manifest,
    ManifestWriter,
    OtherFact,
    PiDescription,
    Reception,
    RowCommitted,
    RowFault,
    RowRejected,
    RowWithdrawn,
    ScanContinued,
    ScanEnded,
    ScanPaused,
    ScanResumed,
    ScanStarted,
)
from polysight.store.raw import Digests, drop, droppable, dropped_rows, require_raw
from polysight.store.replace import PlacedAgain, Replaced, place_again, replace_rows
from polysight.store.sample_rows import (
    SAMPLE_ROWS,
    SAMPLES,
    damaged_samples,
    locked_samples,
    open_records,
    raw_digest,
    read_sample_rows,
    record_digest,
)
from polysight.store.scan_folder import (
    EVENTS,
    PART,
    TRUTH,
    ScanFolder,
    check_same_scan,
    connection_of,
    new_scan_id,
    utc_now,
    versions,
    with_connection,
)
from polysight.store.source import CubeRow, RawSource, RowData, Scan, Source, raw_source
from polysight.store.sources.open import is_source, open_source
from polysight.store.sources.published_settings import COLLECTION, mirrored, read_settings, rig_of
from polysight.store.untrusted import MAX_BYTES, check_links, inside, open_npz
from polysight.store.validation import damage_of, damaged_rows, to_json, to_text, validate

__all__ = [
    "COLLECTION",
    "EVENTS",
    "MANIFEST",
    "MAX_BYTES",
    "PART",
    "SAMPLES",
    "SAMPLE_ROWS",
    "TRUTH",
    "BoardRow",
    "CubeRow",
    "Digests",
    "EventWriter",
    "Fact",
    "LogDigest",
    "Manifest",
    "ManifestWriter",
    "OtherFact",
    "PiDescription",
    "PlacedAgain",
    "RawSource",
    "Reception",
    "Replaced",
    "RowCommitted",
    "RowData",
    "RowFault",
    "RowRejected",
    "RowWithdrawn",
    "Scan",
    "ScanContinued",
    "ScanEnded",
    "ScanFolder",
    "ScanPaused",
    "ScanResumed",
    "ScanStarted",
    "Source",
    "check_links",
    "check_same_scan",
    "connection_of",
    "crc32",
    "damage_of",
    "damaged_rows",
    "damaged_samples",
    "drop",
    "droppable",
    "dropped_rows",
    "inside",
    "is_source",
    "locked_samples",
    "manifest",
    "mirrored",
    "new_scan_id",
    "open_npz",
    "open_records",
    "open_source",
    "place_again",
    "raw_digest",
    "raw_source",
    "read_events",
    "read_sample_rows",
    "read_settings",
    "record_digest",
    "replace_rows",
    "require_raw",
    "rig_of",
    "sync_folder",
    "to_json",
    "to_text",
    "utc_now",
    "validate",
    "versions",
    "with_connection",
]
