"""The plane through plates at given places and heights equals plain least squares; plates off the plane are raised.

A height is the distance behind the object plane of the rig file. It is estimated *by range* (coarse, without
ambiguity) and *by phase* (fine, ambiguous by half a wavelength). A plate that does not lie on the plane of most plates
is *raised*.
"""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from polysight.imaging.plane import (
    UNKNOWN_PLANE,
    PlaneEstimate,
    RaisedPlate,
    TiltPrior,
    _fit_most,
    _fit_plane,
    _mark_raised,
    _measure_slope_behind,
    find_plane,
)
from polysight_shared.geometry import incidence_deg

# Middles of six plates, metres from the middle of the image.
PLACES = np.array([[-0.1, -0.05], [0.0, -0.05], [0.1, -0.05], [-0.1, 0.06], [0.0, 0.05], [0.1, 0.05]])

# A prior with no information about the tilt: 0 within 100 metres per metre
WIDE_PRIOR = TiltPrior(mean=np.zeros(2), std=np.full(2, 100.0))

# The plane's height before any plate is seen is 0 with this standard deviation: that of an error which may be anywhere
# within +-10 mm, 10 mm / sqrt(3) = 5.8 mm.
PRIOR_HEIGHT_STD_M = 5.8e-3


def compute_heights(plane: tuple[float, float, float]) -> np.ndarray:
    """Heights of the six plates on a plane (height at the middle in metres, rise per metre along x and along y)."""
    height_m, rise_x, rise_y = plane
    return height_m + PLACES @ np.array([rise_x, rise_y])


def test_plates_on_a_plane_give_that_plane():
    plane, _ = _fit_plane(PLACES, compute_heights((0.002, 0.01, -0.02)), np.full(6, 1e-6), WIDE_PRIOR)
    np.testing.assert_allclose(plane, (0.002, 0.01, -0.02), rtol=1e-5)


def test_a_plane_is_the_weighted_least_squares_of_heights_and_prior():
    """The prior counts as three more measurements: one of the height and two of the tilts."""
    rng = np.random.default_rng(1)
    stds = np.array([1e-3, 2e-3, 4e-3, 1e-3, 3e-3, 2e-3])
    # Errors of a third of their standard deviations: the scatter does not enlarge the covariance.
    heights = compute_heights((0.002, 0.01, -0.02)) + stds * rng.standard_normal(6) / 3
    prior = TiltPrior(mean=np.array([0.004, -0.003]), std=np.array([0.01, 0.02]))
    rows = np.vstack([np.column_stack([np.ones(6), PLACES]), np.eye(3)])
    values = np.concatenate([heights, [0.0, 0.004, -0.003]])
    errors = np.concatenate([stds, [PRIOR_HEIGHT_STD_M, 0.01, 0.02]])
    expected, *_ = np.linalg.lstsq(rows / errors[:, None], values / errors, rcond=None)
    covariance = np.linalg.inv((rows / errors[:, None] ** 2).T @ rows)
    plane, fitted_covariance = _fit_plane(PLACES, heights, stds, prior)
    np.testing.assert_allclose(plane, expected)
    np.testing.assert_allclose(fitted_covariance, covariance)


def test_heights_that_scatter_more_than_their_errors_enlarge_the_covariance_of_the_plane():
    """The factor is chi squared over its degrees of freedom: six heights minus the three unknowns of a plane."""
    stds = np.array([1e-3, 2e-3, 4e-3, 1e-3, 3e-3, 2e-3])
    heights = compute_heights((0.002, 0.01, -0.02))
    prior = TiltPrior(mean=np.array([0.004, -0.003]), std=np.array([0.01, 0.02]))
    _, covariance = _fit_plane(PLACES, heights, stds, prior)
    # 30 standard deviations up and down are far more than chance gives.
    heights += 30 * stds * np.array([1, -1, 1, -1, 1, -1])
    plane, enlarged_covariance = _fit_plane(PLACES, heights, stds, prior)
    residuals_m = heights - compute_heights(tuple(plane))
    chi2 = np.sum((residuals_m / stds) ** 2)
    np.testing.assert_allclose(enlarged_covariance, covariance * chi2 / (6 - 3))


def test_without_plates_a_plane_is_its_prior():
    prior = TiltPrior(mean=np.array([0.004, -0.003]), std=np.array([0.01, 0.02]))
    plane, covariance = _fit_plane(places=np.zeros((0, 2)), heights=np.zeros(0), stds=np.zeros(0), tilt=prior)
    np.testing.assert_allclose(plane, (0.0, 0.004, -0.003))
    np.testing.assert_allclose(covariance, np.diag([PRIOR_HEIGHT_STD_M, 0.01, 0.02]) ** 2)


@pytest.mark.parametrize("plane", [(0.003, 0.0, 0.0), (0.003, 0.01, 0.0), (-0.001, 0.01, -0.02)])
@pytest.mark.parametrize("raised_m", [0.02, -0.02])
def test_two_raised_plates_of_six_do_not_change_the_plane_of_the_others(plane, raised_m):
    heights = compute_heights(plane)
    heights[[1, 4]] += raised_m
    prior = TiltPrior(mean=np.array([0.0, 0.0]), std=np.array([0.02, 0.02]))
    heights_of_most = _fit_most(PLACES, heights, stds=np.full(6, 5e-4), tilt=prior)
    # Tilts are tried in steps of an eighth of the prior's 0.02: those of the planes above are among them.
    np.testing.assert_allclose(heights_of_most, compute_heights(plane), atol=1e-4)


def test_the_tilts_of_the_plates_are_a_measurement_of_the_planes_tilt():
    """The median of their tilts is averaged with the prior of the plane's tilt, 0 with a standard deviation of 0.02."""
    rises_x = np.array([0.008, 0.010, 0.012, 0.014, 0.016])
    median = 0.012
    # The median of the deviations from 0.012 is 0.002. Of normally distributed values the standard deviation is 1.48
    # times their median deviation, and a median has 1.25 times the error of a mean.
    scatter_std = 1.48 * 0.002
    std_of_median = 1.25 * scatter_std / np.sqrt(5)
    # An error that all plates share, such as one of the stage's scale: 5e-3 (0.3 degrees).
    std = np.hypot(5e-3, std_of_median)
    precision = 0.02**-2 + std**-2
    prior = TiltPrior.from_plates([(rise_x, 0.0) for rise_x in rises_x])
    # A rise of 0 is one that is not known: along y there is only the prior.
    assert prior.mean == pytest.approx([median * std**-2 / precision, 0.0])
    assert prior.std == pytest.approx([precision**-0.5, 0.02])


def make_strips() -> list[np.ndarray]:
    """Insides of three plates, columns 2 to 4, 12 to 14 and 32 to 34 of an image of 8 x 40 pixels."""
    masks = [np.zeros((8, 40), bool) for _ in range(3)]
    for mask, column in zip(masks, (2, 12, 32), strict=True):
        mask[2:6, column : column + 3] = True
    return masks


def mark_raised_strips(heights_m: Sequence[float], is_raised: Sequence[bool]) -> tuple[RaisedPlate, ...]:
    """Those of the three plates of `make_strips` that are raised, with their regions; pixels are 2 mm wide."""
    return _mark_raised(make_strips(), np.array(heights_m), np.array(is_raised), pixel_m=2e-3)


def test_the_region_of_a_raised_plate_reaches_12_mm_or_half_of_the_way_to_the_next_plate():
    """12 mm are six pixels beyond the inside of the plate."""
    (plate,) = mark_raised_strips(heights_m=[0.0, 0.004, 0.0], is_raised=[False, True, False])
    assert plate.height_m == 0.004
    columns = np.flatnonzero(plate.region[3])
    # To the right the next plate is far away: six columns after the last one of the plate, 14.
    assert columns[-1] == 14 + 6
    # To the left another plate ends at column 4, this one begins at column 12: column 8 is as far from either.
    assert columns[0] in (8, 9)
    # The image ends 2 pixels above and below the plate, so that the region reaches from edge to edge.
    assert np.flatnonzero(plate.region[:, 13]).tolist() == list(range(8))
    assert mark_raised_strips(heights_m=[0.0, 0.0, 0.0], is_raised=[False, False, False]) == ()


def test_each_raised_plate_has_its_own_region():
    first, third = mark_raised_strips(heights_m=[1.0, 2.0, 3.0], is_raised=[True, False, True])
    assert (first.height_m, third.height_m) == (1.0, 3.0)
    # The third plate begins at column 32 and has six columns before it; the image ends at column 39.
    assert np.flatnonzero(third.region[3]).tolist() == list(range(26, 40))
    assert not (first.region & third.region).any()


def measure_slope_behind(
    *, image: complex, footprint: complex, slope: complex, mirror_slope: complex, masks: list[np.ndarray]
) -> float:
    """The estimated error of the plates' slopes, for images in which all pixels have the same values."""
    ones = np.ones((8, 40), complex)
    return _measure_slope_behind(
        image=image * ones,
        footprint=footprint * ones,
        slope=slope * ones,
        mirror_slope=mirror_slope * ones,
        masks=masks,
    )


def test_the_slope_of_the_image_between_plates_is_the_error_of_the_plates_slopes():
    """The slope is the change of an image with range. The table under the plates has one, and it adds to the plates'.

    The error is the root mean square of the real and of the imaginary part of slope - image * mirror_slope / footprint.
    The last term is the slope of an echo on the plane that is as strong as the image.
    """
    strips = make_strips()
    # An echo on the plane has the slope of a mirror there: 3 - 1 * 3 / 1 = 0.
    assert measure_slope_behind(image=1, footprint=1, slope=3, mirror_slope=3, masks=strips) == 0.0
    # 2 + 2j has 2 in each of its parts.
    between_plates = measure_slope_behind(image=1, footprint=1, slope=2 + 2j, mirror_slope=0, masks=strips)
    assert between_plates == pytest.approx(2.0)
    # 2 + 2j - 2 * 1j / 1 = 2 has parts of 2 and 0; the root of their mean square is sqrt(2).
    less_the_mirrors = measure_slope_behind(image=2, footprint=1, slope=2 + 2j, mirror_slope=1j, masks=strips)
    assert less_the_mirrors == pytest.approx(2**0.5)


def test_without_plates_or_light_between_them_the_error_of_the_slopes_is_zero():
    no_plates = [np.zeros((8, 40), bool)]
    assert measure_slope_behind(image=1, footprint=1, slope=2, mirror_slope=0, masks=no_plates) == 0.0
    # A footprint of 0: the antennas do not light the plane.
    assert measure_slope_behind(image=1, footprint=0, slope=2, mirror_slope=0, masks=make_strips()) == 0.0


def make_estimate(offset_m: float, **changes: Any) -> PlaneEstimate:
    """The estimate of a scene with one plate at this height; other fields are those of an empty scene."""
    return replace(UNKNOWN_PLANE, **({"offset_m": offset_m, "plates": 1} | changes))


@pytest.mark.parametrize(
    ("offset_m", "moved_m"),
    [(0.0, 0.0), (5e-4, 0.0), (5.1e-4, 5.1e-4), (-5.1e-4, -5.1e-4), (0.0149, 0.0149), (0.015, 0.0), (-0.0151, 0.0)],
)
def test_images_are_moved_to_a_plane_half_a_millimetre_to_15_mm_off(rig, offset_m, moved_m):
    plane = make_estimate(offset_m)
    assert plane.moved_m == moved_m
    distance_mm = rig.geometry.object_distance_mm
    assert plane.apply_to_rig(rig).geometry.object_distance_mm == pytest.approx(distance_mm + 1e3 * moved_m)
    assert make_estimate(0.002, plates=0).moved_m == 0.0


def test_the_error_of_the_incidence_angle_follows_from_that_of_the_planes_distance(rig):
    """Half of the distance between transmitter and receiver over the plane's distance is the tangent of the angle."""
    z_m = rig.geometry.object_distance_mm / 1e3
    half_m = z_m * np.tan(np.radians(incidence_deg(rig, rig.receivers[0])))
    # The antennas' own places are known to 1 mm: sqrt(2.4^2 + 1^2) = 2.6 mm. An unknown plane has the prior's error.
    known_plane = make_estimate(0.0, offset_std_m=2.4e-3)
    for plane, std_m in ((known_plane, 2.6e-3), (UNKNOWN_PLANE, PRIOR_HEIGHT_STD_M)):
        # The change of the angle over one standard deviation, half of it to each side.
        change = np.arctan(half_m / (z_m - std_m / 2)) - np.arctan(half_m / (z_m + std_m / 2))
        # The square root of 2.4^2 + 1^2 is exactly 2.6, so that only rounding is left.
        assert plane.incidence_std_rad(rig) == pytest.approx(change, rel=0.02)


def test_a_plane_is_written_in_millimetres_and_degrees():
    plane = make_estimate(
        0.0021, offset_std_m=0.0003, tilt_rad=(0.01, -0.02), tilt_std_rad=(0.001, 0.002), by_phase=True, plates=5,
        raised=mark_raised_strips(heights_m=[0.0, 0.0051, 0.0], is_raised=[False, True, False]),
    )  # fmt: skip
    assert plane.to_dict() == {
        "known": True,
        "offset_mm": 2.1,
        "offset_std_mm": 0.3,
        "tilt_deg": [0.573, -1.1459],
        "tilt_std_deg": [0.0573, 0.1146],
        "by": "phase",
        "plates": 5,
        # Relative to the plane: 5.1 mm - 2.1 mm
        "raised_mm": [3.0],
    }
    assert make_estimate(0.0, tilt_std_rad=(0.0, 0.0), offset_std_m=0.0).to_dict()["by"] == "range"
    swapped = plane.transpose()
    assert (swapped.tilt_rad, swapped.tilt_std_rad) == ((-0.02, 0.01), (0.002, 0.001))
    assert (swapped.raised[0].region == plane.raised[0].region.T).all()
    assert UNKNOWN_PLANE.to_dict() == {"known": False}


# Change of an echo's phase with its height, radians per metre. A turn is 2 pi / 2000 = 3.1 mm, about that of the rig.
PHASE_RAD_PER_M = 2000.0

# Change of an echo's relative slope with its height; arbitrary, since plates and mirror have the same.
SLOPE_PER_M = 40.0


class PlatesOfOneReceiver:
    """Replaces `BoardSamples`, the samples of a receiver, in the plane estimate; for plates at given heights.

    The height of a plate's pixels by range alternates by `std_m` up and down; their phase is that of its height. The
    image of a mirror on the plane (the footprint) is 1 everywhere and its slope 0; metal reflects with the factor -1.
    """

    def __init__(self, masks: list[np.ndarray], heights_m: Sequence[float], std_m: float) -> None:
        self._ones = np.ones(masks[0].shape, complex)
        self._image = -self._ones
        self._slope = 0 * self._ones
        for mask, height_m in zip(masks, heights_m, strict=True):
            # -1, +1, -1, ... over the plate's pixels
            sign = 2 * (np.arange(mask.sum()) % 2) - 1
            self._image[mask] = -np.exp(1j * PHASE_RAD_PER_M * height_m)
            self._slope[mask] = self._image[mask] * SLOPE_PER_M * (height_m + std_m * sign)

    def image(self):
        """Image, footprint, and the illumination, which the estimate does not use."""
        return self._image, self._ones, None

    def range_slope(self):
        """Slopes of the image and of the footprint."""
        return self._slope, 0 * self._ones

    def mirror_image(self, step_m):
        """Image of a mirror that lies `step_m` behind the plane."""
        return np.exp(1j * PHASE_RAD_PER_M * step_m) * self._ones

    def mirror_slope(self, step_m):
        """Slope of the image of that mirror."""
        return step_m * SLOPE_PER_M * self.mirror_image(step_m)


def make_plates() -> tuple[list[np.ndarray], SimpleNamespace]:
    """Insides of five plates in two rows, and the grid of their image of 60 x 30 pixels of 2 mm."""
    masks = [np.zeros((30, 60), bool) for _ in range(5)]
    for number, mask in enumerate(masks):
        row = 3 + 12 * (number % 2)
        mask[row : row + 4, 12 * number : 12 * number + 4] = True
    return masks, SimpleNamespace(x_m=0.3 + np.arange(60) * 2e-3, y_m=np.arange(30) * 2e-3 - 0.2, pixel_m=2e-3)


def find_middles_m(masks: list[np.ndarray], grid: SimpleNamespace) -> tuple[np.ndarray, np.ndarray]:
    """x and y of the plates' middles, relative to the middle of the image."""
    x_m = np.array([grid.x_m[mask.any(axis=0)].mean() for mask in masks]) - grid.x_m.mean()
    y_m = np.array([grid.y_m[mask.any(axis=1)].mean() for mask in masks]) - grid.y_m.mean()
    return x_m, y_m


@pytest.mark.parametrize("plane", [(0.004, 0.0, 0.0), (0.004, 0.005, 0.0), (-0.005, 0.004, -0.01), (0.0001, 0.0, 0.01)])
@pytest.mark.parametrize("has_phase", [True, False])
def test_plates_on_a_plane_are_measured_by_phase_where_range_resolves_its_turns(monkeypatch, plane, has_phase):
    """A turn of the phase is 3.1 mm; the heights by range scatter by 0.1 mm.

    The prior pulls the plane by range towards 0, by more than the plane by phase, which is known more precisely.
    """
    masks, grid = make_plates()
    x_m, y_m = find_middles_m(masks, grid)
    heights_m = plane[0] + plane[1] * x_m + plane[2] * y_m
    if not has_phase:
        monkeypatch.setattr("polysight.imaging.plane._fit_plane_by_phase", lambda *_: None)
    receiver = PlatesOfOneReceiver(masks, heights_m, std_m=1e-4)
    estimate = find_plane(SimpleNamespace(grid=grid, boards={"RH": receiver}), masks)
    assert estimate.by_phase is has_phase
    np.testing.assert_allclose(estimate.heights_m, heights_m, atol=1e-8)
    if has_phase:
        offset_tolerance_m = 1e-5
        tilt_tolerance = 2e-4
    else:
        # The least standard deviation of a height by range, and a quarter of that of the tilt's prior (0.02). The
        # errors measured are 0.05 mm and 0.0042.
        offset_tolerance_m = 3e-4
        tilt_tolerance = 5e-3
    assert estimate.offset_m == pytest.approx(plane[0], abs=offset_tolerance_m)
    np.testing.assert_allclose(np.tan(estimate.tilt_rad), plane[1:], atol=tilt_tolerance)
    assert estimate.raised == ()


@pytest.mark.parametrize(("plates", "by_phase"), [(3, False), (4, True), (5, True)])
def test_the_plane_is_estimated_by_phase_from_four_plates_on(plates, by_phase):
    """Three plates lie on some plane, whatever their phases are: they cannot show that a phase is wrong."""
    masks, grid = make_plates()
    receiver = PlatesOfOneReceiver(masks[:plates], heights_m=[0.004] * plates, std_m=1e-4)
    estimate = find_plane(SimpleNamespace(grid=grid, boards={"RH": receiver}), masks[:plates])
    assert estimate.by_phase is by_phase


def test_phases_that_fit_no_plane_are_not_used():
    """Heights of 0.5 mm up and down turn the phase by 1 rad up and down; 0.5 rad is the limit."""
    masks, grid = make_plates()
    heights_m = [0.004 + 5e-4 * sign for sign in (1, -1, -1, 1, 1)]
    receiver = PlatesOfOneReceiver(masks, heights_m, std_m=1e-4)
    estimate = find_plane(SimpleNamespace(grid=grid, boards={"RH": receiver}), masks)
    assert not estimate.by_phase


@pytest.mark.parametrize(("tilt", "by_phase"), [(0.034, True), (0.037, False)])
def test_a_plane_by_phase_that_is_tilted_by_more_than_two_degrees_is_not_accepted(tilt, by_phase):
    """Two degrees are a rise of 0.035 per metre."""
    masks, grid = make_plates()
    x_m, _ = find_middles_m(masks, grid)
    receiver = PlatesOfOneReceiver(masks, tilt * x_m, std_m=1e-4)
    own_rises = [(tilt, 0.0)] * 5
    estimate = find_plane(SimpleNamespace(grid=grid, boards={"RH": receiver}), masks, own_rises)
    assert estimate.by_phase is by_phase


@pytest.mark.parametrize(
    ("heights_m", "std_m", "raised"),
    [
        # A raised plate lies at least 1.5 mm off the plane.
        ((0.004, 0.004), 1e-4, [2]),
        ((0.0014, 0.0014), 1e-4, []),
        # The mean over H and V must be known to 2 mm: it has 2.7 mm / sqrt(2) = 1.9 mm, and 2.97 / sqrt(2) = 2.1 mm.
        ((0.012, 0.012), 2.7e-3, [2]),
        ((0.012, 0.012), 2.97e-3, []),
        # H and V may differ by 3 mm plus three standard deviations of their difference. Each has at least 0.3 mm, so
        # that the limit is 3 + 3 * sqrt(2) * 0.3 = 4.3 mm; the differences are 4.2 and 4.4 mm.
        ((0.010, 0.0142), 1e-4, [2]),
        ((0.010, 0.0144), 1e-4, []),
    ],
)
def test_a_plate_is_raised_if_it_is_certain_that_it_lies_off_the_plane_of_the_others(
    monkeypatch, heights_m, std_m, raised
):
    """`heights_m` are those of plate 2 as H and as V see it; the other four plates lie on the rig file's plane."""
    monkeypatch.setattr("polysight.imaging.plane._fit_plane_by_phase", lambda *_: None)
    masks, grid = make_plates()
    receivers = {}
    for name, height_m in zip(("RH", "RV"), heights_m, strict=True):
        receivers[name] = PlatesOfOneReceiver(masks, [0.0, 0.0, height_m, 0.0, 0.0], std_m)
    estimate = find_plane(SimpleNamespace(grid=grid, boards=receivers), masks)
    raised_numbers = []
    for number, mask in enumerate(masks):
        if any(plate.region[mask].all() for plate in estimate.raised):
            raised_numbers.append(number)
    assert raised_numbers == raised
    assert estimate.plates == 5
