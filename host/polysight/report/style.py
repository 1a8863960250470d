"""Style of all figures: colours, fonts, axes in millimetres, titles, colour bars, labels, legends, PNG bytes.

The colours of materials are from the palettes "muted" and "light" of Paul Tol, which are safe for colour-blind readers.
Only matplotlib's object interface is used, which needs no global state and no display. The font of matplotlib has no
Chinese, Japanese or Korean: other installed fonts are tried, and a name that no font can draw is replaced by a short
ASCII label. The text of the page shows all names in full, with the browser's fonts.
"""

from __future__ import annotations

import io
import unicodedata
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, fontManager, get_font
from matplotlib.legend import Legend
from matplotlib.patches import Patch, Polygon, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.text import Text
from matplotlib.transforms import Bbox, BboxBase

from polysight.materials import TruthPlate
from polysight.products import ProcessedScan
from polysight.results import PatchFigures

# Colours of a figure's text: titles, axes, and the word SIMULATED.
INK = "#1b2330"
MUTED = "#5b6675"
STAMP_COLOUR = "#b3261e"
PALETTE = (
    "#332288", "#88CCEE", "#44AA99", "#117733", "#999933", "#DDCC77", "#CC6677", "#882255", "#AA4499",
    "#77AADD", "#EE8866", "#EEDD88", "#FFAABB", "#99DDFF", "#44BB99", "#BBCC33", "#AAAA00",
)  # fmt: skip
UNKNOWN_COLOUR = "#BBBBBB"
# Colours of the metal reference and of patches that were not judged.
METAL_COLOUR = "#C9D3DE"
REFUSED_COLOUR = "#8d949e"
# Hatching of patches that were not judged.
HATCH = "////"
# Least gap between two names side by side, which would otherwise look like one name; points of 1/72 inch.
_GAP_PT = 8.0
# Margins of an axes in inches: there is room for a number of five characters, the axis labels and a title.
_LEFT_IN = 0.66
_BOTTOM_IN = 0.5
_TOP_IN = 0.28
RIGHT_IN = 0.1
"""Margin on the right of an axes, inches."""
BAR_IN = 0.62
"""Margin on the right of an axes with a colour bar, its numbers and its label, inches."""
# Height of a line of a legend, inches.
_LEGEND_LINE_IN = 0.195
# Largest number of characters of a name in a legend: two such names fit side by side below a map.
_LONGEST_NAME = 26

MATPLOTLIB_FONT = "DejaVu Sans"
"""The font that comes with matplotlib."""
FALLBACKS = (
    "Noto Sans CJK JP", "Noto Sans CJK SC", "Noto Sans CJK TC", "Noto Sans CJK KR", "Noto Sans JP", "Noto Sans SC",
    "Source Han Sans", "Source Han Sans JP", "Source Han Sans SC", "Source Han Sans CN", "WenQuanYi Zen Hei",
    "WenQuanYi Micro Hei", "IPAexGothic", "IPAGothic", "TakaoGothic", "VL Gothic", "Hiragino Sans", "PingFang SC",
    "PingFang HK", "Heiti TC", "Apple SD Gothic Neo", "Yu Gothic", "Meiryo", "MS Gothic", "Microsoft YaHei", "SimHei",
    "Microsoft JhengHei", "Malgun Gothic", "NanumGothic", "Arial Unicode MS", "Droid Sans Fallback", "Noto Sans",
)  # fmt: skip
"""Families with CJK glyphs, in the order in which they are tried; the last one has other scripts."""


@cache
def font_families() -> tuple[str, ...]:
    """Return the fonts for texts that hold names: matplotlib's own, then the installed ones of FALLBACKS."""
    installed = {entry.name for entry in fontManager.ttflist}
    return (MATPLOTLIB_FONT, *(family for family in FALLBACKS if family in installed))


@cache
def _list_glyphs() -> frozenset[int]:
    """Return the code points that the fonts of `font_families` can draw."""
    return frozenset(code for family in font_families() for code in get_font(findfont(family)).get_charmap())


def is_drawable(text: str) -> bool:
    """True if the installed fonts have every glyph of a text and it runs from left to right.

    Matplotlib neither turns right-to-left text nor joins its letters: Hebrew would be read backwards.
    """
    if any(unicodedata.bidirectional(character) in ("R", "AL") for character in text):
        return False
    return all(character == "\n" or ord(character) in _list_glyphs() for character in text)


def figure_label(name: str, number: str) -> str:
    """Return a material's or plate's name if the fonts can draw it, else e.g. `patch 3: ??`.

    `number` identifies the patch or plate without its name, such as `patch 3`; missing glyphs become `?`.
    """
    if is_drawable(name):
        return name
    ascii_name = name.encode("ascii", "replace").decode("ascii")
    return f"{number}: {''.join(c if c.isprintable() else '?' for c in ascii_name)}"


def assign_colours(scan: ProcessedScan) -> dict[str, str]:
    """Return the colour of each material in the results or the truth, the same in all figures."""
    names = {patch.name for patch in scan.segments if patch.name} | {plate.name for plate in scan.plates}
    # `pixel_names` has for each patch the names of its pixels, and the mask of these.
    for names_of_pixels, _ in scan.pixel_names.values():
        names |= set(np.unique(names_of_pixels).tolist())
    names.discard("unknown")
    table = {name: PALETTE[i % len(PALETTE)] for i, name in enumerate(sorted(names))}
    return {**table, "unknown": UNKNOWN_COLOUR}


def make_figure(width: float, height: float, right_in: float) -> Figure:
    """Return a white figure of this size in inches, with :func:`set_margins`."""
    fig = Figure(figsize=(width, height), dpi=160, facecolor="white")
    # The canvas attaches itself to the figure; texts are measured as it draws them.
    FigureCanvasAgg(fig)
    set_margins(fig, right_in)
    return fig


def set_margins(fig: Figure, right_in: float, below_in: float = 0.0) -> None:
    """Leave room for titles, axis labels and tick labels, `right_in` on the right, and `below_in` for a legend.

    This replaces matplotlib's "constrained" layout, which measures all texts four times and takes longer than the
    drawing.
    """
    width, height = fig.get_size_inches()
    fig.subplots_adjust(
        left=_LEFT_IN / width,
        right=1 - right_in / width,
        bottom=(_BOTTOM_IN + below_in) / height,
        top=1 - _TOP_IN / height,
    )


def style_axes(ax: Axes, title: str, simulated: bool) -> None:
    """Draw the title, axis labels in millimetres, grey ticks, and the word SIMULATED for simulated data."""
    # With a given height, matplotlib does not search for a height above all ticks, for which it measures every text.
    ax.set_title(title, loc="left", y=1.0, fontsize=11, color=INK, fontweight="bold")
    if simulated:
        ax.text(
            1.0, 1.015, "SIMULATED", transform=ax.transAxes, ha="right", va="bottom",
            fontsize=8, color=STAMP_COLOUR, fontweight="bold",
        )  # fmt: skip
    ax.set_xlabel("x (mm)", fontsize=9, color=MUTED)
    ax.set_ylabel("y (mm)", fontsize=9, color=MUTED)
    ax.tick_params(labelsize=8, colors=MUTED, length=3)
    ax.set_aspect("equal")
    ax.set_facecolor("#d9dde3")
    for spine in ax.spines.values():
        spine.set_color("#c3c9d1")


def colour_bar(fig: Figure, ax: Axes, shown: ScalarMappable, label: str = "", extend: str = "neither") -> Colorbar:
    """Draw a colour bar beside an axes. It is opaque, even if the image is partly transparent."""
    bar = fig.colorbar(shown, ax=ax, fraction=0.046, pad=0.03, extend=extend)
    bar.set_label(label, fontsize=8, color=MUTED)
    bar.ax.tick_params(labelsize=8, colors=MUTED, length=2)
    if bar.solids is not None:
        bar.solids.set_alpha(1)
    return bar


def write_label(
    ax: Axes, x: float, y: float, text: str, size: float = 8.0, above: bool = False, on_dark: bool = False
) -> Text:
    """Write a name or number with a halo, centred on a point or `above` it."""
    ink = INK
    halo = "white"
    if on_dark:
        ink = "white"
        halo = "#10141b"
    alignment = "bottom" if above else "center"
    return ax.text(
        x, y, text, ha="center", va=alignment, fontsize=size, color=ink, linespacing=1.2,
        path_effects=[withStroke(linewidth=2.4, foreground=halo)], family=list(font_families()), parse_math=False,
    )  # fmt: skip


def patch_label(patch: PatchFigures) -> str:
    """Return the text beside a patch in figures."""
    number = f"patch {patch.label}"
    if patch.name:
        return figure_label(patch.name, number)
    if patch.metal_reference:
        return "metal reference"
    return number


def short_label(text: str) -> str:
    """Return a name cut to the length of a legend's line."""
    text = " ".join(text.split())
    if len(text) <= _LONGEST_NAME:
        return text
    return f"{text[: _LONGEST_NAME - 1]}…"


def patch_colour(patch: PatchFigures, colours: dict[str, str]) -> str:
    """Return a patch's colour: that of its name, of refused patches, or of the metal reference."""
    if patch.refused is not None:
        return REFUSED_COLOUR
    if not patch.name and patch.metal_reference:
        return METAL_COLOUR
    return colours.get(patch.name or "unknown", UNKNOWN_COLOUR)


def plate_label(plate: TruthPlate, number: int) -> str:
    """Return the text beside a plate in the figure of the truth; `number` counts plates from 1."""
    return figure_label(plate.name, f"plate {number}")


def make_outline(patch: PatchFigures, **style: Any) -> Polygon | Rectangle:
    """Return a patch's outline, or its box if it has none; `style` are options of matplotlib's patches."""
    if patch.outline_mm:
        return Polygon(patch.outline_mm, closed=True, **style)
    return Rectangle(patch.box_mm[:2], patch.width_mm, patch.height_mm, **style)


@dataclass(frozen=True)
class MapLabel:
    """A name drawn on a map, and its replacement if there is no room for it.

    Attributes
    ----------
    text
        The drawn text.
    number, name, colour
        The number that replaces the name on the map, and the entry in the legend.
    below
        Second line that is kept, such as the confidence; may be empty.
    """

    text: Text
    number: str
    name: str
    colour: str
    below: str = ""


def shorten_labels(fig: Figure, labels: Sequence[MapLabel]) -> list[MapLabel]:
    """Replace all labels by numbers if two touch or one crosses the left or right frame; return the replaced labels."""
    if not labels:
        return []
    engine = fig.get_layout_engine()
    if engine is not None:
        engine.execute(fig)
    # Axes of equal aspect get their final size only when drawn; the labels are measured in it now.
    for ax in fig.axes:
        ax.apply_aspect()
    gap = _GAP_PT * fig.dpi / 72
    boxes = [label.text.get_window_extent() for label in labels]
    frames = [(label.text.axes or fig).bbox for label in labels]
    # A label that crosses the frame by one pixel is accepted: this cannot be seen.
    is_outside = any(b.x0 < f.x0 - 1 or b.x1 > f.x1 + 1 for b, f in zip(boxes, frames, strict=True))
    touching = any(a.overlaps(b) for a, b in combinations([_widen(b, gap) for b in boxes], 2))
    if not is_outside and not touching:
        return []
    for label in labels:
        replacement = label.number
        if label.below:
            replacement += f": {label.below}"
        label.text.set_text(replacement)
    return list(labels)


def _widen(box: BboxBase, gap: float) -> Bbox:
    """Return a box that is wider by `gap` pixels, half of it on each side."""
    return Bbox.from_extents(box.x0 - gap / 2, box.y0, box.x1 + gap / 2, box.y1)


def fit_labels(fig: Figure, labels: Sequence[MapLabel], right_in: float) -> None:
    """Replace names by numbers if they lack room, with a legend below the axes; `right_in` as of `set_margins`."""
    replaced = shorten_labels(fig, labels)
    if not replaced:
        return
    legend_in = 0.1 + _LEGEND_LINE_IN * ((len(replaced) + 1) // 2)
    fig.set_figheight(fig.get_figheight() + legend_in)
    set_margins(fig, right_in, legend_in)
    handles = [
        Patch(facecolor=label.colour, edgecolor=INK, linewidth=0.6, label=f"{label.number}  {short_label(label.name)}")
        for label in replaced
    ]
    legend = fig.legend(handles=handles, loc="lower left", ncols=2, handlelength=1.1, frameon=False)
    style_legend(legend)


def style_legend(legend: Legend) -> None:
    """Set the fonts of a legend that holds names."""
    for text in legend.get_texts():
        text.set(family=list(font_families()), parse_math=False, color=INK, fontsize=7.5)


def encode_png(fig: Figure) -> bytes:
    """Return a figure as PNG bytes without matplotlib's version (`Software`): the same data gives the same file."""
    buffer = io.BytesIO()
    # `savefig` would draw everything twice, the first time only to place the axes; `print_png` places them as it draws.
    # Z_RLE compresses only runs of equal bytes: the files are 7 % larger than with zlib's usual search, and it takes
    # two thirds of the time.
    FigureCanvasAgg(fig).print_png(buffer, metadata={"Software": None}, pil_kwargs={"compress_type": zlib.Z_RLE})
    return buffer.getvalue()
