"""Which row of Table 2 a name in the published files means.

The files name materials freely ("acrylic_3mm", "Cane sugar 3.8 % (glass)"). A name means the row that shares most of
its words and numbers; where two rows share as many, or too few are shared, it means none and is reported.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from polysight.host.materials import Published, table2
from polysight.host.materials.authors_labels import METALS
from polysight.shared.errors import DataError

_FILLING = {"with", "w", "in", "on", "mm", "percent", "sample", "sheet", "plate", "the", "of", "box", "container"}
_ALIASES = {"fibre": "fiber", "fiberglass": "fiber glass", "plywood": "wood", "soya": "soy", "salts": "salt"}
_CONTAINERS = {"glass", "plastic"}
_ENOUGH = 0.5


def words(name: str) -> frozenset[str]:
    """Words and numbers of a name, lower case; a metal's name is "metal"."""
    text = re.sub(r"\\?\bw/?\s", " with ", name.lower().replace("_", " "))
    out: list[str] = []
    for word in re.findall(r"[a-z]+|\d+(?:\.\d+)?", text):
        if word in _FILLING:
            continue
        if word[0].isdigit():
            number = f"0.{word[1:]}" if re.fullmatch(r"0\d+", word) else word  # "pet_05mm"
            out.append(f"{float(number):g}")
        else:
            out += ["metal"] if word in METALS else str(_ALIASES.get(word, word)).split()
    return frozenset(out)


def _alike(theirs: frozenset[str], row: Published) -> float:
    """Shared words and numbers over all of them; a row's container need not be named."""
    ours = words(row.name)
    optional = ours & _CONTAINERS if " with " in row.name or "(with" in row.name else frozenset()
    union = (ours | theirs) - (optional - theirs)
    return len(ours & theirs) / len(union) if union else 0.0


def row_of(name: str, thickness_mm: float | None = None) -> int | None:
    """Number of the row of Table 2 that a name means, or None."""
    theirs = words(name)
    if "metal" in theirs:
        return 1
    tries = [theirs]
    if thickness_mm is not None:
        tries.insert(0, theirs | {f"{thickness_mm:g}"})
    best = sorted(((max(_alike(t, row) for t in tries), row.number) for row in table2()), key=lambda b: -b[0])
    (first, number), (second, _) = best[:2]
    return number if first >= _ENOUGH and first > second else None


def read_names(path: Path) -> dict[str, int]:
    """A file that says what names mean: JSON, {their name: row of Table 2}. Raises DataError."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        given = {str(name): int(number) for name, number in content.items()}
    except (OSError, ValueError, AttributeError, TypeError) as e:
        raise DataError(f"{path}: not a list of names: {e}", 'expected JSON, {"their name": row of Table 2}') from None
    wrong = [n for n in given.values() if not 1 <= n <= len(table2())]
    if wrong:
        raise DataError(f"{path}: Table 2 has no row {wrong[0]}", f"its rows are 1 to {len(table2())}")
    return given


def rows_of(
    names: Iterable[tuple[str, float | None]], given: Mapping[str, int] | None = None
) -> dict[tuple[str, float | None], int]:
    """Rows of names with their thicknesses; those that mean none are left out."""
    found = {(n, t): (given or {}).get(n) or row_of(n, t) for n, t in set(names)}
    return {key: number for key, number in found.items() if number is not None}
