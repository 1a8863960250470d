"""Commands on materials that were found already: permittivity through layers, and concentration."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from polysight.host.imaging.images import sub_bands
from polysight.host.materials import Library
from polysight.host.materials.concentration import fit_concentration
from polysight.host.materials.layers import Layer, LayerFit, fit_layer
from polysight.host.materials.published import read_materials
from polysight.host.materials.sub_bands import AMPLITUDE_ERROR, bands_of_row
from polysight.host.products.files import MATERIALS, SCAN, SavedProducts, read_products
from polysight.shared.config import Chirp, load_instrument
from polysight.shared.errors import ConfigError, DataError

LAST = "?"
_SAME_FREQUENCY = 1e-6  # relative: far above rounding, far below any other chirp


def parse_layer(text: str) -> Layer:
    """`name,eps',eps'',mm` of a known layer, `name,?,mm` of the unknown one; without mm a half space.

    Raises ValueError when it has another form.
    """
    parts = [p.strip() for p in text.split(",")]
    unknown = len(parts) in (2, 3) and parts[1] == LAST
    numbers = [float(p) for p in parts[2 if unknown else 1 :]]
    if not unknown and len(numbers) not in (2, 3):
        raise ValueError(text)
    thickness = numbers[-1] / 1e3 if len(numbers) == (1 if unknown else 3) else None
    if thickness is not None and thickness <= 0:
        raise ValueError(text)
    return Layer(parts[0], None if unknown else complex(numbers[0], -numbers[1]), thickness)


def _chirp(products: SavedProducts, config: Path | None) -> Chirp:
    """The chirp the products were made with; that of `config` when it is given. Raises DataError, ConfigError."""
    chirp = load_instrument(config).chirp if config is not None else products.chirp
    if chirp is None:
        raise DataError(
            f"{products.folder}: no {SCAN}, which names the chirp",
            "an earlier release processed the scan",
            "process the scan again, or give its rig file: --config FILE",
        )
    return chirp


def _check_bands(row: Mapping[str, Any], chirp: Chirp, source: str) -> None:
    """Refuse a patch whose sub-bands are no parts of this chirp. Raises DataError."""
    recorded = [(b["first_hz"], b["last_hz"]) for b in row.get("bands") or ()]
    expected = [(b.first_hz, b.last_hz) for b in sub_bands(chirp, len(recorded))] if recorded else []
    for told, own in zip(recorded, expected, strict=True):
        if not all(math.isclose(a, b, rel_tol=_SAME_FREQUENCY) for a, b in zip(told, own, strict=True)):
            raise DataError(
                f"segment {row.get('label')} was imaged from {told[0] / 1e9:.4f} to {told[1] / 1e9:.4f} GHz; the chirp"
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
    bands: int = 1,
    amplitude_error: float = AMPLITUDE_ERROR,
) -> int:
    """Permittivity of patches, as one interface or as the unknown layer of a stack; returns the exit status.

    `folder` holds the products, or is the scan folder that holds them. The chirp is the one they were made with, as
    their scan.json says; `config` replaces it. With `bands` above 1 the stack is fitted to so many sub-bands of the
    sweep, which the products must hold. `amplitude_error` is how far |H| may be trusted, relative; 0 leaves it out.

    Raises
    ------
    DataError
        when the folder holds no materials, not that segment, or not so many sub-bands; when nothing says with which
        chirp it was made, or its sub-bands are of another one.
    ConfigError
        when `config` cannot be read.
    """
    products = read_products(folder, MATERIALS)
    rows = [r for r in products.segments if segment is None or r["label"] == segment]
    if not rows:
        raise DataError(f"{products.folder}: no segment {segment}", f"its number is not in {MATERIALS}")
    chirp = _chirp(products, config) if stack else None
    out: list[dict[str, Any]] = []
    for row in rows:
        found = None
        if chirp is not None and not row.get("metal_reference"):
            _check_bands(row, chirp, str(config or products.folder / SCAN))
            data = bands_of_row(row, chirp, bands, amplitude_error)
            found = fit_layer(data, stack, float(np.radians(row["incidence_deg"]))) if data else None
        out.append({"label": row["label"], "name": row["name"], "single_interface": row["permittivity"]})
        if found is not None:
            out[-1]["layer"] = _layer_row(found)
    if as_json:
        sys.stdout.write(json.dumps(out, indent=1) + "\n")
    else:
        sys.stdout.write("".join(_line(row) for row in out))
    return 0


def _layer_row(fit: LayerFit) -> dict[str, Any]:
    flat = asdict(replace(fit, rivals=()))
    flat["permittivity"] = [fit.permittivity.real, -fit.permittivity.imag]
    flat["rivals"] = [[r.permittivity.real, -r.permittivity.imag] for r in fit.rivals]
    return flat | {"warnings": fit.warnings()}


def _line(row: Mapping[str, Any]) -> str:
    head = f"{row['label']:>3}  {row['name'] or '':24s}"
    single = row["single_interface"]
    if single is None:
        return f"{head} metal-like: no permittivity\n"
    text = f"{head} one interface {single['real']:6.2f} - j{-single['imag']:5.2f}"
    if single.get("real_std") is not None:
        text += f"  +- {single['real_std']:.2f}"
    layer = row.get("layer")
    if layer is not None:
        real, loss = layer["permittivity"]
        text += f"   in the stack {real:6.2f} - j{loss:5.2f}  +- {layer['std_real']:.2f}, {layer['std_loss']:.2f}"
        text += "".join(f"\n     note: {w}" for w in layer["warnings"])
    return text + "\n"


def concentration(data: Path, given: Mapping[str, float], confidence: float, as_json: bool) -> int:
    """Line from polarisation angle to concentration, judged with each concentration left out; the exit status.

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
        sys.stdout.write(json.dumps(content, indent=1) + "\n")
        return 0
    line = result.line
    rows = [
        f"  {r.name:30s} {r.true_percent:6.2f} %   found {r.percent:6.2f} %   {r.low:6.2f} .. {r.high:6.2f} %\n"
        for r in result.left_out
    ]
    sys.stdout.write(
        f"{source}: percent = {line.intercept:.2f} + ({np.radians(line.slope):.3f}) * angle in degrees,"
        f" {line.patches} patches\neach concentration as told by the others:\n{''.join(rows)}"
        f"median error {result.median_error:.3f} percent by weight; the {100 * confidence:.0f} % intervals hold the"
        f" truth in {100 * result.covered:.0f} % of the patches\n"
    )
    return 0
