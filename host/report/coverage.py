"""Which positions of the scan hold data: one map a board, and in words."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure

from polysight.host.report.context import ReportContext
from polysight.shared.raster import RasterPlan

_COLOURS = ("#dfe5ec", "#882255")  # with data light, masked dark: told apart without colour
_INK, _MUTED, _STAMP = "#1b2330", "#5b6675", "#b3261e"


def masked_positions(ctx: ReportContext) -> dict[str, npt.NDArray[np.bool_]]:
    """Board to bool [row, column]: masked, or never recorded. Empty where the plan or the boards are not known."""
    boards = ctx.quality.get("boards")
    if ctx.plan is None or not isinstance(boards, dict):
        return {}
    return {name: _mask(board, ctx.plan) for name, board in boards.items() if "masked_columns" in board}


def _mask(board: dict[str, Any], plan: RasterPlan) -> npt.NDArray[np.bool_]:
    mask = np.zeros((plan.rows, plan.columns), np.bool_)
    for row, runs in board["masked_columns"].items():
        for start, stop in runs:
            mask[int(row), start:stop] = True
    recorded = {int(row) for row in board.get("rows_recorded", range(plan.rows))}
    mask[[row not in recorded for row in range(plan.rows)]] = True
    return mask


def coverage_sentence(masks: dict[str, npt.NDArray[np.bool_]]) -> str:
    """How many positions of each board are masked; "" where that is not known."""
    if not masks:
        return ""
    if not any(m.any() for m in masks.values()):
        return "Every position of every board has data."
    told = [f"{name} {int(m.sum())} of {m.size} ({m.mean():.2%})" for name, m in masks.items()]
    return f"Positions without data, left out of the images: {', '.join(told)}."


def coverage_figure(ctx: ReportContext, masks: dict[str, npt.NDArray[np.bool_]]) -> Figure:
    """A map of the stage's offsets for each board; axes in millimetres from the middle of the grid."""
    plan = ctx.plan
    if plan is None:
        raise ValueError("a map of positions needs the plan")
    width, height = plan.columns * plan.step_x_mm, plan.rows * plan.step_y_mm
    extent = (-width / 2, width / 2, -height / 2, height / 2)
    fig = Figure(figsize=(9.0, 0.9 + 4.2 * min(1.2, max(0.3, height / width))), dpi=130, layout="constrained")
    FigureCanvasAgg(fig)
    for ax, (name, mask) in zip(fig.subplots(1, len(masks), squeeze=False)[0], masks.items(), strict=True):
        ax.imshow(
            mask, origin="lower", extent=extent, cmap=ListedColormap(_COLOURS), vmin=0, vmax=1,
            interpolation="nearest", aspect="equal",
        )  # fmt: skip
        ax.set_title(f"{name}: {mask.mean():.2%} masked", loc="left", fontsize=10, color=_INK, fontweight="bold")
        ax.set_xlabel("stage offset x (mm)", fontsize=9, color=_MUTED)
        ax.set_ylabel("stage offset y (mm)", fontsize=9, color=_MUTED)
        ax.tick_params(labelsize=8, colors=_MUTED, length=3)
        if ctx.simulated:
            ax.text(
                1.0, 1.02, "SIMULATED", transform=ax.transAxes, ha="right", va="bottom", fontsize=8, color=_STAMP,
                fontweight="bold",
            )  # fmt: skip
    return fig
