"""`polysight check`: the check plate of one or many scans against its known permittivity, and its control chart."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from polysight.catalogue import Scans
from polysight.jobs.output import print_json, print_lines
from polysight.products import ProcessedScan, find_products, read_products
from polysight.results import WARNING_SIGMAS, CheckResult, check_plate, to_plain
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError
from polysight_shared.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    """Return the scans with a check plate in these folders; those of a folder of scans oldest first.

    Raises
    ------
    ConfigError
        if a scan that was named has no check plate.
    DataError
        if there is no processed scan with a check plate.
    """
    checked = []
    for folder in folders:
        if find_products(folder) is not None:
            scan = read_products(folder)
            checked.append((scan, check_scan(scan)))
            continue
        for summary in reversed(Scans(folder).list()):
            scan_below = find_products(folder / summary.name)
            if scan_below is not None and scan_below.rig is not None and scan_below.rig.check.name:
                checked.append((scan_below, check_scan(scan_below)))
    if not checked:
        raise DataError(
            "no processed scan with a check plate", "nothing was processed, or no rig file names a plate",
            "`polysight process SCAN --out DIR`; docs/how-to/check-plate.md", code=ErrorCode.NO_DATA,
        )  # fmt: skip
    return checked


def check(folders: Sequence[Path], chart: Path | None, as_json: bool) -> int:
    """Print the check plate of each scan, and draw the control chart; return 1 if one is beyond its limit or missing.

    Raises PolysightError as :func:`check_scans`.
    """
    checked = check_scans(folders)
    if chart is not None:
        from matplotlib.figure import Figure

        fig = Figure(figsize=CHART_IN, dpi=DOTS_PER_INCH, layout="constrained")
        draw_control_chart(fig, checked)
        buffer = io.BytesIO()
        fig.savefig(buffer, format="png")
        write_atomically(chart, buffer.getvalue())
    if as_json:
        print_json([{"scan_id": scan.scan_id, **to_plain(result)} for scan, result in checked])
    else:
        print_lines([_describe(scan, result) for scan, result in checked])
    return int(any(result.level in ("action", "missing") for _, result in checked))


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


def draw_control_chart(fig: Figure, checked: Sequence[tuple[ProcessedScan, CheckResult]]) -> None:
    """Draw real part and loss of the check plate over the scans, with the known value and its limits."""
    axes = fig.subplots(2, 1, sharex=True)
    names = []
    measured = []
    errors = []
    for scan, result in checked:
        if result.measured and result.measured_std:
            names.append(scan.scan_id)
            measured.append(result.measured)
            errors.append([WARNING_SIGMAS * std for std in result.measured_std])
    # The known value and its band are those of the latest scan.
    _, latest = checked[-1]
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
    stamp = " (simulated)" if any(scan.simulated is not False for scan, _ in checked) else ""
    fig.suptitle(f"Check plate {latest.name}{stamp}: bars and band hold 95 % of good scans", fontsize=11)
