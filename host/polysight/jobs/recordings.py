"""Commands that check recordings: `validate` lists all faults of a scan folder, `inspect` describes a recording.

`inspect --placement` shows how the packets of a row are placed, `validate --replace` places all rows again. Nothing of
the processing is loaded, so that these commands start without delay.
"""

from __future__ import annotations

import io
import sys
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.capture import PACKETS_SUFFIX, CardReport, Code, Layout, Report, inspect_bin, inspect_pcap, is_pcap
from polysight.jobs.output import exit_status, print_json, print_lines
from polysight.store import (
    MANIFEST,
    PlacedAgain,
    ReplacedRow,
    ScanFolder,
    describe_damage,
    place_again,
    replace_rows,
    to_json,
    to_text,
    validate,
)
from polysight_shared.config import load_instrument
from polysight_shared.errors import DataError, ErrorCode, PolysightError
from polysight_shared.files import require_writable, write_atomically

# Largest number of missing ranges that are printed: as many fill about one line of a terminal.
_MAX_RANGES = 8
# Lowest level in the plot of a range profile, relative to the median of the profile; chosen. An antenna whose profile
# is below it everywhere gets the label "no signal".
BOTTOM_DB = -20.0


def format_report(report: Report) -> str:
    """Return the report as lines of a keyword and its values."""
    head = f"{report.path}: {report.bytes} bytes"
    if report.simulated:
        head += " of a simulated scan"
    lines = [head]
    if report.card is not None:
        lines += _format_card(report.card)
    if report.chirps:
        layout = report.layout
        first_of_pair = "Q" if layout.q_first else "I"
        rms = ", ".join(f"{counts:.0f}" for counts in report.rx_rms)
        lines += [
            f"shape      {report.chirps} chirps x {layout.rx} RX x {layout.samples} samples, {layout.lanes}-lane,"
            f" {first_of_pair} first",
            f"peak       {report.peak_db:.1f} dB over the median at bin {report.peak_bin} of {layout.samples}",
            f"level      rms {rms} counts on RX1.., DC {max(report.rx_dc):.1f}",
            f"clipping   {report.clipped} values at full scale",
            f"profile    {_draw_sparkline(report.profile_db)}",
        ]
    lines += [f"note       {remark}" for remark in report.remarks]
    return "\n".join(lines) + "\n"


def _format_card(card: CardReport) -> list[str]:
    """Return lines about a capture card: replies, refused commands, version, status, packets, and the last packet."""
    commands = ", ".join(command for command, _ in card.replies)
    lines = [f"card       {card.address}, {len(card.replies)} replies: {commands}"]
    # Replies to these two carry a value; to any other command, a status other than 0 is a refusal.
    commands_with_value = (Code.STATUS.name, Code.VERSION.name)
    refused = [command for command, status in card.replies if status and command not in commands_with_value]
    if refused:
        lines.append(f"refused    {', '.join(refused)}")
    if card.version:
        lines.append(f"FPGA       {card.version}")
    if card.status:
        lines.append(f"status     {' '.join(s.name or '?' for s in card.status)}")
    if card.record is not None:
        counts = card.record.counts
        lines.append(
            f"record     {card.record.received} of {card.record.expected} bytes in {counts.placed} packets,"
            f" {counts.duplicates} duplicates, {counts.late} late, {counts.disagreeing} disagreeing"
        )
    if card.tail_bytes:
        lines.append(f"tail       {card.tail_bytes} bytes, {card.tail_after_s:.3f} s after the packet before")
    return lines


# Width of a line of bars; chosen.
_SPARKLINE_CHARACTERS = 64


def _draw_sparkline(profile_db: NDArray[np.float64]) -> str:
    """Draw the profile as a line of bars, each as high as the maximum of its bins; negative levels are blank."""
    bars = " ▁▂▃▄▅▆▇█"
    highest = len(bars) - 1
    groups = np.array_split(profile_db, min(_SPARKLINE_CHARACTERS, profile_db.size))
    tops_db = np.array([group.max() for group in groups])
    # A recording of zeros has no level above 0.
    span_db = max(float(tops_db.max()), 1e-9)
    heights = np.clip(np.round(tops_db / span_db * highest), 0, highest).astype(int)
    return "".join(bars[height] for height in heights)


def validate_folder(folder: Path, as_json: bool) -> int:
    """Print all findings on a scan folder; return 0 if none of them is an error."""
    findings = validate(folder)
    if as_json:
        sys.stdout.write(to_json(findings) + "\n")
    else:
        sys.stdout.write("".join(f"{to_text(f)}\n" for f in findings) or f"{folder}: whole\n")
    return exit_status(not any(f.level == "error" for f in findings))


def _is_pcap(file: Path) -> bool:
    """True if the first bytes, or the file name, are those of a packet capture."""
    with file.open("rb") as f:
        return is_pcap(f.read(4)) or file.suffix == ".pcap"


def find_scan(file: Path) -> ScanFolder | None:
    """Return the scan that a row's file belongs to; None for any other file, or if the manifest cannot be read."""
    # A row's file is SCAN/raw/BOARD/ROW.bin: its parents are BOARD, raw and SCAN.
    folders = file.resolve().parents
    if len(folders) < 3 or folders[1].name != "raw" or not (folders[2] / MANIFEST).is_file():
        return None
    try:
        return ScanFolder.load(folders[2])
    except PolysightError:
        # `polysight validate` reports the problem.
        return None


def inspect_file(
    file: Path,
    config: Path | None,
    plot: Path | None,
    card_address: str,
    as_json: bool,
    changes: dict[str, Any] | None = None,
) -> int:
    """Describe a capture; return the exit status, that of DataError if all samples are 0.

    `config` is the rig file it was recorded with; for a row of a scan folder it is the scan's. `plot` is the file for a
    picture of the range profile; `card_address` chooses one card's packets of a packet capture; `changes` are fields
    of `Layout` that replace the rig's. Raises PolysightError, and OSError if the picture cannot be written.
    """
    if plot is not None:
        require_writable(plot)
    scan = find_scan(file)
    layout = Layout()
    if config is not None:
        layout = Layout(samples=load_instrument(config).chirp.samples)
    elif scan is not None:
        layout = Layout(samples=scan.instrument.chirp.samples)
    layout = replace(layout, **(changes or {}))
    if file.is_file() and _is_pcap(file):
        report = inspect_pcap(file, layout, card_address)
    else:
        report = inspect_bin(file, layout)
    report.simulated = scan is not None and scan.simulated
    if as_json:
        from polysight.results import to_plain

        content = asdict(report)
        # In JSON the fields of the layout are on the same level as the others, not in an inner object.
        content |= content.pop("layout")
        print_json(to_plain(content))
    else:
        sys.stdout.write(format_report(report))
    if plot is not None:
        plot_profile(report, plot)
        sys.stderr.write(f"range profile: {plot}\n")
    if report.chirps and not any(report.rx_rms):
        return DataError.exit_status
    return 0


def plot_profile(report: Report, path: Path) -> None:
    """Write the range profile, every antenna and their mean, as a PNG.

    Raises
    ------
    DataError
        when the recording holds no chirp.
    OSError
        when the file cannot be written; nothing is there then.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    if not report.profile_db.size:
        raise DataError(f"{report.path}: no chirp to plot", "the recording contains no data", "record again")
    figure = Figure(figsize=(8.0, 4.5), layout="constrained")
    # The canvas attaches itself to the figure, and draws without a display.
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for rx, profile in enumerate(report.rx_profile_db, 1):
        label = f"RX{rx}"
        if profile.max() < BOTTOM_DB:
            label += " (no signal)"
        axes.plot(profile, linewidth=0.8, label=label)
    axes.plot(report.profile_db, color="black", linewidth=1.4, label="mean")
    axes.axvline(report.peak_bin, color="grey", linestyle=":", linewidth=1.0)
    axes.set_xlabel(f"range bin of {report.layout.samples} samples")
    axes.set_ylabel("power over the median [dB]")
    name = report.path.name
    if report.simulated:
        name = f"simulated {name}"
    axes.set_title(f"{name}: {report.chirps} chirps, peak {report.peak_db:.1f} dB at bin {report.peak_bin}")
    axes.set_ylim(bottom=BOTTOM_DB)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small", ncols=5)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    write_atomically(path, buffer.getvalue())


# --- placement of packets ---


def inspect_placement(file: Path, as_json: bool) -> int:
    """Print how the packets of a row are placed; return 1 if the row was committed with other missing ranges.

    A row whose frames were placed by the times of their pulses is not compared, and gives 0. `file` is the row's file,
    or one of those next to it. Raises DataError when a file is damaged, is not the one that the scan's manifest has
    committed, or the packets were not kept.
    """
    row = file.with_suffix(".bin")
    if scan := find_scan(row):
        if damage := describe_damage(scan, row):
            raise DataError(
                f"{row}: {damage}", "a damaged file, or one of another row", "`polysight validate SCAN`",
                code=ErrorCode.FILE_DAMAGED,
            )  # fmt: skip
        if not row.with_suffix(PACKETS_SUFFIX).exists():
            raise DataError(
                f"{row}: its packets were not kept",
                "the scan was simulated without cards, or recorded by an older release",
                "`polysight validate SCAN` shows whether it is complete",
            )
    result = place_again(row)
    # Packets are placed by their byte counts here. Frames that were placed by their pulses lie elsewhere, and their
    # missing ranges cannot be compared.
    is_same = result.by_pulses or result.missing_before == result.placed.missing
    if as_json:
        print_json({**result.placed.facts(), "committed_missing": result.missing_before, "same": is_same})
    else:
        sys.stdout.write("\n".join(_format_placement(file, result, is_same)) + "\n")
    return exit_status(is_same)


def _format_placement(file: Path, result: PlacedAgain, is_same: bool) -> list[str]:
    """Return lines about the placement of a row's packets; `is_same` says if the row was committed with this placement.

    The line `start` says if the card's packet and byte counts at the row's first byte are known, the line `located` if
    the place of each byte is certain.
    """
    placed = result.placed
    evidence = result.evidence
    counts = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in vars(placed.counts).items() if n)
    start = "known from the record before, or from a reset"
    if evidence.past.start is None:
        start = "not known from the records before"
    missing = ", ".join(f"{first}..{end}" for first, end in placed.missing[:_MAX_RANGES])
    if len(placed.missing) > _MAX_RANGES:
        missing += ", ..."
    if placed.located:
        located = "yes"
    else:
        located = f"no: {placed.reason}"
    lines = [
        f"{file}: {placed.received} of {placed.expected} bytes in place",
        f"packets    {counts or 'none'}",
        f"start      {start}",
        f"located    {located}",
        f"missing    {missing or 'nothing'}",
    ]
    if evidence.dropped_by_card:
        lines.append(f"card       dropped data before numbering it ({evidence.dropped_by_card})")
    if result.by_pulses:
        lines.append("committed  with its frames at their pulses")
    elif is_same:
        lines.append("committed  the same")
    else:
        lines.append("committed  differently: `polysight validate SCAN --replace` commits it as it is here")
    return lines


def replace_folder(folder: Path, as_json: bool) -> int:
    """Repeat the placement of all rows of a scan and commit changed rows; return 0 if no row is damaged."""
    rows = replace_rows(ScanFolder.load(folder))
    if as_json:
        print_json([asdict(r) for r in rows])
    else:
        print_lines(_list_replaced_lines(folder, rows))
    return exit_status(not any(r.damaged for r in rows))


def _list_replaced_lines(folder: Path, rows: list[ReplacedRow]) -> list[str]:
    """Return lines about rows that changed, rows that were left, and the number of equal ones."""
    changed_rows = [
        f"row {r.row} of {r.board}: {r.missing_before} bytes missing before, {r.missing_after} now"
        for r in rows
        if r.changed
    ]
    unchanged = [f"row {r.row} of {r.board}: not changed: {r.why_unchanged}" for r in rows if r.why_unchanged]
    unchanged_rows = sum(not (r.changed or r.why_unchanged) for r in rows)
    return [
        *changed_rows,
        *unchanged,
        f"{folder}: {unchanged_rows} of {len(rows)} files have the same result as when they were committed",
    ]
