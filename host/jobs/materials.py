"""Commands on materials in saved products: the table, names, permittivity through layers, and concentration.

`classify` names the patches of several scans together, or judges the models on a library; `report` finds the report of
a scan, or makes it again from the raw rows.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.imaging import sub_bands
from polysight.host.materials import (
    AMPLITUDE_ERROR,
    PATCHES,
    SIMULATED_LIBRARY,
    Classifier,
    Layer,
    LayerFit,
    Library,
    MatchedPatch,
    Verdict,
    bands_of_row,
    fit_concentration,
    fit_layer,
    format_permittivity,
    match_patches,
    read_materials,
)
from polysight.host.products import MATERIALS, SCAN, SavedProducts, find_products, read_products
from polysight.host.report import classifier_sentence
from polysight.shared.config import Chirp, load_instrument
from polysight.shared.errors import ConfigError, DataError

LAST = "?"
_SAME_FREQUENCY = 1e-6  # relative: far above rounding, far below any other chirp
REPORT = "report.html"


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
    text = f"{head} one interface {format_permittivity(complex(single['real'], single['imag']), width=6):15s}"
    if single.get("real_std") is not None:
        text += f"  +- {single['real_std']:.2f}"
    layer = row.get("layer")
    if layer is not None:
        real, loss = layer["permittivity"]
        text += f"   in the stack {format_permittivity(complex(real, -loss), width=6):15s}"
        text += f"  +- {layer['std_real']:.2f}, {layer['std_loss']:.2f}"
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


def materials(data: Sequence[Path], as_json: bool) -> int:
    """What the patches of processed scans were named, and their permittivity; returns the exit status.

    Raises
    ------
    DataError
        when a folder holds no materials.
    """
    scans = [read_products(folder, MATERIALS) for folder in data]
    if as_json:
        sys.stdout.write(json.dumps([{"products": str(s.folder), **s.materials} for s in scans], indent=1) + "\n")
        return 0
    for scan in scans:
        kind = "simulated " if scan.simulated else ""
        sys.stdout.write(f"{scan.folder}: {kind}scan {scan.scan_id}\n" + "".join(map(_patch_line, scan.segments)))
    return 0


def _patch_line(row: dict[str, Any]) -> str:
    name = row["name"] or "not named"
    sure = f"{100 * row['confidence']:.0f} %" if row.get("confidence") is not None else ""
    e = row.get("permittivity")
    told = "metal-like" if row.get("metal_like") else "-"
    if e is not None:
        told = f"{format_permittivity(complex(e['real'], e['imag']), width=6):15s}"
    if e is not None and e.get("real_std") is not None:
        told += f"  +- {e['real_std']:.2f}"
    return f"{row['label']:>3}  {name:24s} {sure:>5s}  {told}".rstrip() + "\n"


def report(folder: Path) -> int:
    """Say where the report of a scan is, and make it from the raw rows where it is not there; the exit status.

    Raises
    ------
    PolysightError
        as processing the scan does.
    """
    found = find_products(folder, REPORT)
    if found is None:
        from polysight.host.jobs.process import process
        from polysight.host.process import ProcessRequest

        return process(ProcessRequest(data=str(folder), out=str(folder / "products")))
    sys.stdout.write(f"report:   {found.folder / REPORT}\n")
    return 0


def classify(data: Sequence[Path], library: Path | None, model: str | None, as_json: bool) -> int:
    """Name the patches of processed scans together, or judge the models on one library; returns the exit status.

    Parameters
    ----------
    data
        Folders that `polysight process` wrote, or scan folders, one for each incidence angle; or a library (.npz), or a
        folder of the published material files.
    library, model
        Of the naming; without: the simulated library, and the model that was chosen for it.
    as_json
        Print JSON.

    Raises
    ------
    ConfigError
        when the data are of both kinds.
    DataError
        when something in them cannot be used.
    """
    scans = [find_products(folder, PATCHES) for folder in data]
    found = [s for s in scans if s is not None]
    if len(found) == len(scans):
        return _name(found, library or SIMULATED_LIBRARY, model, as_json)
    if len(data) > 1:
        other = data[scans.index(None)]
        raise ConfigError(
            f"{other}: not a folder of products", "several scans are named together from what polysight process wrote",
            f"polysight process SCAN --out {other}",
        )  # fmt: skip
    if library is not None or model is not None:
        raise ConfigError(
            f"{data[0]}: no patches of a scan, so --library and --model would do nothing",
            "they choose what names patches; on a library every model is judged",
            "leave them out, or give a folder that polysight process wrote",
        )
    return _judge(data[0], as_json)


def _judge(data: Path, as_json: bool) -> int:
    from polysight.host.materials import MODELS, Samples, score

    library = read_materials(data) if data.is_dir() else Library.load(data)
    if len(library.angles_deg) > 1:
        sys.stderr.write(f"{data}: angles {library.angles_deg} degrees; judged at {library.angles_deg[-1]:g}\n")
        library = library.at(library.angles_deg[-1])
    samples = Samples.of(library)
    scores = [score(samples, model, by_pixel=by_pixel) for model in MODELS for by_pixel in (False, True)]
    source = "simulated" if library.simulated else "measured"
    if as_json:
        rows = [{k: v for k, v in asdict(s).items() if "confusion" not in k and k != "names"} for s in scores]
        best = max(scores[::2], key=lambda s: s.pixels + s.patches)
        content = {"source": source, "names": best.names, "scores": rows}
        content |= {"best_with_scans_left_out": best.model, "confusion_of_best": best.confusion.tolist()}
        sys.stdout.write(json.dumps(content, indent=1) + "\n")
        return 0
    sys.stdout.write(
        f"{source}: {len(library.names)} materials, {len(library.scans)} scans, {samples.names.size} pixels\n"
        f"{'':44s}{'whole scans left out':>22s}{'by pixel (optimistic)':>24s}\n"
        f"{'model':44s}{'pixels':>11s}{'patches':>11s}{'pixels':>12s}{'patches':>12s}\n"
    )
    for held, mixed in zip(scores[::2], scores[1::2], strict=True):
        sys.stdout.write(
            f"{held.model:44s}{held.pixels:11.1%}{held.patches:11.1%}{mixed.pixels:12.1%}{mixed.patches:12.1%}\n"
        )
    if missing := scores[0].not_judged:
        sys.stdout.write(f"not judged with scans left out, because one scan alone holds them: {', '.join(missing)}\n")
    return 0


def _name(products: Sequence[SavedProducts], library_path: Path, model: str | None, as_json: bool) -> int:
    library = Library.load(library_path)
    scans = [p.patches for p in products]
    classifier = Classifier(library, model=model, angles_deg=[s.angle_deg for s in scans])
    matched = match_patches(scans)
    if not matched:
        raise DataError(
            f"{products[-1].folder}: none of its patches lies where one of {products[0].folder} does",
            "the object was moved between the scans, or these are scans of other objects",
            "scan the same patches in the same places",
        )
    named = classifier.scan([m.features for m in matched])
    rows = [_row(m, n.verdict, n.names) for m, n in zip(matched, named, strict=True)]
    simulated = any(s.simulated for s in scans)
    once = sum(len(s.patches) for s in scans) - len(scans) * len(matched)
    if as_json:
        content = {
            "source": "simulated" if simulated else "measured",
            "incidence_deg": [s.angle_deg for s in scans],
            "model": classifier.model,
            "library": classifier_sentence(classifier),
            "patches": rows,
            "patches_not_in_every_scan": once,
        }
        sys.stdout.write(json.dumps(content, indent=1) + "\n")
        return 0
    angles = " and ".join(f"{s.angle_deg:.1f}" for s in scans)
    sys.stdout.write(f"{'simulated: ' if simulated else ''}{len(rows)} patches at {angles} degrees\n")
    for row in rows:
        votes = ", ".join(f"{name} {share:.0%}" for name, share in list(row["votes"].items())[:2])
        truth = f"   truly {row['truth']}" if row["truth"] else ""
        sys.stdout.write(f"{row['label']:>3}  {row['name']:28s} {row['confidence']:6.1%}   pixels: {votes}{truth}\n")
    known = [r for r in rows if r["truth"]]
    if known:
        right, share = sum(r["name"] == r["truth"] for r in known), np.mean([r["pixels_right"] for r in known])
        sys.stdout.write(f"{right} of {len(known)} patches named right, {share:.1%} of their pixels\n")
    if once:
        sys.stdout.write(f"{once} patches were not seen in every scan and are not named\n")
    sys.stdout.write(classifier_sentence(classifier) + "\n")
    return 0


def _row(matched: MatchedPatch, verdict: Verdict, pixels: npt.NDArray[np.str_]) -> dict[str, Any]:
    return {
        "label": matched.label,
        "name": verdict.name,
        "confidence": verdict.confidence,
        "votes": verdict.votes,
        "distance": verdict.distance if np.isfinite(verdict.distance) else None,
        "pixels": verdict.pixels,
        "truth": matched.truth,
        "pixels_right": float((pixels == matched.truth).mean()) if matched.truth else None,
    }
