"""Scan folders (append-only, self-validating, resumable), and a common `Source` protocol for all recorded layouts.

`ScanFolder` reads and writes our own scans: `manifest` is the log of facts and its one reader, `logs` has the event log
of the Pi, `raw` deletes raw data of processed rows and places rows again from their packets, `validation` checks a
folder and its kept samples. `open_source` opens any known layout (our own, and the `published` data) as a `Source`:
rig, plan, rows with data, `read_row`, and facts about the recording. `raw_source` requires a source that contains the
chirps.
"""

from polysight.store import manifest
from polysight.store.logs import EventWriter, LogDigest, parse_events, read_events
from polysight.store.manifest import (
    MANIFEST,
    BoardRow,
    Fact,
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
    lock_file,
)
from polysight.store.open import is_source, open_source
from polysight.store.published_rig import COLLECTION, build_rig, mirror_rig, read_settings
from polysight.store.raw import (
    Digests,
    PlacedAgain,
    ReplacedRow,
    drop,
    find_droppable,
    place_again,
    replace_rows,
    require_raw,
)
from polysight.store.scan_folder import (
    EVENTS,
    MAX_BYTES,
    PART_SUFFIX,
    SAMPLE_ROWS,
    SAMPLES,
    TRUTH,
    ScanFolder,
    check_inside,
    check_same_scan,
    dropped_rows,
    extract_connection,
    find_damaged_samples,
    lock_samples,
    make_scan_id,
    open_npz,
    open_records,
    raw_digest,
    read_sample_rows,
    record_digest,
    utc_now,
    versions,
    with_connection,
)
from polysight.store.source import CubeRow, RawSource, RowData, Scan, Source, raw_source
from polysight.store.validation import describe_damage, find_damaged_rows, to_json, to_text, validate
