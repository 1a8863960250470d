"""Fig. 21 from the published files: concentration of sugar in water, and the POLySIGHT paper's errors."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from polysight.materials import Entry, Library, concentrations, fit_concentration, polarisation_angle_rad
from polysight.report import INK, PALETTE
from polysight_papers.sensys2026.dataset import AuthorsData
from polysight_papers.sensys2026.item import Item, Picture, Table, new_figure, published_values, style_axes
from polysight_papers.sensys2026.permittivities import WATER_IN_GLASS
from polysight_shared.errors import DataError, ErrorCode

FIG21_NOTE = (
    "A straight line from the polarisation angle to the concentration, each concentration estimated by a line"
    " through the others. The paper does not say whether its line was fitted to the estimated concentration, too; "
    "the last row is for a line that was."
)


def authors_fig21(data: AuthorsData) -> Item:
    """Return the concentration of sugar by a line through the other concentrations. Raises DataError."""
    printed = published_values()["sugar_median_error_percent"]
    tables = []
    content = {}
    plots = []
    reasons = []
    for source, library in data.sources.items():
        concentration_of_name = concentrations(library.names, {WATER_IN_GLASS: 0.0})
        solutions = [e for e in library.entries if e.name in concentration_of_name]
        if not solutions:
            continue
        # The line holds for one incidence angle: that of the most solutions.
        angles = {e.incidence_deg for e in solutions}
        best = max(angles, key=lambda angle: len({e.name for e in _select_entries_near(solutions, angle)}))
        near = Library(tuple(_select_entries_near(solutions, best)))
        try:
            result = fit_concentration(near, {WATER_IN_GLASS: 0.0})
        except DataError as e:
            reasons.append(f"{source}: {e.what}")
            continue
        # Of every patch: the median over its pixels, and the true concentration.
        x = np.array([float(np.median(polarisation_angle_rad(e.p))) for e in near.entries])
        y = np.array([concentration_of_name[e.name] for e in near.entries])
        # Of the line through all patches, which has seen the concentrations that it estimates.
        median_error = float(np.median(np.abs(result.line.percent(x) - y)))
        median = f"{result.median_error:.3f} %"
        count = str(len(result.left_out))
        left_out = ("median error, each concentration left out", f"published {printed:g} %", median, count, "")
        optimistic = ("median error, line has seen them (optimistic)", "", f"{median_error:.3f} %", "", "")
        rows = [*_tabulate_solutions(result, concentration_of_name), left_out, optimistic]
        tables.append(
            Table(
                f"Concentration estimated from the others, {source}, {best:.0f} degrees",
                ("Solution", "true", "found", "patches", "median error"),
                tuple(rows),
            )
        )
        content[source] = {
            "published_median_error_percent": printed,
            "median_error_percent": result.median_error,
            "median_error_seen_percent": median_error,
            "angle_deg": best,
            "line": asdict(result.line),
            "left_out": [asdict(r) for r in result.left_out],
        }
        plots.append((source, x, y, result))
    if not plots:
        raise DataError(
            "no sugar solutions to draw a line through",
            "; ".join(reasons) or "none of the names means water or cane sugar",
            "see what the names were taken for, and --names",
            code=ErrorCode.NO_DATA,
        )
    return Item(
        "fig21",
        "Fig. 21: concentration of sugar in water",
        (FIG21_NOTE,),
        tuple(tables),
        {"sugar": Picture(_draw_sugar(plots, printed), "The lines, and the distribution of errors.")},
        content,
    )


def _select_entries_near(entries: Iterable[Entry], angle_deg: float) -> list[Entry]:
    """Return the entries within a degree of an incidence angle."""
    return [e for e in entries if abs(e.incidence_deg - angle_deg) < 1]


def _tabulate_solutions(result: Any, concentration_of_name: Mapping[str, float]) -> list[tuple[str, ...]]:
    """Return a row for each solution: name, true and mean estimated concentration, patches, median error.

    `result` is that of `fit_concentration`; its `left_out` has the estimate of every patch.
    """
    rows = []
    names = {r.name for r in result.left_out}
    for name in sorted(names, key=lambda n: concentration_of_name[n]):
        estimates = [r for r in result.left_out if r.name == name]
        error = np.median([abs(r.percent - r.true_percent) for r in estimates])
        rows.append(
            (
                name,
                f"{concentration_of_name[name]:.1f} %",
                f"{np.mean([r.percent for r in estimates]):.2f} %",
                str(len(estimates)),
                f"{error:.2f} %",
            )
        )
    return rows


def _draw_sugar(plots: list[tuple[str, Any, Any, Any]], printed: float) -> Any:
    """Draw concentration by polarisation angle, and the distribution of errors with each concentration left out.

    `plots` has for each source: name, polarisation angles in radians, concentrations in %, and the result; `printed` is
    the published median error in %.
    """
    fig = new_figure(11.0, 4.3)
    left_axes, right = fig.subplots(1, 2)
    for k, (source, x, y, result) in enumerate(plots):
        colour = (PALETTE[0], PALETTE[6], PALETTE[3])[k % 3]
        angle = np.degrees(x)
        line_angles = np.linspace(angle.min() - 0.1, angle.max() + 0.1, 50)
        left_axes.plot(angle, y, "osD"[k % 3], ms=4, color=colour, label=source)
        left_axes.plot(line_angles, result.line.percent(np.radians(line_angles)), color=colour, lw=1.2)
        error = np.sort([abs(r.percent - r.true_percent) for r in result.left_out])
        share = np.arange(error.size + 1) / error.size
        label = f"{source}: median {result.median_error:.3f} %"
        right.step(np.concatenate([[0], error]), share, where="post", color=colour, label=label)
    right.axvline(printed, color=INK, ls="--", lw=1.2, label=f"published median {printed:g} %")
    style_axes(
        left_axes,
        "Concentration by polarisation angle",
        "polarisation angle arctan |P| (degrees)",
        "sugar (% by weight)",
    )
    style_axes(right, "Error, each concentration left out", "error (% by weight)", "share of patches")
    left_axes.legend(fontsize=8, frameon=False)
    right.legend(fontsize=8, frameon=False)
    return fig
