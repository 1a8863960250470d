"""A folder of products (images, materials, settings, quality) as `polysight process` writes it, of a random image."""

from pathlib import Path

import numpy as np
import pytest
from tests.support.rigs import load_rig_table

from polysight.imaging import Images
from polysight.products import write_image, write_json

# Two patches (areas of one material) in materials.json, where they are called segments.
PATCH = {
    "label": 4, "name": "PET", "confidence": 0.75, "votes": {"PET": 0.75, "glass": 0.2, "unknown": 0.05},
    "metal_reference": False, "metal_like": False, "box_mm": [-30.0, -40.0, 50.0, 40.0], "outline_mm": [],
    "pixels": 99, "interior_pixels": 77, "incidence_deg": 54.5, "ratio": {"real": 0.0, "imag": 10.0},
    "inverse_ratio_std": 0.004, "permittivity": {"real": 3.5, "imag": -0.25, "real_std": 0.0625, "imag_std": 0.125},
    "truth": None,
}  # fmt: skip
METAL = {**PATCH, "label": 5, "name": None, "confidence": None, "votes": {}, "metal_reference": True,
         "box_mm": [-100.0, -50.0, -80.0, 50.0], "ratio": None, "permittivity": None}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Products without raw data and without patches.npz, as somebody may receive them from another lab."""
    rng = np.random.default_rng(3)
    h, v = (rng.standard_normal((2, 6, 11)) + 1j * rng.standard_normal((2, 6, 11))).astype(np.complex64)
    products = tmp_path / "one"
    x = np.linspace(-0.1, 0.1, 11)
    y = np.linspace(0.05, 0.15, 6)
    write_image(products / "image.npz", Images(h, v, x, y, rng.uniform(size=h.shape) < 0.8, h / v))
    write_json(products / "materials.json", {"scan_id": "s", "simulated": True, "segments": [PATCH, METAL]})
    facts = {"scan_id": "s", "simulated": True, "versions": {"polysight": "0.1.0"}, "instrument": load_rig_table()}
    write_json(products / "scan.json", facts)
    boards = {"RH": {"positions": 9, "positions_masked": 2, "rows_recorded": [0, 1, 5]}}
    write_json(products / "quality.json", {"boards": boards})
    return products
