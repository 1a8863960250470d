"""The facts of a scan: the lines of its manifest, each a JSON object."""

from pathlib import Path
from typing import Any

from polysight.store import MANIFEST
from polysight.store.manifest import decode_line, encode_line, parse


def load_facts(scan: Any, kind: str = "") -> list[dict[str, Any]]:
    """Return the valid facts of a scan: all, or those of one kind.

    `scan` is its folder, its manifest, or a `ScanFolder`. The keys by which a line refers to the previous one are left
    out.
    """
    path = Path(getattr(scan, "path", scan))
    if path.is_dir():
        path = path / MANIFEST
    facts = []
    for line in path.read_bytes().split(b"\n"):
        fact = decode_line(line)
        if fact is not None and kind in ("", fact["fact"]):
            facts.append({key: value for key, value in fact.items() if key not in ("count", "previous")})
    return facts


def parse_fact(fact: dict[str, Any]) -> Any:
    """Return the object that the program makes of a fact's line."""
    return parse(encode_line(fact)).facts[0]
