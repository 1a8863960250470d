"""Functions on scans: `plan` and `simulate` one, `compare` two, `check` the check plates of many."""

from __future__ import annotations

import os
import tempfile
import tomllib
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from html import escape
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tomli_w

from polysight.api.scan import Scan, find_rig_file, open_scan
from polysight.catalogue import Pixels, compare_pixels
from polysight.data import find_packaged
from polysight.jobs.demo import simulate_scene
from polysight.jobs.scans import check_scan, check_scans
from polysight.planning import Forecast, PlanChanges, describe, find_scene_warnings, forecast_scene
from polysight.products import PLANE_DIMENSIONS, ProcessedScan, image_dataset
from polysight.results import CheckResult
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import ConfigError, ErrorCode, expand_paths

if TYPE_CHECKING:
    import xarray
    from matplotlib.figure import Figure

PathText = str | os.PathLike[str]
Scene = PathText | Mapping[str, object]


@dataclass(frozen=True)
class Plan:
    """Forecast of a scan: print it, or use its parts.

    Attributes
    ----------
    forecast
        `rig` (with the changes), `time`, `response.width_mm` (resolution), `field`, `noise`, `warnings`, `possible`.
    """

    forecast: Forecast

    @property
    def warnings(self) -> list[str]:
        """Advice on settings that should be changed before the scan."""
        return [expand_paths(f"{warning.where}: {warning.what}") for warning in self.forecast.warnings]

    def __str__(self) -> str:
        return expand_paths(describe(self.forecast))

    def _repr_html_(self) -> str:
        return f"<pre>{escape(str(self))}</pre>"


def plan(rig: PathText | Instrument | None = None, *, scene: Scene | None = None, **changes: float) -> Plan:
    """Predict time, data, resolution and noise of a scan, as `polysight plan`.

    Parameters
    ----------
    rig
        Rig file or rig; `instrument.toml` here or the packaged one if not given.
    scene
        Scene file or its content: its grid replaces the rig file's, and its plates are checked for gaps, size and
        thickness.
    changes
        Values that replace the rig file's, by their names there: `speed_mm_s`, `pulses`, `period_us`, `step_x_mm`,
        `step_y_mm`, `columns`, `rows`, `width_mm`, `height_mm`, `accel_mm_s2`, `object_distance_mm`.

    Raises
    ------
    ConfigError
        if the rig file or a value is wrong, or a change has another name than these.
    """
    known_options = [field.name for field in fields(PlanChanges)]
    unknown = [name for name in changes if name not in known_options]
    if unknown:
        raise ConfigError(
            f"{', '.join(unknown)}: not a setting of a plan",
            f"the settings are {', '.join(known_options)}",
            "see help(polysight.plan)",
            code=ErrorCode.VALUE_INVALID,
        )
    no_numbers = [f"{name} = {value!r}" for name, value in changes.items() if not isinstance(value, Real)]
    if no_numbers:
        raise ConfigError(
            f"{', '.join(no_numbers)}: not a number",
            "a setting of a plan is a number in the unit that its name has",
            "see help(polysight.plan)",
            code=ErrorCode.VALUE_INVALID,
        )
    instrument = rig if isinstance(rig, Instrument) else load_instrument(find_rig_file(rig))
    with _open_scene_file(scene) as path:
        return Plan(forecast_scene(instrument, PlanChanges(**changes), path))  # type: ignore[arg-type]


def simulate(scene: Scene, out: PathText, *, rig: PathText | None = None, seed: int | None = None) -> Scan:
    """Simulate the scan of a scene with the simulated rig, and open it.

    Warns of gaps, sizes, places and thicknesses that spoil the result of a plate, as :func:`plan`.

    Parameters
    ----------
    scene
        Scene file, such as "examples/own-scene.toml" (also from an installed package), or its content as a dict:
        `{"name": "two plates", "plates": [{"name": "PET", "centre_mm": [30, 0], "size_mm": [45, 45], ...}]}`;
        docs/spec/scene-file.md lists all keys. Without a `grid` all positions of the rig file are simulated, which
        takes long; `examples/own-scene.toml` has one that takes seconds.
    out
        Folder of the scan, which must be empty or not exist yet.
    rig
        Rig file; `instrument.toml` here or the packaged one if not given.
    seed
        Seed of noise and disturbances, instead of the scene's.

    Raises
    ------
    PolysightError
        if the scene is wrong or does not fit the rig, the folder is not empty, or the simulators are not installed.
    """
    with _open_scene_file(scene) as path:
        if path is None:
            raise ConfigError(
                "no scene was given", "a scene says which objects lie where", "see help(polysight.simulate)"
            )
        config = find_rig_file(rig)
        _warn_of_whole_grid(path)
        for warning in find_scene_warnings(path, config):
            warnings.warn(expand_paths(f"{warning.where}: {warning.what}"), stacklevel=2)
        simulate_scene(path, config, Path(out), seed)
    return open_scan(out)


def _warn_of_whole_grid(scene: Path) -> None:
    """Warn the caller of `simulate` if a scene has no grid. The simulator reports a file that cannot be read."""
    with suppress(OSError, ValueError):
        if "grid" not in tomllib.loads(scene.read_text(encoding="utf-8")):
            text = "the scene has no `grid`: all positions of the rig file are simulated, which takes long"
            warnings.warn(f"{text}; examples/own-scene.toml has a grid that takes seconds", stacklevel=3)


def compare(first: Scan | PathText, second: Scan | PathText) -> xarray.Dataset:
    """Compare two processed scans of one place, pixel by pixel and patch by patch: the first minus the second.

    Returns
    -------
    xarray.Dataset
        On the first scan's pixels: `p_difference` and `permittivity_difference` complex128, `sigmas` (size of the
        difference of P in standard deviations of such differences). On dimension `pair`, of patches at one place:
        `pair_x_mm`, `pair_y_mm`, `first_name`, `second_name`, `pair_difference` (permittivity), `pair_sigmas`.
        Attributes `notes` (reasons why the scans are hard to compare), `compared` (number of pixels),
        `significant_share`.

    Raises
    ------
    DataError
        if one of them is not relative to metal, or they show different places.
    """
    import xarray

    scans = [scan if isinstance(scan, Scan) else open_scan(scan) for scan in (first, second)]
    pixels = [Pixels.from_scan(scan.read_or_process()) for scan in scans]
    comparison = compare_pixels(*pixels, names=(str(scans[0].folder), str(scans[1].folder)))
    pairs = comparison.figures.patches
    differences = [pair.difference for pair in pairs]
    unknown = complex(np.nan, np.nan)
    values = [unknown if d is None else complex(d.real, d.imag) for d in differences]
    table: dict[str, Any] = {
        "p_difference": (PLANE_DIMENSIONS, comparison.p, {"units": "1", "long_name": "difference of P"}),
        "permittivity_difference": (
            PLANE_DIMENSIONS,
            comparison.permittivity,
            {"units": "1", "long_name": "difference"},
        ),
        "sigmas": (
            PLANE_DIMENSIONS,
            comparison.sigmas,
            {"units": "1", "long_name": "difference of P in standard deviations"},
        ),
        "pair_x_mm": ("pair", [pair.place_mm[0] for pair in pairs], {"units": "mm", "long_name": "x from the centre"}),
        "pair_y_mm": ("pair", [pair.place_mm[1] for pair in pairs], {"units": "mm", "long_name": "y from the centre"}),
        "first_name": (
            "pair",
            [pair.names[0] or "" for pair in pairs],
            {"units": "", "long_name": "name in the first"},
        ),
        "second_name": (
            "pair",
            [pair.names[1] or "" for pair in pairs],
            {"units": "", "long_name": "name in the second"},
        ),
        "pair_difference": ("pair", values, {"units": "1", "long_name": "difference of the permittivity"}),
        "pair_sigmas": (
            "pair",
            [np.nan if pair.sigmas is None else pair.sigmas for pair in pairs],
            {"units": "1", "long_name": "difference of the permittivity in standard deviations"},
        ),
    }
    image = image_dataset(scans[0].read_or_process())
    attributes: dict[str, object] = {
        "first": scans[0].scan_id,
        "second": scans[1].scan_id,
        "notes": "; ".join(comparison.figures.notes),
        "compared": comparison.figures.compared,
    }
    if comparison.figures.significant_share is not None:
        attributes["significant_share"] = comparison.figures.significant_share
    return xarray.Dataset(table, image.drop_vars(list(image.data_vars)).coords, attributes)


def check(*scans: Scan | PathText) -> xarray.Dataset:
    """Compare the check plates of scans with the known permittivity of the rig file, as `polysight check`.

    Parameters
    ----------
    scans
        Scans, or folders: a processed scan, or a folder of scans, whose order is that of their start.

    Returns
    -------
    xarray.Dataset
        On dimension `scan` (its name): `permittivity`, `permittivity_real_standard_error`,
        `permittivity_loss_standard_error`, `expected_permittivity`, `sigmas` (distance in standard deviations) and
        `level`: "good", "warning" (5 % of good scans are as far off), "action" (0.3 %), "missing".

    Raises
    ------
    ConfigError
        if no scan is given, or a rig file names no check plate.
    DataError
        if a folder holds no processed scan with a check plate.
    """
    import xarray

    checked_scans = _check_all(scans)
    results = [result for _, result in checked_scans]
    unknown = (np.nan, np.nan)
    measured = np.array([result.measured or unknown for result in results])
    errors = np.array([result.measured_std or unknown for result in results])
    expected = np.array([result.expected for result in results])
    sigmas = [np.nan if result.sigmas is None else result.sigmas for result in results]
    table: dict[str, Any] = {
        "permittivity": (measured[:, 0] - 1j * measured[:, 1], "relative permittivity of the check plate"),
        "permittivity_real_standard_error": (errors[:, 0], "standard error, real part"),
        "permittivity_loss_standard_error": (errors[:, 1], "standard error, loss"),
        "expected_permittivity": (expected[:, 0] - 1j * expected[:, 1], "permittivity in the rig file"),
        "sigmas": (sigmas, "distance in standard deviations"),
        "level": ([result.level for result in results], "level of the control chart"),
    }
    variables = {name: ("scan", value, {"units": "1", "long_name": about}) for name, (value, about) in table.items()}
    names = ("scan", [scan.scan_id for scan, _ in checked_scans], {"units": "", "long_name": "name of the scan"})
    return xarray.Dataset(variables, {"scan": names}, {"plate": results[-1].name})


def plot_check(*scans: Scan | PathText) -> Figure:
    """Draw the control chart of check plates: permittivities of scans, the known one, and its limits.

    Takes scans and folders, and raises, as :func:`check`.
    """
    from polysight.api.plot import plot_control_chart

    return plot_control_chart(_check_all(scans))


def _check_all(scans: Sequence[Scan | PathText]) -> list[tuple[ProcessedScan, CheckResult]]:
    """Return each scan, processed if necessary, with the result of its check."""
    checked_scans: list[tuple[ProcessedScan, CheckResult]] = []
    for scan in scans:
        if isinstance(scan, Scan):
            processed = scan.read_or_process()
            checked_scans.append((processed, check_scan(processed)))
        else:
            checked_scans += check_scans([Path(scan)])
    if not checked_scans:
        raise ConfigError(
            "no scan was given", "nothing can be compared with the known value", "see help(polysight.check)"
        )
    return checked_scans


@contextmanager
def _open_scene_file(scene: Scene | None) -> Iterator[Path | None]:
    """Yield the path of a scene file, None without a scene; the content of a scene is written into a temporary one."""
    if scene is None:
        yield None
    elif isinstance(scene, str | os.PathLike):
        yield find_packaged(Path(scene))
    else:
        with tempfile.TemporaryDirectory(prefix="polysight-scene-") as folder:
            path = Path(folder) / "scene.toml"
            path.write_bytes(tomli_w.dumps(dict(scene)).encode("utf-8"))
            yield path
