"""The published numbers that results are shown beside, as data (`published.json`; Table 2 is in `polysight.host.materials`)."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any


@cache
def published() -> dict[str, Any]:
    """Content of `published.json`; percentages as the paper prints them."""
    return json.loads(
        resources.files("polysight.host.reproduce").joinpath("published.json").read_text(encoding="utf-8")
    )
