"""Scan time against image error and naming, simulated: `python -m benchmarks.plans`.

The nine plates of the examples on the published aperture (698 x 398 mm), with every disturbance of the simulated rig,
scanned as published and faster. The error is that of both channels' whole images against an ideal scan (no noise, no
disturbance but leakage, every position standing still), after the best complex factor; plates are named with the
simulated library, and permittivities compared with the scene's.

Raw data is made row by row and thrown away. Half an hour of one core; with
`--coarser 2 1`, every second column, half of it (and 3 dB more noise).
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import replace

import msgspec
import numpy as np

from benchmarks.data import RIG, SCENE
from benchmarks.sparse_scans import predict_image
from polysight.capture.dca1000 import view_row_words
from polysight.imaging import Image, ImageBuilder, Images
from polysight.imaging.sparse import reconstruct
from polysight.materials import (
    SIMULATED_LIBRARY,
    Classifier,
    KnownScene,
    Library,
    MaterialsResult,
    Optics,
    TruthPlate,
    analyse,
    pixel_accuracy,
    read_true_plates,
)
from polysight.planning import PlanChanges, scan_time
from polysight.polarimetry import incidence_choice
from polysight.sync import BoardSetup, synchronise_row
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.raster import plan_raster
from polysight_simulators.scene import Scene, SimulatedRig, load_scene, row_offsets_mm, truth

# Iterations of a reconstruction (chosen).
ITERATIONS = 40
HEAD = (
    "| scan | plan | minutes | image error | plates named right | their pixels | eps' off by (median) |\n"
    "| --- | --- | --- | --- | --- | --- | --- |"
)


def build_scanned_images(rig: Instrument, scene: Scene) -> tuple[ImageBuilder, ImageBuilder]:
    """Simulate, synchronise and reduce every row into two sets of samples.

    In the first, bursts lie at their true places, in the second at their triggers: motion is then not compensated.
    """
    radar = SimulatedRig(rig, scene)
    plan = plan_raster(rig.grid)
    true = ImageBuilder(rig)
    nominal = ImageBuilder(rig)
    for board in rig.receivers:
        setup = BoardSetup.from_rig(rig, board)
        for row in plan:
            x, y = row_offsets_mm(radar, row)
            payload = radar.chirps(board.name, x, y, first_chirp=row.index * len(x)).view(np.uint8).ravel()
            # All bytes are there: no gaps.
            frames, valid = view_row_words(payload, [], len(x), rig.chirp.samples, len(rig.antennas.rx_mm))
            synced = synchronise_row(frames, valid, setup)
            true.add_row(board.name, row.index, synced)
            triggers = np.stack([row.x_mm, np.full(row.points, row.y_mm)], axis=1) / 1e3
            nominal.add_row(board.name, row.index, synced, triggers)
        tell(f"  {board.name} done")
    return true, nominal


def tell(text: str) -> None:
    """Print progress on stderr."""
    sys.stderr.write(text + "\n")
    sys.stderr.flush()


def image_every_nth(builder: ImageBuilder, every: int, rebuilt: bool) -> Images:
    """Image every n-th row, by matched filter or (`rebuilt`) by reconstruction; the builder is not changed.

    A reconstruction predicts the image of all rows, so it is divided by the footprints of all rows, the images of a
    uniform mirror.
    """
    valid = {name: board.valid.copy() for name, board in builder.boards.items()}
    # Weights and images of all rows, before some are left out.
    weights = {name: board.weights for name, board in builder.boards.items()}
    all_images = builder.finish()
    raw = []
    for name, board in builder.boards.items():
        kept_rows = np.zeros_like(valid[name])
        kept_rows[::every] = True
        board.keep(kept_rows)
        if rebuilt:
            raw.append(predict_image(board, reconstruct(board, ITERATIONS).image, weights[name]))
    images = builder.finish()
    for name, board in builder.boards.items():
        board.valid[:] = valid[name]
    if not rebuilt or all_images.illumination is None:
        return images
    # As `ImageBuilder` makes h and v of the raw images.
    h, v = (
        np.divide(image, footprint, out=np.zeros_like(image), where=all_images.valid).conj()
        for image, footprint in zip(raw, all_images.illumination.footprints, strict=True)
    )
    return replace(all_images, h=h, v=v, h_raw=raw[0], v_raw=raw[1])


def raw_images(images: Images) -> tuple[Image, Image]:
    """Return H and V as `ImageBuilder` leaves them, not divided by the illumination."""
    if images.h_raw is None or images.v_raw is None:
        raise ValueError("these images were not made from a scan's samples")
    return images.h_raw, images.v_raw


def image_error(images: Images, ideal: Images) -> float:
    """Return the relative error of both channels' images after the complex factor that fits best."""
    errors = []
    for image, ideal_image in zip(raw_images(images), raw_images(ideal), strict=True):
        factor = np.vdot(image, ideal_image) / np.vdot(image, image)
        errors.append(float(np.linalg.norm(factor * image - ideal_image) / np.linalg.norm(ideal_image)))
    return float(np.mean(errors))


def name_patches(rig: Instrument, images: Images, plates: tuple[TruthPlate, ...]) -> MaterialsResult:
    """Analyse the image with the simulated library: patches, permittivities and names; `plates` are the truth."""
    # One angle for all pixels.
    angles = incidence_choice(rig, images.x_m, images.y_m, "one")
    classifier = Classifier(Library.load(SIMULATED_LIBRARY))
    return analyse(images, Optics.from_rig(rig, angles), given_scene=KnownScene(plates=plates), classifier=classifier)


def measure(
    name: str,
    rig: Instrument,
    images: Images,
    ideal: Images,
    plates: tuple[TruthPlate, ...],
    every: int = 1,
) -> None:
    """Print a line of the table (HEAD) about one scan, of which `every` n-th row was scanned."""
    # Only the rows that are scanned take time.
    scanned = PlanChanges(step_y_mm=every * rig.grid.step_y_mm).apply(rig)
    result = name_patches(rig, images, plates)
    pairs = [(r, r.truth) for r in result.patches if r.truth is not None]
    right = sum(r.patch_name is not None and r.patch_name.name == t.name for r, t in pairs)
    errors = [
        abs(r.permittivity.value.real / t.permittivity.real - 1)
        for r, t in pairs
        if r.permittivity.value is not None and t.permittivity is not None
    ]
    b = rig.burst
    g = scanned.grid
    plan = f"{rig.stage.speed_mm_s:g} mm/s, {b.pulses} x {b.period_us / 1e3:g} ms, {g.step_x_mm:g} x {g.step_y_mm:g} mm"
    if errors:
        median_error = 100 * float(np.median(errors))
    else:
        median_error = float("nan")
    print(
        f"| {name} | {plan} | {scan_time(scanned).minutes:.1f} | {100 * image_error(images, ideal):.1f} % |"
        f" {right} of {len(plates)} | {100 * (pixel_accuracy(result) or 0.0):.1f} % | {median_error:.1f} % |",
        flush=True,
    )


# A scan's name, rig and images, and that every n-th row was scanned.
Made = tuple[str, Instrument, Images, int]


# The following simulate scans by different plans: `rig` has the published plan.


def published_plan(rig: Instrument, scene: Scene) -> Iterator[Made]:
    """Scan by the rig file's plan."""
    yield "published", rig, build_scanned_images(rig, scene)[0].finish(), 1


def fast(rig: Instrument, scene: Scene) -> Iterator[Made]:
    """Scan at 100 mm/s with shorter bursts, whose rows fill whole packets; then leave rows out of it."""
    rig = PlanChanges(speed_mm_s=100.0, pulses=13, period_us=750.0).apply(rig)
    builder, uncompensated = build_scanned_images(rig, scene)
    yield "fast", rig, builder.finish(), 1
    yield "fast, motion not compensated", rig, uncompensated.finish(), 1
    for step in (2, 3, 4):
        yield f"fast, 1 row in {step}", rig, image_every_nth(builder, step, rebuilt=False), step
        if step > 2:
            yield f"fast, 1 row in {step}, reconstructed", rig, image_every_nth(builder, step, rebuilt=True), step


def short(rig: Instrument, scene: Scene) -> Iterator[Made]:
    """Scan at 100 mm/s with fewer chirps."""
    rig = PlanChanges(speed_mm_s=100.0, period_us=750.0, pulses=6).apply(rig)
    yield "fast, 6 chirps", rig, build_scanned_images(rig, scene)[0].finish(), 1


def wide(rig: Instrument, scene: Scene) -> Iterator[Made]:
    """Scan with the published burst, rows twice as far apart, at the speed of `first_proposal`."""
    rig = PlanChanges(speed_mm_s=47.0, step_y_mm=2 * rig.grid.step_y_mm).apply(rig)
    yield "half the rows, published burst", rig, build_scanned_images(rig, scene)[0].finish(), 1


def first_proposal(rig: Instrument, scene: Scene) -> Iterator[Made]:
    """Scan by the first proposal of `polysight plan --minutes 30` for the published rig."""
    rig = PlanChanges(speed_mm_s=47.0, step_y_mm=2 * rig.grid.step_y_mm, pulses=55, period_us=730.0).apply(rig)
    yield "first proposal for 30 minutes", rig, build_scanned_images(rig, scene)[0].finish(), 1


SCANS = (fast, published_plan, wide, short, first_proposal)


def main() -> int:
    """Simulate and measure the plans; print a Markdown table. Return 0."""
    parser = argparse.ArgumentParser(description="image error and naming of faster scans, simulated")
    names = [s.__name__ for s in SCANS]
    parser.add_argument("--scans", nargs="*", choices=names, default=names, help="some of them only")
    parser.add_argument(
        "--coarser", type=float, nargs=2, metavar=("X", "Y"), default=(1, 1), help="steps so many times the plans'"
    )
    args = parser.parse_args()
    # The grid is the rig file's.
    scene = msgspec.structs.replace(load_scene(SCENE), grid={})
    rig = load_instrument(RIG)
    x, y = args.coarser
    rig = PlanChanges(step_x_mm=x * rig.grid.step_x_mm, step_y_mm=y * rig.grid.step_y_mm).apply(rig)
    disturbances = scene.disturbances
    still = scene.with_disturbances(ideal=True, leakage_h=disturbances.leakage_h, leakage_v=disturbances.leakage_v)
    # Without noise and motion a burst of two pulses is as good as a long one.
    ideal = build_scanned_images(PlanChanges(pulses=2).apply(rig), still)[0].finish()
    plates = read_true_plates(truth(rig, scene, scene.seed))
    print(HEAD, flush=True)
    measure("ideal", rig, ideal, ideal, plates)
    for make in (s for s in SCANS if s.__name__ in args.scans):
        for name, scanned, images, step in make(rig, scene):
            measure(name, scanned, images, ideal, plates, step)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
