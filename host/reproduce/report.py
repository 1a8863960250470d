"""`reproduce.html`: one self-contained page, and the same as PNG, CSV and JSON files. All of it is simulated."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

from host.report.figures import STAMP, png
from host.report.products import write_atomically, write_json
from host.reproduce.catalogue import MAKERS, TITLES
from host.reproduce.item import Item, Table


def stamped_png(figure: Figure) -> bytes:
    """A figure as PNG with SIMULATED above it."""
    figure.suptitle("SIMULATED", x=0.995, ha="right", fontsize=9, color=STAMP, fontweight="bold")
    return png(figure)


def write_item(out: Path, item: Item) -> dict[str, bytes]:
    """Write an item's JSON, CSV and PNG files; returns the pictures by file name."""
    pictures = {f"{item.key}-{name}.png": stamped_png(p.figure) for name, p in item.pictures.items()}
    for name, data in pictures.items():
        write_atomically(out / "figures" / name, data)
    for i, table in enumerate(item.tables):
        name = f"{item.key}.csv" if i == 0 else f"{item.key}-{i + 1}.csv"
        write_atomically(out / name, _csv(table).encode("utf-8"))
    write_json(out / f"{item.key}.json", {"item": item.key, "title": item.title, "simulated": True, **item.data})
    return pictures


def _csv(table: Table) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([["simulated: " + table.caption], table.head, *table.rows])
    return text.getvalue()


def write_page(
    out: Path, items: Sequence[Item], pictures: dict[str, bytes], failed: dict[str, str], quick: bool
) -> Path:
    """Write `reproduce.html`; returns its path. Items that are not on it are named on it."""
    environment = Environment(
        loader=PackageLoader("host.reproduce", "."),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    held = {i.key for i in items}
    page = environment.get_template("reproduce.html").render(
        items=items,
        images={name: base64.b64encode(data).decode("ascii") for name, data in pictures.items()},
        left_out=[(k, TITLES[k]) for k in MAKERS if k not in held and k not in failed],
        missing=[(k, t) for k, t in TITLES.items() if k not in MAKERS],
        failed=[(k, TITLES[k], why) for k, why in failed.items()],
        quick=quick,
    )
    path = out / "reproduce.html"
    write_atomically(path, page.encode("utf-8"))
    return path
