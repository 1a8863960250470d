"""`polysight classify`: names the patches of several scans together, or judges the models on a library."""

from __future__ import annotations

import sys
from collections.abc import Container, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.jobs.materials import print_verdict
from polysight.jobs.output import print_json, print_lines
from polysight.materials import (
    PATCHES,
    SIMULATED_LIBRARY,
    UNKNOWN,
    Classifier,
    Library,
    MatchedPatch,
    NamedPatch,
    PatchName,
    ScanPatches,
    match_patches,
    read_materials,
)
from polysight.products import SavedProducts, find_products, refused_text
from polysight.report import classifier_sentence
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError


def classify(data: Sequence[Path], library: Path | None, model: str | None, as_json: bool) -> int:
    """Name the patches of processed scans together, or judge the models on one library; return the exit status.

    `data` are processed scans, one for each incidence angle; or one library (.npz), or a folder of the published
    material files. Names come from `library` (None: the simulated one) and `model` (None: the library's default).

    Raises
    ------
    ConfigError
        when the data are of both kinds.
    DataError
        when something in them cannot be used.

    Notes
    -----
    Where one of the scans has no result (verdict `none`) nothing is named; the exit status is that of NoResult.
    """
    scans = [find_products(folder, PATCHES) for folder in data]
    found = [s for s in scans if s is not None]
    if len({s.folder.resolve() for s in found}) < len(found):
        raise ConfigError(
            f"{' '.join(map(str, data))}: one scan is given twice",
            "it tells nothing more the second time",
            "give scans of the same patches under different angles",
        )
    if len(found) == len(scans):
        return _name_patches(found, library or SIMULATED_LIBRARY, model, as_json)
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
            code=ErrorCode.VALUES_CONFLICT,
        )
    return _score_models(data[0], as_json)


def _score_models(data: Path, as_json: bool) -> int:
    """Cross-validate every model on a library; print shares of right names."""
    from polysight.materials import MODELS, Samples, score

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
        print_json(content)
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


def _name_patches(products: Sequence[SavedProducts], library_path: Path, model: str | None, as_json: bool) -> int:
    """Name the patches that lie at the same place in all scans; print names with shares of their pixels."""
    status = max(print_verdict(p, to_terminal=not as_json) for p in products)
    if status:
        if as_json:
            print_json(_nothing_named(products))
        return status
    library = Library.load(library_path)
    scans = [_classifiable(p) for p in products]
    classifier = Classifier(library, model=model, angles_deg=[s.angle_deg for s in scans])
    matched = match_patches(scans)
    if not matched:
        raise DataError(
            f"{products[-1].folder}: none of its patches lies where one of {products[0].folder} does",
            "the object was moved between the scans, or these are scans of other objects",
            "scan the same patches in the same places",
        )
    errors = scans[0].errors_of([m.label for m in matched]) if len(scans) == 1 else None
    named = classifier.scan([m.features for m in matched], errors)
    content = {
        "source": "simulated" if any(s.simulated for s in scans) else "measured",
        "incidence_deg": [s.angle_deg for s in scans],
        "model": classifier.model,
        "library": classifier_sentence(classifier),
        "patches": [_row(m, n.verdict, n.names) for m, n in zip(matched, named, strict=True)],
        "contradictions": _contradictions(library, model, classifier.angles_deg, matched, named),
        "patches_not_in_every_scan": sum(len(s.patches) for s in scans) - len(scans) * len(matched),
        "refused": [
            {"products": str(p.folder), "label": s["label"], **s["refused"]}
            for p in products
            for s in p.segments
            if s.get("refused")
        ],
    }
    if as_json:
        print_json(content)
    else:
        _print_names(content, several=len(scans) > 1)
        _print_right(content["patches"], library.names)
        if once := content["patches_not_in_every_scan"]:
            sys.stdout.write(f"{once} patches were not seen in every scan and are not named\n")
        sys.stdout.write(content["library"] + "\n")
    return 0


def _classifiable(products: SavedProducts) -> ScanPatches:
    """Patches of a scan without the refused ones and the metal reference, which is never judged by itself."""
    left_out = {s["label"] for s in products.segments if s.get("refused") or s.get("metal_reference")}
    scan = products.patches
    return replace(scan, patches=tuple(p for p in scan.patches if p.label not in left_out))


def _print_names(content: dict[str, Any], several: bool) -> None:
    """Print a line for each named patch, contradiction and refused patch."""
    angles = " and ".join(f"{a:.1f}" for a in content["incidence_deg"])
    source = "simulated: " if content["source"] == "simulated" else ""
    sys.stdout.write(f"{source}{len(content['patches'])} patches at {angles} degrees\n")
    for row in content["patches"]:
        votes = ", ".join(f"{name} {share:.0%}" for name, share in list(row["votes"].items())[:2])
        truth = f"   truly {row['truth']}" if row["truth"] else ""
        sure = f"{row['confidence']:6.1%}" if row["pixels"] else "no pixel of it can be used"
        sys.stdout.write(f"{row['label']:>3}  {row['name']:28s} {sure}   pixels: {votes}{truth}\n")
    print_lines(f"note: {line}" for line in content["contradictions"])
    for refused in content["refused"]:
        where = f" in {refused['products']}" if several else ""
        text = refused_text({"refused": refused})
        sys.stdout.write(f"{refused['label']:>3}  not judged{where}: {text}\n")


def _contradictions(
    library: Library,
    model: str | None,
    angles_deg: Sequence[float],
    matched: Sequence[MatchedPatch],
    named: Sequence[NamedPatch],
) -> list[str]:
    """Describe unknown patches that match different materials at different angles, one line each."""
    if len(angles_deg) < 2 or all(n.verdict.name != UNKNOWN for n in named):
        return []
    alone = [
        Classifier(library, model=model, angles_deg=[a]).scan(
            [np.split(m.features, len(angles_deg), 1)[i] for m in matched]
        )
        for i, a in enumerate(angles_deg)
    ]
    out = []
    for m, together, *each in zip(matched, named, *alone, strict=True):
        names = [n.verdict.name for n in each]
        if together.verdict.name == UNKNOWN and len(set(names) - {UNKNOWN}) > 1:
            answers = ", ".join(f"{name} at {a:g} degrees" for name, a in zip(names, angles_deg, strict=True))
            out.append(f"patch {m.label} contradicts itself: {answers}; was it moved or exchanged between the scans?")
    return out


def _print_right(rows: Sequence[dict[str, Any]], names: Container[str]) -> None:
    """Count right names; unknown patches of materials that the library lacks do not count."""
    strange = [r for r in rows if r["truth"] and r["truth"] not in names]
    known = [r for r in rows if r["truth"] and not (r in strange and r["name"] == UNKNOWN)]
    if strange:
        unknown = sum(r["name"] == UNKNOWN for r in strange)
        sys.stdout.write(
            f"{len(strange)} patches of materials that the library lacks, {unknown} of them named unknown\n"
        )
    if known:
        right, share = sum(r["name"] == r["truth"] for r in known), np.mean([r["pixels_right"] for r in known])
        sys.stdout.write(f"{right} of {len(known)} patches named right, {share:.1%} of their pixels\n")


def _nothing_named(products: Sequence[SavedProducts]) -> dict[str, Any]:
    """JSON of `classify` if a scan has no result: its patches without names."""
    scan = next(p for p in products if p.verdict is not None and not p.verdict.usable)
    nothing = {"name": None, "confidence": None, "votes": {}, "probabilities": {}}
    return {
        "products": str(scan.folder),
        "verdict": None if scan.verdict is None else scan.verdict.to_dict(),
        "patches": [{"label": s["label"], **nothing} for s in scan.segments],
    }


def _row(matched: MatchedPatch, verdict: PatchName, pixels: npt.NDArray[np.str_]) -> dict[str, Any]:
    return {
        "label": matched.label,
        "name": verdict.name,
        "confidence": verdict.confidence,
        "votes": verdict.votes,
        "probabilities": verdict.probabilities,
        "distance": verdict.distance if np.isfinite(verdict.distance) else None,
        "pixels": verdict.pixels,
        "truth": matched.truth,
        "pixels_right": float((pixels == matched.truth).mean()) if matched.truth else None,
    }
