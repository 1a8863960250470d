"""Made-up products of a scan with a verdict, and reports without rendered figures.

The scan has three patches: the metal reference, PET with a name and a permittivity, and one that was refused as noise.
"""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from polysight.imaging import Images
from polysight.products import SCAN, ProcessedScan, read_products, write_image, write_json
from polysight.products.processed import ComputedContent
from polysight.results import ScanFacts, ScanMaterials, ScanQuality
from polysight_shared.config import CheckPlate

NAMES = ("PET", "acrylic", "copper")
REASON = {"what": "no metal reference", "why": "it is the only patch", "do": "lay a metal plate into the scene"}
BUDGET = {
    "leakage": {"h": [0.01, -0.02], "v": [0.0, 0.03], "std": [0.02, 0.02], "source": "scene"},
    "incidence": {"deg": 54.6, "std_deg": 0.12},
    "plane": {"known": True, "offset_mm": 2.4, "offset_std_mm": 0.3, "tilt_deg": [0.2, -0.1],
              "by": "phase", "plates": 3},
    "metal": {"score": 12.5, "others": 2, "channel_ratio_db": 0.4},
}  # fmt: skip
COMMON: dict[str, Any] = {
    "outline_mm": [], "pixels": 90, "interior_pixels": 60, "incidence_deg": 54.6, "metal_like": False, "votes": {},
    "name": None, "confidence": None, "permittivity": None, "ratio": None, "truth": None, "refused": None,
    "metal_reference": False, "inverse_ratio_std": 0.01,
}  # fmt: skip
PERMITTIVITY = {
    "real": 2.9, "imag": -0.2, "real_std": 0.2, "imag_std": 0.1, "covariance": [[0.04, 0.012], [0.012, 0.01]],
    "real_p30_p70": [2.8, 3.0], "imag_p30_p70": [-0.25, -0.15], "dominated_by": "leakage",
    "shares": {"noise": 0.1, "metal reference": 0.1, "leakage": 0.6, "incidence": 0.1, "brightness": 0.1},
    "do": "measure leakage with metal strips (polysight leakage)",
}  # fmt: skip
# Keys that files of earlier releases do not have.
_NEW_KEYS = ("covariance", "dominated_by", "shares", "do")


def make_segments(level: str | None) -> list[dict[str, Any]]:
    """Return the three patches as they are in materials.json with a verdict of this level.

    With the level `none` they have no results. Without a level (None) they are as earlier releases wrote them, which
    had no verdicts.
    """
    metal = {**COMMON, "label": 1, "box_mm": [-50.0, -20.0, -20.0, 20.0], "metal_reference": True}
    pet = {
        **COMMON, "label": 2, "box_mm": [-10.0, -20.0, 15.0, 20.0], "name": "PET", "confidence": 0.8,
        "votes": {"PET": 0.8, "acrylic": 0.2}, "ratio": {"real": 3.0, "imag": 0.4}, "permittivity": PERMITTIVITY,
        "truth": {"name": "acrylic", "metal": False, "permittivity": {"real": 3.0, "imag": -0.3}},
    }  # fmt: skip
    noise = {**COMMON, "label": 3, "box_mm": [25.0, -20.0, 50.0, 20.0]}
    noise["refused"] = {"what": "noise", "why": "its pixels do not agree", "do": "look at the image"}
    segments = [metal, pet, noise]
    if level is None:
        pet["permittivity"] = {key: value for key, value in PERMITTIVITY.items() if key not in _NEW_KEYS}
        for segment in segments:
            segment.pop("refused")
    elif level == "none":
        no_results = {"name": None, "confidence": None, "permittivity": None, "ratio": None, "votes": {}, "truth": None}
        for segment in segments:
            segment.update(no_results)
    return segments


def write_judged_products(folder: Path, level: str | None, keep_withheld: bool = False, seed: int = 2) -> Path:
    """Write products with a verdict of this level (see `make_segments`); the images are noise drawn with this seed.

    With `keep_withheld` the files have names and permittivities although the verdict withholds them, as if a program
    had forgotten to remove them. Pages and figures must not show them.
    """
    rng = np.random.default_rng(seed)
    h, v = (rng.standard_normal((2, 20, 30)) + 1j * rng.standard_normal((2, 20, 30))).astype(np.complex64)
    p_sigma = None if level is None else rng.uniform(0.1, 0.2, h.shape)
    images = Images(
        h=h, v=v, x_m=np.linspace(-0.06, 0.06, 30), y_m=np.linspace(-0.04, 0.04, 20), valid=np.ones(h.shape, bool),
        p=h / v, p_sigma=p_sigma,
    )  # fmt: skip
    write_image(folder / "image.npz", images)
    content: dict[str, Any] = {
        "scan_id": "s",
        "simulated": True,
        "segments": make_segments("good" if keep_withheld else level),
    }
    quality: dict[str, Any] = {}
    if level is not None:
        quality["verdict"] = {"level": level, "reasons": [] if level == "good" else [REASON]}
        content |= {"verdict": quality["verdict"], "error_budget": BUDGET}
    write_json(folder / "materials.json", content)
    write_json(folder / "quality.json", quality)
    write_json(folder / "scan.json", {"scan_id": "s", "simulated": True})
    return folder


def name_check_plate(products: Path, plate: CheckPlate) -> None:
    """Change saved products as if the file of their rig had named this check plate."""
    facts = read_products(products).facts
    rig = {**facts.instrument, "check": msgspec.to_builtins(plate)}
    write_json(products / SCAN, msgspec.structs.replace(facts, instrument=rig))


def make_result(images: Images, content: dict[str, Any] | None, quality: dict[str, Any], **more: Any) -> ProcessedScan:
    """Return the results of a processed scan that are not saved, with the contents of materials.json and quality.json.

    Without materials (None) there are only images.
    """
    results: dict[str, Any] = {"facts": ScanFacts(scan_id="s", simulated=True), "plates": (), **more}
    materials = None if content is None else ScanMaterials.decode(content)
    return ProcessedScan.from_results(
        Path(), images=images, materials=materials, quality=ScanQuality.decode(quality), **results
    )


def replace_results(scan: ProcessedScan, **content: Any) -> ProcessedScan:
    """Return the same results with other values for the parts named in `content`."""
    results = {name: value for name, value in vars(scan).items() if name in ComputedContent.__annotations__}
    return ProcessedScan.from_results(scan.folder, **{**results, **content})


def _encode_chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


# The header of a PNG of one grey pixel: width, height and bits of a pixel; colour type, compression, filter and
# interlace are 0.
_PNG_HEADER = struct.pack(">IIBBBBB", 1, 1, 8, 0, 0, 0, 0)
# The filter of the only line, and its only pixel
_PNG_LINE = b"\0\0"
PIXEL = (
    b"\x89PNG\r\n\x1a\n"
    + _encode_chunk(b"IHDR", _PNG_HEADER)
    + _encode_chunk(b"IDAT", zlib.compress(_PNG_LINE))
    + _encode_chunk(b"IEND", b"")
)


@contextmanager
def skip_rendering() -> Iterator[None]:
    """Save every figure as one pixel: rendering takes seconds per report, and tests/report covers it."""

    def save(_: FigureCanvasAgg, file: BinaryIO, **_options: Any) -> None:
        file.write(PIXEL)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FigureCanvasAgg, "print_png", save)
        patch.setattr(Figure, "draw_without_rendering", lambda _: None)
        yield
