"""Are shape and permittivity of curved and tilted objects right? Objects of the independent generator.

Each object is drawn by `polysight_worlds`: exact series for spheres and cylinders, physical optics for all else, no
code shared with the host. A metal sphere, scanned with the same rig, is the reference. The rig of each object is
disturbed as said. All is simulated, at the nominal noise of the published rig. Figures of an object are medians over
its points; figures of a kind are 68th percentiles over its objects, with their limits. The host is given the
standard errors that the disturbance really has, so that its 95 % regions can be judged.

`--quick` scans every 4 mm with one RX a board, with the noise that the averages of the whole scan have: the same
information for a sixteenth of the CPU.

`--campaign FILE` adds each judged object to a file as soon as it is done, and skips those that the file holds: a long
campaign may be stopped and run on, in as many slices as one likes. Its tables are those of all objects in the file.
"""

import argparse
import json
import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import polysight_worlds as worlds
from polysight import surfaces
from polysight.data import find_packaged
from polysight_shared.config import load_instrument
from polysight_worlds.shape_scenes import FREQUENCIES_HZ

# Squared distance within which a normal distribution in two dimensions holds 95 %.
CHI2_95 = 5.991
RIG_FILE = find_packaged(Path("instrument.toml"))
# Paths from TX to RX over fronts of objects and over the table behind them, metres: outside nothing is looked for.
GATE_M = (1.45, 2.2)
# Points farther from the object's surface than this (chosen) are of something else.
STRAY_M = 0.01
# Arguments of `ShapeNuisances` for each disturbance of the rig.
DISTURBANCES: dict[str, dict[str, float]] = {
    "none": {},
    "misplaced": {"misplaced_mm": 1.0},
    "axes": {"axes_deg": 2.0},
    "leakage": {"leakage": 0.05},
    "table": {},
    "all": {"misplaced_mm": 1.0, "axes_deg": 2.0, "leakage": 0.05},
}
# Standard errors that the host is given: those of the disturbance (each axis of a place, each part of a leakage), and
# none of a rig that stands as its file says.
EXACT = surfaces.Uncertainty(leakage=0.0, axis_rad=0.0, place_m=0.0)
PLACES = {"place_m": 0.001 / np.sqrt(3)}
AXES = {"axis_rad": float(np.radians(2.0))}
LEAKAGE = {"leakage": 0.05 / np.sqrt(2)}
KNOWN: dict[str, surfaces.Uncertainty] = {
    "none": EXACT,
    "table": EXACT,
    "misplaced": replace(EXACT, **PLACES),
    "axes": replace(EXACT, **AXES),
    "leakage": replace(EXACT, **LEAKAGE),
    "all": surfaces.Uncertainty(**PLACES, **AXES, **LEAKAGE),
}
# Points of the reference that are kept, as `polysight calibrate sphere` keeps them.
KEPT_POINTS = 240
# Positions of a quick scan: every so many-th in x and y; chosen.
QUICK_STEP = 2
# Limits of the 68th percentile over objects (chosen): normals in degrees, points in mm, permittivity in % (None: none).
# `LARGE`: for radii of 100 mm and more, and other shapes; a radius of 50 mm has wider limits.
LARGE = (0.5, 0.5, 3.0)
MUST_HOLD: dict[str, tuple[float | None, float | None, float | None]] = {
    **dict.fromkeys(("plate", "sphere", "cylinder", "cone", "barrel", "saddle", "sheet"), LARGE),
    "cylinder 50": (1.0, None, 5.0),
    "sphere 50": (3.0, None, 6.0),
}


@dataclass(frozen=True)
class ObjectFigures:
    """One object: medians over its points, and its permittivity.

    `normals_inside`, `places_inside`: shares of points whose own 95 % regions hold the surface. `distance2`: squared
    distance of the true permittivity in the region of the object; `points_inside`: share of points whose own region
    holds it. `error`, `half_width`: error of the permittivity and half width of its 95 % region, over its magnitude.
    `stray`: number of points on neither object nor background. `normal_68_deg`, `point_68_mm`, `point_error_68`: 68th
    percentiles over the object's points. Figures are None where nothing was seen or given.
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
    normal_68_deg: float | None = None
    point_68_mm: float | None = None
    normals_inside: float | None = None
    places_inside: float | None = None
    error: float | None = None
    distance2: float | None = None
    points_inside: float | None = None
    point_error_68: float | None = None
    half_width: float | None = None
    dominated_by: str = ""
    reason: str = ""
    seconds: float = 0.0


@dataclass(frozen=True)
class ScanKind:
    """How objects are scanned: columns and rows 2 mm apart; `is_quick` as of the option."""

    columns: int = 350
    rows: int = 200
    is_quick: bool = False

    @property
    def offsets_m(self) -> NDArray:
        """Stage offsets [row, column, 3]."""
        every = 1
        if self.is_quick:
            every = QUICK_STEP
        return worlds.scan_offsets(self.columns, self.rows, every=every)

    @property
    def boards(self) -> worlds.Boards:
        """Antennas of the rig file; of a quick scan, one RX of each board."""
        boards = worlds.load_boards(RIG_FILE)
        if self.is_quick:
            # One near the middle of the board.
            return replace(boards, h=boards.h[1:2], v=boards.v[1:2])
        return boards

    @property
    def optics(self) -> surfaces.Optics:
        """Places, polarisations and wave number of the rig file's antennas, for the host's analysis."""
        optics = surfaces.make_optics(load_instrument(RIG_FILE))
        if not self.is_quick:
            return optics
        h_m = self.boards.h[0].position
        v_m = self.boards.v[0].position
        return replace(optics, h=replace(optics.h, at_m=h_m), v=replace(optics.v, at_m=v_m))

    @property
    def noise(self) -> float:
        """Noise of a sample over the nominal one: a quick scan has fewer positions and RX to average over."""
        if self.is_quick:
            return 0.25
        return 1.0


def see_shapes(
    shapes: Sequence[worlds.Shape], nuisances: worlds.ShapeNuisances, scan: ScanKind, number: int
) -> surfaces.SeenEchoes:
    """Scan shapes and return their specular points; scans of one rig with another `number` have other noise."""
    boards = scan.boards
    cubes = worlds.scan_shapes(shapes, scan.offsets_m, nuisances, boards=boards, number=number)
    valid = np.ones(scan.offsets_m.shape[:2], bool)
    samples = []
    for channel, receivers in boards.receivers().items():
        rx_m = np.array([rx.position for rx in receivers])
        samples.append(
            surfaces.Samples(cubes[channel], valid, scan.offsets_m, FREQUENCIES_HZ, boards.tx.position, rx_m)
        )
    return surfaces.see_points(samples[0], samples[1], scan.optics, GATE_M)


@cache
def see_reference(nuisances: worlds.ShapeNuisances, scan: ScanKind) -> surfaces.SeenEchoes:
    """Find the points of the metal sphere that the same rig scanned before."""
    points = see_shapes([worlds.reference_sphere()], nuisances, scan, number=1)
    metal = points[points.segment == 0]
    kept_indices = np.linspace(0, len(metal) - 1, min(KEPT_POINTS, len(metal))).round().astype(int)
    return metal[kept_indices]


def analyse_shapes(
    scene: worlds.ShapeScene, nuisances: worlds.ShapeNuisances, uncertainty: surfaces.Uncertainty, scan: ScanKind
) -> tuple[surfaces.Surface, float]:
    """Scan a scene and its reference; return what the host finds, and the seconds of CPU that its analysis took."""
    metal = see_reference(nuisances, scan)

    def reference(optics: surfaces.Optics) -> surfaces.Gains:
        """Return the gains of the channels by the metal sphere, for antennas as the analysis assumes them."""
        return surfaces.learn_gains(surfaces.find_voltages(metal, optics), optics.wave_number)

    points = see_shapes((*scene.shapes, *scene.background), nuisances, scan, number=2)
    started = time.process_time()
    surface = surfaces.analyse_surface(points, scan.optics, reference, uncertainty=uncertainty, simulated=True)
    return surface, time.process_time() - started


def judge_object(kind: str, seed: int, disturbance: str, scan: ScanKind) -> ObjectFigures:
    """Draw, scan and judge one object."""
    scene = worlds.draw_shapes(seed, kind, with_table=disturbance in ("table", "all"))
    # Every rig has unknown gains, spread by 1.5 dB (chosen): the reference has to determine them.
    nuisances = worlds.ShapeNuisances(seed=seed, noise=scan.noise, gain_db=1.5, **DISTURBANCES[disturbance])
    surface, seconds = analyse_shapes(scene, nuisances, KNOWN[disturbance], scan)
    truth = None
    if scene.is_uniform:
        truth = scene.permittivity
    distances, normals = scene.nearest_surface(surface.points_m)
    on_object = np.abs(distances) < STRAY_M
    background = np.zeros(len(distances), bool)
    for shape in scene.background:
        away_from_shape = np.abs(shape.project(surface.points_m)[0])
        background |= away_from_shape < STRAY_M
        # Where a table touches the object, a point is of the one that is nearer: the object's back is not seen.
        on_object &= away_from_shape > np.abs(distances)
    true_real = float("nan")
    true_loss = float("nan")
    if scene.permittivity is not None:
        true_real = scene.permittivity.real
        true_loss = -scene.permittivity.imag
    figures = ObjectFigures(
        kind=kind,
        seed=seed,
        disturbance=disturbance,
        true_real=true_real,
        true_loss=true_loss,
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
        normal_68_deg=float(np.percentile(turns_deg, 68)),
        point_68_mm=float(1000 * np.percentile(away_m, 68)),
        # A normal turns in two directions, of which this is the root of both variances: 95 % or more lie within 1.96.
        normals_inside=float(np.mean(turns_deg < 1.96 * surface.normal_std_deg[on_object])),
        places_inside=float(np.mean(away_m < 1.96 * surface.position_std_m[on_object])),
    )
    segments, counts = np.unique(surface.segment[on_object], return_counts=True)
    largest = int(segments[counts.argmax()])
    segment = next(s for s in surface.segments if s.number == largest)
    of_segment = on_object & (surface.segment == largest)
    return judge_permittivity(figures, segment, surface, of_segment, truth)


def judge_permittivity(
    figures: ObjectFigures,
    segment: surfaces.Segment,
    surface: surfaces.Surface,
    members: NDArray,
    truth: complex | None,
) -> ObjectFigures:
    """Add what the object's largest segment says of its medium; a permittivity without truth has an endless error."""
    if segment.permittivity is None or segment.covariance is None:
        return replace(figures, reason=segment.reason)
    if truth is None:
        return replace(figures, error=float("inf"))
    covariance = np.array(segment.covariance)
    points = surface.permittivity[members]
    inside = squared_distances(points - truth, surface.covariance[members]) < CHI2_95
    point_errors = np.abs(points - truth)[np.isfinite(points)] / abs(truth)
    return replace(
        figures,
        error=abs(segment.permittivity - truth) / abs(truth),
        distance2=float(squared_distances(np.array([segment.permittivity - truth]), covariance[None])[0]),
        points_inside=float(np.mean(inside[np.isfinite(points)])),
        point_error_68=float(np.percentile(point_errors, 68)),
        half_width=1.96 * float(np.sqrt(np.trace(covariance) / 2)) / abs(truth),
        dominated_by=segment.dominated_by,
    )


def squared_distances(away: NDArray, covariances: NDArray) -> NDArray:
    """Return the squared distances [n] of complex differences [n], in units of the covariances [n, 2, 2]."""
    parts = np.stack([np.real(away), np.imag(away)], axis=-1)
    return np.einsum("ni,nij,nj->n", parts, np.linalg.pinv(np.nan_to_num(covariances)), parts)


def angles_deg(first: NDArray, second: NDArray) -> NDArray:
    """Return the angles [n] between unit vectors [n, 3], degrees."""
    return np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=1) / 2, 0, 1)))


def _percentile_68(values: Iterable[float | None]) -> str:
    """Return the 68th percentile of the figures that are known, as a cell of the table."""
    numbers = [value for value in values if value is not None]
    if not numbers:
        return "-"
    return f"{np.percentile(numbers, 68, method='inverted_cdf'):.2f}"


def _percent(values: Iterable[float | bool | None]) -> str:
    """Return the mean of the shares that are known, in per cent, as a cell of the table."""
    numbers = [float(value) for value in values if value is not None]
    if not numbers:
        return "-"
    return f"{100 * np.mean(numbers):.0f}"


def _in_percent(value: float | None) -> float | None:
    if value is None:
        return None
    return 100 * value


def _is_inside(figures: ObjectFigures) -> bool | None:
    """True if the object's 95 % region holds its permittivity; None without a region."""
    if figures.distance2 is None:
        return None
    return figures.distance2 < CHI2_95


OBJECTS_HEAD = (
    f"{'objects':<26}{'n':>5}{'normal deg':>16}{'point mm':>16}{'eps %':>16}{'given %':>9}{'in 95 %':>9}{'half %':>8}"
)
POINTS_HEAD = (
    f"{'points':<26}{'n':>5}{'normal deg':>12}{'in 95 %':>9}{'point mm':>12}{'in 95 %':>9}{'eps %':>12}{'in 95 %':>9}"
)


def format_line(title: str, figures: Sequence[ObjectFigures], limits: tuple[float | None, ...] | None = None) -> str:
    """Return one line of the table of objects: 68th percentiles of their figures, and how many regions hold."""
    columns: list[list[float | None]] = [
        [f.normal_deg for f in figures],
        [f.point_mm for f in figures],
        [_in_percent(f.error) for f in figures],
    ]
    cells = [f"{title:<26}{len(figures):>5}"]
    for values, limit in zip(columns, limits or (None, None, None), strict=True):
        must_hold = ""
        if limit is not None:
            must_hold = f"<= {limit:g}"
        cells.append(f"{_percentile_68(values):>8} {must_hold:<7}")
    cells.append(f"{_percent(f.error is not None for f in figures):>9}")
    cells.append(f"{_percent(_is_inside(f) for f in figures):>9}")
    widths = [100 * f.half_width for f in figures if f.half_width is not None]
    cells.append(f"{np.median(widths):>8.1f}" if widths else f"{'-':>8}")
    return "".join(cells)


def format_points_line(title: str, figures: Sequence[ObjectFigures]) -> str:
    """Return one line of the table of points, with medians over the objects of the 68th percentiles over their points.

    `in 95 %`: mean share of an object's points whose own regions hold the truth.
    """
    seen_objects = [f for f in figures if f.points]
    cells = [f"{title:<26}{sum(f.points for f in seen_objects):>5}"]
    columns = (
        ([f.normal_68_deg for f in seen_objects], [f.normals_inside for f in seen_objects]),
        ([f.point_68_mm for f in seen_objects], [f.places_inside for f in seen_objects]),
        ([_in_percent(f.point_error_68) for f in seen_objects], [f.points_inside for f in seen_objects]),
    )
    for values, inside in columns:
        numbers = [value for value in values if value is not None]
        usual = f"{np.median(numbers):.2f}" if numbers else "-"
        cells.append(f"{usual:>12}{_percent(inside):>9}")
    return "".join(cells)


def print_tables(figures: Sequence[ObjectFigures]) -> None:
    """Print the tables of objects and of points, by disturbance and kind."""
    disturbances = [name for name in DISTURBANCES if any(f.disturbance == name for f in figures)]
    kinds = [kind for kind in worlds.KINDS if any(f.kind == kind for f in figures)]
    print(OBJECTS_HEAD)
    for name in disturbances:
        for kind in kinds:
            chosen = [f for f in figures if (f.kind, f.disturbance) == (kind, name)]
            if chosen:
                print(format_line(f"{kind}, {name}", chosen, MUST_HOLD.get(kind)))
        print(format_line(f"together, {name}", [f for f in figures if f.disturbance == name]))
    print()
    print(POINTS_HEAD)
    for name in disturbances:
        for kind in kinds:
            chosen = [f for f in figures if (f.kind, f.disturbance) == (kind, name)]
            if chosen:
                print(format_points_line(f"{kind}, {name}", chosen))
        print(format_points_line(f"together, {name}", [f for f in figures if f.disturbance == name]))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("--objects", type=int, default=1, help="objects of each kind and disturbance")
    parser.add_argument("--first", type=int, default=100, help="seed of the first object")
    parser.add_argument("--kinds", default=",".join(worlds.KINDS), help="separated by commas")
    parser.add_argument("--disturbances", default="none", help=f"of: {', '.join(DISTURBANCES)}")
    parser.add_argument("--columns", type=int, default=350, help="stage positions in x, 2 mm apart")
    parser.add_argument("--rows", type=int, default=200, help="stage positions in y")
    parser.add_argument("--quick", action="store_true", help="every other position and one RX a board, with less noise")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--campaign", type=Path, default=None, help="file of judged objects: run on where it ends")
    parser.add_argument("--json", type=Path, default=None, help="write the figures of each object there")


def load_campaign(path: Path | None) -> list[ObjectFigures]:
    """Return the objects that a campaign has judged so far."""
    if path is None or not path.exists():
        return []
    return [ObjectFigures(**json.loads(line)) for line in path.read_text(encoding="utf-8").splitlines()]


def run(args: argparse.Namespace) -> int:
    """Judge drawn objects of each kind; print the tables. Return 0."""
    seeds = range(args.first, args.first + args.objects)
    kinds = args.kinds.split(",")
    disturbances = args.disturbances.split(",")
    scan = ScanKind(args.columns, args.rows, args.quick)
    figures = load_campaign(args.campaign)
    judged_before = {(f.kind, f.seed, f.disturbance) for f in figures}
    jobs = []
    for name in disturbances:
        for seed in seeds:
            jobs += [(kind, seed, name, scan) for kind in kinds if (kind, seed, name) not in judged_before]
    with ProcessPoolExecutor(args.jobs) as pool:
        # Each job is a tuple of arguments.
        for judged in pool.map(judge_object, *zip(*jobs, strict=True)):
            figures.append(judged)
            if args.campaign is not None:
                with args.campaign.open("a", encoding="utf-8") as campaign:
                    campaign.write(json.dumps(asdict(judged)) + "\n")
            if judged.error is None:
                statement = "no permittivity"
            else:
                statement = f"permittivity within {100 * judged.error:.1f} %"
            print(
                f"{judged.kind} {judged.seed}, {judged.disturbance}: {judged.points} points, {statement}",
                file=sys.stderr,
            )
    print(__doc__)
    print_tables(figures)
    if figures:
        print(f"seconds of CPU, analysis of the points: {np.median([f.seconds for f in figures]):.0f} an object")
    if args.json is not None:
        args.json.write_text(json.dumps([asdict(f) for f in figures], indent=1), encoding="utf-8")
    return 0
