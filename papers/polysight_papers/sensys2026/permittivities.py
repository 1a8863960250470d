"""Permittivity in figures and in Table 2 of the POLySIGHT paper: Fig. 3, 16, 17 and 21.

Fig. 3 is reflectance and ratio against angle, Fig. 16 the contrast of materials at three angles, Fig. 17 the estimates
with plates at other places, Fig. 21 the concentration of a sugar solution by regression on the polarisation angle.
Table 2 goes through Eq. 3 (permittivity from the ratio of H to V) with pixels drawn at its own values.
"""

from collections.abc import Mapping
from dataclasses import asdict
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from polysight.materials import (
    ConcentrationResult,
    Library,
    concentrations,
    estimate_permittivity,
    fit_concentration,
    polarisation_angle_rad,
)
from polysight.polarimetry import brewster_angle_rad, fresnel, permittivity_from_ratio, ratio_from_permittivity
from polysight.report import INK, PALETTE
from polysight_papers.sensys2026 import item
from polysight_papers.sensys2026.images import plate, process_scan, simulate_scan
from polysight_papers.sensys2026.patches import calibrated_errors, count_draws, draw, groups

Complex = npt.NDArray[np.complex128]

# Materials of Fig. 3 and of Fig. 16, by their numbers in Table 2, and those that Fig. 16 compares in pairs.
COMMON = (1, 3, 6, 12, 13, 15, 21)
CONTRAST = (1, 13, 16, 12, 18, 6, 3)
CLUTTERED = ("Cardboard", "PET (1 mm)", "Acrylic (3 mm)")
WATER = item.Published(
    number=0,
    name="Water (without glass, 75 GHz)",
    permittivity=9.37 - 18.0j,
    thickness_mm=None,
    note="literature value quoted in section 9.2",
)
# Numbers in Table 2 of the metal, which has no Brewster angle, and of the material whose loss is not given.
METAL = 1
CORK = 23
LINES = ("-", "--", "-.", ":")
# Fig. 17: number of scans, as in the paper; plate centres within this distance of the middle and this far apart
# (chosen); materials by their numbers in Table 2.
PLACEMENTS = 8
REACH_MM = 60.0
APART_MM = 60.0
MATERIALS = {"PET": 6, "ceramic": 12}


def _list_published(numbers: tuple[int, ...]) -> tuple[item.Published, ...]:
    return tuple(item.table2()[n - 1] for n in numbers)


def fig3(run: item.Run) -> item.Item:
    """Return reflectances |r_s|^2 and |r_p|^2 and their ratio over the incidence angle (no random errors)."""
    del run
    materials = (*_list_published(COMMON), WATER)
    angle = np.arange(0.0, 90.0, 0.25)
    fig = item.new_figure(11.5, 4.4)
    axes = fig.subplots(1, 3)
    rows = []
    curves = {}
    for i, m in enumerate(materials):
        r_s, r_p = fresnel(m.permittivity, np.radians(angle))
        p = ratio_from_permittivity(m.permittivity, np.radians(angle))
        style = {"color": PALETTE[i], "ls": LINES[i % 4], "lw": 1.7, "label": m.name}
        axes[0].plot(angle, np.abs(r_s) ** 2, **style)
        axes[1].plot(angle, np.abs(r_p) ** 2, **style)
        axes[2].plot(angle, 20 * np.log10(np.abs(p)), **style)
        brewster = float(np.degrees(brewster_angle_rad(m.permittivity)))
        magnitudes = [abs(complex(ratio_from_permittivity(m.permittivity, np.radians(a)))) for a in (0, 55, 60)]
        rows.append((m.name, "–" if m.number == METAL else f"{brewster:.1f}°", *(f"{x:.2f}" for x in magnitudes)))
        curves[m.name] = {"R_s": np.abs(r_s) ** 2, "R_p": np.abs(r_p) ** 2, "abs_P": np.abs(p)}
    for ax, title, unit in zip(
        axes,
        ("(a) s-polarised", "(b) p-polarised", "(c) ratio P = r_s / r_p"),
        ("reflectance |r_s|²", "reflectance |r_p|²", "|P| (dB)"),
        strict=True,
    ):
        item.style_axes(ax, title, "incidence angle (degrees)", unit)
        ax.set_xlim(0, 90)
    axes[2].axvspan(55, 65, color="#DDCC77", alpha=0.35, lw=0)
    axes[2].set_ylim(-2, 42)
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    table = item.Table(
        "Angle of least p-reflectance (arctan √|ε|) and |P| at three angles",
        ("Material", "(pseudo-)Brewster", "|P| at 0°", "|P| at 55°", "|P| at 60°"),
        tuple(rows),
    )
    return item.Item(
        "fig3",
        "Fig. 3: Fresnel reflection of common materials",
        (
            "Eq. 2 at the permittivities of Table 2. At 0 degrees |P| = 1 for every material; the materials part"
            " between 55 and 65 degrees (shaded), the paper's “Goldilocks zone”. It is the p-polarised wave that"
            " vanishes at the Brewster angle; the paper's text says s.",
        ),
        (table,),
        {"reflectance": item.Picture(fig, "Reflectance of s and p, and their ratio, against the incidence angle.")},
        {"angle_deg": angle, "curves": curves},
    )


def _compute_d_prime(a: np.ndarray, b: np.ndarray) -> float:
    """Return the distance of two means in pooled standard deviations."""
    return float(abs(a.mean() - b.mean()) / np.sqrt((a.var() + b.var()) / 2))


def fig16(run: item.Run) -> item.Item:
    """Draw the level of |H| at 0 degrees and of |P| at 55 and 60, pixels of eight scans each."""
    materials = _list_published(CONTRAST)
    errors = calibrated_errors("solids", count_draws(run.quick))
    fig = item.new_figure(11.5, 4.6)
    axes = fig.subplots(1, 3, sharex=True)
    levels: dict[str, dict[str, np.ndarray]] = {}
    for ax, (angle, quantity) in zip(axes, ((0.0, "|H|"), (55.0, "|P|"), (60.0, "|P|")), strict=True):
        measured = draw(materials, angle, errors, seed=16)
        if quantity == "|H|":
            values = np.abs(measured.h)
        else:
            values = np.abs(measured.h / measured.v)
        # [scan, material, pixel].
        level = 20 * np.log10(values)
        levels[f"{angle:.0f}"] = {m.name: level[:, j].ravel() for j, m in enumerate(materials)}
        for j in range(len(materials)):
            x = j + np.random.default_rng(j).uniform(-0.28, 0.28, level[:, j].size)
            ax.plot(x, level[:, j].ravel(), item.MARKERS[j], ms=2.6, color=PALETTE[j], alpha=0.6)
            ax.plot([j - 0.35, j + 0.35], 2 * [float(np.median(level[:, j]))], color=INK, lw=1.4)
        item.style_axes(ax, f"incidence {angle:.0f}°: {quantity}", "", f"{quantity} relative to metal (dB)")
        ax.set_xticks(range(len(materials)), [m.name for m in materials], rotation=35, ha="right", fontsize=8)
    rows = [
        (f"{a} / {b}", *(f"{_compute_d_prime(level[a], level[b]):.1f}" for level in levels.values()))
        for a, b in combinations(CLUTTERED, 2)
    ]
    table = item.Table(
        "Distance of two materials' pixels, in standard deviations (0°: |H|, else |P|)",
        ("Pair", "0°", "55°", "60°"),
        tuple(rows),
    )
    return item.Item(
        "fig16",
        "Fig. 16: contrast across incidence angles",
        (
            "The paper's figure is qualitative: at 0 degrees only materials with distinct differences can be told"
            " apart, at 55 degrees cardboard, PET and acrylic are still cluttered, at 60 degrees they separate. Here"
            " pixels of eight placements with the errors of the solids (see “How the noise was set”). PET and acrylic"
            " do as the paper says. Cardboard is not among them here: by the permittivity that Table 2 gives it, 5.24,"
            " it differs from both at every angle.",
        ),
        (table,),
        {"contrast": item.Picture(fig, "Pixels (dots) and their median (bar) at three incidence angles.")},
        {"level_db": levels, "errors": vars(errors)},
    )


def _draw_estimates(axes: Any, estimates: list[tuple[complex, complex, float]], colour: str, label: str) -> None:
    """Draw estimated over true permittivities with their standard deviation: real parts, and losses."""
    true = np.array([value for value, _, _ in estimates], np.complex128)
    estimated = np.array([value for _, value, _ in estimates], np.complex128)
    std = [deviation for _, _, deviation in estimates]
    bars: dict[str, Any] = {"yerr": std, "fmt": "o", "ms": 4, "color": colour, "lw": 1, "label": label}
    axes[0].errorbar(true.real, estimated.real, **bars)
    axes[1].errorbar(-true.imag, -estimated.imag, **bars)


def table2_item(run: item.Run) -> item.Item:
    """Estimate Table 2 by Eq. 3 from pixels drawn at the published permittivities."""
    rows = []
    data = []
    fig = item.new_figure(10.5, 4.6)
    axes = fig.subplots(1, 2)
    for colour, (name, group) in zip((PALETTE[0], PALETTE[6], PALETTE[3]), groups().items(), strict=True):
        errors = calibrated_errors(name, count_draws(run.quick))
        # h and v of `measured` are [scan, material, pixel].
        measured = draw(group.materials, group.angle_deg, errors, seed=2)
        estimated: list[tuple[complex, complex, float]] = []
        for j, m in enumerate(group.materials):
            e = estimate_permittivity(measured.h[:, j].ravel(), measured.v[:, j].ravel(), np.radians(group.angle_deg))
            true = m.permittivity
            row = {"number": m.number, "name": m.name, "angle_deg": group.angle_deg}
            printed = (f"{true.real:.2f}", "–" if m.number == CORK else f"{-true.imag:.2f}")
            if e.value is None or e.real_std is None:
                rows.append((str(m.number), m.name, "metal", "metal", "metal-like", "", "", ""))
                data.append(row | {"recovered": None, "metal_like": True})
                continue
            relative_error = abs(e.value - true) / abs(true)
            rows.append(
                (
                    str(m.number),
                    m.name,
                    *printed,
                    f"{e.value.real:.2f}",
                    f"{-e.value.imag:.2f}",
                    f"± {e.real_std:.2f}",
                    f"{100 * relative_error:.1f} %",
                )
            )
            figures = {"published": true, "recovered": e.value, "std": e.real_std, "relative_error": relative_error}
            data.append(row | figures)
            estimated.append((true, e.value, e.real_std))
        _draw_estimates(axes, estimated, colour, f"{name}, {group.angle_deg:.0f}°")
    for ax, part in zip(axes, ("real part ε′", "loss ε″"), strict=True):
        item.style_axes(ax, part, f"published {part}", f"recovered {part}")
        ax.axline((1, 1), slope=1, color=INK, lw=0.8, ls=":")
        ax.legend(fontsize=8, frameon=False)
    worst = max((d for d in data if "relative_error" in d), key=lambda d: d["relative_error"])
    return item.Item(
        "table2",
        "Table 2: permittivity of 36 materials",
        (
            "The published values are put in as the truth, so agreement shows that the method finds the true value "
            "in spite of the noise, and with which error bar; it is not a second measurement of these materials. "
            "Metal has no determinable permittivity; the published value is a division by nearly zero. Cork's loss "
            "is not in the paper and is taken as zero.",
            f"Furthest from the truth: {worst['name']}, {100 * worst['relative_error']:.1f} % of |ε|.",
        ),
        (
            item.Table(
                "Permittivity by Eq. 3 from 96 pixels of eight placements; ± is the standard error of one patch",
                ("No.", "Material", "published ε′", "published ε″", "simulated ε′", "simulated ε″", "±", "apart"),
                tuple(rows),
            ),
        ),
        {"permittivity": item.Picture(fig, "Recovered against published; the dotted line is equality.")},
        {"materials": data},
    )


def places(seed: int, count: int = 3) -> list[tuple[float, float]]:
    """Draw random centres of plates, mm, at least `APART_MM` from each other in x or in y."""
    rng = np.random.default_rng(seed)
    centres: list[tuple[float, float]] = []
    while len(centres) < count:
        x, y = (round(float(c), 1) for c in rng.uniform(-REACH_MM, REACH_MM, 2))
        if all(max(abs(x - a), abs(y - b)) >= APART_MM for a, b in centres):
            centres.append((x, y))
        elif rng.random() < 0.05:
            # Two plates may leave no room for a third: start again now and then.
            centres.clear()
    return centres


def fig17(run: item.Run) -> item.Item:
    """Draw the permittivities of all pixels of PET and ceramic in scans with other placements."""
    count = PLACEMENTS
    if run.quick:
        count = 3
    true = {name: item.table2()[n - 1].permittivity for name, n in MATERIALS.items()}
    pixels: dict[str, list[Complex]] = {name: [] for name in true}
    centres = []
    for i in range(count):
        plate_centres = places(i)
        plates = [plate("copper", None, *plate_centres[0])]
        plates += [plate(name, eps, *xy) for (name, eps), xy in zip(true.items(), plate_centres[1:], strict=True)]
        with simulate_scan(f"placement {i + 1}", plates, run.config, seed=1700 + i) as (source, truth):
            result = process_scan(source, truth).result
        for patch in result.patches:
            if patch.truth is not None and patch.truth.name in pixels:
                inside = patch.patch.interior & np.isfinite(result.p)
                theta = np.broadcast_to(result.theta_rad, result.p.shape)[inside]
                pixels[patch.truth.name].append(permittivity_from_ratio(result.p[inside], theta))
        centres.append(dict(zip(("copper", *true), plate_centres, strict=True)))
    return _make_fig17_item(true, pixels, centres)


def _make_fig17_item(
    true: dict[str, complex], pixels: dict[str, list[Complex]], centres: list[dict[str, Any]]
) -> item.Item:
    """Draw the permittivity of each pixel and tabulate its variance, with the published one.

    `true` has the permittivity of each material, `pixels` those of each placement, `centres` the plates' places in mm.
    """
    fig = item.new_figure(11.5, 4.6)
    rows = []
    data = {}
    for ax, (name, eps) in zip(fig.subplots(1, 2), true.items(), strict=True):
        for i, values in enumerate(pixels[name]):
            ax.plot(values.real, -values.imag, item.MARKERS[i % 10], ms=3, color=PALETTE[i], label=f"placement {i + 1}")
        ax.plot(eps.real, -eps.imag, "x", color=INK, ms=11, mew=2.2, label="truth", zorder=5)
        item.style_axes(ax, name, "real part ε′", "loss ε″")
        all_pixels = np.concatenate(pixels[name])
        medians = np.array([np.median(v.real) - 1j * np.median(-v.imag) for v in pixels[name]])
        published = item.published_values()["location_variance"][name]
        for part, take, key in (("ε′", np.real, "real"), ("ε″", np.imag, "loss")):
            within = float(np.mean([take(v).var() for v in pixels[name]]))
            row = {"published": published[key], "all": float(take(all_pixels).var()), "within": within}
            row["between"] = float(take(medians).var())
            data[f"{name} {key}"] = row
            rows.append((name, part, *(f"{x:.4f}" for x in row.values())))
        offset = np.mean(all_pixels) - eps
        data[f"{name} offset"] = complex(offset)
        data[f"{name} pixels"] = [len(v) for v in pixels[name]]
    ax = fig.axes[1]
    ax.legend(fontsize=7.5, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    offsets = ", ".join(
        f"{n} {data[f'{n} offset'].real:+z.2f} in ε′, {-data[f'{n} offset'].imag:+z.2f} in ε″" for n in true
    )
    parts = {"real": "ε′", "loss": "ε″"}
    larger = [
        f"{n} {p}" for n in true for k, p in parts.items() if data[f"{n} {k}"]["all"] > data[f"{n} {k}"]["published"]
    ]
    return item.Item(
        "fig17",
        "Fig. 17: location independence",
        (
            f"{len(centres)} scans of the simulated rig at 55 degrees, all disturbances on; copper, PET and ceramic"
            " at random places; boxes as known, as the paper segments by hand. Eq. 3 at every pixel of a plate's"
            " interior (9 mm from the edge on).",
            f"Mean of the pixels less the truth: {offsets}. The variance is larger than published in"
            f" {', '.join(larger) or 'none'} and smaller in the others: the simulated rig's errors are not"
            " quite those of the paper's.",
        ),
        (
            item.Table(
                "Variance of the permittivity of pixels; within: mean over placements, between: of the medians",
                ("Material", "part", "published", "simulated, all pixels", "within a placement", "between placements"),
                tuple(rows),
            ),
        ),
        {"location": item.Picture(fig, "Permittivity of each pixel, a colour and marker for each placement.")},
        {"variances": data, "centres_mm": centres},
    )


WATER_IN_GLASS = "Water (with glass)"


def fig21(run: item.Run) -> item.Item:
    """Estimate the concentrations of water and five solutions, each by a line through the others."""
    group = groups()["liquids"]
    errors = calibrated_errors("liquids", count_draws(run.quick))
    materials = tuple(m for m in item.table2() if m.name == WATER_IN_GLASS or m.name.startswith("Cane Sugar"))
    library = draw(materials, group.angle_deg, errors, seed=21).library()
    result = fit_concentration(library, {WATER_IN_GLASS: 0.0})
    published_error = item.published_values()["sugar_median_error_percent"]
    percent_by_name = concentrations(library.names, {WATER_IN_GLASS: 0.0})
    fig = item.new_figure(11.5, 4.2)
    left_axes, centre, right = fig.subplots(1, 3)
    _draw_line(left_axes, library, percent_by_name, result)
    published_eps = {percent_by_name[m.name]: m.permittivity.real for m in materials}
    _draw_permittivity(centre, library, percent_by_name, published_eps)
    _draw_errors(right, result, published_error)
    return item.Item(
        "fig21",
        "Fig. 21: concentration of sugar in water",
        (
            f"Published median error {published_error:g} %; simulated {result.median_error:.3f} % by weight, each"
            " concentration estimated from the others. The 90 % intervals hold the truth in"
            f" {100 * result.covered:.0f} % of the patches. The paper does not say whether its percentage is by weight"
            " or of the concentration, nor whether the line had seen the concentration it was asked for.",
            f"Water and five solutions at {group.angle_deg:.0f} degrees with the errors of the liquids.",
        ),
        (
            item.Table(
                "Each concentration estimated from the others, mean over eight scans",
                ("Solution", "true", "simulated", "90 % interval", "median error"),
                _tabulate_concentrations(percent_by_name, result),
            ),
        ),
        {
            "sugar": item.Picture(
                fig,
                "The calibration line with its interval, the permittivity by Eq. 3, and the distribution of errors.",
            )
        },
        {
            "published_median_error_percent": published_error,
            "median_error_percent": result.median_error,
            "covered": result.covered,
            "line": asdict(result.line),
            "left_out": [asdict(r) for r in result.left_out],
        },
    )


def _draw_line(ax: Axes, library: Library, percent_by_name: Mapping[str, float], result: ConcentrationResult) -> None:
    """Draw the calibration line with its interval, and the patches."""
    x = np.array([np.degrees(np.median(polarisation_angle_rad(e.p))) for e in library.entries])
    ax.plot(x, [percent_by_name[e.name] for e in library.entries], "o", ms=4, color=PALETTE[0], label="patches")
    line_angles = np.linspace(x.min() - 0.1, x.max() + 0.1, 100)
    low, high = result.line.interval(np.radians(line_angles))
    ax.plot(line_angles, result.line.percent(np.radians(line_angles)), color=INK, lw=1.4, label="line")
    ax.fill_between(line_angles, low, high, color=PALETTE[1], alpha=0.35, lw=0, label="90 % of new patches")
    item.style_axes(
        ax, "Concentration by polarisation angle", "polarisation angle arctan |P| (degrees)", "sugar (% by weight)"
    )
    ax.legend(fontsize=8, frameon=False)


def _draw_permittivity(
    ax: Axes, library: Library, percent_by_name: Mapping[str, float], published_eps: Mapping[float, float]
) -> None:
    """Draw the real part by Eq. 3 against concentration, with the published values."""
    eps = [
        np.median(permittivity_from_ratio(e.p.astype(np.complex128), np.radians(e.incidence_deg)).real)
        for e in library.entries
    ]
    ax.plot(
        [percent_by_name[e.name] for e in library.entries], eps, "o", ms=4, color=PALETTE[0], label="patches, simulated"
    )
    printed = zip(*sorted(published_eps.items()), strict=True)
    ax.plot(*printed, "x-", color=PALETTE[6], ms=7, lw=1.0, label="published, Table 2")
    item.style_axes(ax, "Apparent permittivity", "sugar (% by weight)", "real part ε′")
    ax.legend(fontsize=8, frameon=False)


def _draw_errors(ax: Axes, result: ConcentrationResult, published_error: float) -> None:
    """Draw the distribution of the errors, each concentration left out; `published_error` is a median, percent."""
    error = np.sort([abs(r.percent - r.true_percent) for r in result.left_out])
    ax.step(np.concatenate([[0], error]), np.arange(error.size + 1) / error.size, where="post", color=PALETTE[0])
    ax.axvline(published_error, color=PALETTE[6], ls="--", lw=1.2, label=f"published median {published_error:g} %")
    ax.axvline(result.median_error, color=INK, ls=":", lw=1.2, label=f"simulated median {result.median_error:.3f} %")
    item.style_axes(ax, "Error, each concentration left out", "error (% by weight)", "share of patches")
    ax.legend(fontsize=8, facecolor="white", framealpha=1.0, edgecolor="none", loc="lower right")


def _tabulate_concentrations(
    percent_by_name: Mapping[str, float], result: ConcentrationResult
) -> tuple[tuple[str, ...], ...]:
    """Return a table line for each solution, by concentration."""
    rows = []
    for name in sorted(percent_by_name, key=lambda n: percent_by_name[n]):
        errors_of_name = [r for r in result.left_out if r.name == name]
        spread = np.median([abs(r.percent - r.true_percent) for r in errors_of_name])
        rows.append(
            (
                name,
                f"{percent_by_name[name]:.1f} %",
                f"{np.mean([r.percent for r in errors_of_name]):.2f} %",
                f"{np.mean([r.low for r in errors_of_name]):.2f} … {np.mean([r.high for r in errors_of_name]):.2f} %",
                f"{spread:.2f} %",
            )
        )
    return tuple(rows)
