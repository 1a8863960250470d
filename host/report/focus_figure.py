"""The figure of `polysight focus`: a sweep over depth, and the image before and after."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from polysight.host.report.style import axis_mm, png
from polysight.host.report.tables import INK, MUTED, STAMP

_RANGE_DB = 30.0


def focus_figure(
    sweep: dict[str, Any],
    before: npt.NDArray[np.complexfloating],
    after: npt.NDArray[np.complexfloating],
    x_m: npt.NDArray[np.float64],
    y_m: npt.NDArray[np.float64],
    simulated: bool,
) -> bytes:
    """PNG of a sweep (`depths_mm`, `sharpness`, `depth_mm`, `tilt_deg`, `certain`) and of H before and after."""
    fig = Figure(figsize=(13.0, 4.2), dpi=140, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    curve, *pictures = fig.subplots(1, 3, width_ratios=[1.1, 1, 1])
    curve.plot(sweep["depths_mm"], sweep["sharpness"], "o-", color="#44AA99", markersize=4)
    curve.axvline(0, color=MUTED, linewidth=1, linestyle=":", label="rig file")
    curve.axvline(sweep["depth_mm"], color="#882255", linewidth=1.4, label=f"found: {sweep['depth_mm']:+.2f} mm")
    curve.set_xlabel("plane, relative to the rig file (mm)", fontsize=9, color=MUTED)
    curve.set_ylabel("sharpness of the untilted plane", fontsize=9, color=MUTED)
    tilt = sweep["tilt_deg"]
    told = f"Tilt found: {tilt[0]:+.2f}° in x, {tilt[1]:+.2f}° in y" if sweep["certain"] else "Too flat to tell"
    curve.set_title(told, loc="left", fontsize=10, color=INK)
    curve.legend(fontsize=8, frameon=False)
    top = max(float(np.abs(before).max()), float(np.abs(after).max()), 1e-30)
    x, y = axis_mm(x_m), axis_mm(y_m)
    for ax, image, title in zip(
        pictures, (before, after), ("H on the rig file's plane", "H on the found plane"), strict=True
    ):
        level = 20 * np.log10(np.maximum(np.abs(image) / top, 1e-6))
        shown = ax.pcolormesh(x, y, level, cmap="cividis", vmin=-_RANGE_DB, vmax=0, shading="nearest", rasterized=True)
        ax.set_title(title, loc="left", fontsize=10, color=INK)
        ax.set_aspect("equal")
        ax.set_xlabel("x (mm)", fontsize=9, color=MUTED)
        fig.colorbar(shown, ax=ax, fraction=0.046, pad=0.03).set_label("dB", fontsize=8, color=MUTED)
    if simulated:
        fig.suptitle("SIMULATED", fontsize=9, color=STAMP, fontweight="bold", x=0.99, ha="right")
    return png(fig)
