"""Do error bars, names and verdicts hold in physics that is not the simulator's? Scenes of the independent generator.

Each scene is one of `polysight_worlds`: vector physical optics, with one nuisance, all together, or none. The copper is
declared, boxes are given or patches are searched for, the library holds Table 2 as half spaces. With `--mixed` plates
that no library has are among them, which names may take for a material of the library. All is simulated, by a generator
that shares no code with the host. For each nuisance: how many 95 % regions hold the true permittivity, rms z of both
parts, the relative half width, the error, and how many names are right; how many verdicts are `good`, how many regions
hold under those, and in how many scenes a reason names the nuisance, among the first two or at all.
"""

import argparse
import itertools
import json
import re
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

import polysight_worlds as generator
from polysight.data import find_packaged
from polysight.imaging import Antennas, Dispersion, Illumination, Images, illumination_geometry
from polysight.materials import (
    DISCRIMINANT_MODEL,
    UNKNOWN,
    Classifier,
    Entry,
    KnownScene,
    Library,
    MaterialsResult,
    Optics,
    analyse,
    axis_mm,
)
from polysight.materials.inversion import LIBRARY_SHARE, MOVED_PROBABILITY, RigPrior
from polysight.materials.kinds import inverse_ratio
from polysight.materials.labels import make_patches_from_labels
from polysight.materials.result import PatchResult
from polysight.materials.segment import Segmentation
from polysight.polarimetry import fresnel
from polysight.process.judge import scene_reasons
from polysight.results import join_reasons
from polysight_shared.config import load_instrument

UNMEASURED = ("leakage", "all")
"""Nuisances of rigs whose leakage was never measured."""
THETA_STD_RAD = 1.5e-3
"""Error of the incidence angle that the analysis counts with, and that a scene is given: 2 mm in the places of the
boards (1.2e-3 by the published rig's geometry), 1 mm in that of the plane (0.9e-3)."""
LEAKAGE_STD = 0.003
"""The same of a measured leakage, of each real and imaginary part."""
# Border of a given box that is not used, because the image blurs edges (chosen).
MARGIN_MM = 6.0
LEAST_PIXELS = 8
"""Least width and height of a plate's part within the picture."""
# Squared distance within which a normal distribution in two dimensions holds 95 %.
CHI2_95 = 5.991
# Number of a verdict's reasons that count as the first ones (chosen).
FIRST_REASONS = 2
FOREIGN: dict[str, complex] = {
    "polycarbonate": 2.77 - 0.018j,
    "PEEK": 3.20 - 0.025j,
    "polyetherimide": 3.05 - 0.013j,
    "PETG": 2.74 - 0.035j,
    "ASA": 2.60 - 0.025j,
    "printer resin": 2.85 - 0.095j,
    "epoxy": 2.95 - 0.075j,
    "HDPE": 2.34 - 0.001j,
    "polystyrene": 2.53 - 0.003j,
    "PTFE": 2.06 - 0.001j,
    "EPDM": 2.60 - 0.06j,
    "natural rubber": 2.40 - 0.03j,
    "cork": 1.45 - 0.05j,
    "leather": 2.60 - 0.25j,
    "felt": 1.35 - 0.03j,
    "oak": 2.30 - 0.22j,
    "pine": 1.80 - 0.12j,
    "MDF": 2.55 - 0.18j,
    "bamboo": 2.20 - 0.20j,
    "granite": 5.50 - 0.15j,
    "slate": 6.40 - 0.25j,
    "sandstone": 4.20 - 0.12j,
    "limestone": 7.50 - 0.08j,
    "porcelain": 5.60 - 0.08j,
    "machinable ceramic": 5.70 - 0.06j,
    "alumina": 9.70 - 0.005j,
    "float glass": 6.60 - 0.22j,
    "mortar": 4.60 - 0.28j,
    "gypsum": 2.85 - 0.09j,
    "glass epoxy G10": 4.50 - 0.10j,
}
"""Common materials, values rounded from open tables near 100 GHz (Lamb, Int. J. Infrared Millim. Waves 17, 1996;
Jepsen, Cooke and Koch, Laser Photonics Rev. 5, 2011; ITU-R P.2040; tables of woods, rocks and solvents in the open
literature)."""
LIQUIDS = {"water": 8.7 - 14.0j, "oil": 2.3 - 0.02j, "alcohol": 3.2 - 1.2j}
"""Liquids in glass dishes, rounded: water at 20 degrees and 78 GHz, and typical values for the others."""
CAUSES = {
    "h_turn": "turned|moved",
    "v_turn": "turned|moved",
    "tx_turn": "turned|moved",
    "misplaced": "out of place",
    "height": "high",
    "tilt": "tilted|rises by",
    "drift": "drift",
    "multipath": "second path",
    "stage_scale": "stage",
    "noise": "noise",
    "interference": "interference",
    "clipping": "clip",
    "roughness": "rough",
    "waviness": "wavy",
    "bow": "bent",
    "brightness": "brighter|darker",
    "leakage": "leakage",
    "border": "border",
    "aperture": "aperture",
    "dark": "masked|without data",
}
"""Nuisance to the words (regular expression) by which a reason names it as found or as a likely cause."""


@dataclass(frozen=True)
class PatchFigures:
    """One judged patch. Figures are None for a refused patch."""

    nuisance: str
    # The true material.
    material: str
    # Squared distance of the true permittivity from the estimate, in units of the estimate's covariance.
    distance2: float | None
    # Relative half width of the 95 % region (mean of both parts), and relative error.
    half_width: float | None
    error: float | None
    # The name that it was given, with its probability, and whether it is one of the library's.
    name: str
    confidence: float
    of_library: bool
    # Why there is no permittivity; "" if there is one.
    refused: str

    @property
    def inside(self) -> bool | None:
        """True if the 95 % region holds the true permittivity; None without one."""
        if self.distance2 is None:
            return None
        return self.distance2 < CHI2_95


@dataclass(frozen=True)
class SceneFigures:
    """One judged scene: the verdict's level and reasons, its patches without the metal, and how they were found.

    `missed` plates were not found, `stray` patches are not plates; both 0 with given boxes.
    """

    nuisance: str
    seed: int
    level: str
    reasons: tuple[str, ...]
    patches: tuple[PatchFigures, ...]
    missed: int = 0
    stray: int = 0

    def place_named(self, nuisance: str) -> int | None:
        """Return the place of the first reason that names a nuisance as a cause, from 0; None without one."""
        cause = CAUSES.get(nuisance)
        if cause is None:
            return None
        return next((i for i, text in enumerate(self.reasons) if re.search(cause, text)), None)


@cache
def table_2_classifier(theta_rad: float) -> Classifier:
    """Return a classifier of Table 2's materials and copper as half spaces at one angle, four pieces each."""
    rng = np.random.default_rng(0)
    entries = []
    for piece in range(4):
        for name, permittivity in {**generator.TABLE_2, "copper": None}.items():
            # V / H and |H| of metal.
            ratio = 1.0 + 0j
            level = 1.0
            if permittivity is not None:
                ratio = complex(inverse_ratio(permittivity, theta_rad))
                level = abs(complex(fresnel(permittivity, theta_rad)[0]))
            # Thirty pixels with some noise, both chosen.
            pixels = ratio * np.exp(0.003 * (rng.standard_normal(30) + 1j * rng.standard_normal(30)))
            entry = Entry(
                name=name,
                scan=f"scan {piece}",
                h=np.full(30, level, np.float32),
                v=(level * abs(pixels)).astype(np.float32),
                p=(1 / pixels).astype(np.complex64),
                incidence_deg=float(np.degrees(theta_rad)),
                simulated=True,
                specimen=f"{name} {piece}",
            )
            entries.append(entry)
    # The library is not judged: that takes longer than a scene, and no name depends on it.
    return Classifier(Library(tuple(entries)), model=DISCRIMINANT_MODEL)


def illumination_of_worlds(shape: tuple[int, int], pixel_m: float) -> Illumination:
    """Return the relation of phase and tilts for the published rig; footprints are unknown, and taken as uniform."""
    rig = load_instrument(find_packaged(Path("instrument.toml")))
    middle_hz = rig.chirp.first_sample_hz + rig.chirp.swept_hz / 2
    plane_m = rig.geometry.object_distance_mm / 1e3
    boards = [illumination_geometry(Antennas.from_rig(rig, board), plane_m, middle_hz) for board in rig.receivers]
    # For a rise of 1: how far the point of the reflection moves, and the growth of the phase.
    moved_m = np.stack([moved_m for moved_m, _ in boards])
    steepness_rad_m = np.array([steepness for _, steepness in boards])
    return Illumination(np.ones((2, *shape), np.complex64), moved_m, steepness_rad_m, (pixel_m, pixel_m))


def dispersion_of_worlds(pair: generator.ImagePair) -> Dispersion:
    """Return the relative change of the images over the sweep, from their slopes over frequency."""
    first_hz, last_hz = pair.rig.frequencies_hz[[0, -1]].tolist()
    with np.errstate(divide="ignore", invalid="ignore"):
        h = (last_hz - first_hz) * pair.h_slope / pair.h
        v = (last_hz - first_hz) * pair.v_slope / pair.v
    return Dispersion(h, v, (first_hz, last_hz))


def pixel_boxes(pair: generator.ImagePair) -> list[tuple[generator.Plate, tuple[int, int, int, int]]]:
    """Return the plates within the picture without the table, and their boxes in pixels: left, bottom, right, top.

    Right and top are the first pixels beyond the plate.
    """
    out = []
    for plate in pair.world.plates:
        x0, y0, x1, y1 = plate.box_m
        left, right = np.searchsorted(pair.x_m, [x0, x1]).tolist()
        bottom, top = np.searchsorted(pair.y_m, [y0, y1]).tolist()
        if plate.name != "table" and min(right - left, top - bottom) >= LEAST_PIXELS:
            out.append((plate, (left, bottom, right, top)))
    return out


def analyse_world(
    pair: generator.ImagePair,
    declared: str | None = "copper",
    leakage: tuple[complex, complex] | None = (0j, 0j),
    classifier: Classifier | None = None,
    searched: bool = False,
    theta_error_rad: float = 0.0,
) -> tuple[MaterialsResult, dict[int, generator.Plate]]:
    """Analyse the images of a world; return the result, and patch number to true plate.

    `declared` is the plate that is given as the metal reference; None: it is looked for. `leakage` is that of p into H
    and of s into V as it was measured; None: it never was. `searched`: patches are searched for instead of given as
    boxes. `theta_error_rad` is the error of the nominal incidence angle.
    """
    h = pair.h.astype(np.complex64)
    v = pair.v.astype(np.complex64)
    usable: npt.NDArray[np.bool_] = np.isfinite(h) & np.isfinite(v) & (h != 0) & (v != 0)
    light = illumination_of_worlds(h.shape, float(pair.x_m[1] - pair.x_m[0]))
    images = Images(h, v, pair.x_m, pair.y_m, usable, illumination=light, dispersion=dispersion_of_worlds(pair))
    plates = {f"{plate.name} {i}": (plate, box) for i, (plate, box) in enumerate(pixel_boxes(pair))}
    metal_name = next((name for name, (plate, _) in plates.items() if plate.name == declared), None)
    known_scene = KnownScene()
    if not searched:
        boxes: dict[str, tuple[float, float, float, float]] = {}
        for name, (_, (left, bottom, right, top)) in plates.items():
            boxes[name] = (left, bottom, right, top)
        segmentation, names = make_patches_from_labels(boxes, pair.x_m, pair.y_m, margin_mm=MARGIN_MM)
        metal = next((label for label, name in names.items() if name == metal_name), None)
        known_scene = KnownScene(segmentation, metal, names)
    elif metal_name is not None:
        known_scene = KnownScene(metal=box_in_mm(plates[metal_name][1], pair))
    # Amplitudes of these images are relative to the direct path.
    prior = RigPrior(THETA_STD_RAD, channels_known=True)
    if leakage is not None:
        # MOVED_PROBABILITY: probability that the mount has moved since its leakage was measured.
        prior = replace(prior, leakage=leakage, leakage_std=LEAKAGE_STD, leakage_measured=True, moved=MOVED_PROBABILITY)
    theta_rad = np.radians(pair.incidence_deg) + theta_error_rad
    analysis = analyse(images, Optics(theta_rad, prior), known_scene, classifier)
    if not searched:
        return analysis, {label: plates[name][0] for label, name in known_scene.names.items()}
    return analysis, match_plates(analysis.segmentation, list(plates.values()))


def box_in_mm(box: tuple[int, int, int, int], pair: generator.ImagePair) -> tuple[float, float, float, float]:
    """Return a box in pixels as millimetres from the picture's middle, x0, y0, x1, y1."""
    left, bottom, right, top = box
    x_mm = axis_mm(pair.x_m)
    y_mm = axis_mm(pair.y_m)
    return float(x_mm[left]), float(y_mm[bottom]), float(x_mm[right - 1]), float(y_mm[top - 1])


def match_plates(
    segmentation: Segmentation, plates: Sequence[tuple[generator.Plate, tuple[int, int, int, int]]]
) -> dict[int, generator.Plate]:
    """Return patch number to the plate that most of the patch lies on; patches without one are missing."""
    out = {}
    for patch in segmentation.patches:
        for plate, (left, bottom, right, top) in plates:
            if patch.mask[bottom:top, left:right].sum() > patch.mask.sum() / 2:
                out[patch.label] = plate
    return out


def number_name(name: str) -> int:
    """Return a number of a name for seeds: unlike `hash` the same in every run."""
    return sum(map(ord, name))


def draw_pair(nuisance: str, seed: int, mixed: bool = False) -> generator.ImagePair:
    """Draw and scan one world of nine plates: one of copper, the others of materials of Table 2, as half spaces.

    `mixed`: a drawn share of the materials, between `LIBRARY_SHARE`, is of Table 2, others are of no library.
    """
    rng = np.random.default_rng([seed, number_name(nuisance)])
    rig = generator.published_rig()
    materials = None
    if mixed:
        materials = draw_mixed_materials(np.random.default_rng([seed, number_name(nuisance), 2]))
    world = generator.draw_world(rng, tuple(rig.centre_m), materials=materials, half_spaces=True)
    return generator.simulate(world, generator.draw_nuisances(rng, nuisance), rig)


def draw_piece(rng: np.random.Generator, permittivity: complex) -> complex:
    """Draw a piece of a material: 3 % in the real part, 20 % in the loss (standard deviations)."""
    return permittivity.real * (1 + 0.03 * rng.standard_normal()) + 1j * permittivity.imag * np.exp(
        0.2 * rng.standard_normal()
    )


def draw_mixed_materials(rng: np.random.Generator) -> dict[str, complex | generator.Stack]:
    """Draw nine materials (of which copper replaces one): of Table 2, or of no library, named "foreign ..."."""
    of_library = rng.random(9) < rng.uniform(*LIBRARY_SHARE)
    members = rng.choice(list(generator.TABLE_2), 9, replace=False)
    strangers = rng.choice(list(FOREIGN), 9, replace=False)
    materials: dict[str, complex | generator.Stack] = {}
    for is_member, member, stranger in zip(of_library, members.tolist(), strangers.tolist(), strict=True):
        if is_member:
            materials[member] = generator.TABLE_2[member]
        else:
            materials[f"foreign {stranger}"] = draw_piece(rng, FOREIGN[stranger])
    return materials


def draw_calibration(nuisance: str, seed: int) -> tuple[tuple[complex, complex] | None, float]:
    """Draw what a calibration of the rig gives: its leakage, in truth 0, or None; and the error of the incidence angle.

    A rig that knew its leakage exactly would be better than its error bars say.
    """
    rng = np.random.default_rng([seed, number_name(nuisance), 1])
    into_h, into_v = LEAKAGE_STD * (rng.standard_normal(2) + 1j * rng.standard_normal(2))
    theta_error_rad = THETA_STD_RAD * float(rng.standard_normal())
    leakage = None if nuisance in UNMEASURED else (complex(into_h), complex(into_v))
    return leakage, theta_error_rad


def judge_world(nuisance: str, seed: int, searched: bool = False, mixed: bool = False) -> SceneFigures:
    """Draw, scan and judge one world, with the errors of a calibration as the analysis believes in them."""
    pair = draw_pair(nuisance, seed, mixed)
    classifier = table_2_classifier(float(np.radians(pair.incidence_deg)))
    leakage, theta_error_rad = draw_calibration(nuisance, seed)
    analysis, plates = analyse_world(
        pair, leakage=leakage, classifier=classifier, searched=searched, theta_error_rad=theta_error_rad
    )
    verdict = join_reasons(scene_reasons(analysis, None, classifier))
    judged = [(patch, plates[patch.patch.label]) for patch in analysis.patches if patch.patch.label in plates]
    return SceneFigures(
        nuisance,
        seed,
        verdict.level,
        tuple(f"{r.what}: {r.why}" for r in verdict.reasons),
        tuple(compare_with_plate(nuisance, patch, plate) for patch, plate in judged if not plate.stack.is_metal),
        # Several patches may lie on one plate.
        missed=len(pixel_boxes(pair)) - len({plate.centre_m for _, plate in judged}),
        stray=len(analysis.patches) - len(judged),
    )


def compare_with_plate(nuisance: str, patch: PatchResult, plate: generator.Plate) -> PatchFigures:
    """Compare one patch with its plate, whose true permittivity is that of its half space."""
    e = patch.permittivity
    refused = "" if patch.refused is None else patch.refused.what
    distance2 = None
    half_width = None
    error = None
    if e.value is not None and e.covariance is not None and not refused:
        deviation = e.value - plate.stack.below
        parts = np.array([deviation.real, deviation.imag])
        distance2 = float(parts @ np.linalg.solve(e.covariance, parts))
        half_width = 1.96 * float(np.sqrt(np.trace(e.covariance) / 2)) / abs(e.value)
        error = abs(deviation) / abs(plate.stack.below)
    name = UNKNOWN
    confidence = 0.0
    if patch.patch_name is not None:
        name = patch.patch_name.name
        confidence = patch.patch_name.confidence
    return PatchFigures(
        nuisance=nuisance,
        material=plate.name,
        distance2=distance2,
        half_width=half_width,
        error=error,
        name=name,
        confidence=confidence,
        of_library=patch.patch_name is not None and patch.patch_name.source == "library",
        refused=refused,
    )


# Scenes of `--metal`: what is declared as the metal reference, and a scene without metal.
METAL_KINDS = ("copper declared", "dielectric declared", "no metal")


@dataclass(frozen=True)
class MetalFigures:
    """One scene with sheets and dishes."""

    # One of `METAL_KINDS`.
    kind: str
    seed: int
    # Level of the verdict.
    level: str
    # True if the program found that the declared metal is not metal.
    withdrawn: bool
    # Names that the result gives, without "unknown".
    names: tuple[str, ...]


def draw_metal_world(rng: np.random.Generator, with_metal: bool) -> generator.World:
    """Draw plates, thin sheets in air and dishes of liquids, with copper or without."""
    rig = generator.published_rig()
    materials: dict[str, complex | generator.Stack] = dict(generator.TABLE_2)
    for name, liquid in LIQUIDS.items():
        # The glass of the dish, 1 to 3 mm thick.
        materials[name] = generator.Stack(((6.9 - 0.5j, rng.uniform(1e-3, 3e-3)),), liquid)
    for number in range(4):
        sheet = rng.uniform(2, 5) * (1 - 1j * rng.uniform(0.001, 0.05))
        materials[f"sheet {number}"] = generator.Stack(((sheet, rng.uniform(0.5e-3, 3e-3)),), 1.0)
    pieces = int(rng.integers(3, 10))
    return generator.draw_world(
        rng, tuple(rig.centre_m), materials=materials, half_spaces=True, with_metal=with_metal, pieces=pieces
    )


def judge_metal(kind: str, seed: int, searched: bool) -> MetalFigures:
    """Judge one scene of `METAL_KINDS`."""
    rng = np.random.default_rng([seed, METAL_KINDS.index(kind)])
    world = draw_metal_world(rng, with_metal=kind != "no metal")
    pair = generator.simulate(world, generator.draw_nuisances(rng, "none"), generator.published_rig())
    declared = {"copper declared": "copper", "no metal": None}.get(kind)
    if kind == "dielectric declared":
        dielectrics = [plate for plate in world.plates if not plate.stack.is_metal]
        # The first half space; a few scenes have sheets and dishes alone.
        declared = min(dielectrics, key=lambda plate: bool(plate.stack.layers)).name
    classifier = table_2_classifier(float(np.radians(pair.incidence_deg)))
    analysis, _ = analyse_world(pair, declared, classifier=classifier, searched=searched)
    verdict = join_reasons(scene_reasons(analysis, None, classifier))
    if verdict.usable:
        shown_analysis = analysis
    else:
        shown_analysis = analysis.without_result()
    names = [patch.patch_name.name for patch in shown_analysis.patches if patch.patch_name is not None]
    withdrawn = analysis.metal.evidence is not None and analysis.metal.evidence.against
    return MetalFigures(kind, seed, verdict.level, withdrawn, tuple(name for name in names if name != UNKNOWN))


def print_metal(scenes: Sequence[MetalFigures]) -> None:
    """Print for each kind: how often the metal is withdrawn, the verdicts, and in how many scenes there are names."""
    for kind in METAL_KINDS:
        scenes_of_kind = [scene for scene in scenes if scene.kind == kind]
        if scenes_of_kind:
            counts = Counter(scene.level for scene in scenes_of_kind)
            levels = ", ".join(f"{level} {counts[level]}" for level in ("good", "care", "none"))
            withdrawn = sum(scene.withdrawn for scene in scenes_of_kind)
            with_names = sum(bool(scene.names) for scene in scenes_of_kind)
            print(f"{kind}: {len(scenes_of_kind)} scenes, withdrawn {withdrawn}, verdicts {levels},", end="")
            print(f" scenes with names {with_names}")


def format_line(title: str, scenes: Sequence[SceneFigures]) -> str:
    """Return one line of the table of patches."""
    patches = [p for scene in scenes for p in scene.patches]
    distances = np.array([p.distance2 for p in patches if p.distance2 is not None])
    widths = [p.half_width for p in patches if p.half_width is not None]
    errors = [p.error for p in patches if p.error is not None]
    right = np.mean([p.name == p.material for p in patches])
    cells = [f"{title:<14}{len(patches):>8}{100 * float(np.mean(distances < CHI2_95)):>9.1f}"]
    cells.append(f"{np.sqrt(distances.mean() / 2):>8.2f}{100 * np.median(widths):>9.1f}{100 * np.median(errors):>8.1f}")
    cells.append(f"{100 * right:>9.1f}")
    for low, high in ((0.5, 0.8), (0.8, 0.95), (0.95, 1.01)):
        named = [p for p in patches if p.of_library and low <= p.confidence < high]
        said = np.nan
        correct = np.nan
        if named:
            said = np.mean([p.confidence for p in named])
            correct = np.mean([p.name == p.material for p in named])
        cells.append(f"{100 * said:>6.0f}{100 * correct:>4.0f} ({len(named)})")
    return "".join(cells)


def verdict_line(title: str, scenes: Sequence[SceneFigures], undisturbed: Sequence[SceneFigures]) -> str:
    """Return one line of the table of verdicts; in `undisturbed` scenes naming the nuisance is a false alarm."""
    good = [scene for scene in scenes if scene.level == "good"]
    under_good = [p.inside for scene in good for p in scene.patches if p.inside is not None]
    cells = [f"{title:<14}{len(scenes):>7}{100 * len(good) / len(scenes):>8.0f}"]
    cells.append(f"{100 * np.mean(under_good):>10.1f}" if under_good else f"{'-':>10}")
    cells.append(f"{sum(scene.level == 'none' for scene in scenes):>6}")
    places = [scene.place_named(title) for scene in scenes]
    early = np.mean([place is not None and place < FIRST_REASONS for place in places])
    ever = np.mean([place is not None for place in places])
    if undisturbed:
        false = np.mean([scene.place_named(title) is not None for scene in undisturbed])
    else:
        false = np.nan
    cells.append(f"{100 * early:>9.0f}{100 * ever:>6.0f}{100 * false:>13.0f}" if title in CAUSES else f"{'-':>9}")
    refused = sum(bool(p.refused) for scene in scenes for p in scene.patches)
    cells.append(f"   refused {refused}, missed {sum(s.missed for s in scenes)}, stray {sum(s.stray for s in scenes)}")
    return "".join(cells)


def print_tables(scenes: Sequence[SceneFigures]) -> None:
    """Print both tables."""
    names = list(dict.fromkeys(scene.nuisance for scene in scenes))
    by_name = {name: [scene for scene in scenes if scene.nuisance == name] for name in names}
    print(f"{'nuisance':<14}{'patches':>8}{'in 95 %':>9}{'rms z':>8}{'half %':>9}{'err %':>8}{'right %':>9}"
          "  names of the library said %, right % (number) at 0.5, 0.8, 0.95")  # fmt: skip
    for name in names:
        print(format_line(name, by_name[name]))
    print(format_line("together", scenes))
    print(f"\n{'nuisance':<14}{'scenes':>7}{'good %':>8}{'in good %':>10}{'none':>6}{'first 2 %':>10}{'ever':>6}"
          f"{'undisturbed':>13}  the cause among the reasons")  # fmt: skip
    for name in names:
        print(verdict_line(name, by_name[name], by_name.get("none", [])))
    print(verdict_line("together", scenes, []))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument("--scenes", type=int, default=1, help="scenes for each nuisance")
    parser.add_argument("--first", type=int, default=100, help="seed of the first scene")
    parser.add_argument(
        "--nuisances", default=",".join(("none", *generator.NUISANCES, "all")), help="separated by commas"
    )
    parser.add_argument("--metal", type=int, default=0, help="judge so many scenes of each kind of metal instead")
    parser.add_argument("--searched", action="store_true", help="search for patches instead of giving boxes")
    parser.add_argument("--mixed", action="store_true", help="a drawn share of the plates is of no library")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    parser.add_argument("--json", type=Path, default=None, help="write the figures of each scene there")


def run(args: argparse.Namespace) -> int:
    """Judge worlds of each nuisance, or with `--metal` scenes of `METAL_KINDS`; print the tables. Return 0."""
    if args.metal:
        seeds = range(args.first, args.first + args.metal)
        kinds, numbers = zip(*itertools.product(METAL_KINDS, seeds), strict=True)
        with ProcessPoolExecutor(args.jobs) as pool:
            print_metal(list(pool.map(partial(judge_metal, searched=args.searched), kinds, numbers)))
        return 0
    seeds = range(args.first, args.first + args.scenes)
    names, numbers = zip(*itertools.product(args.nuisances.split(","), seeds), strict=True)
    judge = partial(judge_world, searched=args.searched, mixed=args.mixed)
    with ProcessPoolExecutor(args.jobs) as pool:
        scenes = list(pool.map(judge, names, numbers))
    print(__doc__)
    print_tables(scenes)
    if args.json is not None:
        args.json.write_text(json.dumps([asdict(scene) for scene in scenes], indent=1), encoding="utf-8")
    return 0
