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
        Tilt of the sharpest plane along x and along y, degrees; positive where z grows.
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
        Search range to either side of the rig file's plane.
    planes
        Number of planes, evenly spaced over the search range.
    """
    grid = builder.grid
    depths = np.linspace(-depth_m, depth_m, planes)
    stack = np.zeros((planes, *grid.shape))
    for i, depth in enumerate(depths):
        for board in builder.boards.values():
            image = board.image(replace(grid, z_m=float(np.mean(grid.z_m)) + depth))[0]
            stack[i] += np.abs(image) ** 2
    cells = _compute_cell_areas(builder, depths)
    x = grid.x_m - grid.x_m.mean()
    y = grid.y_m - grid.y_m.mean()

    def sharpness(plane: NDArray[np.float64]) -> float:
        """Return the sharpness on a plane [3]: depth at the centre, mm; rise along x and along y, mm per 100 mm."""
        depth, along_x, along_y = plane * [1e-3, 1e-2, 1e-2]
        z = np.clip(depth + along_x * x[None, :] + along_y * y[:, None], depths[0], depths[-1])
        weight = 1 / _interpolate_stack(cells, depths, z)
        intensity = _interpolate_stack(stack, depths, z)
        return float((weight * intensity**2).sum() / max(float((weight * intensity).sum()) ** 2, 1e-300))

    flat = np.array([sharpness(np.array([1e3 * depth, 0.0, 0.0])) for depth in depths])
    start = np.array([1e3 * depths[int(np.argmax(flat))], 0.0, 0.0])
    rise = 1e2 * float(np.tan(np.radians(_MAX_TILT_DEG)))
    optimum = scipy.optimize.minimize(
        lambda plane: -sharpness(plane) / flat.max(),
        start,
        method="Nelder-Mead",
        bounds=[(-1e3 * depth_m, 1e3 * depth_m), (-rise, rise), (-rise, rise)],
        options={"initial_simplex": start + np.vstack([np.zeros(3), np.eye(3)]), "xatol": 0.005, "fatol": 1e-9},
    )
    depth, along_x, along_y = optimum.x
    gain = -optimum.fun * flat.max() / sharpness(np.zeros(3))
    tilt = np.degrees(np.arctan(np.array([along_x, along_y]) / 1e2))
    return Focus(1e3 * depths, flat / flat.max(), float(depth), (float(tilt[0]), float(tilt[1])), float(gain))


def _compute_cell_areas(builder: ImageBuilder, depths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the area of a resolution cell at every pixel of every plane, [plane, ny, nx], m^2.

    It varies slowly: it is computed at nine pixels of the nearest and of the farthest plane, and interpolated between.
    """
    aperture = next(iter(builder.boards.values())).aperture
    grid = builder.grid
    z = float(np.mean(grid.z_m)) + depths
    axes = (z[[0, -1]], grid.y_m[[0, grid.y_m.size // 2, -1]], grid.x_m[[0, grid.x_m.size // 2, -1]])
    area = np.empty([axis.size for axis in axes])
    for index in np.ndindex(area.shape):
        pz, py, px = (axis[i] for axis, i in zip(axes, index, strict=True))
        point = np.array([px, py, pz])
        area[index] = compute_limit_m(aperture, point, 0) * compute_limit_m(aperture, point, 1)
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
