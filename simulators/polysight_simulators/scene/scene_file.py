"""Scene files (docs/spec/scene-file.md), the specimens drawn from them, and reproducible random numbers.

Random numbers follow from a seed and names: they are equal on every machine and in any order of calls. A scene file has
nominal values; `draw_specimens` draws each plate's permittivity around its nominal value, and adds shift and tilt of
the object plane to the plates. The draws depend only on the scene's seed and the plate's index: another power cycle
(`--seed`) scans the same specimens.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal
from zlib import crc32

import msgspec
import numpy as np
import scipy
from numpy.typing import NDArray

from polysight_shared.config import Image, Instrument
from polysight_shared.errors import ConfigError, ErrorCode
from polysight_shared.raster import Burst, Grid, Stage
from polysight_shared.tables import decode, read_toml, to_builtins

_U64 = np.uint64


@cache
def stream_key(seed: int, *words: str) -> int:
    """Return a 64-bit key from a seed and words, equal on every machine."""
    state = np.random.SeedSequence([seed, *(crc32(w.encode()) for w in words)]).generate_state(1, np.uint64)
    return int(state[0])


def draw_uniform(key: int, events: NDArray[np.int64]) -> NDArray[np.floating]:
    """Return a uniform number in [0, 1) per event, independent of order and batch (splitmix64: Steele et al. 2014)."""
    z = (events.astype(_U64) + _U64(1)) * _U64(0x9E3779B97F4A7C15) + _U64(key)
    z = (z ^ (z >> _U64(30))) * _U64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> _U64(27))) * _U64(0x94D049BB133111EB)
    return ((z ^ (z >> _U64(31))) >> _U64(11)).astype(np.float64) * 2.0**-53


def draw_normal(key: int, first: int, out: NDArray[np.float32]) -> None:
    """Fill out[i] with standard normal numbers of event `first` + i, independent of the batch.

    Sixteen bits of a counter-based generator select one of 65536 equally likely values: seven times faster than the
    continuous distribution, and equal after the ADC. The largest is 4.3; the variance is 1.
    """
    values = out[0].size
    # The generator's counter counts blocks of 256 bits.
    blocks = -(-values // 16)
    bits = np.random.Philox(key=key, counter=first * blocks).random_raw(len(out) * blocks * 4).view("<u2")
    chosen = bits.reshape(len(out), -1)[:, :values].reshape(out.shape)
    # "clip": no copy of `out` in case of a wrong index.
    np.take(_tabulate_normal(), chosen, out=out, mode="clip")


@cache
def _tabulate_normal() -> NDArray[np.float32]:
    """Return the middles [65536] of equally likely intervals of the normal distribution, variance 1."""
    middles = scipy.special.ndtri((np.arange(1 << 16) + 0.5) / (1 << 16))
    return (middles / middles.std()).astype(np.float32)


# Every number has both limits: they also refuse NaN and infinities, and limit the size of a scan. They are chosen, wide
# enough for any reasonable scene.
Seed = Annotated[int, msgspec.Meta(ge=0, le=(1 << 63) - 1)]
Millimetres = Annotated[float, msgspec.Meta(ge=-2000, le=2000)]
Size = Annotated[float, msgspec.Meta(ge=0.01, le=2000)]
Factor = Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)]
Permittivity = Annotated[float, msgspec.Meta(ge=0, le=1e9)]
Amplitude = Annotated[float, msgspec.Meta(ge=-1000, le=1000)]
Angle = Annotated[float, msgspec.Meta(ge=-360, le=360)]
Nanoseconds = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
Delay = Annotated[float, msgspec.Meta(ge=0, le=1e5)]
PartsPerMillion = Annotated[float, msgspec.Meta(ge=-1000, le=1000)]
Hertz = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Microseconds = Annotated[float, msgspec.Meta(ge=0.001, le=1e6)]
Share = Annotated[float, msgspec.Meta(ge=0, le=0.5)]
# Tilt of a plate; its fast computation (`field.py`) is checked up to 2 degrees.
Degrees = Annotated[float, msgspec.Meta(ge=-10, le=10)]
Tilt = tuple[Degrees, Degrees]
Height = Annotated[float, msgspec.Meta(ge=-50, le=50)]
SteepTilt = Annotated[float, msgspec.Meta(ge=-60, le=60)]
Bend = Annotated[float, msgspec.Meta(ge=-100, le=100)]
# A table lies far behind the plates.
PlateHeight = Annotated[float, msgspec.Meta(ge=-50, le=300)]
Drift = Annotated[float, msgspec.Meta(ge=-0.5, le=0.5)]
Gain = Annotated[float, msgspec.Meta(ge=-200, le=200)]
GainSpread = Annotated[float, msgspec.Meta(ge=0, le=100)]
Decibels = Annotated[float, msgspec.Meta(ge=-40, le=200)]
Spread = Annotated[float, msgspec.Meta(ge=0, le=2)]
Leakage = tuple[Annotated[float, msgspec.Meta(ge=-10, le=10)], Annotated[float, msgspec.Meta(ge=-10, le=10)]]
Pair = tuple[float, float]
MAX_FACETS = 100_000
"""Largest number of facets of a rough plate; chosen."""
# Tables of the rig file whose keys a scene may replace.
_OVERRIDES: dict[str, type] = {"grid": Grid, "burst": Burst, "image": Image, "stage": Stage}


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the scene file: frozen, without unknown keys."""


def _require(ok: bool, rule: str) -> None:
    """Raise ValueError with this rule unless `ok`; `decode` turns it into a ConfigError."""
    if not ok:
        raise ValueError(rule)


def _check_permittivity(pair: Pair) -> None:
    """Raise ValueError if eps' is below 1 or the loss eps'' negative."""
    _require(pair[0] >= 1.0, "permittivity's real part must be at least 1")
    _require(pair[1] >= 0.0, "permittivity's second number is the loss eps'' >= 0 of eps' - j eps''")


class Layer(_Table, frozen=True):
    """A layer of a plate; without `thickness_mm` a half space (only the last layer).

    `permittivity` is [eps', eps''] of eps' - j eps''.
    """

    permittivity: tuple[Permittivity, Permittivity]
    thickness_mm: Size | None = None
    name: str = ""

    def __post_init__(self) -> None:
        _check_permittivity(self.permittivity)

    @property
    def epsilon(self) -> complex:
        """Relative permittivity eps' - j eps''."""
        return complex(self.permittivity[0], -self.permittivity[1])


class Plate(_Table, frozen=True):
    """A flat rectangular plate on the object plane, sides along x and y.

    `centre_mm` is relative to the image centre (specular midpoint of TX and H at stage offset zero). `permittivity` is
    [eps', eps''] of eps' - j eps''; without `thickness_mm` the plate is a half space (one interface). `layers` is a
    stack from front to back instead, for example a liquid behind a wall; air follows the last layer unless that is a
    half space. Metal with `strips_deg` is ideal thin strips, rotated by this angle from the vertical towards +x.

    `height_mm` moves the plate away from the radars (+z). `tilt_deg` [ax, ay] rotates it about its centre: height grows
    along +x by tan(ax) and along +y by tan(ay). `rough_mm` is the standard deviation of the surface's height, in facets
    of `rough_length_mm`. A `background` plate, such as a table, is seen by the radars but is nothing to be named.
    """

    name: str
    centre_mm: tuple[Millimetres, Millimetres]
    size_mm: tuple[Size, Size]
    permittivity: tuple[Permittivity, Permittivity] | None = None
    metal: bool = False
    thickness_mm: Size | None = None
    layers: tuple[Layer, ...] = ()
    strips_deg: Angle | None = None
    tilt_deg: Tilt = (0.0, 0.0)
    height_mm: PlateHeight = 0.0
    background: bool = False
    rough_mm: Annotated[float, msgspec.Meta(ge=0, le=5)] = 0.0
    rough_length_mm: Size = 6.0

    def __post_init__(self) -> None:
        """Check what the types cannot: a name, one kind of material, what goes with it, and the number of facets."""
        _require(self.name.strip() != "" and self.name.isprintable(), "a plate has a name of printable characters")
        _require(self.strips_deg is None or self.metal, "strips_deg needs metal = true")
        kinds = (self.metal, self.permittivity is not None, bool(self.layers))
        _require(sum(kinds) == 1, "a plate has one of permittivity = [..], metal = true or [[plates.layers]]")
        _require(
            self.thickness_mm is None or self.permittivity is not None,
            "thickness_mm is for permittivity, not for metal or layers",
        )
        _require(
            all(layer.thickness_mm is not None for layer in self.layers[:-1]),
            "only the last of [[plates.layers]] may be without thickness_mm",
        )
        if self.permittivity is not None:
            _check_permittivity(self.permittivity)
        columns, rows = self.facet_counts
        _require(
            columns * rows <= MAX_FACETS,
            f"size_mm, rough_mm and rough_length_mm give {columns} x {rows} facets; at most {MAX_FACETS} are simulated",
        )

    @property
    def facet_counts(self) -> tuple[int, int]:
        """Facets along x and y, with sides near `rough_length_mm`; one for a smooth plate."""
        if not self.rough_mm:
            return 1, 1
        columns, rows = (max(1, round(side / self.rough_length_mm)) for side in self.size_mm)
        return columns, rows

    @property
    def stack(self) -> tuple[Layer, ...]:
        """Layers from front to back; none for metal."""
        if self.permittivity is not None:
            return (Layer(self.permittivity, self.thickness_mm, self.name),)
        return self.layers


class Point(_Table, frozen=True):
    """An isotropic point scatterer, equal in both polarisations.

    `amplitude` [re, im] is relative to the direct path, for a point at the specular midpoint. `height_mm` moves it away
    from the radars.
    """

    position_mm: tuple[Millimetres, Millimetres]
    amplitude: tuple[Amplitude, Amplitude] = (1.0, 0.0)
    name: str = ""
    height_mm: Height = 0.0


class Shape(_Table, frozen=True):
    """A sphere, cylinder (with `slope_deg` a cone), bottle, or plate that may be tilted and bent.

    `centre_mm` and `height_mm` are those of its front: the point nearest to the radars, of a plate its middle. `axis`
    is along a cylinder or bottle, `length_mm` of a bottle that of its body. `turn_deg` rotates a plate's sides about
    its normal. `bends_per_m`: 1 / radius along the plate's sides and its twist, positive where it bends away. With
    `thickness_mm` it is a thin wall in air.
    """

    kind: Literal["sphere", "cylinder", "bottle", "plate"]
    centre_mm: tuple[Millimetres, Millimetres]
    name: str = ""
    height_mm: Annotated[float, msgspec.Meta(ge=-300, le=300)] = 0.0
    radius_mm: Annotated[float, msgspec.Meta(ge=10, le=500)] | None = None
    length_mm: Size = 400.0
    axis: tuple[Amplitude, Amplitude, Amplitude] = (0.0, 1.0, 0.0)
    slope_deg: Annotated[float, msgspec.Meta(ge=-30, le=30)] = 0.0
    size_mm: tuple[Size, Size] | None = None
    tilt_deg: tuple[SteepTilt, SteepTilt] = (0.0, 0.0)
    turn_deg: Angle = 0.0
    bends_per_m: tuple[Bend, Bend, Bend] = (0.0, 0.0, 0.0)
    metal: bool = False
    permittivity: tuple[Permittivity, Permittivity] | None = None
    thickness_mm: Size | None = None

    def __post_init__(self) -> None:
        _require(
            self.metal != (self.permittivity is not None), "a shape has one of permittivity = [..] or metal = true"
        )
        _require(
            self.thickness_mm is None or self.permittivity is not None,
            "thickness_mm is for permittivity, not for metal",
        )
        if self.permittivity is not None:
            _check_permittivity(self.permittivity)
        if self.kind == "plate":
            _require(self.size_mm is not None and self.radius_mm is None, "a plate has size_mm, and no radius_mm")
        else:
            _require(
                self.radius_mm is not None and self.size_mm is None, f"a {self.kind} has radius_mm, and no size_mm"
            )
        # At least 26 degrees away from z; chosen.
        length = math.hypot(*self.axis)
        _require(length > 0 and abs(self.axis[2]) < 0.9 * length, "axis must not point at the radars")


class Crystals(_Table, frozen=True):
    """Errors of the boards' crystals by role, ppm."""

    transmit: PartsPerMillion = 0.0
    receive_h: PartsPerMillion = 0.0
    receive_v: PartsPerMillion = 0.0


class Skews(_Table, frozen=True):
    """Constant later starts of the boards by role, ns."""

    transmit: Nanoseconds = 0.0
    receive_h: Nanoseconds = 0.0
    receive_v: Nanoseconds = 0.0


class Disturbances(_Table, frozen=True):
    """Disturbances of the rig. Defaults are those of the published rig; OFF switches all off.

    docs/spec/scene-file.md has the source of each default, and says which are assumed.
    """

    # Each start of a board is late by 0 to this much, drawn by pulse, and by a latency that is the same for all boards.
    sync_uncertainty_ns: Delay = 5.0
    sync_latency_ns: Delay = 160.0
    crystal_ppm: Crystals = Crystals(0.0, 0.8, -1.1)
    # Start frequency of the receivers above the rig file's, unless the host programs the radars itself.
    if_offset_hz: Hertz = 870e3
    # A new phase of each chirp and board.
    random_phase: bool = True
    # Parabolic bend of the IF before the ramp's end: its height and when it starts.
    bend_hz: Hertz = 300e3
    bend_us: Microseconds = 20.0
    # Oscillation of the IF after the ramp's start, and its decay time.
    ripple_hz: Hertz = 3e3
    ripple_us: Microseconds = 5.0
    # The IF high-pass filter.
    hpf: bool = True
    # Gain and phase of each channel lie within plus and minus these; board H has this gain over board V.
    rx_gain_spread_db: GainSpread = 1.0
    rx_phase_spread_deg: Annotated[float, msgspec.Meta(ge=0, le=360)] = 20.0
    hv_gain_db: Gain = 1.5
    # Change of V's echo relative to H's from the first to the last position: relative amplitude, and degrees. The
    # direct path does not have it, so that the division by that path does not remove it.
    hv_drift: tuple[Drift, Angle] = (0.0, 0.0)
    # Share (real, imaginary) of the other polarisation that a board receives too.
    leakage_h: Leakage = (0.05, 0.0)
    leakage_v: Leakage = (0.05, 0.0)
    # The stage moves during a burst; False: each chirp is at the burst's mean position.
    burst_motion: bool = True
    # Direct path over noise for each chirp and channel; None: no noise.
    direct_snr_db: Gain | None = 5.5
    # Amplitude of the ADC's 32767 counts, in direct paths.
    adc_full_scale: Factor = 64.0
    # Probability that a packet is lost.
    packet_loss: Share = 0.0
    # Rows towards -x are shifted along +x by this much.
    backlash_mm: Height = 0.0
    sync_skew_ns: Skews = Skews()
    # Attenuation of the direct path alone.
    direct_loss_db: Decibels | Literal["absent"] = 0.0
    # Standard error of the leakage that the rig file gets, as from a calibration; None: the rig file keeps its own.
    leakage_measured: Annotated[float, msgspec.Meta(ge=0, le=10)] | None = None

    @property
    def direct_gain(self) -> float:
        """Amplitude of the direct path relative to a free path; 0 without direct path."""
        if isinstance(self.direct_loss_db, str):
            return 0.0
        return 10 ** (-self.direct_loss_db / 20)


# The value of each disturbance that switches it off; the start of the bend and the ripple's decay cannot be.
SWITCHED_OFF: dict[str, Any] = {
    "sync_uncertainty_ns": 0.0,
    "sync_latency_ns": 0.0,
    "crystal_ppm": {},
    "if_offset_hz": 0.0,
    "random_phase": False,
    "bend_hz": 0.0,
    "ripple_hz": 0.0,
    "hpf": False,
    "rx_gain_spread_db": 0.0,
    "rx_phase_spread_deg": 0.0,
    "hv_gain_db": 0.0,
    "hv_drift": [0.0, 0.0],
    "leakage_h": [0.0, 0.0],
    "leakage_v": [0.0, 0.0],
    "burst_motion": False,
    "direct_snr_db": None,
    # Finer steps: 8192 counts for the direct path.
    "adc_full_scale": 4.0,
    "packet_loss": 0.0,
    "backlash_mm": 0.0,
    "sync_skew_ns": {},
    "direct_loss_db": 0.0,
    "leakage_measured": None,
}


class Scene(_Table, frozen=True):
    """The whole scene file.

    `object_gain` models the antenna patterns: gain of object paths relative to the direct path, which lies at the edge
    of the patterns. By default the echo of a 45 mm metal plate at the midpoint has 0.75 of the direct path's amplitude.

    `plane_shift_mm` and `plane_tilt_deg` shift and tilt the plane of all plates and points about the image centre, with
    the signs of a plate. `object_distance_mm` in the rig file does not change, as if the true plane was not measured.
    `specimen_spread` [real, loss] are relative standard deviations of the plates' permittivities from the given ones.
    """

    name: str
    seed: Seed = 1
    object_distance_mm: Size | None = None
    object_gain: Factor = 1.35
    plane_shift_mm: Height = 0.0
    plane_tilt_deg: Tilt = (0.0, 0.0)
    specimen_spread: tuple[Spread, Spread] = (0.0, 0.0)
    grid: dict[str, Any] = {}
    burst: dict[str, Any] = {}
    image: dict[str, Any] = {}
    stage: dict[str, Any] = {}
    plates: tuple[Plate, ...] = ()
    points: tuple[Point, ...] = ()
    shapes: tuple[Shape, ...] = ()
    disturbances: Disturbances = Disturbances()

    def __post_init__(self) -> None:
        for table, kind in _OVERRIDES.items():
            unknown = sorted(set(getattr(self, table)) - set(kind.__struct_fields__))  # type: ignore[attr-defined]
            _require(not unknown, f"[{table}] contains unknown keys {unknown}; known: {list(kind.__struct_fields__)}")  # type: ignore[attr-defined]

    def with_disturbances(self, **changes: Any) -> Scene:
        """Return the scene with some disturbances changed; `ideal=True` switches all off first."""
        base = msgspec.to_builtins(self.disturbances)
        if changes.pop("ideal", False):
            base = dict(SWITCHED_OFF, bend_us=base["bend_us"], ripple_us=base["ripple_us"])
        table = decode(_apply_switches({**base, **changes}, "with_disturbances"), Disturbances, "with_disturbances")
        return msgspec.structs.replace(self, disturbances=table)


def _apply_switches(table: Any, source: str) -> Any:
    """Replace `ideal = true` and "off"/"on" (or false/true) in a [disturbances] table by plain values.

    Raises ConfigError for an unknown switch.
    """
    if not isinstance(table, dict):
        return table
    values = dict(table)
    ideal = values.pop("ideal", False)
    if not isinstance(ideal, bool):
        raise ConfigError(
            f"{source}: disturbances.ideal = {ideal!r}",
            "it is a switch",
            "write true or false",
            code=ErrorCode.TYPE_WRONG,
        )
    result: dict[str, Any] = {}
    if ideal:
        result = dict(SWITCHED_OFF)
    for key, value in values.items():
        if value == "off" or value is False:
            if key not in SWITCHED_OFF and key in Disturbances.__struct_fields__:
                raise ConfigError(
                    f"{source}: disturbances.{key} cannot be switched off",
                    "it only shapes another disturbance",
                    f"switch off disturbances.{key.partition('_')[0]}_hz instead",
                    code=ErrorCode.VALUE_INVALID,
                )
            result[key] = SWITCHED_OFF.get(key, value)
        elif value == "on" or value is True:
            # Without the key its default applies. An unknown key is kept: the caller's `decode` refuses it.
            result.pop(key, None)
            if key not in Disturbances.__struct_fields__:
                result[key] = value
        else:
            result[key] = value
    return result


def decode_scene(raw: dict[str, Any], source: str) -> Scene:
    """Convert and check a parsed scene file.

    Raises
    ------
    ConfigError
        with `source`, the key, its value and the violated rule.
    """
    if "disturbances" in raw:
        raw = {**raw, "disturbances": _apply_switches(raw["disturbances"], source)}
    return decode(raw, Scene, source, "docs/spec/scene-file.md lists all keys of a scene")


def load_scene(path: Path) -> Scene:
    """Read and check a scene file. Raises ConfigError."""
    return decode_scene(read_toml(path), str(path))


def without_offset(scene: Scene) -> Scene:
    """Return the scene without its own IF offset, for a rig file that contains the start frequencies."""
    return msgspec.structs.replace(scene, disturbances=msgspec.structs.replace(scene.disturbances, if_offset_hz=0.0))


def apply_scene(rig: Instrument, scene: Scene) -> Instrument:
    """Return the rig with the scene's grid, burst, image, stage and object distance.

    A filter or leakage that the scene switches off is also switched off in the rig, so that processing does not correct
    it. With `leakage_measured` the rig contains leakage as from a calibration: the true value with an error drawn from
    the scene's seed. Applying the same scene again changes nothing.

    Raises
    ------
    ConfigError
        if an override has a wrong type or violates a rule of the rig file.
    """
    table = to_builtins(rig)
    for name in _OVERRIDES:
        table[name] = {**table[name], **getattr(scene, name)}
    if scene.object_distance_mm is not None:
        table["geometry"] = {**table["geometry"], "object_distance_mm": scene.object_distance_mm}
    if not scene.disturbances.hpf:
        table["chirp"] = {**table["chirp"], "hpf1_khz": 0.0, "hpf2_khz": 0.0}
    table["polarimetry"] = {**table["polarimetry"], **_describe_leakage(scene)}
    remedy = f"its {', '.join(_OVERRIDES)} override the rig file's; docs/spec/scene-file.md lists all keys"
    return decode(table, Instrument, f"scene {scene.name}", remedy)


def _describe_leakage(scene: Scene) -> dict[str, Any]:
    """Return the keys of the rig file's [polarimetry] that a scene sets: measured leakage, or zero."""
    d = scene.disturbances
    parts = ("leakage_h", "leakage_v")
    if d.leakage_measured is not None:
        rng = np.random.default_rng(stream_key(scene.seed, "leakage"))
        error = rng.standard_normal((2, 2)) * d.leakage_measured
        measured = (np.array([d.leakage_h, d.leakage_v]) + error).tolist()
        return {**dict(zip(parts, measured, strict=True)), "leakage_std": d.leakage_measured}
    none = {key: [0.0, 0.0] for key in parts if not any(getattr(d, key))}
    if len(none) == len(parts):
        return {**none, "leakage_std": 0.0}
    return none


_AIR = (1.0, 0.0)


@dataclass(frozen=True)
class Facets:
    """Rectangles of constant height on a plate, in addition to its tilt; metres from the plate's centre.

    Attributes
    ----------
    x_m, y_m
        Centres of the columns and rows of facets.
    size_m
        Sides of one facet along x and y.
    height_m
        float64 [row, column]: zero for a smooth plate, which is one facet.
    """

    x_m: NDArray[np.floating]
    y_m: NDArray[np.floating]
    size_m: tuple[float, float]
    height_m: NDArray[np.floating]


def draw_specimens(scene: Scene) -> Scene:
    """Return the scene with the true properties of plates and points; applying this again changes nothing.

    Permittivities are drawn with `specimen_spread` around the nominal values: the real part from a normal distribution
    (at least 1), the loss from a log-normal one; a layer of air is not changed. Shift and tilt of the plane are added
    to those of each plate and point.
    """
    plates = tuple(_move_with_plane(_draw_permittivities(p, i, scene), scene) for i, p in enumerate(scene.plates))
    points = tuple(
        msgspec.structs.replace(p, height_mm=p.height_mm + _find_plane_height_mm(scene, p.position_mm))
        for p in scene.points
    )
    return msgspec.structs.replace(
        scene,
        plates=plates,
        points=points,
        plane_shift_mm=0.0,
        plane_tilt_deg=(0.0, 0.0),
        specimen_spread=(0.0, 0.0),
    )


def facets(plate: Plate, index: int, seed: int) -> Facets:
    """Return the facets of the plate with this index: independent normal heights from the scene's seed.

    A whole number of facets fits the plate, with sides near `rough_length_mm`.
    """
    n = plate.facet_counts
    sx, sy = (side / 1e3 / count for side, count in zip(plate.size_mm, n, strict=True))
    x, y = ((np.arange(count) - (count - 1) / 2) * side for count, side in zip(n, (sx, sy), strict=True))
    height = np.zeros((n[1], n[0]))
    if plate.rough_mm:
        rng = np.random.default_rng([stream_key(seed, "rough"), index])
        height = rng.standard_normal(height.shape) * plate.rough_mm / 1e3
    return Facets(x, y, (sx, sy), height)


def slopes(plate: Plate) -> tuple[float, float]:
    """Return the growth of the plate's height along x and y."""
    return math.tan(math.radians(plate.tilt_deg[0])), math.tan(math.radians(plate.tilt_deg[1]))


def _find_plane_height_mm(scene: Scene, at_mm: Pair) -> float:
    """Return the distance of the shifted and tilted plane behind the nominal one at a place."""
    heights_mm = [math.tan(math.radians(a)) * x for a, x in zip(scene.plane_tilt_deg, at_mm, strict=True)]
    return scene.plane_shift_mm + sum(heights_mm)


def _move_with_plane(plate: Plate, scene: Scene) -> Plate:
    """Return the plate with shift and tilt of the plane added."""
    tilt = plate.tilt_deg
    if any(scene.plane_tilt_deg):
        summed_slopes = [
            math.tan(math.radians(a)) + math.tan(math.radians(b))
            for a, b in zip(tilt, scene.plane_tilt_deg, strict=True)
        ]
        tilt = (math.degrees(math.atan(summed_slopes[0])), math.degrees(math.atan(summed_slopes[1])))
    height_mm = plate.height_mm + _find_plane_height_mm(scene, plate.centre_mm)
    return msgspec.structs.replace(plate, tilt_deg=tilt, height_mm=height_mm)


def _draw_permittivities(plate: Plate, index: int, scene: Scene) -> Plate:
    """Return the plate with drawn permittivities; metal is not changed."""
    if not any(scene.specimen_spread) or plate.metal:
        return plate
    rng = np.random.default_rng([stream_key(scene.seed, "specimen"), index])
    if plate.permittivity is not None:
        return msgspec.structs.replace(plate, permittivity=_vary(plate.permittivity, scene.specimen_spread, rng))
    return msgspec.structs.replace(plate, layers=tuple(_vary_layer(x, scene, rng) for x in plate.layers))


def _vary_layer(layer: Layer, scene: Scene, rng: np.random.Generator) -> Layer:
    """Return the layer with a drawn permittivity. Air is not changed, but numbers are drawn for it, too."""
    varied = _vary(layer.permittivity, scene.specimen_spread, rng)
    if layer.permittivity == _AIR:
        return layer
    return msgspec.structs.replace(layer, permittivity=varied)


def _vary(nominal: Pair, spread: Pair, rng: np.random.Generator) -> Pair:
    """Draw eps' and eps'' around nominal ones, with the relative standard deviations `spread`."""
    # Plain Python numbers, which can be written as JSON.
    real, loss = rng.standard_normal(2).tolist()
    # The log-normal factor has mean 1 and standard deviation spread[1].
    width = math.sqrt(math.log1p(spread[1] ** 2))
    return max(1.0, nominal[0] * (1 + spread[0] * real)), nominal[1] * math.exp(width * loss - width**2 / 2)
