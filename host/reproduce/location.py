"""Fig. 17: permittivity of PET and ceramic at random places, from images of the simulated rig."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from polysight.host.materials import table2
from polysight.host.polarimetry import permittivity_from_ratio
from polysight.host.report.figures import INK, PALETTE
from polysight.host.reproduce.item import MARKERS, Item, Picture, Run, Table, dress, new_figure
from polysight.host.reproduce.published import published
from polysight.host.reproduce.scenes import imaged, plate, scanned

Complex = npt.NDArray[np.complex128]
PLACEMENTS = 8
REACH_MM, APART_MM = 60.0, 60.0
MATERIALS = {"PET": 6, "ceramic": 12}
"""Rows of Table 2."""


def places(seed: int, count: int = 3) -> list[tuple[float, float]]:
    """Random centres of plates, mm, at least `APART_MM` from each other in x or in y."""
    rng = np.random.default_rng(seed)
    found: list[tuple[float, float]] = []
    while len(found) < count:
        x, y = (round(float(c), 1) for c in rng.uniform(-REACH_MM, REACH_MM, 2))
        if all(max(abs(x - a), abs(y - b)) >= APART_MM for a, b in found):
            found.append((x, y))
        elif rng.random() < 0.05:
            found.clear()  # two plates may leave no room for a third
    return found


def fig17(run: Run) -> Item:
    """Eps of every pixel of PET and ceramic in scans with the plates at other places."""
    count = 3 if run.quick else PLACEMENTS
    true = {name: table2()[n - 1].permittivity for name, n in MATERIALS.items()}
    pixels: dict[str, list[Complex]] = {name: [] for name in true}
    centres = []
    for i in range(count):
        at = places(i)
        plates = [plate("copper", None, *at[0])]
        plates += [plate(name, eps, *xy) for (name, eps), xy in zip(true.items(), at[1:], strict=True)]
        with scanned(f"placement {i + 1}", plates, run.config, seed=1700 + i) as (source, truth):
            seen = imaged(source, truth).result
        for patch in seen.patches:
            if patch.truth is not None and patch.truth.name in pixels:
                inside = patch.patch.interior & np.isfinite(seen.p)
                theta = np.broadcast_to(seen.theta_rad, seen.p.shape)[inside]
                pixels[patch.truth.name].append(permittivity_from_ratio(seen.p[inside], theta))
        centres.append(dict(zip(("copper", *true), at, strict=True)))
    return _item(true, pixels, centres)


def _item(true: dict[str, complex], pixels: dict[str, list[Complex]], centres: list[dict[str, Any]]) -> Item:
    fig = new_figure(11.5, 4.6)
    rows, data = [], {}
    for ax, (name, eps) in zip(fig.subplots(1, 2), true.items(), strict=True):
        for i, values in enumerate(pixels[name]):
            ax.plot(values.real, -values.imag, MARKERS[i % 10], ms=3, color=PALETTE[i], label=f"placement {i + 1}")
        ax.plot(eps.real, -eps.imag, "x", color=INK, ms=11, mew=2.2, label="truth", zorder=5)
        dress(ax, name, "real part ε′", "loss ε″")
        every = np.concatenate(pixels[name])
        medians = np.array([np.median(v.real) - 1j * np.median(-v.imag) for v in pixels[name]])
        told = published()["location_variance"][name]
        for part, take, key in (("ε′", np.real, "real"), ("ε″", np.imag, "loss")):
            within = float(np.mean([take(v).var() for v in pixels[name]]))
            row = {"published": told[key], "all": float(take(every).var()), "within": within}
            row["between"] = float(take(medians).var())
            data[f"{name} {key}"] = row
            rows.append((name, part, *(f"{x:.4f}" for x in row.values())))
        offset = np.mean(every) - eps
        data[f"{name} offset"] = complex(offset)
        data[f"{name} pixels"] = [len(v) for v in pixels[name]]
    ax = fig.axes[1]
    ax.legend(fontsize=7.5, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    offsets = ", ".join(
        f"{n} {data[f'{n} offset'].real:+.2f} in ε′, {-data[f'{n} offset'].imag:+.2f} in ε″" for n in true
    )
    parts = {"real": "ε′", "loss": "ε″"}
    larger = [
        f"{n} {p}" for n in true for k, p in parts.items() if data[f"{n} {k}"]["all"] > data[f"{n} {k}"]["published"]
    ]
    return Item(
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
            Table(
                "Variance of the permittivity of pixels; within: mean over placements, between: of the medians",
                ("Material", "part", "published", "simulated, all pixels", "within a placement", "between placements"),
                tuple(rows),
            ),
        ),
        {"location": Picture(fig, "Permittivity of each pixel, a colour and marker for each placement.")},
        {"variances": data, "centres_mm": centres},
    )
