"""Imaging of a synchronised cube, against the published method (`published.py`) and the best time-domain sum.

Kernels are the spectra of the matched filter over the offset of a pixel from a position; the imager computes them once
for a geometry and keeps them in memory: with them it is warm, without them cold. The footprint is the image of a
uniform mirror. Limits are chosen; what the project asks for is in docs/benchmarks.md.
"""

import argparse
import importlib.util
import statistics
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.data import make_synced_row, published_scene, temporary, write_point_cube
from benchmarks.measure import Line, Seconds, add_arguments, count_repeats, keep_on_one_core, show, write
from benchmarks.published import SETTINGS, form_image
from polysight.imaging import ImageBuilder, spectral
from polysight.imaging.geometry import (
    Antennas,
    Aperture,
    find_scene_gate_m,
    fit_row_starts_m,
    image_grid,
    scan_offsets_m,
)
from polysight.imaging.samples import choose_imager, reduction
from polysight.imaging.spectral import IncrementalImager
from polysight.store.source import allocate_pages
from polysight_shared.config import Board, Instrument
from polysight_shared.raster import plan_raster

__all__ = ["add_arguments", "run"]
REPEATS = 5
# Rounds of methods that take seconds; chosen.
ROUNDS = 3
# Of the rows, one in so many is timed with the time-domain sum; chosen.
EVERY = 10

Image = NDArray[np.complexfloating]


class Bench:
    """One board's cube on disk ([rx, row, column, sample], file `path`), and the ways to its image."""

    def __init__(self, rig: Instrument, board: Board, path: Path) -> None:
        self.rig = rig
        self.board = board
        self.path = path

    def ours(self, live: bool = False) -> Image:
        """Form the image from disk: all rows, then the image; `live`: an image that every row updates."""
        board_samples = ImageBuilder(self.rig, live=live).boards[self.board.name]
        for row, cube_row in self._read_rows():
            board_samples.add_row(row, make_synced_row(self.rig, cube_row))
        # Beside the image there are the footprint and a notice.
        image, _, _ = board_samples.image_current_sums() if live else board_samples.image()
        return image

    def _read_rows(self) -> Iterator[tuple[int, NDArray[np.complex64]]]:
        """Yield the index and samples [rx, position, sample] of each row as the stage ran: odd rows run backwards.

        All in the same memory, which stays in the cache, as the instrument reads its own rows.
        """
        cube = np.load(self.path, mmap_mode="r")
        size = cube[0, 0].nbytes
        memory = allocate_pages(len(cube) * size)
        samples = memory.view(np.complex64).reshape(cube[:, 0].shape)
        with self.path.open("rb", buffering=0) as file:
            for row in range(cube.shape[1]):
                for rx in range(len(cube)):
                    file.seek(cube.offset + (rx * cube.shape[1] + row) * size)
                    file.readinto(memory[rx * size : (rx + 1) * size].data)
                yield row, samples[:, :: 1 - 2 * (row % 2)]

    def reduce_cube(self, window: str) -> tuple[Aperture, NDArray[np.complex64]]:
        """Return the aperture, and the cube after the range gate alone, complex64 [rx, frequency, row, column]."""
        plan = plan_raster(self.rig.grid)
        grid = image_grid(self.rig)
        antennas = Antennas.from_rig(self.rig, self.board)
        # Of a sample vector, the gate's matrix makes the few frequencies that describe echoes from the scene.
        gate = reduction(self.rig.chirp, find_scene_gate_m((antennas,), plan, grid), window)
        maps = gate.matrix.astype(np.complex64)
        cube = np.load(self.path, mmap_mode="r")
        samples = np.stack([np.matmul(maps, cube[:, row].mT) for row in range(plan.rows)], axis=2)
        return Aperture(antennas, scan_offsets_m(self.rig), gate.frequencies_hz, grid), samples

    def ours_cold(self) -> Image:
        """Form the image as :func:`ours`, without any stored kernel."""
        spectral.clear_cache()
        return self.ours()

    def theirs(self, points: int = SETTINGS[0]) -> Image:
        """Form the image by the published method, from disk; `points` are those of its range FFT."""
        cube = np.load(self.path, mmap_mode="r")
        return form_image(cube, self.rig, self.board, image_grid(self.rig), points)


def time_alternately(jobs: dict[str, Callable[[], Any]], rounds: int) -> dict[str, Seconds]:
    """Run every job once a round, one after another; return their times."""
    took = {name: Seconds() for name in jobs}
    for _ in range(rounds):
        for name, job in jobs.items():
            with took[name].time_block():
                job()
    return took


def worst(image: Image, true: Image) -> float:
    """Return the largest difference of two images, as a share of the peak."""
    return float(np.abs(image - true).max() / np.abs(true).max())


def rms(image: Image, true: Image) -> float:
    """Return the relative rms difference of two images after the complex factor that fits best."""
    factor = np.vdot(image, true) / np.vdot(image, image)
    return float(np.linalg.norm(factor * image - true) / np.linalg.norm(true))


def compare_with_published(bench: Bench, rounds: int) -> tuple[list[Line], dict[str, Any]]:
    """Compare with the published method, from the cube on disk; return lines of the table and figures for the file."""
    bench.ours()
    jobs = {"cold": bench.ours_cold, "warm": bench.ours, "published": bench.theirs}
    took = time_alternately(jobs, min(rounds, ROUNDS))
    aperture, samples = bench.reduce_cube("boxcar")
    # Our sum over all samples, without a window, as the published method has none. It stands for the exact one; its own
    # tests compare it with a plain sum.
    imager, _ = choose_imager(aperture)
    exact = imager.image(samples)
    settings: dict[int, dict[str, float]] = {}
    for points in SETTINGS:
        once = Seconds()
        with once.time_block():
            image = bench.theirs(points)
        settings[points] = {"cpu_s": once.cpu[0], "rms_error": rms(image, exact)}
    theirs = took["published"].median
    finer = (f"{n} points {s['cpu_s']:.1f} s, {100 * s['rms_error']:.2g} %" for n, s in settings.items())
    note = f"published method's settings, seconds and rms distance from our image: {'; '.join(finer)}"
    lines = []
    for name, at_least, aim in (("warm", 18, 30), ("cold", 9, 13)):
        ours = took[name].median
        lines.append(
            Line(
                f"image from the cube on disk, {name} kernels",
                f"{ours:.3f} s",
                f"{theirs:.2f} s",
                theirs / ours,
                at_least,
                aim,
                note=note if name == "warm" else "",
            )
        )
    return lines, {"settings": settings, "cpu_s": {name: t.cpu for name, t in took.items()}}


def against_time_domain(bench: Bench, rounds: int) -> tuple[list[Line], dict[str, Any]]:
    """Compare with the time-domain sum, from reduced samples; without numba only a line says so."""
    if importlib.util.find_spec("numba") is None:
        print("numba is not here, so there is no time-domain sum: `pip install --group bench` adds it")
        return [], {}
    from benchmarks import time_domain

    aperture, samples = bench.reduce_cube("hann")
    ours_s: list[float] = []
    theirs_s: list[float] = []
    image: Image = np.empty(0, np.complex64)
    for _ in range(min(rounds, ROUNDS)):
        ours_s += time_alternately({"ours": lambda: choose_imager(aperture)[0].image(samples)}, rounds)["ours"].cpu
        # Its seconds are scaled to all rows there.
        image, seconds = time_domain.timed_image(aperture, samples, EVERY)
        theirs_s.append(seconds)
    ours = statistics.median(ours_s)
    theirs = statistics.median(theirs_s)
    part = np.zeros_like(samples)
    part[:, :, ::EVERY] = samples[:, :, ::EVERY]
    error = rms(image, choose_imager(aperture)[0].image(part))
    line = Line(
        "image from the reduced cube, beside the best time-domain sum",
        f"{ours:.3f} s",
        f"{theirs:.1f} s",
        theirs / ours,
        at_least=150.0,
        aim=250.0,
        note=f"one row in {EVERY} timed, scaled; its image and ours of these rows differ by {error:.1e} rms",
    )
    return [line], {"cpu_s": {"ours": ours_s, "time domain": theirs_s}}


def against_batch(bench: Bench, rounds: int) -> tuple[list[Line], dict[str, Any]]:
    """Compare imaging row by row with imaging all rows together, both with the footprint."""
    aperture, samples = bench.reduce_cube("hann")
    weights = np.ones(samples.shape[2:], np.float32)
    # The echo of the mirror, of whose image the footprint is made: any constant takes the same time.
    mirror = np.ones(samples.shape[:2], np.complex64)
    starts = fit_row_starts_m(aperture.offsets_m)
    images: dict[str, Image] = {}

    def by_row() -> None:
        imager = IncrementalImager(aperture, mirror)
        for row, start in enumerate(starts):
            imager.add_row(row, samples[:, :, row] * weights[row], weights[row], float(start))
        # The footprint, whose time counts; then the image, all RX with a factor of 1.
        imager.image_summed_constant_echo()
        images["rows"] = imager.image_of_sum(np.ones(len(samples)))

    def image_batch() -> None:
        imager, _ = choose_imager(aperture)
        imager.image_constant_echo(mirror, weights)
        images["batch"] = imager.image(samples * weights)

    jobs = {
        "rows": by_row,
        "batch": image_batch,
        "rows from disk": lambda: images.update(live=bench.ours(live=True)),
        "batch from disk": lambda: images.update(whole=bench.ours()),
    }
    for job in jobs.values():
        job()
    took = time_alternately(jobs, rounds)
    lines = []
    for placement, rows, batch, limits in (
        ("the cube on disk", "rows from disk", "batch from disk", (5.0, 3.0)),
        # For information: without the steps that both share.
        ("reduced samples", "rows", "batch", (None, None)),
    ):
        ours = took[rows].median
        theirs = took[batch].median
        # Cost of all updates of an image row by row, relative to imaging all rows together.
        name = f"all row updates in batch images, both from {placement}"
        note = f"{1e3 * ours / len(starts):.2f} ms a row"
        at_least, aim = limits
        lines.append(
            Line(
                quantity=name,
                ours=f"{ours:.3f} s",
                theirs=f"{theirs:.3f} s",
                value=ours / theirs,
                at_least=at_least,
                aim=aim,
                higher_is_better=False,
                note=note,
            )
        )
    difference = max(worst(images["rows"], images["batch"]), worst(images["live"], images["whole"]))
    lines.append(
        Line(
            quantity="row by row against batch, of the peak",
            ours=f"{difference:.1e}",
            theirs="",
            value=difference,
            at_least=2e-6,
            aim=5e-7,
            higher_is_better=False,
        )
    )
    return lines, {name: t.cpu for name, t in took.items()}


def run(args: argparse.Namespace) -> int:
    """Run the comparisons on one core and print the table; return 0."""
    rig, _ = published_scene(args.quick)
    lines: list[Line] = []
    figures_of_parts: dict[str, Any] = {}
    with temporary(args.folder) as folder, keep_on_one_core():
        path = folder / "cube.npy"
        write_point_cube(path, rig, rig.receivers[0])
        bench = Bench(rig, rig.receivers[0], path)
        for part in (compare_with_published, against_time_domain, against_batch):
            part_lines, figures = part(bench, count_repeats(args.quick, REPEATS))
            lines += part_lines
            figures_of_parts[part.__name__] = figures
    show(f"imaging of one board, {rig.grid.rows} x {rig.grid.columns} positions, one core", lines, args.quick)
    write(args.json, "image", lines, **figures_of_parts)
    return 0
