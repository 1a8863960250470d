"""The grid on which an object field is computed: kernel positions, spatial frequencies, and offsets of the output.

The field at the stage offset u is a convolution of the object A with a kernel g of the lag w = v - u, the place of an
object point relative to the stage:

    field(u) = sum over object points v of  A(v) g(v - u)

It is computed along each axis as a product of spectra, and interpolated from an oversampled grid of u.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.raster import mean_burst_travel_mm
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene.optics import Antennas, Real
from polysight_simulators.scene.scene_file import Scene

# Length of the kernel's fade-out beyond the scene; chosen: a shorter one needs a finer step.
FADE_M = 0.06
# Number of taps of the windowed sinc that interpolates the output; chosen.
TAPS = 12
# Margin of kernel positions at either end for the taps of the sinc: 6 steps of at most 2 mm.
MARGIN_M = 0.012
# Points of the output grid per kernel position; chosen: with fewer the sinc needs more taps.
OVERSAMPLING = 2


@dataclass(frozen=True)
class Axis:
    """One axis of the computation, metres: ranges of stage offsets u and kernel positions w, and the step of w."""

    low_u: float
    high_u: float
    low_w: float
    high_w: float
    step: float

    @property
    def points(self) -> int:
        """Number of kernel positions, a fast length of an FFT."""
        point_count = int(np.ceil((self.high_w - self.low_w + 2 * FADE_M) / self.step)) + 1
        return int(scipy.fft.next_fast_len(point_count) or 0)

    @property
    def w(self) -> Real:
        """Kernel positions (object point minus stage offset), [points]."""
        return self.low_w - FADE_M + self.step * np.arange(self.points)

    @property
    def fade(self) -> Real:
        """Fade-out of the kernel, [points]: 1 within the scene, falling smoothly to 0 outside."""
        w = self.w
        distance_beyond = np.maximum(self.low_w - w, w - self.high_w) / FADE_M
        return np.cos(np.pi / 2 * np.clip(distance_beyond, 0.0, 1.0)) ** 4

    @property
    def kappa(self) -> Real:
        """Spatial frequencies of the DFT, rad/m, [points]."""
        return 2 * np.pi * np.fft.fftfreq(self.points, self.step)

    @property
    def first_u(self) -> float:
        """First offset of the output grid, some taps before the aperture."""
        return self.low_u - (TAPS // 2) * self.step / OVERSAMPLING

    @property
    def outputs(self) -> int:
        """Number of offsets of the output grid."""
        return int(np.ceil((self.high_u - self.low_u) / self.step * OVERSAMPLING)) + TAPS + 1


# Largest number of kernel positions; chosen. About 24 arrays of this size are in memory, with 8 or 16 bytes per point:
# 0.8 to 1.6 GB. A scene as wide as the stage (0.8 x 0.5 m) has 0.6e6 points.
MAX_KERNEL_POINTS = 4_000_000


def spectral_axes(rig: Instrument, scene: Scene, ant: Antennas, top_hz: float) -> tuple[Axis, Axis]:
    """Return extent and pitch in x and y from the extent of the scene and the steepest phase of the kernel.

    `top_hz` is the highest frequency. The kernel extends from every offset to the edges of every plate. So it includes
    the specular points of tilted plates, which a tilt moves by 26 mm per degree at half a metre and 55 degrees of
    incidence. Raises ConfigError if the grid needs too much memory.
    """
    # The last pulse of a burst is sent about twice the mean travel after the trigger.
    travel = 2 * mean_burst_travel_mm(rig.burst, rig.stage) + abs(scene.disturbances.backlash_mm)
    # Centre and half size of each object, mm.
    edges = [(*p.centre_mm, p.size_mm[0] / 2, p.size_mm[1] / 2) for p in scene.plates]
    edges += [(*p.position_mm, 0.0, 0.0) for p in scene.points]
    table = np.array(edges or [(0.0, 0.0, 0.0, 0.0)])
    # Each axis: least and largest offset, with 1 mm to spare (chosen), least and largest kernel position.
    spans = []
    for i, (n, step, extra) in enumerate(
        ((rig.grid.columns, rig.grid.step_x_mm, travel + 1.0), (rig.grid.rows, rig.grid.step_y_mm, 1.0))
    ):
        half = (n - 1) / 2 * step + extra
        low_v = ant.centre_m[i] * 1e3 + np.min(table[:, i] - table[:, i + 2])
        high_v = ant.centre_m[i] * 1e3 + np.max(table[:, i] + table[:, i + 2])
        spans.append(np.array([-half, half, low_v - half, high_v + half]) / 1e3 + [0, 0, -MARGIN_M, MARGIN_M])
    # The path changes fastest at the edges of the kernel and in the nearest plane (heights count away from the radars).
    # It is examined at 9 x 9 kernel positions from edge to edge, in x and y.
    kernel_m = np.meshgrid(*(np.linspace(s[2] - FADE_M, s[3] + FADE_M, 9) for s in spans))
    wave = 2 * np.pi * top_hz / SPEED_OF_LIGHT_M_S
    nearest_z = ant.plane_z_m + min([0.0, *(p.height_mm for p in (*scene.plates, *scene.points))]) / 1e3
    axes = []
    for i, span in enumerate(spans):
        steepest = 0.0
        for rx in ant.rx_m:
            slope = np.zeros_like(kernel_m[0])
            for antenna in (ant.tx_m, rx):
                distances_m = np.stack([kernel_m[0] - antenna[0], kernel_m[1] - antenna[1]])
                slope += distances_m[i] / np.sqrt(
                    distances_m[0] ** 2 + distances_m[1] ** 2 + (nearest_z - antenna[2]) ** 2
                )
            steepest = max(steepest, wave * float(np.abs(slope).max()))
        # Nyquist's step, with a margin of a tenth and one for the spectrum of the fade-out (both chosen), at most 4 mm.
        step = min(np.pi / (1.1 * steepest + 6 * np.pi / FADE_M), 4e-3)
        axes.append(Axis(span[0], span[1], span[2], span[3], step))
    if axes[0].points * axes[1].points > MAX_KERNEL_POINTS:
        width_m, height_m = (axis.high_w - axis.low_w for axis in axes)
        raise ConfigError(
            f"scene {scene.name}: plates, points and grid extend over {width_m:.2f} x {height_m:.2f} m",
            "the simulation of such a field needs more memory than computers have",
            "move plates and points nearer to the image centre, or narrow the grid",
            code=ErrorCode.VALUES_CONFLICT,
        )
    return axes[0], axes[1]


def oversample(spectrum: NDArray[np.complex64], axis: Axis, along: int) -> NDArray[np.complex64]:
    """Return the inverse DFT along an axis on the finer output grid, limited to its offsets."""
    n = axis.points
    shape = list(spectrum.shape)
    shape[along] = n * OVERSAMPLING
    # Zeros between the positive and the negative frequencies make the output grid finer.
    padded = np.zeros(shape, dtype=np.complex64)
    head = (n + 1) // 2
    tail = n // 2
    lead = (slice(None),) * along
    padded[(*lead, slice(0, head))] = spectrum[(*lead, slice(0, head))]
    padded[(*lead, slice(-tail, None))] = spectrum[(*lead, slice(n - tail, n))]
    line = np.asarray(scipy.fft.ifft(padded, axis=along), dtype=np.complex64)
    line *= np.float32(OVERSAMPLING)
    return line[(*lead, slice(0, axis.outputs))]
