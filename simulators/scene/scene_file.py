"""The scene file: what lies on the object plane, and what disturbs the rig (docs/spec/scene-file.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from polysight.shared.config import Burst, Grid, Image, Instrument, Stage
from polysight.shared.errors import ConfigError
from polysight.shared.tables import decode, read_toml, to_builtins
from polysight.simulators.scene.draws import stream_key

Positive = Annotated[float, msgspec.Meta(gt=0)]
NonNegative = Annotated[float, msgspec.Meta(ge=0)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=0.5)]
Pair = tuple[float, float]
Degrees = Annotated[float, msgspec.Meta(ge=-10, le=10)]  # of tilt: the fast field is checked up to 2
Tilt = tuple[Degrees, Degrees]
Height = Annotated[float, msgspec.Meta(ge=-50, le=50)]
Decibels = Annotated[float, msgspec.Meta(ge=-40, le=200)]
Spread = Annotated[float, msgspec.Meta(ge=0, le=2)]
_OVERRIDES: dict[str, type] = {"grid": Grid, "burst": Burst, "image": Image, "stage": Stage}


class _Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A table of the scene file: frozen, unknown keys refused."""


def _require(ok: bool, rule: str) -> None:
    if not ok:
        raise ValueError(rule)


def _check_permittivity(pair: Pair) -> None:
    _require(pair[0] >= 1.0, "permittivity's real part must be at least 1")
    _require(pair[1] >= 0.0, "permittivity's second number is the loss eps'' >= 0 of eps' - j eps''")


class Layer(_Table, frozen=True):
    """One layer of a plate; without `thickness_mm` a half space (only the last)."""

    permittivity: Pair
    thickness_mm: Positive | None = None
    name: str = ""

    def __post_init__(self) -> None:
        _check_permittivity(self.permittivity)

    @property
    def epsilon(self) -> complex:
        """Relative permittivity eps' - j eps''."""
        return complex(self.permittivity[0], -self.permittivity[1])


class Plate(_Table, frozen=True):
    """A flat rectangular plate on the object plane, sides along x and y.

    `centre_mm` counts from the image centre (specular midpoint of TX and H at stage offset zero). `permittivity` is
    [eps', eps''] of eps' - j eps''; without `thickness_mm` the plate is a half space (one interface). Instead of it,
    `layers` is a stack in the order the wave meets them, a liquid behind a wall say; air follows the last one unless
    it is a half space. Metal with `strips_deg` is ideal thin strips, turned by so much from the vertical towards +x.

    `height_mm` moves the plate away from the radars (+z), out of the object plane. `tilt_deg` [ax, ay] turns it about
    its own centre: height grows along +x by tan(ax) and along +y by tan(ay). `rough_mm` is the standard deviation of
    its surface's height, in facets of `rough_length_mm`.
    """

    name: str
    centre_mm: Pair
    size_mm: tuple[Positive, Positive]
    permittivity: Pair | None = None
    metal: bool = False
    thickness_mm: Positive | None = None
    layers: tuple[Layer, ...] = ()
    strips_deg: float | None = None
    tilt_deg: Tilt = (0.0, 0.0)
    height_mm: Height = 0.0
    rough_mm: Annotated[float, msgspec.Meta(ge=0, le=5)] = 0.0
    rough_length_mm: Positive = 6.0

    def __post_init__(self) -> None:
        _require(self.strips_deg is None or self.metal, "strips_deg goes with metal = true")
        kinds = (self.metal, self.permittivity is not None, bool(self.layers))
        _require(sum(kinds) == 1, "a plate has one of permittivity = [..], metal = true or [[plates.layers]]")
        _require(
            self.thickness_mm is None or self.permittivity is not None,
            "thickness_mm goes with permittivity, not with metal or layers",
        )
        _require(
            all(layer.thickness_mm is not None for layer in self.layers[:-1]),
            "only the last of [[plates.layers]] may be without thickness_mm",
        )
        if self.permittivity is not None:
            _check_permittivity(self.permittivity)

    @property
    def stack(self) -> tuple[Layer, ...]:
        """Its layers in the order the wave meets them; none for metal."""
        if self.permittivity is not None:
            return (Layer(self.permittivity, self.thickness_mm, self.name),)
        return self.layers


class Point(_Table, frozen=True):
    """An isotropic point scatterer, the same in both polarisations.

    `amplitude` [re, im] is relative to the direct path, reached when the point lies at the specular midpoint.
    `height_mm` moves it away from the radars, out of the object plane.
    """

    position_mm: Pair
    amplitude: Pair = (1.0, 0.0)
    name: str = ""
    height_mm: Height = 0.0


class PerRole(_Table, frozen=True):
    """One number for each board's role."""

    transmit: float = 0.0
    receive_h: float = 0.0
    receive_v: float = 0.0


class Disturbances(_Table, frozen=True):
    """What separates the rig's data from the ideal. Defaults are those of the published rig; OFF is none of it."""

    sync_uncertainty_ns: NonNegative = 5.0
    sync_latency_ns: NonNegative = 160.0
    crystal_ppm: PerRole = PerRole(0.0, 0.8, -1.1)
    if_offset_hz: float = 870e3
    random_phase: bool = True
    bend_hz: float = 300e3
    bend_us: Positive = 20.0
    ripple_hz: float = 3e3
    ripple_us: Positive = 5.0
    hpf: bool = True
    rx_gain_spread_db: NonNegative = 1.0
    rx_phase_spread_deg: NonNegative = 20.0
    hv_gain_db: float = 1.5
    leakage_h: Pair = (0.05, 0.0)
    leakage_v: Pair = (0.05, 0.0)
    burst_motion: bool = True
    direct_snr_db: float | None = 5.5
    adc_full_scale: Positive = 64.0
    packet_loss: Fraction = 0.0
    backlash_mm: float = 0.0
    sync_skew_ns: PerRole = PerRole()
    direct_loss_db: Decibels | Literal["absent"] = 0.0
    leakage_measured: NonNegative | None = None

    @property
    def direct_gain(self) -> float:
        """Amplitude of the direct path relative to a free one; 0 where there is none."""
        return 0.0 if isinstance(self.direct_loss_db, str) else 10 ** (-self.direct_loss_db / 20)


OFF: dict[str, Any] = {
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
    "leakage_h": [0.0, 0.0],
    "leakage_v": [0.0, 0.0],
    "burst_motion": False,
    "direct_snr_db": None,
    "adc_full_scale": 4.0,  # finer steps: 8192 counts for the direct path
    "packet_loss": 0.0,
    "backlash_mm": 0.0,
    "sync_skew_ns": {},
    "direct_loss_db": 0.0,
    "leakage_measured": None,
}


class Scene(_Table, frozen=True):
    """The whole scene file.

    `object_gain` stands for the antenna patterns: gain of every object path over the direct path, which leaves and
    arrives at the edge of the patterns. By default a 45 mm metal plate at the midpoint has 0.75 of the direct path.

    `plane_shift_mm` and `plane_tilt_deg` move and tilt the plane that holds all plates and points, about the image
    centre; signs as of a plate. The rig file keeps its own `object_distance_mm`: nobody measured the true one.
    `specimen_spread` [real, loss] are relative standard deviations of the plates' permittivities from those written.
    """

    name: str
    seed: int = 1
    object_distance_mm: Positive | None = None
    object_gain: Positive = 1.35
    plane_shift_mm: Height = 0.0
    plane_tilt_deg: Tilt = (0.0, 0.0)
    specimen_spread: tuple[Spread, Spread] = (0.0, 0.0)
    grid: dict[str, Any] = {}
    burst: dict[str, Any] = {}
    image: dict[str, Any] = {}
    stage: dict[str, Any] = {}
    plates: tuple[Plate, ...] = ()
    points: tuple[Point, ...] = ()
    disturbances: Disturbances = Disturbances()

    def __post_init__(self) -> None:
        for table, kind in _OVERRIDES.items():
            unknown = sorted(set(getattr(self, table)) - set(kind.__struct_fields__))  # type: ignore[attr-defined]
            _require(not unknown, f"[{table}] holds unknown keys {unknown}; known: {list(kind.__struct_fields__)}")  # type: ignore[attr-defined]

    def with_disturbances(self, **changes: Any) -> Scene:
        """The same scene with single disturbances changed; `ideal=True` switches all off first."""
        base = msgspec.to_builtins(self.disturbances)
        if changes.pop("ideal", False):
            base = dict(OFF, bend_us=base["bend_us"], ripple_us=base["ripple_us"])
        table = decode(_switched({**base, **changes}, "with_disturbances"), Disturbances, "with_disturbances")
        return msgspec.structs.replace(self, disturbances=table)


def _switched(table: Any, source: str) -> Any:
    """`ideal = true` and the words "off"/"on" (or false/true) of a [disturbances] table turned into plain values."""
    if not isinstance(table, dict):
        return table
    given = dict(table)
    ideal = given.pop("ideal", False)
    if not isinstance(ideal, bool):
        raise ConfigError(f"{source}: disturbances.ideal = {ideal!r}", "it is a switch", "write true or false")
    result: dict[str, Any] = dict(OFF) if ideal else {}
    for key, value in given.items():
        if value == "off" or value is False:
            if key not in OFF and key in Disturbances.__struct_fields__:
                raise ConfigError(
                    f"{source}: disturbances.{key} cannot be switched off",
                    "it only shapes another disturbance",
                    f"switch off disturbances.{key.partition('_')[0]}_hz instead",
                )
            result[key] = OFF.get(key, value)
        elif value == "on" or value is True:
            result.pop(key, None)
            if key not in Disturbances.__struct_fields__:
                result[key] = value
        else:
            result[key] = value
    return result


def decode_scene(raw: dict[str, Any], source: str) -> Scene:
    """Check a parsed scene file.

    Raises
    ------
    ConfigError
        naming `source`, the key, its value and the rule that is broken.
    """
    if "disturbances" in raw:
        raw = {**raw, "disturbances": _switched(raw["disturbances"], source)}
    return decode(raw, Scene, source, "docs/spec/scene-file.md names everything that a scene may hold")


def load_scene(path: Path) -> Scene:
    """Read and check a scene file. Raises ConfigError."""
    return decode_scene(read_toml(path), str(path))


def without_offset(scene: Scene) -> Scene:
    """The scene for a rig whose file tells the start frequencies: its own difference of them is in there."""
    return msgspec.structs.replace(scene, disturbances=msgspec.structs.replace(scene.disturbances, if_offset_hz=0.0))


def apply_scene(rig: Instrument, scene: Scene) -> Instrument:
    """The rig with the scene's own grid, burst, image, stage and object distance.

    What the scene switches off, the filter and leakage, this rig does not have: its file says so, or processing would
    take away what was never there. With `leakage_measured` it holds leakage as a calibration would have found it: the
    truth with an error drawn from the scene's seed. Applying the same scene again changes nothing.

    Raises
    ------
    ConfigError
        when an override has a wrong type or breaks a rule of the rig file.
    """
    table = to_builtins(rig)
    for name in _OVERRIDES:
        table[name] = {**table[name], **getattr(scene, name)}
    if scene.object_distance_mm is not None:
        table["geometry"] = {**table["geometry"], "object_distance_mm": scene.object_distance_mm}
    if not scene.disturbances.hpf:
        table["chirp"] = {**table["chirp"], "hpf1_khz": 0.0, "hpf2_khz": 0.0}
    table["polarimetry"] = {**table["polarimetry"], **_known_leakage(scene)}
    told = f"its {', '.join(_OVERRIDES)} change the rig file's; docs/spec/scene-file.md names all keys"
    return decode(table, Instrument, f"scene {scene.name}", told)


def _known_leakage(scene: Scene) -> dict[str, Any]:
    """Keys of the rig file's [polarimetry] that a scene sets: leakage as measured, or none at all."""
    d, parts = scene.disturbances, ("leakage_h", "leakage_v")
    if d.leakage_measured is not None:
        rng = np.random.default_rng(stream_key(scene.seed, "leakage"))
        error = rng.standard_normal((2, 2)) * d.leakage_measured
        found = (np.array([d.leakage_h, d.leakage_v]) + error).tolist()
        return {**dict(zip(parts, found, strict=True)), "leakage_std": d.leakage_measured}
    none = {key: [0.0, 0.0] for key in parts if not any(getattr(d, key))}
    return {**none, "leakage_std": 0.0} if len(none) == len(parts) else none
