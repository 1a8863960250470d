"""`polysight reproduce`: make items (tables and figures of the POLySIGHT paper), write their files, then the page."""

import base64
import csv
import io
import sys
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from matplotlib.figure import Figure

from polysight.jobs.output import steps
from polysight.products import write_json
from polysight.report import STAMP_COLOUR, encode_png
from polysight_papers.sensys2026.classification import fig18, fig20
from polysight_papers.sensys2026.images import fig4, fig13, fig14, fig19
from polysight_papers.sensys2026.item import Item, Run, Table
from polysight_papers.sensys2026.permittivities import fig3, fig16, fig17, fig21, table2_item
from polysight_papers.sensys2026.synchronisation import fig9, fig12, fig15
from polysight_shared.errors import ConfigError, ErrorCode, PolysightError
from polysight_shared.files import write_atomically

TITLES: dict[str, str] = {
    "fig3": "Fresnel reflection of common materials",
    "fig4": "0 degrees against steep incidence",
    "fig9": "spectrogram and high-pass response",
    "fig12": "images before and after synchronisation",
    "fig13": "image of seven materials",
    "fig14": "phase of H, V and P",
    "fig15": "errors by stage of synchronisation",
    "fig16": "contrast across incidence angles",
    "fig17": "location independence",
    "fig18": "classification of solids, liquids and powders",
    "fig19": "qualitative images",
    "fig20": "H, V and P alone and together",
    "fig21": "concentration of sugar in water",
    "table2": "permittivity of 36 materials",
}
# In the order in which they are made: drawn pixels before simulated scans, which take longer.
MAKERS: dict[str, Callable[[Run], Item]] = {
    "fig3": fig3,
    "fig16": fig16,
    "table2": table2_item,
    "fig18": fig18,
    "fig20": fig20,
    "fig21": fig21,
    "fig17": fig17,
    "fig19": fig19,
    "fig14": fig14,
    "fig13": fig13,
    "fig4": fig4,
    "fig12": fig12,
    "fig15": fig15,
    "fig9": fig9,
}


def reproduce(out: Path, keys: Sequence[str] = (), run: Run | None = None) -> int:
    """Make the items `keys` (default: all) into a folder, with the options `run`.

    An item that fails is listed on the page and on stderr; the others are made.

    Returns
    -------
    int
        Exit status; 0 if all items were made.

    Raises
    ------
    ConfigError
        if an item's name is not known, or the item is not implemented.
    """
    run = run or Run()
    for key in keys:
        if key not in MAKERS:
            if key in TITLES:
                reason = f"{TITLES[key]}: not reproduced yet"
            else:
                reason = "the paper has no such item"
            raise ConfigError(
                f"item {key!r} cannot be made",
                reason,
                f"give some of: {' '.join(MAKERS)}",
                code=ErrorCode.KEY_UNKNOWN,
            )
    make_folder(out)
    makers = {key: partial(make, run) for key, make in MAKERS.items()}
    return make_items(out, keys, makers, SIMULATED, quick=run.quick)


def make_folder(out: Path) -> None:
    """Make the folder of the results. Raises ConfigError."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise ConfigError(
            f"{out} is a file", "the results need a folder", "give another --out", code=ErrorCode.FILE_EXISTS
        ) from None


@dataclass(frozen=True)
class Origin:
    """Origin of the numbers of a page.

    Attributes
    ----------
    word, sentence
        Stamp of figures, tables and headings, and its explanation on the page.
    title
        Title of the page.
    simulated
        True if any of it was simulated.
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


def make_items(
    out: Path,
    keys: Sequence[str],
    makers: Mapping[str, Callable[[], Item]],
    origin: Origin,
    quick: bool = False,
    on_item: Callable[[Item], None] | None = None,
) -> int:
    """Make items (default: all of `makers`), write their files and the page; return the exit status.

    The page is written after each item, so that an interrupted run has one, too. An item that fails is listed on the
    page and on stderr; the others are made. `on_item` is called with each item.
    """
    items: list[Item] = []
    pictures: dict[str, bytes] = {}
    failed: dict[str, str] = {}
    chosen = list(dict.fromkeys(keys) or makers)
    earlier_keys = [key for key in TITLES if key not in chosen and (out / f"{key}.json").exists()]
    page = out / "reproduce.html"
    # `steps` prints the item that is being made, and its duration.
    for key in steps(chosen, [f"making {TITLES[key]}" for key in chosen]):
        try:
            item = makers[key]()
            pictures |= write_item(out, item, origin)
        except PolysightError as e:
            failed[key] = str(e)
            sys.stderr.write(f"\n{key}: {e}\n")
        else:
            items.append(item)
            if on_item is not None:
                on_item(item)
        write_page(page, items=items, pictures=pictures, failed=failed, quick=quick, origin=origin, makers=makers)
    noun = "item" if len(items) == 1 else "items"
    sys.stdout.write(f"{page}: {len(items)} {noun} ({origin.word}) beside the published values\n")
    if earlier_keys:
        keys_text = ", ".join(earlier_keys)
        sys.stdout.write(f"not on this page: {keys_text} of an earlier run, whose files stay in {out}\n")
    if failed:
        return 1
    return 0


def stamped_png(figure: Figure, origin: Origin = SIMULATED) -> bytes:
    """Return a figure as PNG with its origin, such as SIMULATED, above it."""
    figure.suptitle(origin.word.upper(), x=0.995, ha="right", fontsize=9, color=STAMP_COLOUR, fontweight="bold")
    return encode_png(figure)


def write_item(out: Path, item: Item, origin: Origin = SIMULATED) -> dict[str, bytes]:
    """Write an item's JSON, CSV and PNG files; return the pictures by file name."""
    pictures = {f"{item.key}-{name}.png": stamped_png(p.figure, origin) for name, p in item.pictures.items()}
    for name, data in pictures.items():
        write_atomically(out / "figures" / name, data)
    for i, table in enumerate(item.tables):
        if i == 0:
            name = f"{item.key}.csv"
        else:
            name = f"{item.key}-{i + 1}.csv"
        write_atomically(out / name, _format_csv(table, origin).encode("utf-8"))
    head = {"item": item.key, "title": item.title, "simulated": origin.simulated}
    write_json(out / f"{item.key}.json", {**head, **item.data})
    return pictures


def _format_csv(table: Table, origin: Origin) -> str:
    """Return a table as CSV: its origin and caption in the first line, then the head."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerows([[f"{origin.word}: {table.caption}"], table.head, *table.rows])
    return text.getvalue()


def write_page(
    path: Path,
    items: Sequence[Item],
    pictures: dict[str, bytes],
    failed: dict[str, str],
    quick: bool,
    origin: Origin,
    makers: Container[str],
) -> None:
    """Write the page `reproduce.html` with the items and a list of missing ones.

    `makers` holds the keys of possible items.
    """
    environment = Environment(
        loader=PackageLoader("polysight_papers.sensys2026", "."),
        autoescape=select_autoescape(["html"]),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    made_keys = {i.key for i in items}
    # On the page `left_out` are items that were not asked for, or not made yet; `missing` are those that these makers
    # cannot make.
    page = environment.get_template("reproduce.html").render(
        items=sorted(items, key=lambda i: list(TITLES).index(i.key)),
        images={name: base64.b64encode(data).decode("ascii") for name, data in pictures.items()},
        left_out=[(k, t) for k, t in TITLES.items() if k in makers and k not in made_keys and k not in failed],
        missing=[(k, t) for k, t in TITLES.items() if k not in makers],
        failed=[(k, TITLES[k], reason) for k, reason in failed.items()],
        quick=quick,
        origin=origin,
    )
    write_atomically(path, page.encode("utf-8"))
