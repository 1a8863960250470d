"""Fig. 3 (reflectance and ratio against angle) and Fig. 16 (contrast of materials at three angles)."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from polysight.host.materials import Published, table2
from polysight.host.polarimetry import brewster_angle_rad, fresnel, ratio_from_permittivity
from polysight.host.report.figures import INK, PALETTE
from polysight.host.reproduce.item import MARKERS, Item, Picture, Run, Table, dress, new_figure
from polysight.host.reproduce.patches import calibrated_errors, draw

COMMON = (1, 3, 6, 12, 13, 15, 21)
CONTRAST = (1, 13, 16, 12, 18, 6, 3)
CLUTTERED = ("Cardboard", "PET (1 mm)", "Acrylic (3 mm)")
WATER = Published(0, "Water (without glass, 75 GHz)", 9.37 - 18.0j, None, "literature value quoted in section 9.2")
LINES = ("-", "--", "-.", ":")


def _rows(numbers: tuple[int, ...]) -> tuple[Published, ...]:
    return tuple(table2()[n - 1] for n in numbers)


def fig3(run: Run) -> Item:
    """Reflectances |r_s|^2 and |r_p|^2 and their ratio over the incidence angle; nothing is random here."""
    del run
    materials = (*_rows(COMMON), WATER)
    angle = np.arange(0.0, 90.0, 0.25)
    fig = new_figure(11.5, 4.4)
    axes = fig.subplots(1, 3)
    rows, curves = [], {}
    for i, m in enumerate(materials):
        r_s, r_p = fresnel(m.permittivity, np.radians(angle))
        p = ratio_from_permittivity(m.permittivity, np.radians(angle))
        style = {"color": PALETTE[i], "ls": LINES[i % 4], "lw": 1.7, "label": m.name}
        axes[0].plot(angle, np.abs(r_s) ** 2, **style)
        axes[1].plot(angle, np.abs(r_p) ** 2, **style)
        axes[2].plot(angle, 20 * np.log10(np.abs(p)), **style)
        brewster = float(np.degrees(brewster_angle_rad(m.permittivity)))
        at = [abs(complex(ratio_from_permittivity(m.permittivity, np.radians(a)))) for a in (0, 55, 60)]
        rows.append((m.name, "–" if m.number == 1 else f"{brewster:.1f}°", *(f"{x:.2f}" for x in at)))
        curves[m.name] = {"R_s": np.abs(r_s) ** 2, "R_p": np.abs(r_p) ** 2, "abs_P": np.abs(p)}
    for ax, title, unit in zip(
        axes,
        ("(a) s-polarised", "(b) p-polarised", "(c) ratio P = r_s / r_p"),
        ("reflectance |r_s|²", "reflectance |r_p|²", "|P| (dB)"),
        strict=True,
    ):
        dress(ax, title, "incidence angle (degrees)", unit)
        ax.set_xlim(0, 90)
    axes[2].axvspan(55, 65, color="#DDCC77", alpha=0.35, lw=0)
    axes[2].set_ylim(-2, 42)
    fig.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9, frameon=False)
    table = Table(
        "Angle of least p-reflectance (arctan √|ε|) and |P| at three angles",
        ("Material", "(pseudo-)Brewster", "|P| at 0°", "|P| at 55°", "|P| at 60°"),
        tuple(rows),
    )
    return Item(
        "fig3",
        "Fig. 3: Fresnel reflection of common materials",
        (
            "Eq. 2 at the permittivities of Table 2. At 0 degrees |P| = 1 for every material; the materials part"
            " between 55 and 65 degrees (shaded), the paper's “Goldilocks zone”. It is the p-polarised wave that"
            " vanishes at the Brewster angle; the paper's text says s.",
        ),
        (table,),
        {"reflectance": Picture(fig, "Reflectance of s and p, and their ratio, against the incidence angle.")},
        {"angle_deg": angle, "curves": curves},
    )


def _d_prime(a: np.ndarray, b: np.ndarray) -> float:
    """Distance of two means in units of the pooled standard deviation."""
    return float(abs(a.mean() - b.mean()) / np.sqrt((a.var() + b.var()) / 2))


def fig16(run: Run) -> Item:
    """Level of |H| at 0 degrees and of |P| at 55 and 60, pixels of eight scans each."""
    materials = _rows(CONTRAST)
    errors = calibrated_errors("solids", 1 if run.quick else 3)
    fig = new_figure(11.5, 4.6)
    axes = fig.subplots(1, 3, sharex=True)
    levels: dict[str, dict[str, np.ndarray]] = {}
    for ax, (angle, what) in zip(axes, ((0.0, "|H|"), (55.0, "|P|"), (60.0, "|P|")), strict=True):
        seen = draw(materials, angle, errors, seed=16)
        values = np.abs(seen.h) if what == "|H|" else np.abs(seen.h / seen.v)
        level = 20 * np.log10(values)
        levels[f"{angle:.0f}"] = {m.name: level[:, j].ravel() for j, m in enumerate(materials)}
        for j in range(len(materials)):
            x = j + np.random.default_rng(j).uniform(-0.28, 0.28, level[:, j].size)
            ax.plot(x, level[:, j].ravel(), MARKERS[j], ms=2.6, color=PALETTE[j], alpha=0.6)
            ax.plot([j - 0.35, j + 0.35], 2 * [float(np.median(level[:, j]))], color=INK, lw=1.4)
        dress(ax, f"incidence {angle:.0f}°: {what}", "", f"{what} relative to metal (dB)")
        ax.set_xticks(range(len(materials)), [m.name for m in materials], rotation=35, ha="right", fontsize=8)
    rows = [
        (f"{a} / {b}", *(f"{_d_prime(level[a], level[b]):.1f}" for level in levels.values()))
        for a, b in combinations(CLUTTERED, 2)
    ]
    table = Table(
        "Distance of two materials' pixels, in standard deviations (0°: |H|, else |P|)",
        ("Pair", "0°", "55°", "60°"),
        tuple(rows),
    )
    return Item(
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
        {"contrast": Picture(fig, "Pixels (dots) and their median (bar) at three incidence angles.")},
        {"level_db": levels, "errors": vars(errors)},
    )
