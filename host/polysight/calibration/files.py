"""Calibration files: dated TOML files with sources, values and standard errors, units in the key names.

The gains of a metal plate are arrays and lie in an .npz file beside their TOML file.
"""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import tomli_w
from numpy.typing import NDArray

from polysight.imaging import ImagedWith, SubBand
from polysight.polarimetry import PlaneReference
from polysight.store import open_npz, versions
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError, DeviceError
from polysight_shared.tables import decode, read_toml, to_builtins

FORMAT = 1
IMAGES = ("h", "v", "valid")
MIN_METAL_LEVEL = 0.02
"""Smallest echo of a mirror relative to the direct path; antenna patterns may take some 20 dB."""
Vector = tuple[float, float, float]
F = TypeVar("F", bound="CalibrationFile")


class SourceScan(msgspec.Struct, frozen=True):
    """A scan that a calibration was made from."""

    scan_id: str
    folder: str
    simulated: bool
    rows: int


class CalibrationFile(msgspec.Struct, frozen=True, kw_only=True):
    """Common fields. `kind` is the key in the rig file's [calibration] that names the file."""

    kind: str
    made_utc: str
    sources: list[SourceScan]
    versions: dict[str, str]
    format: int = FORMAT
    note: str = ""

    @property
    def simulated(self) -> bool:
        """True if any of the scans was simulated."""
        return any(s.simulated for s in self.sources)


class BoardPlace(msgspec.Struct, frozen=True):
    """Position of a receiving board: `shift_mm` in the rig frame, added after its mount; direct path to its RX1."""

    shift_mm: Vector
    standard_error_mm: Vector
    direct_path_mm: float
    direct_path_was_mm: float
    direct_path_standard_error_mm: float


class PlacesFile(CalibrationFile, frozen=True, kw_only=True):
    """`direct_path`: receiving boards and object plane relative to the transmitter, which stays as in the rig file.

    `target_mm` [x, y] from the image centre and `target_turn_deg` are the position and rotation of the target
    (by-products). `rig_crc32` is the digest of the rig file's positions, which the shifts are relative to.
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
    """High-pass filter of a receiver: corners of its first-order sections, and the residual of the fit."""

    corners_khz: list[float]
    standard_error_khz: list[float]
    programmed_khz: list[float]
    if_from_khz: float
    if_to_khz: float
    chirps: int
    residual_db: float


class FilterFile(CalibrationFile, frozen=True, kw_only=True):
    """`hpf`: the measured filters of the receivers."""

    boards: dict[str, BoardFilter]


class MetalBand(msgspec.Struct, frozen=True):
    """One sub-band of the metal plate: its frequencies, and the scatter of its pixels."""

    first_hz: float
    last_hz: float
    spread: float
    how: str


class MetalFile(CalibrationFile, frozen=True, kw_only=True):
    """`metal`: gains over the plane, in the file `images` beside this one, and the settings they depend on.

    `imaged_with` is None in files of older releases, which are refused. `bands`: lowest frequency first.
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
    """Start frequency of a receiver: `start_offset_hz` moves its direct path to the middle of the IF band."""

    start_offset_hz: float
    start_offset_was_hz: float
    direct_if_hz: float
    direct_if_standard_error_hz: float
    expected_if_hz: float
    middle_hz: float
    alias: int
    chirps: int


class StartFile(CalibrationFile, frozen=True, kw_only=True):
    """`start_frequency`: values for the [[boards]] tables of the rig file, which does not name this file itself."""

    boards: dict[str, BoardStart]


def header(kind: str, sources: list[SourceScan]) -> dict[str, Any]:
    """Return the common fields of a new file, dated now."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"kind": kind, "made_utc": now, "sources": sources, "versions": versions()}


def places_crc32(rig: Instrument) -> str:
    """Return the digest of a rig's antennas, mounts and object distance."""
    places = [to_builtins(rig.antennas), [[b.name, to_builtins(b)["mount"]] for b in rig.boards]]
    return f"{zlib.crc32(msgspec.json.encode([places, rig.geometry.object_distance_mm])):08x}"


def write_calibration(file: CalibrationFile, out: Path) -> Path:
    """Write a file with a dated name, `<kind>-<time>.toml`, and return its path. Never overwrites a file.

    Raises
    ------
    DeviceError
        if the file cannot be written.
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
        raise DeviceError(f"{out}: {e.strerror}", "wrong path or missing permission", "give another --out") from None
    raise DeviceError(
        f"{out}: has 100 files of {stamp} already",
        "a program calibrates in a loop",
        "give another --out",
        code=ErrorCode.FILE_EXISTS,
    )


def read_calibration(path: Path, kind: type[F], name: str) -> F:
    """Read a calibration file of the kind `name`.

    Raises
    ------
    ConfigError
        if it is missing, of another kind, or of a later format.
    """
    table = read_toml(path)
    if table.get("kind") != name:
        raise ConfigError(
            f"{path}: kind {table.get('kind')!r}, not {name!r}",
            "the file belongs to another key of [calibration]",
            f"give a file that `polysight calibrate {name.replace('_', '-')}` wrote",
            code=ErrorCode.FILE_FOREIGN,
        )
    if table.get("format", FORMAT) > FORMAT:
        raise ConfigError(
            f"{path}: format {table['format']}, this program reads up to {FORMAT}",
            "it was written by a later release",
            "install that release, or calibrate again",
            code=ErrorCode.VERSION_UNSUPPORTED,
        )
    return decode(table, kind, str(path))


def write_metal(reference: PlaneReference, sources: list[SourceScan], out: Path, bands: Sequence[SubBand] = ()) -> Path:
    """Write the gains of a metal plate and their calibration file; return the path of the latter.

    The gains lie beside it under the same name (.npz). `bands` are the sub-bands of `reference.bands`.

    Raises
    ------
    DataError
        if the echo is too weak to be metal.
    DeviceError
        if the files cannot be written.
    """
    facts = reference.facts()
    for channel, image in (("H", reference.h), ("V", reference.v)):
        level = float(np.median(np.abs(image[reference.valid])))
        if level < MIN_METAL_LEVEL:
            raise DataError(
                f"the reference scan shows no metal plate: {channel} has {level:.4f} of a mirror's echo",
                "there was no plate, or it lay too deep or too tilted to reflect the transmitter into the receivers",
                "scan a flat metal plate that covers the plane, larger than the grid on every side",
                code=ErrorCode.NO_DATA,
            )
    file = MetalFile(
        **header("metal", sources),
        images="",
        images_crc32="",
        share_of_plane=facts["share_of_plane"],
        **{key: value for key, value in facts.items() if "_variation_" in key},
        spread=reference.spread,
        how=reference.how,
        imaged_with=reference.made_with,
        bands=[
            MetalBand(band.first_hz, band.last_hz, part.spread, part.how)
            for band, part in zip(bands, reference.bands, strict=True)
        ],
    )
    path = write_calibration(file, out)  # reserves the name
    images = path.with_suffix(".npz")
    try:
        arrays = {name: getattr(reference, name) for name in IMAGES}
        if reference.bands:
            arrays |= {f"band_{n}": np.stack([getattr(part, n) for part in reference.bands]) for n in IMAGES}
        np.savez_compressed(images, x_m=reference.x_m, y_m=reference.y_m, **arrays)
        digest = f"{zlib.crc32(images.read_bytes()):08x}"
        path.unlink()
    except OSError as e:
        path.unlink(missing_ok=True)
        images.unlink(missing_ok=True)
        raise DeviceError(
            f"{images}: {e.strerror}", "the disk is full, or permission is missing", "free space"
        ) from None
    return write_calibration(msgspec.structs.replace(file, images=images.name, images_crc32=digest), out)


def read_metal(file: MetalFile, images: Path) -> PlaneReference:
    """Read the metal reference from a calibration file and its images, with sub-bands.

    Raises
    ------
    DataError
        if the images are missing or do not belong to the file.
    """
    if not images.is_file() or f"{zlib.crc32(images.read_bytes()):08x}" != file.images_crc32:
        raise DataError(
            f"{images}: missing, or other images than those of the calibration file",
            "one of the two files was moved or replaced",
            "copy both, or calibrate again",
            code=ErrorCode.FILE_DAMAGED,
        )
    with open_npz(images) as f:
        arrays: dict[str, NDArray[Any]] = dict(f)
    whole = PlaneReference(
        *(arrays[name] for name in IMAGES),
        x_m=arrays["x_m"],
        y_m=arrays["y_m"],
        spread=file.spread,
        how=file.how,
        made_with=file.imaged_with,
    )
    parts = (
        replace(whole, spread=band.spread, how=band.how, **{n: arrays[f"band_{n}"][k] for n in IMAGES})
        for k, band in enumerate(file.bands)
    )
    return replace(whole, bands=tuple(parts))
