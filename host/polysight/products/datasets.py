"""Convert processed scans to xarray datasets with named dimensions, coordinates in metres, units and provenance.

Notebooks and exports use the same names: `image_dataset` has the pixels, `patch_dataset` the patches, `full_dataset`
both. Permittivity is eps' - j eps'' (eps'' is the loss); unknown values are NaN. xarray is imported at first use.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from polysight.materials import image_centre_mm
from polysight.polarimetry import incidence_choice, specular_incidence_rad
from polysight.products.material_table import material_columns
from polysight.products.processed import ProcessedScan
from polysight.results import Verdict
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError

if TYPE_CHECKING:
    import xarray

CONVENTION = (
    "H: s-polarised, V: p-polarised, P = H / V, relative to metal where a reference was found; row 0 is the smallest y,"
    " column 0 the smallest x; rig frame; permittivity is real - j loss"
)
UNREFERENCED = "none: h, v and p are in arbitrary units"


def ranges_text(numbers: Sequence[int]) -> str:
    """Return ascending numbers as text, `3, 7-9`; `none` without numbers."""
    found: list[list[int]] = []
    for n in numbers:
        if found and n == found[-1][1] + 1:
            found[-1][1] = n
        else:
            found.append([n, n])
    return ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in found) or "none"


def verdict_attributes(verdict: Verdict | None) -> dict[str, str]:
    """Return `verdict` (the level) and `verdict_reasons` as JSON (what, why, do); empty without a verdict."""
    if verdict is None:
        return {}
    content = verdict.to_dict()
    return {"verdict": content["level"], "verdict_reasons": json.dumps(content["reasons"], ensure_ascii=False)}


def provenance(done: ProcessedScan) -> dict[str, Any]:
    """Return the attributes of every dataset: identity and origin of the data. Unknown entries are left out.

    `simulated` is True, False or "unknown"; `versions` is JSON; `rows_missing` and `positions_masked` are text; see
    :func:`verdict_attributes` for `verdict` and `verdict_reasons`.
    """
    simulated = "unknown" if done.simulated is None else done.simulated
    attrs: dict[str, Any] = {
        "title": f"scan {done.scan_id or 'without a name'}{' (simulated)' if simulated is True else ''}",
        "scan_id": done.scan_id,
        "simulated": simulated,
        "convention": CONVENTION,
        "metal_reference": done.materials.get("metal_reference", {}).get("how", "given")
        if done.metal_referenced
        else UNREFERENCED,
        **verdict_attributes(done.verdict),
    }
    if done.rig is not None:
        attrs["rig"] = done.rig.name
    if "processed_utc" in done.scan:
        attrs["processed_utc"] = done.scan["processed_utc"]
    if "versions" in done.scan:
        attrs["versions"] = json.dumps(done.scan["versions"])
    if done.rows is not None:
        attrs["rows_planned"] = done.rows.planned
        attrs["rows_missing"] = ranges_text(done.rows.missing)
    masked = [
        f"{name} {b['positions_masked']} of {b['positions']}"
        for name, b in done.quality.get("boards", {}).items()
        if "positions_masked" in b and "positions" in b
    ]
    if masked:
        attrs["positions_masked"] = ", ".join(masked)
    return attrs


def _text(values: Sequence[Any]) -> npt.NDArray[np.str_]:
    return np.array([v or "" for v in values], dtype=np.str_)


def _numbers(values: Sequence[Any]) -> npt.NDArray[np.float64]:
    return np.array([np.nan if v is None else v for v in values], np.float64)


def _complex(real: Sequence[Any], loss_or_imag: Sequence[Any], sign: int = 1) -> npt.NDArray[np.complex128]:
    """Return complex numbers; both parts are NaN if one is unknown."""
    out = _numbers(real) + 1j * sign * _numbers(loss_or_imag)
    out[np.isnan(out)] = complex(np.nan, np.nan)
    return out


def _described(dims: tuple[str, ...], values: Any, units: str, long_name: str) -> tuple[Any, ...]:
    return dims, np.array(values), {"units": units, "long_name": long_name}


def image_dataset(done: ProcessedScan) -> xarray.Dataset:
    """Return the images of a processed scan.

    Returns
    -------
    xarray.Dataset
        Dimensions `y`, `x` (metres, rig frame). `h`, `v`, `p` complex64 [y, x]: s-polarised and p-polarised channel
        and their ratio, relative to metal unless `metal_reference` begins with "none". `valid` bool [y, x].
        `p_sigma` float32 [y, x], the standard deviation of `p`, if the products have it.
        `incidence_deg`: one angle, or [y, x] if the scan was processed with one angle per pixel; left out if the
        rig is unknown. Attributes: :func:`provenance`.
    """
    import xarray

    image, plane = done.image, ("y", "x")
    unit = "reflection relative to metal" if done.metal_referenced else "arbitrary units"
    data = {
        "h": _described(plane, image.h, "1", f"s-polarised channel, {unit}"),
        "v": _described(plane, image.v, "1", f"p-polarised channel, {unit}"),
        "p": _described(plane, image.p, "1", f"polarisation ratio H / V, {unit}"),
        "valid": _described(plane, image.valid, "1", "True where the scan illuminates the pixel"),
    }
    if image.p_sigma is not None:
        about = "standard deviation of p: root of the mean variance of its real and imaginary part"
        data["p_sigma"] = _described(plane, image.p_sigma, "1", about)
    if done.rig is not None:
        if done.quality.get("incidence", {}).get("used") == "by pixel":
            angles = incidence_choice(done.rig, image.x_m, image.y_m, "pixel").used_rad
            data["incidence_deg"] = _described(plane, np.degrees(angles), "degree", "incidence angle of the pixel")
        else:
            angle = np.degrees(specular_incidence_rad(done.rig))
            data["incidence_deg"] = _described((), angle, "degree", "incidence angle")
    return xarray.Dataset(data, _axes(done), provenance(done))


def _axes(done: ProcessedScan) -> dict[str, Any]:
    return {
        name: _described((name,), getattr(done.image, f"{name}_m"), "m", f"pixel centre, {name} of the rig frame")
        for name in ("y", "x")
    }


def patch_dataset(done: ProcessedScan) -> xarray.Dataset:
    """Return the patches of a processed scan: the patch number of each pixel, and a table.

    Returns
    -------
    xarray.Dataset
        `label` int32 [y, x] (0: no patch) and, if known, `interior` bool [y, x], the pixels used for the values.
        On dimension `patch`: `name`, `confidence`, `runner_up`, `runner_up_share`, `metal_reference`, `metal_like`,
        `width` and `height` (m), `pixels`, `patch_incidence_deg`, `ratio` and `permittivity` (complex) with their
        standard errors, `permittivity_real_loss_covariance`, `dominated_by` (largest source of the error) and
        `refused` (why a patch has no result); for boxes drawn by hand `drawn_as`, if the truth is known `true_name`
        and `true_permittivity`, and with sub-bands `band_ratio` [patch, band]. Coordinates `centre_x` and `centre_y`
        (m, rig frame). Attributes: :func:`provenance`, `library`, `model`.

    Raises
    ------
    DataError
        if only images were made.
    """
    import xarray

    if not done.metal_referenced:
        raise DataError(
            f"scan {done.scan_id} has no materials",
            "only images were made of this scan",
            "`polysight process` finds patches and materials; give the folder it writes, or the scan folder",
            code=ErrorCode.NO_DATA,
        )
    plane = ("y", "x")
    data = {"label": _described(plane, done.labels, "1", "number of the patch that holds the pixel, 0 for none")}
    if done.interior is not None:
        data["interior"] = _described(plane, done.interior, "1", "True where the pixel is used for the patch's numbers")
    data |= _table(done) | _band_table(done.segments)
    naming = {key: done.materials[key] for key in ("library", "model") if done.materials.get(key)}
    return xarray.Dataset(data, _axes(done) | _patch_axes(done), provenance(done) | naming)


def _patch_axes(done: ProcessedScan) -> dict[str, Any]:
    columns = material_columns(done)
    middle = image_centre_mm(done.image.x_m, done.image.y_m)
    axes = {"patch": _described(("patch",), np.array(columns["patch"], np.int32), "1", "number of the patch in label")}
    for name, offset_mm in zip("xy", middle, strict=True):
        at = (_numbers(columns[f"centre_{name}_mm"]) + offset_mm) / 1e3
        axes[f"centre_{name}"] = _described(("patch",), at, "m", f"middle of the patch, {name} of the rig frame")
    return axes


def _table(done: ProcessedScan) -> dict[str, Any]:
    """Return the variables on dimension `patch`."""
    c = material_columns(done)
    second = [_runner_up(s) for s in done.segments]
    inverse = _numbers(c["inverse_p_standard_error"])
    rows: list[tuple[str, Any, str, str]] = [
        ("name", _text(c["name"]), "", "material; empty where it was not named"),
        ("confidence", _numbers(c["confidence"]), "1", "confidence in the name, 0 to 1"),
        ("runner_up", _text([name for name, _ in second]), "", "next likeliest material"),
        ("runner_up_share", _numbers([share for _, share in second]), "1", "probability of runner_up"),
        ("metal_reference", np.array(c["metal_reference"], bool), "1", "True where the patch is the metal reference"),
        ("metal_like", np.array(c["metal_like"], bool), "1", "True where P is too close to metal for a permittivity"),
        ("width", _numbers(c["width_mm"]) / 1e3, "m", "extent along x"),
        ("height", _numbers(c["height_mm"]) / 1e3, "m", "extent along y"),
        ("pixels", _numbers(c["pixels"]), "1", "number of pixels behind the numbers"),
        ("patch_incidence_deg", _numbers(c["incidence_deg"]), "degree", "mean incidence angle of the patch"),
        ("ratio", _complex(c["p_real"], c["p_imag"]), "1", "median of P = H / V relative to metal"),
        ("inverse_ratio_standard_error", inverse, "1", "standard error of V / H, real and imaginary part each"),
        ("permittivity", _complex(c["permittivity_real"], c["permittivity_loss"], -1), "1", "relative permittivity"),
    ]
    for part in ("real", "loss"):
        name = f"permittivity_{part}_standard_error"
        rows.append((name, _numbers(c[name]), "1", f"standard error of the permittivity, {part} part"))
    name = "permittivity_real_loss_covariance"
    rows.append((name, _numbers(c[name]), "1", "covariance of the permittivity's real part and loss"))
    rows.append(("dominated_by", _text(c["dominated_by"]), "", "what most of the permittivity's error comes from"))
    rows.append(("refused", _text(c["refused"]), "", "why the patch was not judged, and what to do"))
    if any(c["drawn_as"]):
        rows.append(("drawn_as", _text(c["drawn_as"]), "", "what a person called the box of the patch"))
    if any(c["true_name"]):
        truth = _complex(c["true_permittivity_real"], c["true_permittivity_loss"], -1)
        rows.append(("true_name", _text(c["true_name"]), "", "material of the simulated scene"))
        rows.append(("true_permittivity", truth, "1", "relative permittivity of the simulated scene"))
    return {name: _described(("patch",), values, units, about) for name, values, units, about in rows}


def _runner_up(segment: dict[str, Any]) -> tuple[str | None, float | None]:
    """Return the second most probable material and its probability (without probabilities: share of pixels)."""
    every = segment.get("probabilities") or segment.get("votes") or {}
    others = {name: share for name, share in every.items() if name != segment.get("name")}
    return max(others.items(), key=lambda item: item[1], default=(None, None))


def _band_table(segments: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the variables on dimensions `patch`, `band`; empty unless every patch has sub-bands."""
    bands = [s.get("bands") for s in segments]
    if not bands or any(b is None for b in bands):
        return {}
    rows: list[list[dict[str, Any]]] = [b for b in bands if b is not None]
    ratios = [[b.get("ratio") or {"real": None, "imag": None} for b in row] for row in rows]
    errors = [_numbers([b.get("inverse_ratio_std") for b in row]) for row in rows]
    found = [_complex([p["real"] for p in row], [p["imag"] for p in row]) for row in ratios]
    name, error = "band_ratio", "band_inverse_ratio_standard_error"
    edges = {
        f"band_{edge}_hz": _described(("band",), [b[f"{edge}_hz"] for b in rows[0]], "Hz", f"{edge} transmit frequency")
        for edge in ("first", "last")
    }
    return {
        name: _described(("patch", "band"), found, "1", "median of P = H / V in the sub-band"),
        error: _described(("patch", "band"), errors, "1", "standard error of V / H in the sub-band"),
        **edges,
    }


def full_dataset(done: ProcessedScan) -> xarray.Dataset:
    """Return :func:`image_dataset` and, if there are materials, :func:`patch_dataset` in one dataset.

    The attribute `instrument` is the rig file as JSON.
    """
    made = image_dataset(done)
    if done.metal_referenced:
        patches = patch_dataset(done)
        made = made.assign_coords(patches.coords).assign(patches.data_vars).assign_attrs(patches.attrs)
    if "instrument" in done.scan:
        made.attrs["instrument"] = json.dumps(done.scan["instrument"])
    return made
