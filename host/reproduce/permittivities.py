"""Table 2: the permittivity of 36 materials recovered from noisy pixels, beside the published one."""

from __future__ import annotations

from typing import Any

import numpy as np

from polysight.host.materials import estimate_permittivity
from polysight.host.report.figures import INK, PALETTE
from polysight.host.reproduce.item import Item, Picture, Run, Table, dress, new_figure
from polysight.host.reproduce.patches import calibrated_errors, draw, groups


def table2_item(run: Run) -> Item:
    """Pixels drawn at the published permittivities go through Eq. 3 as measured ones would."""
    rows, data = [], []
    fig = new_figure(10.5, 4.6)
    axes = fig.subplots(1, 2)
    for colour, (name, group) in zip((PALETTE[0], PALETTE[6], PALETTE[3]), groups().items(), strict=True):
        errors = calibrated_errors(name, 1 if run.quick else 3)
        seen = draw(group.materials, group.angle_deg, errors, seed=2)
        found: list[tuple[complex, complex, float]] = []
        for j, m in enumerate(group.materials):
            e = estimate_permittivity(seen.h[:, j].ravel(), seen.v[:, j].ravel(), np.radians(group.angle_deg))
            true, row = m.permittivity, {"number": m.number, "name": m.name, "angle_deg": group.angle_deg}
            told = (f"{true.real:.2f}", "–" if m.number == 23 else f"{-true.imag:.2f}")
            if e.value is None or e.real_std is None:
                rows.append((str(m.number), m.name, "metal", "metal", "metal-like", "", "", ""))
                data.append(row | {"recovered": None, "metal_like": True})
                continue
            apart = abs(e.value - true) / abs(true)
            rows.append((
                str(m.number), m.name, *told, f"{e.value.real:.2f}", f"{-e.value.imag:.2f}", f"± {e.real_std:.2f}",
                f"{100 * apart:.1f} %",
            ))  # fmt: skip
            data.append(row | {"published": true, "recovered": e.value, "std": e.real_std, "relative_error": apart})
            found.append((true, e.value, e.real_std))
        bars: dict[str, Any] = {
            "yerr": [f[2] for f in found], "fmt": "o", "ms": 4, "color": colour, "lw": 1,
            "label": f"{name}, {group.angle_deg:.0f}°",
        }  # fmt: skip
        axes[0].errorbar([f[0].real for f in found], [f[1].real for f in found], **bars)
        axes[1].errorbar([-f[0].imag for f in found], [-f[1].imag for f in found], **bars)
    for ax, part in zip(axes, ("real part ε′", "loss ε″"), strict=True):
        dress(ax, part, f"published {part}", f"recovered {part}")
        ax.axline((1, 1), slope=1, color=INK, lw=0.8, ls=":")
        ax.legend(fontsize=8, frameon=False)
    worst = max((d for d in data if "relative_error" in d), key=lambda d: d["relative_error"])
    return Item(
        "table2",
        "Table 2: permittivity of 36 materials",
        (
            "The published values are put in as the truth, so agreement shows that the method recovers what is there"
            " under the noise, and with which error bar; it is not a second measurement of these materials. Metal has"
            " no determinable permittivity; the published one is a division by nearly nothing. Cork's loss is not in"
            " the paper and is taken as zero.",
            f"Furthest from the truth: {worst['name']}, {100 * worst['relative_error']:.1f} % of |ε|.",
        ),
        (
            Table(
                "Permittivity by Eq. 3 from 96 pixels of eight placements; ± is the standard error of one patch",
                ("No.", "Material", "published ε′", "published ε″", "simulated ε′", "simulated ε″", "±", "apart"),
                tuple(rows),
            ),
        ),
        {"permittivity": Picture(fig, "Recovered against published; the dotted line is equality.")},
        {"materials": data},
    )
