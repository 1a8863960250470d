"""A stack of layers fitted to every patch, as a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from polysight.materials import LAYER_FORMS, Layer, fit_row, incidence_std_rad, parse_layer
from polysight.products import ProcessedScan, patch_coordinates
from polysight_shared.config import Chirp
from polysight_shared.errors import ConfigError, ErrorCode

if TYPE_CHECKING:
    import xarray


def layer_dataset(
    scan: ProcessedScan, chirp: Chirp, stack: Sequence[str | Layer], bands: int | None, amplitude_percent: float
) -> xarray.Dataset:
    """Fit the unknown layer of a stack at each patch; errors as `Scan.layers`.

    `bands` is the number of sub-bands that are used (None: all if a thickness is fitted), `amplitude_percent` the
    relative error of |H|. A patch without enough data has no fit, and not a number in each column.
    """
    import xarray

    if scan.verdict is not None and not scan.verdict.usable:
        raise scan.verdict.error("the images are kept")
    layers = [_parse_layer(layer) for layer in stack]
    angle_std_rad = incidence_std_rad(scan.materials)
    fits = [fit_row(patch, chirp, layers, bands, amplitude_percent / 100, angle_std_rad) for patch in scan.segments]

    def describe(values: Sequence[object], units: str, about: str) -> tuple[str, np.ndarray, dict[str, str]]:
        return "patch", np.asarray(values), {"units": units, "long_name": about}

    def read(attribute: str, factor: float = 1.0) -> list[float]:
        """Return an attribute of each fit, times `factor`; not a number where it is missing."""
        values = [getattr(fit, attribute, None) for fit in fits]
        return [np.nan if value is None else factor * value for value in values]

    unknown = complex(np.nan, np.nan)
    values = [unknown if fit is None else fit.permittivity for fit in fits]
    notes = ["" if fit is None else "; ".join(map(str, fit.warnings())) for fit in fits]
    ambiguous = [fit is not None and fit.ambiguous for fit in fits]
    thickness = "thickness of the unknown layer; not a number: half space"
    table = {
        "permittivity": describe(values, "1", "relative permittivity of the unknown layer"),
        "permittivity_real_standard_error": describe(read("std_real"), "1", "standard error, real part"),
        "permittivity_loss_standard_error": describe(read("std_loss"), "1", "standard error, loss"),
        "thickness_mm": describe(read("thickness_m", 1e3), "mm", thickness),
        "thickness_standard_error_mm": describe(read("std_thickness_m", 1e3), "mm", "0 where it was given"),
        "ambiguous": describe(ambiguous, "1", "another solution fits, or it is uncertain by over 5 %"),
        "notes": describe(notes, "", "rivals and other warnings"),
    }
    return xarray.Dataset(table, patch_coordinates(scan))


def _parse_layer(layer: str | Layer) -> Layer:
    """Return a layer; a text is parsed. Raises ConfigError for a text of another form."""
    if isinstance(layer, Layer):
        return layer
    try:
        return parse_layer(layer)
    except ValueError:
        problem = f"{layer!r} does not describe a layer"
        why = "the text has another form"
        raise ConfigError(problem, why, f"write {LAYER_FORMS}", code=ErrorCode.VALUE_INVALID) from None
