"""Layers of unknown thickness: are permittivity and thickness right, reported ambiguous, or wrong without a warning?

A scene holds five random sheets and a liquid: sheets in air and sheets on metal of 0.5 to 5 mm, permittivity 2
to 7, loss tangent up to 0.1; liquids behind a wall of glass of known thickness. Each scene has its own plane distance,
heights and roughness. Each rig (five scenes) has its own leakage, measured to 0.003, and one scan of a metal plate on
its own, because a scene without half spaces does not show which of its plates is metal. Samples are as perfect
synchronisation leaves them (`synced_cube`). The program images a scene in sub-bands and fits each stack, the thickness
of sheets free in a stated range. All is simulated, by simulators that share nothing with the host's optics; what it
says of a real rig is an expectation.
"""

import argparse
import itertools
import json
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.coverage import CHI2_68, CHI2_95, GRID, PLACES, Cubes, image_scan, lay_metal_plate
from polysight.data import find_packaged
from polysight.jobs.process import make_plane_reference
from polysight.materials import METAL_PERMITTIVITY, Layer, LayerFit, fit_row, match_truth, read_true_plates
from polysight.polarimetry import PlaneReference
from polysight.process import Inputs
from polysight.results import PatchFigures
from polysight.settings import Settings
from polysight_shared.config import Instrument, load_instrument
from polysight_simulators.scene import decode_scene
from polysight_simulators.scene.scene_file import Plate, Scene, apply_scene
from polysight_simulators.scene.simulated_scan import truth

RANGE_M = (0.3e-3, 6e-3)
"""Where the thickness of a sheet is looked for; chosen."""
# Sub-bands of the sweep, in which a scene is imaged; chosen.
BANDS = 4
IN_BANDS = Settings(model="none", bands=BANDS)
SCENES_PER_RIG = 5
# Side of the plates (chosen).
SIDE_MM = 46.0
# Permittivity eps', eps'' of the wall in front of a liquid (chosen).
GLASS = (5.5, 0.05)
CONDUCTOR = (1.0, 1e9)
"""Permittivity of metal behind a sheet: of a good conductor, reflects -1 to one part in 1e4."""
IN_AIR = "sheet in air"
ON_METAL = "sheet on metal"
LIQUID = "liquid behind a wall"
KINDS = (IN_AIR, ON_METAL, LIQUID)
# Relative error up to which a result counts as right; chosen.
ENOUGH = 0.05
Setting = tuple[float, float | None]
"""Trust in |H| and reach of the thickness's range, see `SETTINGS`."""
SETTINGS: tuple[Setting, ...] = ((0.1, None), (0.04, None), (0.1, 0.2))
"""Relative error to which |H| is trusted (0.1: the command's default; 0.04: for flat, smooth plates), and the reach of
the thickness's range on either side of the truth, as a share (None: `RANGE_M`)."""


@dataclass(frozen=True)
class Case:
    """One stack and what was fitted to it, by one of `SETTINGS`. Permittivities are (eps', eps'')."""

    # Seed of its scene.
    scene: int
    # One of `KINDS`.
    kind: str
    setting: Setting
    # The truth of the layer in question; a liquid's thickness is 0.
    permittivity: tuple[float, float]
    thickness_mm: float
    # The fit; None if the plate was not found or not fitted.
    fitted: tuple[float, float] | None = None
    # Relative errors of permittivity and thickness.
    error: float = float("nan")
    thickness_error: float = 0.0
    # Squared distance of the true permittivity from the fit, in units of the fit's covariance.
    distance2: float = float("nan")
    # Stated relative standard error.
    relative_std: float = float("nan")
    # True if the program says that other values fit as well; number of such values.
    ambiguous: bool = True
    rivals: int = 0
    # Misfit, chi-square per degree of freedom.
    chi2: float = float("nan")
    # True if the program warns that the stack does not explain the data.
    unexplained: bool = False

    @property
    def right(self) -> bool:
        """True if permittivity and thickness are within 5 % of the truth."""
        return self.error < ENOUGH and self.thickness_error < ENOUGH

    @property
    def is_flagged(self) -> bool:
        """True if the program reports that the error may exceed 5 %: ambiguous, or an error bar that long."""
        return self.ambiguous or 2 * self.relative_std > ENOUGH


def draw_scene(seed: int) -> Scene:
    """Draw six stacks on the places of a coverage scene; `SCENES_PER_RIG` successive seeds have the same rig."""
    rig_rng = np.random.default_rng([20261123, seed // SCENES_PER_RIG])
    rng = np.random.default_rng([20261124, seed])
    leak = [complex(0.1 * rig_rng.random() * np.exp(2j * np.pi * rig_rng.random())) for _ in range(2)]
    plates: list[dict[str, Any]] = []
    sheets = (IN_AIR, ON_METAL)
    kinds = iter(rng.permutation([*sheets, *sheets, LIQUID, sheets[seed % 2]]).tolist())
    for i, (x, y) in enumerate(PLACES):
        place = {
            "centre_mm": [x + rng.uniform(-3, 3), y + rng.uniform(-3, 3)],
            "size_mm": [SIDE_MM, SIDE_MM],
            "height_mm": rng.uniform(-0.3, 0.3),
            "rough_mm": rng.uniform(0, 0.1),
        }
        kind = next(kinds)
        real = rng.uniform(2, 7)
        sheet = {"permittivity": [real, real * rng.uniform(0, 0.1)], "thickness_mm": rng.uniform(0.5, 5)}
        layers = [sheet]
        if kind == ON_METAL:
            layers = [sheet, {"permittivity": list(CONDUCTOR)}]
        elif kind == LIQUID:
            wall = {"permittivity": list(GLASS), "thickness_mm": rng.uniform(1, 3.5)}
            layers = [wall, {"permittivity": [rng.uniform(3, 15), rng.uniform(2, 20)]}]
        plates.append({**place, "name": f"{kind} {i}", "layers": layers})
    return decode_scene(
        {
            "name": f"layers {seed}",
            "seed": 2000 + seed,
            "grid": GRID,
            # That of the packaged rig file, and an image that holds all plates.
            "object_distance_mm": 499.0,
            "image": {"columns": 116, "rows": 90},
            "plane_shift_mm": rng.uniform(-5, 5),
            "plates": plates,
            "disturbances": {
                "leakage_h": [leak[0].real, leak[0].imag],
                "leakage_v": [leak[1].real, leak[1].imag],
                "leakage_measured": 0.003,
                "direct_loss_db": rig_rng.uniform(-6, 12),
            },
        },
        "drawn",
    )


def metal_scan(rig: Instrument, scene: Scene) -> PlaneReference:
    """Simulate a metal plate over the rig file's plane with the same rig, in the same sub-bands."""
    pipeline = image_scan(Cubes(rig, lay_metal_plate(scene)), IN_BANDS)
    parts = tuple(make_plane_reference(pipeline, part) for part in pipeline.sub_bands.finish(pipeline.source.mirrored))
    return replace(make_plane_reference(pipeline, pipeline.form_images()), bands=parts)


def process_scene(
    seed: int, rig: Instrument, scene: Scene, metal: PlaneReference
) -> tuple[dict[str, PatchFigures], float]:
    """Simulate and process one scene; return each found plate's row of materials.json, and the incidence angle's error.

    Rows are by the plate's name; the error is a standard deviation, radians.
    """
    pipeline = image_scan(Cubes(rig, scene), IN_BANDS, Inputs(reference=metal))
    findings = pipeline.examine(pipeline.form_images())
    result = findings.analysis
    plates = match_truth(
        [r.patch for r in result.patches], read_true_plates(truth(apply_scene(rig, scene), scene, seed))
    )
    rows = {plates[row.label].name: row for row in result.rows() if row.label in plates}
    return rows, result.prior.theta_std_rad


def given_stack(plate: Plate, within: float | None = None) -> list[Layer]:
    """Return the stack as a user would give it, the thickness of a sheet free or within a share of the truth."""
    if plate.name.startswith(LIQUID):
        wall = plate.layers[0]
        return [Layer("glass", wall.epsilon, (wall.thickness_mm or 0.0) / 1e3), Layer("liquid")]
    behind = []
    if plate.name.startswith(ON_METAL):
        behind = [Layer("metal", METAL_PERMITTIVITY)]
    size = (plate.layers[0].thickness_mm or 0.0) / 1e3
    limits = RANGE_M
    if within is not None:
        limits = ((1 - within) * size, (1 + within) * size)
    return [Layer("sheet", thickness_range_m=limits), *behind]


def judge_fit(seed: int, plate: Plate, fit: LayerFit | None, setting: Setting) -> Case:
    """Compare the fit of one plate with its truth."""
    kind = next(k for k in KINDS if plate.name.startswith(k))
    if kind == LIQUID:
        layer = plate.layers[1]
    else:
        layer = plate.layers[0]
    true = layer.permittivity
    size_mm = layer.thickness_mm or 0.0
    if fit is None or fit.covariance is None:
        return Case(seed, kind, setting, true, size_mm)
    # In the order of the fit's covariance: eps', eps'' (and the thickness, left out here).
    difference = np.array([fit.permittivity.real - true[0], -fit.permittivity.imag - true[1]])
    found_mm = 1e3 * (fit.thickness_m or 0.0)
    return Case(
        scene=seed,
        kind=kind,
        setting=setting,
        permittivity=true,
        thickness_mm=size_mm,
        fitted=(fit.permittivity.real, -fit.permittivity.imag),
        error=float(np.hypot(*difference) / np.hypot(*true)),
        thickness_error=abs(found_mm / size_mm - 1) if size_mm else 0.0,
        distance2=float(difference @ np.linalg.solve(fit.covariance[:2, :2], difference)),
        relative_std=fit.relative_std,
        ambiguous=fit.ambiguous,
        rivals=len(fit.rivals),
        chi2=fit.chi2 / fit.freedom,
        unexplained=any("does not explain" in w for w in fit.warnings()),
    )


def cases(seeds: Sequence[int]) -> list[Case]:
    """Return all stacks of the scenes of one rig, by each of `SETTINGS`."""
    rig = load_instrument(find_packaged(Path("instrument.toml")))
    out = list[Case]()
    metal = metal_scan(rig, draw_scene(seeds[0]))
    for seed in seeds:
        scene = draw_scene(seed)
        rows, theta_std_rad = process_scene(seed, rig, scene, metal)
        for plate in scene.plates:
            row = rows.get(plate.name)
            for trusted, within in SETTINGS:
                stack = given_stack(plate, within)
                if row is None:
                    fit = None
                else:
                    fit = fit_row(row, rig.chirp, stack, BANDS, trusted, theta_std_rad)
                out.append(judge_fit(seed, plate, fit, (trusted, within)))
    return out


def _mean_or_nan(flags: NDArray[np.bool_]) -> float:
    """Return the share of true flags; NaN without any."""
    if flags.size == 0:
        return float("nan")
    return float(np.mean(flags))


def table(rows: list[Case], title: str) -> dict[str, float]:
    """Print and return how many fits of one kind of stack are right, ambiguous or wrong; {} without fits.

    "cases", "not fitted" and "wrong, not flagged" are counts, the others shares; "ambiguous" is the share
    of flagged fits.
    """
    fits = [r for r in rows if r.fitted is not None]
    unrivalled = np.array([r.distance2 for r in fits if not r.rivals])
    sure = [r for r in fits if not r.is_flagged]
    if not fits:
        return {}
    d = np.array([r.distance2 for r in sure])
    entry = {
        "cases": float(len(rows)),
        "not fitted": float(len(rows) - len(fits)),
        "right": float(np.mean([r.right for r in fits])),
        "ambiguous": float(np.mean([r.is_flagged for r in fits])),
        "rivals": float(np.mean([r.rivals > 0 for r in fits])),
        "wrong, not flagged": float(sum(not r.right for r in sure)),
        "in_68, no rivals": _mean_or_nan(unrivalled < CHI2_68),
        "in_95, no rivals": _mean_or_nan(unrivalled < CHI2_95),
        "in_68": _mean_or_nan(d < CHI2_68),
        "in_95": _mean_or_nan(d < CHI2_95),
        "median_std": float(np.median([r.relative_std for r in fits])),
        "median_error": float(np.median([max(r.error, r.thickness_error) for r in fits])),
        "unexplained": float(np.mean([r.unexplained for r in fits])),
    }
    percent = {key: 100 * entry[key] for key in entry}
    print(
        f"{title:22s} {len(rows):4d} cases, {len(rows) - len(fits)} not fitted   within 5 %: {percent['right']:5.1f} %"
        f"   ambiguous: {percent['ambiguous']:5.1f} % ({percent['rivals']:.1f} % with rivals)   wrong, not flagged:"
        f" {entry['wrong, not flagged']:.0f} of {len(sure)}\n{'':22s} regions without rivals ({unrivalled.size}): 68 %"
        f" {percent['in_68, no rivals']:5.1f}, 95 % {percent['in_95, no rivals']:5.1f}; of those not flagged 68 %"
        f" {percent['in_68']:5.1f}, 95 % {percent['in_95']:5.1f}   median error {percent['median_error']:.1f} %, stated"
        f" {percent['median_std']:.1f} %, not explained {percent['unexplained']:.1f} %",
        flush=True,
    )
    return entry


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        "--cases", type=int, default=240, help="stacks, five sheets and a liquid a scene (default: 240)"
    )
    parser.add_argument("--first", type=int, default=0, help="number of the first scene (default: 0)")
    parser.add_argument("--jobs", type=int, default=2, help="processes (default: 2)")
    parser.add_argument("--json", type=Path, default=None, help="write every case here")


def run(args: argparse.Namespace) -> int:
    """Print the table; return 1 if more than 5 % of the fits that are not flagged are beyond 5 %."""
    scenes = range(args.first, args.first + -(-args.cases // len(PLACES)))
    rigs = [list(group) for _, group in itertools.groupby(scenes, lambda seed: seed // SCENES_PER_RIG)]
    print(f"simulated sheets and liquids, {BANDS} sub-bands")
    with ProcessPoolExecutor(args.jobs) as pool:
        rows = [case for group in pool.map(cases, rigs) for case in group]
    out: dict[str, dict[str, float]] = {}
    for setting in SETTINGS:
        trusted, within = setting
        if within is None:
            near = f"{1e3 * RANGE_M[0]:g} to {1e3 * RANGE_M[1]:g} mm"
        else:
            near = f"+-{100 * within:g} %"
        print(f"|H| trusted to {100 * trusted:g} %, thickness looked for in {near}")
        same = [r for r in rows if r.setting == setting]
        for kind in (*KINDS, "all"):
            out[f"{kind}, {setting}"] = table([r for r in same if kind in (r.kind, "all")], kind)
    if args.json is not None:
        args.json.parent.mkdir(parents=True, exist_ok=True)
        args.json.write_text(json.dumps({"summary": out, "cases": [asdict(r) for r in rows]}, indent=1) + "\n")
    sure = [r for r in rows if not r.is_flagged]
    return int(sum(not r.right for r in sure) > 0.05 * len(sure))
