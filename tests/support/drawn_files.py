"""Write files as in the folders `labels` and `materials` of the paper's published data, with known materials.

Their images and pixels are no simulated scans: each pixel is drawn from the Fresnel reflection of its material, with
random errors of amplitude and phase.
"""

import json
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight_simulators.scene.optics import half_space

Complex = NDArray[np.complexfloating]
# Width and height of an image in pixels
IMAGE_PIXELS = 150
# Name of the metal reference
METAL = "copper"
# Amplitude of an image outside of the boxes; that of metal is 1.
BACKGROUND = 0.001


@dataclass(frozen=True)
class Material:
    """A material; without a permittivity it is metal."""

    name: str
    permittivity: complex | None
    thickness_mm: float | None = None

    def reflection(self, angle_deg: float) -> tuple[complex, complex]:
        """Return r_s and r_p."""
        if self.permittivity is None:
            return -1.0 + 0j, -1.0 + 0j
        r_s, r_p = half_space(self.permittivity, np.radians(angle_deg))
        return complex(r_s), complex(r_p)


@dataclass(frozen=True)
class Errors:
    """Errors of drawn pixels: standard deviations of the relative amplitude and of the phase, and the leakage.

    An error is the sum of two parts with half of the variance each: one that all pixels of a box share, and one that
    is drawn for each pixel. `leakage` is the amplitude of r_p in H and of r_s in V.
    """

    amplitude: float = 0.009
    phase_rad: float = 0.022
    leakage: float = 0.0


def draw_gain(rng: np.random.Generator) -> complex:
    """Draw the gain of a channel, which is the same for all pixels: an amplitude of 0.5 to 2 and any phase."""
    amplitude = rng.uniform(0.5, 2.0)
    return amplitude * np.exp(2j * np.pi * rng.uniform())


def draw_pixels(
    material: Material, angle_deg: float, n: int, errors: Errors, rng: np.random.Generator
) -> tuple[Complex, Complex]:
    """Draw H and V of n pixels of a box with a gain of 1, complex64 [n]."""
    r_s, r_p = material.reflection(angle_deg)

    def draw_error(std: float) -> NDArray[np.floating]:
        """Draw an error that all pixels share plus one for each pixel, both with half of the variance."""
        return std * np.sqrt(0.5) * (rng.standard_normal() + rng.standard_normal(n))

    channels = []
    for signal in (r_s + errors.leakage * r_p, r_p + errors.leakage * r_s):
        amplitude_error = draw_error(errors.amplitude)
        phase_error = draw_error(errors.phase_rad)
        # The published images are the complex conjugates of what a permittivity eps' - j eps'' gives.
        drawn = np.conj(signal * (1 + amplitude_error) * np.exp(1j * phase_error))
        channels.append(drawn.astype(np.complex64))
    return channels[0], channels[1]


def write_material(
    folder: Path, material: Material, angle_deg: float, scan: str, pixels: int, errors: Errors, seed: int
) -> Path:
    """Write pixels of a material and of its metal reference into `folder`/<name>_<angle>.pkl; return its path.

    If that file exists, a number is added to the name.
    """
    rng = np.random.default_rng(seed)
    gain_h = draw_gain(rng)
    gain_v = draw_gain(rng)
    # P, H and V of the material and of the metal
    values = []
    for medium in (material, Material(METAL, None)):
        h, v = draw_pixels(medium, angle_deg, pixels, errors, rng)
        h = (h * gain_h).astype(np.complex64)
        v = (v * gain_v).astype(np.complex64)
        values.append([h / v, h, v])
    content = {
        "name": material.name,
        "thickness": material.thickness_mm,
        "collection_name": scan,
        "incident_angle": round(angle_deg),
        "ref_name": METAL,
        "ref_thickness": 1.0,
        "values": values[0],
        "ref_values": values[1],
        "simulated": True,
    }
    folder.mkdir(parents=True, exist_ok=True)
    file_name = "".join(c if c.isalnum() or c in "-." else "-" for c in material.name).strip("-")
    path = folder / f"{file_name}_{angle_deg:.0f}.pkl"
    number = 1
    while path.exists():
        number += 1
        path = folder / f"{file_name}_{angle_deg:.0f}_{number}.pkl"
    path.write_bytes(pickle.dumps(content))
    return path


def write_labels(
    folder: Path,
    scan: str,
    boxes: Mapping[str, Sequence[int]],
    materials: Mapping[str, Material],
    angle_deg: float,
    errors: Errors,
    seed: int,
    upside_down: bool = False,
) -> Path:
    """Write `folder`/<scan> with sar_h.npy, sar_v.npy and <scan>.json; return the folder.

    Parameters
    ----------
    folder, scan
        Output folder, and name of the scan.
    boxes, materials
        Corners of each box in pixels by its name, [x0, y0, x1, y1] without x1 and y1 themselves; and its material.
    angle_deg, errors, seed
        Incidence angle, errors, and their seed.
    upside_down
        The first row of an image is that with the largest y.
    """
    rng = np.random.default_rng(seed)
    path = folder / scan
    path.mkdir(parents=True)
    shape = (IMAGE_PIXELS, IMAGE_PIXELS)
    # H and V
    images = [BACKGROUND * (rng.standard_normal(shape) + 1j * rng.standard_normal(shape)) for _ in range(2)]
    gains = [draw_gain(rng) for _ in range(2)]
    # A phase that both channels share, of one turn in 900 pixels along each axis: the scene is tilted by a tenth of a
    # degree.
    turns = np.arange(IMAGE_PIXELS) / 900.0
    tilt = np.exp(2j * np.pi * np.add.outer(turns, turns))
    for name, (x0, y0, x1, y1) in boxes.items():
        width = x1 - x0
        height = y1 - y0
        h, v = draw_pixels(materials[name], angle_deg, width * height, errors, rng)
        for image, pixels in zip(images, (h, v), strict=True):
            image[y0:y1, x0:x1] += pixels.reshape(height, width)
    for key, image, gain in zip(("sar_h", "sar_v"), images, gains, strict=True):
        full_image = (gain * image * tilt).astype(np.complex64)
        if upside_down:
            full_image = full_image[::-1]
        np.save(path / f"{key}.npy", full_image)
    content = {
        "description": f"simulated: {scan}, incidence {angle_deg:.0f} deg",
        "labels": {name: list(box) for name, box in boxes.items()},
        "sar_config": _sar_config(),
    }
    (path / f"{scan}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path


def _sar_config() -> dict[str, Any]:
    """Return the settings of a scan with the keys of the published files; the pixels are 2 mm wide."""
    focus = {"alignment_configs": {}, "sar_focuse_center": [0.0, 0.0, 0.0]}
    return {
        "numX": 350,
        "numY": 200,
        "dx": 2,
        "dy": 2,
        "output_size_x": 2 * IMAGE_PIXELS,
        "output_size_y": 2 * IMAGE_PIXELS,
        "chirp_configs": [],
        "ant_locs": {},
        "tx_idx": 1,
        "RH_config": focus,
        "RV_config": focus,
    }
