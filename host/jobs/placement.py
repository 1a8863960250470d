"""Placement of packets in rows: `inspect --placement` shows one row, `validate --replace` places all rows again."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path

from polysight.host.capture import PACKETS
from polysight.host.jobs.look import scan_of
from polysight.host.store import PlacedAgain, Replaced, ScanFolder, damage_of, place_again, replace_rows
from polysight.shared.error_codes import ErrorCode
from polysight.shared.errors import DataError

_SHOWN = 8


def inspect_placement(file: Path, as_json: bool) -> int:
    """Say how a row's packets are placed by this program; 0 when that is how the row was committed.

    `file` is the row's file, or one of those beside it. Raises DataError when a file is damaged, or is not the one that
    the scan's manifest has committed.
    """
    row = file.with_suffix(".bin")
    if scan := scan_of(row):
        if strange := damage_of(scan, row):
            why, remedy = "a damaged file, or one of another row", "`polysight validate SCAN`"
            raise DataError(f"{row}: {strange}", why, remedy, code=ErrorCode.FILE_DAMAGED)
        if not row.with_suffix(PACKETS).exists():
            why = "the scan was simulated without cards, or recorded by an older release"
            raise DataError(
                f"{row}: its packets were not kept", why, "`polysight validate SCAN` says whether it is whole"
            )
    again = place_again(row)
    same = again.moved or again.missing == again.placed.missing
    if as_json:
        said = {**again.placed.facts(), "committed_missing": again.missing, "same": same}
        sys.stdout.write(json.dumps(said, indent=1) + "\n")
    else:
        sys.stdout.write("\n".join(_lines(file, again, same)) + "\n")
    return 0 if same else 1


def _lines(file: Path, again: PlacedAgain, same: bool) -> list[str]:
    p, e = again.placed, again.evidence
    counts = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in vars(p.counts).items() if n)
    if e.past.base is None:
        start = "not known from the records before"
    elif len(e.past.ends) == 1:
        start = "known from the record before"
    else:
        start = f"one of {len(e.past.ends)} places behind the record before"
    missing = ", ".join(f"{a}..{b}" for a, b in p.missing[:_SHOWN]) + (", ..." if len(p.missing) > _SHOWN else "")
    lines = [
        f"{file}: {p.received} of {p.expected} bytes in place",
        f"packets    {counts or 'none'}",
        f"start      {start}",
        f"located    {'yes' if p.located else f'no: {p.reason}'}",
        f"missing    {missing or 'nothing'}",
    ]
    if e.dropped_by_card:
        lines.append(f"card       dropped data before numbering it ({e.dropped_by_card})")
    if again.moved:
        lines.append("committed  with its frames at their pulses")
    else:
        told = "the same" if same else "differently: `polysight validate SCAN --replace` commits it as it is here"
        lines.append(f"committed  {told}")
    return lines


def replace_folder(folder: Path, as_json: bool) -> int:
    """Place every row of a scan again, and commit those that come out differently; 0 when all could be looked at."""
    rows = replace_rows(ScanFolder.load(folder))
    if as_json:
        sys.stdout.write(json.dumps([asdict(r) for r in rows], indent=1) + "\n")
    else:
        sys.stdout.write("".join(f"{line}\n" for line in _told(folder, rows)))
    return 1 if any(r.damaged for r in rows) else 0


def _told(folder: Path, rows: list[Replaced]) -> list[str]:
    lines = [f"row {r.row} of {r.board}: {r.before} bytes missing before, {r.after} now" for r in rows if r.changed] + [
        f"row {r.row} of {r.board}: left as it is: {r.left}" for r in rows if r.left
    ]
    same = sum(not (r.changed or r.left) for r in rows)
    return [*lines, f"{folder}: {same} of {len(rows)} files come out as they were committed"]
