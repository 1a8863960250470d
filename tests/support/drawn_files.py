"""Write `labels/` and `materials/` files of the published data set with known truth.

Their images and pixels are random, not simulated scans: Fresnel reflection of each box with speckle and phase errors.
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
# Pixels of each side of an image.
PIXELS = 150
METAL = "copper"


@dataclass(frozen=True)
class Material:
    """A material of drawn files; without permittivity it is metal."""

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
    """Errors of a drawn pixel: relative amplitude and phase (rad); half of the variance is common to a box.

    `leakage` is the amplitude of p in H and of s in V.
    """

    amplitude: float = 0.009
    phase_rad: float = 0.022
    leakage: float = 0.0


def draw_pixels(
    material: Material, angle_deg: float, n: int, errors: Errors, rng: np.random.Generator
) -> tuple[Complex, Complex]:
    """Draw H and V of n pixels of a box, complex64 [n], with unit gain."""
    r_s, r_p = material.reflection(angle_deg)

    def draw_error(std: float) -> NDArray[np.floating]:
        """Draw errors of which half of the variance is common to the pixels."""
        return std * np.sqrt(0.5) * (rng.standard_normal() + rng.standard_normal(n))

    channels = []
    for signal in (r_s + errors.leakage * r_p, r_p + errors.leakage * r_s):
        amplitude_error = draw_error(errors.amplitude)
        phase_error = draw_error(errors.phase_rad)
        # The published images are conjugate to a reflection with losses of -j eps''.
        drawn = np.conj(signal * (1 + amplitude_error) * np.exp(1j * phase_error))
        channels.append(drawn.astype(np.complex64))
    return channels[0], channels[1]


def write_material(
    folder: Path, material: Material, angle_deg: float, scan: str, pixels: int, errors: Errors, seed: int
) -> Path:
    """Write `folder`/<name>_<angle>.pkl with its own metal reference; further files are numbered."""
    rng = np.random.default_rng(seed)
    gain_h = rng.uniform(0.5, 2.0) * np.exp(2j * np.pi * rng.uniform())
    gain_v = rng.uniform(0.5, 2.0) * np.exp(2j * np.pi * rng.uniform())
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
    safe = "".join(c if c.isalnum() or c in "-." else "-" for c in material.name).strip("-")
    path = folder / f"{safe}_{angle_deg:.0f}.pkl"
    for number in range(2, 1000):
        if not path.exists():
            break
        path = folder / f"{safe}_{angle_deg:.0f}_{number}.pkl"
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
        Name to pixel corners [x0, y0, x1, y1] (half-open), and name to material.
    angle_deg, errors, seed
        Incidence angle, errors, and their seed.
    upside_down
        The images' rows run opposite to the boxes' y.
    """
    rng = np.random.default_rng(seed)
    path = folder / scan
    path.mkdir(parents=True)
    images = [
        0.001 * (rng.standard_normal((PIXELS, PIXELS)) + 1j * rng.standard_normal((PIXELS, PIXELS))) for _ in "hv"
    ]
    gains = [rng.uniform(0.5, 2.0) * np.exp(2j * np.pi * rng.uniform()) for _ in "hv"]
    # A phase common to both channels: the scene is tilted by a tenth of a degree.
    distance = np.exp(2j * np.pi * np.add.outer(*2 * [np.arange(PIXELS) / 900.0]))
    for name, (x0, y0, x1, y1) in boxes.items():
        h, v = draw_pixels(materials[name], angle_deg, (x1 - x0) * (y1 - y0), errors, rng)
        for image, pixels in zip(images, (h, v), strict=True):
            image[y0:y1, x0:x1] += pixels.reshape(y1 - y0, x1 - x0)
    for key, image, gain in zip(("sar_h", "sar_v"), images, gains, strict=True):
        full_image = (gain * image * distance).astype(np.complex64)
        np.save(path / f"{key}.npy", full_image[::-1] if upside_down else full_image)
    content = {
        "description": f"simulated: {scan}, incidence {angle_deg:.0f} deg",
        "labels": {name: list(box) for name, box in boxes.items()},
        "sar_config": _sar_config(),
    }
    (path / f"{scan}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path


def _sar_config() -> dict[str, Any]:
    """Return the keys of the published files."""
    focus = {"alignment_configs": {}, "sar_focuse_center": [0.0, 0.0, 0.0]}
    return {
        "numX": 350,
        "numY": 200,
        "dx": 2,
        "dy": 2,
        "output_size_x": 2 * PIXELS,
        "output_size_y": 2 * PIXELS,
        "chirp_configs": [],
        "ant_locs": {},
        "tx_idx": 1,
        "RH_config": focus,
        "RV_config": focus,
    }
