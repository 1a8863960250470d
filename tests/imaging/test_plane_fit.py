"""The plane of plates at given places and heights: compared with plain least squares; which plates are raised."""

from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from polysight.imaging.plane import (
    UNKNOWN_PLANE,
    PlaneEstimate,
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
WIDE_PRIOR = TiltPrior(np.zeros(2), np.full(2, 100.0))


def lay(plane: tuple[float, float, float]) -> np.ndarray:
    """Heights of the plates on a plane: height at the middle, rise along x and along y."""
    return plane[0] + PLACES @ np.array(plane[1:])


def test_plates_on_a_plane_give_that_plane():
    plane, _ = _fit_plane(PLACES, lay((0.002, 0.01, -0.02)), np.full(6, 1e-6), WIDE_PRIOR)
    np.testing.assert_allclose(plane, (0.002, 0.01, -0.02), rtol=1e-5)


def test_a_plane_is_the_weighted_least_squares_of_heights_and_prior():
    """The prior is three more measurements: the height is 0 within 5.8 mm, the tilts are as given."""
    rng = np.random.default_rng(1)
    stds = np.array([1e-3, 2e-3, 4e-3, 1e-3, 3e-3, 2e-3])
    heights = lay((0.002, 0.01, -0.02)) + stds * rng.standard_normal(6) / 3
    prior = TiltPrior(np.array([0.004, -0.003]), np.array([0.01, 0.02]))
    rows = np.vstack([np.column_stack([np.ones(6), PLACES]), np.eye(3)])
    values = np.concatenate([heights, [0.0, 0.004, -0.003]])
    errors = np.concatenate([stds, [5.8e-3, 0.01, 0.02]])
    expected, *_ = np.linalg.lstsq(rows / errors[:, None], values / errors, rcond=None)
    covariance = np.linalg.inv((rows / errors[:, None] ** 2).T @ rows)
    plane, found = _fit_plane(PLACES, heights, stds, prior)
    np.testing.assert_allclose(plane, expected)
    np.testing.assert_allclose(found, covariance)
    # Heights that scatter ten times as much: their scatter, with three unknowns, is that of the errors.
    heights += 30 * stds * np.array([1, -1, 1, -1, 1, -1])
    plane, wider = _fit_plane(PLACES, heights, stds, prior)
    chi2 = np.sum(((heights - plane[0] - PLACES @ plane[1:]) / stds) ** 2)
    np.testing.assert_allclose(wider, covariance * chi2 / 3)


def test_without_plates_a_plane_is_its_prior():
    prior = TiltPrior(np.array([0.004, -0.003]), np.array([0.01, 0.02]))
    plane, covariance = _fit_plane(np.zeros((0, 2)), np.zeros(0), np.zeros(0), prior)
    np.testing.assert_allclose(plane, (0.0, 0.004, -0.003))
    np.testing.assert_allclose(covariance, np.diag([5.8e-3, 0.01, 0.02]) ** 2)


@pytest.mark.parametrize("plane", [(0.003, 0.0, 0.0), (0.003, 0.01, 0.0), (-0.001, 0.01, -0.02)])
@pytest.mark.parametrize("raised_m", [0.02, -0.02])
def test_most_plates_determine_a_plane_whatever_the_others(plane, raised_m):
    heights = lay(plane)
    heights[[1, 4]] += raised_m
    prior = TiltPrior(np.array([0.0, 0.0]), np.array([0.02, 0.02]))
    np.testing.assert_allclose(_fit_most(PLACES, heights, np.full(6, 5e-4), prior), lay(plane), atol=1e-4)


def test_the_own_tilts_of_plates_are_a_measurement_of_the_planes_tilt():
    """A median has 1.25 times the error of a mean, of 1.48 times the median deviation; the prior is 0 within 0.02."""
    own = np.array([0.008, 0.010, 0.012, 0.014, 0.016])
    std = np.hypot(5e-3, 1.25 * 1.48 * 0.002 / np.sqrt(5))
    precision = 0.02**-2 + std**-2
    prior = TiltPrior.from_plates([(rise, 0.0) for rise in own])
    assert prior.mean == pytest.approx([0.012 * std**-2 / precision, 0.0])
    assert prior.std == pytest.approx([precision**-0.5, 0.02])


def make_strips() -> list[np.ndarray]:
    """Insides of three plates, columns 2 to 4, 12 to 14 and 32 to 34 of an image of 8 x 40 pixels."""
    masks = [np.zeros((8, 40), bool) for _ in range(3)]
    for mask, column in zip(masks, (2, 12, 32), strict=True):
        mask[2:6, column : column + 3] = True
    return masks


def test_a_raised_plate_has_the_pixels_nearest_to_it_and_not_those_far_away():
    """Regions reach 12 mm: six pixels of 2 mm beyond the inside, or half of the way to the next plate."""
    (plate,) = _mark_raised(make_strips(), np.array([0.0, 0.004, 0.0]), np.array([False, True, False]), 2e-3)
    assert plate.height_m == 0.004
    # Column 8 is as far from either.
    columns = np.flatnonzero(plate.region[3])
    assert columns[-1] == 14 + 6
    assert columns[0] in (8, 9)
    assert np.flatnonzero(plate.region[:, 13]).tolist() == list(range(8))
    assert _mark_raised(make_strips(), np.zeros(3), np.zeros(3, bool), 2e-3) == ()
    first, third = _mark_raised(make_strips(), np.array([1.0, 2.0, 3.0]), np.array([True, False, True]), 2e-3)
    assert (first.height_m, third.height_m) == (1.0, 3.0)
    assert np.flatnonzero(third.region[3]).tolist() == list(range(26, 40))
    assert not (first.region & third.region).any()


def test_what_lies_beside_plates_is_an_error_of_their_slopes():
    masks = make_strips()
    ones = np.ones((8, 40), complex)
    assert _measure_slope_behind(ones, ones, 3 * ones, 3 * ones, masks) == 0.0
    # A slope of 2 + 2j beside the plates: 2 in each part
    assert _measure_slope_behind(ones, ones, (2 + 2j) * ones, 0 * ones, masks) == pytest.approx(2.0)
    # The slope of an echo as strong on the plane does not count.
    assert _measure_slope_behind(2 * ones, ones, (2 + 2j) * ones, 1j * ones, masks) == pytest.approx(2**0.5)
    # Without plates, or where the mirror is not lit, nothing is known.
    assert _measure_slope_behind(ones, ones, 2 * ones, 0 * ones, [np.zeros((8, 40), bool)]) == 0.0
    assert _measure_slope_behind(ones, 0 * ones, 2 * ones, 0 * ones, masks) == 0.0


def estimate(offset_m: float, **changes: Any) -> PlaneEstimate:
    """The estimate of a scene with one plate at a height, in other fields as of a scene without plates."""
    return replace(UNKNOWN_PLANE, **({"offset_m": offset_m, "plates": 1} | changes))


@pytest.mark.parametrize(
    ("offset_m", "moved_m"),
    [(0.0, 0.0), (5e-4, 0.0), (5.1e-4, 5.1e-4), (-5.1e-4, -5.1e-4), (0.0149, 0.0149), (0.015, 0.0), (-0.0151, 0.0)],
)
def test_images_are_moved_to_a_plane_half_a_millimetre_to_15_mm_off(rig, offset_m, moved_m):
    plane = estimate(offset_m)
    assert plane.moved_m == moved_m
    distance_mm = rig.geometry.object_distance_mm
    assert plane.apply_to_rig(rig).geometry.object_distance_mm == pytest.approx(distance_mm + 1e3 * moved_m)
    assert estimate(0.002, plates=0).moved_m == 0.0


def test_the_error_of_the_angle_is_that_of_the_distance(rig):
    """Half of the distance between two antennas over the distance of the plane is the tangent of the angle."""
    z_m = rig.geometry.object_distance_mm / 1e3
    for plane, std_m in ((estimate(0.0, offset_std_m=2.4e-3), 2.6e-3), (UNKNOWN_PLANE, 5.8e-3)):
        half_m = z_m * np.tan(np.radians(incidence_deg(rig, rig.receivers[0])))
        change = np.arctan(half_m / (z_m - std_m / 2)) - np.arctan(half_m / (z_m + std_m / 2))
        assert plane.incidence_std_rad(rig) == pytest.approx(change, rel=0.02)


def test_a_plane_is_written_in_millimetres_and_degrees():
    plane = estimate(
        0.0021, offset_std_m=0.0003, tilt_rad=(0.01, -0.02), tilt_std_rad=(0.001, 0.002), by_phase=True, plates=5,
        raised=_mark_raised(make_strips(), np.array([0.0, 0.0051, 0.0]), np.array([False, True, False]), 2e-3),
    )  # fmt: skip
    assert plane.to_dict() == {
        "known": True,
        "offset_mm": 2.1,
        "offset_std_mm": 0.3,
        "tilt_deg": [0.573, -1.1459],
        "tilt_std_deg": [0.0573, 0.1146],
        "by": "phase",
        "plates": 5,
        "raised_mm": [3.0],
    }
    assert estimate(0.0, tilt_std_rad=(0.0, 0.0), offset_std_m=0.0).to_dict()["by"] == "range"
    swapped = plane.transpose()
    assert (swapped.tilt_rad, swapped.tilt_std_rad) == ((-0.02, 0.01), (0.002, 0.001))
    assert (swapped.raised[0].region == plane.raised[0].region.T).all()
    assert UNKNOWN_PLANE.to_dict() == {"known": False}


class LevelBoard:
    """Images of a board on which each plate has a height and a scatter of it."""

    def __init__(self, masks: list[np.ndarray], heights_m: Sequence[float], std_m: float) -> None:
        self._ones = np.ones(masks[0].shape, complex)
        self._image = -self._ones
        self._slope = 0 * self._ones
        for mask, height_m in zip(masks, heights_m, strict=True):
            sign = 2 * (np.arange(mask.sum()) % 2) - 1
            # The phase grows by 2000 rad / m.
            self._image[mask] = -np.exp(2000j * height_m)
            self._slope[mask] = self._image[mask] * 40.0 * (height_m + std_m * sign)

    def image(self):
        return self._image, self._ones, None

    def range_slope(self):
        return self._slope, 0 * self._ones

    def mirror_image(self, step_m):
        return np.exp(2000j * step_m) * self._ones

    def mirror_slope(self, step_m):
        return step_m * 40.0 * self.mirror_image(step_m)


def make_plates() -> tuple[list[np.ndarray], SimpleNamespace]:
    """Insides of five plates in two rows, and the grid of their image of 60 x 30 pixels of 2 mm."""
    masks = [np.zeros((30, 60), bool) for _ in range(5)]
    for number, mask in enumerate(masks):
        row = 3 + 12 * (number % 2)
        mask[row : row + 4, 12 * number : 12 * number + 4] = True
    return masks, SimpleNamespace(x_m=0.3 + np.arange(60) * 2e-3, y_m=np.arange(30) * 2e-3 - 0.2, pixel_m=2e-3)


@pytest.mark.parametrize("plane", [(0.004, 0.0, 0.0), (0.004, 0.005, 0.0), (-0.005, 0.004, -0.01), (0.0001, 0.0, 0.01)])
@pytest.mark.parametrize("has_phase", [True, False])
def test_plates_on_a_plane_are_measured_by_phase_where_range_resolves_its_turns(monkeypatch, plane, has_phase):
    """A turn of the phase is 3.1 mm; ranges are 0.1 mm off, up and down."""
    masks, grid = make_plates()
    x_m = np.array([grid.x_m[mask.any(axis=0)].mean() for mask in masks]) - grid.x_m.mean()
    y_m = np.array([grid.y_m[mask.any(axis=1)].mean() for mask in masks]) - grid.y_m.mean()
    heights_m = plane[0] + plane[1] * x_m + plane[2] * y_m
    if not has_phase:
        monkeypatch.setattr("polysight.imaging.plane._fit_plane_by_phase", lambda *_: None)
    board = LevelBoard(masks, heights_m, 1e-4)
    found = find_plane(SimpleNamespace(grid=grid, boards={"RH": board}), masks)
    assert found.by_phase is has_phase
    np.testing.assert_allclose(found.heights_m, heights_m, atol=1e-8)
    assert found.offset_m == pytest.approx(plane[0], abs=1e-5 if has_phase else 3e-4)
    np.testing.assert_allclose(np.tan(found.tilt_rad), plane[1:], atol=2e-4 if has_phase else 5e-3)
    assert found.raised == ()


@pytest.mark.parametrize(("plates", "by_phase"), [(3, False), (4, True), (5, True)])
def test_three_plates_cannot_contradict_a_plane_by_phase(plates, by_phase):
    masks, grid = make_plates()
    board = LevelBoard(masks[:plates], [0.004] * plates, 1e-4)
    assert find_plane(SimpleNamespace(grid=grid, boards={"RH": board}), masks[:plates]).by_phase is by_phase


def test_phases_that_fit_no_plane_are_not_used():
    """0.5 mm up and down is 0.16 of a turn, 1 rad; a plane has no such phases."""
    masks, grid = make_plates()
    heights_m = [0.004 + 5e-4 * sign for sign in (1, -1, -1, 1, 1)]
    found = find_plane(SimpleNamespace(grid=grid, boards={"RH": LevelBoard(masks, heights_m, 1e-4)}), masks)
    assert not found.by_phase
    # A plane that is tilted by more than two degrees is not accepted by phase.
    x_m = np.array([grid.x_m[mask.any(axis=0)].mean() for mask in masks]) - grid.x_m.mean()
    for tilt, by_phase in ((0.034, True), (0.037, False)):
        board = LevelBoard(masks, tilt * x_m, 1e-4)
        rises = [(tilt, 0.0)] * 5
        assert find_plane(SimpleNamespace(grid=grid, boards={"RH": board}), masks, rises).by_phase is by_phase


@pytest.mark.parametrize(
    ("heights_m", "std_m", "raised"),
    [
        ((0.004, 0.004), 1e-4, [2]),
        ((0.0014, 0.0014), 1e-4, []),
        # The mean of H and V is more precise than either: 1.9 and 2.1 mm. Less precise heights show nothing.
        ((0.012, 0.012), 2.7e-3, [2]),
        ((0.012, 0.012), 2.97e-3, []),
        # H and V agree within 3 mm and three standard deviations, 0.3 mm each.
        ((0.010, 0.0142), 1e-4, [2]),
        ((0.010, 0.0144), 1e-4, []),
    ],
)
def test_a_plate_that_lies_apart_from_the_others_is_raised(monkeypatch, heights_m, std_m, raised):
    monkeypatch.setattr("polysight.imaging.plane._fit_plane_by_phase", lambda *_: None)
    masks, grid = make_plates()
    boards = {
        name: LevelBoard(masks, [0.0, 0.0, height_m, 0.0, 0.0], std_m)
        for name, height_m in zip(("RH", "RV"), heights_m, strict=True)
    }
    found = find_plane(SimpleNamespace(grid=grid, boards=boards), masks)
    assert [number for number in range(5) if any(plate.region[masks[number]].all() for plate in found.raised)] == raised
    assert found.plates == 5
