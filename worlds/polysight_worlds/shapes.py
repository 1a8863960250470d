"""Shapes: smooth surfaces with a place, a turn and a medium, their geometry at a point, and specular points on them.

A shape is a surface p(a, b) over two parameters, with first and second derivatives. `Graph` is a height over a plane
(plates, bent sheets, saddles), `Revolved` a radius along an axis (cylinders, cones, bottles), `Sphere` a sphere. Local
axes: z points away from the antennas, and so does the inside of a body.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from polysight_worlds.media import Stack
from polysight_worlds.rig import turn

# Edges of curved pieces fade over this width, so that what they diffract is small and varies slowly. Chosen: wider
# edges leave less of the piece.
SOFT_EDGE_M = 0.025
# Iterations of Newton's method; from the grid's start, four to six are needed; chosen.
ITERATIONS = 25
# Newton's steps are limited to this length: a saddle's path is not convex far from its stationary point; chosen.
LONGEST_STEP_M = 0.03


@dataclass(frozen=True)
class Patch:
    """Points of a surface and derivatives by its parameters a and b, each [3, ...]."""

    point: NDArray
    d_a: NDArray
    d_b: NDArray
    d_aa: NDArray
    d_ab: NDArray
    d_bb: NDArray

    @property
    def normal(self) -> NDArray:
        """Unit normal towards the antennas or out of the body, [3, ...]."""
        across = np.cross(self.d_b, self.d_a, axis=0)
        return across / np.linalg.norm(across, axis=0)

    @property
    def area(self) -> NDArray:
        """Area per unit of a times b, [...]."""
        return np.linalg.norm(np.cross(self.d_b, self.d_a, axis=0), axis=0)

    def tangents(self) -> NDArray:
        """Orthonormal tangents as combinations of d_a and d_b: [2, 2, ...], row i the parameters' rates along i."""
        # First fundamental form. The first tangent is d_a of unit length, the second is d_b without its part along it.
        aa = _dots(self.d_a, self.d_a)
        ab = _dots(self.d_a, self.d_b)
        bb = _dots(self.d_b, self.d_b)
        first = 1 / np.sqrt(aa)
        rest = np.sqrt(bb - ab**2 / aa)
        zero = np.zeros_like(first)
        return np.stack([np.stack([first, zero]), np.stack([-ab / aa / rest, 1 / rest])])

    def curvature(self) -> NDArray:
        """Curvature in the basis of `tangents`, [2, 2, ...], 1 / m; positive where the surface bends away (convex)."""
        normal = self.normal
        aa = -_dots(normal, self.d_aa)
        ab = -_dots(normal, self.d_ab)
        bb = -_dots(normal, self.d_bb)
        second_form = np.array([[aa, ab], [ab, bb]])
        basis = self.tangents()
        return np.einsum("ij...,jk...,lk...->il...", basis, second_form, basis)


def _dots(a: NDArray, b: NDArray) -> NDArray:
    return np.einsum("i...,i...->...", a, b)


@dataclass(frozen=True)
class Shape:
    """A piece of a surface with a medium (`stack`), a base of the shapes below.

    `place_m`: origin of the local axes in the rig frame; `axes`: columns are local x, y, z in the rig frame. `size_m`:
    full extents of the two parameters, as metres on the surface (`scale_m`), about the origin.
    """

    name: str
    stack: Stack
    place_m: tuple[float, float, float]
    size_m: tuple[float, float]
    axes: NDArray = field(default_factory=lambda: np.eye(3), repr=False)

    # True for a plane with sharp edges, which `shape_echoes` sums facet by facet.
    is_flat_plate = False
    # False for a plane with any edges.
    is_bent = True

    def rotate(self, axis: NDArray, angle_deg: float) -> Shape:
        """Return the shape turned about its origin, around a unit `axis` [3] of the rig frame."""
        return replace(self, axes=turn(np.asarray(axis, float), angle_deg) @ self.axes)

    def local(self, a: NDArray, b: NDArray) -> Patch:
        """Return the surface in local axes."""
        raise NotImplementedError

    def scale_m(self) -> tuple[float, float]:
        """Return metres per unit of a and of b."""
        return 1.0, 1.0

    def evaluate(self, a: NDArray, b: NDArray) -> Patch:
        """Return the surface in the rig frame at parameters a and b, of shapes that broadcast."""
        parts = self.local(np.asarray(a, float), np.asarray(b, float))
        turned = [np.einsum("ij,j...->i...", self.axes, part) for part in vars(parts).values()]
        # The first part is the point; derivatives do not move.
        turned[0] = turned[0] + np.reshape(self.place_m, (3, *(1,) * (turned[0].ndim - 1)))
        return Patch(*turned)

    def cover(self, a: NDArray, b: NDArray) -> NDArray:
        """Return 1 on the piece, 0 beyond its edges, and a step of SOFT_EDGE_M between, 0.5 at the edge."""
        share = np.ones(np.broadcast(a, b).shape)
        for value, scale, size_m in zip((a, b), self.scale_m(), self.size_m, strict=True):
            inside_m = size_m / 2 - np.abs(value) * scale
            # The cubic step from 0 to 1 without slope at its ends.
            phase = np.clip(inside_m / SOFT_EDGE_M + 0.5, 0, 1)
            share = share * phase**2 * (3 - 2 * phase)
        return share

    def grid(self, count: int = 13) -> tuple[NDArray, NDArray]:
        """Return parameters of a coarse grid of the piece, each [count * count]."""
        ends = [size / 2 / scale for size, scale in zip(self.size_m, self.scale_m(), strict=True)]
        a, b = np.meshgrid(*(np.linspace(-end, end, count) for end in ends))
        return a.ravel(), b.ravel()

    def project(self, points_m: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Return nearest place of the surface to points [n, 3]: signed distances (positive in front), a, b; each [n].

        The surface continues beyond the edges of the piece.
        """
        points = np.asarray(points_m, float).T
        a, b = self.grid()
        distance2 = ((points[:, :, None] - self.evaluate(a, b).point[:, None]) ** 2).sum(axis=0)
        nearest = distance2.argmin(axis=1)
        a = a[nearest]
        b = b[nearest]
        for _ in range(ITERATIONS):
            patch = self.evaluate(a, b)
            difference = patch.point - points
            gradient = np.stack([_dots(difference, patch.d_a), _dots(difference, patch.d_b)])
            # Gauss and Newton's: without the second derivatives of the surface.
            hessian = np.array([
                [_dots(patch.d_a, patch.d_a), _dots(patch.d_a, patch.d_b)],
                [_dots(patch.d_a, patch.d_b), _dots(patch.d_b, patch.d_b)],
            ])  # fmt: skip
            step = solve_2x2(hessian, gradient)
            a = a - step[0]
            b = b - step[1]
        patch = self.evaluate(a, b)
        return _dots(points - patch.point, patch.normal), a, b


@dataclass(frozen=True)
class Graph(Shape):
    """z = (bend_x x^2 + bend_y y^2) / 2 + twist x y in local axes; a is x, b is y, in metres.

    Bends and twist are in 1 / m; a positive bend is convex to the antennas. `is_soft`: a plane has soft edges too.
    """

    bend_x: float = 0.0
    bend_y: float = 0.0
    twist: float = 0.0
    is_soft: bool = False

    @property
    def is_bent(self) -> bool:  # type: ignore[override]
        """True if it is not a plane."""
        return bool(self.bend_x or self.bend_y or self.twist)

    @property
    def is_flat_plate(self) -> bool:  # type: ignore[override]
        """True for a plane with sharp edges."""
        return not (self.is_bent or self.is_soft)

    def local(self, a: NDArray, b: NDArray) -> Patch:
        """Return the surface in local axes."""
        zero = np.zeros(np.broadcast(a, b).shape)
        ones = np.ones(np.broadcast(a, b).shape)
        height = (self.bend_x * a**2 + self.bend_y * b**2) / 2 + self.twist * a * b
        return Patch(
            point=np.stack([a + zero, b + zero, height]),
            d_a=np.stack([ones, zero, self.bend_x * a + self.twist * b]),
            d_b=np.stack([zero, ones, self.bend_y * b + self.twist * a]),
            d_aa=np.stack([zero, zero, self.bend_x * ones]),
            d_ab=np.stack([zero, zero, self.twist * ones]),
            d_bb=np.stack([zero, zero, self.bend_y * ones]),
        )


@dataclass(frozen=True)
class Revolved(Shape):
    """Surface of revolution about local x: a in metres along the axis, b the angle (rad) from -z, towards the antennas.

    The radius is radius_m + slope a - bulge a^2 / 2: a cylinder, a cone, or a barrel (`bulge` in 1 / m).
    """

    radius_m: float = 0.1
    slope: float = 0.0
    bulge: float = 0.0

    def scale_m(self) -> tuple[float, float]:
        """Return metres per unit of a and of b, at a = 0."""
        return 1.0, self.radius_m

    def profile(self, a: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Return radius at places along the axis and its first and second derivative, each of the shape of `a`."""
        radius = self.radius_m + self.slope * a - self.bulge / 2 * a**2
        first = self.slope - self.bulge * a
        second = -self.bulge + 0 * a
        return radius, first, second

    def local(self, a: NDArray, b: NDArray) -> Patch:
        """Return the surface in local axes."""
        a, b = np.broadcast_arrays(a, b)
        radius, first, second = self.profile(a)
        sine = np.sin(b)
        cosine = np.cos(b)
        zero = np.zeros_like(radius)
        ones = np.ones_like(radius)
        return Patch(
            point=np.stack([a, radius * sine, -radius * cosine]),
            d_a=np.stack([ones, first * sine, -first * cosine]),
            d_b=np.stack([zero, radius * cosine, radius * sine]),
            d_aa=np.stack([zero, second * sine, -second * cosine]),
            d_ab=np.stack([zero, first * cosine, first * sine]),
            d_bb=np.stack([zero, -radius * sine, radius * cosine]),
        )


@dataclass(frozen=True)
class Sphere(Shape):
    """A sphere about `place_m`: a and b are the angles (rad) of longitude about local y and of latitude, from -z."""

    radius_m: float = 0.1

    def scale_m(self) -> tuple[float, float]:
        """Return metres per unit of a and of b."""
        return self.radius_m, self.radius_m

    def local(self, a: NDArray, b: NDArray) -> Patch:
        """Return the surface in local axes."""
        a, b = np.broadcast_arrays(a, b)
        radius = self.radius_m
        sa = np.sin(a)
        ca = np.cos(a)
        sb = np.sin(b)
        cb = np.cos(b)
        zero = np.zeros_like(sa)
        point = radius * np.stack([sa * cb, sb, -ca * cb])
        return Patch(
            point=point,
            d_a=radius * np.stack([ca * cb, zero, sa * cb]),
            d_b=radius * np.stack([-sa * sb, cb, ca * sb]),
            d_aa=radius * np.stack([-sa * cb, zero, ca * cb]),
            d_ab=radius * np.stack([-ca * sb, zero, -sa * sb]),
            d_bb=-point,
        )


# Angle from -z up to which round bodies have a surface. Chosen: specular points lie well within it.
FRONT_DEG = 80


def sphere(name: str, stack: Stack, centre_m: tuple[float, float, float], radius_m: float) -> Sphere:
    """Return the front of a sphere, as far as `FRONT_DEG`."""
    extent_m = 2 * np.radians(FRONT_DEG) * radius_m
    return Sphere(name, stack, centre_m, (extent_m, extent_m), radius_m=radius_m)


def cylinder(
    name: str,
    stack: Stack,
    centre_m: tuple[float, float, float],
    radius_m: float,
    length_m: float,
    *,
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0),
    slope: float = 0.0,
    bulge: float = 0.0,
) -> Revolved:
    """Return the front of a cylinder (with `slope` a cone, with `bulge` a barrel, see `Revolved`) about its centre.

    `axis`: direction of its axis in the rig frame, not along z.
    """
    along = np.asarray(axis, float) / np.linalg.norm(axis)
    normal = np.array([0.0, 0.0, 1.0]) - along[2] * along
    normal /= np.linalg.norm(normal)
    axes = np.stack([along, np.cross(normal, along), normal], axis=1)
    size_m = (length_m, 2 * np.radians(FRONT_DEG) * radius_m)
    return Revolved(name, stack, centre_m, size_m, axes, radius_m=radius_m, slope=slope, bulge=bulge)


def bottle(
    name: str,
    stack: Stack,
    centre_m: tuple[float, float, float],
    radius_m: float,
    length_m: float,
    *,
    axis: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> tuple[Revolved, ...]:
    """Return body, shoulder and neck of a bottle about `axis`, its body's middle at `centre_m`.

    The shoulder is a cone with a half angle of 20 degrees, as long as half of the body or until 0.3 of its radius is
    left. The neck is a cylinder with the radius at which the shoulder ends, half as long as the body.
    """
    along = np.asarray(axis, float) / np.linalg.norm(axis)
    slope = -np.tan(np.radians(20))
    neck_radius_m = max(0.3 * radius_m, radius_m + slope * length_m / 2)
    cone_m = (neck_radius_m - radius_m) / slope
    cone_at = tuple(np.asarray(centre_m) + (length_m + cone_m) / 2 * along)
    neck_at = tuple(np.asarray(centre_m) + (length_m / 2 + cone_m + length_m / 4) * along)
    middle_radius_m = (radius_m + neck_radius_m) / 2
    return (
        cylinder(f"{name} body", stack, centre_m, radius_m, length_m, axis=axis),
        cylinder(f"{name} shoulder", stack, cone_at, middle_radius_m, cone_m, axis=axis, slope=slope),
        cylinder(f"{name} neck", stack, neck_at, neck_radius_m, length_m / 2, axis=axis),
    )


def plate(
    name: str,
    stack: Stack,
    centre_m: tuple[float, float, float],
    size_m: tuple[float, float],
    *,
    tilt_deg: tuple[float, float] = (0.0, 0.0),
    turn_deg: float = 0.0,
    bends: tuple[float, float, float] = (0.0, 0.0, 0.0),
    is_soft: bool = False,
) -> Graph:
    """Return a plate: its z rises along x and y by the tilts; with `bends` (x, y, twist; 1 / m) a sheet or saddle.

    `turn_deg`: it is turned so far about its normal.
    """
    slope_x, slope_y = np.tan(np.radians(tilt_deg))
    normal = np.array([-slope_x, -slope_y, 1.0])
    normal /= np.linalg.norm(normal)
    x_axis = np.array([1.0, 0.0, slope_x])
    x_axis /= np.linalg.norm(x_axis)
    axes = turn(normal, turn_deg) @ np.stack([x_axis, np.cross(normal, x_axis), normal], axis=1)
    bend_x, bend_y, twist = bends
    return Graph(name, stack, centre_m, size_m, axes, bend_x=bend_x, bend_y=bend_y, twist=twist, is_soft=is_soft)


def solve_2x2(matrix: NDArray, right: NDArray) -> NDArray:
    """Solve [2, 2, ...] x = [2, ...]."""
    determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] * matrix[1, 0]
    first = matrix[1, 1] * right[0] - matrix[0, 1] * right[1]
    second = matrix[0, 0] * right[1] - matrix[1, 0] * right[0]
    return np.stack([first, second]) / determinant


@dataclass(frozen=True)
class PathAt:
    """Path from TX over a surface to RX [...], and its derivatives by both parameters: [2, ...] and [2, 2, ...]."""

    length_m: NDArray
    gradient: NDArray
    hessian: NDArray


def follow_path(patch: Patch, tx_m: NDArray, rx_m: NDArray) -> PathAt:
    """Return the path from TX by way of each point of the patch to RX, antennas at [3, ...]."""
    length = 0.0
    gradient = 0.0
    hessian = 0.0
    for antenna in (tx_m, rx_m):
        ray = patch.point - antenna
        distance = np.sqrt(_dots(ray, ray))
        unit = ray / distance
        rates = [_dots(unit, patch.d_a), _dots(unit, patch.d_b)]
        tangents = (patch.d_a, patch.d_b)
        seconds = ((patch.d_aa, patch.d_ab), (patch.d_ab, patch.d_bb))
        # Second derivatives of this antenna's distance from the surface.
        bends = [
            [
                (_dots(tangents[i], tangents[j]) - rates[i] * rates[j]) / distance + _dots(unit, seconds[i][j])
                for j in range(2)
            ]
            for i in range(2)
        ]
        length = length + distance
        gradient = gradient + np.stack(rates)
        hessian = hessian + np.array(bends)
    return PathAt(np.asarray(length), np.asarray(gradient), np.asarray(hessian))


def find_specular(shape: Shape, tx_m: NDArray, rx_m: NDArray) -> tuple[NDArray, NDArray]:
    """Return parameters (a, b), each [n], at which the path from TX to RX [3, n] is stationary.

    They can lie beyond the edges of the piece.
    """
    scale = np.array(shape.scale_m())
    grid = shape.grid()
    coarse = shape.evaluate(*grid)
    # All pairs of antennas and places of the grid: [3, 1, place] beside [3, n, 1].
    patch = Patch(*(part[:, None] for part in vars(coarse).values()))
    path = follow_path(patch, tx_m[:, :, None], rx_m[:, :, None])
    # The smallest slope of the path per metre on the surface.
    basis = patch.tangents()
    slope = np.einsum("ij...,j...->i...", basis, path.gradient)
    start = (slope**2).sum(axis=0).argmin(axis=-1)
    a = grid[0][start]
    b = grid[1][start]
    for _ in range(ITERATIONS):
        path = follow_path(shape.evaluate(a, b), tx_m, rx_m)
        step = solve_2x2(path.hessian, path.gradient)
        length = np.hypot(step[0] * scale[0], step[1] * scale[1])
        step = step * np.minimum(1, LONGEST_STEP_M / np.maximum(length, 1e-12))
        a = a - step[0]
        b = b - step[1]
    return a, b
