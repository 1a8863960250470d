"""Figures for notebooks: a processed scan, the check plates of many."""

from __future__ import annotations

import io
from collections.abc import Sequence

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from polysight.jobs.scans import CHART_IN, DOTS_PER_INCH, draw_control_chart
from polysight.products import ProcessedScan
from polysight.report import draw_overview, figure_label, font_families
from polysight.results import CheckResult

# Width of a picture, in inches as all sizes here, which were chosen by eye.
_PANEL_IN = 3.8
# Width of a colour bar and of the axis of the next picture.
_BETWEEN_IN = 1.2
# Height of a picture's title and axis.
_TITLE_IN = 0.4
# Height of the title of the whole figure.
_HEAD_IN = 0.5


class NotebookFigure(Figure):
    """A figure that notebooks show once, as the value of a cell, with or without matplotlib's inline backend."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png")
        return buffer.getvalue()


def plot_scan(scan: ProcessedScan) -> Figure:
    """Draw the amplitudes of H, V and P = H / V in dB, and the materials if the images are relative to metal."""
    rows = 1
    columns = 3
    if scan.metal_referenced:
        # The materials are the fourth picture.
        rows = 2
        columns = 2
    # A picture is at least 0.4 and at most 2 times as high as wide (chosen by eye), also for a long narrow image.
    height_over_width = scan.labels.shape[0] / scan.labels.shape[1]
    height_in = _PANEL_IN * min(2.0, max(0.4, height_over_width))
    size = (columns * (_PANEL_IN + _BETWEEN_IN), rows * (height_in + _TITLE_IN) + _HEAD_IN)
    fig = NotebookFigure(figsize=size, dpi=100, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    draw_overview(fig, list(fig.subplots(rows, columns).flat), scan, bar_labels=True)
    stamp = {True: " (simulated)", False: "", None: " (not known whether simulated)"}[scan.simulated]
    title = figure_label(f"Scan {scan.scan_id}{stamp}", "title")
    fig.suptitle(title, fontsize=12, family=list(font_families()), parse_math=False)
    return fig


def plot_control_chart(checked_scans: Sequence[tuple[ProcessedScan, CheckResult]]) -> Figure:
    """Draw the control chart of the check plates of scans."""
    fig = NotebookFigure(figsize=CHART_IN, dpi=DOTS_PER_INCH, layout="constrained")
    FigureCanvasAgg(fig)
    draw_control_chart(fig, checked_scans)
    return fig
