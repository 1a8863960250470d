"""The facts of a scan as they are in its file."""

from pathlib import Path
from typing import Any

from polysight.store import MANIFEST
from polysight.store.manifest import decode_line, encode_line, parse


def load_facts(scan: Any, kind: str = "") -> list[dict[str, Any]]:
    """Return the valid facts of a scan (its folder, manifest, or a `ScanFolder`), of one kind or all, without chain."""
    path = Path(getattr(scan, "path", scan))
    lines = (path / MANIFEST if path.is_dir() else path).read_bytes().split(b"\n")
    facts = [fact for line in lines if (fact := decode_line(line)) is not None and kind in ("", fact["fact"])]
    return [{key: value for key, value in fact.items() if key not in ("count", "previous")} for fact in facts]


def parse_fact(fact: dict[str, Any]) -> Any:
    """Return a fact as the program reads its line."""
    return parse(encode_line(fact)).facts[0]
