"""Synthetic images of plates in H and V: reflection by Eq. 2 of the paper, a gain between the channels, a limited band
with ringing at edges, uneven illumination and noise.

They are made without raw data; `tests/process` tests the whole chain from raw data.
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

# The paper's incidence angle.
THETA = np.radians(55.0)
# Nine plates with the permittivities eps' - j eps'' of the paper's Table 2; None is metal.
NINE_PLATES = {
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
class SyntheticScene:
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
        """Return the materials of the scene; `pair` replaces its images."""
        known_scene = KnownScene(segmentation, metal, plates=self.plates)
        # The images have neither leakage nor an error of the angle: a rig that was measured well.
        prior = RigPrior(theta_std_rad=1e-3, leakage_std=0.003, leakage_measured=True)
        return analyse(pair or self.pair, Optics(self.theta, prior), known_scene, classifier)


def smooth_field(rng, shape, correlation_px):
    """Return a random field of unit standard deviation that varies slowly over the plane."""
    field = ndimage.gaussian_filter(rng.standard_normal(shape), correlation_px, mode="wrap")
    return field / field.std()


def reflect(eps, theta):
    """Return r_s and r_p by Eq. 2 of the paper, independent of the code under test."""
    if eps is None:
        return -1.0, -1.0
    index = np.sqrt(eps)
    cos_in_air = np.cos(theta)
    # Snell's law: sin(theta) = index * sin(angle in the plate).
    cos_in_plate = np.sqrt(1 - np.sin(theta) ** 2 / eps)
    r_s = (cos_in_air - index * cos_in_plate) / (cos_in_air + index * cos_in_plate)
    r_p = (cos_in_plate - index * cos_in_air) / (cos_in_plate + index * cos_in_air)
    return r_s, r_p


def make(seed, materials=None, uneven=0.01, noise=0.006, gain_v=0.3 + 0.6j, theta=THETA):
    """Return an image pair of plates of 45 mm in random order on a 3 x 3 raster of 60 mm, each shifted by up to 5 mm.

    `uneven` is the relative scatter of the illumination, `noise` that of a pixel over metal's amplitude, `gain_v` the
    gain of V over H.
    """
    pixels = 150
    pixel_mm = 2.0
    rng = np.random.default_rng(seed)
    materials = NINE_PLATES if materials is None else materials
    # Both axes of the image, millimetres from its middle.
    axis_mm = (np.arange(pixels) - (pixels - 1) / 2) * pixel_mm

    # Reflection of every point of the plane: 0 between the plates.
    raster_mm = [((i % 3 - 1) * 60.0, (i // 3 - 1) * 60.0) for i in rng.permutation(9)]
    r_s = np.zeros((pixels, pixels), complex)
    r_p = np.zeros((pixels, pixels), complex)
    plates = []
    for (name, eps), (raster_x, raster_y) in zip(materials.items(), raster_mm, strict=False):
        centre_x = raster_x + rng.uniform(-5.0, 5.0)
        centre_y = raster_y + rng.uniform(-5.0, 5.0)
        half = 22.5
        box = (centre_x - half, centre_y - half, centre_x + half, centre_y + half)
        plates.append(TruthPlate(name, box, eps, metal=eps is None))
        inside = (abs(axis_mm[:, None] - centre_y) <= half) & (abs(axis_mm[None, :] - centre_x) <= half)
        r_s[inside], r_p[inside] = reflect(eps, theta)

    # A sharp limit f of the spatial frequencies, which rings at edges as images of a real aperture do. The response to
    # a point, sin(2 pi f x) / (2 pi f x), is 0.443 / f wide at half of its power: 3.6 mm along y, 5.4 mm along x.
    frequency = np.fft.fftfreq(pixels, pixel_mm)
    passed = (abs(frequency[:, None]) < 0.443 / 3.6) & (abs(frequency[None, :]) < 0.443 / 5.4)
    images = []
    for reflection, gain in ((r_s, 1.0), (gain_v * r_p, abs(gain_v))):
        parts = rng.standard_normal((2, pixels, pixels))
        white_noise = parts[0] + 1j * parts[1]
        noise_image = np.fft.ifft2(np.fft.fft2(white_noise) * passed)
        noise_rms = np.sqrt(np.mean(abs(noise_image) ** 2))
        noise_image *= noise * gain / noise_rms
        ln_amplitude = smooth_field(rng, reflection.shape, 20)
        phase_rad = smooth_field(rng, reflection.shape, 20)
        illumination = np.exp(uneven * (ln_amplitude + 1j * phase_rad))
        image = np.fft.ifft2(np.fft.fft2(reflection) * passed) * illumination
        images.append((image + noise_image).astype(np.complex64))

    # The distance of the plane is not known to a wavelength: a phase that both channels have in common.
    common_phase = np.complex64(np.exp(1j * rng.uniform(-3, 3)))
    axis_m = axis_mm / 1e3
    # The middle of the image lies at x = -13.2 mm and y = 100 mm.
    return SyntheticScene(
        h=images[0] * common_phase,
        v=images[1] * common_phase,
        x_m=axis_m - 0.0132,
        y_m=axis_m + 0.1,
        plates=tuple(plates),
        theta=theta,
    )


@pytest.fixture(scope="session")
def synthetic():
    """`synthetic(seed, ...)`: see `make`."""
    return make


@pytest.fixture(scope="session")
def analyse_placement():
    """`analyse_placement(seed, angle_deg)`: the materials of a placement of the nine, analysed once.

    Tests that need no library take seeds 1000 to 1005, which are analysed for `library` anyway.
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
    """A library of six placements, none of which is the scene of a test that uses the library."""
    return make_library(
        [
            TrainingScan(f"train-{s}", analyse_placement(s), simulated=True, versions={"made by": "test"})
            for s in range(1000, 1006)
        ],
        note="synthetic images",
    )
