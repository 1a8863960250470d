"""The paper's Table 2 as data (36 materials with their published permittivities), and its other published values."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any


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
def published() -> dict[str, Any]:
    """Return the content of `published.json`; percentages as in the paper."""
    return json.loads(
        resources.files("polysight_papers.sensys2026").joinpath("published.json").read_text(encoding="utf-8")
    )
