"""The tables that benchmarks print, and the JSON that they write."""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.measure import machine


@dataclass(frozen=True)
class Line:
    """One quantity of the table.

    Attributes
    ----------
    quantity
        The measured quantity.
    ours, theirs
        The two figures as text with their units; `theirs` may be empty.
    value
        The judged value: a ratio (higher is better) or an amount (lower is better).
    at_least, aim
        Required and desired limits.
    higher_is_better
        Whether `value` is such a ratio.
    note
        How it was measured, when that is not plain.
    """

    quantity: str
    ours: str
    theirs: str
    value: float
    at_least: float | None = None
    aim: float | None = None
    higher_is_better: bool = True
    note: str = ""

    @property
    def verdict(self) -> str:
        """Whether it holds."""
        if self.at_least is None or self.aim is None:
            return ""
        if self._reaches(self.aim):
            return "aim"
        return "holds" if self._reaches(self.at_least) else "DOES NOT HOLD"

    def _reaches(self, limit: float) -> bool:
        return self.value >= limit if self.higher_is_better else self.value <= limit

    def cells(self) -> list[str]:
        """The line as text."""

        def number(x: float | None) -> str:
            return "" if x is None else f"{x:.0f}x" if self.higher_is_better else f"{x:.3g}"

        value = f"{self.value:.1f}x" if self.higher_is_better else f"{self.value:.3g}"
        return [self.quantity, self.ours, self.theirs, value, number(self.at_least), number(self.aim), self.verdict]


HEAD = ["quantity (simulated data)", "ours", "beside it", "value", "at least", "aim", ""]


def show(title: str, lines: list[Line], quick: bool = False) -> None:
    """Print a table, its notes below; after a quick trial without verdicts, which would mean nothing."""
    rows = [HEAD, *(line.cells()[: -1 if quick else None] for line in lines)]
    width = [max(len(row[i]) for row in rows if i < len(row)) for i in range(len(HEAD))]
    here = machine()
    print(f"\n{title}{'; a quick trial, not a measurement' if quick else ''}")
    print(f"{here['cpu']}, {here['cores']} cores, load {here['load_average'][0]}; seconds are CPU seconds")
    for row in rows:
        print("  ".join(cell.ljust(width[i]) if i < 3 else cell.rjust(width[i]) for i, cell in enumerate(row)))
    for line in lines:
        if line.note:
            print(f"  {line.quantity}: {line.note}")
    print(flush=True)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of every benchmark that prints such a table."""
    parser.add_argument("--folder", type=Path, default=None, help="where data is made (default: a temporary folder)")
    parser.add_argument("--quick", action="store_true", help="a tiny grid, once: shows that it runs, nothing else")
    parser.add_argument("--json", type=Path, default=None, help="also write the figures and the machine to this file")


def write(path: Path | None, name: str, lines: list[Line], **more: Any) -> None:
    """Write the figures, with the machine they were measured on."""
    if path is None:
        return
    content = {
        "benchmark": name,
        "simulated": True,
        "measured_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
        "machine": machine(),
        "lines": [{**asdict(line), "verdict": line.verdict} for line in lines],
        **more,
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
