"""Pixels of patches as the rig would give them: Fresnel at Table 2's permittivities, with errors.

The reflection of material m seen in scan i, pixel k, divided by the scan's metal reference, is in each channel

    r_m (1 + a) exp(j b) / ((1 + a_ref) exp(j b_ref)).

a (speckle, gain over the plane) and b (synchronisation) are normal, independent in H and V. Half of their variance is
one draw for a whole patch (its placement), half is drawn for each pixel; the reference, a mean over many pixels, has
the first half alone and is shared by all patches of a scan. The standard deviation of b is the paper's residual phase
of synchronisation. That of a is not in the paper: it is set, for each group of materials, so that the paper's KNN on
|H| alone, judged by the paper's split by pixel, reaches the published accuracy of H alone. Nothing else is set.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import numpy.typing as npt
import scipy

from polysight.materials import PAPER, Entry, Library, Samples, feature_matrix, score
from polysight.polarimetry import fresnel
from polysight_papers.sensys2026.table2 import Published, published, table2

Complex = npt.NDArray[np.complex128]
SCANS, PIXELS = 8, 12
"""Placements of Fig. 17; with 12 pixels each a material has 96, the paper's "about 80 to 120"."""


@dataclass(frozen=True)
class Group:
    """Materials of one classification task, and the incidence angle in the paper."""

    name: str
    materials: tuple[Published, ...]
    angle_deg: float


def groups() -> dict[str, Group]:
    """Solids at 60 degrees, liquids at 55, powders at 60: rows 1 to 23, 24 to 32 and 33 to 36 of Table 2.

    The paper counts eight liquids; its table has nine, all of which are used here.
    """
    rows = table2()
    return {g.name: g for g in (
        Group("solids", rows[:23], 60.0), Group("liquids", rows[23:32], 55.0), Group("powders", rows[32:], 60.0),
    )}  # fmt: skip


@dataclass(frozen=True)
class Errors:
    """Relative amplitude error and phase error of a pixel, and the share of their variance common to a patch.

    `spread`: relative standard deviations of real part and loss between specimens; each scan has its own.
    """

    amplitude: float
    phase_rad: float
    shared: float = 0.5
    spread: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Pixels:
    """Metal-referenced pixels; `h` and `v` complex [scans, materials, pixels]."""

    materials: tuple[Published, ...]
    angle_deg: float
    h: Complex
    v: Complex

    def samples(self) -> Samples:
        """Return the pixels as samples for classifiers; a scan is a group."""
        scan, material, _ = np.indices(self.h.shape)
        names = np.array([m.name for m in self.materials])
        return Samples(
            feature_matrix(self.h, self.v, self.h / self.v).reshape(-1, 4),
            names[material.ravel()],
            np.array([f"scan {i + 1}" for i in scan.ravel()]),
            (scan * len(self.materials) + material).ravel(),
            np.array([f"specimen {i + 1}" for i in scan.ravel()]),
            (self.angle_deg,),
        )

    def library(self) -> Library:
        """Return a library with one entry for each patch."""
        entries = [
            Entry(
                name=m.name,
                scan=f"scan {i + 1}",
                h=np.abs(self.h[i, j]).astype(np.float32),
                v=np.abs(self.v[i, j]).astype(np.float32),
                p=(self.h[i, j] / self.v[i, j]).astype(np.complex64),
                incidence_deg=self.angle_deg,
                simulated=True,
                thickness_mm=m.thickness_mm,
                permittivity=(m.permittivity.real, -m.permittivity.imag),
                specimen=f"specimen {i + 1}",
            )
            for i in range(self.h.shape[0])
            for j, m in enumerate(self.materials)
        ]
        return Library(tuple(entries), {}, "simulated pixels of patches")


def specimens(materials: tuple[Published, ...], spread: tuple[float, float], z: npt.NDArray[np.float64]) -> Complex:
    """Return permittivities at z [2, ..., materials] standard deviations (real part normal, loss log-normal)."""
    eps = np.array([m.permittivity for m in materials], np.complex128)
    width = np.sqrt(np.log1p(spread[1] ** 2))
    real = np.maximum(eps.real * (1 + spread[0] * z[0]), 1.0)
    return np.asarray(real + 1j * eps.imag * np.exp(width * z[1] - width**2 / 2), np.complex128)


def draw(
    materials: tuple[Published, ...],
    angle_deg: float,
    errors: Errors,
    seed: int,
    scans: int = SCANS,
    pixels: int = PIXELS,
) -> Pixels:
    """Draw pixels of every material in every scan; the same seed gives the same errors up to their size."""
    rng = np.random.default_rng([seed, round(angle_deg * 100)])
    own, common = np.sqrt(1 - errors.shared), np.sqrt(errors.shared)

    def channel(r: Complex) -> Complex:
        one = (scans, len(materials), 1)
        parts = []
        for std in (errors.amplitude, errors.phase_rad):
            patch = common * rng.standard_normal(one) + own * rng.standard_normal((*one[:2], pixels))
            parts.append((std * patch, std * common * rng.standard_normal((scans, 1, 1))))
        (a, a_ref), (b, b_ref) = parts
        return np.broadcast_to(r, one[:2])[..., None] * (1 + a) / (1 + a_ref) * np.exp(1j * (b - b_ref))

    own_rng = np.random.default_rng([seed, 1])  # the same specimens under every angle
    eps = specimens(materials, errors.spread, own_rng.standard_normal((2, scans, len(materials))))
    r_s, r_p = fresnel(eps, np.radians(angle_deg))
    return Pixels(materials, angle_deg, channel(-r_s), channel(-r_p))


def h_accuracy(group: Group, errors: Errors, seeds: tuple[int, ...]) -> float:
    """Return the share of pixels that the paper's KNN names right from |H| alone, split by pixel, mean over draws."""
    drawn = (draw(group.materials, group.angle_deg, errors, seed).samples() for seed in seeds)
    return float(np.mean([score(s, PAPER, "H", by_pixel=True).pixels for s in drawn]))


@cache
def calibrated_errors(group_name: str, draws: int = 3, shared: float = 0.5) -> Errors:
    """Return the errors with which |H| alone has the published accuracy; V and P are not used.

    Bisection over the logarithm of the amplitude error, on draws that no result is made from.
    """
    group, target = groups()[group_name], published()["classification"][group_name]["h_percent"] / 100
    seeds = tuple(range(1000, 1000 + draws))
    start = Errors(0.0, published()["phase_std_rad"], shared)

    def excess(log_amplitude: float) -> float:
        return h_accuracy(group, replace(start, amplitude=float(np.exp(log_amplitude))), seeds) - target

    at = scipy.optimize.root_scalar(excess, bracket=(np.log(1e-4), np.log(0.3)), method="bisect", xtol=0.01)
    return replace(start, amplitude=float(np.exp(at.root)))
