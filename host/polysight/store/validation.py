"""Validate a scan folder: compare every file with the manifest, whose lines are *facts*, and list all faults."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path

import msgspec

from polysight.capture import PACKETS_SUFFIX, read_index
from polysight.store import manifest, scan_folder
from polysight.store.logs import LogDigest, crc32, read_events
from polysight.store.manifest import MANIFEST, BoardRow, RowCommitted, ScanEnded
from polysight_shared.errors import DeviceError, ErrorCode, PolysightError, quote
from polysight_shared.findings import Finding
from polysight_shared.raster import plan_raster

# Bytes of a file that are in memory at a time (chosen).
_CHUNK = 1 << 22
# Remedies of a damaged file of a row and of a damaged event log.
_COPY_REMEDY = "restore it from a copy, or `polysight resume` retakes its row"
_FETCH_REMEDY = "resume fetches the rest from the Pi's journal"
# What is said instead of a remedy if the damaged lines of the manifest cost no row.
_NO_ROW_LOST = "every row is committed"


def to_text(finding: Finding) -> str:
    """Return a finding as one line."""
    text = f"{finding.level}: {finding.where}: {finding.what}"
    if finding.do:
        text += f" ({finding.do})"
    return text


def to_json(findings: list[Finding]) -> str:
    """Return the findings as JSON; `unreadable`: a read error, the file may be undamaged."""
    entries = [
        {
            "severity": f.level,
            "where": f.where,
            "what": f.what,
            "remedy": f.do,
            "unreadable": f.code is ErrorCode.FILE_UNREADABLE,
        }
        for f in findings
    ]
    return json.dumps(entries, indent=2)


def _make_error(where: str, what: str, do: str = "", code: ErrorCode = ErrorCode.FILE_DAMAGED) -> Finding:
    """Return the finding that something is damaged; `do` is the remedy."""
    return Finding("error", what, do=do, where=where, code=code)


def _note(where: str, what: str, do: str = "") -> Finding:
    """Return a finding that is not a fault of the data."""
    return Finding("note", what, do=do, where=where)


def validate(path: Path) -> list[Finding]:
    """List faults of a scan folder and notes on it; [] if it is complete. Raises DataError if it is not a scan."""
    content = manifest.read(path / MANIFEST)
    being_written = manifest.is_being_written(path / MANIFEST)
    findings = []
    if content.torn:
        findings.append(_note(MANIFEST, "the last line is incomplete after a kill or power cut", "resume cuts it off"))
    try:
        scan = scan_folder.ScanFolder(path, content)
        rows = scan.committed_rows()
    except PolysightError as e:
        lost_lines = [_add_lost_rows(fault, "its facts are lost") for fault in content.faults]
        return [*findings, *lost_lines, _make_error(MANIFEST, e.what, e.remedy)]
    findings += [_add_lost_rows(fault, _describe_loss(scan)) for fault in scan.manifest_faults]
    if scan.plan != plan_raster(scan.instrument.grid):
        findings.append(_make_error(MANIFEST, "the plan is not that of the rig file's grid"))
    for row in rows.values():
        findings += _check_row(scan, row)
    if being_written:
        # Files of the row that is being recorded, and its events, are not complete yet.
        problem = f"a program is recording this scan: {len(rows)} of {scan.plan.rows} rows are committed"
        return [f for f in findings if f.level == "error"] + [
            _note(MANIFEST, problem, "validate again when it has ended")
        ]
    findings += _check_dropped(scan)
    findings += _find_strays(scan, rows)
    findings += _check_events(scan)
    # A committed row may lie outside the plan: `_check_row` reports it, and it takes the place of no planned row.
    planned_rows = range(scan.plan.rows)
    missing = len([row for row in planned_rows if row not in rows])
    ended = scan.facts(ScanEnded)
    if missing:
        remedy = f"`polysight resume {quote(path)}` records them"
        findings.append(_note(MANIFEST, f"{missing} of {scan.plan.rows} rows are not committed", remedy))
    elif not ended:
        findings.append(_note(MANIFEST, "no scan_ended: the program ended before it was written"))
    return findings


def find_damaged_rows(scan: scan_folder.ScanFolder) -> dict[int, list[str]]:
    """Return the committed rows whose files differ from the commit, with the faults of each; reads every byte.

    Raises DeviceError on a read error: the row may be undamaged and must not be taken again.
    """
    findings = {row.row: _check_row(scan, row) for row in scan.committed_rows().values()}
    unreadable = [f for faults in findings.values() for f in faults if f.code is ErrorCode.FILE_UNREADABLE]
    if unreadable:
        raise DeviceError(
            f"{scan.path / unreadable[0].where}: {unreadable[0].what}",
            f"the disk fails, or its server does not respond ({len(unreadable)} files); nothing was changed",
            f"check the disk, then `polysight resume {quote(scan.path)}`",
            code=ErrorCode.FILE_UNREADABLE,
        )
    return {row: [to_text(f) for f in faults] for row, faults in findings.items() if faults}


def describe_damage(scan: scan_folder.ScanFolder, path: Path) -> str:
    """Compare the files of one board and row with the manifest; return the faults as text, "" if there are none.

    `path` is the board's payload file of the row. If no committed row has such a file, the text says so.
    """
    for row in scan.committed_rows().values():
        for board in row.boards.values():
            if (scan.path / board.file).resolve() == path.resolve():
                # The radar records one frame for each pulse.
                faults = find_board_faults(scan, board, frames=row.pulses)
                return "; ".join(map(to_text, faults))
    return "the manifest has no such committed row"


def _add_lost_rows(fault: Finding, loss: str) -> Finding:
    """Return a fault of the manifest with the text about its lost rows; with an empty text it is only a note."""
    if loss:
        return msgspec.structs.replace(fault, level="error", do=loss)
    return msgspec.structs.replace(fault, level="note", do=_NO_ROW_LOST)


def _describe_loss(scan: scan_folder.ScanFolder) -> str:
    """Describe the rows that are not committed; "" if every row is, so that lost lines do not matter."""
    absent = scan.rows_absent
    if not absent:
        return ""
    if len(absent) == 1:
        rows = f"row {absent[0]} is"
    else:
        rows = f"rows {', '.join(map(str, absent))} are"
    return f"facts are lost: {rows} not committed; `polysight resume {quote(scan.path)}` records them again"


def _check_row(scan: scan_folder.ScanFolder, row: RowCommitted) -> list[Finding]:
    """Compare a committed row with the plan, and its files with the manifest."""
    row_text = f"row {row.row}"
    if not 0 <= row.row < scan.plan.rows:
        return [_make_error(row_text, f"outside the plan's {scan.plan.rows} rows")]
    findings = []
    planned_row = scan.plan.row(row.row)
    pulses = planned_row.points * scan.instrument.burst.pulses
    if row.direction != planned_row.direction:
        findings.append(_make_error(row_text, f"direction {row.direction}, planned {planned_row.direction}"))
    if row.pulses != pulses:
        findings.append(_make_error(row_text, f"{row.pulses} pulses, {pulses} planned"))
    boards = {board.name for board in scan.instrument.recorded}
    if set(row.boards) != boards:
        findings.append(_make_error(row_text, f"boards {sorted(row.boards)}, recorded are {sorted(boards)}"))
    for board in row.boards.values():
        findings += find_board_faults(scan, board, frames=pulses)
    return findings


def find_board_faults(scan: scan_folder.ScanFolder, board: BoardRow, frames: int) -> list[Finding]:
    """Compare the files of one board's committed row of `frames` frames with the manifest."""
    file_name = board.file
    path = scan.path / board.file
    findings = []
    expected = frames * scan.instrument.frame_bytes
    if (board.bytes, board.frames_expected) != (expected, frames):
        findings.append(
            _make_error(file_name, f"{board.bytes} bytes of {board.frames_expected} frames, planned {expected}")
        )
    is_kept = board.file not in scan_folder.dropped_files(scan) or path.exists()
    try:
        # Only the committed digest is left of a dropped payload.
        if is_kept:
            size, crc = _compute_digest(path)
        else:
            size = board.bytes
            crc = int(board.crc32, 16)
    except OSError as e:
        return [*findings, _make_read_error(file_name, e)]
    if size != board.bytes:
        findings.append(_make_error(file_name, f"{size} bytes, {board.bytes} were committed", _COPY_REMEDY))
    elif f"{crc:08x}" != board.crc32:
        findings.append(_make_error(file_name, "differs from the committed data (CRC)", _COPY_REMEDY))
    # The index says which byte ranges of the row are missing; a row without it misses none.
    index = path.with_suffix(".idx")
    findings += _check_packets(scan, board, path.with_suffix(PACKETS_SUFFIX))
    file_name = str(index.relative_to(scan.path))
    if not index.exists():
        is_needed = board.missing_bytes > 0 or board.index_crc32 != ""
        if is_needed:
            return [*findings, _make_error(file_name, "absent", _COPY_REMEDY)]
        return findings
    try:
        index_crc = crc32(index.read_bytes())
    except OSError as e:
        return [*findings, _make_read_error(file_name, e)]
    if board.index_crc32 and f"{index_crc:08x}" != board.index_crc32:
        return [*findings, _make_error(file_name, "differs from the committed data (CRC)", _COPY_REMEDY)]
    try:
        facts, _ = read_index(index)
        gaps = [(int(begin), int(end)) for begin, end in facts.get("missing", [])]
    except (PolysightError, TypeError, ValueError) as e:
        return [*findings, _make_error(file_name, str(e))]
    none_is_empty = all(begin < end for begin, end in gaps)
    are_apart = all(gap[1] < next_gap[0] for gap, next_gap in pairwise(gaps))
    are_inside = all(begin >= 0 and end <= board.bytes for begin, end in gaps)
    gap_bytes = sum(end - begin for begin, end in gaps)
    if not (none_is_empty and are_apart and are_inside) or gap_bytes != board.missing_bytes:
        findings.append(_make_error(file_name, f"its gaps do not make the {board.missing_bytes} missing bytes"))
    return findings


def _check_packets(scan: scan_folder.ScanFolder, board: BoardRow, path: Path) -> list[Finding]:
    """Compare the row's packet file with its digest; rows of earlier releases have none."""
    if not board.packets_crc32:
        return []
    file_name = str(path.relative_to(scan.path))
    try:
        _, crc = _compute_digest(path)
    except FileNotFoundError:
        return [_make_error(file_name, "absent", _COPY_REMEDY)]
    except OSError as e:
        return [_make_read_error(file_name, e)]
    if f"{crc:08x}" == board.packets_crc32:
        return []
    return [_make_error(file_name, "differs from the committed data (CRC)", _COPY_REMEDY)]


def _make_read_error(where: str, e: OSError) -> Finding:
    """Return the finding that a file is missing or cannot be read."""
    if isinstance(e, FileNotFoundError):
        code = ErrorCode.FILE_MISSING
    else:
        code = ErrorCode.FILE_UNREADABLE
    return _make_error(where, f"cannot be read: {e.strerror}", _COPY_REMEDY, code)


def _compute_digest(path: Path) -> tuple[int, int]:
    """Return the size and the CRC-32 of a file."""
    size = 0
    crc = 0
    with path.open("rb") as f:
        while chunk := f.read(_CHUNK):
            size += len(chunk)
            crc = crc32(chunk, crc)
    return size, crc


def _check_dropped(scan: scan_folder.ScanFolder) -> list[Finding]:
    """Check that the stored samples of rows without raw data are good, and that no file to be dropped is left."""
    files = scan_folder.dropped_files(scan)
    if not files:
        return []
    last = list(files.values())[-1]
    problem = f"the raw data of {len({f.row for f in files.values()})} rows was dropped after processing"
    findings = [_note("raw", f"{problem} into {last.products} ({last.dropped_utc}); digests are kept")]
    if (scan.path / scan_folder.SAMPLES).exists():
        rows_without_raw = scan_folder.dropped_rows(scan)
        remedy_of_samples = "its raw data was dropped: restore the file from a copy, or images leave it out"
        for row, names in scan_folder.find_damaged_samples(scan).items():
            problem = f"row {row} is damaged or missing (CRC)"
            findings += [_make_error(name, problem, remedy_of_samples) for name in names if row in rows_without_raw]
    else:
        findings.append(_note(scan_folder.SAMPLES, "absent: no image can be made again"))
    leftover_files = [file for file in files if (scan.path / file).exists()]
    if leftover_files:
        remedy = f"`polysight drop-raw {quote(scan.path)}` removes them"
        findings.append(_note("raw", f"{len(leftover_files)} files to be dropped are still there", remedy))
    return findings


def _find_strays(scan: scan_folder.ScanFolder, rows: dict[int, RowCommitted]) -> list[Finding]:
    """Return a note for each file in `raw` that belongs to no committed row."""
    committed_files = {scan.path / b.file for r in rows.values() for b in r.boards.values()}
    committed_files |= {p.with_suffix(suffix) for p in committed_files for suffix in (".idx", PACKETS_SUFFIX)}
    return [
        _note(str(p.relative_to(scan.path)), "belongs to no committed row", "resume replaces it")
        for p in sorted((scan.path / "raw").rglob("*"))
        if p.is_file()
        and p not in committed_files
        and p.suffix in (".bin", ".idx", PACKETS_SUFFIX, scan_folder.PART_SUFFIX)
    ]


def _check_events(scan: scan_folder.ScanFolder) -> list[Finding]:
    """Check the event log: its records, their sequence, and its digest at the last commit."""
    path = scan.path / scan_folder.EVENTS
    try:
        log = read_events(path)
    except PolysightError as e:
        return [_make_error(scan_folder.EVENTS, e.what, e.remedy)]
    findings = []
    if log.torn:
        findings.append(
            _note(scan_folder.EVENTS, "the last event is incomplete after a kill or power cut", _FETCH_REMEDY)
        )
    commits = [(fact.row, fact.events) for fact in scan.facts(RowCommitted) if fact.events is not None]
    if commits:
        row, committed = commits[-1]
    else:
        row = 0
        committed = LogDigest(0, "")
    # Damage after the last commit is only a note: a power cut may have come before those events were on the disk.
    # Where the committed bytes end is in the digest of the last commit. Rows of earlier releases and simulated rows
    # have no digest: there, any damage counts as damage of committed events.
    end_is_known = bool(commits) or not scan.facts(RowCommitted)
    commits_are_undamaged = end_is_known and log.length >= committed.bytes
    is_committed_damage = bool(log.damage) and not commits_are_undamaged
    if is_committed_damage:
        findings.append(_make_error(scan_folder.EVENTS, log.damage, _FETCH_REMEDY))
    elif log.damage:
        findings.append(_note(scan_folder.EVENTS, log.damage, _FETCH_REMEDY))
    if {e.scan_id for e in log.events} - {scan.scan_id}:
        findings.append(_make_error(scan_folder.EVENTS, "contains events of another scan"))
    if [e.seq for e in log.events] != list(range(1, len(log.events) + 1)):
        findings.append(_make_error(scan_folder.EVENTS, "the sequence of the events has gaps"))
    if commits and not is_committed_damage:
        findings += _check_committed_events(path, log.length, row, committed)
    return findings


def _check_committed_events(path: Path, length: int, row: int, committed: LogDigest) -> list[Finding]:
    """Compare the event log, whose first `length` bytes are good, with its digest at the commit of `row`."""
    size = committed.bytes
    when = f"row {row} was committed"
    if length < size:
        return [_make_error(scan_folder.EVENTS, f"{length} bytes of events, {size} when {when}", _FETCH_REMEDY)]
    with path.open("rb") as f:
        is_whole = f"{crc32(f.read(size)):08x}" == committed.crc32
    problem = f"not the events that were there when {when} (CRC)"
    if is_whole:
        return []
    return [_make_error(scan_folder.EVENTS, problem, "restore it from a copy")]
