"""Do the error bars hold? Simulated scenes with drawn nuisances, judged by the program; coverage of its regions.

Scenes are random: materials with their specimens' spread, leakage of any phase, the plane's distance and tilt,
each plate's tilt, height and roughness, a weak or strong direct path, metal in the scene or scanned on its own. Most
scenes start from samples as perfect synchronisation leaves them (`synced_cube`), some from raw data. All is simulated,
by simulators that share nothing with the host's optics; for a real rig the figures are an expectation.
"""

import argparse
import itertools
import json
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from polysight.data import find_packaged
from polysight.imaging import PlaneEstimate
from polysight.materials import UNKNOWN, match_truth, read_true_plates
from polysight.pipeline import Pipeline
from polysight.polarimetry import PlaneReference, plane_reference
from polysight.process import NO_INPUTS, Findings, Inputs
from polysight.results import Recording
from polysight.settings import Settings
from polysight.store import CubeRow, open_source
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.raster import RasterPlan, plan_raster
from polysight_simulators.scene import decode_scene, synced_cube
from polysight_simulators.scene.scene_file import Scene, apply_scene
from polysight_simulators.scene.simulated_scan import simulate, truth

# Materials of most scenes: real part and loss (eps' and eps''), eight of them of the POLySIGHT paper's Table 2.
MATERIALS: dict[str, tuple[float, float]] = {
    "wood": (2.61, 0.01),
    "PTFE": (2.05, 0.005),
    "PET": (3.78, 0.7),
    "acrylic": (4.0, 0.4),
    "cardboard": (4.54, 0.56),
    "glass fibre": (4.69, 0.7),
    "rubber": (5.06, 1.11),
    "silicone": (3.52, 0.82),
    "ceramic": (4.75, 2.43),
    "liquid behind glass": (3.66, 0.43),
    "glass": (6.3, 0.2),
    "marble": (7.5, 0.25),
}
KNOWN: dict[str, tuple[float, float]] = {
    "rubber": (5.06, 1.11),
    "cardboard (rough)": (4.54, 0.56),
    "silicone rubber": (3.52, 0.82),
    "PET (0.5 mm)": (3.78, 0.7),
    "ceramic": (4.75, 2.43),
    "acrylic (3 mm)": (4.0, 0.4),
    "glass fiber": (4.69, 0.7),
    "wood (thin, smooth)": (2.61, 0.01),
}
"""Materials of the simulated library, as above: named scenes hold these, all specimens alike."""
CLASSES = {"low loss": 0.05, "medium": 0.18, "lossy": np.inf}
"""Material classes by their loss tangent's upper end."""
GRID = {"columns": 45, "rows": 43, "step_x_mm": 10.0, "step_y_mm": 6.0}
# Centres of the six plates, mm.
PLACES = [(x, y) for y in (-34.0, 34.0) for x in (-66.0, 0.0, 66.0)]
KINDS = ("full", "no metal", "no direct path", "noise", "empty", "named", "sheet", "wide")
"""Kinds of scenes. "full": six plates, one of them metal or metal scanned on its own. "no metal": plates without any
metal. "no direct path": without the path from TX to RX that synchronisation needs; "noise": the same without plates.
"empty": nothing there. "named": plates of `KNOWN`. "sheet" is "full" with one thin sheet in air that is not declared,
"wide" is "full" with permittivities and apertures drawn from the ranges below."""
# Kinds with a metal reference and plates that can be judged, and kinds that must give no result.
WHOLE = ("full", "sheet", "wide")
NOTHING = ("no metal", "no direct path", "noise", "empty")
# Of "wide" scenes: ranges of the real part and of the loss tangent; chosen.
WIDE_REAL = (2.0, 12.0)
WIDE_LOSS_TANGENT = (0.003, 0.4)
# Columns and rows; the image is not changed, so that the outer plates lie beyond the smallest aperture.
WIDE_APERTURES = ((45, 43), (33, 31), (25, 25))
# Limits of the bins of a name's probability, the upper ones outside: the last bin holds 1. Chosen.
SURE = (0.0, 0.5, 0.8, 0.95, 1.01)
# Squared distances within which a normal distribution in two dimensions holds 68 and 95 %.
CHI2_68 = 2.279
CHI2_95 = 5.991
# Standard deviations on both sides of a normal distribution's mean that hold 95 %.
Z_95 = 1.960


@dataclass(frozen=True)
class PatchFigures:
    """One judged patch."""

    # Seed of its scene.
    scene: int
    # The true material, and its class of `CLASSES`.
    material: str
    kind: str
    # Squared distance of the true permittivity from the estimate, in units of the estimate's covariance.
    distance2: float
    # Magnitude of the complex error, and stated standard error (rms of both parts: with equal ones the median magnitude
    # is 1.18 times it); both over the true permittivity's magnitude.
    relative_error: float
    relative_std: float
    leakage_measured: bool
    # False: the metal was scanned on its own.
    metal_in_scene: bool
    # Level of the scan's verdict.
    level: str
    # Real part of the true permittivity.
    permittivity_real: float
    # Error of each part over its standard error, and over the half width of the interval that holds 68 %.
    real_pull: float
    loss_pull: float
    real_pull_68: float
    loss_pull_68: float
    # Columns of the scene's grid, which determine its aperture.
    columns: int
    # True for a thin sheet that was not declared.
    sheet: bool = False


class Cubes:
    """A scene as a source of rows that were synchronised already, in memory, for `Pipeline`.

    `seed` draws gains and noise; None: the scene's own.
    """

    mirrored = False
    synchronised = True
    manifest_faults = ()
    simulated = True

    def __init__(self, rig: Instrument, scene: Scene, seed: int | None = None) -> None:
        self.instrument: Instrument = apply_scene(rig, scene)
        self.plan: RasterPlan = plan_raster(self.instrument.grid)
        self.scan_id = scene.name
        self._cubes = {b.name: synced_cube(rig, scene, b.name, seed=seed) for b in self.instrument.receivers}

    def rows(self) -> Iterator[int]:
        """Return all rows of the plan."""
        yield from range(self.plan.rows)

    def read_row(self, board_name: str, row: int) -> CubeRow:
        """Return one row, positions in the order of the stage."""
        cube = self._cubes[board_name][:, row]
        return CubeRow(np.ascontiguousarray(cube[:, :: self.plan.row(row).direction]))

    def recording_facts(self) -> dict[str, Any]:
        """Return the facts of the recording: none are known."""
        return {"recording": Recording()}


def draw_scene(seed: int, kind: str = "full") -> Scene:
    """Draw a scene of six plates, or another of `KINDS`, with every nuisance at random; the ranges are chosen."""
    # The first number keeps these scenes apart from others' draws with the same seed.
    rng = np.random.default_rng([20261122, seed, KINDS.index(kind)])
    leak = [complex(0.1 * rng.random() * np.exp(2j * np.pi * rng.random())) for _ in range(2)]
    materials = MATERIALS
    grid = GRID
    if kind == "named":
        materials = KNOWN
    elif kind == "wide":
        materials = _draw_materials(rng)
        columns, rows = WIDE_APERTURES[int(rng.integers(len(WIDE_APERTURES)))]
        grid = GRID | {"columns": columns, "rows": rows}
    names = rng.choice(list(materials), len(PLACES), replace=False).tolist()
    if kind == "no metal" or (kind in WHOLE and rng.random() < 0.25):
        metal = None
    else:
        metal = int(rng.integers(len(PLACES)))
    # Either each plate is tilted, or the plane with all of them.
    plates_tilted = rng.random() < 0.5
    plates = []
    for i, (x, y) in enumerate(PLACES):
        place = {"centre_mm": [x + rng.uniform(-3, 3), y + rng.uniform(-3, 3)], "size_mm": [46.0, 46.0]}
        relief = {"height_mm": rng.uniform(-0.5, 0.5), "tilt_deg": (rng.uniform(-1, 1, 2) * plates_tilted).tolist()}
        if i == metal:
            material = {"name": "metal", "metal": True}
        else:
            material = {"name": names[i], "permittivity": list(materials[names[i]]), "rough_mm": rng.uniform(0, 0.2)}
        plates.append({**place, **relief, **material})
    if kind == "no metal":
        plates = plates[: int(rng.integers(1, len(PLACES) + 1))]
    # Standard error with which a calibration has measured the leakage; None: it is not measured.
    measured = None
    if rng.random() < 0.5:
        measured = 0.003
    # Relative standard deviations of the real part and the loss.
    specimen_spread = [0.03, 0.3]
    if kind == "named":
        specimen_spread = [0.0, 0.0]
    if kind == "sheet":
        sheet = int(rng.choice([i for i in range(len(plates)) if i != metal]))
        plates[sheet] |= {"thickness_mm": rng.uniform(0.5, 5)}
    return decode_scene(
        {
            "name": f"drawn {kind} {seed}",
            "seed": 1000 + seed,
            "grid": grid,
            "object_distance_mm": 499.0,
            # 232 mm by 180 mm: all plates, and a margin.
            "image": {"columns": 116, "rows": 90},
            "specimen_spread": specimen_spread,
            "plane_shift_mm": rng.uniform(-10, 10),
            "plane_tilt_deg": (rng.uniform(-1, 1, 2) * (not plates_tilted)).tolist(),
            "plates": [] if kind in ("empty", "noise") else plates,
            "disturbances": {
                "leakage_h": [leak[0].real, leak[0].imag],
                "leakage_v": [leak[1].real, leak[1].imag],
                "direct_loss_db": "absent" if kind in ("no direct path", "noise") else rng.uniform(-6, 12),
            }
            | ({} if measured is None else {"leakage_measured": measured}),
        },
        "drawn",
    )


def _draw_materials(rng: np.random.Generator) -> dict[str, tuple[float, float]]:
    """Draw a material for each place: real part uniform, loss tangent uniform in its logarithm."""
    least_tangent, largest_tangent = np.log(WIDE_LOSS_TANGENT).tolist()
    real = rng.uniform(*WIDE_REAL, size=len(PLACES))
    tangent = np.exp(rng.uniform(least_tangent, largest_tangent, size=len(PLACES)))
    return {f"drawn {i}": (float(real[i]), float(real[i] * tangent[i])) for i in range(len(PLACES))}


def lay_metal_plate(scene: Scene) -> Scene:
    """Return the scene with a metal plate on the rig file's plane instead of all else: the same leakage and gains."""
    # It fills the image of 232 mm by 180 mm, and ends far from it.
    plate = {"name": "plate", "centre_mm": [0.0, 0.0], "size_mm": [420.0, 340.0], "metal": True}
    plates = decode_scene({"name": "plate", "plates": [plate]}, "plate").plates
    return msgspec.structs.replace(scene, plates=plates, plane_shift_mm=0.0, plane_tilt_deg=(0.0, 0.0))


def metal_scan(rig: Instrument, scene: Scene) -> PlaneReference:
    """Simulate a metal plate alone with the scene's rig."""
    pipeline = image_scan(Cubes(rig, lay_metal_plate(scene)), Settings(model="none"))
    images = pipeline.form_images()
    reference = plane_reference(images.level(images.valid))
    # A reference is refused for a scan with other settings or calibration files than its own.
    return replace(reference, made_with=pipeline.calibration.describe_imaging(pipeline.rig))


def image_scan(source: Any, settings: Settings, inputs: Inputs = NO_INPUTS) -> Pipeline:
    """Return a pipeline with all rows of a source."""
    pipeline = Pipeline(source, settings, inputs)
    for row in source.rows():
        pipeline.add_row(row)
    return pipeline


def judge_scan(seed: int, kind: str = "full", raw: bool = False) -> tuple[Scene, Instrument, Findings, PlaneEstimate]:
    """Draw, simulate and judge one scene; return it, its rig, the findings and the estimated plane.

    `raw`: from raw data instead of synchronised samples.
    """
    rig = load_instrument(find_packaged(Path("instrument.toml")))
    scene = draw_scene(seed, kind)
    # "none" names nothing, None is the default classifier.
    settings = Settings(model=None if kind == "named" else "none")
    inputs = NO_INPUTS
    if kind in WHOLE and not any(p.metal for p in scene.plates):
        inputs = Inputs(reference=metal_scan(rig, scene))
    if raw or kind in ("no direct path", "noise"):
        with tempfile.TemporaryDirectory(prefix="polysight-coverage-") as folder:
            simulate(rig, scene, Path(folder) / "scan")
            pipeline = image_scan(open_source(Path(folder) / "scan", None), settings, inputs)
            findings = pipeline.examine(pipeline.form_images())
    else:
        pipeline = image_scan(Cubes(rig, scene), settings, inputs)
        findings = pipeline.examine(pipeline.form_images())
    return scene, apply_scene(rig, scene), findings, pipeline.plane


def figures(seed: int, kind: str = "full", raw: bool = False) -> list[PatchFigures]:
    """Return the judged patches of one scene: the sample from which coverage is counted; arguments of `judge_scan`."""
    scene, rig, findings, _ = judge_scan(seed, kind, raw)
    plates = read_true_plates(truth(rig, scene, scene.seed))
    result = findings.analysis
    true = match_truth([r.patch for r in result.patches], plates)
    out = []
    for r in result.patches:
        e = r.permittivity
        plate = true.get(r.patch.label)
        if plate is None or plate.permittivity is None or r.refused:
            continue
        if e.value is None or e.covariance is None or e.half_widths_68 is None:
            continue
        difference = np.array([(e.value - plate.permittivity).real, (e.value - plate.permittivity).imag])
        size = abs(plate.permittivity)
        tangent = -plate.permittivity.imag / plate.permittivity.real
        values = np.linalg.eigvalsh(e.covariance)
        out.append(
            PatchFigures(
                scene=seed,
                material=plate.name,
                kind=next(k for k, top in CLASSES.items() if tangent <= top),
                distance2=float(difference @ np.linalg.solve(e.covariance, difference)),
                relative_error=float(np.hypot(*difference)) / size,
                relative_std=float(np.sqrt(values.mean())) / size,
                leakage_measured=result.prior.leakage_measured,
                metal_in_scene=any(p.metal for p in scene.plates),
                level=findings.verdict.level,
                permittivity_real=plate.permittivity.real,
                real_pull=float(difference[0] / np.sqrt(e.covariance[0, 0])),
                loss_pull=float(difference[1] / np.sqrt(e.covariance[1, 1])),
                real_pull_68=float(difference[0] / e.half_widths_68[0]),
                loss_pull_68=float(difference[1] / e.half_widths_68[1]),
                columns=scene.grid["columns"],
                sheet=plate.thickness_mm is not None,
            )
        )
    return out


def _print_coverage(rows: list[PatchFigures], title: str) -> dict[str, float]:
    """Print and return how many regions hold the truth, rms z and errors; {} without patches."""
    d = np.array([r.distance2 for r in rows])
    if d.size == 0:
        return {}
    entry = {
        "patches": float(d.size),
        "in_68": float(np.mean(d < CHI2_68)),
        "in_95": float(np.mean(d < CHI2_95)),
        "rms_z": float(np.sqrt(np.mean(d) / 2)),
        "median_error": float(np.median([r.relative_error for r in rows])),
        "median_std": float(np.median([r.relative_std for r in rows])),
    }
    print(
        f"{title:36s} {d.size:5d} patches   68 %: {100 * entry['in_68']:5.1f}   95 %: {100 * entry['in_95']:5.1f}"
        f"   rms z {entry['rms_z']:.2f}   median error {100 * entry['median_error']:.1f} %,"
        f" stated {100 * entry['median_std']:.1f} %",
        flush=True,
    )
    return entry


def _pull_table(rows: list[PatchFigures], title: str) -> dict[str, float]:
    """Print and return the coverage of real part and loss: 68 % by its own interval, 95 % by its standard error."""
    entry = {"patches": float(len(rows))}
    text = f"{title:36s} {len(rows):5d} patches"
    for part in ("real", "loss"):
        pulls = np.array([getattr(r, f"{part}_pull") for r in rows])
        if pulls.size == 0:
            return {}
        entry[f"{part}_in_68"] = float(np.mean([abs(getattr(r, f"{part}_pull_68")) < 1 for r in rows]))
        entry[f"{part}_in_95"] = float(np.mean(np.abs(pulls) < Z_95))
        entry[f"{part}_rms_pull"] = float(np.sqrt(np.mean(pulls**2)))
        text += (
            f"   {part}: 68 %: {100 * entry[f'{part}_in_68']:.1f}, 95 %: {100 * entry[f'{part}_in_95']:.1f},"
            f" rms {entry[f'{part}_rms_pull']:.2f}"
        )
    print(text, flush=True)
    return entry


def print_pulls(rows: list[PatchFigures]) -> dict[str, Any]:
    """Print and return the coverage of both parts over all patches, by aperture, real part and leakage."""
    out: dict[str, Any] = {"wide": _pull_table(rows, "real part 2..12, all apertures")}
    for columns, grid_rows in WIDE_APERTURES:
        title = f"  aperture {columns} x {grid_rows}"
        out[title.strip()] = _pull_table([r for r in rows if r.columns == columns], title)
    for low, high in itertools.pairwise((0.0, 4.0, 8.0, np.inf)):
        title = f"  real part {low:.0f} to {high:.0f}"
        out[title.strip()] = _pull_table([r for r in rows if low <= r.permittivity_real < high], title)
    for measured, title in ((True, "  wide, leakage measured"), (False, "  wide, leakage not measured")):
        out[title.strip()] = _pull_table([r for r in rows if r.leakage_measured == measured], title)
    return out


def _read_names(seed: int) -> list[tuple[float, bool]]:
    """Return the probability of each name of one scene of kind "named", and whether the name is right."""
    scene, rig, findings, _ = judge_scan(seed, "named")
    plates = read_true_plates(truth(rig, scene, scene.seed))
    result = findings.analysis
    true = match_truth([r.patch for r in result.patches], plates)
    named = [(r.patch_name, true[r.patch.label]) for r in result.patches if r.patch.label in true]
    return [(v.confidence, v.name == plate.name) for v, plate in named if v is not None and v.name != UNKNOWN]


def _print_reliability(pairs: list[tuple[float, bool]]) -> list[dict[str, float]]:
    """Print how often names are correct for each bin of their probability; return the same."""
    out = []
    for low, high in itertools.pairwise(SURE):
        inside = [(p, right) for p, right in pairs if low <= p < high]
        if inside:
            said, right = (float(np.mean(x)) for x in zip(*inside, strict=True))
            out.append({"names": len(inside), "probability": said, "right": right})
            print(
                f"  probability {100 * low:3.0f}..{min(100 * high, 100):3.0f} %: {len(inside):4d} names, said"
                f" {100 * said:.0f} %, right {100 * right:.0f} %"
            )
    return out


class WithoutResult(NamedTuple):
    """One scene that must give no result."""

    kind: str
    seed: int
    # Level of the verdict.
    level: str
    # Number of patches with a name or permittivity.
    said: int
    # The verdict's first reason.
    reason: str


def _judge_without_result(seed: int, kind: str) -> WithoutResult:
    """Judge a scene that must give no result."""
    _, _, findings, _ = judge_scan(seed, kind)
    rows = findings.analysis.rows()
    said = sum(r.name is not None or r.permittivity is not None for r in rows)
    reason = ""
    if findings.verdict.reasons:
        reason = findings.verdict.reasons[0].what
    return WithoutResult(kind, seed, findings.verdict.level, said, reason)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("--scenes", type=int, default=40, help="full scenes, from samples (default: 40)")
    parser.add_argument("--raw", type=int, default=4, help="full scenes from raw data (default: 4)")
    parser.add_argument("--without", type=int, default=20, help="scenes that hold nothing to name (default: 20)")
    parser.add_argument("--sheets", type=int, default=8, help="full scenes with a thin sheet undeclared (default: 8)")
    parser.add_argument("--named", type=int, default=12, help="scenes of the library's materials (default: 12)")
    parser.add_argument(
        "--wide", type=int, default=8, help="scenes of real parts 2 to 12, small apertures (default: 8)"
    )
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (default: 0)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default: 2)")
    parser.add_argument("--json", type=Path, default=None, help="write every patch here")


def run(args: argparse.Namespace) -> int:
    """Print the tables; return 1 if a scene without anything to name got a name or a permittivity."""
    seeds = range(args.first, args.first + args.scenes)
    nothing_kinds = [NOTHING[i % len(NOTHING)] for i in range(args.without)]
    print("simulated scenes; regions of the permittivity (real and imaginary part together)")
    flatten = itertools.chain.from_iterable
    with ProcessPoolExecutor(args.jobs) as pool:
        rows = [*flatten(pool.map(figures, seeds))]
        raw = [*flatten(pool.map(partial(figures, raw=True), range(args.first, args.first + args.raw)))]
        thin = [*flatten(pool.map(partial(figures, kind="sheet"), range(args.first, args.first + args.sheets)))]
        wide = [*flatten(pool.map(partial(figures, kind="wide"), range(args.first, args.first + args.wide)))]
        without = list(pool.map(_judge_without_result, itertools.count(args.first), nothing_kinds))
        named = [*flatten(pool.map(_read_names, range(args.first, args.first + args.named)))]
    out: dict[str, Any] = {"all": _print_coverage(rows, "all, from samples")}
    out["raw"] = _print_coverage(raw, "all, from raw data")
    for name in CLASSES:
        out[name] = _print_coverage([r for r in rows if r.kind == name], f"  {name}")
    for measured, title in ((True, "  leakage measured"), (False, "  leakage not measured")):
        out[title.strip()] = _print_coverage([r for r in rows if r.leakage_measured == measured], title)
    for inside, title in ((True, "  metal in the scene"), (False, "  metal scanned on its own")):
        out[title.strip()] = _print_coverage([r for r in rows if r.metal_in_scene == inside], title)
    out["beside a sheet"] = _print_coverage([r for r in thin if not r.sheet], "  beside a thin sheet, undeclared")
    out["sheet"] = _print_coverage([r for r in thin if r.sheet], "  the sheet itself, as a half space")
    print(f"  sheets: {args.sheets}; without a permittivity {args.sheets - sum(r.sheet for r in thin)}")
    out["pulls"] = print_pulls(wide)
    same = {(r.scene, r.material): r for r in rows}
    differences = [
        abs(r.relative_error - same[r.scene, r.material].relative_error) for r in raw if (r.scene, r.material) in same
    ]
    if differences:
        median_percent = 100 * float(np.median(differences))
        print(f"raw beside samples: errors of the same patches differ by {median_percent:.2f} % (median)")
    # A verdict that allows names is printed too, but only a name or a permittivity fails.
    said = [scene for scene in without if scene.said or scene.level != "none"]
    print(f"scenes with nothing to name: {len(without)}; given a name or permittivity: {len(said)}")
    for scene in said:
        print("   ", tuple(scene))
    print(f"names of the library's materials, {args.named} scenes with every nuisance but other specimens")
    reliability = _print_reliability(named)
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        content = {
            "summary": out,
            "names": reliability,
            "patches": [asdict(r) for r in rows + raw + thin + wide],
            "without": without,
        }
        args.json.write_text(json.dumps(content, indent=1) + "\n")
    return int(any(scene.said for scene in said))
