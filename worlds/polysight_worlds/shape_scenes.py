"""Random scenes of shapes, what disturbs their scan, and the samples of the scan.

`draw_shapes` makes a scene of one object of a kind, with or without a table behind; `scan_shapes` gives its samples as
the instrument holds them, with noise and a rig whose boards stand a little beside their nominal places.

Boards (places, axes, leakage), gains, noise and scene have random streams of their own, numbered after the seed
(`[seed, 11]`), and what is switched off is drawn, too: switching one disturbance on does not change the others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from polysight_worlds.media import METAL, Stack
from polysight_worlds.optics import Antenna
from polysight_worlds.rig import Boards, published_boards, published_rig, turn
from polysight_worlds.shape_echoes import record_shapes
from polysight_worlds.shapes import Shape, Sphere, bottle, cylinder, plate, sphere

# The linear part of the chirp of the published rig (instrument.toml). Its range gate of 0.5 m holds paths that differ
# by up to 1 m; 24 frequencies are enough for it: at their steps of 151 MHz only paths that differ by 2 m look alike.
FREQUENCIES_HZ = np.linspace(76.282e9, 79.749e9, 24)
# Linear samples of the published chirp.
SAMPLES = 192
# Noise of a sample, where a free path of 1 m has amplitude 1. In the published rig it is 5.5 dB below the direct path
# in each chirp, and a position averages 16 of them (a fourth of the noise). The direct path is 1.39 m long, and weaker
# than a free path by the factor 1.35, as it leaves at the edge of the antennas' patterns.
NOISE_A_SAMPLE = 10 ** (-5.5 / 20) / np.sqrt(16) / 1.39 / 1.35
# Distance from the rig's origin to the published rig's object plane.
PLANE_M = 0.499


@dataclass(frozen=True)
class ShapeScene:
    """Shapes of one object, and its truth.

    `permittivity` is None for metal; `radius_m`: the smaller radius of its front, infinite for a plate. `is_uniform` is
    False for a thin wall, which has no single surface to look at. `background`: a table or nothing.
    """

    kind: str
    shapes: tuple[Shape, ...]
    permittivity: complex | None
    radius_m: float
    is_uniform: bool = True
    background: tuple[Shape, ...] = ()

    def nearest_surface(self, points_m: NDArray) -> tuple[NDArray, NDArray]:
        """Signed distances [n] of points [n, 3] from the nearest surface that faces the antennas, and normals [n, 3].

        Distances are positive in front of the surface. They are infinite and normals zero where no piece lies before or
        behind a point, or only its back does. The surface of a single piece counts beyond its edges, too.
        """
        distances = np.full(len(points_m), np.inf)
        normals = np.zeros((len(points_m), 3))
        for shape in self.shapes:
            # `a` and `b` are the surface's parameters.
            distance, a, b = shape.project(points_m)
            facing = shape.evaluate(a, b).normal.T
            # The antennas do not see the back of a body.
            is_seen = facing[:, 2] < 0
            if len(self.shapes) > 1:
                # The surface of a piece continues beyond its edges, through other pieces.
                is_seen &= shape.cover(a, b) > 0
            nearer = is_seen & (np.abs(distance) < np.abs(distances))
            distances = np.where(nearer, distance, distances)
            normals = np.where(nearer[:, None], facing, normals)
        return distances, normals


@dataclass(frozen=True)
class ShapeNuisances:
    """What disturbs a scan of shapes; 0: undisturbed. By `seed`, all but the phases is drawn from normal distributions.

    `noise`: of the nominal noise. Root mean squares: `misplaced_mm` how far each board stands from where the rig file
    says, `axes_deg` how far its polarisation is turned about its boresight, `leakage` the magnitude of the other
    polarisation in H and V. `gain_db`: spread of the boards' unknown gains; with any, their phases are drawn too.
    """

    seed: int = 0
    noise: float = 1.0
    misplaced_mm: float = 0.0
    axes_deg: float = 0.0
    leakage: float = 0.0
    gain_db: float = 0.0


def disturb_boards(boards: Boards, nuisances: ShapeNuisances) -> Boards:
    """Return the boards as they really stand; the same for all scans with these nuisances."""
    rng = np.random.default_rng([nuisances.seed, 11])

    def disturb(antennas: tuple[Antenna, ...], leakage: float) -> tuple[Antenna, ...]:
        """Shift and turn the antennas of one board together, and give them a drawn leakage."""
        shift_m = nuisances.misplaced_mm / 1000 / np.sqrt(3) * rng.standard_normal(3)
        rotation = turn(antennas[0].boresight, nuisances.axes_deg * rng.standard_normal())
        real, imaginary = leakage / np.sqrt(2) * rng.standard_normal(2)
        leaked = complex(real, imaginary)
        return tuple(antenna.rotate(rotation, shift_m).with_leakage(leaked) for antenna in antennas)

    tx = disturb((boards.tx,), 0.0)[0]
    return Boards(tx, disturb(boards.h, nuisances.leakage), disturb(boards.v, nuisances.leakage))


def scan_shapes(
    shapes: Sequence[Shape],
    offsets_m: NDArray,
    nuisances: ShapeNuisances | None = None,
    *,
    boards: Boards | None = None,
    frequencies_hz: NDArray = FREQUENCIES_HZ,
    number: int = 0,
) -> dict[str, NDArray]:
    """Return samples of shapes, complex64 [rx, frequency, ...] for "h" and "v", as of `record_shapes`, disturbed.

    `offsets_m` [..., 3]: stage offsets. `boards`: as the rig file has them, or None for the published rig.
    Scans of one rig, a reference and an object, have the same nuisances; `number` makes their noise differ.
    """
    nuisances = ShapeNuisances() if nuisances is None else nuisances
    nominal = published_boards() if boards is None else boards
    true_boards = disturb_boards(nominal, nuisances)
    cubes = record_shapes(shapes, true_boards, frequencies_hz, offsets_m)
    gain_rng = np.random.default_rng([nuisances.seed, 12])
    noise_rng = np.random.default_rng([nuisances.seed, 13, number])
    # Each of the fewer frequencies represents several samples of the chirp, whose noise averages.
    sigma = nuisances.noise * NOISE_A_SAMPLE * np.sqrt(len(frequencies_hz) / SAMPLES)
    for channel, cube in cubes.items():
        level = gain_rng.normal()
        phase = gain_rng.uniform(0, 2 * np.pi)
        if nuisances.gain_db:
            cube *= np.complex64(10 ** (nuisances.gain_db * level / 20) * np.exp(1j * phase))
        # Real and imaginary part.
        pair = noise_rng.standard_normal((2, *cube.shape), dtype=np.float32)
        cubes[channel] = cube + np.float32(sigma * np.sqrt(0.5)) * (pair[0] + 1j * pair[1])
    return cubes


def scan_offsets(columns: int = 350, rows: int = 200, step_m: float = 0.002, *, every: int = 1) -> NDArray:
    """Stage offsets [rows, columns, 3] about the middle of the grid; `every`: of so many positions one, both ways."""
    x = (np.arange(0, columns, every) - (columns - 1) / 2) * step_m
    y = (np.arange(0, rows, every) - (rows - 1) / 2) * step_m
    grid_x, grid_y = np.meshgrid(x, y)
    return np.stack([grid_x, grid_y, np.zeros_like(grid_x)], axis=-1)


def reference_sphere(radius_m: float = 0.125) -> Sphere:
    """Return a metal sphere whose front is at the middle of the picture."""
    x, y = published_rig().centre_m
    return sphere("reference", METAL, (float(x), float(y), PLANE_M + radius_m), radius_m)


@dataclass(frozen=True)
class _Draw:
    """What all kinds draw: a front near the middle of the picture, a medium, and the direction of an axis.

    `rng`: the generator from which each kind draws its sizes. All ranges here are chosen.
    """

    rng: Generator
    front_m: tuple[float, float, float]
    stack: Stack
    axis: tuple[float, float, float]

    def point_behind(self, depth_m: float) -> tuple[float, float, float]:
        """Return the centre of a body whose front is at `front_m` and lies `depth_m` before it."""
        x, y, z = self.front_m
        return x, y, z + depth_m


def _draw_sphere(low_m: float, high_m: float) -> Callable[[_Draw], tuple[tuple[Shape, ...], float]]:
    """Return a function that draws a sphere with a radius between these, and returns it and its radius of curvature."""

    def draw(draws: _Draw) -> tuple[tuple[Shape, ...], float]:
        radius_m = draws.rng.uniform(low_m, high_m)
        return (sphere("sphere", draws.stack, draws.point_behind(radius_m), radius_m),), radius_m

    return draw


def _draw_cylinder(low_m: float, high_m: float) -> Callable[[_Draw], tuple[tuple[Shape, ...], float]]:
    """Return a function that draws a cylinder 0.4 m long, a radius between these, and returns it and its radius."""

    def draw(draws: _Draw) -> tuple[tuple[Shape, ...], float]:
        radius_m = draws.rng.uniform(low_m, high_m)
        return (
            cylinder("cylinder", draws.stack, draws.point_behind(radius_m), radius_m, 0.4, axis=draws.axis),
        ), radius_m

    return draw


def _draw_plate(draws: _Draw) -> tuple[tuple[Shape, ...], float]:
    """Draw a tilted plate; its radius of curvature is infinite."""
    tilt_deg = draws.rng.uniform(-15, 15, 2)
    size_m = draws.rng.uniform(0.14, 0.22, 2)
    tilts = float(tilt_deg[0]), float(tilt_deg[1])
    return (plate("plate", draws.stack, draws.front_m, (float(size_m[0]), float(size_m[1])), tilt_deg=tilts),), np.inf


def _draw_cone(draws: _Draw) -> tuple[tuple[Shape, ...], float]:
    """Draw a cone with a half angle of 3 to 12 degrees; return it and its radius."""
    radius_m = draws.rng.uniform(0.1, 0.16)
    slope = float(np.tan(np.radians(draws.rng.uniform(3, 12))))
    piece = cylinder("cone", draws.stack, draws.point_behind(radius_m), radius_m, 0.3, axis=draws.axis, slope=slope)
    return (piece,), radius_m


def _draw_barrel(draws: _Draw) -> tuple[tuple[Shape, ...], float]:
    """Draw a barrel, whose profile has a curvature of 1 to 6 per metre; return it and its radius."""
    radius_m = draws.rng.uniform(0.1, 0.16)
    bulge = float(draws.rng.uniform(1, 6))
    piece = cylinder("barrel", draws.stack, draws.point_behind(radius_m), radius_m, 0.2, axis=draws.axis, bulge=bulge)
    return (piece,), radius_m


def _draw_saddle(draws: _Draw) -> tuple[tuple[Shape, ...], float]:
    """Draw a saddle; return it and the smaller of its two radii."""
    radii_m = draws.rng.uniform(0.1, 0.2, 2)
    # Curvatures along x and y, and the twist.
    bends = float(1 / radii_m[0]), float(-1 / radii_m[1]), 0.0
    turn_deg = float(draws.rng.uniform(0, 180))
    return (plate("saddle", draws.stack, draws.front_m, (0.24, 0.24), turn_deg=turn_deg, bends=bends),), radii_m.min()


def _draw_sheet(draws: _Draw) -> tuple[tuple[Shape, ...], float]:
    """Draw a bent sheet, so thick that its back does not reflect; return it and its radius."""
    radius_m = draws.rng.uniform(0.15, 0.6)
    turn_deg = float(draws.rng.uniform(0, 180))
    bends = (1 / radius_m, 0.0, 0.0)
    return (plate("sheet", draws.stack, draws.front_m, (0.24, 0.24), turn_deg=turn_deg, bends=bends),), radius_m


def _draw_bottle(draws: _Draw) -> tuple[tuple[Shape, ...], float]:
    """Draw a bottle with a wall of 0.5 to 3 mm and air in it; return its pieces and its radius."""
    radius_m = draws.rng.uniform(0.03, 0.05)
    wall_m = draws.rng.uniform(0.5e-3, 3e-3)
    # One layer of the medium, and air behind it.
    wall = Stack(((draws.stack.below, wall_m),), 1.0)
    return bottle("bottle", wall, draws.point_behind(radius_m), radius_m, 0.16, axis=draws.axis), radius_m


def _draw_thin_sheet(draws: _Draw) -> tuple[tuple[Shape, ...], float]:
    """Draw a bent sheet 0.5 to 3 mm thick; return it and its radius."""
    radius_m = draws.rng.uniform(0.15, 0.6)
    turn_deg = float(draws.rng.uniform(0, 180))
    wall = Stack(((draws.stack.below, draws.rng.uniform(0.5e-3, 3e-3)),), 1.0)
    bends = (1 / radius_m, 0.0, 0.0)
    return (plate("thin sheet", wall, draws.front_m, (0.24, 0.24), turn_deg=turn_deg, bends=bends),), radius_m


# What draws the pieces of each kind of object, and the smaller radius of its front in metres. Numbers are radii in mm.
KINDS: dict[str, Callable[[_Draw], tuple[tuple[Shape, ...], float]]] = {
    "plate": _draw_plate,
    "sphere": _draw_sphere(0.1, 0.2),
    "cylinder": _draw_cylinder(0.1, 0.2),
    "sphere 50": _draw_sphere(0.05, 0.05),
    "cylinder 50": _draw_cylinder(0.05, 0.05),
    "sphere below 40": _draw_sphere(0.02, 0.04),
    "cylinder below 40": _draw_cylinder(0.02, 0.04),
    "bottle": _draw_bottle,
    "cone": _draw_cone,
    "barrel": _draw_barrel,
    "saddle": _draw_saddle,
    "sheet": _draw_sheet,
    "thin sheet": _draw_thin_sheet,
}
# Both faces of a thin wall reflect: it has no single surface.
THIN_WALLS = ("bottle", "thin sheet")


def draw_shapes(
    seed: int, kind: str | None = None, *, with_table: bool = False, metal_share: float = 0.0
) -> ShapeScene:
    """Draw an object of a kind (None: any of `KINDS`), real part 2 to 9, loss 0 to 1, front near the picture's middle.

    `with_table`: a wooden table stands 120 to 250 mm behind its front. `metal_share`: of scenes whose object is metal;
    thin walls never are.
    """
    rng = np.random.default_rng([seed, 21])
    if kind is None:
        kind = str(rng.choice(list(KINDS)))
    medium = complex(rng.uniform(2, 9), -rng.uniform(0, 1))
    is_metal = rng.random() < metal_share and kind not in THIN_WALLS
    x, y = published_rig().centre_m + rng.uniform(-0.04, 0.04, 2)
    front_m = float(x), float(y), float(PLANE_M + rng.uniform(-0.02, 0.03))
    # Axes lie within 10 degrees of the picture's plane, in any direction of it.
    direction_rad = rng.uniform(0, np.pi)
    out_of_plane_rad = rng.uniform(-0.17, 0.17)
    axis = float(np.cos(direction_rad)), float(np.sin(direction_rad)), float(out_of_plane_rad)
    stack = METAL if is_metal else Stack(below=medium)
    shapes, radius_m = KINDS[kind](_Draw(rng, front_m, stack, axis))
    background: tuple[Shape, ...] = ()
    if with_table:
        wood = Stack(below=complex(rng.uniform(1.8, 3.5), -0.15))
        place_m = (front_m[0], front_m[1], front_m[2] + rng.uniform(0.12, 0.25))
        # With soft edges it hardly diffracts.
        background = (plate("table", wood, place_m, (1.6, 1.2), is_soft=True),)
    return ShapeScene(
        kind=kind,
        shapes=shapes,
        permittivity=None if is_metal else medium,
        radius_m=float(radius_m),
        is_uniform=kind not in THIN_WALLS,
        background=background,
    )
