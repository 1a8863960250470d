"""Fig. 21: concentration of a sugar solution by regression on the polarisation angle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np
from matplotlib.axes import Axes

from polysight.materials import (
    ConcentrationResult,
    Library,
    concentrations,
    fit_concentration,
    polarisation_angle_rad,
)
from polysight.polarimetry import permittivity_from_ratio
from polysight.report import INK, PALETTE
from polysight_papers.sensys2026.item import Item, Picture, Run, Table, dress, new_figure
from polysight_papers.sensys2026.patches import calibrated_errors, draw, groups
from polysight_papers.sensys2026.table2 import published, table2

WATER = "Water (with glass)"


def fig21(run: Run) -> Item:
    """Water and five solutions in eight scans; each concentration is estimated by a line through the others."""
    group = groups()["liquids"]
    errors = calibrated_errors("liquids", 1 if run.quick else 3)
    materials = tuple(m for m in table2() if m.name == WATER or m.name.startswith("Cane Sugar"))
    library = draw(materials, group.angle_deg, errors, seed=21).library()
    result = fit_concentration(library, {WATER: 0.0})
    printed = published()["sugar_median_error_percent"]
    value = concentrations(library.names, {WATER: 0.0})
    fig = new_figure(11.5, 4.2)
    left, centre, right = fig.subplots(1, 3)
    _draw_line(left, library, value, result)
    _draw_permittivity(centre, library, value, {value[m.name]: m.permittivity.real for m in materials})
    _draw_errors(right, result, printed)
    return Item(
        "fig21",
        "Fig. 21: concentration of sugar in water",
        (
            f"Published median error {printed:g} %; simulated {result.median_error:.3f} % by weight, each concentration"
            f" estimated from the others. The 90 % intervals hold the truth in {100 * result.covered:.0f} % of"
            " the patches. The paper does not say whether its percentage is by weight or of the concentration, nor"
            " whether the line had seen the concentration it was asked for.",
            f"Water and five solutions at {group.angle_deg:.0f} degrees with the errors of the liquids.",
        ),
        (
            Table(
                "Each concentration estimated from the others, mean over eight scans",
                ("Solution", "true", "simulated", "90 % interval", "median error"),
                _rows(value, result),
            ),
        ),
        {
            "sugar": Picture(
                fig,
                "The calibration line with its interval, the permittivity by Eq. 3, and the distribution of errors.",
            )
        },
        {
            "published_median_error_percent": printed,
            "median_error_percent": result.median_error,
            "covered": result.covered,
            "line": asdict(result.line),
            "left_out": [asdict(r) for r in result.left_out],
        },
    )


def _draw_line(ax: Axes, library: Library, value: Mapping[str, float], result: ConcentrationResult) -> None:
    """Draw the calibration line with its interval, and the patches."""
    x = np.array([np.degrees(np.median(polarisation_angle_rad(e.p))) for e in library.entries])
    ax.plot(x, [value[e.name] for e in library.entries], "o", ms=4, color=PALETTE[0], label="patches")
    at = np.linspace(x.min() - 0.1, x.max() + 0.1, 100)
    low, high = result.line.interval(np.radians(at))
    ax.plot(at, result.line.percent(np.radians(at)), color=INK, lw=1.4, label="line")
    ax.fill_between(at, low, high, color=PALETTE[1], alpha=0.35, lw=0, label="90 % of new patches")
    dress(ax, "Concentration by polarisation angle", "polarisation angle arctan |P| (degrees)", "sugar (% by weight)")
    ax.legend(fontsize=8, frameon=False)


def _draw_permittivity(
    ax: Axes, library: Library, value: Mapping[str, float], published_eps: Mapping[float, float]
) -> None:
    """Draw the real part by Eq. 3 against concentration, beside the published values."""
    eps = [
        np.median(permittivity_from_ratio(e.p.astype(np.complex128), np.radians(e.incidence_deg)).real)
        for e in library.entries
    ]
    ax.plot([value[e.name] for e in library.entries], eps, "o", ms=4, color=PALETTE[0], label="patches, simulated")
    printed = zip(*sorted(published_eps.items()), strict=True)
    ax.plot(*printed, "x-", color=PALETTE[6], ms=7, lw=1.0, label="published, Table 2")
    dress(ax, "Apparent permittivity", "sugar (% by weight)", "real part ε′")
    ax.legend(fontsize=8, frameon=False)


def _draw_errors(ax: Axes, result: ConcentrationResult, printed: float) -> None:
    """Draw the distribution of the errors, each concentration left out; `printed` is the published median, percent."""
    error = np.sort([abs(r.percent - r.true_percent) for r in result.left_out])
    ax.step(np.concatenate([[0], error]), np.arange(error.size + 1) / error.size, where="post", color=PALETTE[0])
    ax.axvline(printed, color=PALETTE[6], ls="--", lw=1.2, label=f"published median {printed:g} %")
    ax.axvline(result.median_error, color=INK, ls=":", lw=1.2, label=f"simulated median {result.median_error:.3f} %")
    dress(ax, "Error, each concentration left out", "error (% by weight)", "share of patches")
    ax.legend(fontsize=8, facecolor="white", framealpha=1.0, edgecolor="none", loc="lower right")


def _rows(value: Mapping[str, float], result: ConcentrationResult) -> tuple[tuple[str, ...], ...]:
    """Return a table line for each solution, by concentration."""
    rows = []
    for name in sorted(value, key=lambda n: value[n]):
        of = [r for r in result.left_out if r.name == name]
        spread = np.median([abs(r.percent - r.true_percent) for r in of])
        rows.append((
            name, f"{value[name]:.1f} %", f"{np.mean([r.percent for r in of]):.2f} %",
            f"{np.mean([r.low for r in of]):.2f} … {np.mean([r.high for r in of]):.2f} %", f"{spread:.2f} %",
        ))  # fmt: skip
    return tuple(rows)
