"""Made-up calibration files, and the leakage that remains after a correction."""

from dataclasses import replace

import numpy as np

from polysight.calibration.files import BoardFilter, FilterFile, SourceScan, make_header
from polysight.imaging import ImagedWith, Images, image_grid
from polysight.polarimetry import Leakage, PlaneReference, plane_reference
from polysight_shared.config import Instrument

SOURCES = [SourceScan("plate", "scans/plate", simulated=True, rows=7)]


def make_board_filter(first_khz: float = 180.5, second_khz: float = 355.25) -> BoardFilter:
    """A measurement of one receiver's high-pass filters, by default near the corners of the published rig."""
    return BoardFilter(
        corners_khz=[first_khz, second_khz],
        standard_error_khz=[1.5, 2.5],
        programmed_khz=[175.0, 350.0],
        if_from_khz=100.0,
        if_to_khz=1900.0,
        chirps=640,
        residual_db=0.05,
    )


def make_filter_file(first_khz: float = 180.5, rv: BoardFilter | None = None) -> FilterFile:
    """A file with the filters of both receivers, which are the same unless `rv` is given."""
    rh = make_board_filter(first_khz)
    if rv is None:
        rv = rh
    return FilterFile(**make_header("hpf", SOURCES), boards={"RH": rh, "RV": rv})


def make_metal_reference(rig: Instrument, seed: int = 0) -> PlaneReference:
    """A metal reference from the images of a plate, with a gain that varies over the plate and noise of 2 %."""
    rng = np.random.default_rng(seed)
    grid = image_grid(rig)
    y, x = np.meshgrid(np.linspace(0, 1, grid.y_m.size), np.linspace(0, 1, grid.x_m.size), indexing="ij")
    gain = (1 + 0.2 * y) * np.exp(1j * x)
    noise = 1 + 0.02 * (rng.standard_normal((2, *x.shape)) + 1j * rng.standard_normal((2, *x.shape)))
    images = Images(
        h=gain * noise[0], v=0.7 * noise[1], x_m=grid.x_m, y_m=grid.y_m, valid=np.ones(x.shape, bool)
    )  # fmt: skip
    plate = plane_reference(images, smooth_mm=4.0, name="plate")
    return replace(plate, made_with=ImagedWith.from_rig(rig, {}))


def compute_remaining(estimate: Leakage, truth: Leakage) -> tuple[float, float]:
    """What remains of the true leakage after a correction with its estimate.

    Returns
    -------
    crosstalk, imbalance
        The larger of the two relative amplitudes of the wrong polarisation, and the deviation of the ratio of both
        channels' gains from 1. Both are 0 for a perfect estimate.
    """
    # A matrix maps the true H and V to the received ones: a perfect correction leaves a diagonal of equal gains.
    residual = np.linalg.solve(estimate.matrix(), truth.matrix())
    gain_h = residual[0, 0]
    gain_v = residual[1, 1]
    crosstalk = max(abs(residual[0, 1] / gain_h), abs(residual[1, 0] / gain_v))
    imbalance = abs(gain_h / gain_v - 1)
    return float(crosstalk), float(imbalance)
