"""A scan opened for notebooks: results as datasets, computed on first use."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from msgspec import UNSET

from polysight import process
from polysight.api.layers import layer_dataset
from polysight.catalogue import Pixels
from polysight.data import find_packaged
from polysight.imaging import Images
from polysight.jobs.label import save_labels
from polysight.materials import MODEL_OF_OPTION, MODELS, Labels, find_truth, format_permittivity
from polysight.pipeline import Pipeline
from polysight.polarimetry import Incidence
from polysight.products import (
    IMAGE,
    LABELS,
    ProcessedScan,
    Rows,
    find_products,
    format_ranges,
    full_dataset,
    image_dataset,
    label_folder,
    patch_dataset,
    permittivity_dataset,
    surface_dataset,
    write_netcdf,
)
from polysight.results import PatchFigures, Verdict, list_declared_figures
from polysight.settings import Settings
from polysight.store import MANIFEST, ScanFolder, Source, open_source
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import ConfigError, DataError, ErrorCode

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure

RIG_FILE = Path("instrument.toml")
Box = tuple[float, float, float, float]
# Description of a box in error messages.
_BOX_FORM = "a box is (x0, y0, x1, y1) in mm from the image's centre, x0 < x1 and y0 < y1"
# Variables of each patch's permittivity, in the order of the dataset.
_PERMITTIVITY = (
    "permittivity", "permittivity_real_standard_error", "permittivity_loss_standard_error",
    "permittivity_real_loss_covariance", "permittivity_real_half_width_68", "permittivity_loss_half_width_68",
    "dominated_by", "refused",
)  # fmt: skip


def open_scan(
    folder: str | os.PathLike[str],
    *,
    rig: str | os.PathLike[str] | Instrument | None = None,
    library: str | os.PathLike[str] | None = None,
    model: str | None = None,
    metal_box_mm: Box | None = None,
    bands: int = 1,
    incidence: Incidence = "one",
    incidence_deg: float | None = None,
    fresh: bool = False,
) -> Scan:
    """Open a scan. Rows are read later, when a result is asked for.

    Parameters
    ----------
    folder
        A scan folder, a folder `unsynced/<scan>` or `raw/<scan>` of the published data, a folder of products that
        `polysight process` or `polysight image` wrote, or images of another program: an `.npz` file or a folder
        `labels/<scan>` (docs/spec/given-images.md). Saved products in the folder are used if they hold all of its rows
        and none of the parameters below is given (but `rig` for a scan folder); otherwise the rows are processed.
    rig
        Rig file of published data, or the rig itself: `instrument.toml` in that folder, in the current folder or the
        packaged one if not given. Scan folders bring their own, and warn that this one is ignored.
    library
        Reference library of the materials; the packaged simulated one if not given.
    model
        Classifier: "knn", "discriminant", a full name, or "none" for no names. The library's own choice
        if not given.
    metal_box_mm
        Metal reference (x0, y0, x1, y1), mm from the image centre; found automatically if not given.
    bands
        Number of sub-bands of the sweep to image as well, for thin layers.
    incidence
        "one": one incidence angle for the image; "pixel": each pixel's own.
    incidence_deg
        Incidence angle of images of another program; that of their file, or of the rig, if not given.
    fresh
        Process the rows even if saved products could be used.

    Raises
    ------
    DataError
        when the folder is not one of these, or is damaged.
    ConfigError
        when a parameter or a rig file is wrong, or a folder of products is given with a rig or processing parameters.
    """
    _check_arguments(model, library, metal_box_mm, bands, incidence)
    path = Path(folder)
    settings = Settings(
        metal_box_mm=metal_box_mm,
        library=None if library is None else os.fspath(library),
        model=model,
        bands=bands,
        incidence=incidence,
        incidence_deg=incidence_deg,
    )
    if process.is_given_images(path):
        return Scan(path, None, _analyse_images(path, rig, settings), settings)
    process_again = fresh or settings != Settings()
    if (path / IMAGE).exists() and not (path / MANIFEST).exists():
        return _open_products_only(path, settings, process_again or rig is not None)
    source = _open_source(path, rig)
    if rig is not None and isinstance(source, ScanFolder):
        warnings.warn(f"{path}: `rig` is ignored: a scan folder has its own rig file", stacklevel=2)
    rig_is_used = rig is not None and not isinstance(source, ScanFolder)
    saved = None if process_again or rig_is_used else find_products(path)
    if saved is not None and isinstance(source, ScanFolder) and not _is_current(saved, source):
        saved = None
    return Scan(path, source, saved, settings)


def _check_arguments(
    model: str | None, library: str | os.PathLike[str] | None, box: Box | None, bands: int, incidence: str
) -> None:
    """Check the arguments before any row is read. Raises ConfigError."""
    problem = ""
    if incidence not in ("one", "pixel"):
        problem = f"incidence is {incidence!r}: 'one' or 'pixel'"
    elif not isinstance(bands, int) or bands < 1:
        problem = f"bands is {bands!r}: a whole number, 1 or more"
    elif box is not None and not _is_box(box):
        problem = f"metal_box_mm is {box!r}: {_BOX_FORM}"
    elif model is not None and model not in (*MODELS, *MODEL_OF_OPTION, "none"):
        problem = f"model is {model!r}: one of {', '.join((*MODEL_OF_OPTION, 'none'))}"
    elif not isinstance(library, str | os.PathLike | None):
        problem = f"library is {library!r}: the path of a file that Library.save wrote"
    elif library is not None and not Path(library).is_file():
        problem = f"library {library}: no such file"
    if problem:
        raise ConfigError(problem, "wrong argument", "see help(polysight.open_scan)", code=ErrorCode.VALUE_INVALID)


def find_rig_file(rig: str | os.PathLike[str] | None) -> Path:
    """Return the path of the rig file: the given one, that of the current folder, or the packaged one."""
    return find_packaged(RIG_FILE) if rig is None else Path(rig)


def _is_box(box: object) -> bool:
    """True for four numbers x0, y0, x1, y1 with x0 < x1 and y0 < y1."""
    if not isinstance(box, tuple | list | np.ndarray) or len(box) != 4:
        return False
    x0, y0, x1, y1 = box
    return bool(x0 < x1 and y0 < y1)


def _analyse_images(path: Path, rig: str | os.PathLike[str] | Instrument | None, settings: Settings) -> ProcessedScan:
    """Find the materials of images that another program made. Raises PolysightError."""
    if settings.bands > 1:
        raise ConfigError(
            f"bands = {settings.bands} with given images",
            "sub-bands need the rows of a recorded scan",
            "leave bands out",
        )
    if not isinstance(rig, Instrument):
        rig = load_instrument(find_rig_file(rig))
    scan, _, _ = process.analyse_given_images(process.read_given_images(path, rig), settings, process.Inputs(), rig)
    return scan


def _open_products_only(path: Path, settings: Settings, process_again: bool) -> Scan:
    """Open a folder of products. Raises ConfigError if they would have to be processed again."""
    if process_again:
        raise ConfigError(
            f"{path}: products cannot be processed again", "the recorded rows are not in this folder",
            "give the scan folder with these parameters, or leave them out to read the products",
            code=ErrorCode.VALUES_CONFLICT,
        )  # fmt: skip
    return Scan(path, None, ProcessedScan(path), settings)


def _open_source(path: Path, rig: str | os.PathLike[str] | Instrument | None) -> Source:
    """Open recorded data, also without raw rows; without `rig`, with the rig file in its folder or the packaged one."""
    if rig is None:
        rig = path / RIG_FILE if (path / RIG_FILE).exists() else find_packaged(RIG_FILE)
    return open_source(path, rig if isinstance(rig, Instrument) else Path(rig), dropped=True)


def _is_current(saved: ProcessedScan, scan: ScanFolder) -> bool:
    """True unless the products say that they were made from other rows than the scan holds now. Raises DataError."""
    committed = scan.committed_rows()
    for name, board in saved.quality.boards.items():
        recorded = {row: entry.boards[name].crc32 for row, entry in committed.items() if name in entry.boards}
        if board.raw_crc32 is not UNSET and board.raw_crc32 != recorded:
            return False
    return True


class Scan:
    """A recorded scan, or the products of one. Made by :func:`open_scan`.

    Results are computed once and kept. Each call returns new arrays, so that changing them changes no later result.
    Every dataset has named dimensions: `y_mm`, `x_mm` (millimetres from the image's centre, as boxes and the command
    line count them) and `patch`. `y_m`, `x_m` are the places in the rig frame, in which the centre lies at the
    attributes `image_centre_x_m`, `image_centre_y_m`. Every variable has `units` and `long_name`. The attributes hold
    the provenance: `scan_id`, `simulated`, `rig`, `versions`, `processed_utc`, `rows_missing`, `positions_masked`,
    `verdict`.

    Attributes
    ----------
    folder
        The folder that was opened.
    """

    def __init__(self, folder: Path, source: Source | None, saved: ProcessedScan | None, settings: Settings) -> None:
        # `source` holds recorded rows, `saved` products; at least one of them is given.
        self.folder = folder
        self._source = source
        self._saved = saved
        self._settings = settings

    @property
    def scan_id(self) -> str:
        """Name of the scan; "" if the products do not contain it."""
        return self._origin.scan_id

    @property
    def simulated(self) -> bool | None:
        """True if the data is simulated; None if the products do not say."""
        return self._origin.simulated

    @property
    def verdict(self) -> Verdict | None:
        """Verdict of the result, with reasons; None for products of earlier releases.

        Recorded rows are processed if there are no products. Raises as :meth:`image`.
        """
        processed = self._saved or self.read_or_process()
        return processed.verdict

    @property
    def rig(self) -> Instrument:
        """Rig of the images: geometry, chirp, boards, as calibrated; its x runs from TX to RX, as that of the images.

        Raises
        ------
        DataError
            when products do not say.
        """
        if self._saved is not None and self._saved.rig is not None:
            return self._saved.rig
        if self._source is None:
            raise self._make_unknown_error("rig")
        return self._processing.pipeline.rig

    @property
    def rows(self) -> Rows:
        """Rows of the scan: `indices`, `planned`, `committed`, `missing`. Raises DataError if products lack them."""
        if self._source is not None:
            return Rows(self._source.plan.rows, tuple(self._source.rows()))
        if self._saved is None or self._saved.rows is None:
            raise self._make_unknown_error("rows")
        return self._saved.rows

    def image(self, *, metal_referenced: bool = True) -> xarray.Dataset:
        """Both channels and their ratio on one grid.

        Parameters
        ----------
        metal_referenced
            True: relative to metal, with the cross-polar leakage removed, as `polysight process` writes them. False:
            as imaged, in arbitrary units, as `polysight image` writes them; needs no metal in the scene.

        Returns
        -------
        xarray.Dataset
            `h` (s-polarised), `v` (p-polarised), `p` (H / V) complex64 [y_mm, x_mm], `valid` bool; `incidence_deg` and
            `incidence_rad` (functions take radians); `p_sigma` (standard deviation of `p`) where it is known.

        Raises
        ------
        DataError
            when no row is whole, no metal is found, or the products have images of the other kind and no rows exist.
        """
        return image_dataset(self.read_or_process(metal_referenced))

    def patches(self) -> xarray.Dataset:
        """Patches found in the image, with everything known about each.

        Returns
        -------
        xarray.Dataset
            `label` int32 [y_mm, x_mm] and `interior` bool; on dimension `patch` the variables of `permittivity` and
            `materials`, `metal_like`, `width_mm`, `height_mm`, and `band_ratio` where sub-bands were asked for.
            Coordinates `centre_x_mm` and `centre_y_mm` say where each patch is.

        Raises
        ------
        DataError
            as :meth:`image`.
        """
        return patch_dataset(self.read_or_process(True))

    def permittivity(self) -> xarray.Dataset:
        """Relative permittivity eps' - j eps'' of each patch; not a number where P is too close to metal.

        Returns
        -------
        xarray.Dataset
            On dimension `patch`: `permittivity` complex128, `permittivity_real_standard_error`,
            `permittivity_loss_standard_error`, `permittivity_real_loss_covariance`, `permittivity_real_half_width_68`,
            `permittivity_loss_half_width_68` (of intervals of 68 %), `dominated_by` (what most of the error comes
            from), `refused` (why a patch was not judged), `ratio` (P) complex128, `inverse_ratio_standard_error` (of
            1 / P), `patch_incidence_deg` and `patch_incidence_rad`, `name`,
            `pixels`; `true_permittivity` for a simulated scene.

        Raises
        ------
        DataError
            as :meth:`image`.
        """
        angles = ("patch_incidence_deg", "patch_incidence_rad")
        ratios = ("ratio", "inverse_ratio_standard_error")
        return self._select_columns((*_PERMITTIVITY, *ratios, *angles, "name", "pixels", "true_permittivity"))

    def permittivity_map(self) -> xarray.Dataset:
        """Permittivity of each pixel as a half space, with its standard errors.

        Returns
        -------
        xarray.Dataset
            `permittivity` complex128 [y_mm, x_mm], eps' - j eps''; `permittivity_real_standard_error` and
            `permittivity_loss_standard_error`; `mask` bool: True where the scan lights the pixel, the errors are below
            half of the value, and a half space can have it (real part 1, loss 0 or more) within twice its errors.
            Neighbouring pixels have mostly the same error: a mean over a patch is not more certain than a pixel.
            Pixels are corrected for the leakage and the incidence angle that the scene determines, and those of a patch
            for all that is known of it: their median has the patch's permittivity.

        Raises
        ------
        DataError
            as :meth:`image`; when the verdict is "no result".
        """
        return permittivity_dataset(self.read_or_process())

    def probe(self, x_mm: float, y_mm: float) -> xarray.Dataset:
        """Results at the pixel nearest to a place, mm from the image's centre.

        Returns
        -------
        xarray.Dataset
            The variables of :meth:`image` and :meth:`permittivity_map`, `label` (the patch there, 0: none) and its
            `name` ("": none).

        Raises
        ------
        DataError
            as :meth:`permittivity_map`; when the place lies outside the image.
        """
        import xarray

        # Raises for a place outside.
        Pixels.from_scan(self.read_or_process()).nearest(x_mm, y_mm)
        patches = self.patches()
        maps = [self.image(), self.permittivity_map(), patches[["label"]]]
        merged = xarray.merge(maps, compat="override", join="exact", combine_attrs="override")
        pixel = merged.sel(x_mm=x_mm, y_mm=y_mm, method="nearest")
        names = dict(zip(patches["patch"].values, patches["name"].values, strict=True))
        name = str(names.get(pixel["label"].item(), ""))
        return pixel.assign(name=((), name, patches["name"].attrs))

    def columns(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
        """Pixels inside the patches for a classifier, and the number of the patch of each.

        Returns
        -------
        X, patch
            float64 [n, 4]: |H|, |V|, real and imaginary part of P; int32 [n].

        Raises
        ------
        DataError
            as :meth:`image`; when the products do not say which pixels are inside.
        """
        processed = self.read_or_process()
        if processed.interior is None:
            raise self._make_unknown_error("pixels inside the patches")
        is_patch_pixel = processed.interior & (processed.labels > 0) & np.isfinite(processed.p)
        p = processed.p[is_patch_pixel]
        X = np.stack([np.abs(processed.h[is_patch_pixel]), np.abs(processed.v[is_patch_pixel]), p.real, p.imag], axis=1)
        return X.astype(np.float64), processed.labels[is_patch_pixel]

    def label(
        self, boxes: Mapping[str, Box], *, metal: str | None = None, specimens: Mapping[str, str] | None = None
    ) -> Path:
        """Save the boxes of known materials, for training; earlier boxes of this scan are replaced.

        Parameters
        ----------
        boxes
            Name of the material to its box (x0, y0, x1, y1), mm from the image's centre. A second piece of a material
            is called `oak#2`.
        metal
            Box of the metal reference; the one with a metal's name if not given.
        specimens
            Box to the name of the piece of material in it, if several scans show the same piece.

        Returns
        -------
        Path
            The label file; a picture of the boxes lies in the same folder.

        Raises
        ------
        ConfigError
            when a box is not four numbers in this order.
        DataError
            when a box or name cannot be used; nothing was written then.
        """
        for name, box in boxes.items():
            if not _is_box(box):
                raise ConfigError(
                    f"box of {name!r} is {box!r}",
                    _BOX_FORM,
                    "see help(polysight.Scan.label)",
                    code=ErrorCode.VALUE_INVALID,
                )
        # Images of another program are one file: the labels are written into its folder.
        labels_folder = label_folder(self.folder if self.folder.is_dir() else self.folder.parent)
        save_labels(labels_folder, self.read_or_process(), Labels(dict(boxes), "mm", metal, dict(specimens or {})))
        return labels_folder / LABELS

    def materials(self) -> xarray.Dataset:
        """Name of each patch, and its permittivity with errors.

        Returns
        -------
        xarray.Dataset
            On dimension `patch`: `name` ("" when not named, "unknown" when it is not one of the library), `confidence`,
            `runner_up` and `runner_up_share` (the next name and its probability; in products without probabilities
            the share of the patch's pixels that have it),
            `metal_reference`, `pixels`;
            `permittivity`, its errors, `dominated_by` and `refused` as of :meth:`permittivity`; `true_name` for a
            simulated scene. Attributes `library`, `model`, `verdict`.

        Raises
        ------
        DataError
            as :meth:`image`.
        """
        names = ("name", "confidence", "runner_up", "runner_up_share", "metal_reference", "pixels")
        return self._select_columns((*names, *_PERMITTIVITY, "true_name"))

    def layers(self, *stack: str, bands: int | None = None, amplitude_percent: float = 10.0) -> xarray.Dataset:
        """Permittivity and thickness of the one unknown layer of a stack, on dimension `patch`, with standard errors.

        `stack` is typed as for `polysight permittivity --layer`: `scan.layers("sheet,?,0.5-3", "plate,metal")`. `bands`
        is the number of sub-bands used (None: all if a thickness is fitted), `amplitude_percent` the relative error of
        |H|. `ambiguous` and `notes` say what the data do not determine. Raises as :meth:`image`, and ConfigError.
        """
        return layer_dataset(self.read_or_process(True), self.rig.chirp, stack, bands, amplitude_percent)

    def surface(self, *, reference: str | os.PathLike[str] | None = None) -> xarray.Dataset:
        """Shape and permittivity of curved and tilted objects, as `polysight surface` finds them.

        `reference` is a scan of a flat metal plate; None: the metal sphere of the calibration. Without either the shape
        alone is given.

        Returns
        -------
        xarray.Dataset
            On dimension `point`: `position` and `normal` [point, axis] (metres, rig frame), `curvature` [point, 2, 2]
            (1 / m), `incidence_deg`, `permittivity` complex128 (not a number where it is not given),
            `permittivity_covariance` [point, 2, 2] of (real, imaginary), `segment`, `position_std`, `normal_std_deg`.

        Raises
        ------
        DataError
            when the rows are not there, or no surface shows a specular point.
        """
        from polysight.jobs.surface import make_surface

        if self._source is None:
            raise self._make_unknown_error("surface")
        plate = None if reference is None else Path(reference)
        return surface_dataset(make_surface(self.folder, self._source.instrument, plate))

    def plot(self, *, metal_referenced: bool = True) -> Figure:
        """Draw |H|, |V|, |P| (dB), and the materials' names if metal-referenced; axes in mm. Return the figure.

        Notebooks show the figure when it is the last line of a cell; `plot().savefig("scan.png")` saves it.

        Raises
        ------
        DataError
            as :meth:`image`.
        """
        from polysight.api.plot import plot_scan

        return plot_scan(self.read_or_process(metal_referenced))

    def to_netcdf(self, path: str | os.PathLike[str], *, metal_referenced: bool = True) -> None:
        """Write images and patches as one NetCDF file, see :func:`write_netcdf`, which writes maps, too.

        Raises
        ------
        ConfigError
            when h5netcdf is not installed.
        DataError
            as :meth:`image`.
        """
        write_netcdf(path, full_dataset(self.read_or_process(metal_referenced)))

    def __repr__(self) -> str:
        simulated = "SIMULATED, " if self.simulated else ""
        return f"<Scan {self._title}: {simulated}{self._row_count}, {self._kind} in {self.folder}>"

    def _repr_html_(self) -> str:
        """Return a table of the scan, and of its patches if they are known without processing rows."""
        lines = {"rows": self._row_count, "read from": f"{self._kind} in {self.folder}"}
        processed = self._result_at_hand
        patches = ""
        if processed is not None:
            if processed.verdict is not None:
                lines["verdict"] = "; ".join(
                    [processed.verdict.text, *(reason.what for reason in processed.verdict.reasons)]
                )
            if processed.metal_referenced and processed.segments:
                patches = patch_table(processed)
        cells = "".join(f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in lines.items())
        stamp = " <b>SIMULATED</b>" if self.simulated else ""
        return f"<div><h4>Scan {escape(self._title)}{stamp}</h4><table>{cells}</table>{patches}</div>"

    @property
    def _title(self) -> str:
        return self.scan_id or "without a name"

    @property
    def _kind(self) -> str:
        return "recorded rows" if self._saved is None else "saved products"

    @property
    def _row_count(self) -> str:
        """Committed and planned rows as text."""
        try:
            rows = self.rows
        except DataError:
            return "number of rows not known"
        missing = f" (missing {format_ranges(rows.missing)})" if rows.missing else ""
        return f"{len(rows.committed)} of {rows.planned} rows{missing}"

    @property
    def _result_at_hand(self) -> ProcessedScan | None:
        """The result if it is saved or was computed already; else None."""
        if self._saved is not None:
            return self._saved
        # The value of a cached property is in the `__dict__` of its object once it was computed. The properties
        # themselves are not used here, because that would compute them.
        processing = vars(self).get("_processing")
        if processing is None:
            return None
        return vars(processing).get("referenced")

    @cached_property
    def _processing(self) -> Processing:
        """The processing of the recorded rows. Raises DataError if there are none."""
        if self._source is None:
            raise DataError(
                f"{self.folder}: contains no recorded rows", "it is a folder of products", "open the scan folder "
                "instead",
                code=ErrorCode.NO_DATA,
            )  # fmt: skip
        return Processing(self._source, self.folder, self._settings)

    @property
    def _origin(self) -> Source | ProcessedScan:
        """Recorded rows, or else the products. Raises DataError without both."""
        origin = self._source or self._saved
        if origin is None:
            raise DataError(
                f"{self.folder}: contains no scan", "it is empty", "open another folder", code=ErrorCode.NO_DATA
            )
        return origin

    def read_or_process(self, metal_referenced: bool = True) -> ProcessedScan:
        """Return saved products of this kind, or else process the rows. Raises as :meth:`image`."""
        if self._saved is not None and self._saved.metal_referenced == metal_referenced:
            return self._saved
        if self._source is None:
            raise self._wrong_kind_error(metal_referenced)
        if metal_referenced:
            return self._processing.referenced
        return self._processing.unreferenced

    def _wrong_kind_error(self, metal_referenced: bool) -> DataError:
        """Return the error of products that hold images of the other kind only."""
        if metal_referenced:
            return DataError(
                f"{self.folder}: these images are not referenced to metal", "only images were made of this scan",
                "image(metal_referenced=False) reads them; `polysight process` finds metal, patches and materials",
                code=ErrorCode.MISMATCH,
            )  # fmt: skip
        return DataError(
            f"{self.folder}: these images are referenced to metal", "products do not keep the images before that",
            "open the scan folder, or ask for metal_referenced=True", code=ErrorCode.MISMATCH,
        )  # fmt: skip

    def _make_unknown_error(self, what: str) -> DataError:
        """Return the error of products that do not say `what`."""
        return DataError(
            f"{self.folder}: the {what} of the products is unknown", "an earlier release made them, or scan.json or"
            " quality.json is missing", "open the scan folder instead", code=ErrorCode.KEY_MISSING,
        )  # fmt: skip

    def _select_columns(self, names: Sequence[str]) -> xarray.Dataset:
        """Return those of the named variables that the patches have, with the coordinates of their dimension."""
        patches = self.patches()
        columns = patches[[name for name in names if name in patches]]
        return columns.drop_vars(["x_mm", "y_mm", "x_m", "y_m"], errors="ignore")


class Processing:
    """Processes one source; each step runs once, when its result is first used.

    `folder` is where the source was read; `truth.json` there holds the truth of a simulated scene.
    """

    def __init__(self, source: Source, folder: Path, settings: Settings) -> None:
        self.source = source
        self.folder = folder
        self.settings = settings

    @cached_property
    def pipeline(self) -> Pipeline:
        """The pipeline, without rows at first. Raises PolysightError when calibration and rig do not fit."""
        return Pipeline(self.source, self.settings, samples="read")

    @cached_property
    def _images(self) -> Images:
        """Both channels from all rows that hold data. Raises DataError when there are none."""
        for row in self.pipeline.samples.processable(self.source, self.folder):
            self.pipeline.add_row(row)
        images = self.pipeline.form_images()
        self.pipeline.quality.note_imaging(self.pipeline.builder, images)
        return images

    @cached_property
    def unreferenced(self) -> ProcessedScan:
        """Images in arbitrary units, as `polysight image` writes them. Raises PolysightError."""
        pipeline = self.pipeline
        return process.collect_imaged_scan(self.folder, self.source, pipeline.rig, self._images, pipeline.quality)

    @cached_property
    def referenced(self) -> ProcessedScan:
        """Images relative to metal, patches and materials, as `polysight process` writes them.

        Raises
        ------
        DataError
            when no metal is found, a row is damaged, or library or metal reference do not fit the scan.
        """
        pipeline = self.pipeline
        unnamed = process.explain_unnamed(self.settings, pipeline.rig)
        plates, note = find_truth(self.folder)
        if note:
            warnings.warn(note, stacklevel=2)
        findings = pipeline.examine(self._images, plates)
        return process.collect_processed_scan(
            self.folder, self.source, pipeline.rig, findings, pipeline.quality, unnamed
        )


def patch_table(scan: ProcessedScan) -> str:
    """Return the patches as an HTML table: the figures that reports show."""
    figures = [figure for figure in list_declared_figures(PatchFigures) if figure.column.title]
    lines = ["<tr><th>patch</th><th>name</th><th>permittivity</th>"]
    lines += [f"<th>{escape(figure.column.title)}</th>" for figure in figures]
    for patch in scan.segments:
        name = "metal reference" if patch.metal_reference else patch.name or "not named"
        value = patch.permittivity
        text = "–"
        if value is not None and value.real is not None and value.imag is not None:
            text = format_permittivity(complex(value.real, value.imag))
        cells = [str(patch.label), name, text, *(figure.format(patch) for figure in figures)]
        lines.append("</tr><tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in cells))
    return f"<table>{''.join(lines)}</tr></table>"
