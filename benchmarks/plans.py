"""Scan time against image error and naming, simulated: `python -m benchmarks.plans`.

The nine plates of the examples on the published aperture (698 x 398 mm), with every disturbance of the simulated rig,
scanned as published and faster. The error is that of both channels' whole images against an ideal scan (no noise, no
disturbance but leakage, every position standing still), after the best complex factor; plates are named with the
simulated library, and permittivities compared with the scene's.

Raw data is made row by row and thrown away: nothing is written but table and figure. Half an hour of one core; with
`--coarser 2 1`, every second column, half of it (and 3 dB more noise).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.sparse_scans import predicted
from polysight.capture.decode import row_words
from polysight.imaging import ChannelImages, ImageBuilder
from polysight.imaging.sparse import reconstruct
from polysight.materials import (
    Classifier,
    Library,
    MaterialsResult,
    TruthPlate,
    analyse,
    pixel_accuracy,
    truth_plates,
)
from polysight.materials.analyse import ImagePair, KnownScene, Optics
from polysight.materials.library import SIMULATED_LIBRARY
from polysight.plan import Changes, scan_time
from polysight.polarimetry import incidence_choice
from polysight.sync import BoardSetup, synchronise_row
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.raster import plan_raster
from polysight_simulators.scene import Scene, SimulatedRig, load_scene, row_offsets_mm, truth

ROOT = Path(__file__).parents[1]
ITERATIONS = 40


@dataclass(frozen=True)
class Result:
    """One plan: its cost and its result."""

    name: str
    plan: str
    minutes: float
    image_error: float
    plates_right: int
    plates: int
    pixels_right: float
    permittivity_error: float


def as_scanned(rig: Instrument, scene: Scene) -> tuple[ImageBuilder, ImageBuilder]:
    """Simulate, synchronise and reduce every row: bursts in their true places, and taken to lie at their triggers."""
    radar, plan = SimulatedRig(rig, scene), plan_raster(rig.grid)
    true, nominal = ImageBuilder(rig), ImageBuilder(rig)
    for board in rig.receivers:
        setup = BoardSetup.of(rig, board)
        for row in plan:
            x, y = row_offsets_mm(radar, row)
            payload = radar.chirps(board.name, x, y, row.index * len(x)).view(np.uint8).ravel()
            frames, valid = row_words(payload, [], len(x), rig.chirp.samples)
            synced = synchronise_row(frames, valid, setup)
            true.add_row(board.name, row.index, synced)
            triggers = np.stack([row.x_mm, np.full(row.points, row.y_mm)], axis=1) / 1e3
            nominal.add_row(board.name, row.index, synced, triggers)
        tell(f"  {board.name} done")
    return true, nominal


def tell(text: str) -> None:
    """Progress, on stderr."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def thinned(builder: ImageBuilder, every: int, rebuilt: bool) -> ChannelImages:
    """The images from every n-th row, by matched filter or by reconstruction; the builder is left as it was."""
    valid = {name: board.valid.copy() for name, board in builder.boards.items()}
    weights = {name: board.weights for name, board in builder.boards.items()}
    whole = builder.finish()
    raw = []
    for name, board in builder.boards.items():
        kept = np.zeros_like(valid[name])
        kept[::every] = True
        board.keep(kept)
        if rebuilt:
            raw.append(predicted(board, reconstruct(board, ITERATIONS).image, weights[name]))
    images = builder.finish()
    for name, board in builder.boards.items():
        board.valid[:] = valid[name]
    if not rebuilt:
        return images
    flat = [
        np.divide(r, w, out=np.zeros_like(r), where=whole.valid).conj()
        for r, w in zip(raw, (whole.h_footprint, whole.v_footprint), strict=True)
    ]
    return replace(whole, h=flat[0], v=flat[1], h_raw=raw[0], v_raw=raw[1])


def image_error(images: ChannelImages, ideal: ChannelImages) -> float:
    """Of both channels' whole images, relative, after the complex factor that fits best."""
    errors = []
    for made, wanted in ((images.h_raw, ideal.h_raw), (images.v_raw, ideal.v_raw)):
        factor = np.vdot(made, wanted) / np.vdot(made, made)
        errors.append(float(np.linalg.norm(factor * made - wanted) / np.linalg.norm(wanted)))
    return float(np.mean(errors))


def named(rig: Instrument, images: ChannelImages, plates: tuple[TruthPlate, ...]) -> MaterialsResult:
    """Patches, permittivities and names."""
    angles = incidence_choice(rig, images.x_m, images.y_m, "one")
    classifier = Classifier(Library.load(SIMULATED_LIBRARY))
    return analyse(ImagePair.of(images), Optics.of(rig, angles), known=KnownScene(plates=plates), classifier=classifier)


def measure(
    name: str,
    rig: Instrument,
    images: ChannelImages,
    ideal: ChannelImages,
    plates: tuple[TruthPlate, ...],
    every: int = 1,
) -> Result:
    """Figures of one scan; `every` n-th row was scanned."""
    scanned = Changes(step_y_mm=every * rig.grid.step_y_mm).apply(rig)  # its minutes are those of the rows scanned
    found = named(rig, images, plates)
    pairs = [(r, r.truth) for r in found.patches if r.truth is not None]
    right = sum(r.verdict is not None and r.verdict.name == t.name for r, t in pairs)
    errors = [
        abs(r.permittivity.value.real / t.permittivity.real - 1)
        for r, t in pairs
        if r.permittivity.value is not None and t.permittivity is not None
    ]
    b, g = rig.burst, scanned.grid
    plan = f"{rig.stage.speed_mm_s:g} mm/s, {b.pulses} x {b.period_us / 1e3:g} ms, {g.step_x_mm:g} x {g.step_y_mm:g} mm"
    result = Result(
        name,
        plan,
        scan_time(scanned).minutes,
        image_error(images, ideal),
        right,
        len(plates),
        pixel_accuracy(found) or 0.0,
        float(np.median(errors)) if errors else float("nan"),
    )
    print(line(result), flush=True)
    return result


HEAD = (
    "| scan | plan | minutes | image error | plates named right | their pixels | eps' off by (median) |\n"
    "| --- | --- | --- | --- | --- | --- | --- |"
)


def line(r: Result) -> str:
    """A row of the table."""
    return (
        f"| {r.name} | {r.plan} | {r.minutes:.1f} | {100 * r.image_error:.1f} % | {r.plates_right} of {r.plates} |"
        f" {100 * r.pixels_right:.1f} % | {100 * r.permittivity_error:.1f} % |"
    )


Made = tuple[str, Instrument, ChannelImages, int]


def published(rig: Instrument, scene: Scene) -> Iterator[Made]:
    """The rig file's plan."""
    yield "published", rig, as_scanned(rig, scene)[0].finish(), 1


def fast(rig: Instrument, scene: Scene) -> Iterator[Made]:
    """At 100 mm/s with shorter bursts that make whole packets of a row; then with rows left out of it."""
    rig = Changes(speed_mm_s=100.0, pulses=13, period_us=750.0).apply(rig)
    builder, uncompensated = as_scanned(rig, scene)
    yield "fast", rig, builder.finish(), 1
    yield "fast, motion not compensated", rig, uncompensated.finish(), 1
    for every in (2, 3, 4):
        yield f"fast, 1 row in {every}", rig, thinned(builder, every, rebuilt=False), every
        if every > 2:
            yield f"fast, 1 row in {every}, reconstructed", rig, thinned(builder, every, rebuilt=True), every


def short(rig: Instrument, scene: Scene) -> Iterator[Made]:
    """The same with fewer chirps."""
    rig = Changes(speed_mm_s=100.0, period_us=750.0, pulses=6).apply(rig)
    yield "fast, 6 chirps", rig, as_scanned(rig, scene)[0].finish(), 1


def wide(rig: Instrument, scene: Scene) -> Iterator[Made]:
    """The published burst, rows twice as far apart."""
    rig = Changes(speed_mm_s=47.0, step_y_mm=2 * rig.grid.step_y_mm).apply(rig)
    yield "half the rows, published burst", rig, as_scanned(rig, scene)[0].finish(), 1


def proposed(rig: Instrument, scene: Scene) -> Iterator[Made]:
    """The first proposal of `polysight plan --minutes 30` for the published rig."""
    rig = Changes(speed_mm_s=47.0, step_y_mm=2 * rig.grid.step_y_mm, pulses=55, period_us=730.0).apply(rig)
    yield "first proposal for 30 minutes", rig, as_scanned(rig, scene)[0].finish(), 1


SCANS = (fast, published, wide, short, proposed)


def figure(results: list[Result], pictures: list[tuple[str, ChannelImages]], path: Path) -> None:
    """Image error against time, and images of H."""
    fig = Figure(figsize=(12.5, 7.6 if pictures else 4.6), dpi=110, layout="constrained", facecolor="white")
    FigureCanvasAgg(fig)
    fig.suptitle("SIMULATED: nine plates, aperture 698 x 398 mm", color="#b3261e", fontsize=11, x=0.01, ha="left")
    upper: Any = fig
    if pictures:
        parts: Any = fig.subfigures(2, 1, height_ratios=[1.15, 1])
        upper = parts[0]
        _draw_pictures(parts[1], pictures)
    ax = upper.subplots(1, 1)
    marks = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "*", "h", "p", "d")
    colours = ("#332288", "#88CCEE", "#44AA99", "#117733", "#999933", "#DDCC77", "#CC6677", "#882255", "#AA4499")
    for i, r in enumerate(results):
        label = f"{r.name}: {r.plates_right} of {r.plates} named right"
        ax.plot(
            r.minutes, 100 * r.image_error, marks[i % len(marks)], color=colours[i % len(colours)], ms=9,
            markeredgecolor="#1b2330", markeredgewidth=0.6, label=label, linestyle="none",
        )  # fmt: skip
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_yticks([1, 2, 5, 10, 20, 50], ["1", "2", "5", "10", "20", "50"])
    ax.set_xticks([5, 10, 15, 30, 60, 120], ["5", "10", "15", "30", "60", "120"])
    ax.minorticks_off()
    ax.set_xlabel("scan time (minutes)")
    ax.set_ylabel("image error (%)")
    ax.grid(color="#e6e9ee")
    ax.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    path.parent.mkdir(parents=True, exist_ok=True)
    fig.savefig(path, metadata={"Software": None})


def _draw_pictures(fig: Any, pictures: list[tuple[str, ChannelImages]]) -> None:
    """H of some scans side by side."""
    shown = None
    axes = fig.subplots(1, len(pictures), squeeze=False)[0]
    for ax, (name, images) in zip(axes, pictures, strict=True):
        level = 20 * np.log10(np.maximum(np.abs(images.h_raw) / np.abs(images.h_raw).max(), 1e-6))
        half = [(a[-1] - a[0]) / 2 * 1e3 for a in (images.x_m, images.y_m)]
        extent = (-half[0], half[0], -half[1], half[1])
        shown = ax.imshow(level, origin="lower", extent=extent, cmap="cividis", vmin=-35, vmax=0)
        ax.set_title(name, fontsize=8.5, loc="left")
        ax.set_xlabel("x (mm)", fontsize=8)
        ax.tick_params(labelsize=7)
    fig.colorbar(shown, ax=axes, fraction=0.02, pad=0.01).set_label("H (dB)", fontsize=8)


SHOWN = ("ideal", "fast", "fast, 1 row in 4", "fast, 1 row in 4, reconstructed")


def main() -> int:
    """Simulate and measure the plans; print a Markdown table, draw the figure."""
    parser = argparse.ArgumentParser(description="image error and naming of faster scans, simulated")
    names = [s.__name__ for s in SCANS]
    parser.add_argument("--scans", nargs="*", choices=names, default=names, help="some of them only")
    parser.add_argument("--figure", type=Path, default=ROOT / "docs" / "images" / "plans.png")
    parser.add_argument("--json", type=Path, help="write the results here")
    parser.add_argument(
        "--add",
        type=Path,
        nargs="*",
        default=[],
        help="earlier results to show too; with --scans alone, only these",
    )
    parser.add_argument(
        "--coarser", type=float, nargs=2, metavar=("X", "Y"), default=(1, 1), help="steps so many times the plans'"
    )
    args = parser.parse_args()
    scene = msgspec.structs.replace(load_scene(ROOT / "examples" / "nine-materials.toml"), grid={})  # the rig file's
    rig = load_instrument(ROOT / "instrument.toml")
    x, y = args.coarser
    rig = Changes(step_x_mm=x * rig.grid.step_x_mm, step_y_mm=y * rig.grid.step_y_mm).apply(rig)
    results = [Result(**r) for path in args.add for r in json.loads(path.read_text(encoding="utf-8"))]
    if not args.scans:
        print(HEAD, *map(line, results), sep="\n")
        figure(results, [], args.figure)
        return 0
    leakage = scene.disturbances
    still = scene.with_disturbances(ideal=True, leakage_h=leakage.leakage_h, leakage_v=leakage.leakage_v)
    ideal = as_scanned(Changes(pulses=2).apply(rig), still)[0].finish()
    plates = truth_plates(truth(rig, scene, scene.seed))
    print(HEAD, flush=True)
    measure("ideal", rig, ideal, ideal, plates)
    pictures = [("ideal", ideal)]
    for make in (s for s in SCANS if s.__name__ in args.scans):
        for name, scanned, images, every in make(rig, scene):
            results.append(measure(name, scanned, images, ideal, plates, every))
            if name in SHOWN:
                pictures.append((name, images))
        if args.json:
            args.json.write_text(json.dumps([asdict(r) for r in results], indent=1) + "\n", encoding="utf-8")
        figure(results, pictures, args.figure)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
