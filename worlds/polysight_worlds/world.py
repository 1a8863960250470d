"""Worlds: plates, sheets, dishes and a table behind them, and the nuisances under which they are scanned."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.random import Generator

from polysight_worlds.media import METAL, Stack
from polysight_worlds.optics import Facets

# Table 2 of the POLySIGHT paper, solids: estimated permittivity at 76 to 81 GHz.
TABLE_2: dict[str, complex] = {
    "acrylic_1mm": 3.56 - 0.18j,
    "acrylic_3mm": 4.00 - 0.40j,
    "polycarbonate": 4.26 - 0.21j,
    "pet_0.5mm": 3.78 - 0.70j,
    "pet_1mm": 3.83 - 0.73j,
    "vinyl": 3.65 - 0.70j,
    "pvc": 4.15 - 0.81j,
    "pla_ender": 3.79 - 0.34j,
    "pla_hyper": 4.21 - 0.30j,
    "tpu": 3.91 - 0.21j,
    "ceramic": 4.75 - 2.43j,
    "rubber": 5.06 - 1.11j,
    "silicone_rubber": 3.52 - 0.82j,
    "glass": 7.26 - 0.85j,
    "glass_fibre": 4.69 - 0.70j,
    "paper": 4.63 - 0.31j,
    "cardboard": 5.24 - 0.01j,
    "cardboard_rough": 4.54 - 0.56j,
    "fabric": 2.21 - 0.13j,
    "wood_thin": 2.61 - 0.01j,
    "wood_rough": 5.02 - 0.81j,
}


@dataclass(frozen=True)
class Plate:
    """A flat piece, with its centre in the rig frame and its size along x and y.

    `height_mm`: its surface above the object plane, towards the antennas. With positive tilts z, which points away from
    the antennas, grows along x and y. `roughness_mm` and `waviness_mm`: rms of its surface with correlation lengths of
    5 and 20 mm. `bow_mm`: how much farther away the edges are than the middle, along x and y. `brightness`: factor on
    the amplitudes of H and V alike. `round_`: a disc.
    """

    name: str
    centre_m: tuple[float, float]
    size_m: tuple[float, float]
    stack: Stack
    height_mm: float = 0.0
    tilt_x_deg: float = 0.0
    tilt_y_deg: float = 0.0
    roughness_mm: float = 0.0
    waviness_mm: float = 0.0
    bow_mm: tuple[float, float] = (0.0, 0.0)
    brightness: float = 1.0
    round_: bool = False

    @property
    def box_m(self) -> tuple[float, float, float, float]:
        """x0, y0, x1, y1 in the rig frame."""
        x, y = self.centre_m
        width, height = self.size_m
        return x - width / 2, y - height / 2, x + width / 2, y + height / 2


@dataclass(frozen=True)
class Body:
    """A piece of any form, such as an `optics.ellipsoid`. Its echo is a sum over all facets at each stage position."""

    name: str
    facets: Facets
    stack: Stack


@dataclass(frozen=True)
class World:
    """What lies before the rig: all pieces, seen without shadows of each other."""

    plates: tuple[Plate, ...]
    bodies: tuple[Body, ...] = ()


def table(stack: Stack, *, behind_mm: float, centre_m: tuple[float, float], tilt_deg: float = 0.0) -> Plate:
    """Return a table of 0.7 m by 0.5 m at `behind_mm` behind the object plane; by the tilt z grows in x, falls in y."""
    size_m = (0.7, 0.5)
    return Plate("table", centre_m, size_m, stack, height_mm=-behind_mm, tilt_x_deg=tilt_deg, tilt_y_deg=-tilt_deg)


def dish(name: str, centre_m: tuple[float, float], diameter_m: float, liquid: complex, *, wall_m: float) -> Plate:
    """Return a round dish whose bottom faces the antennas: `wall_m` of glass, and a deep liquid behind it."""
    # Near the glass of Table 2; chosen.
    glass = 6.9 - 0.5j
    return Plate(name, centre_m, (diameter_m, diameter_m), Stack(((glass, wall_m),), liquid), round_=True)


@dataclass(frozen=True)
class Nuisances:
    """What disturbs a scan; 0: undisturbed. Directions, phases and places are drawn from `seed`.

    | field | what |
    | --- | --- |
    | tx_turn_deg, h_turn_deg, v_turn_deg | a board was turned about its own place after the calibration |
    | misplaced_mm | each board stands so far from where the rig file says |
    | height_mm | surfaces of plates lie up to this above the object plane |
    | tilt_deg | plates lie tilted by up to this in x and y |
    | drift, drift_deg | change of the gain of V against H during the scan: share, phase |
    | multipath | share of a second path beside the direct path: fringes in amplitude and phase |
    | stage_scale | share by which stage steps are longer than said |
    | noise | rms of each sample relative to the rms echo |
    | interference | share of positions with a burst of another radar |
    | clipping | share of the largest amplitude of direct path and echo that is cut off |
    | roughness_mm, waviness_mm | rms of all plates' surfaces, correlated over 5 and 20 mm |
    | bow_mm | plates are bent by up to this, either way in x and y |
    | brightness | plates are brighter or darker by a factor of up to 1 plus this, as in the published picture |
    | leakage | magnitude of the other polarisation in H and V |
    | border | share of the picture's width by which the scene is shifted |
    | aperture | share of the grid, in each direction, that was not scanned |
    | dark | share of positions without signal |
    """

    seed: int = 0
    tx_turn_deg: float = 0.0
    h_turn_deg: float = 0.0
    v_turn_deg: float = 0.0
    misplaced_mm: float = 0.0
    height_mm: float = 0.0
    tilt_deg: float = 0.0
    drift: float = 0.0
    drift_deg: float = 0.0
    multipath: float = 0.0
    stage_scale: float = 0.0
    noise: float = 0.0
    interference: float = 0.0
    clipping: float = 0.0
    roughness_mm: float = 0.0
    waviness_mm: float = 0.0
    bow_mm: float = 0.0
    brightness: float = 0.0
    leakage: float = 0.0
    border: float = 0.0
    aperture: float = 0.0
    dark: float = 0.0

    def active(self) -> tuple[str, ...]:
        """Return the names of the fields that are not 0."""
        return tuple(f.name for f in fields(self) if f.name != "seed" and getattr(self, f.name))


# What one named nuisance sets, each drawn evenly from its range. The ranges are chosen.
RANGES: dict[str, dict[str, tuple[float, float]]] = {
    "h_turn": {"h_turn_deg": (1, 3)},
    "v_turn": {"v_turn_deg": (1, 3)},
    "tx_turn": {"tx_turn_deg": (1, 3)},
    "misplaced": {"misplaced_mm": (2, 5)},
    "height": {"height_mm": (1, 6)},
    "tilt": {"tilt_deg": (0.5, 2)},
    "drift": {"drift": (0.05, 0.25), "drift_deg": (2, 15)},
    "multipath": {"multipath": (0.1, 0.2)},
    "stage_scale": {"stage_scale": (0.001, 0.002)},
    "noise": {"noise": (0.05, 0.5)},
    "interference": {"interference": (0.002, 0.015)},
    "clipping": {"clipping": (0.1, 0.5)},
    "roughness": {"roughness_mm": (0.1, 0.3)},
    "waviness": {"waviness_mm": (0.05, 0.2)},
    "bow": {"bow_mm": (0.05, 0.3)},
    "brightness": {"brightness": (0.3, 1.0)},
    "leakage": {"leakage": (0.02, 0.1)},
    "border": {"border": (0.25, 0.31)},
    "aperture": {"aperture": (0.2, 0.45)},
    "dark": {"dark": (0.005, 0.03)},
}
NUISANCES = tuple(RANGES)
# At once, the grid is not also cut and the scene not also shifted: a scan so poor is another question.
TOGETHER = tuple(name for name in NUISANCES if name not in ("border", "aperture"))


def draw_nuisances(rng: Generator, names: str | Sequence[str] = "none", *, strength: float = 1.0) -> Nuisances:
    """Draw the named nuisances.

    `names`: "none", "all" (without `border` and `aperture`), one of `NUISANCES`, or several. With "all" each is
    drawn from 0 to its upper limit, else from its lower one. `strength` multiplies what was drawn.
    """
    is_all = names == "all"
    if names == "none":
        drawn_names: Sequence[str] = ()
    elif is_all:
        drawn_names = TOGETHER
    elif isinstance(names, str):
        drawn_names = (names,)
    else:
        drawn_names = names
    values = {}
    for name in drawn_names:
        for key, (low, high) in RANGES[name].items():
            least = 0 if is_all else low
            values[key] = strength * rng.uniform(least, high)
    return Nuisances(seed=int(rng.integers(2**31)), **values)


def draw_stack(rng: Generator, permittivity: complex) -> Stack:
    """Draw a half space or, as often, a plate of 0.4 to 6 mm on a lossy holder; ranges are chosen."""
    if rng.random() < 0.5:
        return Stack(below=permittivity)
    holder = rng.uniform(1.05, 2.5) - 1j * rng.uniform(0.01, 0.4)
    return Stack(((permittivity, rng.uniform(0.4e-3, 6e-3)),), holder)


def nine_places(centre_m: tuple[float, float]) -> list[tuple[float, float]]:
    """Return centres of nine plates in three rows and columns, 64 mm apart as in the published picture."""
    steps = (-0.064, 0.0, 0.064)
    return [(centre_m[0] + dx, centre_m[1] + dy) for dy in steps for dx in steps]


def draw_world(
    rng: Generator,
    centre_m: tuple[float, float],
    *,
    materials: dict[str, complex | Stack] | None = None,
    half_spaces: bool = False,
    with_metal: bool = True,
    with_table: bool = False,
    pieces: int = 9,
) -> World:
    """Draw plates at nine places around `centre_m`.

    `pieces` places get a plate: one of copper (`with_metal`), the others of drawn `materials` (default: Table 2).
    `with_table`: a wooden table stands behind them.
    A material is a permittivity, as half space or slab on a holder (`half_spaces`: never a slab), or a whole stack.
    Sizes are 40 to 50 mm, in steps of 2 mm.
    """
    materials = dict(TABLE_2) if materials is None else materials
    places = nine_places(centre_m)
    order = rng.permutation(len(places))[:pieces]
    names = [str(name) for name in rng.choice(list(materials), pieces, replace=len(materials) < pieces)]
    plates = []
    for i, (index, name) in enumerate(zip(order, names, strict=True)):
        size_m = (0.002 * int(rng.integers(20, 26)), 0.002 * int(rng.integers(20, 26)))
        is_metal = with_metal and i == 0
        material = materials[name]
        if is_metal:
            stack = METAL
        elif isinstance(material, Stack):
            stack = material
        elif half_spaces:
            stack = Stack(below=material)
        else:
            stack = draw_stack(rng, material)
        plates.append(Plate("copper" if is_metal else name, places[index], size_m, stack))
    if with_table:
        # A board of wood with air behind it.
        wood = Stack(((rng.uniform(1.8, 3.5) - 0.15j, rng.uniform(0.005, 0.03)),), 1.0)
        plates.append(table(wood, behind_mm=rng.uniform(60, 200), centre_m=centre_m, tilt_deg=rng.uniform(-1, 1)))
    return World(tuple(plates))


def disturb_plates(world: World, nuisances: Nuisances) -> World:
    """Return the world with what `nuisances` add to plates: heights, tilts, roughness, waviness, bow and brightness.

    A plate named "table" is not changed.
    """
    # The 1 makes these draws differ from other ones of the same seed.
    rng = np.random.default_rng([nuisances.seed, 1])
    disturbed = []
    for plate in world.plates:
        # Drawn for the table too: what a plate gets depends only on its own place in the list.
        height_share = rng.uniform(0, 1)
        tilt_shares = rng.uniform(-1, 1, 2)
        bow_shares = rng.uniform(-1, 1, 2)
        brightness = (1 + nuisances.brightness) ** rng.uniform(-1, 1)
        if plate.name == "table":
            disturbed.append(plate)
            continue
        roughness_mm = np.hypot(plate.roughness_mm, nuisances.roughness_mm)
        waviness_mm = np.hypot(plate.waviness_mm, nuisances.waviness_mm)
        moved = replace(
            plate,
            height_mm=plate.height_mm + height_share * nuisances.height_mm,
            tilt_x_deg=plate.tilt_x_deg + tilt_shares[0] * nuisances.tilt_deg,
            tilt_y_deg=plate.tilt_y_deg + tilt_shares[1] * nuisances.tilt_deg,
            roughness_mm=float(roughness_mm),
            waviness_mm=float(waviness_mm),
            brightness=plate.brightness * float(brightness),
            bow_mm=(
                plate.bow_mm[0] + float(bow_shares[0]) * nuisances.bow_mm,
                plate.bow_mm[1] + float(bow_shares[1]) * nuisances.bow_mm,
            ),
        )
        disturbed.append(moved)
    return replace(world, plates=tuple(disturbed))
