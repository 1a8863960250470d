"""Result of `polysight surface`: points with normals, curvature and permittivity, and a description of each segment.

A *segment* is a connected surface; `analyse_surface` describes the segments of a scan. Segments that are no surface of
a single medium get no permittivity but a `reason`: metal, edges, walls, coatings, echoes from inside a body. The points
of walls and of such echoes get larger standard errors (`doubt_places`).

Files: `surface.npz` (docs/spec/products.md) and `surface.ply`, which MeshLab, CloudCompare and Open3D read.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.store import open_npz
from polysight.surfaces.gains import Gains, Voltages, find_voltages
from polysight.surfaces.measure import MIN_POINTS as LEAST_POINTS, SAME_WINDOW_M, SeenEchoes, Shape, find_shape
from polysight.surfaces.optics import Optics
from polysight.surfaces.permittivity import (
    FRESNEL_ZONE_M,
    RIPPLE_OF_PLATES_M,
    DisturbedScan,
    PermittivityFit,
    Reference,
    Uncertainty,
    add_common_errors,
    disturb_optics,
    disturb_scan,
    find_interior,
    find_reflecting,
    find_reflection,
    find_shares,
    fit_permittivity,
    judge_medium,
    point_covariance,
    point_permittivity,
    point_ratio,
)
from polysight.surfaces.points import compute_tangents
from polysight.surfaces.window import Echoes
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.files import write_atomically

# Fields of a surface that are not arrays of points.
NOT_POINTS = ("scan_id", "simulated", "segments")
SURFACE = "surface.npz"
POINTS = "surface.ply"
# Below this radius the first-order correction of curved surfaces is not enough: errors of 8 to 12 % at 30 mm
# (tests/surfaces).
MIN_RADIUS_M = 0.040
# A surface with a smaller curvature, 1 / m, counts as flat: a radius of 2 m.
FLAT_CURVATURE = 0.5
# Least number of points away from the edges to which a permittivity is fitted; chosen. (`LEAST_POINTS` is the least
# number of points of a segment.)
MIN_POINTS = 20
# A segment whose ratio r_s / r_p is nearer to 1 is metal. Metal has 1; a permittivity of 40 without loss has 1.5 at 55
# degrees.
METAL_RATIO = 0.15
# No single medium has a loss below zero by more than `MAX_GAIN_SIGMA` standard deviations, or a real part outside
# `LEAST_REAL` and `MOST_REAL`. The fit is limited to 1.2 and 40: a result near these is a fit that left the range.
MAX_GAIN_SIGMA = 3.0
LEAST_REAL = 1.25
MOST_REAL = 39.0
# Largest deviations from a single medium, both logarithms: of the level of H from that of the fitted medium, and of the
# levels over the band (`judge_medium`). 46 drawn solids have at most 0.020 and 0.0034. Walls for which a medium that is
# not theirs was fitted have more than 0.05, or more than 0.01 (tests/surfaces/test_rejected_surfaces.py).
MAX_LEVEL_MISS = 0.05
MAX_BAND_RISE = 0.01
NO_SINGLE_MEDIUM = (
    "no single medium reflects in this way: a thin wall, a coating, an edge, or a second echo at the same place"
)
# A segment counts as an echo from inside a body if at least this share of its points lies more than MIN_DEPTH_M behind
# another surface. At a smaller distance a window does not resolve both.
MIN_SHARE_BEHIND = 0.8
MIN_DEPTH_M = 0.03
BEHIND_ANOTHER_REASON = "it lies behind another surface: an echo from inside a body, whose place and form are different"
# Standard error of slopes near the border of the zone that a surface reflects to, by diffraction at its edge: up to
# 0.01, in the root mean square 0.0065 (half a plane, tests/surfaces/test_slope_errors.py).
EDGE_SLOPE_STD = 0.0065
# Both faces of a wall make one echo, whose path is that of neither. Its error grows with the rise of its level over the
# band, and where the faces cancel, so that the reflection R (1: metal) is small. `estimate_wall_std`, in mm:
#     std = min(20, min(11, 2.5 + 35 |rise|) max(1, 0.45 / R)^3)
# A window just resolves two faces with the error 11 mm. With these numbers 95 % of 4000 drawn walls are measured within
# 1.96 standard deviations (0.5 to 25 mm, evenly on a logarithmic scale, permittivity 2 to 9, loss 0.001 to 1, 53
# degrees).
WALL_STD_M = 0.0025
WALL_STD_OF_RISE_M = 0.035
MOST_WALL_STD_M = 0.011
WALL_REFLECTION = 0.45
WALL_EXPONENT = 3.0
MOST_CANCELLED_STD_M = 0.02
# Relative error of the curvature of a segment that no single medium explains: the error of the path of both faces' echo
# differs from window to window. Chosen: of twelve surfaces of walls (1 to 20 mm, another author's exact series) nine
# had at most 0.21, one 0.44; two were wrong by a factor of three, and their normals disagreed as far.
WALL_CURVATURE_ERROR = 0.25

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Segment:
    """A connected surface.

    Attributes
    ----------
    number, points
        Its number in the scan, and how many points it has.
    centre_m, normal
        Means over its points, x, y, z in the rig frame; the normal points towards the antennas.
    radius_mm, radius_std_mm
        The smallest radius R of curvature, and its standard error, R^2 times that of 1 / R; None for a plane.
    incidence_deg
        Mean incidence angle.
    permittivity, covariance
        eps' - j eps'', and the covariance [2][2] of (real, imaginary); both None if the segment has no permittivity.
    reason
        Why the segment has no permittivity; "" if it has one.
    dominated_by
        Source of the largest part of the covariance; "" without one.
    name, confidence
        Material, "" without one, and its probability.
    turned_deg
        Angle of the turntable during the scan.
    """

    number: int
    points: int
    centre_m: tuple[float, float, float]
    normal: tuple[float, float, float]
    radius_mm: float | None
    incidence_deg: float
    permittivity: complex | None = None
    covariance: tuple[tuple[float, float], tuple[float, float]] | None = None
    dominated_by: str = ""
    name: str = ""
    reason: str = ""
    confidence: float | None = None
    turned_deg: float = 0.0
    radius_std_mm: float | None = None


@dataclass(frozen=True)
class Surface:
    """Points of a scan [n, ...], metres in the rig frame, and their segments.

    Attributes
    ----------
    scan_id, simulated
        Name of the scan, and whether it is simulated.
    points_m, normals
        float64 [n, 3]: points, and unit vectors towards the antennas.
    curvature
        float64 [n, 2, 2] in 1 / m in the basis of `compute_tangents` [n, 3, 2]; positive for convex bodies.
    incidence_deg
        float64 [n], of H.
    permittivity, covariance
        complex [n] (not a number where its segment has none), and float64 [n, 2, 2] of (real, imaginary).
    position_std_m, normal_std_deg
        float64 [n]: standard deviations along the normal, and of the normal.
    segment, segments
        Number of each point's segment, [n], and the segments.
    """

    scan_id: str
    simulated: bool
    points_m: Array
    normals: Array
    curvature: Array
    incidence_deg: Array
    permittivity: NDArray[np.complex128]
    covariance: Array
    position_std_m: Array
    normal_std_deg: Array
    segment: NDArray[np.int_]
    segments: tuple[Segment, ...]


def analyse_surface(
    echoes: SeenEchoes,
    optics: Optics,
    reference: Reference | None,
    *,
    uncertainty: Uncertainty,
    scan_id: str = "",
    simulated: bool = False,
) -> Surface:
    """Return shape and permittivity of the points seen; without a reference, the shape alone.

    `echoes` are those of H and V. `reference` returns the gains for a rig; it is also called for rigs that differ from
    `optics` by the errors in `uncertainty`.
    """
    gains = None if reference is None else reference(optics)
    echoes, share = drop_edges(echoes, optics, gains)
    interior = share > 0
    shape = find_shape(echoes.h, optics)
    numbers = np.unique(echoes.segment)
    segments = [describe_segment(int(number), shape[echoes.segment == number]) for number in numbers]
    permittivity = np.full(len(echoes), complex(np.nan, np.nan))
    covariance = np.full((len(echoes), 2, 2), np.nan)
    voltages = find_voltages(echoes, optics, shape)
    if reference is None or gains is None:
        reason = "no metal reference: calibrate with a sphere, or give --reference"
        segments = [replace(segment, reason=reason) for segment in segments]
    else:
        disturbed = disturb_scan(echoes, optics, reference, uncertainty)
        for index, segment in enumerate(segments):
            members = (echoes.segment == segment.number) & interior
            segment_voltages = voltages[members]
            disturbed_segment = [replace(scan, voltages=scan.voltages[members]) for scan in disturbed]
            segments[index], fit = judge_segment(
                segment, segment_voltages, gains, disturbed_segment, optics.wave_number, share=share[members]
            )
            if fit is None:
                continue
            sources = add_common_errors(fit, segment_voltages, gains, disturbed_segment, optics.wave_number)
            segments[index] = add_permittivity(segments[index], fit.eps, sources)
            if segments[index].permittivity is None:
                continue
            # A point has the errors that all points share, and its own scatter instead of the segment's.
            common = sum((c for name, c in sources.items() if name != "scatter"), np.zeros((2, 2)))
            permittivity[members] = point_permittivity(segment_voltages, gains, optics.wave_number)
            covariance[members] = point_covariance(segment_voltages, gains, fit, optics.wave_number) + common
    edge_std = np.where(interior, 0.0, EDGE_SLOPE_STD)[:, None]
    h_echoes = replace(echoes.h, slope_std=np.hypot(echoes.h.slope_std, edge_std))
    position_std_m, normal_std_rad = find_shape_errors(h_echoes, shape, optics, uncertainty)
    if gains is not None:
        segments, unknown_m = doubt_places(segments, echoes, shape, voltages, gains)
        position_std_m = np.hypot(position_std_m, unknown_m)
    return Surface(
        scan_id=scan_id,
        simulated=simulated,
        points_m=shape.points,
        normals=shape.normals,
        curvature=shape.curvature,
        incidence_deg=np.degrees(np.arccos(np.clip(shape.cos, 0, 1))),
        permittivity=permittivity,
        covariance=covariance,
        position_std_m=position_std_m,
        normal_std_deg=np.degrees(normal_std_rad),
        segment=echoes.segment,
        segments=tuple(segments),
    )


def join_turned(surfaces: Sequence[Surface], angles_deg: Sequence[float], axis_m: tuple[float, float]) -> Surface:
    """Join scans of an object on a turntable into one surface, turned to where the object was at the angle zero.

    The table turns about a vertical axis through `axis_m`, its x and z in the rig frame; a positive angle turns +z
    towards +x. Segments of different scans are not joined: those of each scan get numbers after those of the scan
    before.
    """
    x, z = axis_m
    axis = np.array([x, 0.0, z])
    parts: list[dict[str, NDArray]] = []
    segments: list[Segment] = []
    for surface, angle_deg in zip(surfaces, angles_deg, strict=True):
        cos = np.cos(np.radians(angle_deg))
        sin = np.sin(np.radians(angle_deg))
        # Rotation that turns the object back to the angle zero.
        back = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
        normals = surface.normals @ back.T
        # Curvatures are given along tangents, which follow from the normal. [n, 2 new tangents, 2 turned tangents].
        change = np.swapaxes(compute_tangents(normals), 1, 2) @ (back @ compute_tangents(surface.normals))
        # After the highest number, which may be above the count of segments: edges that were dropped leave gaps.
        first = max((segment.number for segment in segments), default=-1) + 1
        point_fields = {f.name: getattr(surface, f.name) for f in fields(surface) if f.name not in NOT_POINTS}
        point_fields["points_m"] = (surface.points_m - axis) @ back.T + axis
        point_fields["normals"] = normals
        point_fields["curvature"] = change @ surface.curvature @ np.swapaxes(change, 1, 2)
        point_fields["segment"] = surface.segment + first
        parts.append(point_fields)
        for segment in surface.segments:
            moved_segment = replace(
                segment,
                number=segment.number + first,
                centre_m=_convert_triple(back @ (np.array(segment.centre_m) - axis) + axis),
                normal=_convert_triple(back @ np.array(segment.normal)),
                turned_deg=float(angle_deg),
            )
            segments.append(moved_segment)
    joined = {name: np.concatenate([point_fields[name] for point_fields in parts]) for name in parts[0]}
    return Surface(
        scan_id="+".join(surface.scan_id for surface in surfaces),
        simulated=any(surface.simulated for surface in surfaces),
        segments=tuple(segments),
        **joined,
    )


def drop_edges(seen: SeenEchoes, optics: Optics, gains: Gains | None) -> tuple[SeenEchoes, Array]:
    """Return the points at which surfaces reflect, and factors of their weights in a permittivity, [n]: 0 near edges.

    Flat surfaces lose their points near edges. Segments with too few other points are dropped as edges, unless all
    segments have too few: then the object is small.
    """
    if not len(seen):
        return seen, np.zeros(0)
    voltages = find_voltages(seen, optics)
    reflecting = seen[find_reflecting(voltages, np.abs(seen.h.amplitude), seen.segment, gains)]
    at_m = seen.h.at_m[:, :2]
    extent_m = (at_m.min(axis=0), at_m.max(axis=0))
    at_m = reflecting.h.at_m[:, :2]
    interior = find_interior(at_m, reflecting.segment, extent_m)
    share = np.zeros(len(reflecting))
    share[interior] = find_shares(at_m[interior], reflecting.segment[interior], extent_m)
    counts = np.bincount(reflecting.segment, minlength=1)
    interior_counts = np.bincount(reflecting.segment[interior], minlength=counts.size)
    if interior_counts.max() < LEAST_POINTS:
        enough = counts[reflecting.segment] >= LEAST_POINTS
        return reflecting[enough], share[enough]
    shape = find_shape(reflecting.h, optics)
    is_surface = interior_counts[reflecting.segment] >= LEAST_POINTS
    for number in np.unique(reflecting.segment[is_surface]):
        members = reflecting.segment == number
        if describe_segment(int(number), shape[members]).radius_mm is None:
            # A flat surface keeps only its interior.
            is_surface &= interior | ~members
    return reflecting[is_surface], share[is_surface]


def find_shape_errors(echoes: Echoes, shape: Shape, optics: Optics, uncertainty: Uncertainty) -> tuple[Array, Array]:
    """Return standard deviations [n] of points along the normal (m) and of normals (rad, both directions together).

    An error that moves a point along a curved surface also turns its normal, by the curvature times the distance. The
    error of a normal is its turn without this part.
    """
    tangent = compute_tangents(shape.normals)

    def find_changes(moved: Shape) -> tuple[Array, Array]:
        """Return how far points moved along the normal, m [n], and how normals turned from the surface, rad [n, 2]."""
        shift_m = moved.points - shape.points
        turn = np.einsum("nij,ni->nj", tangent, moved.normals - shape.normals)
        slide = np.einsum("nij,ni->nj", tangent, shift_m)
        turn_of_surface = np.einsum("njk,nk->nj", shape.curvature, slide)
        return np.einsum("ni,ni->n", shift_m, shape.normals), turn - turn_of_surface

    # In each of these rigs one coordinate of one antenna is wrong by its standard error.
    rigs = [rig for source, rig in disturb_optics(optics, uncertainty) if source == "places"]
    changes = [find_changes(find_shape(echoes, rig)) for rig in rigs]
    # Error of the path by noise.
    changes.append(find_changes(find_shape(replace(echoes, path_m=echoes.path_m + echoes.path_std_m), optics)))
    # Errors of the slopes along x and y.
    for axis in np.eye(2):
        slope = echoes.slope + echoes.slope_std * axis
        changes.append(find_changes(find_shape(replace(echoes, slope=slope), optics)))
    position2 = np.sum([along**2 for along, _ in changes], axis=0)
    turn2 = np.sum([np.sum(turn**2, axis=1) for _, turn in changes], axis=0)
    return np.sqrt(position2), np.sqrt(turn2)


def estimate_wall_std(reflection: float, rise: float) -> float:
    """Return the standard error of the points of a wall, metres.

    `reflection` is its level over that of metal; `rise` the logarithm of its level in the upper half of the band over
    that in the lower.
    """
    steady = min(MOST_WALL_STD_M, WALL_STD_M + WALL_STD_OF_RISE_M * abs(rise))
    # 0.05 avoids a division by zero. With it the result is at its limit.
    cancellation = max(1.0, WALL_REFLECTION / max(reflection, 0.05))
    return min(MOST_CANCELLED_STD_M, steady * cancellation**WALL_EXPONENT)


def doubt_places(
    segments: Sequence[Segment], echoes: SeenEchoes, shape: Shape, voltages: Voltages, gains: Gains
) -> tuple[list[Segment], Array]:
    """Return the segments, and further standard errors of the points of those that no single medium explains, [n].

    The errors are in metres, 0 for segments of one medium. A segment behind another surface gets this as its reason,
    and the error of its depth. Any other one is taken as a wall, as it is not distinguished from other causes, and gets
    the error of a wall's points. The radius gets an error, too.
    """
    reflection = find_reflection(voltages, gains)
    rise = voltages.band_rise[:, 0] - gains.band_rise[0]
    judged = list(segments)
    unknown_m = np.zeros(len(echoes))
    for index, segment in enumerate(segments):
        # Segments with a small radius are tested, too: an echo from inside a body looks like that of a small ball.
        is_small = segment.radius_mm is not None and segment.radius_mm < 1e3 * MIN_RADIUS_M
        if segment.name or not (segment.reason == NO_SINGLE_MEDIUM or is_small):
            continue
        members = echoes.segment == segment.number
        depth_m = find_depth_behind(echoes, shape, segment.number)
        if depth_m is None and segment.reason != NO_SINGLE_MEDIUM:
            continue
        if depth_m is None:
            unknown_m[members] = estimate_wall_std(
                float(np.median(reflection[members])), float(np.median(rise[members]))
            )
            judged[index] = add_curvature_error(segment, WALL_CURVATURE_ERROR)
        else:
            judged[index] = add_curvature_error(replace(segment, reason=BEHIND_ANOTHER_REASON), 1.0)
            # Standard deviation of a uniform distribution between this segment and the surface in front of it.
            unknown_m[members] = depth_m / np.sqrt(3)
    return judged, unknown_m


def find_depth_behind(echoes: SeenEchoes, shape: Shape, number: int) -> float | None:
    """Return how far a segment's points lie behind another surface that the same windows see, metres, or None.

    An echo from inside a body is seen by the windows that see the body's front. Its point lies behind that front, but
    not at its true place: rays are refracted where they enter, and are slower inside.
    """
    window = np.unique(np.round(echoes.h.at_m / SAME_WINDOW_M), axis=0, return_inverse=True)[1].reshape(-1)
    members = np.flatnonzero(echoes.segment == number)
    # The nearest point of another segment in each window; `front` is that of the window of each member.
    other_points = np.flatnonzero(echoes.segment != number)
    other_points = other_points[np.argsort(echoes.h.path_m[other_points], kind="stable")]
    windows, first = np.unique(window[other_points], return_index=True)
    if not windows.size:
        return None
    window_index = np.minimum(np.searchsorted(windows, window[members]), windows.size - 1)
    front = other_points[first[window_index]]
    is_shared = windows[window_index] == window[members]
    distance_from_front = shape.points[members] - shape.points[front]
    depth_m = -np.einsum("ni,ni->n", distance_from_front, shape.normals[front])
    lateral_m = np.sqrt(np.maximum(0, np.sum(distance_from_front**2, axis=1) - depth_m**2))
    is_behind = is_shared & (depth_m > MIN_DEPTH_M) & (lateral_m < depth_m)
    if is_behind.mean() < MIN_SHARE_BEHIND:
        return None
    return float(np.median(depth_m[is_behind]))


def describe_segment(number: int, shape: Shape) -> Segment:
    """Return a segment with its place, normal, radius and incidence angle by the shape of its points."""
    # The median over the points of each matrix element: noise drives the two principal curvatures of a point apart.
    usual_curvature = np.median(shape.curvature, axis=0)
    principal_curvatures, axes = np.linalg.eigh((usual_curvature + usual_curvature.T) / 2)
    largest = int(np.abs(principal_curvatures).argmax())
    signed_curvature = float(principal_curvatures[largest])
    curvature = abs(signed_curvature)
    normal = shape.normals.mean(axis=0)
    normal /= np.linalg.norm(normal)
    radius_mm = None
    radius_std_mm = None
    if curvature > FLAT_CURVATURE:
        radius_mm = 1e3 / curvature
        radius_std_mm = radius_mm * estimate_curvature_std(shape, axes[:, largest], signed_curvature) / curvature
    return Segment(
        number=number,
        points=len(shape.points),
        centre_m=_convert_triple(shape.points.mean(axis=0)),
        normal=_convert_triple(normal),
        radius_mm=radius_mm,
        radius_std_mm=radius_std_mm,
        incidence_deg=float(np.degrees(np.arccos(np.clip(shape.cos, 0, 1)).mean())),
    )


def estimate_curvature_std(shape: Shape, axis: Array, curvature: float) -> float:
    """Return the standard error of a segment's `curvature`, 1 / m, along an `axis` [2] of its tangents.

    `curvature` follows from the second derivatives of the paths. The turn of the normals from point to point gives a
    second value. Both agree for a surface of one medium; a wall or a second echo disturbs them differently. Their
    difference and the scatter of the points' curvatures are added as squares. The scatter is not divided by the number
    of points, because errors extend over many points.
    """
    curvature_of_points = np.einsum("i,nij,j->n", axis, shape.curvature, axis)
    low, high = np.percentile(curvature_of_points, [16, 84])
    tangent = np.median(compute_tangents(shape.normals), axis=0)
    offset = (shape.points - shape.points.mean(axis=0)) @ tangent
    turned_normal = (shape.normals - shape.normals.mean(axis=0)) @ tangent @ axis
    axis_across = np.array([-axis[1], axis[0]])
    # Rotation of the normals per metre along the axis, and across it.
    rates = np.linalg.lstsq(np.stack([offset @ axis, offset @ axis_across], axis=1), turned_normal, rcond=None)[0]
    return float(np.hypot((high - low) / 2, rates[0] - curvature))


def add_curvature_error(segment: Segment, share: float) -> Segment:
    """Return a segment whose curvature has a further relative error of `share`."""
    if segment.radius_mm is None or segment.radius_std_mm is None:
        return segment
    return replace(segment, radius_std_mm=float(np.hypot(segment.radius_std_mm, share * segment.radius_mm)))


def _convert_triple(vector: Array) -> tuple[float, float, float]:
    """Return a vector [3] as plain numbers."""
    x, y, z = map(float, vector)
    return x, y, z


def judge_segment(
    segment: Segment,
    voltages: Voltages,
    gains: Gains,
    disturbed: Sequence[DisturbedScan],
    wave_number: float,
    *,
    share: Array | float = 1.0,
) -> tuple[Segment, PermittivityFit | None]:
    """Fit a segment's permittivity; return the segment and the fit, or the segment with a reason, and None.

    `disturbed` holds the same points as `voltages`; `share` [n] is a factor of their weights.
    """
    if len(voltages) < MIN_POINTS:
        cause = f"{len(voltages)} points away from its edges: too few to average over"
        return replace(segment, reason=cause), None
    ratios = point_ratio(voltages, gains)
    ratio = complex(np.median(ratios.real), np.median(ratios.imag))
    if abs(ratio - 1) < METAL_RATIO:
        return replace(segment, reason="its ratio is that of metal", name="metal"), None
    # Length over which the errors by edges and by other echoes are similar.
    ripple_m = RIPPLE_OF_PLATES_M if segment.radius_mm is None else FRESNEL_ZONE_M
    fit = fit_permittivity(voltages, gains, wave_number, share, ripple_m)
    level, rise = judge_medium(fit, voltages, gains, disturbed, wave_number)
    if level > MAX_LEVEL_MISS or rise > MAX_BAND_RISE:
        return replace(segment, reason=NO_SINGLE_MEDIUM), None
    # The radius is tested last: a small body may be a thin wall, too, whose points have larger errors.
    if segment.radius_mm is not None and segment.radius_mm < 1e3 * MIN_RADIUS_M:
        cause = f"radius {segment.radius_mm:.0f} mm: below {1e3 * MIN_RADIUS_M:.0f} mm only the shape is reliable"
        return replace(segment, reason=cause), None
    return segment, fit


def add_permittivity(segment: Segment, eps: complex, sources: dict[str, Array]) -> Segment:
    """Add a permittivity with its covariances [2, 2] by source, unless no passive medium has it."""
    (real2, mixed), (_, imag2) = sum(sources.values(), np.zeros((2, 2))).tolist()
    if eps.imag > MAX_GAIN_SIGMA * imag2**0.5 or not LEAST_REAL <= eps.real <= MOST_REAL:
        return replace(segment, reason=NO_SINGLE_MEDIUM)
    dominant = max(sources, key=lambda name: float(np.trace(sources[name])))
    return replace(segment, permittivity=eps, covariance=((real2, mixed), (mixed, imag2)), dominated_by=dominant)


def plain_segment(segment: Segment) -> dict[str, Any]:
    """Return a segment for JSON; complex numbers as [real, imaginary]."""
    row = {f.name: getattr(segment, f.name) for f in fields(segment)}
    eps = segment.permittivity
    row["permittivity"] = None if eps is None else [eps.real, eps.imag]
    return row


def write_surface(out: Path, surface: Surface) -> None:
    """Write `surface.npz` and `surface.ply` into a folder."""
    out.mkdir(parents=True, exist_ok=True)
    arrays = {f.name: getattr(surface, f.name) for f in fields(surface)}
    arrays["segments"] = json.dumps([plain_segment(s) for s in surface.segments])
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    write_atomically(out / SURFACE, buffer.getvalue())
    write_atomically(out / POINTS, point_cloud(surface))


def read_surface(path: Path) -> Surface:
    """Read `surface.npz`. Raises DataError if it cannot be read."""
    try:
        with open_npz(path) as f:
            arrays: dict[str, Any] = dict(f)
        segments = tuple(map(_read_segment, json.loads(str(arrays.pop("segments")))))
        scan_id = str(arrays.pop("scan_id"))
        simulated = bool(arrays.pop("simulated"))
        return Surface(scan_id=scan_id, simulated=simulated, segments=segments, **arrays)
    except (OSError, ValueError, KeyError, EOFError, TypeError, AttributeError, zipfile.BadZipFile) as e:
        raise DataError(
            f"{path}: the surface cannot be read: {type(e).__name__}: {e}",
            "it is damaged, or of another version", "make it again: polysight surface", code=ErrorCode.FILE_UNREADABLE,
        ) from None  # fmt: skip


def _read_segment(row: dict[str, Any]) -> Segment:
    """Return the segment of a row that :func:`plain_segment` made. Raises KeyError or TypeError for another row."""
    eps = row["permittivity"]
    covariance = row["covariance"]
    row["permittivity"] = None if eps is None else complex(*eps)
    row["covariance"] = None if covariance is None else tuple(map(tuple, covariance))
    row["centre_m"] = tuple(row["centre_m"])
    row["normal"] = tuple(row["normal"])
    return Segment(**row)


def point_cloud(surface: Surface) -> bytes:
    """Return the points as a binary PLY file, in millimetres, with normals and permittivity of each vertex."""
    names = ("x", "y", "z", "nx", "ny", "nz", "permittivity", "loss", "permittivity_std", "incidence_deg")
    eps = surface.permittivity
    columns = [*(1e3 * surface.points_m.T), *surface.normals.T, eps.real, -eps.imag]
    columns += [np.sqrt(surface.covariance[:, 0, 0]), surface.incidence_deg]
    vertices = np.zeros(len(eps), [*((name, "<f4") for name in names), ("segment", "<i4")])
    for name, column in zip(names, columns, strict=True):
        vertices[name] = column
    vertices["segment"] = surface.segment
    simulated = "simulated " if surface.simulated else ""
    head = ["ply", "format binary_little_endian 1.0", f"comment {simulated}scan {surface.scan_id}, millimetres"]
    head += [f"element vertex {len(eps)}", *(f"property float {name}" for name in names), "property int segment"]
    return ("\n".join([*head, "end_header"]) + "\n").encode() + vertices.tobytes()


def summary_lines(surface: Surface) -> list[str]:
    """Return lines that describe the surface in a terminal: a headline, and one for each segment."""
    kind = "simulated " if surface.simulated else ""
    count = len(surface.segments)
    counts = f"{len(surface.segment)} points on {count} surface{'s' * (count != 1)}"
    lines = [f"{kind}scan {surface.scan_id}: {counts}; places are in the rig's frame, not from the image's centre"]
    for segment in surface.segments:
        x_mm, y_mm, z_mm = 1e3 * np.array(segment.centre_m)
        tilts_deg = [np.degrees(np.arctan2(part, -segment.normal[2])) for part in segment.normal[:2]]
        turned_text = f", turned by {segment.turned_deg:g} degrees" if segment.turned_deg else ""
        lines.append(
            f"  {segment.number}: {segment.points} points at ({x_mm:+z.0f}, {y_mm:+z.0f}, {z_mm:.0f}) mm{turned_text}, "
            f"{describe_form(segment)}, tilt {tilts_deg[0]:+z.1f}, {tilts_deg[1]:+z.1f} degrees, "
            f"incidence {segment.incidence_deg:.1f}: {describe_material(segment)}"
        )
    return lines


def describe_form(segment: Segment) -> str:
    """Return "flat", or the radius of a segment with its standard error."""
    if segment.radius_mm is None:
        return "flat"
    if segment.radius_std_mm is None:
        return f"radius {segment.radius_mm:.0f} mm"
    return f"radius {segment.radius_mm:.0f} +- {max(1.0, segment.radius_std_mm):.0f} mm"


def describe_material(segment: Segment) -> str:
    """Return permittivity, standard errors and name of a segment as text, or why it has none."""
    if segment.permittivity is None or segment.covariance is None:
        name = f"{segment.name}, " if segment.name else ""
        return f"{name}no permittivity, {segment.reason}"
    eps = segment.permittivity
    real_std = segment.covariance[0][0] ** 0.5
    loss_std = segment.covariance[1][1] ** 0.5
    text = f"{eps.real:.2f} +- {real_std:.2f} - j ({-eps.imag:z.2f} +- {loss_std:.2f})"
    text += f", mostly by {segment.dominated_by}"
    if segment.name and segment.confidence is not None:
        text += f"; {segment.name} ({100 * segment.confidence:.0f} %)"
    return text
