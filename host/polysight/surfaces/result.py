"""Result of `polysight surface`: points with normals, curvature and permittivity, and what is known of each segment.

Files: `surface.npz` (docs/spec/products.md) and `surface.ply`, which MeshLab, CloudCompare and Open3D read.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.store import open_npz
from polysight.surfaces.measure import Seen, Shape, shape_of
from polysight.surfaces.optics import Optics
from polysight.surfaces.permittivity import (
    MODEL_ERROR,
    Gains,
    Uncertainty,
    Voltages,
    point_permittivity,
    point_ratio,
    segment_permittivity,
    voltages_of,
)
from polysight_shared.files import write_atomically

SURFACE = "surface.npz"
POINTS = "surface.ply"
# Below this radius the first-order correction of curved surfaces is not enough (tests/surfaces, 8..12 % at 30 mm).
MIN_RADIUS_M = 0.040
MIN_POINTS = 20
# Ratio r_s / r_p of metal is 1; a permittivity of 40 without loss has 1.5 at 55 degrees.
METAL_RATIO = 0.15
# A loss below zero by so many standard deviations is no property of one medium.
MAX_GAIN_SIGMA = 3.0

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Segment:
    """A connected surface. `permittivity` is None where it is not given, and `reason` says why; `covariance` [2][2] is
    that of (real, imaginary). `radius_mm`: the smallest radius of curvature, None for a plane. `name`: "metal" or "".
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


@dataclass(frozen=True)
class Surface:
    """Points of a scan [n, ...], metres in the rig frame, and their segments.

    `curvature` [n, 2, 2] in 1 / m in the basis of `tangents` [n, 3, 2]; `permittivity` complex (not a number where its
    segment has none) with `covariance` [n, 2, 2]; `position_std_m` [n]: along the normal; `normal_std_deg` [n].
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
    seen: Seen,
    optics: Optics,
    reference: Callable[[Optics], Gains] | None,
    *,
    uncertainty: Uncertainty,
    scan_id: str = "",
    simulated: bool = False,
) -> Surface:
    """Return shape and permittivity of the points seen; without a reference, the shape alone."""
    shape = shape_of(seen.h, optics)
    count = len(seen)
    permittivity = np.full(count, complex(np.nan, np.nan))
    covariance = np.full((count, 2, 2), np.nan)
    segments = []
    gains = None if reference is None else reference(optics)
    for number in np.unique(seen.segment):
        members = seen.segment == number
        described = _describe(int(number), shape[members])
        if reference is None or gains is None:
            segments.append(_refuse(described, "no metal reference: calibrate with a sphere, or give --reference"))
            continue
        voltages = voltages_of(seen[members], optics)
        judged, common = _judge(described, seen[members], voltages, optics, reference, gains, uncertainty)
        segments.append(judged)
        if common is not None:
            permittivity[members] = point_permittivity(voltages, gains, optics.wave_number)
            covariance[members] = _point_covariance(voltages, gains, optics.wave_number) + common
    return Surface(
        scan_id=scan_id,
        simulated=simulated,
        points_m=shape.points,
        normals=shape.normals,
        curvature=shape.curvature,
        incidence_deg=np.degrees(np.arccos(np.clip(shape.cos, 0, 1))),
        permittivity=permittivity,
        covariance=covariance,
        # The path changes by 2 cos(theta) along the normal, its slope by as much per radian.
        position_std_m=seen.h.path_std_m / (2 * shape.cos),
        normal_std_deg=np.degrees(np.linalg.norm(seen.h.slope_std, axis=1) / (2 * shape.cos)),
        segment=seen.segment,
        segments=tuple(segments),
    )


def _describe(number: int, shape: Shape) -> Segment:
    bends = np.linalg.eigvalsh((shape.curvature + np.swapaxes(shape.curvature, 1, 2)) / 2)
    bend = float(np.max(np.abs(np.median(bends, axis=0))))
    normal = shape.normals.mean(axis=0)
    normal /= np.linalg.norm(normal)
    return Segment(
        number=number,
        points=len(shape.points),
        centre_m=_triple(shape.points.mean(axis=0)),
        normal=_triple(normal),
        radius_mm=1e3 / bend if bend > 0.5 else None,
        incidence_deg=float(np.degrees(np.arccos(np.clip(shape.cos, 0, 1)).mean())),
    )


def _triple(vector: Array) -> tuple[float, float, float]:
    x, y, z = map(float, vector)
    return x, y, z


def _refuse(segment: Segment, reason: str, name: str = "") -> Segment:
    return replace(segment, reason=reason, name=name)


def _judge(
    segment: Segment,
    seen: Seen,
    voltages: Voltages,
    optics: Optics,
    reference: Callable[[Optics], Gains],
    gains: Gains,
    uncertainty: Uncertainty,
) -> tuple[Segment, Array | None]:
    """Give a segment its permittivity or the reason why it has none; and the covariance common to its points."""
    if segment.points < MIN_POINTS:
        return _refuse(segment, f"{segment.points} points only: too few to average over"), None
    ratio = np.median(point_ratio(voltages, gains).real) + 1j * np.median(point_ratio(voltages, gains).imag)
    if abs(ratio - 1) < METAL_RATIO:
        return _refuse(segment, "its ratio is that of metal", "metal"), None
    if segment.radius_mm is not None and segment.radius_mm < 1e3 * MIN_RADIUS_M:
        why = f"radius {segment.radius_mm:.0f} mm: below {1e3 * MIN_RADIUS_M:.0f} mm only the shape is reliable"
        return _refuse(segment, why), None
    found = segment_permittivity(seen, optics, reference, uncertainty)
    loss_std = float(np.sqrt(found.covariance[1, 1]))
    if found.eps.imag > MAX_GAIN_SIGMA * loss_std or found.eps.real < 1.25:
        why = "no single medium reflects so: a thin wall, a coating, or a second echo at the same place"
        return _refuse(segment, why), None
    (aa, ab), (_, bb) = found.covariance.tolist()
    source = max(found.sources, key=lambda name: found.sources[name])
    judged = replace(segment, permittivity=found.eps, covariance=((aa, ab), (ab, bb)), dominated_by=source)
    scatter = found.sources["scatter"]
    total = float(np.trace(found.covariance))
    return judged, found.covariance * max(0.0, 1 - scatter / total)


def _point_covariance(v: Voltages, gains: Gains, wave_number: float) -> Array:
    """Covariance of (real, imaginary) of each point's permittivity by its own noise, [n, 2, 2]."""
    relative = np.sqrt(np.sum((v.std / np.maximum(np.abs(v.b), 1e-30)) ** 2, axis=1) + 2 * MODEL_ERROR**2)
    step = 1e-3
    changed = Voltages(v.b * np.array([1 + step, 1.0]), v.std, v.m, v.theta, v.bend_inside, v.bend_across, v.arrival)
    rate = (point_permittivity(changed, gains, wave_number) - point_permittivity(v, gains, wave_number)) / step
    # The permittivity is an analytic function of the ratio: the same error in both parts.
    variance = np.abs(rate) ** 2 * relative**2
    return variance[:, None, None] * np.eye(2)


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
    with open_npz(path) as f:
        arrays: dict[str, Any] = dict(f)
    segments = []
    for row in json.loads(str(arrays.pop("segments"))):
        eps = row["permittivity"]
        covariance = row["covariance"]
        row["permittivity"] = None if eps is None else complex(*eps)
        row["covariance"] = None if covariance is None else tuple(map(tuple, covariance))
        row["centre_m"], row["normal"] = tuple(row["centre_m"]), tuple(row["normal"])
        segments.append(Segment(**row))
    scan_id, simulated = str(arrays.pop("scan_id")), bool(arrays.pop("simulated"))
    return Surface(scan_id=scan_id, simulated=simulated, segments=tuple(segments), **arrays)


def point_cloud(surface: Surface) -> bytes:
    """Points as binary PLY, in millimetres, with normals and permittivity as properties of each vertex."""
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
    """Text for people: a line for each segment."""
    head = f"{'simulated ' if surface.simulated else ''}scan {surface.scan_id}: {len(surface.segment)} points"
    lines = [f"{head} on {len(surface.segments)} surfaces"]
    for s in surface.segments:
        x, y, z = (1e3 * value for value in s.centre_m)
        tilt_x, tilt_y = (float(np.degrees(np.arctan2(n, -s.normal[2]))) for n in s.normal[:2])
        form = "flat" if s.radius_mm is None else f"radius {s.radius_mm:.0f} mm"
        line = f"  {s.number}: {s.points} points at ({x:+.0f}, {y:+.0f}, {z:.0f}) mm, {form}"
        line += f", tilt {tilt_x:+.1f}, {tilt_y:+.1f} degrees, incidence {s.incidence_deg:.1f}"
        if s.permittivity is not None and s.covariance is not None:
            std = [float(np.sqrt(s.covariance[i][i])) for i in range(2)]
            line += f": {s.permittivity.real:.2f} +- {std[0]:.2f} - j ({-s.permittivity.imag:.2f} +- {std[1]:.2f})"
            line += f", mostly by {s.dominated_by}"
        else:
            line += f": {s.name + ', ' if s.name else ''}no permittivity, {s.reason}"
        lines.append(line)
    return lines
