"""Synthetic image pairs of plates: Fresnel, leakage, gains, band limit with ringing, uneven illumination, noise.

Used only by these tests; the whole chain from raw data is tested elsewhere.
"""

import functools
from dataclasses import dataclass

import numpy as np
import pytest
from scipy import ndimage

from polysight.imaging import Images
from polysight.materials import Classifier, Library, MaterialsResult, TrainingScan, TruthPlate, make_library
from polysight.materials.analyse import KnownScene, Optics, analyse
from polysight.materials.inversion import RigPrior

# The paper's incidence angle, and its Table 2 (eps' - j eps''; None is metal).
THETA = np.radians(55.0)
NINE = {
    "rubber": 5.06 - 1.11j,
    "cardboard (rough)": 4.54 - 0.56j,
    "silicone rubber": 3.52 - 0.82j,
    "PET 0.5 mm": 3.78 - 0.70j,
    "ceramic": 4.75 - 2.43j,
    "acrylic 3 mm": 4.00 - 0.40j,
    "glass fibre": 4.69 - 0.70j,
    "copper": None,
    "wood (thin)": 2.61 - 0.01j,
}


@dataclass
class Synthetic:
    """An image pair, complex64 [ny, nx], with its axes and the plates in it."""

    h: np.ndarray
    v: np.ndarray
    x_m: np.ndarray
    y_m: np.ndarray
    plates: tuple[TruthPlate, ...]
    theta: float = THETA

    @property
    def pair(self):
        return Images(self.h, self.v, self.x_m, self.y_m, np.ones(self.h.shape, bool))

    def analyse(self, metal=None, segmentation=None, classifier=None, pair=None):
        known_scene = KnownScene(segmentation, metal, plates=self.plates)
        prior = RigPrior(1e-3, leakage_std=0.003, leakage_measured=True)
        return analyse(pair or self.pair, Optics(self.theta, prior), known_scene, classifier)


def smooth_field(rng, shape, correlation_px):
    """Random field of unit rms that varies slowly over the plane."""
    field = ndimage.gaussian_filter(rng.standard_normal(shape), correlation_px, mode="wrap")
    return field / field.std()


def reflect(eps, theta):
    """r_s and r_p by Eq. 2, independent of the code under test."""
    if eps is None:
        return -1.0, -1.0
    n = np.sqrt(eps)
    c = np.cos(theta)
    ct = np.sqrt(1 - np.sin(theta) ** 2 / eps)
    return (c - n * ct) / (c + n * ct), (ct - n * c) / (ct + n * c)


def make(seed, materials=None, uneven=0.01, noise=0.006, gain_v=0.3 + 0.6j, theta=THETA):
    """Return an image pair of plates of 45 mm in random order on a 3 x 3 raster of 60 mm, each shifted by up to 5 mm.

    `uneven` is the relative scatter of the illumination, `noise` that of a pixel over metal's amplitude, `gain_v` the
    gain of V over H.
    """
    pixels = 150
    pixel_mm = 2.0
    rng = np.random.default_rng(seed)
    materials = NINE if materials is None else materials
    x = (np.arange(pixels) - (pixels - 1) / 2) * pixel_mm
    places = [((i % 3 - 1) * 60.0, (i // 3 - 1) * 60.0) for i in rng.permutation(9)]
    s = np.zeros((pixels, pixels), complex)
    p = np.zeros((pixels, pixels), complex)
    plates = []
    for (name, eps), (cx, cy) in zip(materials.items(), places, strict=False):
        cx = cx + rng.uniform(-5.0, 5.0)
        cy = cy + rng.uniform(-5.0, 5.0)
        half = 22.5
        plates.append(TruthPlate(name, (cx - half, cy - half, cx + half, cy + half), eps, metal=eps is None))
        inside = (abs(x[:, None] - cy) <= half) & (abs(x[None, :] - cx) <= half)
        s[inside], p[inside] = reflect(eps, theta)
    frequency = np.fft.fftfreq(pixels, pixel_mm)
    passed = (abs(frequency[:, None]) < 0.443 / 3.6) & (abs(frequency[None, :]) < 0.443 / 5.4)
    out = []
    for channel, gain in ((s, 1.0), (gain_v * p, abs(gain_v))):
        n = rng.standard_normal((2, pixels, pixels))
        n = np.fft.ifft2(np.fft.fft2(n[0] + 1j * n[1]) * passed)
        n *= noise * gain / np.sqrt(np.mean(abs(n) ** 2)) if noise else 0.0
        light = np.exp(uneven * (smooth_field(rng, channel.shape, 20) + 1j * smooth_field(rng, channel.shape, 20)))
        out.append((np.fft.ifft2(np.fft.fft2(channel) * passed) * light + n).astype(np.complex64))
    common = np.exp(1j * rng.uniform(-3, 3))
    axis = x / 1e3
    phase = np.complex64(common)
    return Synthetic(out[0] * phase, out[1] * phase, axis - 0.0132, axis + 0.1, tuple(plates), theta)


@pytest.fixture(scope="session")
def synthetic():
    """`synthetic(seed, ...)`: see `make`."""
    return make


@pytest.fixture(scope="session")
def analyse_placement():
    """`analyse_placement(seed, angle_deg)`: the materials of a placement of the nine, analysed once.

    Seeds 1000 to 1005 are those of `library`: tests without a library take them.
    """

    @functools.cache
    def find(seed: int, angle_deg: float = 55.0) -> MaterialsResult:
        return make(seed, theta=np.radians(angle_deg)).analyse()

    return find


@pytest.fixture(scope="session")
def name_placement(library):
    """`name_placement(seed)`: the materials of a placement of the nine, named by the library, analysed once."""

    @functools.cache
    def find(seed: int) -> MaterialsResult:
        return make(seed).analyse(classifier=Classifier(library))

    return find


@pytest.fixture(scope="session")
def library(analyse_placement) -> Library:
    """Six placements that differ from all test scenes."""
    return make_library(
        [TrainingScan(f"train-{s}", analyse_placement(s), True, {"made by": "test"}) for s in range(1000, 1006)],
        note="synthetic images",
    )
