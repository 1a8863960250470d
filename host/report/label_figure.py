"""The image with the boxes that a person drew, and their names: `labels.png`."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.patches import Rectangle

from polysight.host.materials import Box
from polysight.host.products import SavedProducts
from polysight.host.report.context import ReportContext
from polysight.host.report.figures import draw_channel
from polysight.host.report.fonts import figure_label
from polysight.host.report.style import MapLabel, dress, name_legend, new_axes, png, shorten_labels, write_label
from polysight.host.report.tables import MUTED

_METAL, _OTHER = "#ff9e3d", "#ffffff"


def label_figure(products: SavedProducts, boxes_mm: Mapping[str, Box], metal: str | None) -> bytes:
    """PNG of |H| with boxes and names; the metal reference is drawn in another colour.

    Parameters
    ----------
    products
        Whose image is shown.
    boxes_mm
        Name to (x0, y0, x1, y1), millimetres from the image centre.
    metal
        Name of the metal reference; None without one.
    """
    context = ReportContext(
        title=products.scan_id, simulated=products.simulated is not False, x_m=products.x_m, y_m=products.y_m,
        h=products.h, v=products.v, p=products.p, valid=products.valid, metal_referenced=bool(products.materials),
        verdict=products.verdict,
    )  # fmt: skip
    fig, ax = new_axes(5.4, 4.8)
    shown, unit = draw_channel(ax, context, "amplitude_h")
    labels = []
    for number, (name, (x0, y0, x1, y1)) in enumerate(boxes_mm.items(), 1):
        colour = _METAL if name == metal else _OTHER
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor="#10141b", linewidth=3.0))
        ax.add_patch(Rectangle((x0, y0), x1 - x0, y1 - y0, fill=False, edgecolor=colour, linewidth=1.5))
        text, below = figure_label(name, f"box {number}"), "metal" if name == metal else ""
        written = f"{text}\n{below}" if below else text
        middle = write_label(ax, (x0 + x1) / 2, (y0 + y1) / 2, written, 8.5, on_dark=True)
        labels.append(MapLabel(middle, str(number), text, colour, below))
    dress(ax, "Amplitude H, and the boxes", context.simulated)
    bar = fig.colorbar(shown, ax=ax, fraction=0.046, pad=0.03)
    bar.set_label(unit, fontsize=8, color=MUTED)
    bar.ax.tick_params(labelsize=8, colors=MUTED, length=2)
    replaced = shorten_labels(fig, labels)
    if replaced:
        fig.set_figheight(4.9 + 0.17 * ((len(replaced) + 1) // 2))
        name_legend(fig, replaced)
    return png(fig)
