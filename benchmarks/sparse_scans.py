"""Image error against scan time for scans that leave positions out, simulated: `python -m benchmarks.sparse_scans`.

Every example scene is simulated once with all positions, without noise or disturbances, so that only the
missing positions matter. Then rows or columns are masked, and the image is made by matched filter and by reconstruction
(polysight/imaging/sparse.py). The error is that of the whole image against the matched filter of all positions, both
channels' mean; a reconstruction is compared through the samples it predicts.
"""

import argparse
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polysight.imaging.samples import BoardSamples, choose_imager
from polysight.imaging.sparse import reconstruct
from polysight.pipeline import Pipeline
from polysight.store.scan_folder import ScanFolder
from polysight_shared.config import Instrument, load_instrument
from polysight_simulators.scene import load_scene, simulate

ROOT = Path(__file__).parents[1]
SCENES = ("point-targets", "nine-materials")


def patterns(rows: int, columns: int) -> Iterator[tuple[str, np.ndarray, float]]:
    """Yield scans: name, mask of the positions that are kept [row, column], share of the whole scan's time."""
    rng = np.random.default_rng(1)

    def of_rows(chosen: np.ndarray) -> np.ndarray:
        is_scanned = np.zeros((rows, columns), bool)
        is_scanned[chosen] = True
        return is_scanned

    yield "all positions", np.ones((rows, columns), bool), 1.0
    yield "every second row", of_rows(np.arange(0, rows, 2)), 0.5
    yield "every third row", of_rows(np.arange(0, rows, 3)), 1 / 3
    yield "random half of the rows", of_rows(rng.permutation(rows)[: rows // 2]), 0.5
    every_second = np.zeros((rows, columns), bool)
    every_second[:, ::2] = True
    yield "every second column, at twice the speed", every_second, 0.5
    yield "random half of the positions", rng.uniform(size=(rows, columns)) < 0.5, 1.0
    yield "random quarter of the positions", rng.uniform(size=(rows, columns)) < 0.25, 1.0


def scan_minutes(rig: Instrument) -> float:
    """Return the time of the whole scan: rows at constant speed, with run-up, run-out and the step to the next row."""
    stage = rig.stage
    grid = rig.grid
    length_mm = (grid.columns - 1) * grid.step_x_mm
    ramp_s = stage.speed_mm_s / stage.accel_mm_s2
    row_s = length_mm / stage.speed_mm_s + 2 * ramp_s + grid.step_y_mm / stage.travel_speed_mm_s
    return grid.rows * row_s / 60


def predict_image(board: BoardSamples, image: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the matched filter over all positions of the samples that a reconstructed image predicts.

    `weights` are those of the positions [row, column].
    """
    imager, _ = choose_imager(board.aperture)
    samples = imager.samples(image)
    # Recorded samples have passed the range gate: `model` [frequency, frequency] is what it does to an echo. `samples`
    # are [rx, frequency, row, column].
    gated = (board.model.astype(np.complex64) @ samples.reshape(*samples.shape[:2], -1)).reshape(samples.shape)
    # The mean over RX and weighted positions, as `BoardSamples.image`.
    return imager.image((gated * weights).astype(np.complex64)) / (weights.sum() * len(samples))


def measure(folder: Path, iterations: int) -> list[tuple[str, float, float, float]]:
    """Return pattern, minutes, error of the matched filter and of the reconstruction for each pattern of one scan."""
    pipeline = Pipeline(ScanFolder.load(folder))
    for row in pipeline.source.rows():
        pipeline.add_row(row)
    boards = list(pipeline.builder.boards.values())
    valid = [b.valid.copy() for b in boards]
    full_images = [b.image()[0] for b in boards]
    weights = [b.weights for b in boards]
    rig = pipeline.source.instrument
    minutes = scan_minutes(rig)
    out = []
    for name, is_scanned, share in patterns(rig.grid.rows, rig.grid.columns):
        errors = []
        for board, good, full, weight in zip(boards, valid, full_images, weights, strict=True):
            board.valid[:] = good
            board.keep(is_scanned)
            matched = board.image()[0]
            predicted_image = predict_image(board, reconstruct(board, iterations).image, weight)
            errors.append([np.linalg.norm(image - full) / np.linalg.norm(full) for image in (matched, predicted_image)])
        plain, rebuilt = np.mean(errors, axis=0)
        out.append((name, share * minutes, float(plain), float(rebuilt)))
    return out


def main() -> int:
    """Simulate and measure; print a Markdown table for each scene. Return 0."""
    parser = argparse.ArgumentParser(description="image error of sparse scans")
    parser.add_argument("--iterations", type=int, default=40)
    parser.add_argument("--scenes", nargs="*", default=SCENES)
    parser.add_argument("--keep", type=Path, default=None, help="folder where simulated scans stay")
    args = parser.parse_args()
    rig = load_instrument(ROOT / "instrument.toml")
    results = {}
    with tempfile.TemporaryDirectory() as temporary:
        for scene in args.scenes:
            folder = (args.keep or Path(temporary)) / f"ideal-{scene}"
            if not folder.exists():
                ideal = load_scene(ROOT / "examples" / f"{scene}.toml").with_disturbances(ideal=True)
                simulate(rig, ideal, folder)
            results[scene] = measure(folder, args.iterations)
            print(f"\n{scene} (simulated)\n\n| positions | minutes | matched filter | reconstruction |")
            print("| --- | --- | --- | --- |")
            for name, minutes, plain, rebuilt in results[scene]:
                print(f"| {name} | {minutes:.1f} | {100 * plain:.1f} % | {100 * rebuilt:.1f} % |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
