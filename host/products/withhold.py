"""Where the verdict is `none`, nothing is said of any patch: its name, permittivity and ratio are withheld.

Processing writes the files so already. Readers apply it again, so that no command, export, figure or page can show a
number that the data do not support.
"""

from __future__ import annotations

from typing import Any

from polysight.host.verdict import read_verdict

_NOTHING: dict[str, Any] = {
    "name": None,
    "confidence": None,
    "permittivity": None,
    "ratio": None,
    "votes": {},
    "probabilities": {},
    "why": "",
}


def withhold(materials: dict[str, Any]) -> dict[str, Any]:
    """Content of materials.json as it may be shown.

    Unchanged unless the verdict is `none`. Then each patch keeps its place and size only: what it was named, what was
    measured of it and the truth beside it are null; sub-bands and the share of pixels named right are left out.
    """
    verdict = read_verdict(materials)
    segments = materials.get("segments")
    if verdict is None or verdict.usable or not isinstance(segments, list):
        return materials
    return {**materials, "pixel_accuracy": None, "segments": [_bare(s) for s in segments]}


def _bare(segment: dict[str, Any]) -> dict[str, Any]:
    hidden = _NOTHING | {key: None for key in ("truth", "inverse_ratio_std", "metal_like") if key in segment}
    return {key: value for key, value in segment.items() if key != "bands"} | hidden
