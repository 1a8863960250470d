"""Commands on existing scans, as on the operator's page: scans, note, ask, probe, compare, check; and drop-raw."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
from msgspec import UNSET

from polysight import store
from polysight.acquisition import BADGES, STATES, ScanCommand, send_command
from polysight.catalogue import (
    Notes,
    PermittivityDifference,
    Scans,
    Summary,
    change_notes,
    compare,
    folder_bytes,
    is_scan,
    probe,
    read_notes,
    remove_unprintable,
)
from polysight.jobs.output import confirm, print_json, print_lines
from polysight.materials import UNKNOWN
from polysight.products import (
    QUALITY,
    REPORT,
    ProcessedScan,
    find_products,
    format_ranges,
    lock_products,
    read_products,
    write_json,
)
from polysight.results import WARNING_SIGMAS, CheckResult, ComplexNumber, RawDropped, check_plate, read_object, to_plain
from polysight_shared.errors import ConfigError, DataError, ErrorCode, make_missing_path_error, quote
from polysight_shared.files import require_writable, write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_NAME_WIDTH = 40
"""Largest width of the column of names. A longer name does not widen the column."""


def scans(root: Path, tags: list[str], text: str, as_json: bool) -> int:
    """Print the scans under a folder that have all tags and contain the text, the newest first; return 0.

    Raises DataError when there is no such folder.
    """
    if not root.is_dir():
        raise make_missing_path_error(root)
    catalogue = Scans(root)
    not_listed = ""
    if left_out := catalogue.list_left_out():
        not_listed = f"; not listed, because they are links or have unprintable names: {', '.join(left_out)}"
    matching = [
        summary
        for summary in catalogue.list()
        if set(tags) <= set(summary.tags) and text.casefold() in _join_searchable_text(summary)
    ]
    if as_json:
        rows = [msgspec.to_builtins(summary) | {"bytes": _count_bytes(root, summary)} for summary in matching]
        print_json({"scans": rows})
        return 0
    width = min(max((len(summary.name) for summary in matching), default=0), _NAME_WIDTH)
    for summary in matching:
        line = remove_unprintable(_format_summary(summary))
        sys.stdout.write(f"{summary.name:{width}}  {_count_bytes(root, summary) / 1e6:8.1f} MB  {line}\n")
    noun = "scan" if len(matching) == 1 else "scans"
    sys.stdout.write(f"{len(matching)} {noun} under {root}{not_listed}\n")
    return 0


def _count_bytes(root: Path, summary: Summary) -> int:
    """Return the size on the disk; 0 for a folder that does not answer."""
    if summary.state == "silent":
        return 0
    return folder_bytes(root / summary.name)


def _format_summary(summary: Summary) -> str:
    """Format state, rows, verdict, materials and tags of a scan."""
    words, _ = BADGES[summary.state]
    parts = [words]
    if summary.rows:
        parts.append(f"{summary.committed}/{summary.rows} rows")
    parts.append(summary.verdict)
    if summary.images_only:
        parts.append("images only")
    parts.append(", ".join(map(_format_name, summary.materials)))
    if summary.simulated:
        parts.append("simulated")
    parts.append(" ".join(f"#{tag}" for tag in summary.tags))
    if summary.state == "failed" and not summary.rows:
        parts.append(summary.reason)
    return "  ".join(part for part in parts if part)


def _join_searchable_text(summary: Summary) -> str:
    """Return the text in which a search looks for words: fields of the summary, in small letters."""
    return " ".join(
        (summary.name, summary.scan_id, summary.rig, summary.state, summary.notes, *summary.tags, *summary.materials)
    ).casefold()


def note(folder: Path, text: str | None, add: list[str], remove: list[str]) -> int:
    """Change or print the operator's notes and tags of a scan; returns 0. Raises PolysightError."""
    if not folder.is_dir():
        raise make_missing_path_error(folder)
    if not (is_scan(folder) or store.is_source(folder)):
        raise DataError(
            f"{folder}: contains no scan", "notes belong to a scan; nothing was recorded or processed in this folder",
            "give the folder of a scan or of products; polysight scans FOLDER lists those under a folder",
            code=ErrorCode.FILE_MISSING,
        )  # fmt: skip

    def change(present: Notes) -> Notes:
        tags = tuple(t for t in dict.fromkeys((*present.tags, *add)) if t not in remove)
        return Notes(present.notes if text is None else text, tags)

    if text is not None or add or remove:
        notes = change_notes(folder, change)
    else:
        notes = read_notes(folder)
    lines = [f"tags: {', '.join(notes.tags) or 'none'}"]
    if notes.notes:
        lines.insert(0, notes.notes)
    sys.stdout.write(remove_unprintable("\n".join(lines), keep="\n") + "\n")
    return 0


def ask_scan(folder: Path, request: str) -> int:
    """Send pause, continue, stop or abort to a running scan; return 0 when it is received. Raises PolysightError."""
    if not folder.is_dir():
        raise make_missing_path_error(folder)
    send_command(folder, ScanCommand(request), "polysight ask")
    states = {"pause": "pausing", "continue": "rows", "stop": "stopping", "abort": "aborting"}
    state = STATES[states[request]]
    words = state.headline if request != "continue" else "The scan continues"
    sys.stdout.write(f"{folder}: heard {request}: {words}\n")
    return 0


def probe_scan(folder: Path, place_mm: tuple[float, float], library: Path | None, as_json: bool) -> int:
    """Print the results of a processed scan at one place; return 0. Raises DataError."""
    result = probe(folder, *place_mm, library)
    if as_json:
        print_json(to_plain(result))
        return 0
    lines = [f"x {result.place_mm[0]:zg} mm, y {result.place_mm[1]:zg} mm from the image's centre"]
    if not result.lit:
        lines.append("the scan does not illuminate this position")
    lines.append(f"|H| {_format_value(result.h_db)} dB, |V| {_format_value(result.v_db)} dB")
    lines.append(f"P = {_format_complex(result.p)} {_format_error(result.p_sigma)}")
    if result.permittivity:
        errors = f"+- {result.permittivity_real_std:.3g} (real part), {result.permittivity_loss_std:.3g} (loss)"
        lines.append(f"permittivity {_format_complex(result.permittivity)} {errors}, as a half space")
    else:
        lines.append(f"no permittivity: {result.why}")
    if result.patch is not None:
        name = "the metal reference" if result.patch.metal_reference else _format_name(result.patch.name)
        lines.append(f"in patch {result.patch.label}: {name}")
    lines += [f"  {n.sigmas:g} standard deviations from {n.name}" for n in result.nearest]
    lines.append(result.profile_why or "range profile: --json")
    sys.stdout.write("".join(f"{remove_unprintable(line)}\n" for line in lines))
    return 0


def compare_scans(first: Path, second: Path, picture: Path | None, as_json: bool) -> int:
    """Print the differences of two processed scans; returns 0. Raises DataError, and OSError for the picture."""
    if picture is not None:
        require_writable(picture)
    comparison = compare(first, second)
    values = comparison.figures
    if picture is not None:
        from polysight.catalogue import draw_comparison

        write_atomically(picture, draw_comparison(comparison, "sigmas").png)
        sys.stderr.write(f"picture: {picture}\n")
    if as_json:
        print_json(to_plain(values))
        return 0
    lines = [f"{first} minus {second}: {values.compared} pixels", *(f"note: {n}" for n in values.notes)]
    if values.significant_share is not None:
        share = f"{100 * values.significant_share:.1f} %"
        lines.append(f"P differs by more than {values.significant_sigmas:g} standard deviations in {share} of them")
    for pair in values.patches:
        names = " and ".join(map(_format_name, pair.names))
        place_text = f"x {pair.place_mm[0]:zg}, y {pair.place_mm[1]:zg} mm ({names})"
        if pair.difference is None:
            lines.append(f"{place_text}: no permittivity in one of them")
            continue
        line = f"{place_text}: permittivity differs by {_format_complex(pair.difference)}"
        if pair.sigmas is not None:
            line += f": {pair.sigmas:g} standard deviations"
        lines.append(line)
    sys.stdout.write("".join(f"{remove_unprintable(line)}\n" for line in lines))
    return 0


def _format_name(name: str | None) -> str:
    """Return a material's name in the form for people."""
    if name == UNKNOWN:
        return "not in the library"
    return name or "not named"


def _format_error(std: float | None) -> str:
    """Format the standard error of a complex number."""
    if std is None:
        return "(its error is not known)"
    return f"+- {std:.3g} (real and imaginary part)"


def _format_value(value: float | None) -> str:
    """Format a number with three digits; None as not known."""
    if value is None:
        return "not known"
    # z: no sign before a rounded zero.
    return f"{value:z.3g}"


def _format_complex(number: ComplexNumber | PermittivityDifference) -> str:
    """Format a number as `3.1 - 0.2j`."""
    if number.real is None or number.imag is None:
        return "not known"
    sign = "-" if number.imag < 0 else "+"
    return f"{number.real:z.3g} {sign} {abs(number.imag):.3g}j"


# Word that a person types to confirm the removal of raw rows.
CONFIRMATION_WORD = "drop"


def drop_raw(folder: Path, products: Path | None, yes: bool) -> int:
    """Delete the raw data of processed rows after confirmation; return the exit status.

    Products with a report and undamaged samples of every dropped row must remain, and no other program may be writing
    them.

    Raises
    ------
    DataError
        when products or samples are not complete, or the products were not made from rows of this scan.
    ConfigError
        when it is not confirmed, or products are being written; nothing was removed.
    DeviceError
        when the scan is being processed or recorded.
    """
    scan = store.ScanFolder.load(folder)
    payloads = [scan.path / board.file for row in scan.committed_rows().values() for board in row.boards.values()]
    if store.dropped_rows(scan) and not any(path.exists() for path in payloads):
        sys.stdout.write(f"{folder}: every processed row is dropped already\n")
        return 0
    products = read_products(products or folder, REPORT).folder
    with lock_products(products), store.lock_samples(scan):
        return _confirm_and_drop(scan, folder, products, yes)


def _confirm_and_drop(scan: store.ScanFolder, folder: Path, products: Path, yes: bool) -> int:
    """List the files, ask for confirmation, and delete them; return the exit status.

    Raises DataError if there is nothing to delete, ConfigError if it is not confirmed.
    """
    processed = find_processed_digests(products)
    rows = store.find_droppable(scan, processed)
    for line in rows.kept_files:
        sys.stdout.write(f"kept: {line}\n")
    if not rows.files:
        if rows.kept_files:
            raise DataError(
                f"{folder}: nothing can be dropped",
                f"{products} was made from none of its rows",
                f"`polysight process {quote(folder)} --out DIR`, then --products DIR",
            )
        sys.stdout.write(f"{folder}: every processed row is dropped already\n")
        return 0
    _check_samples(scan, set(rows.files))
    text = (
        f"{folder}: the raw data of {len(rows.files)} rows, {rows.bytes / 1e6:.1f} MB, is removed. {products} and"
        " the kept samples stay: images and materials can be made again, but not synchronised again."
    )
    paths = [path for boards in rows.files.values() for path in boards.values()]
    for folder_of_board in sorted({path.parent for path in paths}):
        indices = sorted(int(path.stem) for path in paths if path.parent == folder_of_board)
        files = f"{format_ranges(indices)} ({len(indices)} files)"
        sys.stdout.write(f"to be removed: {folder_of_board.relative_to(folder)}: rows {files}\n")
    answer = confirm(text, CONFIRMATION_WORD, yes)
    if answer != CONFIRMATION_WORD:
        raise ConfigError(
            f"nothing was deleted: the answer was {answer!r}",
            f"the answer was not {CONFIRMATION_WORD!r}",
            f"type {CONFIRMATION_WORD}, or give --yes",
        )
    _mark_as_only_data(products, scan)
    store.drop(scan, processed, products)
    sys.stdout.write(f"{folder}: dropped; its digests stay in the manifest\n")
    return 0


def _check_samples(scan: store.ScanFolder, rows: set[int]) -> None:
    """Check that images can be made without the raw data of these rows. Raises DataError."""
    damaged = {row: names for row, names in store.find_damaged_samples(scan).items() if row in rows}
    if not damaged:
        from polysight.pipeline import Pipeline

        samples = Pipeline(scan, samples="read").samples
        damaged = {row: ["samples/samples.json: other settings"] for row in rows if not samples.is_kept(row)}
    if damaged:
        names = sorted({name for files in damaged.values() for name in files})
        raise DataError(
            f"{scan.path}: samples of rows {format_ranges(sorted(damaged))} are damaged or missing: {', '.join(names)}",
            "without these samples images can be made from the raw data only",
            f"`polysight process {quote(scan.path)} --out DIR` makes them again",
            code=ErrorCode.FILE_DAMAGED,
        )


def _mark_as_only_data(products: Path, scan: store.ScanFolder) -> None:
    """Mark the products as the only remaining data of the scan, so that they are never overwritten."""
    mark = RawDropped(scan_id=scan.scan_id, scan=str(scan.path.resolve()), dropped_utc=store.utc_now())
    # The file is changed as a plain object, not as a struct, so that keys of later releases are kept.
    content = read_object(products / QUALITY) or {}
    write_json(products / QUALITY, {**content, "raw_dropped": mark})


def find_processed_digests(folder: Path) -> store.Digests:
    """Return the CRCs of the processed rows, by board. Raises DataError."""
    products = read_products(folder)
    # Reading the images raises an error if they are damaged.
    _ = products.images
    boards = products.quality.boards
    digests = {name: board.raw_crc32 for name, board in boards.items() if board.raw_crc32 is not UNSET}
    if not digests or len(digests) < len(boards):
        raise DataError(
            f"{products.folder / QUALITY}: does not state from which data it was made",
            "made by an earlier release, or from another program's recordings",
            "`polysight process SCAN --out DIR` makes it again",
        )
    return digests


# --- check plates, and their control chart ---

# Size of the chart in inches, and its pixels per inch; chosen.
CHART_IN = (8.0, 5.0)
DOTS_PER_INCH = 120


def check_scan(scan: ProcessedScan) -> CheckResult:
    """Compare the check plate of a processed scan with its known permittivity.

    Raises
    ------
    ConfigError
        if its rig file is not known, or names no check plate.
    """
    result = None
    if scan.rig is not None:
        result = check_plate(scan.rig.check, scan.segments)
    if result is None:
        raise ConfigError(
            f"scan {scan.scan_id}: its rig file names no check plate",
            "[check] name is empty",
            "name a plate of known permittivity there, and lay it at the same place in every scan"
            " (docs/how-to/check-plate.md)",
            code=ErrorCode.KEY_MISSING,
        )
    return result


def check_scans(folders: Sequence[Path]) -> list[tuple[ProcessedScan, CheckResult]]:
    """Return the scans with a check plate in these folders; scans below one folder come oldest first.

    Raises
    ------
    ConfigError
        if a scan that was named has no check plate.
    DataError
        if there is no processed scan with a check plate.
    """
    checked_scans = []
    for folder in folders:
        if find_products(folder) is not None:
            scan = read_products(folder)
            checked_scans.append((scan, check_scan(scan)))
            continue
        for summary in reversed(Scans(folder).list()):
            scan_below = find_products(folder / summary.name)
            if scan_below is not None and scan_below.rig is not None and scan_below.rig.check.name:
                checked_scans.append((scan_below, check_scan(scan_below)))
    if not checked_scans:
        raise DataError(
            "no processed scan with a check plate", "nothing was processed, or no rig file names a plate",
            "`polysight process SCAN --out DIR`; docs/how-to/check-plate.md", code=ErrorCode.NO_DATA,
        )  # fmt: skip
    return checked_scans


def check(folders: Sequence[Path], chart: Path | None, as_json: bool) -> int:
    """Print the check plate of each scan, and draw the control chart into the file `chart`, if given.

    Return 1 if a plate is missing or beyond its action limit.
    Raises PolysightError as :func:`check_scans`, and OSError if the chart cannot be written.
    """
    if chart is not None:
        require_writable(chart)
    checked_scans = check_scans(folders)
    if chart is not None:
        from matplotlib.figure import Figure

        fig = Figure(figsize=CHART_IN, dpi=DOTS_PER_INCH, layout="constrained")
        draw_control_chart(fig, checked_scans)
        buffer = io.BytesIO()
        fig.savefig(buffer, format="png")
        write_atomically(chart, buffer.getvalue())
    if as_json:
        print_json([{"scan_id": scan.scan_id, **to_plain(result)} for scan, result in checked_scans])
    else:
        print_lines([_describe(scan, result) for scan, result in checked_scans])
    return int(any(result.level in ("action", "missing") for _, result in checked_scans))


def _describe(scan: ProcessedScan, result: CheckResult) -> str:
    """Return the check plate of a scan as a line: measured and known permittivity, distance and level."""
    stamp = " (simulated)" if scan.simulated else ""
    head = f"{scan.scan_id}{stamp}: {result.name}"
    if result.measured is None or result.measured_std is None:
        return f"{head} missing: {result.why}"
    real, loss = result.measured
    real_std, loss_std = result.measured_std
    return (
        f"{head} {real:.3f} +- {real_std:.3f}, loss {loss:.3f} +- {loss_std:.3f}; known {result.expected[0]:g},"
        f" {result.expected[1]:g}; {result.sigmas:.1f} standard deviations: {result.level}"
    )


def draw_control_chart(fig: Figure, checked_scans: Sequence[tuple[ProcessedScan, CheckResult]]) -> None:
    """Draw real part and loss of the check plate over the scans, and the known value.

    Bars of the scans and the band of the known value are `WARNING_SIGMAS` standard deviations to either side. A scan's
    level is that of its distance in both parts together, which the chart does not show.
    """
    axes = fig.subplots(2, 1, sharex=True)
    names = []
    measured = []
    errors = []
    for scan, result in checked_scans:
        if result.measured and result.measured_std:
            names.append(scan.scan_id)
            measured.append(result.measured)
            errors.append([WARNING_SIGMAS * std for std in result.measured_std])
    # The known value and its band are those of the latest scan.
    _, latest = checked_scans[-1]
    for part, (ax, title) in enumerate(zip(axes, ("real part", "loss"), strict=True)):
        values = [value[part] for value in measured]
        bars = [error[part] for error in errors]
        ax.errorbar(range(len(values)), values, yerr=bars, fmt="o", capsize=3)
        expected = latest.expected[part]
        limit = WARNING_SIGMAS * latest.expected_std[part]
        ax.axhline(expected, color="black", linewidth=1)
        ax.axhspan(expected - limit, expected + limit, color="green", alpha=0.15)
        ax.set_ylabel(title)
    axes[-1].set_xticks(range(len(names)), names, rotation=30, ha="right", fontsize=8)
    # A scan that does not say whether it was simulated may be: the chart is marked.
    stamp = " (simulated)" if any(scan.simulated is not False for scan, _ in checked_scans) else ""
    title = f"Check plate {latest.name}{stamp}: bars and band are ± {WARNING_SIGMAS} standard deviations"
    fig.suptitle(title, fontsize=11)
