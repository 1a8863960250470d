"""Draws docs/images/demo.png from a demo's products: `python docs/images/draw_demo.py out/demo/scan/products`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke

from polysight.report import INK, MUTED, PALETTE, STAMP_COLOUR

# Title of each image to the levels at the ends of its colours; chosen by eye.
SHOWN_DB = {"H, s-polarised": (-35, 0), "V, p-polarised": (-35, 0), "P = H / V": (-3, 24)}
# Half the width of the part of each image that is shown.
REACH_MM = 98.0


def _loss(permittivity: dict[str, float]) -> str:
    """Return the loss of a permittivity in materials.json with its standard error, as text."""
    # Adding zero after rounding removes the sign of a negative zero.
    loss = round(-permittivity["imag"], 1) + 0.0
    return f"loss {loss:.1f} ± {permittivity['imag_std']:.1f}"


def draw(products: Path, to: Path) -> None:
    """Draw both channels and their ratio in dB, and each patch's name, with its relative permittivity."""
    image = np.load(products / "image.npz", allow_pickle=False)
    materials = json.loads((products / "materials.json").read_text(encoding="utf-8"))
    if not materials["simulated"]:
        raise SystemExit("this picture says that it is simulated")
    x, y = ((a - a.mean()) * 1e3 for a in (image["x_m"], image["y_m"]))
    fig = Figure(figsize=(16, 4.95), dpi=125, layout="constrained", facecolor="white")
    axes = fig.subplots(1, 4, width_ratios=(1, 1, 1, 1))
    for ax, (title, (low, high)), key in zip(axes[:3], SHOWN_DB.items(), "hvp", strict=True):
        with np.errstate(divide="ignore", invalid="ignore"):
            level = 20 * np.log10(np.abs(image[key]) / (1 if key == "p" else np.abs(image[key]).max()))
        seen = image["valid"]
        if key == "p":
            # Where H is dark, a ratio is noise; the level is chosen.
            seen = seen & (np.abs(image["h"]) > 0.1 * np.abs(image["h"]).max())
        shown = np.where(seen, level, np.nan)
        picture = ax.imshow(
            shown, origin="lower", extent=(x[0], x[-1], y[0], y[-1]), vmin=low, vmax=high, cmap="cividis"
        )  # fmt: skip
        bar = fig.colorbar(picture, ax=ax, location="bottom", shrink=0.8, pad=0.02, aspect=30)
        bar.ax.tick_params(labelsize=12, colors=MUTED, length=2)
        bar.set_label("dB", fontsize=12, color=MUTED)
        ax.set_title(title, fontsize=19, color=INK, fontweight="bold", loc="left")
        ax.set_facecolor("#d9dce3")
    names = sorted({part["name"] or "" for part in materials["segments"]})
    for part in materials["segments"]:
        colour = PALETTE[names.index(part["name"] or "")]
        axes[3].add_patch(Polygon(part["outline_mm"], facecolor=colour + "99", edgecolor=INK, linewidth=1.2))
        x0, y0, x1, y1 = part["box_mm"]
        # The name without the part in brackets, in two lines.
        name = (part["name"] or "metal").split(" (")[0].replace(" ", "\n", 1)
        eps = part["permittivity"]
        value = "reference" if eps is None else f"{eps['real']:.1f} ± {eps['real_std']:.1f}\n{_loss(eps)}"
        for text, size, up_mm in ((name, 14, 8), (value, 10.5, -13)):
            axes[3].text(
                (x0 + x1) / 2, (y0 + y1) / 2 + up_mm, text, ha="center", va="center", fontsize=size, color=INK,
                linespacing=0.95, path_effects=[withStroke(linewidth=3, foreground="white")],
            )  # fmt: skip
    axes[3].set_title("materials, permittivity", fontsize=19, color=INK, fontweight="bold", loc="left")
    axes[3].set_aspect("equal")
    for ax in axes:
        ax.set(xlim=(-REACH_MM, REACH_MM), ylim=(-REACH_MM, REACH_MM), xticks=[], yticks=[], anchor="N")
        ax.text(
            0.98, 0.02, "SIMULATED", transform=ax.transAxes, ha="right", va="bottom", fontsize=12, color=STAMP_COLOUR,
            fontweight="bold", path_effects=[withStroke(linewidth=3, foreground="white")],
        )  # fmt: skip
    # The scale: a line of 50 mm.
    axes[0].plot([-94, -44], [-95, -95], color="white", linewidth=3)
    axes[0].text(-69, -93, "50 mm", ha="center", va="bottom", fontsize=12, color="white")
    fig.savefig(to)


if __name__ == "__main__":
    draw(Path(sys.argv[1]), Path(__file__).with_name("demo.png"))
