"""PNG figures of products, drawn from the saved arrays."""

from __future__ import annotations

from pathlib import Path

from polysight.host.report import ReportContext, figures, write_atomically
from polysight.host.report.read import SavedProducts


def write_pngs(folder: Path, products: SavedProducts) -> list[Path]:
    """Amplitude (dB), phase (degrees) of H, V and P, and what is known of the materials, as PNG; returns the files."""
    context = ReportContext(
        title=products.scan_id,
        simulated=products.simulated is not False,
        x_m=products.x_m,
        y_m=products.y_m,
        h=products.h,
        v=products.v,
        p=products.p,
        valid=products.valid,
        metal_referenced=bool(products.materials),
        materials=products.segments,
    )
    paths = []
    for name, data in figures(context).items():
        paths.append(folder / f"{name}.png")
        write_atomically(paths[-1], data)
    return paths
