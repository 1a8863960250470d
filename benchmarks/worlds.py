"""Do error bars and names hold in physics that is not the simulator's? Scenes of the independent generator.

Each scene is one of `polysight_worlds`: vector physical optics, with one nuisance, all together, or none. The copper is
declared, boxes are given, the library holds Table 2 as half spaces. All is simulated, by a generator that shares no
code with the host. For each nuisance: how many 95 % regions hold the true permittivity, rms z of both parts, the
relative half width, the error, and how many names are right.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from polysight.data import packaged
from polysight.imaging import Antennas, Illumination, Images, illumination_geometry
from polysight.materials import UNKNOWN, Classifier, Entry, KnownScene, Library, MaterialsResult, Optics, analyse
from polysight.materials.inversion import MOVED, RigPrior
from polysight.materials.kinds import inverse_ratio
from polysight.materials.labels import patches_from_labels
from polysight.materials.train import fit_library
from polysight.polarimetry import fresnel
from polysight_shared.config import load_instrument
from polysight_worlds import NUISANCES, TABLE_2, ImagePair, Plate, draw_nuisances, draw_world, published_rig, simulate

UNMEASURED = ("leakage", "all")
"""Nuisances of rigs whose leakage was never measured."""
THETA_STD_RAD = 4e-3
"""Error of the incidence angle that the analysis counts with: 2 mm in the places of boards and plane."""
MARGIN_MM = 6.0
LEAST_PIXELS = 8
"""Least width and height of a plate's part within the picture."""
CHI2_95 = 5.991


@dataclass(frozen=True)
class PatchFigures:
    """One judged patch: squared distance of the truth in its region, relative half width and error, name and its share.

    Figures are None for a refused patch.
    """

    nuisance: str
    material: str
    distance2: float | None
    half_width: float | None
    error: float | None
    name: str
    confidence: float
    refused: str


@cache
def table_2_classifier(theta_rad: float) -> Classifier:
    """Return a classifier of Table 2's materials and copper as half spaces at one angle, four pieces each."""
    rng = np.random.default_rng(0)
    entries = []
    for piece in range(4):
        for name, permittivity in {**TABLE_2, "copper": None}.items():
            t = 1.0 + 0j
            level = 1.0
            if permittivity is not None:
                t = complex(inverse_ratio(permittivity, theta_rad))
                level = abs(complex(fresnel(permittivity, theta_rad)[0]))
            pixels = t * np.exp(0.003 * (rng.standard_normal(30) + 1j * rng.standard_normal(30)))
            entries.append(Entry(
                name, f"scan {piece}", np.full(30, level, np.float32), (level * abs(pixels)).astype(np.float32),
                (1 / pixels).astype(np.complex64), float(np.degrees(theta_rad)), True, specimen=f"{name} {piece}",
            ))  # fmt: skip
    return Classifier(fit_library(Library(tuple(entries))))


def illumination_of_worlds(shape: tuple[int, int], pixel_m: float) -> Illumination:
    """Return what the phase says about tilts on the published rig; the footprints are not known, and taken as even."""
    rig = load_instrument(packaged(Path("instrument.toml")))
    middle_hz = rig.chirp.first_sample_hz + rig.chirp.swept_hz / 2
    plane_m = rig.geometry.object_distance_mm / 1e3
    boards = [illumination_geometry(Antennas.of(rig, board), plane_m, middle_hz) for board in rig.receivers]
    moved = np.stack([moved for moved, _ in boards])
    steep = np.array([steepness for _, steepness in boards])
    return Illumination(np.ones((2, *shape), np.complex64), moved, steep, (pixel_m, pixel_m))


def analyse_world(
    pair: ImagePair, declared: str = "copper", measured: bool = True, classifier: Classifier | None = None
) -> tuple[MaterialsResult, dict[int, Plate]]:
    """Analyse the images of a world with given boxes; return the result, and patch number to true plate.

    `declared` is the plate that is given as the metal reference; `measured`: the rig's leakage was measured.
    """
    h, v = pair.h.astype(np.complex64), pair.v.astype(np.complex64)
    usable: npt.NDArray[np.bool_] = np.isfinite(h) & np.isfinite(v) & (h != 0) & (v != 0)
    light = illumination_of_worlds(h.shape, float(pair.x_m[1] - pair.x_m[0]))
    images = Images(h, v, pair.x_m, pair.y_m, usable, illumination=light)
    boxes: dict[str, tuple[float, float, float, float]] = {}
    plates = {}
    for i, plate in enumerate(pair.world.plates):
        x0, y0, x1, y1 = plate.box_m
        left, right = np.searchsorted(pair.x_m, [x0, x1]).tolist()
        bottom, top = np.searchsorted(pair.y_m, [y0, y1]).tolist()
        if plate.name != "table" and min(right - left, top - bottom) >= LEAST_PIXELS:
            boxes[f"{plate.name} {i}"] = (left, bottom, right, top)
            plates[f"{plate.name} {i}"] = plate
    segmentation, names = patches_from_labels(boxes, pair.x_m, pair.y_m, margin_mm=MARGIN_MM)
    metal = next(label for label, name in names.items() if plates[name].name == declared)
    prior = RigPrior(THETA_STD_RAD, channels_known=True)
    if measured:
        prior = replace(prior, leakage_std=0.003, leakage_measured=True, moved=MOVED)
    optics = Optics(np.radians(pair.incidence_deg), prior)
    found = analyse(images, optics, KnownScene(segmentation, metal, names), classifier)
    return found, {label: plates[name] for label, name in names.items()}


def judge_world(nuisance: str, seed: int) -> list[PatchFigures]:
    """Draw, scan and judge one world; return the figures of its patches without the copper."""
    rng = np.random.default_rng([seed, sum(map(ord, nuisance))])
    rig = published_rig()
    world = draw_world(rng, tuple(rig.centre_m), half_spaces=True)
    pair = simulate(world, draw_nuisances(rng, nuisance), rig)
    classifier = table_2_classifier(float(np.radians(pair.incidence_deg)))
    found, plates = analyse_world(pair, measured=nuisance not in UNMEASURED, classifier=classifier)
    out = []
    for patch in found.patches:
        plate = plates[patch.patch.label]
        if plate.stack.is_metal:
            continue
        e, name = patch.permittivity, patch.verdict
        refused = "" if patch.refused is None else patch.refused.what
        distance2, half_width, error = None, None, None
        if e.value is not None and e.covariance is not None and not refused:
            away = e.value - plate.stack.below
            parts = np.array([away.real, away.imag])
            distance2 = float(parts @ np.linalg.solve(e.covariance, parts))
            half_width = 1.96 * float(np.sqrt(np.trace(e.covariance) / 2)) / abs(e.value)
            error = abs(away) / abs(plate.stack.below)
        said = (UNKNOWN, 0.0) if name is None else (name.name, name.confidence)
        out.append(PatchFigures(nuisance, plate.name, distance2, half_width, error, *said, refused))
    return out


def _judge(job: tuple[str, int]) -> list[PatchFigures]:
    return judge_world(*job)


def line_of(title: str, patches: Sequence[PatchFigures]) -> str:
    """Return one line of the table."""
    distances = np.array([p.distance2 for p in patches if p.distance2 is not None])
    widths = [p.half_width for p in patches if p.half_width is not None]
    errors = [p.error for p in patches if p.error is not None]
    right = np.mean([p.name == p.material for p in patches])
    cells = [f"{title:<14}{len(patches):>8}{100 * float(np.mean(distances < CHI2_95)):>9.1f}"]
    cells.append(f"{np.sqrt(distances.mean() / 2):>8.2f}{100 * np.median(widths):>9.1f}{100 * np.median(errors):>8.1f}")
    cells.append(f"{100 * right:>9.1f}")
    for low, high in ((0.5, 0.8), (0.8, 0.95), (0.95, 1.01)):
        said = [p.name == p.material for p in patches if p.name != UNKNOWN and low <= p.confidence < high]
        cells.append(f"{100 * np.mean(said):>6.0f} ({len(said)})" if said else f"{'-':>6}    ")
    return "".join(cells)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the benchmark."""
    parser.add_argument("--scenes", type=int, default=1, help="scenes for each nuisance")
    parser.add_argument("--first", type=int, default=100, help="seed of the first scene")
    parser.add_argument("--nuisances", default=",".join(("none", *NUISANCES, "all")), help="separated by commas")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--json", type=Path, default=None, help="write the figures of each patch there")


def run(args: argparse.Namespace) -> int:
    """Judge worlds of each nuisance; print the table."""
    jobs = [(name, seed) for name in args.nuisances.split(",") for seed in range(args.first, args.first + args.scenes)]
    with ProcessPoolExecutor(args.jobs) as pool:
        patches = [p for scene in pool.map(_judge, jobs) for p in scene]
    print(__doc__)
    print(f"{'nuisance':<14}{'patches':>8}{'in 95 %':>9}{'rms z':>8}{'half %':>9}{'err %':>8}{'right %':>9}"
          "  names right % (said) at 0.5, 0.8, 0.95")  # fmt: skip
    for name in dict.fromkeys(p.nuisance for p in patches):
        print(line_of(name, [p for p in patches if p.nuisance == name]))
    print(line_of("together", patches))
    if args.json is not None:
        args.json.write_text(json.dumps([asdict(p) for p in patches], indent=1), encoding="utf-8")
    return 0
