"""Names in figures: a list of installed fonts that have the glyphs, and a short ASCII label where none has them.

Matplotlib's own font has no Chinese, Japanese or Korean. The page names everything in full, by the browser's fonts.
"""

from __future__ import annotations

import unicodedata
from functools import cache

from matplotlib.font_manager import findfont, fontManager, get_font

OWN = "DejaVu Sans"
"""Comes with matplotlib."""
FALLBACKS = (
    "Noto Sans CJK JP", "Noto Sans CJK SC", "Noto Sans CJK TC", "Noto Sans CJK KR", "Noto Sans JP", "Noto Sans SC",
    "Source Han Sans", "Source Han Sans JP", "Source Han Sans SC", "Source Han Sans CN", "WenQuanYi Zen Hei",
    "WenQuanYi Micro Hei", "IPAexGothic", "IPAGothic", "TakaoGothic", "VL Gothic", "Hiragino Sans", "PingFang SC",
    "PingFang HK", "Heiti TC", "Apple SD Gothic Neo", "Yu Gothic", "Meiryo", "MS Gothic", "Microsoft YaHei", "SimHei",
    "Microsoft JhengHei", "Malgun Gothic", "NanumGothic", "Arial Unicode MS", "Droid Sans Fallback", "Noto Sans",
)  # fmt: skip
"""Families with CJK glyphs, in the order in which they are tried."""


@cache
def font_families() -> tuple[str, ...]:
    """Matplotlib's own font, then those of FALLBACKS that are installed: the `family` of texts that hold names."""
    installed = {entry.name for entry in fontManager.ttflist}
    return (OWN, *(family for family in FALLBACKS if family in installed))


@cache
def _glyphs() -> frozenset[int]:
    return frozenset(code for family in font_families() for code in get_font(findfont(family)).get_charmap())


def is_drawable(text: str) -> bool:
    """True if the installed fonts have every glyph of a text, and it runs from left to right.

    Matplotlib neither turns right-to-left text nor joins its letters: Hebrew would be read backwards.
    """
    if any(unicodedata.bidirectional(character) in ("R", "AL") for character in text):
        return False
    return all(character == "\n" or ord(character) in _glyphs() for character in text)


def figure_label(name: str, number: str) -> str:
    """A name as figures show it: itself, or `number` and the name with `?` for what no font has.

    Parameters
    ----------
    name
        Of a material or plate.
    number
        What tells it apart without its name, such as `patch 3`.
    """
    if is_drawable(name):
        return name
    return f"{number}: {''.join(c if c.isascii() and c.isprintable() else '?' for c in name)}"
