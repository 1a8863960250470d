"""Scenes simulated with the simulated rig and processed like recorded scans, and the figures of their images.

Of the POLySIGHT paper: Fig. 4 (front-on and steep), Fig. 13 and 19 (materials), Fig. 14 (phase).
"""

import tempfile
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy
import tomli_w
from matplotlib.patheffects import withStroke

from polysight.jobs.demo import run_simulator
from polysight.jobs.train import EDGE_MM
from polysight.materials import KnownScene, MaterialsResult, TruthPlate, make_patches_from_plates, read_truth
from polysight.pipeline import Pipeline
from polysight.polarimetry import ratio_from_permittivity
from polysight.products import ProcessedScan
from polysight.report import INK, draw_channel
from polysight.results import ScanFacts, ScanMaterials, ScanQuality
from polysight.store import TRUTH, RawSource, ScanFolder
from polysight_papers.sensys2026.item import Item, Picture, Run, Table, new_figure, style_axes, table2
from polysight_shared.errors import ErrorCode, ScanError

# Sides of the plates, as in `examples/nine-materials.toml`.
PLATE_MM = 45.0
GRID = {"columns": 49, "rows": 49, "step_x_mm": 10.0, "step_y_mm": 6.0}
"""The sparse aperture of `examples/nine-materials.toml`, explained there."""
# Distance of the object plane there: 55 degrees of incidence.
PLANE_MM = 499.0


def plate(name: str, eps: complex | None, x_mm: float, y_mm: float) -> dict[str, Any]:
    """Return a square plate for the scene file; without permittivity it is metal."""
    if eps is None:
        material = {"metal": True}
    else:
        material = {"permittivity": [eps.real, -eps.imag]}
    return {"name": name, "centre_mm": [x_mm, y_mm], "size_mm": [PLATE_MM, PLATE_MM], **material}


@contextmanager
def simulate_scan(
    name: str, plates: Sequence[Mapping[str, Any]], config: Path, seed: int, **more: Any
) -> Iterator[tuple[ScanFolder, tuple[TruthPlate, ...]]]:
    """Simulate a scan of plates with all disturbances; yield it with its truth. Its files are deleted afterwards.

    `more` are further keys of the scene file. Raises ScanError.
    """
    content = {"name": name, "seed": seed, "object_distance_mm": PLANE_MM, "grid": GRID, "plates": list(plates)} | more
    with tempfile.TemporaryDirectory(prefix="polysight-reproduce-") as temporary:
        file = Path(temporary) / "scene.toml"
        folder = Path(temporary) / "scan"
        file.write_text(tomli_w.dumps(content), encoding="utf-8")
        if run_simulator(["simulate", str(file), "--config", str(config), "--out", str(folder)]):
            raise ScanError(
                f"the scene {name!r} could not be simulated", "the lines above say why", "correct the rig file",
                code=ErrorCode.VALUE_INVALID,
            )  # fmt: skip
        yield ScanFolder.load(folder), read_truth(folder / TRUTH)


@dataclass(frozen=True)
class Imaged:
    """Materials found in a scan's images, and the images' axes in the rig frame (float64, metres)."""

    result: MaterialsResult
    x_m: npt.NDArray[np.float64]
    y_m: npt.NDArray[np.float64]


def process_scan(source: RawSource, plates: tuple[TruthPlate, ...]) -> Imaged:
    """Process a scan with known positions of its plates (the paper segments by hand), referenced to its metal plate."""
    pipeline = Pipeline(source)
    for row in source.rows():
        pipeline.add_row(row)
    images = pipeline.form_images()
    metal = next(p for p in plates if p.metal)
    labelled_patches, _ = make_patches_from_plates(plates, images.x_m, images.y_m, EDGE_MM)
    result = pipeline.find_materials(images, KnownScene(labelled_patches, metal.box_mm, plates=plates))
    return Imaged(result, images.x_m, images.y_m)


PLACES_MM = tuple((60.0 * x, -60.0 * y) for y, x in product((-1, 0, 1), repeat=2))
"""Nine positions; the metal reference is in the middle."""
SETS: dict[str, tuple[int, ...]] = {
    "solids": (13, 12, 19, 3, 14, 6, 15, 21),
    "liquids": (27, 25, 24, 26),
    "powders": (33, 34, 35, 36),
}
"""Rows of Table 2 without the metal reference."""
FIG13 = (13, 12, 18, 3, 14, 6)
FIG13_DISTANCE_MM = 598.0
"""Distance of the object plane with 50 degrees of incidence at the rig file's boards."""
PHASE_DEG = 30.0
"""Range of the phase that Fig. 14 shows, to either side."""

# Fig. 4.
FRONT_ON_MM = 60.0
"""Distance of each board's origin from the middle in x in the front-on rig. The antennas lie 7 to 16 mm from the middle
in x: RX1 of H and V see it under 0.6 and 2.2 degrees of incidence."""
FRONT_ON_GRID = {"columns": 81, "rows": 81, "step_x_mm": 4.5, "step_y_mm": 4.5}
"""Monostatic, a step d makes ghosts at wavelength * distance / 2 d: 216 mm for 4.5 mm, outside the plates."""
ROWS = (3, 6, 15)
"""Acrylic, PET and glass in Table 2."""
# Their places, around copper in the middle.
FRONT_ON_PLACES_MM = ((-60.0, 0.0), (60.0, 0.0), (0.0, 60.0))


@dataclass(frozen=True)
class ScanView:
    """Materials of a scan, and the scan with its images and known plates, as figures are drawn from it."""

    result: MaterialsResult
    scan: ProcessedScan


@cache
def view_scan(name: str, rows: tuple[int, ...], run: Run, distance_mm: float = PLANE_MM) -> ScanView:
    """Scan plates with the permittivities of these rows of Table 2, and a copper plate in the middle.

    `rows`: eight at most. `distance_mm`: of the object plane.
    """
    around = [p for p in PLACES_MM if p != (0.0, 0.0)]
    step = len(around) // len(rows)
    places_mm = [around[i * step] for i in range(len(rows))]
    # Seeds here and below are any numbers.
    return _scan(name, rows, places_mm, run.config, 1300, object_distance_mm=distance_mm)


def _scan(
    name: str, rows: Sequence[int], at: Sequence[tuple[float, float]], config: Path, seed: int, **more: object
) -> ScanView:
    """Simulate and process a scan of a copper plate in the middle, and of plates of these rows of Table 2.

    `at`: places of the plates, mm; `more`: further keys of the scene file.
    """
    plates = [plate("copper", None, 0.0, 0.0)]
    plates += [plate(table2()[n - 1].name, table2()[n - 1].permittivity, *xy) for n, xy in zip(rows, at, strict=True)]
    with simulate_scan(name, plates, config, seed=seed, **more) as (source, truth):
        imaged_scan = process_scan(source, truth)
    scan = ProcessedScan.from_results(
        Path(),
        images=imaged_scan.result.calibrated,
        quality=ScanQuality(),
        facts=ScanFacts(scan_id=name, simulated=True),
        materials=ScanMaterials(segments=imaged_scan.result.rows()),
        analysis=imaged_scan.result,
        plates=truth,
    )
    return ScanView(imaged_scan.result, scan)


def _label_plates(ax: Any, scan: ProcessedScan) -> None:
    """Write the plates' names on an image, and crop it to 110 mm about the middle."""
    for plate in scan.plates:
        x0, y0, x1, y1 = plate.box_mm
        name = plate.name.split(" (")[0]
        ax.text(
            (x0 + x1) / 2,
            (y0 + y1) / 2,
            name.replace(" ", "\n"),
            ha="center",
            va="center",
            fontsize=7.5,
            color="white",
            path_effects=[withStroke(linewidth=2.0, foreground=INK)],
        )
    x_min, right, bottom, top = scan.extent_mm
    ax.set_xlim(max(x_min, -110), min(right, 110))
    ax.set_ylim(max(bottom, -110), min(top, 110))


def _compute_opacity(scan: ProcessedScan) -> npt.NDArray[np.float64]:
    """Return the opacity of P, [y, x]: 0 at a level of -20 dB of metal and below (noise), 1 at -14 dB and above."""
    power = (np.abs(scan.h).astype(np.float64) ** 2 + np.abs(scan.v).astype(np.float64) ** 2) / 2
    power = np.nan_to_num(power)
    # The smaller of a pixel's power and its surroundings': neither a single bright pixel nor a dark one beside a plate
    # counts as bright.
    level = 10 * np.log10(np.maximum(np.minimum(power, scipy.ndimage.gaussian_filter(power, 1.5)), 1e-12))
    return np.clip((level + 20) / 6, 0.0, 1.0)


def draw_row(fig: Any, axes: Any, view: ScanView, name: str) -> None:
    """Draw the amplitudes of a scan in H, V and P side by side, with colour bars and the plates' names."""
    for ax, key in zip(axes, ("amplitude_h", "amplitude_v", "amplitude_p"), strict=True):
        image, unit = draw_channel(ax, view.scan, key)
        if key.endswith("_p"):
            image.set_alpha(_compute_opacity(view.scan))
        kind, _, channel = key.partition("_")
        style_axes(ax, f"{name}: {kind} {channel.upper()}", "x (mm)", "y (mm)" if ax is axes[0] else "")
        ax.set_aspect("equal")
        ax.grid(visible=False)
        ax.set_facecolor("#3a404a")
        bar = fig.colorbar(image, ax=ax, fraction=0.046, pad=0.02)
        bar.set_label(unit, fontsize=8)
        bar.ax.tick_params(labelsize=7.5)
        if bar.solids is not None:
            bar.solids.set_alpha(1)
        _label_plates(ax, view.scan)


def ratio_table(views: dict[str, ScanView]) -> Table:
    """Return a table of each plate's ratio in each view, and Fresnel's."""
    rows = []
    for name, view in views.items():
        theta = float(np.mean(view.result.theta_rad))
        for patch in view.result.patches:
            if patch.truth is None:
                continue
            eps = patch.truth.permittivity
            if eps is None:
                true = 1.0 + 0j
            else:
                true = complex(ratio_from_permittivity(eps, theta))
            p = patch.permittivity.ratio
            # Adding zero removes the sign of a negative zero.
            ratios = [f"{20 * np.log10(abs(z)):.2f} dB, {np.degrees(np.angle(z)) + 0.0:.1f}°" for z in (p, true)]
            error = abs(1 / p - 1 / true)
            rows.append((f"{name}: {patch.truth.name}", f"{np.degrees(theta):.1f}°", *ratios, f"{error:.4f}"))
    return Table(
        "Ratio P of each plate, median of its interior, and Fresnel's at the scene's permittivity",
        ("Plate", "incidence", "simulated image", "Fresnel", "|Δ(1/P)|"),
        tuple(rows),
    )


def ratio_data(views: dict[str, ScanView]) -> dict[str, Any]:
    """Return each plate's ratio in each view, for the JSON file."""
    return {
        name: {p.truth.name: p.permittivity.ratio for p in view.result.patches if p.truth is not None}
        for name, view in views.items()
    }


def fig13(run: Run) -> Item:
    """Seven materials at 50 degrees."""
    view = view_scan("seven materials at 50 degrees", FIG13, run, FIG13_DISTANCE_MM)
    fig = new_figure(11.5, 3.7)
    draw_row(fig, fig.subplots(1, 3), view, "50°")
    views = {"50°": view}
    return Item(
        "fig13",
        "Fig. 13: image of seven materials at 50 degrees",
        (
            "The paper's rubber, alumina (Table 2's ceramic), cardboard, acrylic, silicone rubber, plastic (PET) and"
            " copper, as plates in a grid; its copper tape lay on a plastic plate. The published figure is a picture.",
        ),
        (ratio_table(views),),
        {"image": Picture(fig, "|H|, |V| and |P| relative to metal. P fades where nothing reflects.")},
        {"ratios": ratio_data(views)},
    )


def fig19(run: Run) -> Item:
    """Solids, liquids and powders at 55 degrees: H, V and P."""
    views = {name: view_scan(name, rows, run) for name, rows in SETS.items()}
    fig = new_figure(11.5, 10.2)
    for line, (name, view) in zip(fig.subplots(3, 3), views.items(), strict=True):
        draw_row(fig, line, view, name)
    return Item(
        "fig19",
        "Fig. 19: images of solids, liquids and powders",
        (
            "Many materials look alike in H or in V and differ in P. Liquids and powders are plates with the apparent"
            " permittivity that Table 2 gives them with their container. The published figure is a picture.",
        ),
        (ratio_table(views),),
        {"images": Picture(fig, "|H|, |V| and |P| relative to metal at 55 degrees. P fades where nothing reflects.")},
        {"ratios": ratio_data(views)},
    )


def _spread_deg(values: npt.NDArray[np.complexfloating]) -> float:
    """Return the circular standard deviation of the phase, degrees (Mardia and Jupp, section 2.3)."""
    length = min(float(np.abs(np.mean(values / np.abs(values)))), 1.0)
    return float(np.degrees(np.sqrt(-2 * np.log(length))))


FIG14_NOTE = (
    "Water, oil and metal; everything outside their interiors is masked. In the paper the phases of H and V"
    " change over a target, because it is not parallel to the plane of the scan, and the phase of P does not."
    " In this simulation the plane is parallel, so H and V are steady as well; in both, the phase of P "
    "distinguishes the materials."
)


def fig14(run: Run) -> Item:
    """Return the phase of H, V and P inside water, oil and metal."""
    view = view_scan("liquids", SETS["liquids"], run)
    drawn_materials = ("Water (with glass)", "Corn Oil (with glass)", "copper")
    fig = new_figure(11.5, 3.4)
    channels = {"H": view.result.calibrated.h, "V": view.result.calibrated.v, "P": view.result.calibrated.p}
    patches = {p.truth.name: p for p in view.result.patches if p.truth is not None and p.truth.name in drawn_materials}
    rows = []
    data = {}
    inside = np.any([p.patch.interior for p in patches.values()], axis=0)
    for ax, (channel, values) in zip(fig.subplots(1, 3), channels.items(), strict=True):
        metal = np.mean(values[patches["copper"].patch.interior])
        angle = np.angle(values / metal, deg=True)
        phase = np.ma.masked_array(angle, ~inside)
        picture = ax.imshow(
            phase,
            extent=view.scan.extent_mm,
            origin="lower",
            cmap="PuOr",
            vmin=-PHASE_DEG,
            vmax=PHASE_DEG,
            interpolation="nearest",
        )
        style_axes(ax, f"phase of {channel}", "x (mm)", "y (mm)")
        ax.grid(visible=False)
        ax.set_facecolor("#b9c0ca")
        ax.set_xlim(-95, 95)
        ax.set_ylim(-30, 115)
        ticks = [-PHASE_DEG, -PHASE_DEG / 2, 0, PHASE_DEG / 2, PHASE_DEG]
        bar = fig.colorbar(picture, ax=ax, fraction=0.046, pad=0.02, ticks=ticks, extend="both")
        bar.set_label("degrees", fontsize=8)
        for name, p in patches.items():
            x0, _, x1, y1 = p.patch.box_mm
            # Adding zero removes the sign of a negative zero.
            text = f"{name.split(' (')[0]}\n{np.median(angle[p.patch.interior]) + 0.0:.1f}°"
            ax.text((x0 + x1) / 2, y1 + 4, text, ha="center", fontsize=8, color=INK)
    for name, p in patches.items():
        spreads = {c: _spread_deg(v[p.patch.interior]) for c, v in channels.items()}
        data[name] = {"phase_std_deg": spreads, "phase_of_P_deg": float(np.degrees(np.angle(p.permittivity.ratio)))}
        rows.append((name, *(f"{s:.1f}°" for s in spreads.values()), f"{data[name]['phase_of_P_deg'] + 0.0:.1f}°"))
    return Item(
        "fig14",
        "Fig. 14: phase of H, V and P",
        (FIG14_NOTE,),
        (
            Table(
                "Spread of the phase over each plate (circular standard deviation), and the phase of P",
                ("Plate", "H", "V", "P", "median phase of P"),
                tuple(rows),
            ),
        ),
        {
            "phase": Picture(
                fig,
                f"Phase of each channel less that of metal, from {-PHASE_DEG:g} to {PHASE_DEG:g} degrees; the number is"
                " the median over the plate.",
            )
        },
        data,
    )


def front_on(config: Path, folder: Path) -> Path:
    """Write the rig file with its boards side by side into a folder; return the file."""
    rig = tomllib.loads(config.read_text(encoding="utf-8"))
    for board in rig["boards"]:
        # The last shift of a mount places the board on the rig: only its side, left or right, is kept in x.
        shift = next(step["shift_mm"] for step in reversed(board["mount"]) if "shift_mm" in step)
        shift[0] = float(np.copysign(FRONT_ON_MM, shift[0]))
    path = folder / "front-on.toml"
    path.write_text(tomli_w.dumps(rig), encoding="utf-8")
    return path


def fig4(run: Run) -> Item:
    """H, V and P of copper, acrylic, PET and glass, with boards side by side and as in the rig file."""
    with tempfile.TemporaryDirectory(prefix="polysight-reproduce-") as temporary:
        near = front_on(run.config, Path(temporary))
        # The direct path is some 10 mm here, and echoes are relative to it: a larger gain (chosen) makes up for that.
        views = {
            "front-on": _scan("front-on", ROWS, FRONT_ON_PLACES_MM, near, 400, grid=FRONT_ON_GRID, object_gain=10.0)
        }
    views["steep"] = _scan("steep", ROWS, FRONT_ON_PLACES_MM, run.config, 400)
    fig = new_figure(11.5, 6.8)
    for line, (name, view) in zip(fig.subplots(2, 3), views.items(), strict=True):
        draw_row(fig, line, view, name)
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
