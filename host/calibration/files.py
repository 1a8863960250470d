"""The dated files of `polysight calibrate`: TOML, units in the key names, where they come from, how sure it is."""

from __future__ import annotations

import zlib
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import tomli_w

from polysight.host.imaging import ImagedWith
from polysight.host.store import versions
from polysight.shared.config import Instrument
from polysight.shared.errors import ConfigError, DeviceError
from polysight.shared.tables import decode, read_toml, to_builtins

FORMAT = 1
Vector = tuple[float, float, float]
F = TypeVar("F", bound="CalibrationFile")


class SourceScan(msgspec.Struct, frozen=True):
    """A scan that was looked at."""

    scan_id: str
    folder: str
    simulated: bool
    rows: int


class CalibrationFile(msgspec.Struct, frozen=True, kw_only=True):
    """What every file has. `kind` is the key of the rig file's [calibration] that takes it."""

    kind: str
    made_utc: str
    sources: list[SourceScan]
    versions: dict[str, str]
    format: int = FORMAT
    note: str = ""

    @property
    def simulated(self) -> bool:
        """Whether any of it comes from simulated data."""
        return any(s.simulated for s in self.sources)


class BoardPlace(msgspec.Struct, frozen=True):
    """Where a receiving board is: `shift_mm` in the rig frame, to be added behind its mount; the path to its RX1."""

    shift_mm: Vector
    standard_error_mm: Vector
    direct_path_mm: float
    direct_path_was_mm: float
    direct_path_standard_error_mm: float


class PlacesFile(CalibrationFile, frozen=True, kw_only=True):
    """`direct_path`: receiving boards and object plane relative to the transmitter, whose place is taken as it is.

    `target_mm` is where the target lay, [x, y] from the image centre, `target_turn_deg` how it was turned: by-products.
    `rig_crc32` is of the places that the rig file gave: the shifts count from them.
    """

    rig_crc32: str
    boards: dict[str, BoardPlace]
    object_distance_mm: float
    object_distance_was_mm: float
    object_distance_standard_error_mm: float
    target_mm: tuple[float, float]
    target_standard_error_mm: tuple[float, float]
    target_turn_deg: float
    target_turn_standard_error_deg: float
    explained: float
    points: int


class BoardFilter(msgspec.Struct, frozen=True):
    """A receiver's high-pass filter: corners of its first-order sections, and how well they fit the sweep."""

    corners_khz: list[float]
    standard_error_khz: list[float]
    programmed_khz: list[float]
    if_from_khz: float
    if_to_khz: float
    chirps: int
    residual_db: float


class FilterFile(CalibrationFile, frozen=True, kw_only=True):
    """`hpf`: the receivers' filters as measured."""

    boards: dict[str, BoardFilter]


class MetalBand(msgspec.Struct, frozen=True):
    """One sub-band of the plate: its frequencies, and the scatter of its own pixels."""

    first_hz: float
    last_hz: float
    spread: float
    how: str


class MetalFile(CalibrationFile, frozen=True, kw_only=True):
    """`metal`: gains over the plane, in the file `images` beside this one, and the rig they belong to.

    `imaged_with` is None in files of older releases, which are refused. `bands` are sub-bands, lowest frequency first.
    """

    images: str
    images_crc32: str
    share_of_plane: float
    h_variation_db: float
    v_variation_db: float
    ratio_variation_db: float
    ratio_variation_deg: float
    spread: float
    how: str
    imaged_with: ImagedWith | None = None
    bands: list[MetalBand] = []


class BoardStart(msgspec.Struct, frozen=True):
    """A receiver's start frequency: `start_offset_hz` puts its direct path in the middle of the band."""

    start_offset_hz: float
    start_offset_was_hz: float
    direct_if_hz: float
    direct_if_standard_error_hz: float
    expected_if_hz: float
    middle_hz: float
    alias: int
    chirps: int


class StartFile(CalibrationFile, frozen=True, kw_only=True):
    """`start_frequency`: what to write into the [[boards]] tables. For the record: no key of the rig file takes it."""

    boards: dict[str, BoardStart]


def head(kind: str, sources: list[SourceScan]) -> dict[str, Any]:
    """What every file begins with, made now."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"kind": kind, "made_utc": now, "sources": sources, "versions": versions()}


def places_crc32(rig: Instrument) -> str:
    """Digest of what a rig file says of places: antennas, mounts, object plane."""
    places = [to_builtins(rig.antennas), [[b.name, to_builtins(b)["mount"]] for b in rig.boards]]
    return f"{zlib.crc32(msgspec.json.encode([places, rig.geometry.object_distance_mm])):08x}"


def write(file: CalibrationFile, out: Path) -> Path:
    """Write a file under a dated name, `<kind>-<time>.toml`; never over another one. Returns its path.

    Raises
    ------
    DeviceError
        when it cannot be written.
    """
    stamp = datetime.fromisoformat(file.made_utc).strftime("%Y%m%dT%H%M%SZ")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for n in range(100):
            path = out / f"{file.kind.replace('_', '-')}-{stamp}{f'-{n}' if n else ''}.toml"
            try:
                with path.open("xb") as f:
                    f.write(tomli_w.dumps(to_builtins(file)).encode())
                return path
            except FileExistsError:
                continue
    except OSError as e:
        raise DeviceError(f"{out}: {e.strerror}", "a path or a permission", "give another --out") from None
    raise DeviceError(f"{out}: a hundred files of {stamp}", "a loop?", "give another --out")


def read(path: Path, kind: type[F], name: str) -> F:
    """Read a file.

    Raises
    ------
    ConfigError
        when it is absent, not of this kind, or of a later format.
    """
    table = read_toml(path)
    if table.get("kind") != name:
        raise ConfigError(
            f"{path}: kind {table.get('kind')!r}, not {name!r}",
            "the file belongs to another key of [calibration]",
            f"give a file that `polysight calibrate {name.replace('_', '-')}` wrote",
        )
    if table.get("format", FORMAT) > FORMAT:
        raise ConfigError(
            f"{path}: format {table['format']}, this program reads up to {FORMAT}",
            "it was written by a later release",
            "install that release, or calibrate again",
        )
    return decode(table, kind, str(path))
