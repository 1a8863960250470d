"""Are shape and permittivity of curved and tilted objects right? Objects of the independent generator.

Each object is drawn by `polysight_worlds`: exact series for spheres and cylinders, physical optics for all else, no
code shared with the host. A metal sphere, scanned with the same rig, is the reference. The rig of each object is
disturbed as said. All is simulated, at the nominal noise of the published rig. Figures of an object are medians over
its points; figures of a kind are 68th percentiles over its objects, beside what must hold.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polysight.data import packaged
from polysight.surfaces import (
    Gains,
    Optics,
    Samples,
    Seen,
    Segment,
    Surface,
    Uncertainty,
    analyse_surface,
    learn_gains,
    optics_of,
    see_points,
    voltages_of,
)
from polysight_shared.config import load_instrument
from polysight_worlds import (
    KINDS,
    Boards,
    Shape,
    ShapeNuisances,
    ShapeScene,
    draw_shapes,
    load_boards,
    reference_sphere,
    scan_offsets,
    scan_shapes,
)
from polysight_worlds.shape_scenes import FREQUENCIES_HZ

CHI2_95 = 5.991
RIG_FILE = packaged(Path("instrument.toml"))
# Paths over fronts of objects and over the table behind them.
GATE_M = (1.45, 2.2)
# Points farther from the object's surface than this are of something else.
STRAY_M = 0.01
DISTURBANCES: dict[str, dict[str, float]] = {
    "none": {},
    "misplaced": {"misplaced_mm": 1.0},
    "axes": {"axes_deg": 2.0},
    "leakage": {"leakage": 0.05},
    "table": {},
    "all": {"misplaced_mm": 1.0, "axes_deg": 2.0, "leakage": 0.05},
}
# What must hold for the 68th percentile of objects: normals in degrees, points in mm, permittivity in per cent (None:
# none is to be given).
LARGE = (0.5, 0.5, 3.0)
MUST_HOLD: dict[str, tuple[float | None, float | None, float | None]] = {
    **dict.fromkeys(("plate", "sphere", "cylinder", "cone", "barrel", "saddle", "sheet"), LARGE),
    "cylinder 50": (1.0, None, 5.0),
    "sphere 50": (3.0, None, 6.0),
}


@dataclass(frozen=True)
class ObjectFigures:
    """One object: medians over its points, and its permittivity.

    `normal_z2`, `point_z2`: means of squared errors over the variances said. `distance2`: squared distance of the true
    permittivity in the region of the object; `points_inside`: share of points whose own region holds it. Figures are
    None where nothing was seen or given.
    """

    kind: str
    seed: int
    disturbance: str
    true_real: float
    true_loss: float
    radius_mm: float
    points: int
    stray: int
    normal_deg: float | None = None
    point_mm: float | None = None
    normal_z2: float | None = None
    point_z2: float | None = None
    error: float | None = None
    distance2: float | None = None
    points_inside: float | None = None
    half_width: float | None = None
    dominated_by: str = ""
    reason: str = ""
    seconds: float = 0.0


@cache
def nominal_boards() -> Boards:
    """Return the antennas of the rig file."""
    return load_boards(RIG_FILE)


@cache
def nominal_optics() -> Optics:
    """Return the rig as the host takes it."""
    return optics_of(load_instrument(RIG_FILE))


def see_shapes(shapes: Sequence[Shape], nuisances: ShapeNuisances, grid: tuple[int, int], number: int) -> Seen:
    """Scan shapes and find their specular points."""
    offsets = scan_offsets(*grid)
    cubes = scan_shapes(shapes, offsets, nuisances, boards=nominal_boards(), number=number)
    boards = nominal_boards()
    valid = np.ones(offsets.shape[:2], bool)
    samples = []
    for channel, receivers in boards.receivers().items():
        rx_m = np.array([rx.position for rx in receivers])
        samples.append(Samples(cubes[channel], valid, offsets, FREQUENCIES_HZ, boards.tx.position, rx_m))
    return see_points(samples[0], samples[1], nominal_optics(), GATE_M)


@cache
def see_reference(nuisances: ShapeNuisances, grid: tuple[int, int]) -> Seen:
    """Find the points of the metal sphere that the same rig scanned before."""
    seen = see_shapes([reference_sphere()], nuisances, grid, number=1)
    return seen[seen.segment == 0]


def analyse_shapes(scene: ShapeScene, nuisances: ShapeNuisances, grid: tuple[int, int]) -> tuple[Surface, float]:
    """Scan a scene and its reference; return what the host finds, and the seconds of CPU it took."""
    metal = see_reference(nuisances, grid)
    known: dict[int, tuple[Optics, Gains]] = {}

    def reference(optics: Optics) -> Gains:
        if id(optics) not in known:
            known[id(optics)] = (optics, learn_gains(voltages_of(metal, optics), optics.wave_number))
        return known[id(optics)][1]

    started = time.process_time()
    seen = see_shapes((*scene.shapes, *scene.background), nuisances, grid, number=2)
    found = analyse_surface(seen, nominal_optics(), reference, uncertainty=Uncertainty(), simulated=True)
    return found, time.process_time() - started


def judge_object(kind: str, seed: int, disturbance: str, grid: tuple[int, int]) -> ObjectFigures:
    """Draw, scan and judge one object."""
    scene = draw_shapes(seed, kind, with_table=disturbance in ("table", "all"))
    nuisances = ShapeNuisances(seed=seed, gain_db=1.5, **DISTURBANCES[disturbance])
    surface, seconds = analyse_shapes(scene, nuisances, grid)
    truth = scene.permittivity if scene.is_uniform else None
    distances, normals = scene.surface_at(surface.points_m)
    on_object = np.abs(distances) < STRAY_M
    background = np.zeros(len(distances), bool)
    for shape in scene.background:
        background |= np.abs(shape.project(surface.points_m)[0]) < STRAY_M
    figures = ObjectFigures(
        kind=kind,
        seed=seed,
        disturbance=disturbance,
        true_real=float("nan") if scene.permittivity is None else scene.permittivity.real,
        true_loss=float("nan") if scene.permittivity is None else -scene.permittivity.imag,
        radius_mm=1000 * scene.radius_m,
        points=int(on_object.sum()),
        stray=int((~on_object & ~background).sum()),
        seconds=seconds,
    )
    if not on_object.any():
        return figures
    turns_deg = angles_deg(surface.normals, normals)[on_object]
    away_m = np.abs(distances)[on_object]
    figures = replace(
        figures,
        normal_deg=float(np.median(turns_deg)),
        point_mm=float(1000 * np.median(away_m)),
        normal_z2=float(np.median((turns_deg / surface.normal_std_deg[on_object]) ** 2)),
        point_z2=float(np.median((away_m / surface.position_std_m[on_object]) ** 2)),
    )
    numbers, counts = np.unique(surface.segment[on_object], return_counts=True)
    largest = int(numbers[counts.argmax()])
    segment = next(s for s in surface.segments if s.number == largest)
    of_segment = on_object & (surface.segment == largest)
    return judge_permittivity(figures, segment, surface, of_segment, truth)


def judge_permittivity(
    figures: ObjectFigures, segment: Segment, surface: Surface, members: NDArray, truth: complex | None
) -> ObjectFigures:
    """Add what the object's largest segment says of its medium; a permittivity without truth has an endless error."""
    if segment.permittivity is None or segment.covariance is None:
        return replace(figures, reason=segment.reason)
    if truth is None:
        return replace(figures, error=float("inf"))
    covariance = np.array(segment.covariance)
    points = surface.permittivity[members]
    inside = squared_distances(points - truth, surface.covariance[members]) < CHI2_95
    return replace(
        figures,
        error=abs(segment.permittivity - truth) / abs(truth),
        distance2=float(squared_distances(np.array([segment.permittivity - truth]), covariance[None])[0]),
        points_inside=float(np.mean(inside[np.isfinite(points)])),
        half_width=1.96 * float(np.sqrt(np.trace(covariance) / 2)) / abs(truth),
        dominated_by=segment.dominated_by,
    )


def squared_distances(away: NDArray, covariances: NDArray) -> NDArray:
    """Squared distances [n] of complex differences [n] in regions of covariance [n, 2, 2]."""
    parts = np.stack([np.real(away), np.imag(away)], axis=-1)
    return np.einsum("ni,nij,nj->n", parts, np.linalg.pinv(np.nan_to_num(covariances)), parts)


def angles_deg(first: NDArray, second: NDArray) -> NDArray:
    """Angles [n] between unit vectors [n, 3]."""
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=1) / 2, 0, 1)))


def _judge(job: tuple[str, int, str, tuple[int, int]]) -> ObjectFigures:
    return judge_object(*job)


def line_of(title: str, figures: Sequence[ObjectFigures], limits: tuple[float | None, ...] | None = None) -> str:
    """Return one line of the table."""
    columns = [[f.normal_deg for f in figures], [f.point_mm for f in figures]]
    columns.append([None if f.error is None else 100 * f.error for f in figures])
    cells = [f"{title:<26}{len(figures):>5}"]
    for values, limit in zip(columns, limits or (None, None, None), strict=True):
        known = [v for v in values if v is not None]
        value = f"{np.percentile(known, 68, method='inverted_cdf'):.2f}" if known else "-"
        cells.append(f"{value:>8} {'' if limit is None else f'<= {limit:g}':<7}")
    given = [f for f in figures if f.error is not None]
    cells.append(f"{100 * len(given) / len(figures):>7.0f}")
    distances = [f.distance2 for f in figures if f.distance2 is not None]
    inside = [f.points_inside for f in figures if f.points_inside is not None]
    widths = [100 * f.half_width for f in figures if f.half_width is not None]
    if distances:
        cells.append(
            f"{100 * np.mean(np.array(distances) < CHI2_95):>9.0f}{np.sqrt(np.median(distances) / 1.386):>8.2f}"
        )
        cells.append(f"{100 * np.mean(inside):>9.0f}{np.median(widths):>9.1f}")
    return "".join(cells)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of the benchmark."""
    parser.add_argument("--objects", type=int, default=1, help="objects of each kind and disturbance")
    parser.add_argument("--first", type=int, default=100, help="seed of the first object")
    parser.add_argument("--kinds", default=",".join(KINDS), help="separated by commas")
    parser.add_argument("--disturbances", default="none", help=f"of: {', '.join(DISTURBANCES)}")
    parser.add_argument("--columns", type=int, default=350, help="stage positions in x, 2 mm apart")
    parser.add_argument("--rows", type=int, default=200, help="stage positions in y")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--json", type=Path, default=None, help="write the figures of each object there")


def run(args: argparse.Namespace) -> int:
    """Judge drawn objects of each kind; print the table."""
    seeds = range(args.first, args.first + args.objects)
    kinds, disturbances = args.kinds.split(","), args.disturbances.split(",")
    grid = args.columns, args.rows
    jobs = [(kind, seed, name, grid) for name in disturbances for seed in seeds for kind in kinds]
    figures = []
    with ProcessPoolExecutor(args.jobs) as pool:
        for judged in pool.map(_judge, jobs):
            figures.append(judged)
            said = "no permittivity" if judged.error is None else f"permittivity within {100 * judged.error:.1f} %"
            print(f"{judged.kind} {judged.seed}, {judged.disturbance}: {judged.points} points, {said}", file=sys.stderr)
    print(__doc__)
    print(f"{'kind':<26}{'n':>5}{'normal deg':>16}{'point mm':>16}{'eps %':>16}{'given %':>7}"
          f"{'in 95 %':>9}{'rms z':>8}{'points':>9}{'half %':>9}")  # fmt: skip
    for name in disturbances:
        for kind in kinds:
            chosen = [f for f in figures if (f.kind, f.disturbance) == (kind, name)]
            print(line_of(f"{kind}, {name}", chosen, MUST_HOLD.get(kind)))
        print(line_of(f"together, {name}", [f for f in figures if f.disturbance == name]))
    print(f"seconds of CPU, scan and analysis: {np.median([f.seconds for f in figures]):.0f} an object")
    if args.json is not None:
        args.json.write_text(json.dumps([asdict(f) for f in figures], indent=1), encoding="utf-8")
    return 0
