"""Imaging of a synchronised cube on a GPU, compared with one CPU core, the exact sum, and the authors' code.

Without a GPU, or without PyTorch and CuPy, it says so and measures nothing.
"""

from __future__ import annotations

import argparse
import importlib
import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

from benchmarks.data import published_scene, temporary, write_point_cube
from benchmarks.image import Image, worst
from benchmarks.measure import add_arguments as add_common, count_repeats, keep_on_one_core, write
from polysight.imaging import spectral
from polysight.imaging.direct import DirectImager
from polysight.imaging.geometry import Antennas, Aperture, find_scene_gate_m, image_grid, scan_offsets_m
from polysight.imaging.samples import reduction
from polysight.imaging.spectral import SpectralImager
from polysight_shared.config import Board, Instrument
from polysight_shared.geometry import rx_positions_m, tx_position_m
from polysight_shared.raster import plan_raster

# Rounds of what takes milliseconds; chosen.
ROUNDS = 20
# Rounds of what takes seconds; chosen.
FEW_ROUNDS = 3
# Products of position and voxel per chunk of the exact sum (chosen: the default suits a CPU's cache).
LARGE_CHUNK = 1 << 24


@dataclass(frozen=True)
class Library:
    """An array library with a GPU.

    Attributes
    ----------
    name
        PyTorch or CuPy.
    xp, device
        Array API namespace and device.
    card
        The GPU's name.
    """

    name: str
    xp: Any
    device: Any
    card: str

    def to_numpy(self, array: Any) -> NDArray[np.complexfloating]:
        """Copy an array to host memory."""
        # PyTorch has `cpu`, CuPy has `get`.
        if hasattr(array, "cpu"):
            array = array.cpu()
        elif hasattr(array, "get"):
            array = array.get()
        return np.asarray(array)


def libraries() -> list[Library]:
    """Return those of PyTorch and CuPy that are installed and see a GPU."""
    usable = []
    try:
        torch = importlib.import_module("torch")
        if torch.cuda.is_available():
            xp = importlib.import_module("array_api_compat.torch")
            usable.append(Library("PyTorch", xp, "cuda", torch.cuda.get_device_name()))
    except ImportError as error:
        print(f"PyTorch is not used: {error}")
    try:
        cupy = importlib.import_module("cupy")
        card = cupy.cuda.runtime.getDeviceProperties(0)["name"].decode()
        usable.append(Library("CuPy", importlib.import_module("array_api_compat.cupy"), None, card))
    except Exception as error:  # noqa: BLE001 - CuPy's errors without a GPU are many
        print(f"CuPy is not used: {error}")
    return usable


class Chain:
    """The way from a board's cube in the file `path` to its image, in NumPy or on a GPU: the same calls."""

    def __init__(self, rig: Instrument, board: Board, path: Path) -> None:
        grid = image_grid(rig)
        antennas = Antennas.from_rig(rig, board)
        self.gate = reduction(rig.chirp, find_scene_gate_m((antennas,), plan_raster(rig.grid), grid), "boxcar")
        self.aperture = Aperture(antennas, scan_offsets_m(rig), self.gate.frequencies_hz, grid)
        self.path = path

    def reduce(self, xp: Any = np, device: Any = None) -> Any:
        """Copy the cube [rx, row, column, sample] to the device; return gated samples [rx, frequency, row, column]."""
        matrix = self.gate.matrix.astype(np.complex64)
        # Samples outside the linear part have weight 0.
        used = np.flatnonzero(np.abs(matrix).max(axis=0))
        linear = slice(int(used[0]), int(used[-1]) + 1)
        weights = xp.asarray(np.ascontiguousarray(matrix[:, linear].T), device=device)
        cube = xp.asarray(np.load(self.path), device=device)
        return xp.permute_dims(xp.matmul(cube[:, :, :, linear], weights), (0, 3, 1, 2))

    def image(self, samples: Any, xp: Any = np, device: Any = None) -> Any:
        """Return the image [ny, nx] of reduced samples, with kernels kept from before where there are any."""
        return SpectralImager(self.aperture, xp=xp, device=device).image(samples)


def authors_settings(rig: Instrument, board: Board, folder: Path, bins: int) -> dict[str, Any]:
    """Return the settings of the authors' imager for this rig, with range spectra zero-padded to `bins` points.

    Keys and the numbers of antennas (TX 4, RX 7 to 10 of 21) are theirs; RH is their name of the board that receives H.
    """
    chirp = rig.chirp
    grid = image_grid(rig)
    first, last = chirp.linear_samples
    offsets = scan_offsets_m(rig)
    places = np.zeros((21, 3))
    places[7:11] = rx_positions_m(rig, board)
    places[4] = tx_position_m(rig)
    return {
        "fileDir": str(folder),
        "dx": rig.grid.step_x_mm / 1e3,
        "dy": rig.grid.step_y_mm / 1e3,
        "numX": offsets.shape[1],
        "numY": offsets.shape[0],
        "output_size_x": grid.shape[1],
        "output_size_y": grid.shape[0],
        "tx_idx": 4,
        "ant_locs": places.tolist(),
        "chirp_configs": {
            "f0": chirp.start_hz,
            "adc_start_time": chirp.adc_start_us / 1e6,
            "Fs": chirp.sample_rate_hz,
            "slope": chirp.slope_hz_per_s,
        },
        "RH_config": {
            "alignment_configs": {
                "idx_adc_start": first,
                "idx_adc_end": last,
                "ref_idx_aligned": 0,
                # Only the first 32 range bins of a chirp, which hold the scene, with so many points for each bin.
                "idx_fft_start_zoom": 0,
                "idx_fft_end_zoom": 32,
                "fs_zoom": chirp.samples,
                "nfft_scale": bins // chirp.samples,
            },
            "sar_focuse_center": [float(grid.x_m.mean()), float(grid.y_m.mean()), float(grid.z_m)],
            "masked_matched_filter": True,
            # All of these points.
            "num_fft_bin": -1,
            "idx_bin_offset": 0,
            "remove_avesig": False,
        },
    }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    add_common(parser)
    parser.add_argument("--authors", type=Path, default=None, help="a checkout of the authors' code, to run it beside")


def run(args: argparse.Namespace) -> int:
    """Measure on the first GPU, or say that there is none."""
    usable = libraries()
    if not usable:
        print("\nno GPU with PyTorch or CuPy and array-api-compat here: imaging on a GPU is not measured")
        return 0
    rig, _ = published_scene(args.quick)
    board = rig.receivers[0]
    rounds = count_repeats(args.quick, ROUNDS)
    figures: dict[str, Any] = {}
    with temporary(args.folder) as folder:
        path = folder / "RH_synced.npy"
        write_point_cube(path, rig, board)
        chain = Chain(rig, board, path)
        samples = random_samples(chain.aperture)
        print(f"\nimaging of one board, simulated: {usable[0].card}; wall seconds until the result is in host memory")
        with keep_on_one_core():
            cpu = Figures.of_numpy(chain, samples)
        cpu.print()
        figures["one CPU core"] = cpu.seconds
        for library in usable:
            gpu = Figures.of_library(chain, samples, library, rounds)
            gpu.print(cpu)
            figures[library.name] = {"card": library.card, "seconds": gpu.seconds, "differences": gpu.differences(cpu)}
        if args.authors is not None:
            figures["authors"] = measure_authors(args.authors, rig, board, folder, cpu.from_cube)
    write(args.json, "gpu", [], **figures)
    return 0


def random_samples(aperture: Aperture) -> NDArray[np.complex64]:
    """Return new random samples [rx, frequency, row, column] of an aperture: every pixel of their image counts."""
    rng = np.random.default_rng()
    parts = rng.standard_normal((2, *aperture.shape), np.float32)
    return parts[0] + 1j * parts[1]


@dataclass
class Figures:
    """Seconds of each step in one library, and its images.

    Attributes
    ----------
    name
        Library, or "one CPU core".
    seconds
        Wall seconds of every round of each step.
    from_samples, from_cube
        Image of the random samples, and of the cube on disk, [ny, nx].
    exact
        The random samples' image by direct summation in double precision; None where it would take hours.
    """

    name: str
    seconds: dict[str, list[float]]
    from_samples: Image
    from_cube: Image
    exact: Image | None = None

    @classmethod
    def of_numpy(cls, chain: Chain, samples: NDArray[np.complex64]) -> Figures:
        """Measure NumPy on this core."""
        spectral.clear_cache()
        seconds = {
            "first image": wall_seconds(lambda: chain.image(samples), 1),
            "image": wall_seconds(lambda: chain.image(samples), FEW_ROUNDS),
            "cube on disk to image": wall_seconds(lambda: chain.image(chain.reduce()), FEW_ROUNDS),
        }
        return cls("one CPU core", seconds, chain.image(samples), chain.image(chain.reduce()))

    @classmethod
    def of_library(cls, chain: Chain, samples: NDArray[np.complex64], library: Library, rounds: int) -> Figures:
        """Measure a library on its GPU."""
        xp = library.xp
        device = library.device

        def put() -> Any:
            return xp.asarray(samples, device=device)

        def from_cube() -> Image:
            return library.to_numpy(chain.image(chain.reduce(xp, device), xp, device))

        def from_samples() -> Image:
            return library.to_numpy(chain.image(put(), xp, device))

        def first() -> Image:
            spectral.clear_cache()
            return from_samples()

        def exact() -> Image:
            return library.to_numpy(DirectImager(chain.aperture).image(put()))

        # Without the time in which the library itself starts.
        first()
        resident = put()
        seconds = {
            "first image": wall_seconds(first, FEW_ROUNDS),
            "image": wall_seconds(from_samples, rounds),
            "image, samples on the GPU": wall_seconds(
                lambda: library.to_numpy(chain.image(resident, xp, device)), rounds
            ),
            "cube on disk to image": wall_seconds(from_cube, FEW_ROUNDS),
        }
        exact_images: list[Image] = []
        # A GPU would idle in the chunks that suit a CPU's cache.
        with patch("polysight.imaging.direct._CHUNK", LARGE_CHUNK):
            seconds["exact sum"] = wall_seconds(lambda: exact_images.append(exact()), 1)
        return cls(library.name, seconds, from_samples(), from_cube(), exact_images[0])

    def differences(self, cpu: Figures) -> dict[str, float]:
        """Return the largest differences of images, as shares of the peak."""
        differences = {
            "image beside NumPy's": worst(self.from_samples, cpu.from_samples),
            "image of the cube beside NumPy's": worst(self.from_cube, cpu.from_cube),
        }
        if self.exact is not None:
            differences["image beside the exact sum"] = worst(self.from_samples, self.exact)
            differences["NumPy's image beside the exact sum"] = worst(cpu.from_samples, self.exact)
        return differences

    def print(self, cpu: Figures | None = None) -> None:
        """Print median seconds of every step, and the differences from NumPy's."""
        for step, seconds in self.seconds.items():
            median = statistics.median(seconds)
            beside = ""
            if cpu is not None and step in cpu.seconds:
                beside = f"  {statistics.median(cpu.seconds[step]) / median:6.1f}x one CPU core"
            print(f"  {self.name:14} {step:28} {median:9.4f} s ({min(seconds):.4f} to {max(seconds):.4f}){beside}")
        if cpu is not None:
            for name, value in self.differences(cpu).items():
                print(f"  {self.name:14} {name}: {value:.1e} of the peak", flush=True)


def wall_seconds(job: Callable[[], Any], rounds: int) -> list[float]:
    """Run a job that ends with its result in host memory, and time each round."""
    taken = []
    for _ in range(rounds):
        began = time.perf_counter()
        job()
        taken.append(time.perf_counter() - began)
    return taken


def measure_authors(checkout: Path, rig: Instrument, board: Board, folder: Path, image: Image) -> dict[str, Any]:
    """Run the authors' imager on the same cube from disk; print and return its seconds and how like ours its image is.

    Their axes may run the other way, so the most similar of the four mirrored images counts.
    """
    answer: dict[str, Any] = {}
    for bins in (1024, 2048, 4096):
        settings = folder / f"settings-{bins}.json"
        settings.write_text(json.dumps(authors_settings(rig, board, folder, bins)), encoding="utf-8")
        theirs = folder / "theirs.npy"
        words = [
            sys.executable,
            str(Path(__file__).with_name("authors_gpu.py")),
            str(checkout),
            str(settings),
            str(theirs),
        ]
        program = subprocess.run(words, capture_output=True, text=True, check=False)
        if program.returncode:
            print(program.stderr[-2000:])
            answer[str(bins)] = {"error": program.stderr[-400:]}
            continue
        seconds = json.loads(program.stdout.splitlines()[-1])
        authors_images = np.load(theirs)
        likeness = max(
            _correlate(turned, image)
            for turned in (authors_images, authors_images[::-1], authors_images[:, ::-1], authors_images[::-1, ::-1])
        )
        answer[str(bins)] = {"seconds": seconds, "likeness": likeness}
        print(
            f"authors' code, range spectra of {bins} points: first {seconds[0]:.2f} s, then"
            f" {statistics.median(seconds[1:]):.3f} s; likeness of the images {likeness:.4f}"
        )
    return answer


def _correlate(one: Image, other: Image) -> float:
    """Return the normalised correlation of two images' magnitudes: 1 if equal but for a factor, 0 for other sizes."""
    if one.shape != other.shape:
        return 0.0
    a = np.abs(one)
    b = np.abs(other)
    return float((a * b).sum() / np.sqrt((a**2).sum() * (b**2).sum()))
