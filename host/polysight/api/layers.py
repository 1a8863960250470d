"""Fit of a stack of layers to every patch of a scan, as a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from polysight.materials import LAYER_FORMS, Layer, LayerFit, fit_row, incidence_std_rad, parse_layer
from polysight.products import ProcessedScan
from polysight_shared.config import Chirp
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError

if TYPE_CHECKING:
    import xarray


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
