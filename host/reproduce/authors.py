"""`polysight reproduce --authors`: Table 2, Fig. 18, 20 and 21 from the published files, beside the paper's values."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from polysight.host.materials import table2
from polysight.host.reproduce.authors_data import AuthorsData, read_authors
from polysight.host.reproduce.authors_items import Judgements, authors_fig18, authors_fig20, authors_fig21
from polysight.host.reproduce.authors_table2 import authors_table2
from polysight.host.reproduce.item import Item, Table
from polysight.host.reproduce.report import Origin, write_item, write_page
from polysight.shared.errors import ConfigError, PolysightError

MAKERS: dict[str, Callable[[Judgements], Item]] = {
    "table2": lambda judge: authors_table2(judge.data),
    "fig18": authors_fig18,
    "fig20": authors_fig20,
    "fig21": lambda judge: authors_fig21(judge.data),
}


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
        As of :func:`polysight.host.reproduce.authors_data.read_authors`.
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
    for key in keys:
        if key not in MAKERS:
            raise ConfigError(
                f"item {key!r} cannot be made from the published files",
                "they hold pixels of materials, nothing else of the paper",
                f"give some of: {' '.join(MAKERS)}; without --authors the others are made from simulation",
            )
    data = read_authors(folder, config, images, names)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise ConfigError(f"{out} is a file", "the results need a folder", "give another --out") from None
    origin, judge = origin_of(data), Judgements(data)
    for notice in data.notices:
        sys.stderr.write(f"note: {notice}\n")
    items: list[Item] = []
    pictures: dict[str, bytes] = {}
    failed: dict[str, str] = {}
    for key in dict.fromkeys(keys) or MAKERS:
        try:
            item = MAKERS[key](judge)
        except PolysightError as e:
            failed[key] = str(e)
            sys.stderr.write(f"{key}: {e}\n")
            continue
        pictures |= write_item(out, item, origin)
        items.append(item)
        sys.stdout.write(f"\n{item.title} ({origin.word})\n" + "".join(f"{text_of(t)}\n" for t in item.tables))
    page = write_page(out, items, pictures, failed, False, origin, MAKERS)
    sys.stdout.write(f"{page}: {len(items)} items from {origin.word} beside the published values\n")
    return 1 if failed else 0


def origin_of(data: AuthorsData) -> Origin:
    """What the page says of the data."""
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
    """A table for the terminal: columns as wide as their cells, long heads over several lines."""
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
