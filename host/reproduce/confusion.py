"""Confusion matrices side by side, materials in the order and with the numbers of Table 2, as the paper's Fig. 18."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import fill

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from polysight.host.materials import Published
from polysight.host.materials.judge import Score
from polysight.host.report.figures import INK
from polysight.host.reproduce.item import dress, new_figure

Panel = tuple[Score, npt.NDArray[np.float64], str]


def confusion_figure(materials: Sequence[Published], panels: Sequence[Panel]) -> Figure:
    """One panel for each score and matrix, with its title."""
    n = len(materials)
    many = n > 12
    fig = new_figure(11.5, 11.0 if many else 4.5)
    size = 7.5 if many else 8.0
    axes = (fig.subplots(2, 2) if many else fig.subplots(1, len(panels), squeeze=False)).ravel()
    if many:
        axes[3].set_axis_off()
        axes[3].text(0.02, 0.98, _confused(panels[1:]), va="top", fontsize=9, color=INK, linespacing=1.5)
    shown = None
    for ax, (found, table, title) in zip(axes[: len(panels)], panels, strict=True):
        order = [found.names.index(m.name) for m in materials]
        shares = table[np.ix_(order, order)]
        shown = ax.imshow(100 * shares, cmap="cividis", vmin=0, vmax=100, interpolation="nearest")
        first = ax in (axes[0], axes[2] if many else axes[0])
        lines = [fill(line, 60 if many else 36) for line in title.splitlines()]
        dress(ax, "\n".join(lines), "named", "true" if first else "")
        ax.title.set_fontsize(9.5)
        ax.grid(visible=False)
        ax.set_xticks(range(n), [str(m.number) for m in materials], fontsize=size)
        ax.set_yticks(range(n), [f"{m.name}  {m.number}" if first else str(m.number) for m in materials], fontsize=size)
        for i, j in zip(*np.nonzero(shares > 0.005), strict=True):
            colour = INK if shares[i, j] > 0.6 else "w"
            text = f"{100 * shares[i, j]:.0f}"
            ax.text(j, i, text, ha="center", va="center", fontsize=size - 1.5, color=colour)
    if shown is not None:
        bar = fig.colorbar(shown, ax=list(axes), fraction=0.02, pad=0.01)
        bar.set_label("% of pixels", fontsize=8)
        bar.ax.tick_params(labelsize=7)
    return fig


def _confused(panels: Sequence[Panel], shown: int = 5) -> str:
    """The largest confusions of each panel."""
    lines = []
    for found, table, title in panels:
        apart = table * (1 - np.eye(len(table)))
        lines.append(f"Most confused, {title.splitlines()[0].rpartition(':')[0]}:")
        for at in np.argsort(apart, axis=None)[::-1][:shown]:
            i, j = np.unravel_index(at, apart.shape)
            if apart[i, j] > 0:
                lines.append(f"   {found.names[i]} named {found.names[j]}: {100 * apart[i, j]:.0f} %")
        lines += [""] if apart.any() else ["   none", ""]
    return "\n".join(lines)
