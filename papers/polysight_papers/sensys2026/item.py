"""Structure of a reproduced table or figure of the POLySIGHT paper, and the published numbers.

These are in `table2.json` and `published.json`.
"""

import json
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from polysight.report import INK, MUTED

# Markers of matplotlib for the lines of a figure, in this order.
MARKERS = "osD^vP*X<>"


@dataclass(frozen=True)
class Run:
    """Options of a run: quick or full, and the rig file of the scans to simulate."""

    quick: bool = False
    config: Path = Path("instrument.toml")


@dataclass(frozen=True)
class Table:
    """A table of texts; also written as CSV."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class Picture:
    """A figure and the sentence below it."""

    figure: Figure
    caption: str


@dataclass(frozen=True)
class Item:
    """A reproduced table or figure.

    Attributes
    ----------
    key, title
        Short name ("fig18") and heading.
    text
        Paragraphs: the method, and the comparison with the published values.
    tables, pictures
        Shown in this order; pictures by file name.
    data
        Numbers for the JSON file.
    """

    key: str
    title: str
    text: tuple[str, ...]
    tables: tuple[Table, ...] = ()
    pictures: dict[str, Picture] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of this size, inches."""
    fig = Figure(figsize=(width, height), dpi=130, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    return fig


def style_axes(ax: Axes, title: str, x: str, y: str) -> None:
    """Set the title, the axis labels and a light grid."""
    ax.set_title(title, loc="left", fontsize=10.5, color=INK, fontweight="bold")
    ax.set_xlabel(x, fontsize=9, color=MUTED)
    ax.set_ylabel(y, fontsize=9, color=MUTED)
    ax.tick_params(labelsize=8, colors=MUTED)
    ax.grid(color="#e6e9ee", linewidth=0.8)
    ax.set_axisbelow(True)


def percent(share: float | None) -> str:
    """Format a share as a percentage with two decimals; a dash for None."""
    if share is None:
        return "–"
    return f"{100 * share:.2f} %"


@dataclass(frozen=True)
class Published:
    """One row of Table 2.

    Attributes
    ----------
    number, name
        As in the paper, with the thickness in the name.
    permittivity
        eps' - j eps'', the apparent value of a single interface; loss zero where the paper gives none (see note).
    thickness_mm
        Thickness in the name; None without one.
    note
        Remark on the value.
    """

    number: int
    name: str
    permittivity: complex
    thickness_mm: float | None
    note: str | None


def table2() -> tuple[Published, ...]:
    """Return the 36 rows of the paper's Table 2, in its order."""
    raw = json.loads(resources.files("polysight_papers.sensys2026").joinpath("table2.json").read_text(encoding="utf-8"))
    return tuple(
        Published(m["number"], m["name"], complex(m["real"], -(m["loss"] or 0.0)), m["thickness_mm"], m["note"])
        for m in raw["materials"]
    )


@cache
def published_values() -> dict[str, Any]:
    """Return the content of `published.json`; percentages as in the paper."""
    return json.loads(
        resources.files("polysight_papers.sensys2026").joinpath("published.json").read_text(encoding="utf-8")
    )
