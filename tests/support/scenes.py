"""Scene files small enough for a test: few positions, and a metal plate in the middle or an empty scene."""

from typing import Any

import tomli_w

COPPER = {"name": "copper", "centre_mm": [-40.0, 10.0], "size_mm": [50.0, 50.0], "metal": True}
PET = {"name": "PET", "centre_mm": [36.0, 6.0], "size_mm": [50.0, 50.0], "permittivity": [3.78, 0.7]}
# A copper plate that covers the whole image
EVERYWHERE = {"name": "copper", "centre_mm": [0.0, 0.0], "size_mm": [500.0, 400.0], "metal": True}


def write_small_scene(
    columns: int,
    rows: int,
    step_mm: tuple[float, float] = (10.0, 10.0),
    pulses: int = 2,
    pixels: int = 20,
    pixel_mm: float = 8.0,
    metal: bool = True,
    seed: int = 3,
) -> str:
    """Return the text of a scene file: grid, burst and a square image; with `metal` a plate of 60 mm in its middle."""
    scene: dict[str, Any] = {
        "name": "a metal plate" if metal else "nothing",
        "seed": seed,
        "grid": {"columns": columns, "rows": rows, "step_x_mm": step_mm[0], "step_y_mm": step_mm[1]},
        "burst": {"pulses": pulses},
        "image": {"columns": pixels, "rows": pixels, "pixel_mm": pixel_mm},
    }
    if metal:
        plate = {"name": "copper", "centre_mm": [0.0, 0.0], "size_mm": [60.0, 60.0], "metal": True}
        scene["plates"] = [plate]
    return tomli_w.dumps(scene)


def make_scene(
    *plates: dict[str, Any],
    columns: int,
    rows: int,
    step_mm: tuple[float, float] = (14.0, 8.0),
    pulses: int = 2,
    **more: Any,
) -> dict[str, Any]:
    """Return a scene of plates on a coarse grid; `more` are its other tables."""
    return {
        "name": "small",
        "grid": {"columns": columns, "rows": rows, "step_x_mm": step_mm[0], "step_y_mm": step_mm[1]},
        "burst": {"pulses": pulses},
        "image": {"columns": 50, "rows": 40, "pixel_mm": 4.0},
        "plates": list(plates),
        **more,
    }
