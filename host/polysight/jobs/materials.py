"""Commands on saved products: table of materials, permittivity through layers, concentration, report.

Each prints the verdict first, and no patches if it is `none`.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from rich.cells import cell_len

from polysight.imaging import sub_bands
from polysight.jobs.output import print_json, print_lines
from polysight.materials import (
    AMPLITUDE_ERROR,
    Layer,
    Library,
    fit_concentration,
    fit_row,
    format_permittivity,
    incidence_std_rad,
    layer_content,
    read_materials,
)
from polysight.products import (
    MATERIALS,
    REPORT,
    SCAN,
    SavedProducts,
    find_products,
    permittivity_spread,
    read_products,
    refused_text,
)
from polysight.results import NoResult
from polysight.store import is_source
from polysight_shared.config import Chirp, load_instrument
from polysight_shared.errors import ConfigError, DataError

_SAME_FREQUENCY = 1e-6  # relative: far above rounding, far below any other chirp
_REASONS = 3  # of a verdict, for the terminal


def print_verdict(products: SavedProducts, to_terminal: bool = True) -> int:
    """Print the verdict of products, if they have one; return the exit status it gives: 0, or that of NoResult."""
    verdict = products.verdict
    if verdict is None:
        return 0
    if to_terminal:
        print_lines(verdict.lines(_REASONS))
    return 0 if verdict.usable else NoResult.exit_status


def _chirp(products: SavedProducts, config: Path | None) -> Chirp:
    """The chirp of the products, or that of `config` if given. Raises DataError, ConfigError."""
    rig = load_instrument(config) if config is not None else products.rig
    if rig is None:
        raise DataError(
            f"{products.folder}: no {SCAN}, which names the chirp",
            "an earlier release processed the scan",
            "process the scan again, or give its rig file: --config FILE",
        )
    return rig.chirp


def _check_bands(row: Mapping[str, Any], chirp: Chirp, source: str) -> None:
    """Raise DataError if the sub-bands of a patch are not those of this chirp."""
    recorded = [(b["first_hz"], b["last_hz"]) for b in row.get("bands") or ()]
    expected = [(b.first_hz, b.last_hz) for b in sub_bands(chirp, len(recorded))] if recorded else []
    for saved, own in zip(recorded, expected, strict=True):
        if not all(math.isclose(a, b, rel_tol=_SAME_FREQUENCY) for a, b in zip(saved, own, strict=True)):
            raise DataError(
                f"segment {row.get('label')} covers {saved[0] / 1e9:.4f} to {saved[1] / 1e9:.4f} GHz; the chirp"
                f" of {source} has that part from {own[0] / 1e9:.4f} to {own[1] / 1e9:.4f} GHz",
                "that is another rig file than the scan's",
                "leave --config out: the products bring their own",
            )


def permittivity(
    folder: Path,
    config: Path | None,
    stack: Sequence[Layer],
    segment: int | None,
    as_json: bool,
    bands: int | None = None,
    amplitude_error: float = AMPLITUDE_ERROR,
) -> int:
    """Print the permittivity of patches, as a half space or as the unknown layer of a stack; return the exit status.

    Without a result (verdict `none`) no permittivity is printed, and the exit status is that of NoResult.

    `folder` holds the products, or is the scan folder that holds them. The chirp is the one they were made with, as
    their scan.json says; `config` replaces it. With `bands` above 1 the stack is fitted to so many sub-bands of the
    sweep, which the products must hold; None takes those they hold where a thickness is fitted, else the whole sweep.
    `amplitude_error` is how far |H| may be trusted, relative; 0 leaves it out.

    Raises
    ------
    DataError
        when the folder holds no materials, not that segment, or not so many sub-bands; when nothing says with which
        chirp it was made, or its sub-bands are of another one.
    ConfigError
        when `config` cannot be read.
    NoResult
        when a stack is to be fitted to data whose verdict is `none`.
    """
    products = read_products(folder, MATERIALS)
    if stack and products.verdict is not None and not products.verdict.usable:
        raise products.verdict.error("the images are kept")
    rows = [r for r in products.segments if segment is None or r["label"] == segment]
    if not rows:
        raise DataError(f"{products.folder}: no segment {segment}", f"its number is not in {MATERIALS}")
    chirp = _chirp(products, config) if stack else None
    out: list[dict[str, Any]] = []
    for row in rows:
        found = None
        if chirp is not None and not row.get("metal_reference"):
            _check_bands(row, chirp, str(config or products.folder / SCAN))
            found = fit_row(row, chirp, stack, bands, amplitude_error, incidence_std_rad(products.materials))
        out.append({"label": row["label"], "name": row["name"], "single_interface": row["permittivity"]})
        if row.get("refused"):
            out[-1]["refused"] = row["refused"]
        if found is not None:
            out[-1]["layer"] = layer_content(found)
    if as_json:
        print_json(out)
        return print_verdict(products, to_terminal=False)
    status = print_verdict(products)
    if status == 0:
        sys.stdout.write("".join(_line(row) for row in out))
    return status


def _line(row: Mapping[str, Any]) -> str:
    head = f"{row['label']:>3}  {_padded(row['name'] or '')}"
    single = row["single_interface"]
    if row.get("refused"):
        text = f"{head} not judged: {refused_text(row)}"
    elif single is None:
        text = f"{head} metal-like: no permittivity"
    else:
        text = f"{head} one interface {_estimate(single)}"
    return (text + _in_the_stack(row.get("layer"))).rstrip() + "\n"


def _in_the_stack(layer: Mapping[str, Any] | None) -> str:
    """The fit of a layer as text, with a line for each note."""
    if layer is None:
        return ""
    real, loss = layer["permittivity"]
    text = f"   in the stack {format_permittivity(complex(real, -loss), width=6):15s}"
    text += f"  +- {layer['std_real']:.2f}, {layer['std_loss']:.2f}"
    if layer["thickness_std_mm"] is not None:
        text += f"   thickness {layer['thickness_mm']:.3f} +- {layer['thickness_std_mm']:.3f} mm"
    return text + "".join(f"\n     note: {w}" for w in layer["warnings"])


def _estimate(permittivity: Mapping[str, Any]) -> str:
    """A permittivity with the errors of both parts and their main source."""
    text = f"{format_permittivity(complex(permittivity['real'], permittivity['imag']), width=6):15s}"
    if spread := permittivity_spread(permittivity):
        text += f"  +- {spread.real_std:.2f}, {spread.loss_std:.2f}"
    main = permittivity.get("dominated_by")
    return f"{text}  mostly {main}" if main else text


def concentration(data: Path, given: Mapping[str, float], confidence: float, as_json: bool) -> int:
    """Fit concentration against polarisation angle, with leave-one-out errors; return the exit status.

    `data` is a library (.npz) or a folder of the published material files. Raises DataError.
    """
    library = read_materials(data) if data.is_dir() else Library.load(data)
    unknown = sorted(set(given) - set(library.names))
    if unknown:
        raise ConfigError(
            f"{data}: no material {unknown[0]!r}", f"it holds {', '.join(library.names)}", "correct --value"
        )
    result = fit_concentration(library, given, confidence)
    source = "simulated" if library.simulated else "measured"
    if as_json:
        content = {
            "source": source,
            "line": asdict(result.line),
            "left_out": [asdict(r) for r in result.left_out],
            "median_error_percent": result.median_error,
            "covered": result.covered,
        }
        print_json(content)
        return 0
    line = result.line
    rows = [
        f"  {r.name:30s} {r.true_percent:6.2f} %   found {r.percent:6.2f} %   {r.low:6.2f} .. {r.high:6.2f} %\n"
        for r in result.left_out
    ]
    sys.stdout.write(
        f"{source}: percent = {line.intercept:.2f} + ({np.radians(line.slope):.3f}) * angle in degrees,"
        f" {line.patches} patches\neach concentration predicted from the others:\n{''.join(rows)}"
        f"median error {result.median_error:.3f} percent by weight; the {100 * confidence:.0f} % intervals hold the"
        f" truth in {100 * result.covered:.0f} % of the patches\n"
    )
    return 0


def materials(data: Sequence[Path], as_json: bool) -> int:
    """Print names and permittivities of the patches of processed scans; return the exit status.

    That of NoResult if one of the scans has none (verdict `none`); its patches are not printed.

    Raises
    ------
    DataError
        if a folder holds no materials.
    """
    scans = [read_products(folder, MATERIALS) for folder in data]
    if as_json:
        print_json([{"products": str(s.folder), **s.materials} for s in scans])
        return max((print_verdict(s, to_terminal=False) for s in scans), default=0)
    worst = 0
    for scan in scans:
        kind = "simulated " if scan.simulated else ""
        sys.stdout.write(f"{scan.folder}: {kind}scan {scan.scan_id}\n")
        status = print_verdict(scan)
        if status == 0:
            sys.stdout.write("".join(map(_patch_line, scan.segments)))
        worst = max(worst, status)
    return worst


def _patch_line(row: dict[str, Any]) -> str:
    name = row["name"] or ("metal reference" if row.get("metal_reference") else "not named")
    drawn = f"   drawn as {row['box']}" if row.get("box") else ""
    if row.get("refused"):
        return f"{row['label']:>3}  {'not judged':24s} {refused_text(row)}{drawn}\n"
    sure = f"{100 * row['confidence']:.0f} %" if row.get("confidence") is not None else ""
    e = row.get("permittivity")
    value = _estimate(e) if e is not None else "metal-like" if row.get("metal_like") else "-"
    why = f"\n     {row['why']}" if row.get("why") else ""
    return f"{row['label']:>3}  {_padded(name)} {sure:>5s}  {value}{drawn}".rstrip() + f"{why}\n"


def _padded(name: str, width: int = 24) -> str:
    """A name as wide as a column of a terminal; Chinese characters take two places each."""
    return name + " " * max(0, width - cell_len(name))


def report(folder: Path) -> int:
    """Print where the report of a scan is; make it if it is missing. Return the exit status, also that of NoResult.

    Raises
    ------
    PolysightError
        as processing the scan does.
    """
    found = find_products(folder, REPORT)
    if found is None:
        if not is_source(folder):
            read_products(folder, REPORT)  # raises with the reason
        from polysight.jobs.process import process

        status = process(folder, folder / "products")
        made = find_products(folder, REPORT)
        return status if status or made is None else print_verdict(made, to_terminal=False)
    status = print_verdict(found)
    sys.stdout.write(f"report:   {found.folder / REPORT}\n")
    return status
