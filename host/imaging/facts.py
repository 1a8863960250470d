"""What quality.json says of the imaging: masked positions and their cost, the point response, the imager's notices."""

from __future__ import annotations

from typing import Any

import numpy as np

from polysight.host.imaging.images import ChannelImages, ImageBuilder
from polysight.host.imaging.resolution import point_response
from polysight.host.imaging.samples import BoardSamples


def imaging_facts(builder: ImageBuilder, images: ChannelImages) -> dict[str, Any]:
    """Content of `imaging` in quality.json, by board, plain numbers."""
    out: dict[str, Any] = {name: board_facts(board) for name, board in builder.boards.items()}
    if images.notices:
        out["notices"] = list(images.notices)
    return out


def board_facts(board: BoardSamples) -> dict[str, Any]:
    """One board's.

    `masked` is the share of the tapered aperture without data; `loss_db` what a point's sum loses by it, `-20 log10(1 -
    masked)`. Amplitudes in the image do not fall by it: it is divided by the positions that are there.
    """
    weights = board.weights
    masked = 1 - float(weights.sum() / board.taper.sum())
    facts: dict[str, Any] = {
        "positions": int(board.valid.size),
        "masked_positions": int(board.valid.size - board.valid.sum()),
        "rows_without_data": int((~board.valid.any(axis=1)).sum()),
        "masked": round(masked, 6),
        "frequencies": board.aperture.frequencies_hz.size,
    }
    if masked < 1:
        response = point_response(board.aperture, weights)
        facts["loss_db"] = round(-20 * float(np.log10(1 - masked)), 4) + 0.0
        for key in ("width_mm", "limit_mm", "paper_mm", "sidelobe_db"):
            facts[f"point_{key}"] = [round(v, 3) if np.isfinite(v) else None for v in getattr(response, key)]
    return facts
