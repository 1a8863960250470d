"""`reproduce.html`: one self-contained page, and the same as PNG, CSV and JSON files; it says where all is from."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Container, Sequence
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

from polysight.host.report.figures import STAMP, png
from polysight.host.report.products import write_atomically, write_json
from polysight.host.reproduce.catalogue import MAKERS, TITLES
from polysight.host.reproduce.item import Item, Table


@dataclass(frozen=True)
class Origin:
    """Where the numbers of a page come from.

    Attributes
    ----------
    word, sentence
        What every figure, table and heading is stamped with, and what the page says of it.
    title
        Of the page.
    simulated
        Whether any of it was simulated.
    notes
        Paragraphs above the items.
    """

    word: str
    sentence: str
    title: str
    simulated: bool
    notes: tuple[str, ...] = ()


SIMULATED = Origin(
    "simulated",
    "Every value and figure on this page that is not headed “published” comes from simulation. Nothing here was"
    " measured.",
    "The paper's tables and figures, simulated beside published",
    True,
)


def stamped_png(figure: Figure, origin: Origin = SIMULATED) -> bytes:
    """A figure as PNG with SIMULATED, or where else it is from, above it."""
    figure.suptitle(origin.word.upper(), x=0.995, ha="right", fontsize=9, color=STAMP, fontweight="bold")
    return png(figure)


def write_item(out: Path, item: Item, origin: Origin = SIMULATED) -> dict[str, bytes]:
    """Write an item's JSON, CSV and PNG files; returns the pictures by file name."""
    pictures = {f"{item.key}-{name}.png": stamped_png(p.figure, origin) for name, p in item.pictures.items()}
    for name, data in pictures.items():
        write_atomically(out / "figures" / name, data)
    for i, table in enumerate(item.tables):
        name = f"{item.key}.csv" if i == 0 else f"{item.key}-{i + 1}.csv"
        write_atomically(out / name, _csv(table, origin).encode("utf-8"))
    head = {"item": item.key, "title": item.title, "simulated": origin.simulated}
    write_json(out / f"{item.key}.json", {**head, **item.data})
    return pictures


def _csv(table: Table, origin: Origin) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([[f"{origin.word}: {table.caption}"], table.head, *table.rows])
    return text.getvalue()


def write_page(
    out: Path,
    items: Sequence[Item],
    pictures: dict[str, bytes],
    failed: dict[str, str],
    quick: bool,
    origin: Origin = SIMULATED,
    makers: Container[str] | None = None,
) -> Path:
    """Write `reproduce.html`; returns its path. Items that are not on it are named on it.

    `makers` holds the keys that could be on it; None: all there are.
    """
    makers = MAKERS if makers is None else makers
    environment = Environment(
        loader=PackageLoader("polysight.host.reproduce", "."),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    held = {i.key for i in items}
    page = environment.get_template("reproduce.html").render(
        items=sorted(items, key=lambda i: list(TITLES).index(i.key)),
        images={name: base64.b64encode(data).decode("ascii") for name, data in pictures.items()},
        left_out=[(k, t) for k, t in TITLES.items() if k in makers and k not in held and k not in failed],
        missing=[(k, t) for k, t in TITLES.items() if k not in makers],
        failed=[(k, TITLES[k], why) for k, why in failed.items()],
        quick=quick,
        origin=origin,
    )
    path = out / "reproduce.html"
    write_atomically(path, page.encode("utf-8"))
    return path
