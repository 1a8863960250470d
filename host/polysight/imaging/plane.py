"""Distance and tilt of the object plane from the echoes of flat plates (`move_to_plane`).

A plate's echo gives its *height*, the distance behind the rig file's plane, in two ways:
* by range: from the change of the image's amplitude with range (bandwidth of the sweep); coarse but unambiguous, within
  about a millimetre;
* by phase: fine but ambiguous, by half a wavelength / cos(incidence angle); the height by range resolves that.
Both ways compare the echo with that of a mirror on the rig file's plane, seen from the same positions. So aperture,
taper (weights of the positions) and masked positions have no influence. The image of that mirror is the *footprint*.

One plane is fitted to most plates:

    height(x, y) = height at the middle + rise_x x + rise_y y

Plates at another height by range, such as blocks of another thickness, are *raised*: each is imaged on a plane of its
own, because at another distance it is seen at another angle. Level plates of several thicknesses can also be near some
tilted plane. The *own tilts* of the plates, from the phase over each plate, rule that out: they are the prior of the
plane's tilt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.imaging.images import Dispersion, ImageBuilder, Images, Rise
from polysight.imaging.samples import BoardSamples
from polysight_shared.config import Instrument
from polysight_shared.geometry import incidence_deg

PLANE_REACH_M = 0.015
"""Images are moved to planes up to this far from the rig file's plane, and echoes from there are kept; chosen."""
MOUNT_STD_M = 1e-3
"""Standard deviation of the antennas' distance by errors of the rig file, added to that of a known plane; chosen."""
PRIOR_STD_M = 5.8e-3
"""Standard deviation of the plane's distance if the scene does not determine it: that of a uniform error within +-10 mm
(chosen)."""
_WORTH_M = 5e-4
"""Smallest offset of the plane for which images are formed again. A smaller one changes the incidence angle by less
than an error of MOUNT_STD_M."""
_STEP_M = 2e-4
"""Step of height for the numerical derivatives of range and phase; chosen."""
_LEAST_COHERENCE = 0.7
"""A plate's phase is used if the coherence of its pixels, |sum| / sum of magnitudes, is above this; chosen."""
_TILT_PRIOR_RAD = 0.02
"""Prior standard deviation of the tilt along x and along y: about one degree (chosen)."""
_OWN_TILT_STD = 5e-3
"""Smallest standard deviation of the tilt by the plates' own tilts, rise per metre: 0.3 degrees (chosen). A phase that
grows over the scan, as by an error of the stage's scale, looks like an equal tilt of all plates."""
_LEAST_OWN_TILTS = 3
"""Least number of own tilts that are used; chosen: their scatter is needed."""
_MIN_STD_M = 3e-4
"""Smallest standard deviation of a height by range, due to sidelobes of the plate's neighbours; chosen."""
_MAX_RISE_BY_PHASE = 0.035
"""Largest accepted tilt of a plane by phase, rise per metre: two degrees; chosen."""
_TILT_TOLERANCE = 3e-3
"""Accepted difference between the tilts by phase and by range, in addition to three standard deviations of the latter,
rise per metre (chosen)."""
_MAX_RANGE_STD_M = 0.05
"""Largest standard deviation of a height by range that is used (chosen)."""
# Pixels with a larger footprint, relative to the largest one, are illuminated; chosen.
_LIT_FOOTPRINT = 0.1
# Distance from a plate's inside up to which a pixel may still show the plate; chosen.
_AROUND_PX = 5
# Squares of the background are used if more than this share of their pixels shows no plate; chosen.
_MOST_OF_SQUARE = 0.6
_PHASE_FITS_RAD = 0.5
"""Largest root mean square of the phases' deviations from the fitted plane, radians (chosen); random phases have
1.8."""
_PHASE_STD_M = 5e-5
"""Standard deviation of a height by phase, due to roughness and to the phase of the reflection (some degrees for lossy
plates); chosen."""
RAISED_M = 1.5e-3
"""A plate is raised if its height by range differs from the plane of the others by more than this, and by more than
three standard deviations. Such a difference changes the incidence angle by 1.5 mrad, as much as the error of the angle.
Thin plates appear up to a millimetre deeper, because their rear face echoes, too. Chosen."""
_PRECISE_STD_M = 2e-3
"""Only plates whose height by range has a smaller standard deviation can be raised; chosen. In the demo's scene the
echo of a table passes through the plates: their heights have 4 to 13 mm, except for copper."""
_BOARDS_AGREE_M = 3e-3
"""The heights by range of a raised plate in H and in V differ by at most this and three standard deviations; chosen. A
liquid behind glass changes over the sweep, differently in H and V: its two heights are 35 mm apart."""
_LEVEL_STD_M = 5e-4
"""Standard deviation of the heights of plates of one plane, in addition to that by range; chosen."""
_LEVEL_STDS = 3.0
"""A plate farther from the plane than this, in standard deviations, is left out of the plane's fit; chosen."""
_RAISED_REACH_M = 0.012
"""A raised plate's own plane replaces the images at pixels up to this far from its inside that are not nearer to
another plate. So they include its edges, which `find_interiors` has left out. Chosen."""


@dataclass(frozen=True)
class RaisedPlate:
    """A plate that does not lie on the plane of the others.

    `height_m` is its height. `region` bool [ny, nx], on the builder's grid, is where its own plane replaces the images.
    """

    height_m: float
    region: NDArray[np.bool_]


@dataclass(frozen=True)
class TiltPrior:
    """Prior of the plane's tilt before heights are known: a normal distribution along x and along y.

    `mean` and `std`, float64 [2], are in rise per metre.
    """

    mean: NDArray[np.float64]
    std: NDArray[np.float64]

    @classmethod
    def from_plates(cls, rises: Sequence[Rise]) -> TiltPrior:
        """Return the prior, given the plates' own rises along x and y, radians; a rise of 0 counts as unknown.

        Along each axis two normal distributions of the tilt are multiplied. One is around 0, with the standard
        deviation `_TILT_PRIOR_RAD`. The other is around the median of the plates' own tilts, because plates on a tilted
        plane are tilted with it. Its variance is that of a median, (1.25 std / sqrt(number of plates))^2, plus
        `_OWN_TILT_STD`^2.
        """
        mean = np.zeros(2)
        std = np.full(2, _TILT_PRIOR_RAD)
        for along, rise in enumerate(np.array(rises, np.float64).reshape(-1, 2).T):
            known = rise[rise != 0]
            if known.size < _LEAST_OWN_TILTS:
                continue
            median = float(np.median(known))
            scatter = 1.48 * float(np.median(np.abs(known - median)))
            own_std = float(np.hypot(_OWN_TILT_STD, 1.25 * scatter / np.sqrt(known.size)))
            precision = np.array([_TILT_PRIOR_RAD, own_std]) ** -2
            mean[along] = median * precision[1] / precision.sum()
            std[along] = precision.sum() ** -0.5
        return cls(mean, std)


@dataclass(frozen=True)
class PlaneEstimate:
    """Plane of the plates relative to the rig file's plane.

    Attributes
    ----------
    offset_m, offset_std_m
        Height of the plane, its distance behind the rig file's plane at the middle of the image, and its standard
        deviation.
    tilt_rad, tilt_std_rad
        Tilt of the plane along x and along y, radians (positive where z grows), and their standard deviations.
    heights_m
        float64 [patch]: height of each patch, by range, or by phase if `by_phase` and not raised; NaN if undetermined.
    by_phase
        True if the plane is that of the phases: those of the plates that are not raised fit one plane, which agrees
        with the ranges.
    plates
        Number of patches with a height by range; 0 if the plane is not known.
    raised
        Plates that lie on other planes.
    """

    offset_m: float
    offset_std_m: float
    tilt_rad: tuple[float, float]
    tilt_std_rad: tuple[float, float]
    heights_m: NDArray[np.float64]
    by_phase: bool
    plates: int
    raised: tuple[RaisedPlate, ...] = ()

    @property
    def known(self) -> bool:
        """True if the scene determines the plane."""
        return self.plates > 0

    @property
    def worth_moving(self) -> bool:
        """True if the offset is large enough to form images again (0.5 mm), and below `PLANE_REACH_M`."""
        return self.known and abs(self.offset_m) > _WORTH_M and abs(self.offset_m) < PLANE_REACH_M

    @property
    def moved_m(self) -> float:
        """Distance of the images' plane behind the rig file's plane: `offset_m`, or 0 if not `worth_moving`."""
        return self.offset_m if self.worth_moving else 0.0

    def apply_to_rig(self, rig: Instrument) -> Instrument:
        """Return the rig with its object plane moved by `offset_m`; the rig itself if not `worth_moving`."""
        if not self.worth_moving:
            return rig
        distance = rig.geometry.object_distance_mm + 1e3 * self.offset_m
        return msgspec.structs.replace(rig, geometry=msgspec.structs.replace(rig.geometry, object_distance_mm=distance))

    def form_images(self, builder: ImageBuilder) -> Images:
        """Form the images on this plane, and those of each raised plate on the plate's own plane."""
        images = builder.finish(self.moved_m)
        for plate in self.raised:
            images = _replace_region(images, builder.finish(plate.height_m), plate, self.moved_m)
        return images

    def form_dispersion(self, builder: ImageBuilder) -> Dispersion:
        """Form the dispersion on this plane, and that of each raised plate on the plate's own plane."""
        dispersion = builder.form_dispersion(self.moved_m)
        for plate in self.raised:
            plate_dispersion = builder.form_dispersion(plate.height_m)
            h = np.where(plate.region, plate_dispersion.h, dispersion.h)
            dispersion = replace(dispersion, h=h, v=np.where(plate.region, plate_dispersion.v, dispersion.v))
        return dispersion

    def incidence_std_rad(self, rig: Instrument) -> float:
        """Return the standard deviation of the incidence angle theta, radians.

        It is d theta / d z = sin theta cos theta / z times the standard deviation of the plane's distance z. If the
        plane is known, that of the antennas' distance is added (as squares).
        """
        theta = np.radians(incidence_deg(rig, rig.receivers[0]))
        offset_std_m = PRIOR_STD_M
        if self.known:
            offset_std_m = float(np.hypot(self.offset_std_m, MOUNT_STD_M))
        return float(np.sin(theta) * np.cos(theta) / (rig.geometry.object_distance_mm / 1e3) * offset_std_m)

    def transpose(self) -> PlaneEstimate:
        """Return the estimate with x and y swapped."""
        raised = tuple(replace(plate, region=np.ascontiguousarray(plate.region.T)) for plate in self.raised)
        return replace(self, tilt_rad=self.tilt_rad[::-1], tilt_std_rad=self.tilt_std_rad[::-1], raised=raised)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for quality.json; millimetres and degrees."""
        if not self.known:
            return {"known": False}
        return {
            "known": True,
            "offset_mm": round(1e3 * self.offset_m, 3),
            "offset_std_mm": round(1e3 * self.offset_std_m, 3),
            "tilt_deg": [round(float(np.degrees(t)), 4) for t in self.tilt_rad],
            "tilt_std_deg": [round(float(np.degrees(t)), 4) for t in self.tilt_std_rad],
            "by": "phase" if self.by_phase else "range",
            "plates": self.plates,
            "raised_mm": [round(1e3 * (plate.height_m - self.offset_m), 2) for plate in self.raised],
        }


UNKNOWN_PLANE = PlaneEstimate(
    offset_m=0.0,
    offset_std_m=np.inf,
    tilt_rad=(0.0, 0.0),
    tilt_std_rad=(np.inf, np.inf),
    heights_m=np.zeros(0),
    by_phase=False,
    plates=0,
)
"""Estimate of a scene that does not determine the plane: the rig file's plane is used."""


def find_plane(builder: ImageBuilder, masks: Sequence[NDArray[np.bool_]], rises: Sequence[Rise] = ()) -> PlaneEstimate:
    """Estimate the plane from the insides of flat patches; without any height the result is not `known`.

    Parameters
    ----------
    builder
        Builder with the rows, and with a range gate that includes the plane (`depth_m`).
    masks
        bool [ny, nx], one per patch, on the builder's grid.
    rises
        The patches' own tilts along the builder's x and y, radians, 0 where unknown; none if no tilt is known.
    """
    grid = builder.grid
    tilt = TiltPrior.from_plates(rises)
    x = grid.x_m - grid.x_m.mean()
    y = grid.y_m - grid.y_m.mean()
    # Heights and standard deviations [patch] of each board.
    ranges = [_estimate_heights_by_range(board, masks) for board in builder.boards.values()]
    precision = np.stack([1 / std**2 for _, std in ranges])
    total = precision.sum(axis=0)
    # Mean over the boards, weighted by their precision.
    with np.errstate(invalid="ignore", divide="ignore"):
        heights = sum(precision[i] * np.nan_to_num(ranges[i][0]) for i in range(len(ranges))) / total
    stds = np.sqrt(1 / np.where(total > 0, total, np.nan))
    determined = np.isfinite(heights)
    if not determined.any():
        return replace(UNKNOWN_PLANE, heights_m=np.full(len(masks), np.nan))
    # Middle of each patch (x, y), relative to the middle of the image.
    places = np.zeros((len(masks), 2))
    for place, mask in zip(places, masks, strict=True):
        if mask.any():
            place[:] = x[mask.any(axis=0)].mean(), y[mask.any(axis=1)].mean()
    is_precise = determined & (stds <= _PRECISE_STD_M)
    is_level = determined.copy()
    if is_precise.any():
        level_stds = np.hypot(stds[is_precise], _LEVEL_STD_M)
        heights_of_most = _fit_most(places[is_precise], heights[is_precise], level_stds, tilt)
        is_level[is_precise] = np.abs(heights[is_precise] - heights_of_most) <= _LEVEL_STDS * level_stds
    plane, covariance = _fit_plane(places[is_level], heights[is_level], np.hypot(stds[is_level], _MIN_STD_M), tilt)
    is_by_phase = False
    phase_fit = _fit_plane_by_phase(builder, masks, places, is_level, (plane, covariance, tilt))
    if phase_fit is not None:
        is_by_phase = True
        plane, covariance, phase_heights = phase_fit
        heights = np.where(is_level & np.isfinite(phase_heights), phase_heights, heights)
    distance_m = np.abs(heights - _evaluate_plane(plane, places))
    difference_of_boards_m = np.ptp([heights_of_board for heights_of_board, _ in ranges], axis=0)
    boards_agree = difference_of_boards_m <= _BOARDS_AGREE_M + 3 * np.linalg.norm([std for _, std in ranges], axis=0)
    is_raised = is_precise & ~is_level & (distance_m > np.maximum(RAISED_M, 3 * stds)) & boards_agree
    std = np.sqrt(np.diag(covariance))
    return PlaneEstimate(
        offset_m=float(plane[0]),
        offset_std_m=float(std[0]),
        tilt_rad=(float(np.arctan(plane[1])), float(np.arctan(plane[2]))),
        tilt_std_rad=(float(std[1]), float(std[2])),
        heights_m=np.asarray(heights, np.float64),
        by_phase=is_by_phase,
        plates=int(determined.sum()),
        raised=_mark_raised(masks, heights, is_raised, grid.pixel_m),
    )


def _mark_raised(
    masks: Sequence[NDArray[np.bool_]], heights: NDArray[np.float64], is_raised: NDArray[np.bool_], pixel_m: float
) -> tuple[RaisedPlate, ...]:
    """Return the raised plates with their regions (`_RAISED_REACH_M`)."""
    if not is_raised.any():
        return ()
    numbers = np.zeros(masks[0].shape, np.intp)
    for i, mask in enumerate(masks):
        numbers[mask] = i + 1
    distance_px, nearest_plate = scipy.ndimage.distance_transform_edt(numbers == 0, return_indices=True)
    owner = np.where(distance_px * pixel_m <= _RAISED_REACH_M, numbers[tuple(nearest_plate)], 0)
    return tuple(RaisedPlate(float(heights[i]), owner == i + 1) for i in np.flatnonzero(is_raised))


def _replace_region(images: Images, plate_images: Images, plate: RaisedPlate, plane_m: float) -> Images:
    """Return the images with those of a raised plate's own plane in its region; `plane_m`: height of the others."""
    region = plate.region
    replaced = {
        name: np.where(region, getattr(plate_images, name), getattr(images, name))
        for name in ("h", "v", "h_raw", "v_raw")
    }
    illumination = images.illumination
    if illumination is not None and plate_images.illumination is not None:
        footprints = np.where(region, plate_images.illumination.footprints, illumination.footprints)
        illumination = replace(illumination, footprints=footprints)
    raised_m = np.zeros(region.shape) if images.raised_m is None else images.raised_m
    raised_m = np.where(region, plate.height_m - plane_m, raised_m)
    valid = np.where(region, plate_images.valid, images.valid)
    return replace(images, **replaced, valid=valid, illumination=illumination, raised_m=raised_m)


def move_to_plane(
    builder: ImageBuilder, images: Images, masks: Sequence[NDArray[np.bool_]], transposed: bool, move: bool
) -> tuple[PlaneEstimate, Images]:
    """Estimate the plane of patches; return it, and the images on it.

    Images are formed again if the plane differs enough from the rig file's (`PlaneEstimate.worth_moving`), or if plates
    are raised. With `move` they get their dispersion, too.

    Parameters
    ----------
    builder, images
        Builder with all rows, and its images.
    masks
        bool [ny, nx] insides of the patches, on the images' grid.
    transposed
        True if `images` and `masks` are the builder's with x and y swapped. The plane is that of the builder's axes.
    move
        False: return the images unchanged, without dispersion.
    """
    rises: list[Rise] = []
    if images.illumination is not None:
        rises = [images.illumination.estimate_rise(images.h, images.v, mask) for mask in masks]
    if transposed:
        rises = [(y, x) for x, y in rises]
    plane = find_plane(builder, [mask.T if transposed else mask for mask in masks], rises)
    if not move:
        return plane, images
    if plane.worth_moving or plane.raised:
        images = plane.form_images(builder)
        if transposed:
            images = images.transpose()
    dispersion = plane.form_dispersion(builder)
    if transposed:
        dispersion = dispersion.transpose()
    return plane, replace(images, dispersion=dispersion)


def _estimate_heights_by_range(
    board: BoardSamples, masks: Sequence[NDArray[np.bool_]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the height by range of each patch, and its standard deviation, metres, [patch].

    The height is the relative change of the amplitude with range, minus that of a mirror, over the change of a mirror's
    per metre of height. Where the range does not determine the height, it is NaN and its standard deviation infinite.
    The echo of what lies behind a plate, such as a table, passes through it and changes all of its pixels equally. This
    error is not in the scatter of the pixels: it is taken from the background next to the plates.
    """
    image, footprint, _ = board.image()
    slope, mirror_slope = board.range_slope()
    moved_image = board.mirror_image(_STEP_M)
    moved_slope = board.mirror_slope(_STEP_M)
    heights = np.full(len(masks), np.nan)
    stds = np.full(len(masks), np.inf)
    slope_behind = _measure_slope_behind(image, footprint, slope, mirror_slope, masks)
    for i, mask in enumerate(masks):
        power = np.abs(image[mask].astype(np.complex128)) ** 2
        if not power.sum() > 0:
            continue
        weight = power / power.sum()
        # [pixel]: relative change of the amplitude with range, minus that of a mirror on the rig file's plane; the same
        # for a mirror at the height _STEP_M, per metre of height.
        with np.errstate(invalid="ignore", divide="ignore"):
            path_slope = np.real(slope[mask] / image[mask]) - np.real(mirror_slope[mask] / footprint[mask])
            slope_per_height = (
                np.real(moved_slope[mask] / moved_image[mask]) - np.real(mirror_slope[mask] / footprint[mask])
            ) / _STEP_M
        per_metre = float(np.nansum(weight * slope_per_height))
        path_slope = np.where(np.isfinite(path_slope), path_slope, 0.0)
        mean = float(np.sum(weight * path_slope))
        path_std = float(np.sqrt(np.sum(weight * (path_slope - mean) ** 2)))
        height = mean / per_metre
        std = float(np.hypot(path_std, slope_behind / np.sqrt(power.mean()))) / abs(per_metre)
        if std < _MAX_RANGE_STD_M:
            heights[i] = height
            stds[i] = max(std, _MIN_STD_M)
    return heights, stds


def _measure_slope_behind(
    image: NDArray[np.complexfloating],
    footprint: NDArray[np.complexfloating],
    slope: NDArray[np.complexfloating],
    mirror_slope: NDArray[np.complexfloating],
    masks: Sequence[NDArray[np.bool_]],
) -> float:
    """Return the standard deviation by the background of the change of a plate's amplitude with range.

    In the background, away from all plates, the image's slope minus that of an equally strong echo on the plane is
    averaged over squares of a plate's size. The result is the root mean square of the real part, and of the imaginary
    part, of these means; 0 without such squares. Divided by a plate's |image| it is the error of its relative slope.
    """
    lit = np.abs(footprint) > _LIT_FOOTPRINT * np.abs(footprint).max()
    plates = np.logical_or.reduce([*masks, np.zeros(image.shape, bool)])
    sizes = [mask.sum() for mask in masks if mask.any()]
    if not sizes:
        return 0.0
    width_px = max(1, round(float(np.sqrt(np.median(sizes)))))
    is_beside_plates = lit & ~scipy.ndimage.binary_dilation(plates, iterations=_AROUND_PX)
    with np.errstate(invalid="ignore", divide="ignore"):
        background_slope = np.where(is_beside_plates, slope - image * (mirror_slope / footprint), 0)
    share = scipy.ndimage.uniform_filter(is_beside_plates.astype(np.float64), width_px, mode="constant")
    mean = scipy.ndimage.uniform_filter(background_slope.astype(np.complex128), width_px, mode="constant")
    is_whole_square = share > _MOST_OF_SQUARE
    if not is_whole_square.any():
        return 0.0
    return float(np.sqrt(np.mean(np.abs(mean[is_whole_square] / share[is_whole_square]) ** 2) / 2))


def _estimate_heights_by_phase(
    board: BoardSamples,
    masks: Sequence[NDArray[np.bool_]],
    places: NDArray[np.float64],
    near: tuple[NDArray[np.float64], TiltPrior],
    chosen: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], float]:
    """Return the heights by phase [patch], metres, NaN where pixels are not coherent; and the radians per metre.

    Only patches of `chosen` [patch] get a height. `places` [patch, 2] are the middles of the patches, metres. `board`
    is the one of H.

    A phase gives a height but for a multiple of the ambiguity. The multiples are chosen so that all heights fit one
    plane best: many trial planes are taken around the plane by range (`near`: the plane [3], height and rise along x
    and y, and the prior of its tilt); for each, every height is moved to the multiple next to it.
    """
    plane, prior = near
    image, footprint, _ = board.image()
    moved_image = board.mirror_image(_STEP_M)
    phases = np.full(len(masks), np.nan)
    rates = []
    for i, mask in enumerate(masks):
        # The reflection r_s of a plate is nearly real and negative: with the minus its phase is about zero.
        relative_to_mirror = -image[mask].astype(np.complex128) * np.conj(footprint[mask])
        coherence = abs(relative_to_mirror.sum()) / max(float(np.abs(relative_to_mirror).sum()), 1e-300)
        if chosen[i] and mask.any() and coherence > _LEAST_COHERENCE:
            phases[i] = np.angle(relative_to_mirror.sum())
            # Change of a mirror's phase with its height, radians per metre.
            rates.append(float(np.angle(np.vdot(footprint[mask], moved_image[mask]))) / _STEP_M)
    if not rates:
        return phases, 1.0
    rad_per_m = float(np.median(rates))
    ambiguity_m = 2 * np.pi / abs(rad_per_m)
    plates_with_phase = np.flatnonzero(np.isfinite(phases))
    design = np.column_stack([np.ones(plates_with_phase.size), places[plates_with_phase]])
    # The plane by range may be wrong by some multiples of the ambiguity. If the tilt is right, the error is common to
    # all plates. 17 tilts along each axis are tried, within one standard deviation of the prior; [trial, 3].
    tilts = np.linspace(-1, 1, 17) * _TILT_PRIOR_RAD
    trial_planes = plane + np.array([(0.0, tilt_x, tilt_y) for tilt_x in tilts for tilt_y in tilts])
    # Heights of the plates on each trial plane, [trial, plate].
    guesses = trial_planes @ design.T
    heights = phases[plates_with_phase] / rad_per_m
    phasors = np.exp(2j * np.pi * (heights - guesses) / ambiguity_m)
    common_height = np.angle(np.mean(phasors, axis=1)) / (2 * np.pi) * ambiguity_m
    # Multiples of the ambiguity are added: first those that bring the heights to the trial plane moved by their common
    # height, then one for all plates, which brings them nearest to the trial plane itself. [trial, plate]
    lifted = heights + ambiguity_m * np.round((guesses + common_height[:, None] - heights) / ambiguity_m)
    lifted += ambiguity_m * np.round((np.median(guesses, axis=1) - np.median(lifted, axis=1)) / ambiguity_m)[:, None]
    # Fit a plane with the prior to each trial's heights. The matrix depends only on the places, and is the same for all
    # trials.
    precision = np.array([0.0, *prior.std**-2])
    mean = np.array([0.0, *prior.mean])
    weighted = design / _PHASE_STD_M**2
    planes = np.linalg.solve(design.T @ weighted + np.diag(precision), (lifted @ weighted + precision * mean).T).T
    chi2 = ((lifted - planes @ design.T) ** 2).sum(axis=1) / _PHASE_STD_M**2
    chi2 += (precision * (planes - mean) ** 2).sum(axis=1)
    best_heights = np.full(len(masks), np.nan)
    best_heights[plates_with_phase] = lifted[int(np.argmin(chi2))]
    return best_heights, rad_per_m


def _fit_plane_by_phase(
    builder: ImageBuilder,
    masks: Sequence[NDArray[np.bool_]],
    places: NDArray[np.float64],
    is_level: NDArray[np.bool_],
    by_range: tuple[NDArray[np.float64], NDArray[np.float64], TiltPrior],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None:
    """Fit a plane to the phases of the plates that are not raised; None if they fit none that agrees with the ranges.

    Returns the plane [3], its covariance [3, 3] and the heights by phase [patch]. `by_range` are plane and covariance
    by range, and the prior of the tilt.
    """
    plane, covariance, prior = by_range
    # H: its reflection r_s has nearly the same phase for all plates.
    board_h = next(iter(builder.boards.values()))
    phase_heights, rad_per_m = _estimate_heights_by_phase(board_h, masks, places, (plane, prior), is_level)
    has_phase = np.isfinite(phase_heights)
    # A plane has three unknowns: only with four plates can their phases contradict it.
    if has_phase.sum() < 4:
        return None
    phase_stds = np.full(int(has_phase.sum()), _PHASE_STD_M)
    phase_plane, phase_covariance = _fit_plane(places[has_phase], phase_heights[has_phase], phase_stds, prior)
    residual = phase_heights[has_phase] - _evaluate_plane(phase_plane, places[has_phase])
    on_one_plane = float(np.sqrt(np.mean((residual * rad_per_m) ** 2))) < _PHASE_FITS_RAD
    # The reflection of thin sheets has another phase: the plane is accepted only if it agrees with the ranges.
    tolerance = 3 * np.sqrt(np.diag(covariance)) + [_MIN_STD_M, _TILT_TOLERANCE, _TILT_TOLERANCE]
    agrees_with_ranges = bool((np.abs(phase_plane - plane) < tolerance).all())
    if on_one_plane and agrees_with_ranges and float(np.hypot(*phase_plane[1:])) < _MAX_RISE_BY_PHASE:
        return phase_plane, phase_covariance, phase_heights
    return None


def _fit_most(
    places: NDArray[np.float64], heights: NDArray[np.float64], stds: NDArray[np.float64], tilt: TiltPrior
) -> NDArray[np.float64]:
    """Return the heights at the places [patch] of the plane on which most plates lie.

    Trial planes go through each plate, with tilts up to two standard deviations of the prior. The plane with the least
    cost is taken (MSAC; Torr and Zisserman, CVIU 78, 2000):

        cost = sum over plates of min(distance^2 / std^2, _LEVEL_STDS^2) + squared tilt in standard deviations
    """
    # Trial tilts along x and y, in standard deviations from the mean, [tilt, 2].
    steps = np.linspace(-2, 2, 33)
    trial_tilts = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    rises = (tilt.mean + trial_tilts * tilt.std) @ places.T
    # Height at the middle of the tilted plane through each plate, [tilt, plate].
    levels = heights - rises
    prior = np.sum(trial_tilts**2, axis=1)
    # [plate that the plane goes through, tilt]. One plate after the other, for memory: an image may have hundreds.
    cost = [
        prior + np.minimum(((levels - through[:, None]) / stds) ** 2, _LEVEL_STDS**2).sum(axis=1)
        for through in levels.T
    ]
    plate, best = np.unravel_index(np.argmin(cost), np.shape(cost))
    return rises[best] + levels[best, plate]


def _fit_plane(
    places: NDArray[np.float64], heights: NDArray[np.float64], stds: NDArray[np.float64], tilt: TiltPrior
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit a plane [3] (height at the middle, rise along x, along y); return it and its covariance [3, 3].

    `heights` and `stds` [patch] are in metres. The fit includes the priors of the height (`PRIOR_STD_M`) and of the
    `tilt`. The covariance is scaled up if the scatter around the plane is larger than `stds` explain.
    """
    rows = np.column_stack([np.ones(len(places)), places]) / stds[:, None]
    precision = np.array([PRIOR_STD_M**-2, *tilt.std**-2])
    information = rows.T @ rows + np.diag(precision)
    from_prior = precision * np.array([0.0, *tilt.mean])
    plane = np.asarray(np.linalg.solve(information, rows.T @ (heights / stds) + from_prior), np.float64)
    covariance = np.linalg.inv(information)
    residual = (heights - _evaluate_plane(plane, places)) / stds
    freedom = max(len(places) - 3, 1)
    return plane, np.asarray(covariance * max(1.0, float(np.sum(residual**2)) / freedom), np.float64)


def _evaluate_plane(plane: NDArray[np.float64], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the heights of a plane [3] at places [patch, 2], metres, [patch]."""
    return plane[0] + places @ plane[1:]
