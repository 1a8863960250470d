"""Distance and tilt of the object plane from the sharpness of the image (`focus_sweep`).

The scene is imaged on a stack of planes parallel to the stage. Any plane, also a tilted one, is a cut through this
volume, so one stack is enough for the whole search.

Sharpness is `sum w I^2 / (sum w I)^2` of the intensities I of the pixels (Fienup and Miller, J. Opt. Soc. Am. A 20,
2003). The weight w is 1 over the area of a resolution cell: cells grow with the distance of the plane, so that with
equal weights the nearest plane would be the sharpest. Points and edges determine the focus, the inside of a plate does
not. A wrong depth causes a phase error that grows with the square of the aperture's length: a wide scan resolves a
tenth of a millimetre, a narrow one does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight.imaging.images import ImageBuilder
from polysight.imaging.resolution import compute_limit_m

# Largest tilt of the plane along x and along y that `focus_sweep` searches; chosen. A result near this limit is not
# certain.
_MAX_TILT_DEG = 3.0
# The search describes a plane by its depth in millimetres and its slopes along x and along y in per cent, so that steps
# of 1 suit all three. Factors to metres and to slopes:
_FROM_SEARCH_UNITS = np.array([1e-3, 1e-2, 1e-2])
_MM = 1e3
_PER_CENT = 1e2
# Axes of a point (x, y, z).
_X_AXIS = 0
_Y_AXIS = 1


@dataclass(frozen=True)
class Focus:
    """Result of a focus sweep.

    Attributes
    ----------
    depths_mm
        float64 [n]: distances of the planes of the sweep minus that of the rig file's plane.
    sharpness
        float64 [n]: sharpness on the plane without tilt at each depth, over the largest of them.
    depth_mm
        Distance of the sharpest plane minus that of the rig file's plane, at the centre of the image.
    tilt_deg
        Tilt of the sharpest plane along x and along y, degrees; positive if its z grows with x, or with y.
    gain
        Sharpness on the sharpest plane over that on the rig file's plane.
    """

    depths_mm: NDArray[np.float64]
    sharpness: NDArray[np.float64]
    depth_mm: float
    tilt_deg: tuple[float, float]
    gain: float

    @property
    def certain(self) -> bool:
        """True if depth and tilt are below 95 % of the search's limits, and the sharpness falls by 2 % towards both
        ends.

        Both margins are chosen.
        """
        is_inside = (
            abs(self.depth_mm) < 0.95 * self.depths_mm[-1] and max(map(abs, self.tilt_deg)) < 0.95 * _MAX_TILT_DEG
        )
        return is_inside and float(max(self.sharpness[0], self.sharpness[-1])) < 0.98

    def transpose(self) -> Focus:
        """Return the result with x and y swapped."""
        return replace(self, tilt_deg=(self.tilt_deg[1], self.tilt_deg[0]))

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers for JSON."""
        return {
            "depth_mm": round(self.depth_mm, 3),
            "tilt_deg": [round(t, 3) for t in self.tilt_deg],
            "gain": round(self.gain, 6),
            "certain": self.certain,
            "depths_mm": self.depths_mm.tolist(),
            "sharpness": self.sharpness.tolist(),
        }


def focus_sweep(builder: ImageBuilder, depth_m: float = 8e-3, planes: int = 17) -> Focus:
    """Find the plane on which the sum of both channels' intensities is sharpest.

    Parameters
    ----------
    builder
        Builder with all rows, and with a range gate for at least this `depth_m`.
    depth_m
        Search range to either side of the rig file's plane; the default is chosen.
    planes
        Number of planes, evenly spaced over the search range; the default, a plane each millimetre, is chosen.
    """
    grid = builder.grid
    depths = np.linspace(-depth_m, depth_m, planes)
    stack = np.zeros((planes, *grid.shape))
    for i, depth in enumerate(depths):
        for board in builder.boards.values():
            image, _footprint, _notice = board.image(replace(grid, z_m=float(np.mean(grid.z_m)) + depth))
            stack[i] += np.abs(image) ** 2
    cells = _compute_cell_areas(builder, depths)
    x = grid.x_m - grid.x_m.mean()
    y = grid.y_m - grid.y_m.mean()

    def sharpness(plane: NDArray[np.float64]) -> float:
        """Return the sharpness on a plane [3]: depth at the centre, mm; slopes along x and along y, per cent."""
        depth, slope_x, slope_y = plane * _FROM_SEARCH_UNITS
        z = np.clip(depth + slope_x * x[None, :] + slope_y * y[:, None], depths[0], depths[-1])
        weight = 1 / _interpolate_stack(cells, depths, z)
        intensity = _interpolate_stack(stack, depths, z)
        return float((weight * intensity**2).sum() / max(float((weight * intensity).sum()) ** 2, 1e-300))

    # Begin at the sharpest plane without tilt.
    flat = np.array([sharpness(np.array([_MM * depth, 0.0, 0.0])) for depth in depths])
    start = np.array([_MM * depths[int(np.argmax(flat))], 0.0, 0.0])
    largest_depth = _MM * depth_m
    largest_slope = _PER_CENT * float(np.tan(np.radians(_MAX_TILT_DEG)))
    # The simplex has the start and a neighbour at a distance of 1 along each coordinate.
    simplex = start + np.vstack([np.zeros(3), np.eye(3)])
    optimum = scipy.optimize.minimize(
        lambda plane: -sharpness(plane) / flat.max(),
        start,
        method="Nelder-Mead",
        bounds=[
            (-largest_depth, largest_depth),
            (-largest_slope, largest_slope),
            (-largest_slope, largest_slope),
        ],
        # The search ends when the corners of the simplex differ by less than 0.005 mm and 0.005 per cent, and their
        # relative sharpness by less than 1e-9.
        options={"initial_simplex": simplex, "xatol": 0.005, "fatol": 1e-9},
    )
    depth, slope_x, slope_y = optimum.x
    gain = -optimum.fun * flat.max() / sharpness(np.zeros(3))
    tilt = np.degrees(np.arctan(np.array([slope_x, slope_y]) / _PER_CENT))
    return Focus(
        depths_mm=_MM * depths,
        sharpness=flat / flat.max(),
        depth_mm=float(depth),
        tilt_deg=(float(tilt[0]), float(tilt[1])),
        gain=float(gain),
    )


def _compute_cell_areas(builder: ImageBuilder, depths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the area of a resolution cell at every pixel of every plane, [plane, ny, nx], m^2.

    It varies slowly: it is computed at nine pixels of the nearest and of the farthest plane, and interpolated between.
    """
    # A common factor of all areas does not matter, and the cells of all boards grow with the distance in nearly the
    # same way: those of one board are enough.
    one_board = next(iter(builder.boards.values()))
    aperture = one_board.aperture
    grid = builder.grid
    z = float(np.mean(grid.z_m)) + depths
    axes = (z[[0, -1]], grid.y_m[[0, grid.y_m.size // 2, -1]], grid.x_m[[0, grid.x_m.size // 2, -1]])
    area = np.empty([axis.size for axis in axes])
    for index in np.ndindex(area.shape):
        pz, py, px = (axis[i] for axis, i in zip(axes, index, strict=True))
        point = np.array([px, py, pz])
        area[index] = compute_limit_m(aperture, point, _X_AXIS) * compute_limit_m(aperture, point, _Y_AXIS)
    interpolate = scipy.interpolate.RegularGridInterpolator(axes, area, method="linear")
    return interpolate(tuple(np.meshgrid(z, grid.y_m, grid.x_m, indexing="ij")))


def _interpolate_stack(
    stack: NDArray[np.float64], depths: NDArray[np.float64], z: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the values [ny, nx] of a stack [plane, ny, nx] at the depth z [ny, nx] of each pixel, metres.

    They are interpolated along the depth by cubic convolution (Keys 1981).
    """
    place = (z - depths[0]) / (depths[1] - depths[0])
    base = np.clip(np.floor(place).astype(np.intp), 0, len(depths) - 2)
    t = place - base
    # Weights of the planes base - 1, base, base + 1 and base + 2.
    weights = (
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    )
    # The convolution needs one extrapolated plane before the first and one after the last (Keys 1981).
    ends = [3 * stack[:1] - 3 * stack[1:2] + stack[2:3], 3 * stack[-1:] - 3 * stack[-2:-1] + stack[-3:-2]]
    stack = np.concatenate([ends[0], stack, ends[1]])
    rows, columns = np.indices(z.shape)
    return sum((w * stack[base + i, rows, columns] for i, w in enumerate(weights)), np.zeros(z.shape))
