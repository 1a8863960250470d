"""Are the error bars as narrow as the data allow? Beside a rival that learnt from the nuisances' own generator.

The narrowest honest error bar of a plate follows from all nuisances, marginalised over the prior that they are drawn
from. That bound has no closed form here, so a rival stands for it: it is given the nuisance of each scene, and learns
the error of the plain estimate from other scenes of the same generator. The plain estimate is Eq. 3 of the POLySIGHT
paper (a half space's permittivity by H / V) of a plate's mean H and V relative to copper, the measured leakage removed.
The rival learns by gradient boosted quantiles (scikit-learn) over the means, slopes and scatter of all plates, widened
or narrowed until they hold 95 % in each row. It does not know which materials there are; the program does, but neither
the nuisance nor its size. For each nuisance: median relative half widths of 95 % regions of both, and their ratio. All
is simulated.

The rival is above the bound, by how much is not known: about a slope of 20 times the noise its intervals are three
times too wide (tests/benchmarks/test_widths.py), and errors that only the inversion of a whole scene finds (leakage,
turned boards) it hardly learns. A linear model learnt first, of all rows together, is worse in mild rows.
"""

import argparse
import json
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks.worlds import draw_calibration, draw_pair, judge_world, pixel_boxes
from polysight.polarimetry import permittivity_from_ratio
from polysight_worlds import NUISANCES

Real = npt.NDArray[np.float64]
Complex = npt.NDArray[np.complex128]
Integers = npt.NDArray[np.intp]

ROWS = ("none", *NUISANCES, "all")
# Pixels that are cut off at each edge of a plate; chosen.
EDGE_PX = 2
# Groups of scenes for cross-validation; chosen.
FOLDS = 5


@dataclass(frozen=True)
class SceneData:
    """One scene: number of its row in `ROWS`, and of each plate [plate] what the rival sees and the truth.

    `features` float64 [plate, feature]; `plain`, `true` complex [plate]: the plain estimate and the true permittivity;
    `half_widths` [patch]: relative half widths of the program's regions, of the patches that have one.
    """

    row: int
    features: Real
    plain: Complex
    true: Complex
    half_widths: tuple[float, ...]


def describe_plate(h: Complex, v: Complex) -> tuple[complex, complex, list[float]]:
    """Return the means of H and V over the pixels [ny, nx] of a plate, and its features.

    These are the share of known pixels, slopes and bends (x y, x^2, y^2) of H and V relative to their means, and the
    scatter of magnitude and phase of H, V and V / H; of V / H also the medians.
    """
    known = np.isfinite(h) & np.isfinite(v) & (h != 0) & (v != 0)
    known_count = max(int(known.sum()), 1)
    means = complex(np.sum(h, where=known) / known_count), complex(np.sum(v, where=known) / known_count)
    # From -1 to 1 over the plate.
    y, x = np.meshgrid(*(np.linspace(-1, 1, count) for count in h.shape), indexing="ij")
    features = [float(known.mean())]
    for image, mean in zip((h, v), means, strict=True):
        relative = np.where(known, image / mean, 0)
        for shape in (x, y, x * y, x**2 - 1 / 3, y**2 - 1 / 3):
            part = np.sum(relative * shape) / np.sum(shape**2)
            features += [float(part.real), float(part.imag)]
        features += [float(np.log(np.abs(relative[known])).std()), float(np.angle(relative[known]).std())]
    ratio = v[known] / h[known] * (means[0] / means[1])
    for part in (np.log(np.abs(ratio)), np.angle(ratio)):
        features += [float(np.std(part)), float(np.median(part))]
    return *means, features


def collect_scene(job: tuple[str, int]) -> SceneData | None:
    """Draw one scene; return what the rival sees of it, and the program's half widths; None without copper in it."""
    nuisance, seed = job
    pair = draw_pair(nuisance, seed)
    leakage, theta_error_rad = draw_calibration(nuisance, seed)
    into_h, into_v = leakage or (0j, 0j)
    # Of each: the plate, its means of H and V, its features.
    plates = []
    for plate, (left, bottom, right, top) in pixel_boxes(pair):
        inner = slice(bottom + EDGE_PX, top - EDGE_PX), slice(left + EDGE_PX, right - EDGE_PX)
        plates.append((plate, *describe_plate(pair.h[inner], pair.v[inner])))
    metal = next((entry for entry in plates if entry[0].stack.is_metal), None)
    if metal is None:
        return None
    dielectrics = [entry for entry in plates if not entry[0].stack.is_metal]
    # With the leakage a of V into H and b of H into V, a plate's true V / H = t (1 for metal) is measured, relative to
    # metal, as (t + b) / (1 + a t) * (1 + a) / (1 + b).
    measured = np.array([v / h for _, h, v, _ in dielectrics]) * (metal[1] / metal[2]) * (1 + into_v) / (1 + into_h)
    t = (measured - into_v) / (1 - into_h * measured)
    plain = permittivity_from_ratio(1 / t, np.radians(pair.incidence_deg) + theta_error_rad)
    own = np.array([features for *_, features in dielectrics])
    places = np.array([plate.box_m for plate, *_ in dielectrics]) - np.tile(metal[0].centre_m[:2], 2)
    levels = np.log(np.abs([(h / metal[1], v / metal[2]) for _, h, v, _ in dielectrics]))
    of_scene = np.concatenate(
        [metal[3], np.median(own, axis=0), [plain.imag.mean(), plain.imag.max()], levels.std(axis=0)]
    )
    columns = [plain.real, plain.imag, t.real, t.imag, levels, places, own, np.tile(of_scene, (len(own), 1))]
    row = ROWS.index(nuisance)
    features = np.column_stack([np.full(len(own), row), *columns])
    figures = judge_world(nuisance, seed)
    widths = tuple(patch.half_width for patch in figures.patches if patch.half_width is not None)
    true = np.array([complex(plate.stack.below) for plate, *_ in dielectrics])
    return SceneData(row=row, features=features, plain=plain, true=true, half_widths=widths)


def learn_half_widths(features: Real, deviation: Real, row: Integers, scene: Integers) -> Real:
    """Return half widths [plate] of intervals that hold 95 % of `deviation` [plate] in each row.

    `features` are [plate, feature]; `row` and `scene` [plate] are numbers. A scene's intervals are learnt from scenes
    of other folds. Settings of the regression are chosen.
    """
    # They take a second to load.
    from sklearn.ensemble import HistGradientBoostingRegressor
    from sklearn.model_selection import GroupKFold, cross_val_predict

    ends = []
    for quantile in (0.025, 0.975):
        boosted = HistGradientBoostingRegressor(
            loss="quantile",
            quantile=quantile,
            max_iter=150,
            learning_rate=0.06,
            min_samples_leaf=15,
            l2_regularization=1.0,
        )
        ends.append(cross_val_predict(boosted, features, deviation, groups=scene, cv=GroupKFold(FOLDS)))
    low, high = ends
    half_width = np.maximum(high - low, 1e-4) / 2
    distance = np.abs(deviation - (low + high) / 2) / half_width
    for number in np.unique(row):
        half_width[row == number] *= np.quantile(distance[row == number], 0.95)
    return half_width


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("--scenes", type=int, default=20, help="scenes of each nuisance")
    parser.add_argument("--first", type=int, default=300_000, help="seed of the first scene")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--json", type=Path, default=None, help="write the figures there")


def run(args: argparse.Namespace) -> int:
    """Draw the scenes, let the rival learn, print the table. Return 0."""
    jobs = [(nuisance, seed) for nuisance in ROWS for seed in range(args.first, args.first + args.scenes)]
    with ProcessPoolExecutor(args.jobs) as pool:
        scenes = [scene for scene in pool.map(collect_scene, jobs) if scene is not None]
    features = np.concatenate([scene.features for scene in scenes])
    plain = np.concatenate([scene.plain for scene in scenes])
    true = np.concatenate([scene.true for scene in scenes])
    plate_counts = [scene.true.size for scene in scenes]
    row = np.repeat([scene.row for scene in scenes], plate_counts)
    scene_number = np.repeat(np.arange(len(scenes)), plate_counts)
    deviation = (true - plain) / plain.real
    parts = [learn_half_widths(features, part, row, scene_number) for part in (deviation.real, deviation.imag)]
    # Root mean square of the half widths of both parts, as of ours (`compare_with_plate`); relative to |true|.
    rival = np.hypot(*parts) / np.sqrt(2) * plain.real / np.abs(true)
    figures = {}
    print(f"{len(scenes)} scenes, {true.size} plates; median half widths of 95 % regions")
    print("nuisance       rival %  ours %  ratio")
    for number, nuisance in enumerate(ROWS):
        of_rival = 100 * float(np.median(rival[row == number]))
        ours = 100 * float(np.median(np.concatenate([s.half_widths for s in scenes if s.row == number])))
        figures[nuisance] = {"rival_percent": of_rival, "ours_percent": ours}
        print(f"{nuisance:13s} {of_rival:8.2f} {ours:7.2f} {ours / of_rival:6.2f}")
    if args.json:
        args.json.write_text(json.dumps(figures, indent=1))
    return 0
