"""Fig. 4: the same plates seen front-on and at a steep angle."""

from __future__ import annotations

import tempfile
import tomllib
from pathlib import Path

import numpy as np
import tomli_w

from polysight.host.materials import table2
from polysight.host.polarimetry import ratio_from_permittivity
from polysight.host.report import context_of
from polysight.host.reproduce.images import Seen, draw_row, ratio_data, ratio_table
from polysight.host.reproduce.item import Item, Picture, Run, new_figure
from polysight.host.reproduce.scenes import imaged, plate, scanned

FRONT_ON_MM = 60.0
"""Distance of each board from the middle in the front-on rig: 1.4 degrees of incidence."""
FRONT_ON_GRID = {"columns": 81, "rows": 81, "step_x_mm": 4.5, "step_y_mm": 4.5}
"""Monostatic, a step d makes ghosts at wavelength * distance / 2 d: 216 mm for 4.5 mm, outside the plates."""
ROWS = (3, 6, 15)
"""Acrylic, PET and glass in Table 2."""
PLACES_MM = ((-60.0, 0.0), (60.0, 0.0), (0.0, 60.0))


def front_on(config: Path, folder: Path) -> Path:
    """The rig file with its boards side by side, written into a folder."""
    rig = tomllib.loads(config.read_text(encoding="utf-8"))
    for board in rig["boards"]:
        shift = next(step["shift_mm"] for step in reversed(board["mount"]) if "shift_mm" in step)
        shift[0] = float(np.copysign(FRONT_ON_MM, shift[0]))
    path = folder / "front-on.toml"
    path.write_text(tomli_w.dumps(rig), encoding="utf-8")
    return path


def _seen(name: str, config: Path, **more: object) -> Seen:
    plates = [plate("copper", None, 0.0, 0.0)]
    plates += [
        plate(table2()[n - 1].name, table2()[n - 1].permittivity, *xy) for n, xy in zip(ROWS, PLACES_MM, strict=True)
    ]
    with scanned(name, plates, config, seed=400, **more) as (source, truth):
        found = imaged(source, truth)
    return Seen(found.result, context_of(found.result, found.x_m, found.y_m, title=name, simulated=True, plates=truth))


def fig4(run: Run) -> Item:
    """H, V and P of copper, acrylic, PET and glass with the boards side by side, and with those of the rig file."""
    with tempfile.TemporaryDirectory(prefix="polysight-reproduce-") as temporary:
        near = front_on(run.config, Path(temporary))
        views = {"front-on": _seen("front-on", near, grid=FRONT_ON_GRID, object_gain=10.0)}
    views["steep"] = _seen("steep", run.config)
    fig = new_figure(11.5, 6.8)
    for line, (name, view) in zip(fig.subplots(2, 3), views.items(), strict=True):
        draw_row(fig, line, view, ("amplitude_h", "amplitude_v", "amplitude_p"), name)
    theta = {name: float(np.mean(view.result.theta_rad)) for name, view in views.items()}
    eps = [table2()[n - 1].permittivity for n in ROWS]
    spread = {k: float(np.ptp(20 * np.log10(np.abs(ratio_from_permittivity(eps, t))))) for k, t in theta.items()}
    return Item(
        "fig4",
        "Fig. 4: front-on against steep incidence",
        (
            f"Boards side by side ({np.degrees(theta['front-on']):.1f} degrees of incidence) and as in the rig file"
            f" ({np.degrees(theta['steep']):.1f} degrees). By Fresnel |P| of acrylic, PET and glass lies within"
            f" {spread['front-on']:.3f} dB front-on and spreads over {spread['steep']:.1f} dB at the steep angle. The"
            " published figure is a picture that says the same.",
        ),
        (ratio_table(views),),
        {"angles": Picture(fig, "|H|, |V| and |P| relative to metal, above front-on, below at the steep angle.")},
        {"ratios": ratio_data(views), "incidence_deg": {k: float(np.degrees(t)) for k, t in theta.items()}},
    )
