"""`polysight reproduce --authors`: Table 2, Fig. 18, 20 and 21 from the published files, beside the paper's values.

The page and the terminal's tables are made here, and Table 2 by three recipes, the authors' among them; the figures are
in `dataset_figures.py`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from polysight.jobs.output import steps
from polysight.materials import Permittivity, estimate_permittivity
from polysight.polarimetry import permittivity_from_ratio
from polysight.report import INK, PALETTE
from polysight_papers.sensys2026.dataset import IMAGES, AuthorsData, read_authors
from polysight_papers.sensys2026.dataset_figures import Judgements, authors_fig18, authors_fig20, authors_fig21
from polysight_papers.sensys2026.item import Item, Picture, Table, dress, new_figure
from polysight_papers.sensys2026.patches import groups
from polysight_papers.sensys2026.run import Origin, write_item, write_page
from polysight_papers.sensys2026.table2 import Published, table2
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError, PolysightError

Complex = npt.NDArray[np.complexfloating]
HEAD = (
    "No.", "Material", "angle", "scans", "pixels", "published ε′", "published ε″", "Eq. 3 ε′", "Eq. 3 ε″",
    "without leakage ε′", "without leakage ε″", "±", "authors' recipe ε′", "authors' recipe ε″",
)  # fmt: skip
"""Head of the comparison with Table 2."""

MAKERS: dict[str, Callable[[Judgements], Item]] = {
    "table2": lambda judge: authors_table2(judge.data),
    "fig18": authors_fig18,
    "fig20": authors_fig20,
    "fig21": lambda judge: authors_fig21(judge.data),
}
AXIAL_RATIO, METAL_FACTOR, PERCENTILES = 0.05, 1 / 0.8, (30, 70)
"""Corrections of the authors before Eq. 3: leakage, a factor on |P| relative to metal, percentiles of |P| to keep."""


def reproduce_authors(
    folder: Path,
    out: Path,
    config: Path,
    keys: Sequence[str] = (),
    images: Path | None = None,
    names: Path | None = None,
) -> int:
    """Print the items, and write them as a page and as files.

    Parameters
    ----------
    folder, config, images, names
        As of :func:`polysight_papers.sensys2026.dataset.read_authors`.
    out
        Folder for the page and the files.
    keys
        Items, default all four.

    Returns
    -------
    int
        Exit status, 0 only when every item was made.

    Raises
    ------
    ConfigError
        when an item cannot be made from these files at all.
    DataError
        when nothing in the folder can be used.
    """
    _check_keys(keys)
    data = read_authors(folder, config, images, names)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise ConfigError(
            f"{out} is a file", "the results need a folder", "give another --out", code=ErrorCode.FILE_EXISTS
        ) from None
    origin, judge = origin_of(data), Judgements(data)
    for notice in data.notices:
        sys.stderr.write(f"note: {notice}\n")
    items: list[Item] = []
    pictures: dict[str, bytes] = {}
    failed: dict[str, str] = {}
    made = list(dict.fromkeys(keys) or MAKERS)
    for key in steps(made, made):
        try:
            item = MAKERS[key](judge)
        except PolysightError as e:
            failed[key] = str(e)
            sys.stderr.write(f"\n{key}: {e}\n")
            continue
        pictures |= write_item(out, item, origin)
        items.append(item)
        sys.stdout.write(f"\n{item.title} ({origin.word})\n" + "".join(f"{text_of(t)}\n" for t in item.tables))
    page = write_page(out, items, pictures, failed, False, origin, MAKERS)
    sys.stdout.write(f"{page}: {len(items)} items from {origin.word} beside the published values\n")
    return 1 if failed else 0


def _check_keys(keys: Sequence[str]) -> None:
    """Raise ConfigError for items that cannot be made from the published files."""
    for key in keys:
        if key not in MAKERS:
            raise ConfigError(
                f"item {key!r} cannot be made from the published files",
                "they hold pixels of materials, nothing else of the paper",
                f"give some of: {' '.join(MAKERS)}; without --authors the others are made from simulation",
            )


def origin_of(data: AuthorsData) -> Origin:
    """Return the notes on the data for the page."""
    held = "; ".join(
        f"{source}: {len(lib.entries)} boxes of {len(lib.names)} materials in {len(lib.scans)} scans"
        for source, lib in data.sources.items()
    )
    titles = {m.number: m.name for m in table2()}
    taken = ", ".join(f"“{n}” = {k}" for n, k in data.meaning.items() if not n.startswith(titles[k]))
    notes = [f"Read from {data.folder.name}: {held}.", *(f"{n[0].upper()}{n[1:]}." for n in data.notices)]
    if taken:
        notes.insert(1, f"Names that were taken for a row of Table 2 by their words: {taken}.")
    if data.simulated:
        return Origin(
            "simulated files",
            "Some of these files were simulated, and say so: what is on this page was not measured.",
            "The paper's tables and figures, from simulated files of the published form",
            True,
            tuple(notes),
        )
    return Origin(
        "the published files",
        "Every value and figure on this page that is not headed “published” was computed here from the authors' files.",
        "The paper's tables and figures, computed from the authors' files",
        False,
        tuple(notes),
    )


def text_of(table: Table) -> str:
    """Format a table for the terminal: columns as wide as their cells, long heads over several lines."""
    limit = [max([9, *(len(row[k]) for row in table.rows)]) for k in range(len(table.head))]
    heads = [_wrapped(head, width) for head, width in zip(table.head, limit, strict=True)]
    width = [max([n, *map(len, lines)]) for n, lines in zip(limit, heads, strict=True)]
    tall = max(map(len, heads))
    lines = [[h[k - tall + len(h)] if k >= tall - len(h) else "" for h in heads] for k in range(tall)]
    rows = [*lines, ["-" * n for n in width], *table.rows]

    def line(cells: Sequence[str]) -> str:
        first, *rest = zip(cells, width, strict=True)
        return "  ".join([first[0].ljust(first[1]), *(c.rjust(n) for c, n in rest)]).rstrip()

    return "\n".join([table.caption, *map(line, rows)]) + "\n"


def _wrapped(text: str, width: int) -> list[str]:
    out = [""]
    for word in text.split():
        if out[-1] and len(out[-1]) + 1 + len(word) > width:
            out.append("")
        out[-1] = f"{out[-1]} {word}".strip()
    return out


def without_leakage(p: Complex, axial_ratio: float) -> Complex:
    """Remove the leakage a of both channels from ratios P = (t + a) / (1 + a t); return t (1 for metal)."""
    return (p - axial_ratio) / (1 - axial_ratio * p)


def authors_recipe(p: Complex, angle_deg: float) -> complex:
    """Return the permittivity by the authors' recipe: leakage, factor, the middle pixels by |P|, mean of Eq. 3."""
    used = without_leakage(p, AXIAL_RATIO) * METAL_FACTOR
    low, high = np.percentile(np.abs(used), PERCENTILES)
    kept = used[(np.abs(used) >= low) & (np.abs(used) <= high)]
    eps = permittivity_from_ratio(kept, np.radians(angle_deg))
    return complex(np.mean(eps[np.isfinite(eps)]))


def _seen(data: AuthorsData, source: str, m: Published) -> tuple[Complex, float, int] | None:
    """Ratios of a material's pixels, their angle, and how many scans: at the paper's angle, or else the first."""
    paper = next(g.angle_deg for g in groups().values() if m in g.materials)
    entries = list(data.at(source, range(m.number, m.number + 1), paper).entries)
    if not entries:
        others = sorted(e.incidence_deg for e in data.sources[source].entries if e.name == m.name)
        if not others:
            return None
        entries = list(data.at(source, range(m.number, m.number + 1), others[0]).entries)
    p = np.concatenate([e.p for e in entries]).astype(np.complex128)
    angle = float(np.mean([e.incidence_deg for e in entries]))
    return p[np.isfinite(p) & (p != 0)], angle, len({e.scan for e in entries})


@dataclass(frozen=True)
class Estimate:
    """Permittivities of a material from one source: by Eq. 3 as it is, without leakage, and by the authors' recipe."""

    material: Published
    angle_deg: float
    scans: int
    pixels: int
    as_is: Permittivity
    clean: Permittivity
    recipe: complex

    @property
    def metal_like(self) -> bool:
        """True if there is no permittivity."""
        return self.material.number == 1 or self.clean.value is None or self.clean.real_std is None


def authors_table2(data: AuthorsData) -> Item:
    """Each source's permittivities by Eq. 3 as it is, without leakage, and by the authors' recipe.

    Raises
    ------
    DataError
        when no material of the table is in the data.
    """
    leakage = float(np.mean([data.base.polarimetry.leakage_h[0], data.base.polarimetry.leakage_v[0]]))
    estimates = {source: _estimates(data, source, 0.0 if source == IMAGES else leakage) for source in data.sources}
    if not any(estimates.values()):
        raise DataError("no material of Table 2 is in the data", "see the notices on its names", code=ErrorCode.NO_DATA)
    return Item(
        "table2",
        "Table 2: permittivity of 36 materials",
        (
            "Three ways from the same pixels. “Eq. 3”: the median of V/H relative to metal, as it is in the files."
            f" “Without leakage”: the rig file's cross-polar amplitude, {leakage:g}, is taken out first; images made"
            f" here have it out already. “Authors' recipe”: leakage {AXIAL_RATIO:g}, |P| times {METAL_FACTOR:g}, the"
            f" pixels between the {PERCENTILES[0]}th and the {PERCENTILES[1]}th percentile of |P|, mean of Eq. 3 over"
            " them."
            " ± is the standard error of one patch.",
            "The recipe's factor makes up for something in the published measurements that is not explained; on data"
            " without it, simulated data for one, the recipe is off by it.",
        ),
        tuple(Table(f"Permittivity from {source}", HEAD, tuple(map(_row, e))) for source, e in estimates.items()),
        {"permittivity": Picture(_figure(estimates), "From the files against published; the dotted line is equality.")},
        {"materials": [_plain(source, e) for source, found in estimates.items() for e in found]},
    )


def _estimates(data: AuthorsData, source: str, leakage: float) -> list[Estimate]:
    """Estimate all materials of Table 2 in a source; `leakage` is still in its ratios."""
    found = []
    for m in table2():
        seen = _seen(data, source, m)
        if seen is None or not seen[0].size:
            continue
        p, angle, scans = seen
        one, theta = np.ones(p.size, np.complex128), np.radians(angle)
        as_is, clean = (estimate_permittivity(x, one, theta) for x in (p, without_leakage(p, leakage)))
        found.append(Estimate(m, angle, scans, p.size, as_is, clean, authors_recipe(p, angle)))
    return found


def _row(e: Estimate) -> tuple[str, ...]:
    m, std = e.material, e.clean.real_std
    return (
        str(m.number), m.name, f"{e.angle_deg:.0f}°", str(e.scans), str(e.pixels), f"{m.permittivity.real:.4g}",
        "–" if m.number == 23 else f"{-m.permittivity.imag:.4g}", *_cells(e.as_is.value), *_cells(e.clean.value),
        "" if std is None or e.metal_like else f"± {std:.2f}", *_cells(None if e.metal_like else e.recipe),
    )  # fmt: skip


def _cells(value: complex | None) -> tuple[str, str]:
    return ("metal-like", "") if value is None else (f"{value.real:.2f}", f"{-value.imag:.2f}")


def _plain(source: str, e: Estimate) -> dict[str, Any]:
    """Return the content of the JSON file."""
    return {
        "source": source, "number": e.material.number, "name": e.material.name, "angle_deg": e.angle_deg,
        "scans": e.scans, "pixels": e.pixels, "published": e.material.permittivity, "as_is": e.as_is.value,
        "without_leakage": e.clean.value, "std": e.clean.real_std, "authors_recipe": e.recipe,
        "metal_like": e.metal_like, "ratio": e.clean.ratio,
    }  # fmt: skip


def _figure(estimates: Mapping[str, Sequence[Estimate]]) -> Figure:
    """Draw real part and loss of each source, without leakage, against the published values."""
    fig = new_figure(10.5, 4.6)
    axes = fig.subplots(1, 2)
    for colour, (source, found) in zip((PALETTE[0], PALETTE[6], PALETTE[3]), estimates.items(), strict=False):
        bars: dict[str, Any] = {"fmt": "o", "ms": 4, "color": colour, "lw": 1, "label": source}
        shown = [e for e in found if not e.metal_like]
        true = [e.material.permittivity for e in shown]
        values = [e.clean.value or 0j for e in shown]
        std = [e.clean.real_std or 0.0 for e in shown]
        axes[0].errorbar([t.real for t in true], [v.real for v in values], yerr=std, **bars)
        axes[1].errorbar([-t.imag for t in true], [-v.imag for v in values], yerr=std, **bars)
    for ax, part in zip(axes, ("real part ε′", "loss ε″"), strict=True):
        dress(ax, part, f"published {part}", f"{part} without leakage")
        ax.axline((1, 1), slope=1, color=INK, lw=0.8, ls=":")
        ax.legend(fontsize=8, frameon=False)
    return fig
