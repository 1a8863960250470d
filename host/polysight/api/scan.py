"""A scan opened for notebooks: results as datasets, computed on first use."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from msgspec import UNSET

from polysight.data import packaged
from polysight.imaging import Images
from polysight.materials import (
    LAYER_FORMS,
    MODELS,
    SHORT,
    Layer,
    LayerFit,
    find_truth,
    fit_row,
    incidence_std_rad,
    parse_layer,
)
from polysight.pipeline import Pipeline
from polysight.polarimetry import Incidence
from polysight.process import imaged_scan, processed_scan, why_unnamed
from polysight.products import (
    IMAGE,
    ProcessedScan,
    Rows,
    find_products,
    full_dataset,
    image_dataset,
    patch_dataset,
    ranges_text,
    surface_dataset,
    write_netcdf,
)
from polysight.results import Verdict
from polysight.settings import Settings
from polysight.store import MANIFEST, ScanFolder, Source, open_source
from polysight_shared.config import Chirp, Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure

RIG = Path("instrument.toml")
Box = tuple[float, float, float, float]
_PERMITTIVITY = (
    "permittivity", "permittivity_real_standard_error", "permittivity_loss_standard_error",
    "permittivity_real_loss_covariance", "dominated_by", "refused",
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
    fresh: bool = False,
) -> Scan:
    """Open a scan. Rows are read later, when a result is asked for.

    Parameters
    ----------
    folder
        A scan folder, a folder `unsynced/<scan>` or `raw/<scan>` of the published data, or a folder of products that
        `polysight process` or `polysight image` wrote. Saved products in a scan folder are used if they hold all of
        its rows and none of the parameters below is given; otherwise the rows are processed.
    rig
        Rig file of published data, or the rig itself: `instrument.toml` in that folder, in the current folder or the
        packaged one if not given. Scan folders bring their own.
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
    fresh
        Process the rows even where saved products could be used.

    Raises
    ------
    DataError
        when the folder is none of these, or is damaged.
    ConfigError
        when a folder of products is given with processing parameters, or a rig file is wrong.
    """
    _check_arguments(model, library, metal_box_mm, bands, incidence)
    path = Path(folder)
    settings = Settings(
        metal_box_mm=metal_box_mm,
        library=None if library is None else os.fspath(library),
        model=model,
        bands=bands,
        incidence=incidence,
    )
    anew = fresh or settings != Settings()
    if (path / IMAGE).exists() and not (path / MANIFEST).exists():
        return _products_only(path, settings, anew)
    source = _open_source(path, rig)
    saved = None if anew else find_products(path)
    if saved is not None and isinstance(source, ScanFolder) and not _is_current(saved, source):
        saved = None
    return Scan(path, source, saved, settings)


def _check_arguments(
    model: str | None, library: str | os.PathLike[str] | None, box: Box | None, bands: int, incidence: str
) -> None:
    """Check the arguments before any row is read. Raises ConfigError."""
    wrong = ""
    if incidence not in ("one", "pixel"):
        wrong = f"incidence is {incidence!r}: 'one' or 'pixel'"
    elif not isinstance(bands, int) or bands < 1:
        wrong = f"bands is {bands!r}: a whole number, 1 or more"
    elif box is not None and (isinstance(box, str) or len(box) != 4 or not (box[0] < box[2] and box[1] < box[3])):
        wrong = f"metal_box_mm is {box!r}: (x0, y0, x1, y1) in mm from the image centre, x0 < x1 and y0 < y1"
    elif model is not None and model not in (*MODELS, *SHORT, "none"):
        wrong = f"model is {model!r}: one of {', '.join((*SHORT, 'none'))}"
    elif library is not None and not Path(library).is_file():
        wrong = f"library {library}: no such file"
    if wrong:
        raise ConfigError(wrong, "the argument is wrong", "see help(polysight.open_scan)", code=ErrorCode.VALUE_INVALID)


def _products_only(path: Path, settings: Settings, anew: bool) -> Scan:
    if anew:
        raise ConfigError(
            f"{path}: products cannot be processed again", "the recorded rows are not in this folder",
            "give the scan folder with these parameters, or leave them out to read the products",
            code=ErrorCode.VALUES_CONFLICT,
        )  # fmt: skip
    return Scan(path, None, ProcessedScan(path), settings)


def _open_source(path: Path, rig: str | os.PathLike[str] | Instrument | None) -> Source:
    """Open recorded data of any layout; without `rig`, with the rig file beside it or the packaged one."""
    if rig is None:
        rig = path / RIG if (path / RIG).exists() else packaged(RIG)
    return open_source(path, rig if isinstance(rig, Instrument) else Path(rig), dropped=True)


def _is_current(saved: ProcessedScan, scan: ScanFolder) -> bool:
    """True unless the products say that they were made from other rows than the scan holds now. Raises DataError."""
    committed = scan.committed()
    for name, board in saved.quality.boards.items():
        recorded = {row: entry.boards[name].crc32 for row, entry in committed.items() if name in entry.boards}
        if board.raw_crc32 is not UNSET and board.raw_crc32 != recorded:
            return False
    return True


class Scan:
    """A recorded scan, or the products of one. Made by :func:`open_scan`.

    Results are computed once and kept. Each call returns new arrays, so that changing them changes no later result.
    Every dataset has named dimensions (`y`, `x` in metres in the rig frame, `patch`), `units` and `long_name` on each
    variable, and its provenance as attributes: `scan_id`, `simulated`, `rig`, `versions`, `processed_utc`,
    `rows_missing`, `positions_masked`, `verdict`.

    Attributes
    ----------
    folder
        The folder that was opened.
    """

    def __init__(self, folder: Path, source: Source | None, saved: ProcessedScan | None, settings: Settings) -> None:
        self.folder = folder
        self._source, self._saved_products, self._settings = source, saved, settings

    @property
    def scan_id(self) -> str:
        """Name of the scan; "" when its products do not say."""
        return self._source.scan_id if self._source is not None else self._saved.scan_id

    @property
    def simulated(self) -> bool | None:
        """True if the data is simulated; None when the products do not say."""
        return self._source.simulated if self._source is not None else self._saved.simulated

    @property
    def verdict(self) -> Verdict | None:
        """Verdict of the result, with reasons; None for products of earlier releases.

        Processes recorded rows where there are no products. Raises as :meth:`image`.
        """
        return self._saved.verdict if self._saved_products is not None else self._processed(True).verdict

    @property
    def rig(self) -> Instrument:
        """Rig of the images: geometry, chirp, boards, as calibrated; x from TX to RX.

        Raises
        ------
        DataError
            when products do not say.
        """
        known = self._saved.rig if self._saved_products is not None else self._processing.pipeline.rig
        if known is None and self._source is not None:
            known = self._processing.pipeline.rig
        if known is None:
            raise self._unknown("rig")
        return known

    @property
    def rows(self) -> Rows:
        """Rows of the scan: `indices`, `planned`, `committed`, `missing`. Raises DataError when products do not say."""
        if self._source is not None:
            return Rows(self._source.plan.rows, tuple(self._source.rows()))
        known = self._saved.rows
        if known is None:
            raise self._unknown("rows")
        return known

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
            `h` (s-polarised), `v` (p-polarised), `p` (H / V) complex64 [y, x], `valid` bool [y, x], `incidence_deg`;
            `p_sigma` (standard deviation of `p`) where it is known.

        Raises
        ------
        DataError
            when no row is whole, no metal is found, or the products hold the other kind and the rows are not there.
        """
        return image_dataset(self._processed(metal_referenced))

    def patches(self) -> xarray.Dataset:
        """Patches found in the image, with everything known about each.

        Returns
        -------
        xarray.Dataset
            `label` int32 [y, x] and `interior` bool [y, x]; on dimension `patch` the variables of `permittivity` and
            `materials`, `metal_like`, `width` and `height` (m), and `band_ratio` where sub-bands were asked for.

        Raises
        ------
        DataError
            as :meth:`image`.
        """
        return patch_dataset(self._processed(True))

    def permittivity(self) -> xarray.Dataset:
        """Relative permittivity eps' - j eps'' of each patch; not a number where P is too close to metal.

        Returns
        -------
        xarray.Dataset
            On dimension `patch`: `permittivity` complex128, `permittivity_real_standard_error`,
            `permittivity_loss_standard_error`, `permittivity_real_loss_covariance`, `dominated_by` (what most of the
            error comes from), `refused` (why a patch was not judged), `ratio` (P) complex128,
            `inverse_ratio_standard_error` (of 1 / P), `patch_incidence_deg`, `name`, `pixels`; `true_permittivity` for
            a simulated scene.

        Raises
        ------
        DataError
            as :meth:`image`.
        """
        return self._columns(
            *_PERMITTIVITY, "ratio", "inverse_ratio_standard_error", "patch_incidence_deg", "name", "pixels",
            "true_permittivity",
        )  # fmt: skip

    def materials(self) -> xarray.Dataset:
        """Name of each patch, and its permittivity with errors.

        Returns
        -------
        xarray.Dataset
            On dimension `patch`: `name` ("" when not named, "unknown" when it is none of the library), `confidence`,
            `runner_up` and `runner_up_share` (the next name by number of pixels), `metal_reference`, `pixels`;
            `permittivity`, its errors, `dominated_by` and `refused` as of :meth:`permittivity`; `true_name` for a
            simulated scene. Attributes `library`, `model`, `verdict`.

        Raises
        ------
        DataError
            as :meth:`image`.
        """
        names = ("name", "confidence", "runner_up", "runner_up_share", "metal_reference", "pixels")
        return self._columns(*names, *_PERMITTIVITY, "true_name")

    def layers(self, *stack: str, bands: int | None = None, amplitude_percent: float = 10.0) -> xarray.Dataset:
        """Permittivity and thickness of the one unknown layer of a stack, on dimension `patch`, with standard errors.

        `stack` is typed as for `polysight permittivity --layer`: `scan.layers("sheet,?,0.5-3", "plate,metal")`. `bands`
        are the sub-bands used (None: all where a thickness is fitted), `amplitude_percent` says how far |H| may be
        trusted. `ambiguous` and `notes` tell what the data leave open. Raises as :meth:`image`, and ConfigError.
        """
        return layer_dataset(self._processed(True), self.rig.chirp, stack, bands, amplitude_percent)

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
            raise self._unknown("surface")
        config = None if self._settings.config is None else Path(self._settings.config)
        made = make_surface(self.folder, config, None if reference is None else Path(reference))
        return surface_dataset(made)

    def plot(self, *, metal_referenced: bool = True) -> Figure:
        """Figure of |H|, |V|, |P| (dB), and of the materials' names if metal-referenced; axes in mm.

        Notebooks show the figure when it is the last line of a cell; `plot().savefig("scan.png")` saves it.

        Raises
        ------
        DataError
            as :meth:`image`.
        """
        from polysight.api.plot import plot_scan

        return plot_scan(self._processed(metal_referenced))

    def to_netcdf(self, path: str | os.PathLike[str], *, metal_referenced: bool = True) -> None:
        """Write all results as one NetCDF file: complex variables as `h_real` and `h_imag`, see :func:`read_netcdf`.

        Raises
        ------
        ConfigError
            when h5netcdf is not installed.
        DataError
            as :meth:`image`.
        """
        write_netcdf(Path(path), full_dataset(self._processed(metal_referenced)))

    def __repr__(self) -> str:
        try:
            rows = self.rows
            count = f"{len(rows.committed)} of {rows.planned} rows"
            count += f" (missing {ranges_text(rows.missing)})" if rows.missing else ""
        except DataError:
            count = "number of rows not known"
        simulated = "SIMULATED, " if self.simulated else ""
        kind = "saved products" if self._saved_products is not None else "recorded rows"
        return f"<Scan {self.scan_id or 'without a name'}: {simulated}{count}, {kind} in {self.folder}>"

    @cached_property
    def _processing(self) -> Processing:
        if self._source is None:
            raise DataError(
                f"{self.folder}: holds no recorded rows", "it is a folder of products", "open the scan folder instead",
                code=ErrorCode.NO_DATA,
            )  # fmt: skip
        return Processing(self._source, self.folder, self._settings)

    @cached_property
    def _saved(self) -> ProcessedScan:
        if self._saved_products is None:
            raise DataError(
                f"{self.folder}: holds no products", "it was not processed", "polysight process", code=ErrorCode.NO_DATA
            )
        return ProcessedScan(self._saved_products.folder)

    def _processed(self, metal_referenced: bool) -> ProcessedScan:
        """The saved products if they are of this kind, otherwise processed rows. Raises DataError."""
        if self._saved_products is not None and self._saved.metal_referenced == metal_referenced:
            return self._saved
        if self._source is None:
            raise self._other_kind(metal_referenced)
        return self._processing.referenced if metal_referenced else self._processing.unreferenced

    def _other_kind(self, metal_referenced: bool) -> DataError:
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

    def _unknown(self, what: str) -> DataError:
        return DataError(
            f"{self.folder}: the {what} of the products is unknown", "an earlier release made them, or scan.json or"
            " quality.json is missing", "open the scan folder instead", code=ErrorCode.KEY_MISSING,
        )  # fmt: skip

    def _columns(self, *names: str) -> xarray.Dataset:
        """These variables of the patches, where they exist, with the coordinates of their dimension."""
        patches = self.patches()
        return patches[[name for name in names if name in patches]].drop_vars(["x", "y"], errors="ignore")


class Processing:
    """Processes one source; each step runs once, when its result is first used.

    `folder` is where the source was read; `truth.json` there holds the truth of a simulated scene.
    """

    def __init__(self, source: Source, folder: Path, settings: Settings) -> None:
        self.source, self.folder, self.settings = source, folder, settings

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
        self.pipeline.quality.note_imaging(self.pipeline.images, images)
        return images

    @cached_property
    def unreferenced(self) -> ProcessedScan:
        """Images in arbitrary units, as `polysight image` writes them. Raises PolysightError."""
        pipeline = self.pipeline
        return imaged_scan(self.folder, self.source, pipeline.rig, self._images, pipeline.quality)

    @cached_property
    def referenced(self) -> ProcessedScan:
        """Images relative to metal, patches and materials, as `polysight process` writes them.

        Raises
        ------
        DataError
            when no metal is found, a row is damaged, or library or metal reference do not fit the scan.
        """
        pipeline = self.pipeline
        unnamed = why_unnamed(self.settings, pipeline.rig)
        plates, note = find_truth(self.folder)
        if note:
            warnings.warn(note, stacklevel=2)
        findings = pipeline.examine(self._images, plates)
        return processed_scan(self.folder, self.source, pipeline.rig, findings, pipeline.quality, unnamed)


def layer_dataset(
    done: ProcessedScan, chirp: Chirp, stack: Sequence[str | Layer], bands: int | None, amplitude_percent: float
) -> xarray.Dataset:
    """Fit the unknown layer of a stack at each patch; parameters and errors as `Scan.layers`."""
    import xarray

    if done.verdict is not None and not done.verdict.usable:
        raise done.verdict.error("the images are kept")
    layers, std = [_layer(one) for one in stack], incidence_std_rad(done.materials)
    fits = [fit_row(row, chirp, layers, bands, amplitude_percent / 100, std) for row in done.segments]

    def column(of: str, factor: float = 1.0) -> list[float]:
        values = [None if fit is None else getattr(fit, of) for fit in fits]
        return [np.nan if value is None else factor * value for value in values]

    def described(values: Sequence[object], units: str, about: str) -> tuple[str, np.ndarray, dict[str, str]]:
        return "patch", np.asarray(values), {"units": units, "long_name": about}

    unknown = [complex(np.nan, np.nan) if fit is None else fit.permittivity for fit in fits]
    notes = [str((fit and "; ".join(fit.warnings())) or "") for fit in fits]
    table = {
        "permittivity": described(unknown, "1", "relative permittivity of the unknown layer"),
        "permittivity_real_standard_error": described(column("std_real"), "1", "standard error, real part"),
        "permittivity_loss_standard_error": described(column("std_loss"), "1", "standard error, loss"),
        "thickness": described(column("thickness_m"), "m", "thickness of the unknown layer; not a number: half space"),
        "thickness_standard_error": described(column("std_thickness_m"), "m", "standard error; 0 where it was given"),
        "ambiguous": described([_ambiguous(fit) for fit in fits], "1", "another solution fits, or it is open by 5 %"),
        "notes": described(notes, "", "rivals and other warnings"),
    }
    return xarray.Dataset(
        table, {"patch": described([patch.label for patch in done.segments], "1", "number of the patch")}
    )


def _layer(one: str | Layer) -> Layer:
    if isinstance(one, Layer):
        return one
    try:
        return parse_layer(one)
    except ValueError:
        raise ConfigError(
            f"{one!r} is no layer", "it has another form", f"write {LAYER_FORMS}", code=ErrorCode.VALUE_INVALID
        ) from None


def _ambiguous(fit: LayerFit | None) -> bool:
    return fit is not None and fit.ambiguous
