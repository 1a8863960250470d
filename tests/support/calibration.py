"""Made-up calibration files, and the leakage that remains after a correction."""

from dataclasses import replace

import numpy as np

from polysight.calibration.files import BoardFilter, FilterFile, SourceScan, make_header
from polysight.imaging import ImagedWith, Images, image_grid
from polysight.polarimetry import Leakage, PlaneReference, plane_reference
from polysight_shared.config import Instrument

SOURCES = [SourceScan("plate", "scans/plate", True, 7)]


def read_board_filter(first_khz: float = 180.5, second_khz: float = 355.25) -> BoardFilter:
    """One receiver's corners, measured with those of the published rig."""
    return BoardFilter(
        corners_khz=[first_khz, second_khz],
        standard_error_khz=[1.5, 2.5],
        programmed_khz=[175.0, 350.0],
        if_from_khz=100.0,
        if_to_khz=1900.0,
        chirps=640,
        residual_db=0.05,
    )


def filter_file(first_khz: float = 180.5, rv: BoardFilter | None = None) -> FilterFile:
    """Both receivers with the same corners, or the second one with its own."""
    rh = read_board_filter(first_khz)
    return FilterFile(**make_header("hpf", SOURCES), boards={"RH": rh, "RV": rv or rh})


def make_metal_reference(rig: Instrument, seed: int = 0) -> PlaneReference:
    """The images of a noisy plate, made with this rig."""
    rng = np.random.default_rng(seed)
    grid = image_grid(rig)
    y, x = np.meshgrid(np.linspace(0, 1, grid.y_m.size), np.linspace(0, 1, grid.x_m.size), indexing="ij")
    gain = (1 + 0.2 * y) * np.exp(1j * x)
    noise = 1 + 0.02 * (rng.standard_normal((2, *x.shape)) + 1j * rng.standard_normal((2, *x.shape)))
    plate_seen = Images(gain * noise[0], 0.7 * noise[1], grid.x_m, grid.y_m, np.ones(x.shape, bool))
    plate = plane_reference(plate_seen, smooth_mm=4.0, name="plate")
    return replace(plate, made_with=ImagedWith.from_rig(rig, {}))


def compute_remaining(estimate: Leakage, truth: Leakage) -> tuple[float, float]:
    """Return the larger cross-polar amplitude and the co-polar ratio's deviation from 1, after correction."""
    residual = np.linalg.solve(estimate.matrix(), truth.matrix())
    crosstalk = max(abs(residual[0, 1] / residual[0, 0]), abs(residual[1, 0] / residual[1, 1]))
    return float(crosstalk), float(abs(residual[0, 0] / residual[1, 1] - 1))
