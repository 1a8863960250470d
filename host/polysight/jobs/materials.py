"""Commands on saved products: materials, report, permittivity through layers, concentration, classify.

Each command prints the verdict first. If it is `none`, no patches are printed; JSON output lists them without names and
permittivities, as the products do.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Container, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.cells import cell_len

from polysight.imaging import sub_bands
from polysight.jobs.output import name_scan, print_json, print_lines
from polysight.materials import (
    AMPLITUDE_ERROR,
    PATCHES_FILE,
    SIMULATED_LIBRARY,
    UNKNOWN,
    CatalogueMaterial,
    Classifier,
    Layer,
    Library,
    MatchedPatch,
    NamedPatch,
    PatchName,
    ScanPatches,
    concentrations,
    fit_concentration,
    fit_row,
    format_layer_content,
    format_permittivity,
    incidence_std_rad,
    load_catalogue,
    match_patches,
    read_materials,
)
from polysight.products import MATERIALS, REPORT, SCAN, ProcessedScan, find_products, read_products
from polysight.results import NoResult, PatchFigures, PermittivityFigures, format_one_line, to_plain
from polysight.store import is_source
from polysight_shared.config import Chirp, load_instrument
from polysight_shared.errors import ConfigError, DataError, ErrorCode, quote
from polysight_shared.findings import Finding

# Two frequencies are the same within this relative difference: far above rounding, far below the difference to any
# other chirp.
_SAME_FREQUENCY = 1e-6
# Largest number of a verdict's reasons that the terminal shows; chosen. The report lists all of them.
_REASONS = 3


def print_verdict(products: ProcessedScan, to_terminal: bool = True) -> int:
    """Print the verdict of products, if they have one; return the exit status it gives: 0, or that of NoResult."""
    verdict = products.verdict
    if verdict is None:
        return 0
    if to_terminal:
        print_lines(verdict.lines(_REASONS))
    if verdict.usable:
        return 0
    return NoResult.exit_status


def _find_chirp(products: ProcessedScan, config: Path | None) -> Chirp:
    """Return the chirp of the products, or that of `config` if given. Raises DataError, ConfigError."""
    rig = products.rig
    if config is not None:
        rig = load_instrument(config)
    if rig is None:
        raise DataError(
            f"{products.folder}: no {SCAN}, which names the chirp",
            "an earlier release processed the scan",
            "process the scan again, or give its rig file: --config FILE",
        )
    return rig.chirp


def _check_bands(patch: PatchFigures, chirp: Chirp, source: str) -> None:
    """Raise DataError if the sub-bands of a patch are not those of this chirp."""
    if not patch.bands:
        return
    for saved, expected in zip(patch.bands, sub_bands(chirp, len(patch.bands)), strict=True):
        same_first = math.isclose(saved.first_hz, expected.first_hz, rel_tol=_SAME_FREQUENCY)
        same_last = math.isclose(saved.last_hz, expected.last_hz, rel_tol=_SAME_FREQUENCY)
        if not (same_first and same_last):
            raise DataError(
                f"patch {patch.label} covers {saved.first_hz / 1e9:.4f} to {saved.last_hz / 1e9:.4f} GHz; the chirp"
                f" of {source} has that part from {expected.first_hz / 1e9:.4f} to {expected.last_hz / 1e9:.4f} GHz",
                "the rig file is not that of the scan",
                "leave --config out: the products have their own",
            )


def permittivity(
    folder: Path,
    config: Path | None,
    stack: Sequence[Layer],
    number: int | None,
    as_json: bool,
    bands: int | None = None,
    amplitude_error: float = AMPLITUDE_ERROR,
) -> int:
    """Print the permittivity of patches, as a half space or as the unknown layer of a stack; return the exit status.

    Without a result (verdict `none`) the products hold no permittivity, JSON has patches without one, and the exit
    status is that of NoResult.

    `folder` holds the products, or is the scan folder that holds them. `stack` are layers from the radars' side, one of
    them unknown (empty: half spaces alone), `number` is one patch (None: all). The chirp is the one of the products, as
    their scan.json says; `config` replaces it. With `bands` above 1 the stack is fitted to so many sub-bands of the
    sweep, which the products must hold; None takes those of the products if a thickness is fitted, else the whole
    sweep. `amplitude_error` is the relative error of |H|; 0 leaves |H| out.

    Raises
    ------
    DataError
        when the folder holds no materials, not that patch, or not so many sub-bands; when nothing says with which
        chirp it was made, or its sub-bands are of another one.
    ConfigError
        when `config` cannot be read.
    NoResult
        when a stack is to be fitted to data whose verdict is `none`.
    """
    products = read_products(folder, MATERIALS)
    if stack and products.verdict is not None and not products.verdict.usable:
        raise products.verdict.error("the images are kept")
    patches = [patch for patch in products.segments if number is None or patch.label == number]
    if number is not None and not patches:
        raise DataError(
            f"{products.folder}: no patch {number}",
            f"its number is not in {MATERIALS}",
            f"`polysight materials {quote(products.folder)}` lists them",
        )
    chirp = None
    if stack:
        chirp = _find_chirp(products, config)
    rows: list[dict[str, Any]] = []
    for patch in patches:
        row = {"label": patch.label, "name": patch.name, "single_interface": to_plain(patch.permittivity)}
        if patch.refused is not None:
            row["refused"] = to_plain(patch.refused)
        if chirp is not None and not patch.metal_reference:
            _check_bands(patch, chirp, str(config or products.folder / SCAN))
            fit = fit_row(patch, chirp, stack, bands, amplitude_error, incidence_std_rad(products.materials))
            if fit is not None:
                row["layer"] = format_layer_content(fit)
        rows.append(row)
    if as_json:
        print_json(rows)
        return print_verdict(products, to_terminal=False)
    status = print_verdict(products)
    if status == 0:
        for patch, row in zip(patches, rows, strict=True):
            sys.stdout.write(_format_half_space_line(patch, row.get("layer")))
    return status


def _format_half_space_line(patch: PatchFigures, layer: Mapping[str, Any] | None) -> str:
    """Return a patch as a line: permittivity as a half space, then that of the layer, if one was fitted."""
    head = f"{patch.label:>3}  {_pad_name(patch.name or '')}"
    if patch.refused is not None:
        text = f"{head} not judged: {patch.refused_text}"
    elif patch.permittivity is None:
        if patch.metal_reference:
            head = f"{patch.label:>3}  {_pad_name('metal reference')}"
        text = f"{head} metal-like: no permittivity"
    else:
        text = f"{head} one interface {_format_estimate(patch.permittivity)}"
    return (text + _format_layer(layer)).rstrip() + "\n"


def _format_layer(layer: Mapping[str, Any] | None) -> str:
    """Format the fit of a layer, with a line for each note."""
    if layer is None:
        return ""
    real, loss = layer["permittivity"]
    text = f"   in the stack {format_permittivity(complex(real, -loss), width=6):15s}"
    text += f"  +- {layer['std_real']:.2f}, {layer['std_loss']:.2f}"
    if layer["thickness_std_mm"] is not None:
        text += f"   thickness {layer['thickness_mm']:.3f} +- {layer['thickness_std_mm']:.3f} mm"
    return text + "".join(f"\n     note: {w}" for w in layer["warnings"])


def _format_estimate(estimate: PermittivityFigures) -> str:
    """Format a permittivity with the errors of both parts and their main source."""
    text = f"{format_permittivity(estimate.value, width=6):15s}"
    if estimate.spread is not None:
        text += f"  +- {estimate.spread.real_std:.2f}, {estimate.spread.loss_std:.2f}"
    if estimate.dominated_by:
        text += f"  mostly {estimate.dominated_by}"
    return text


def _load_library(data: Path) -> Library:
    """Load a library (.npz), or a folder of the published material files."""
    if data.is_dir():
        return read_materials(data)
    return Library.load(data)


def _describe_origin(is_simulated: bool) -> str:
    """Return the label of the data's origin: simulated or measured."""
    return "simulated" if is_simulated else "measured"


def concentration(data: Path, values: Sequence[tuple[str, float]], confidence: float, as_json: bool) -> int:
    """Fit concentration against polarisation angle, with leave-one-out errors; return 0.

    `data` is a library (.npz) or a folder of the published material files, `values` are percentages of materials
    without one in their name, `confidence` the share of truths that the printed intervals are to hold, 0 to 1. Raises
    ConfigError for a value of a material that is not in `data`, else DataError.
    """
    library = _load_library(data)
    percent_by_name = dict(values)
    unknown = sorted(set(percent_by_name) - set(library.names))
    if unknown:
        raise ConfigError(
            f"{data}: no material {unknown[0]!r}", f"it holds {', '.join(library.names)}", "correct --value"
        )
    result = fit_concentration(library, percent_by_name, confidence)
    without_concentration = sorted(set(library.names) - set(concentrations(library.names, percent_by_name)))
    source = _describe_origin(library.simulated)
    if as_json:
        content = {
            "source": source,
            "line": asdict(result.line),
            "left_out": [asdict(r) for r in result.left_out],
            "without_concentration": without_concentration,
            "median_error_percent": result.median_error,
            "covered": result.covered,
        }
        print_json(content)
        return 0
    line = result.line
    # The slope is per radian; times pi / 180 it is per degree.
    slope_per_degree = np.radians(line.slope)
    rows = [
        f"  {r.name:30s} {r.true_percent:6.2f} %   found {r.percent:6.2f} %   {r.low:6.2f} .. {r.high:6.2f} %\n"
        for r in result.left_out
    ]
    sys.stdout.write(
        f"{source}: percent = {line.intercept:.2f} + ({slope_per_degree:.3f}) * angle in degrees,"
        f" {line.patches} patches\neach concentration predicted from the others:\n{''.join(rows)}"
        f"median error {result.median_error:.3f} percent by weight; the {100 * confidence:.0f} % intervals contain "
        f"the truth in {100 * result.covered:.0f} % of the patches\n"
    )
    if without_concentration:
        names = ", ".join(without_concentration)
        print_lines([f"note: not used, no percentage in the name: {names} (--value NAME=PERCENT gives it)"])
    return 0


def materials(data: Sequence[Path], as_json: bool) -> int:
    """Print names and permittivities of the patches of processed scans; return the exit status.

    The status is that of NoResult if one of the scans has no result (verdict `none`); its patches are not printed, but
    in JSON, without names.

    Raises
    ------
    DataError
        if a folder holds no materials.
    """
    scans = [read_products(folder, MATERIALS) for folder in data]
    if as_json:
        print_json([{"products": str(s.folder), **to_plain(s.materials)} for s in scans])
        return max((print_verdict(s, to_terminal=False) for s in scans), default=0)
    worst_status = 0
    for scan in scans:
        sys.stdout.write(f"{scan.folder}: {name_scan(scan.scan_id, bool(scan.simulated))}\n")
        status = print_verdict(scan)
        if status == 0:
            sys.stdout.write("".join(map(_format_patch_line, scan.segments)))
        worst_status = max(worst_status, status)
    return worst_status


def catalogue(as_json: bool) -> int:
    """Print the catalogue of the literature, sorted by eps'; return the exit status. A star marks a default spread."""
    entries = sorted(load_catalogue(), key=lambda material: material.permittivity.real)
    if as_json:
        print_json([to_plain(material) for material in entries])
        return 0
    sources = {source.key: source.citation for material in entries for source in material.sources}
    number = {key: k for k, key in enumerate(sorted(sources), 1)}
    print_lines(_format_catalogue_line(material, number) for material in entries)
    print_lines(["", "spread: standard deviation between specimens; * is the default of the kind"])
    print_lines(f"[{number[key]}] {sources[key]}" for key in number)
    return 0


def _format_catalogue_line(material: CatalogueMaterial, number: Mapping[str, int]) -> str:
    """Format a material: name, permittivity and spreads, frequency and numbers of the sources."""
    value = format_permittivity(material.permittivity, 4, 8)
    spread_real, spread_loss = material.spread
    star = "*" if material.spread_is_default else " "
    cited = "".join(f"[{number[source.key]}]" for source in material.sources)
    spread_text = f"+-{100 * spread_real:3.0f} %, {100 * spread_loss:3.0f} %{star}"
    frequency = f"{material.frequency_hz / 1e9:5.4g} GHz"
    return f"{_pad_name(material.name, 30)} {value:19s} {spread_text} {frequency}  {material.kind:10s} {cited}"


def _format_patch_line(patch: PatchFigures) -> str:
    """Return a patch as a line: number, name, confidence, permittivity; a second line says why it has no name."""
    box = ""
    if patch.box:
        box = f"   drawn as {patch.box}"
    if patch.refused is not None:
        return f"{patch.label:>3}  {'not judged':24s} {patch.refused_text}{box}\n"
    name = patch.name or "not named"
    if patch.metal_reference and not patch.name:
        name = "metal reference"
    confidence = ""
    if patch.confidence is not None:
        confidence = f"{100 * patch.confidence:.0f} %"
    value = "-"
    if patch.permittivity is not None:
        value = _format_estimate(patch.permittivity)
    elif patch.metal_like:
        value = "metal-like"
    line = f"{patch.label:>3}  {_pad_name(name)} {confidence:>5s}  {value}{box}".rstrip() + "\n"
    if patch.why:
        line += f"     {patch.why}\n"
    return line


def _pad_name(name: str, width: int = 24) -> str:
    """Pad a name to the width of a column of a terminal; Chinese characters take two places each."""
    return name + " " * max(0, width - cell_len(name))


def report(folder: Path) -> int:
    """Print the path of a scan's report, and make the report if it is missing; return the exit status.

    Raises
    ------
    PolysightError
        as processing the scan does.
    """
    saved = find_products(folder, REPORT)
    if saved is None:
        if not is_source(folder):
            # There are neither products nor a scan: this raises the error with the reason.
            read_products(folder, REPORT)
        from polysight.jobs.process import process

        # It prints the verdict and the report's path.
        status = process(folder, folder / "products")
        new = find_products(folder, REPORT)
        if status or new is None:
            return status
        return print_verdict(new, to_terminal=False)
    status = print_verdict(saved)
    sys.stdout.write(f"report:   {saved.folder / REPORT}\n")
    return status


def classify(data: Sequence[Path], library: Path | None, model: str | None, as_json: bool) -> int:
    """Name the patches of processed scans together, or judge the models on one library; return the exit status.

    `data` are processed scans, one for each incidence angle; or one library (.npz), or a folder of the published
    material files. Names come from `library` (None: the simulated one) and `model` (None: the library's default).

    Raises
    ------
    ConfigError
        when the data are of both kinds, one scan is given twice, or `library` or `model` is given with a library.
    DataError
        when something in them cannot be used.

    Notes
    -----
    Where one of the scans has no result (verdict `none`) nothing is named; the exit status is that of NoResult.
    """
    scans = [find_products(folder, PATCHES_FILE) for folder in data]
    products = [s for s in scans if s is not None]
    if len({s.folder.resolve() for s in products}) < len(products):
        raise ConfigError(
            f"{' '.join(map(str, data))}: one scan is given twice",
            "the second one adds no information",
            "give scans of the same patches under different angles",
        )
    if len(products) == len(scans):
        return _name_patches(products, library or SIMULATED_LIBRARY, model, as_json)
    if len(data) > 1:
        unprocessed = data[scans.index(None)]
        raise ConfigError(
            f"{unprocessed}: not a folder of products",
            "several scans are named together from what polysight process wrote",
            f"polysight process SCAN --out {quote(unprocessed)}",
        )  # fmt: skip
    if library is not None or model is not None:
        raise ConfigError(
            f"{data[0]}: no patches of a scan, so --library and --model would do nothing",
            "they choose what names patches; on a library every model is judged",
            "leave them out, or give a folder that polysight process wrote",
            code=ErrorCode.VALUES_CONFLICT,
        )
    return _score_models(data[0], as_json)


def _score_models(data: Path, as_json: bool) -> int:
    """Cross-validate every model on a library, of several angles at the last one; print shares of correct names."""
    from polysight.materials import MODELS, Samples, score

    library = _load_library(data)
    if len(library.angles_deg) > 1:
        sys.stderr.write(f"{data}: angles {library.angles_deg} degrees; judged at {library.angles_deg[-1]:g}\n")
        library = library.at_angle(library.angles_deg[-1])
    samples = Samples.from_library(library)
    # Each model has two scores: with whole scans left out, and with single pixels left out.
    scores_by_scan = []
    scores_by_pixel = []
    for model in MODELS:
        scores_by_scan.append(score(samples, model, by_pixel=False))
        scores_by_pixel.append(score(samples, model, by_pixel=True))
    pairs = list(zip(scores_by_scan, scores_by_pixel, strict=True))
    source = _describe_origin(library.simulated)
    if as_json:
        scores = [score_of_model for pair in pairs for score_of_model in pair]
        rows = [{k: v for k, v in asdict(s).items() if "confusion" not in k and k != "names"} for s in scores]
        best = max(scores_by_scan, key=lambda s: s.pixels + s.patches)
        content = {"source": source, "names": best.names, "scores": rows}
        content |= {"best_with_scans_left_out": best.model, "confusion_of_best": best.confusion.tolist()}
        print_json(content)
        return 0
    sys.stdout.write(
        f"{source}: {len(library.names)} materials, {len(library.scans)} scans, {samples.names.size} pixels\n"
        f"{'':44s}{'whole scans left out':>22s}{'by pixel (optimistic)':>24s}\n"
        f"{'model':44s}{'pixels':>11s}{'patches':>11s}{'pixels':>12s}{'patches':>12s}\n"
    )
    for score_by_scan, score_by_pixel in pairs:
        sys.stdout.write(
            f"{score_by_scan.model:44s}{score_by_scan.pixels:11.1%}{score_by_scan.patches:11.1%}"
            f"{score_by_pixel.pixels:12.1%}{score_by_pixel.patches:12.1%}\n"
        )
    if missing := scores_by_scan[0].not_judged:
        sys.stdout.write(f"not judged with scans left out, because only one scan contains them: {', '.join(missing)}\n")
    return 0


def _name_patches(products: Sequence[ProcessedScan], library_path: Path, model: str | None, as_json: bool) -> int:
    """Name the patches that lie at the same place in all scans; print names with shares of their pixels.

    Raises DataError if no place has a patch in every scan.
    """
    from polysight.materials import describe_classifier

    status = max(print_verdict(p, to_terminal=not as_json) for p in products)
    if status:
        if as_json:
            print_json(_describe_unnamed(products))
        return status
    library = Library.load(library_path)
    scans = [_select_classifiable(p) for p in products]
    classifier = Classifier(library, model=model, angles_deg=[s.angle_deg for s in scans])
    matched = match_patches(scans)
    if not matched:
        raise DataError(
            f"{products[-1].folder}: none of its patches is at the place of a patch of {products[0].folder}",
            "the object was moved between the scans, or these are scans of other objects",
            "scan the same patches in the same places",
        )
    # Evidence: V / H of the patch in each scan, as the joint inversion estimated it with its errors.
    named = classifier.scan([m.features for m in matched], [m.evidence for m in matched])
    content = {
        "source": _describe_origin(any(s.simulated for s in scans)),
        "incidence_deg": [s.angle_deg for s in scans],
        "model": classifier.model,
        "library": describe_classifier(classifier),
        "patches": [_describe_named_patch(m, n.patch_name, n.pixel_names) for m, n in zip(matched, named, strict=True)],
        "contradictions": _describe_contradictions(library, model, classifier.angles_deg, matched, named),
        "patches_not_in_every_scan": sum(len(s.patches) for s in scans) - len(scans) * len(matched),
        "refused": [
            {"products": str(p.folder), "label": patch.label, **to_plain(patch.refused)}
            for p in products
            for patch in p.segments
            if patch.refused is not None
        ],
    }
    if as_json:
        print_json(content)
    else:
        _print_names(content, several=len(scans) > 1)
        _print_accuracy(content["patches"], library.names)
        if unmatched := content["patches_not_in_every_scan"]:
            sys.stdout.write(f"{unmatched} patches were not seen in every scan and are not named\n")
        sys.stdout.write(content["library"] + "\n")
    return 0


def _select_classifiable(products: ProcessedScan) -> ScanPatches:
    """Return the patches of a scan that are classified: not refused, and not the metal reference."""
    left_out = {patch.label for patch in products.segments if patch.refused is not None or patch.metal_reference}
    scan = products.patches
    return replace(scan, patches=tuple(p for p in scan.patches if p.label not in left_out))


def _print_names(content: dict[str, Any], several: bool) -> None:
    """Print a line for each named patch, contradiction and refused patch."""
    angles = " and ".join(f"{a:.1f}" for a in content["incidence_deg"])
    head = f"{len(content['patches'])} patches at {angles} degrees"
    if content["source"] == "simulated":
        head = f"simulated: {head}"
    sys.stdout.write(f"{head}\n")
    for row in content["patches"]:
        votes = ", ".join(f"{name} {share:.0%}" for name, share in list(row["votes"].items())[:2])
        confidence = "no pixel of it can be used"
        if row["pixels"]:
            confidence = f"{row['confidence']:6.1%}"
        line = f"{row['label']:>3}  {row['name']:28s} {confidence}   pixels: {votes}"
        if row["truth"]:
            line += f"   truly {row['truth']}"
        sys.stdout.write(f"{line}\n")
    print_lines(f"note: {line}" for line in content["contradictions"])
    for refused in content["refused"]:
        place_text = ""
        if several:
            place_text = f" in {refused['products']}"
        text = format_one_line(Finding("error", refused["what"], refused["why"], refused["do"]))
        sys.stdout.write(f"{refused['label']:>3}  not judged{place_text}: {text}\n")


def _describe_contradictions(
    library: Library,
    model: str | None,
    angles_deg: Sequence[float],
    matched: Sequence[MatchedPatch],
    named: Sequence[NamedPatch],
) -> list[str]:
    """Describe patches without a name that match different materials at different angles, one line each.

    `matched` and `named` are one patch each, in the same order; a name counts if its source is the library.
    """
    if len(angles_deg) < 2 or all(n.patch_name.source == "library" for n in named):
        return []
    names_by_angle = []
    for i, angle_deg in enumerate(angles_deg):
        features: list[npt.NDArray[np.float64]] = []
        evidence: list[Any] = []
        for match in matched:
            # Features of the angles are side by side in columns; evidence has one entry for each angle.
            features_by_angle = np.split(match.features, len(angles_deg), axis=1)
            features.append(features_by_angle[i])
            if match.evidence is None:
                evidence.append(None)
            else:
                evidence.append(match.evidence[i : i + 1])
        names_by_angle.append(Classifier(library, model=model, angles_deg=[angle_deg]).scan(features, evidence))
    lines = []
    for match, together, *single_scans in zip(matched, named, *names_by_angle, strict=True):
        names = [n.patch_name.name for n in single_scans]
        materials_alone = {n.patch_name.name for n in single_scans if n.patch_name.source == "library"}
        if together.patch_name.source != "library" and len(materials_alone) > 1:
            answers = ", ".join(f"{name} at {a:g} degrees" for name, a in zip(names, angles_deg, strict=True))
            lines.append(
                f"patch {match.label} contradicts itself: {answers}; was it moved or exchanged between the scans?"
            )
    return lines


def _print_accuracy(rows: Sequence[dict[str, Any]], names: Container[str]) -> None:
    """Print the number of correct names; patches of materials that the library lacks do not count if unknown."""
    not_in_library = [r for r in rows if r["truth"] and r["truth"] not in names]
    judged = [r for r in rows if r["truth"] and not (r in not_in_library and r["name"] == UNKNOWN)]
    if not_in_library:
        unknown = sum(r["name"] == UNKNOWN for r in not_in_library)
        sys.stdout.write(
            f"{len(not_in_library)} patches of materials that the library lacks, {unknown} of them named unknown\n"
        )
    if judged:
        correct = sum(r["name"] == r["truth"] for r in judged)
        share = np.mean([r["pixels_right"] for r in judged])
        sys.stdout.write(f"{correct} of {len(judged)} patches named right, {share:.1%} of their pixels\n")


def _describe_unnamed(products: Sequence[ProcessedScan]) -> dict[str, Any]:
    """Return the JSON of `classify` if a scan has no result (ValueError: all have one): its patches without names."""
    nothing = {"name": None, "confidence": None, "votes": {}, "probabilities": {}}
    for scan in products:
        if scan.verdict is not None and not scan.verdict.usable:
            return {
                "products": str(scan.folder),
                "verdict": scan.verdict.to_dict(),
                "patches": [{"label": patch.label, **nothing} for patch in scan.segments],
            }
    raise ValueError("every scan has a result")


def _describe_named_patch(matched: MatchedPatch, verdict: PatchName, pixels: npt.NDArray[np.str_]) -> dict[str, Any]:
    """Return a named patch as JSON; `pixels` are the names of its pixels."""
    distance = None
    if np.isfinite(verdict.distance):
        distance = verdict.distance
    pixels_right = None
    if matched.truth:
        pixels_right = float((pixels == matched.truth).mean())
    return {
        "label": matched.label,
        "name": verdict.name,
        "confidence": verdict.confidence,
        "votes": verdict.votes,
        "probabilities": verdict.probabilities,
        "distance": distance,
        "pixels": verdict.pixels,
        "truth": matched.truth,
        "pixels_right": pixels_right,
    }
