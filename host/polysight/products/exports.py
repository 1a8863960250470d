"""Processed scans for other programs: xarray datasets, and files in NetCDF, MATLAB and CSV (`polysight export`).

Notebooks and exports use the same names: `image_dataset` has the pixels, `patch_dataset` the patches, `full_dataset`
both. Places are `x_mm`, `y_mm` from the image's centre; `x_m`, `y_m` are the same in the rig frame. Permittivity is
eps' - j eps'' (eps'' is the loss); unknown values are NaN. xarray is imported at first use.

NetCDF has no complex numbers: a complex variable `h` is stored as `h_real` and `h_imag`, each with the attribute
`complex_part`; :func:`read_netcdf` joins them again.
"""

from __future__ import annotations

import csv
import io
import json
import os
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import scipy
from msgspec import UNSET

from polysight.materials import axis_mm, image_centre_mm
from polysight.products.maps import map_permittivity, nominal_incidence_rad
from polysight.products.processed import ProcessedScan, read_products
from polysight.results import Figure, PatchFigures, Verdict, list_declared_figures, to_plain
from polysight.store import MAX_BYTES
from polysight.surfaces import Surface
from polysight_shared.errors import ConfigError, DataError, ErrorCode
from polysight_shared.files import write_atomically, write_together

if TYPE_CHECKING:
    import xarray

CONVENTION = (
    "H: s-polarised, V: p-polarised, P = H / V, relative to metal where a reference was found; row 0 is the smallest y,"
    " column 0 the smallest x; x_mm and y_mm from the image's centre, x_m and y_m in the rig frame; permittivity is"
    " real - j loss"
)
PLANE_DIMENSIONS = ("y_mm", "x_mm")
"""Dimensions of images in datasets."""
# Attribute of a real variable that is one part of a complex one.
_PART = "complex_part"
UNREFERENCED = "none: h, v and p are in arbitrary units"
"""Value of the attribute `metal_reference` if only images were made."""


def format_ranges(numbers: Sequence[int]) -> str:
    """Return ascending numbers as text, `3, 7-9`; `none` without numbers."""
    ranges: list[list[int]] = []
    for n in numbers:
        if ranges and n == ranges[-1][1] + 1:
            ranges[-1][1] = n
        else:
            ranges.append([n, n])
    texts = []
    for first, last in ranges:
        if first == last:
            texts.append(f"{first}")
        else:
            texts.append(f"{first}-{last}")
    return ", ".join(texts) or "none"


def verdict_attributes(verdict: Verdict | None) -> dict[str, str]:
    """Return `verdict` (the level) and `verdict_reasons` as JSON (what, why, do); empty without a verdict."""
    if verdict is None:
        return {}
    content = verdict.to_dict()
    return {"verdict": content["level"], "verdict_reasons": json.dumps(content["reasons"], ensure_ascii=False)}


def provenance(scan: ProcessedScan) -> dict[str, Any]:
    """Return the attributes of every dataset: identity and origin of the data. Unknown entries are left out.

    `simulated` is True, False or "unknown"; `versions` is JSON; `rows_missing` and `positions_masked` are text; see
    :func:`verdict_attributes` for `verdict` and `verdict_reasons`.
    """
    simulated = "unknown" if scan.simulated is None else scan.simulated
    metal = UNREFERENCED
    if scan.materials is not None:
        # Products of earlier releases do not say how the metal reference was found.
        metal = "given"
        if scan.materials.metal_reference:
            metal = scan.materials.metal_reference.how
    title = f"scan {scan.scan_id or 'without a name'}"
    if simulated is True:
        title += " (simulated)"
    attrs: dict[str, Any] = {
        "title": title,
        "scan_id": scan.scan_id,
        "simulated": simulated,
        "convention": CONVENTION,
        "metal_reference": metal,
        **verdict_attributes(scan.verdict),
    }
    centre_x_mm, centre_y_mm = image_centre_mm(scan.x_m, scan.y_m)
    attrs["image_centre_x_m"] = centre_x_mm / 1e3
    attrs["image_centre_y_m"] = centre_y_mm / 1e3
    if scan.rig is not None:
        attrs["rig"] = scan.rig.name
    if scan.facts.processed_utc:
        attrs["processed_utc"] = scan.facts.processed_utc
    if scan.facts.versions:
        attrs["versions"] = json.dumps(scan.facts.versions)
    if scan.rows is not None:
        attrs["rows_planned"] = scan.rows.planned
        attrs["rows_missing"] = format_ranges(scan.rows.missing)
    masked = [
        f"{name} {board.positions_masked} of {board.positions}"
        for name, board in scan.quality.boards.items()
        if board.positions_masked is not UNSET and board.positions is not UNSET
    ]
    if masked:
        attrs["positions_masked"] = ", ".join(masked)
    return attrs


def _convert_numbers(values: Sequence[Any]) -> npt.NDArray[np.float64]:
    """Return numbers as an array; None becomes NaN."""
    return np.array(values, np.float64)


def _describe(dims: tuple[str, ...], values: Any, units: str, long_name: str) -> tuple[Any, ...]:
    """Return a variable as xarray takes it: dimensions, values, attributes."""
    return dims, np.array(values), {"units": units, "long_name": long_name}


def image_dataset(scan: ProcessedScan) -> xarray.Dataset:
    """Return the images of a processed scan.

    Returns
    -------
    xarray.Dataset
        Dimensions `y_mm`, `x_mm`: millimetres from the image's centre; coordinates `y_m`, `x_m`: metres in the rig
        frame. `h`, `v`, `p` complex64 [y_mm, x_mm]: s-polarised and p-polarised channel and their ratio, relative to
        metal unless `metal_reference` begins with "none". `valid` bool. `p_sigma` float32, the standard deviation of
        `p`, if the products have it. `incidence_deg` and `incidence_rad`: one angle, or an angle per pixel if the scan
        was processed so; left out if it is unknown. Attributes: :func:`provenance`.
    """
    import xarray

    images = scan.images
    unit = "reflection relative to metal" if scan.metal_referenced else "arbitrary units"
    data = {
        "h": _describe(PLANE_DIMENSIONS, images.h, "1", f"s-polarised channel, {unit}"),
        "v": _describe(PLANE_DIMENSIONS, images.v, "1", f"p-polarised channel, {unit}"),
        "p": _describe(PLANE_DIMENSIONS, images.p, "1", f"polarisation ratio H / V, {unit}"),
        "valid": _describe(PLANE_DIMENSIONS, images.valid, "1", "True where the scan illuminates the pixel"),
    }
    if images.p_sigma is not None:
        long_name = "standard deviation of p: root of the mean variance of its real and imaginary part"
        data["p_sigma"] = _describe(PLANE_DIMENSIONS, images.p_sigma, "1", long_name)
    angle_rad = nominal_incidence_rad(scan)
    if np.isfinite(angle_rad).all():
        dims = ()
        if np.ndim(angle_rad):
            dims = PLANE_DIMENSIONS
        data["incidence_deg"] = _describe(dims, np.degrees(angle_rad), "degree", "incidence angle")
        data["incidence_rad"] = _describe(dims, angle_rad, "rad", "incidence angle")
    return xarray.Dataset(data, _make_axes(scan), provenance(scan))


def _make_axes(scan: ProcessedScan) -> dict[str, Any]:
    """Return the coordinates of the pixels. `axis` lets programs for maps find x and y."""
    axes: dict[str, Any] = {}
    for name, place_m in (("y", scan.y_m), ("x", scan.x_m)):
        dims = (f"{name}_mm",)
        # Rounded, so that `.sel(x_mm=20)` finds a pixel whose centre is at 20 mm.
        place_mm = np.round(axis_mm(place_m), 6)
        axes[f"{name}_mm"] = _describe(dims, place_mm, "mm", f"pixel centre, {name} from the image's centre")
        _, _, attributes = axes[f"{name}_mm"]
        attributes["axis"] = name.upper()
        axes[f"{name}_m"] = _describe(dims, place_m, "m", f"pixel centre, {name} of the rig frame")
    return axes


def patch_dataset(scan: ProcessedScan) -> xarray.Dataset:
    """Return the patches of a processed scan: the patch number of each pixel, and a table.

    Returns
    -------
    xarray.Dataset
        `label` int32 [y_mm, x_mm] (0: no patch) and, if known, `interior` bool, the pixels used for the values.
        On dimension `patch` the figures declared in :class:`polysight.results.PatchFigures`, and with sub-bands
        `band_ratio` [patch, band]. Coordinates `centre_x_mm` and `centre_y_mm` from the image's centre. Attributes:
        :func:`provenance`, `library`, `model`.

    Raises
    ------
    DataError
        if only images were made.
    """
    import xarray

    if scan.materials is None:
        raise _no_materials_error(scan)
    data = {
        "label": _describe(PLANE_DIMENSIONS, scan.labels, "1", "number of the patch that holds the pixel, 0 for none")
    }
    if scan.interior is not None:
        data["interior"] = _describe(
            PLANE_DIMENSIONS, scan.interior, "1", "True where the pixel is used for the patch's numbers"
        )
    data |= _make_figure_variables(scan.segments) | _make_band_variables(scan.segments)
    naming = {"library": scan.materials.library, "model": scan.materials.model}
    attributes = provenance(scan) | {key: text for key, text in naming.items() if text}
    return xarray.Dataset(data, _make_axes(scan) | patch_coordinates(scan), attributes)


def permittivity_dataset(scan: ProcessedScan) -> xarray.Dataset:
    """Return the permittivity of each pixel as a half space, with its standard errors (:func:`map_permittivity`).

    Neighbouring pixels share most of their error: averaging over a patch does not reduce it.

    Returns
    -------
    xarray.Dataset
        `permittivity` complex128 [y_mm, x_mm], eps' - j eps''; `permittivity_real_standard_error` and
        `permittivity_loss_standard_error` float64; `mask` bool: True where the pixel is lit, the errors are below
        half of the value, and a half space can have it within twice its errors: no loss below 0, no real part below
        1. The values are not a number where the scan lights nothing.

    Raises
    ------
    DataError
        if only images were made, or the verdict is "no result".
    """
    import xarray

    if scan.materials is None:
        raise _no_materials_error(scan)
    if scan.verdict is not None and not scan.verdict.usable:
        raise scan.verdict.error("the images are kept")
    pixels = map_permittivity(scan)
    mask = "True where the permittivity is possible and known to half of its size"
    data = {
        "permittivity": _describe(
            PLANE_DIMENSIONS, pixels.value, "1", "relative permittivity eps' - j eps'' as a half space"
        ),
        "permittivity_real_standard_error": _describe(PLANE_DIMENSIONS, pixels.real_std, "1", "standard error of eps'"),
        "permittivity_loss_standard_error": _describe(
            PLANE_DIMENSIONS, pixels.loss_std, "1", "standard error of eps''"
        ),
        "mask": _describe(PLANE_DIMENSIONS, pixels.mask, "1", mask),
    }
    return xarray.Dataset(data, _make_axes(scan), provenance(scan))


def _no_materials_error(scan: ProcessedScan) -> DataError:
    """Return the error for a scan of which only images were made."""
    return DataError(
        f"scan {scan.scan_id} has no materials",
        "only images were made of this scan",
        "`polysight process` finds patches and materials; give the folder it writes, or the scan folder",
        code=ErrorCode.NO_DATA,
    )


def patch_coordinates(scan: ProcessedScan) -> dict[str, Any]:
    """Return number and middle of each patch, as coordinates of a dataset."""
    numbers = np.array([patch.label for patch in scan.segments], np.int32)
    centre_x_mm = _convert_numbers([patch.centre_x_mm for patch in scan.segments])
    centre_y_mm = _convert_numbers([patch.centre_y_mm for patch in scan.segments])
    return {
        "patch": _describe(("patch",), numbers, "1", "number of the patch in label"),
        "centre_x_mm": _describe(("patch",), centre_x_mm, "mm", "middle of the patch, x from the image's centre"),
        "centre_y_mm": _describe(("patch",), centre_y_mm, "mm", "middle of the patch, y from the image's centre"),
    }


def _make_figure_variables(patches: Sequence[PatchFigures]) -> dict[str, Any]:
    """Return a variable on dimension `patch` for each figure declared to be a variable, and angles in radians too.

    Optional figures that no patch has are left out.
    """
    variables = {}
    for figure in _patch_figures(patches):
        values = figure.values(patches)
        if not figure.variable or (figure.column.optional and not any(values)):
            continue
        array = figure.array(patches)
        column = figure.column
        variables[figure.variable] = _describe(("patch",), array, column.unit, column.about)
        if column.unit == "degree":
            name = f"{figure.variable.removesuffix('_deg')}_rad"
            variables[name] = _describe(("patch",), np.radians(array), "rad", column.about)
    return variables


def _make_band_variables(patches: Sequence[PatchFigures]) -> dict[str, Any]:
    """Return the variables on dimensions `patch`, `band`; empty unless every patch has sub-bands."""
    rows = [patch.bands for patch in patches if patch.bands]
    if not rows or len(rows) < len(patches):
        return {}
    ratios = np.full((len(rows), len(rows[0])), complex(np.nan, np.nan))
    for i, row in enumerate(rows):
        for j, band in enumerate(row):
            if band.ratio is not None:
                ratios[i, j] = band.ratio.value
    errors = [_convert_numbers([band.inverse_ratio_std for band in row]) for row in rows]
    first_hz = [band.first_hz for band in rows[0]]
    last_hz = [band.last_hz for band in rows[0]]
    plane = ("patch", "band")
    return {
        "band_ratio": _describe(plane, ratios, "1", "median of P = H / V in the sub-band"),
        "band_inverse_ratio_standard_error": _describe(plane, errors, "1", "standard error of V / H in the sub-band"),
        "band_first_hz": _describe(("band",), first_hz, "Hz", "first transmit frequency"),
        "band_last_hz": _describe(("band",), last_hz, "Hz", "last transmit frequency"),
    }


def full_dataset(scan: ProcessedScan) -> xarray.Dataset:
    """Return :func:`image_dataset` and, if there are materials, :func:`patch_dataset` in one dataset.

    The attribute `instrument` is the rig file as JSON.
    """
    dataset = image_dataset(scan)
    if scan.materials is not None:
        patches = patch_dataset(scan)
        dataset = dataset.assign_coords(patches.coords).assign(patches.data_vars).assign_attrs(patches.attrs)
    if scan.facts.instrument:
        dataset.attrs["instrument"] = json.dumps(scan.facts.instrument)
    return dataset


def surface_dataset(surface: Surface) -> xarray.Dataset:
    """Return points, normals, curvatures and permittivities of surfaces, on dimension `point`."""
    import xarray

    square = ("point", "row", "column")
    return xarray.Dataset(
        {
            "position": _describe(("point", "axis"), surface.points_m, "m", "specular point, rig frame"),
            "normal": _describe(("point", "axis"), surface.normals, "1", "unit normal towards the antennas"),
            "curvature": _describe(square, surface.curvature, "1/m", "curvature, positive for convex bodies"),
            "incidence_deg": _describe(("point",), surface.incidence_deg, "degree", "angle of incidence"),
            "incidence_rad": _describe(("point",), np.radians(surface.incidence_deg), "rad", "angle of incidence"),
            "permittivity": _describe(("point",), surface.permittivity, "1", "relative permittivity"),
            "permittivity_covariance": _describe(square, surface.covariance, "1", "covariance of (real, imaginary)"),
            "position_std": _describe(("point",), surface.position_std_m, "m", "standard deviation along the normal"),
            "normal_std_deg": _describe(("point",), surface.normal_std_deg, "degree", "standard deviation"),
            "segment": _describe(("point",), surface.segment, "1", "number of the connected surface"),
        },
        coords={"axis": ["x", "y", "z"]},
        attrs={"scan_id": surface.scan_id, "simulated": int(surface.simulated)},
    )


def split_complex(dataset: xarray.Dataset) -> xarray.Dataset:
    """Return a dataset with each complex variable `h` replaced by real variables `h_real` and `h_imag`."""
    variables: dict[str, Any] = {}
    for name, variable in dataset.data_vars.items():
        if variable.dtype.kind != "c":
            variables[str(name)] = variable
            continue
        long_name = variable.attrs.get("long_name", str(name))
        for suffix, part in (("real", "real"), ("imag", "imaginary")):
            values = getattr(variable, suffix)
            attrs = {**variable.attrs, "long_name": f"{long_name}, {part} part", _PART: suffix}
            variables[f"{name}_{suffix}"] = values.copy().assign_attrs(attrs)
    return dataset.drop_vars(list(dataset.data_vars)).assign(variables)


def join_complex(dataset: xarray.Dataset) -> xarray.Dataset:
    """Undo :func:`split_complex`: join the variables with the attribute `complex_part`."""
    variables: dict[str, Any] = {}
    for full_name, variable in dataset.data_vars.items():
        name, _, suffix = str(full_name).rpartition("_")
        part = variable.attrs.get(_PART)
        if part == "real" and f"{name}_imag" in dataset:
            joined = np.empty(variable.shape, np.result_type(variable.dtype, np.complex64))
            joined.real = variable.values
            joined.imag = dataset[f"{name}_imag"].values
            attrs = {key: text for key, text in variable.attrs.items() if key != _PART}
            attrs["long_name"] = str(attrs.get("long_name", name)).removesuffix(", real part")
            variables[name] = (variable.dims, joined, attrs)
        elif not (part == "imag" and suffix == "imag"):
            # Imaginary parts are left out: they are joined with their real parts.
            variables[str(full_name)] = variable
    return dataset.drop_vars(list(dataset.data_vars)).assign(variables)


def _require_h5netcdf() -> None:
    """Raise ConfigError if the package for NetCDF files is not installed."""
    try:
        import_module("h5netcdf")
    except ImportError:
        raise ConfigError(
            "NetCDF needs the package h5netcdf, which is not installed",
            "only NetCDF files use it, so it is optional",
            "pip install h5netcdf h5py",
            code=ErrorCode.PACKAGE_MISSING,
        ) from None


def write_netcdf(path: str | os.PathLike[str], dataset: xarray.Dataset) -> None:
    """Write any dataset of a scan, such as a map, as a NetCDF 4 file that :func:`read_netcdf` reads back.

    NetCDF has neither complex numbers nor truth values among attributes, so that `Dataset.to_netcdf` refuses: a complex
    variable `h` becomes `h_real` and `h_imag`, True and False become 1 and 0. The file's folder is made.

    Raises
    ------
    ConfigError
        if h5netcdf is not installed.
    """
    write_atomically(Path(path), pack_netcdf(dataset))


def pack_netcdf(dataset: xarray.Dataset) -> bytes:
    """Return the content of a NetCDF 4 file, converted as in :func:`write_netcdf`.

    Raises
    ------
    ConfigError
        if h5netcdf is not installed.
    """
    _require_h5netcdf()
    split = split_complex(dataset)
    for key, value in split.attrs.items():
        if isinstance(value, bool):
            split.attrs[key] = int(value)
    packed = {"zlib": True, "complevel": 4, "shuffle": True}
    encoding = {name: packed for name, v in split.data_vars.items() if v.ndim == 2 and v.dtype.kind in "biuf"}
    buffer = io.BytesIO()
    split.to_netcdf(buffer, engine="h5netcdf", encoding=encoding)
    return buffer.getvalue()


def read_netcdf(path: str | os.PathLike[str]) -> xarray.Dataset:
    """Load a file of `Scan.to_netcdf`, `write_netcdf` or `polysight export --netcdf`, with complex variables.

    Raises
    ------
    ConfigError
        if h5netcdf is not installed.
    DataError
        if the file cannot be read.
    """
    import xarray

    _require_h5netcdf()
    path = Path(path)
    try:
        _check_hdf5(path)
        dataset = xarray.load_dataset(path, engine="h5netcdf")
    except (OSError, ValueError) as e:
        raise DataError(
            f"{path}: not a NetCDF file: {e}",
            "the path is wrong, or the file is damaged",
            "give a file that `polysight export --netcdf` wrote",
            code=ErrorCode.FILE_UNREADABLE,
        ) from None
    if "simulated" in dataset.attrs and dataset.attrs["simulated"] != "unknown":
        dataset.attrs["simulated"] = bool(dataset.attrs["simulated"])
    return join_complex(dataset)


def _check_hdf5(path: Path) -> None:
    """Raise DataError if a file's arrays are in other files, or too large to be read. Raises OSError."""
    import h5py

    sizes: list[int] = []
    external: list[str] = []
    with h5py.File(path, "r") as file:
        # HDF5 calls this function from C: it must not raise.
        def check(name: str) -> None:
            is_external = isinstance(file.get(name, getlink=True), h5py.ExternalLink)
            content = None
            if not is_external:
                content = file.get(name)
            if isinstance(content, h5py.Dataset):
                is_external = bool(content.external) or content.is_virtual
                sizes.append((content.size or 0) * content.dtype.itemsize)
            if is_external:
                external.append(name)

        file.visit_links(check)
    if external:
        raise DataError(
            f"{path}: {external[0]} lies in another file",
            "it was not written by this program",
            "give a file that `polysight export --netcdf` wrote",
            code=ErrorCode.PATH_OUTSIDE,
        )
    if sum(sizes) > MAX_BYTES:
        raise DataError(
            f"{path}: its arrays take {sum(sizes)} bytes, more than the limit of {MAX_BYTES} bytes",
            "it was not written by this program, or is damaged",
            "export the products again",
            code=ErrorCode.FILE_TOO_LARGE,
        )


def table_figures(scan: ProcessedScan) -> list[Figure]:
    """Return the declared figures that are columns of the exported tables."""
    return [figure for figure in _patch_figures(scan.segments) if figure.column.name]


def _patch_figures(patches: Sequence[PatchFigures]) -> tuple[Figure, ...]:
    """Return the figures that the patches' class declares: a subclass of `PatchFigures` may declare more."""
    if not patches:
        return list_declared_figures(PatchFigures)
    return list_declared_figures(type(patches[0]))


def pack_csv(scan: ProcessedScan) -> bytes:
    """Return the table of materials as CSV: comma, UTF-8, a header line; unknown values are empty, digits are kept.

    The last columns, `verdict` and `verdict_reasons` (JSON), are the same in every line; products without a verdict
    have none.
    """
    columns = {figure.column.name: figure.values(scan.segments) for figure in table_figures(scan)}
    count = len(scan.segments)
    columns |= {name: [value] * count for name, value in verdict_attributes(scan.verdict).items()}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue().encode("utf-8")


# Longest name of a variable or field in MATLAB (namelengthmax).
_LONGEST_NAME = 63


def pack_mat(scan: ProcessedScan) -> bytes:
    """Return the content of a MATLAB file.

    `h`, `v`, `p`, `valid` [y, x]; `x_mm`, `y_mm` from the image's centre, `x_m`, `y_m` in the rig frame; structs
    `materials`, `config` (the rig file), `versions`; `scan_id`, `simulated` (NaN if unknown), `convention`. If known
    also `p_sigma` [y, x], `verdict` and `verdict_reasons` (JSON). `quality_json` and `materials_json` are the files as
    text, for jsondecode.
    """
    images = scan.images
    content = {
        "h": images.h,
        "v": images.v,
        "p": images.p,
        "valid": images.valid,
        "x_mm": axis_mm(images.x_m)[None, :],
        "y_mm": axis_mm(images.y_m)[:, None],
        "x_m": images.x_m[None, :],
        "y_m": images.y_m[:, None],
        "materials": {figure.column.name: _convert_column(figure, scan) for figure in table_figures(scan)},
        "config": _convert_struct(scan.facts.instrument or {}),
        "versions": _convert_struct(scan.facts.versions or {}),
        "scan_id": scan.scan_id,
        "simulated": np.nan if scan.simulated is None else scan.simulated,
        "convention": CONVENTION,
        "quality_json": json.dumps(to_plain(scan.quality)),
        "materials_json": json.dumps(to_plain(scan.materials) or {}),
        **verdict_attributes(scan.verdict),
    }
    if images.p_sigma is not None:
        content["p_sigma"] = images.p_sigma
    buffer = io.BytesIO()
    scipy.io.savemat(buffer, content, long_field_names=True, do_compression=True, oned_as="column")
    return buffer.getvalue()


def _convert_column(figure: Figure, scan: ProcessedScan) -> Any:
    """Return a column of numbers (NaN if unknown) or of bools, or a cell array of text."""
    column = figure.array(scan.segments)
    if figure.kind is str:
        column = column.astype(object)
    return column[:, None]


def _convert_struct(node: Any) -> Any:
    """Convert nested dicts to structs with MATLAB's names; lists other than of numbers become cell arrays.

    Keys without a value (None) are left out. A dict without keys becomes an empty matrix.
    """
    if isinstance(node, dict):
        return {
            _make_matlab_name(k): _convert_struct(value) for k, value in node.items() if value is not None
        } or np.zeros((0, 0))
    if isinstance(node, list | tuple):
        if node and all(isinstance(value, int | float) and not isinstance(value, bool) for value in node):
            return np.array(node, np.float64)[None, :]
        cells = np.empty((1, len(node)), dtype=object)
        for i, value in enumerate(node):
            cells[0, i] = _convert_struct(value)
        return cells
    if isinstance(node, int) and not isinstance(node, bool):
        return float(node)
    return node


def _make_matlab_name(key: str) -> str:
    """Return a name that MATLAB accepts: a letter first, then letters, digits and underscores."""
    name = re.sub(r"\W", "_", key)
    if not name[:1].isalpha():
        name = f"x{name}"
    return name[:_LONGEST_NAME]


# End of the name of the folder into which exports are written by default.
_FOLDER = "export"


def create_export_folder(folder: Path, out: Path | None) -> Path:
    """Create and return the folder for exports: `out`, or one next to `folder`. Raises ConfigError for a link."""
    if out is None:
        out = folder.parent / f"{folder.name}-{_FOLDER}"
        if out.is_symlink():
            raise ConfigError(
                f"{out} is a link", "files elsewhere would be overwritten", "give --out, or remove the link",
                code=ErrorCode.PATH_OUTSIDE,
            )  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    return out


def export(folder: Path, formats: list[str], out: Path | None) -> int:
    """Write the requested formats ("netcdf", "mat", "csv"), all or none; return 0, the exit status of the command.

    Each format is printed to stderr before it is made, each file to stdout when all are written. `folder` is that of
    the products or of their scan, `out` the folder to write to (:func:`create_export_folder`).

    Raises
    ------
    PolysightError
        if no format is requested, the products cannot be read, or a package is missing.
    OSError
        if a file cannot be written; nothing was written then.
    """
    if not formats:
        raise ConfigError(
            "nothing to export",
            "no format was given",
            "add one or more of --netcdf, --mat, --csv",
            code=ErrorCode.KEY_MISSING,
        )
    scan = read_products(folder)
    if "csv" in formats and scan.materials is None:
        raise DataError(
            f"{scan.folder}: no materials.json",
            "this scan has images only",
            "polysight process finds the materials",
            code=ErrorCode.FILE_MISSING,
        )
    out = create_export_folder(scan.folder, out)
    packers = {
        "netcdf": ("image.nc", lambda: pack_netcdf(full_dataset(scan))),
        "mat": ("image.mat", lambda: pack_mat(scan)),
        "csv": ("materials.csv", lambda: pack_csv(scan)),
    }
    files: dict[Path, bytes] = {}
    for kind in formats:
        sys.stderr.write(f"writing {kind} ...\n")
        sys.stderr.flush()
        name, pack = packers[kind]
        files[out / name] = pack()
    write_together(files)
    sys.stdout.write("".join(f"{path}\n" for path in files))
    return 0
