"""Are plates that nearly touch found as plates of their own? Pictures of their own generator, drawn, not chosen.

Two to six plates in one or two rows, a stated number of resolution cells apart, of the same material or of different
ones. A picture is Fresnel's reflection, the band limit of an aperture (with the taper of a Hamming window or without),
uneven light, leakage, and noise; resolution cells of 4 to 12 mm, also where they differ between x and y. No hardware
made these pictures, and neither the simulator nor the host's imaging takes part: only the segmentation is judged.

A plate counts as separate if one patch covers most of it, nothing else covers it, and this patch covers no other plate.
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polysight.materials.segment import segment

# Distance of the pixels, and the incidence angle: those of the published rig.
PIXEL_MM = 2.0
THETA_RAD = np.radians(55.0)
# Half-power width of the response of an even band (sinc) and of one with a Hamming taper, times the band's width.
WIDTH_EVEN = 0.886
WIDTH_HAMMING = 1.30
# Least share of a plate that its patch covers, and largest share of another plate, or by another patch (chosen).
LEAST_COVERED = 0.5
MOST_OF_ANOTHER = 0.1
# Distances between plates, in resolution cells; chosen.
GAPS_CELLS = (1.0, 1.5, 2.0, 3.0)
FIRST_SEED = 38_000
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class PlateScene:
    """Images of H and V, complex [ny, nx], axes in metres, and the mask of each plate."""

    h: NDArray[np.complex128]
    v: NDArray[np.complex128]
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    plates: tuple[Mask, ...]


@dataclass(frozen=True)
class GapFigures:
    """Result at one gap and kind of materials."""

    # Gap in resolution cells.
    gap_cells: float
    same_material: bool
    # Plates of all scenes, and how many of them are separate.
    plates: int
    separate: int
    # Patches that are not a plate.
    strays: int

    @property
    def share(self) -> float:
        """Share of separate plates."""
        return self.separate / self.plates


def reflect(permittivity: complex) -> tuple[complex, complex]:
    """Return Fresnel's reflection of a half space, s and p."""
    cosine = np.cos(THETA_RAD)
    index = np.sqrt(permittivity)
    inside = np.sqrt(1 - np.sin(THETA_RAD) ** 2 / permittivity)
    s = (cosine - index * inside) / (cosine + index * inside)
    p = (inside - index * cosine) / (inside + index * cosine)
    return complex(s), complex(p)


def draw_scene(seed: int, gap_cells: float, same_material: bool) -> PlateScene:
    """Draw plates in one or two rows, a number of resolution cells apart along both axes; all ranges are chosen."""
    rng = np.random.default_rng(seed)
    cells_mm = rng.uniform(4.0, 12.0, 2)
    tapered = bool(rng.integers(2))
    columns, rows = [(2, 1), (1, 2), (3, 1), (2, 2), (3, 2), (5, 1)][int(rng.integers(6))]
    sizes_mm = 18 + cells_mm + rng.uniform(10.0, 30.0, 2)
    pitch_mm = sizes_mm + gap_cells * cells_mm
    reach_mm = np.array([columns, rows]) * pitch_mm + 60
    counts = np.ceil(reach_mm / PIXEL_MM).astype(int)
    x_mm, y_mm = ((np.arange(n) - (n - 1) / 2) * PIXEL_MM for n in counts)

    # A real part of 2 to 9 with its loss; the same for all, or another for each.
    drawn = [complex(rng.uniform(2.0, 9.0), -rng.uniform(0.01, 1.5)) for _ in range(columns * rows)]
    has_metal = bool(rng.integers(2))
    reflections = [reflect(drawn[0] if same_material else eps) for eps in drawn]
    if has_metal and not same_material:
        reflections[int(rng.integers(len(drawn)))] = (-1.0, -1.0)

    plates = []
    s, p = np.zeros((2, y_mm.size, x_mm.size), complex)
    for number, (reflected_s, reflected_p) in enumerate(reflections):
        centre_x = (number % columns - (columns - 1) / 2) * pitch_mm[0] + rng.uniform(-0.5, 0.5)
        centre_y = (number // columns - (rows - 1) / 2) * pitch_mm[1] + rng.uniform(-0.5, 0.5)
        inside_x = np.abs(x_mm - centre_x) <= sizes_mm[0] / 2
        inside_y = np.abs(y_mm - centre_y) <= sizes_mm[1] / 2
        plate = inside_y[:, None] & inside_x[None, :]
        s[plate] = reflected_s
        p[plate] = reflected_p
        plates.append(plate)

    leakage = 0.03 * np.exp(1j * rng.uniform(0, 2 * np.pi, 2))
    transfer = _transfer(s.shape, cells_mm, tapered)
    brightest = max(abs(reflected_s) for reflected_s, _ in reflections)
    channels = []
    for channel in (s + leakage[0] * p, p + leakage[1] * s):
        noise = rng.standard_normal((2, *s.shape))
        noise = np.fft.ifft2(np.fft.fft2(noise[0] + 1j * noise[1]) * transfer)
        # 35 dB below the brightest plate.
        noise *= 10 ** (-35 / 20) * brightest / np.sqrt(np.mean(np.abs(noise) ** 2))
        light = np.exp(rng.uniform(0.0, 0.15) * _draw_uneven_light(rng, s.shape))
        channels.append(np.fft.ifft2(np.fft.fft2(channel * light) * transfer) + noise)
    return PlateScene(channels[0], channels[1], x_mm / 1e3, y_mm / 1e3, tuple(plates))


def _transfer(shape: tuple[int, ...], cells_mm: NDArray[np.float64], tapered: bool) -> NDArray[np.float64]:
    """Return the aperture's transfer function [ny, nx] with these half-power widths along x and y."""
    factors = []
    for count, cell_mm in zip(shape[::-1], cells_mm, strict=True):
        if tapered:
            share = np.fft.fftfreq(count, PIXEL_MM) * cell_mm / WIDTH_HAMMING
            taper = 0.54 + 0.46 * np.cos(2 * np.pi * share)
        else:
            share = np.fft.fftfreq(count, PIXEL_MM) * cell_mm / WIDTH_EVEN
            taper = np.ones(count)
        factors.append(np.where(np.abs(share) <= 0.5, taper, 0.0))
    return factors[1][:, None] * factors[0][None, :]


def _draw_uneven_light(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.complex128]:
    """Return a complex random field [ny, nx] of unit scatter, correlated over about 30 mm."""
    per_mm = [np.fft.fftfreq(count, PIXEL_MM) for count in shape]
    # In space exp(-(pi r / 60 mm)^2): 1 / e at 19 mm; the field's own correlation is wider by sqrt(2), 27 mm.
    passed = np.exp(-((per_mm[0][:, None] * 60) ** 2) - (per_mm[1][None, :] * 60) ** 2)
    white = rng.standard_normal((2, *shape))
    field = np.fft.ifft2(np.fft.fft2(white[0] + 1j * white[1]) * passed)
    return field / np.sqrt(np.mean(np.abs(field) ** 2))


def count_separate(scene: PlateScene) -> tuple[int, int]:
    """Return how many plates are patches of their own, and how many patches are not a plate."""
    patches = [patch.mask for patch in segment(scene.h, scene.v, scene.x_m, scene.y_m).patches]
    if not patches:
        return 0, 0
    covered = np.array([[float((patch & plate).sum() / plate.sum()) for patch in patches] for plate in scene.plates])
    separate = 0
    for plate_number in range(len(scene.plates)):
        best = int(covered[plate_number].argmax())
        others_of_plate = np.delete(covered[plate_number], best)
        others_of_patch = np.delete(covered[:, best], plate_number)
        is_covered = covered[plate_number, best] >= LEAST_COVERED
        is_alone = max(others_of_plate, default=0.0) < MOST_OF_ANOTHER
        covers_no_other = max(others_of_patch, default=0.0) < MOST_OF_ANOTHER
        separate += int(is_covered and is_alone and covers_no_other)
    strays = int((covered.max(axis=0) < MOST_OF_ANOTHER).sum())
    return separate, strays


def judge_gap(gap_cells: float, same_material: bool, scenes: int, first_seed: int) -> GapFigures:
    """Segment `scenes` drawn scenes of one gap and count separate plates."""
    plates = 0
    separate = 0
    strays = 0
    for seed in range(first_seed, first_seed + scenes):
        scene = draw_scene(seed, gap_cells, same_material)
        separate_plates, extra = count_separate(scene)
        plates += len(scene.plates)
        separate += separate_plates
        strays += extra
    return GapFigures(gap_cells, same_material, plates, separate, strays)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--scenes", type=int, default=40, help="scenes of each gap and kind (default: 40)")
    parser.add_argument("--first", type=int, default=FIRST_SEED, help=f"first seed (default: {FIRST_SEED})")
    parser.add_argument("--json", type=Path, help="file for the figures")


def run(args: argparse.Namespace) -> int:
    """Print a line for each gap and kind of materials. Return 0."""
    figures = []
    print("gap (cells)  materials  separate plates    patches that are no plate")
    for gap_cells in GAPS_CELLS:
        for same_material in (False, True):
            row = judge_gap(gap_cells, same_material, args.scenes, args.first)
            figures.append(asdict(row))
            kind = "same" if same_material else "different"
            print(
                f"{gap_cells:11.1f}  {kind:9}  {row.separate:4} of {row.plates:4} ({row.share:4.0%})   {row.strays}",
                flush=True,
            )
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1))
    return 0
