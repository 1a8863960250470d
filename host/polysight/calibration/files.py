"""Calibration files, the active calibration of a scan, and the recorded scans that calibrations are made from.

Files are dated TOML files with sources, values and standard errors, units in the key names. The gains of a metal plate
are arrays and lie in an .npz file next to their TOML file.

The rig file names the files that apply. A scan keeps copies of them in `<scan>/calibration`; the manifest lists them
with their digests. Processing uses the copies, even if the rig file names other files later.
"""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
import tomli_w
from numpy.typing import NDArray

from polysight.capture import view_row_words
from polysight.imaging import ImagedWith, SubBand, image_grid
from polysight.polarimetry import PlaneReference
from polysight.results import CalibrationSource
from polysight.store import (
    MANIFEST,
    RawSource,
    ScanFolder,
    Source,
    check_inside,
    manifest,
    open_npz,
    open_source,
    raw_source,
    versions,
)
from polysight.sync import HighPass
from polysight_shared.config import Board, Instrument, MountStep
from polysight_shared.errors import ConfigError, DataError, DeviceError, ErrorCode, quote
from polysight_shared.tables import decode, read_toml, to_builtins

FORMAT = 1
"""Latest format of calibration files; files of later ones are refused."""
IMAGE_ARRAYS = ("h", "v", "valid")
"""Arrays of a `PlaneReference` in the .npz file."""
MIN_METAL_LEVEL = 0.02
"""Smallest echo of a mirror relative to the direct path; antenna patterns may take some 20 dB; chosen."""
COPIES_FOLDER = "calibration"
"""Folder of the copies in a scan's folder."""
# x, y, z.
Vector = tuple[float, float, float]
F = TypeVar("F", bound="CalibrationFile")


class SourceScan(msgspec.Struct, frozen=True):
    """A scan that a calibration was made from: name, folder, and the number of its rows."""

    scan_id: str
    folder: str
    simulated: bool
    rows: int


class CalibrationFile(msgspec.Struct, frozen=True, kw_only=True):
    """Fields that all files have.

    `kind` is the key in the rig file's [calibration] that names the file (`start_frequency` has no such key),
    `made_utc` date and time in ISO 8601, `versions` are those of the programs, `format` is that of the file.
    """

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
    """Position of a receiving board, relative to that in the rig file."""

    shift_mm: Vector
    """In the rig frame, added after the board's mount."""
    standard_error_mm: Vector
    """Standard error of each component of the shift."""
    direct_path_mm: float
    """Length of the direct path from the transmitter to the board's RX1."""
    direct_path_was_mm: float
    """Length of the direct path according to the rig file."""
    direct_path_standard_error_mm: float
    """Standard error of the length."""


class PlacesFile(CalibrationFile, frozen=True, kw_only=True):
    """`direct_path`: receiving boards and object plane relative to the transmitter, which stays as in the rig file.

    Fields with `was` are the rig file's values. `target_mm` [x, y] from the image centre and `target_turn_deg` are the
    position and rotation of the target (by-products). `rig_crc32` is the digest of the rig file's positions, which the
    shifts are relative to. `explained` is the share of the measured power that the fit explains, at `points` points.
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
    """High-pass filter of a receiver, as measured."""

    # Corners of its first-order sections, and their standard errors.
    corners_khz: list[float]
    standard_error_khz: list[float]
    # Corners set in the rig file.
    programmed_khz: list[float]
    # Range of the direct path that the fit is based on.
    if_from_khz: float
    if_to_khz: float
    # Number of chirps with a direct path.
    chirps: int
    # Root mean square of the measured levels minus those of the fitted filter.
    residual_db: float


class FilterFile(CalibrationFile, frozen=True, kw_only=True):
    """`hpf`: the measured filters of the receivers, by board name."""

    boards: dict[str, BoardFilter]


class MetalBand(msgspec.Struct, frozen=True):
    """One sub-band of the metal plate: its frequencies, and `spread` and `how` of its `PlaneReference`."""

    first_hz: float
    last_hz: float
    spread: float
    how: str


class MetalFile(CalibrationFile, frozen=True, kw_only=True):
    """`metal`: gains over the plane, in the file `images` of the same folder, and the settings they depend on.

    `images` is the file's name without a folder, `images_crc32` its digest. The shares, variations and the spread are
    those of :meth:`PlaneReference.facts`, `how` is a sentence for the report. `imaged_with` is None in files of older
    releases, which are refused. `bands`: lowest frequency first.
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
    # Rise along the plane of incidence and across it; files of earlier releases do not have it.
    tilt_deg: tuple[float, float] = (0.0, 0.0)


class SphereFile(CalibrationFile, frozen=True, kw_only=True):
    """`sphere`: points of a metal sphere, the reference of surfaces; gains follow from them with the current rig.

    `points` is channel ("h", "v") to points. A point has twelve numbers: stage offset x, y, z; path (m), its slope x, y
    and its curvature xx, xy, yy (1 / m); real part, imaginary part and standard deviation of the amplitude. A
    thirteenth is the amplitude's rise over the band (`surfaces.window.Echoes.band_rise`), which files of earlier
    releases do not have. `radius_mm` is the true radius, `radius_found_mm` that by the curvature of the points.
    `centre_mm` (rig frame) lies one true radius behind the points, whose distances from the sphere have the median
    deviation `misfit_mm`. `gain_std` is the standard deviation of ln(H / V).
    """

    radius_mm: float
    radius_found_mm: float
    centre_mm: Vector
    misfit_mm: float
    gain_std: float
    points: dict[str, list[list[float]]]


class BoardStart(msgspec.Struct, frozen=True):
    """Start frequency of a receiver: `start_offset_hz` moves its direct path to the middle of the IF band."""

    start_offset_hz: float
    # Value of the rig file that the scan was made with.
    start_offset_was_hz: float
    # Measured IF of the direct path, as sampled (it may be aliased).
    direct_if_hz: float
    direct_if_standard_error_hz: float
    # IF of the direct path by the rig file.
    expected_if_hz: float
    # Middle of the IF band.
    middle_hz: float
    # Number of sample rates by which the direct path was aliased.
    alias: int
    # Number of chirps with a direct path.
    chirps: int


class StartFile(CalibrationFile, frozen=True, kw_only=True):
    """`start_frequency`: values for the [[boards]] tables of the rig file, which does not name this file itself."""

    boards: dict[str, BoardStart]


def make_header(kind: str, sources: list[SourceScan]) -> dict[str, Any]:
    """Return the common fields of a new file, dated now."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    return {"kind": kind, "made_utc": now, "sources": sources, "versions": versions()}


def places_crc32(rig: Instrument) -> str:
    """Return the digest of a rig's antennas, mounts and object distance."""
    places = [to_builtins(rig.antennas), [[b.name, to_builtins(b)["mount"]] for b in rig.boards]]
    return f"{zlib.crc32(msgspec.json.encode([places, rig.geometry.object_distance_mm])):08x}"


def write_calibration(file: CalibrationFile, out: Path) -> Path:
    """Write a file with a dated name, `<kind>-<time>.toml`, and return its path. Never overwrites a file.

    Raises DeviceError if the file cannot be written.
    """
    stamp = datetime.fromisoformat(file.made_utc).strftime("%Y%m%dT%H%M%SZ")
    name = f"{file.kind.replace('_', '-')}-{stamp}"
    try:
        out.mkdir(parents=True, exist_ok=True)
        # Files of the same second get a number.
        for ending in ("", *(f"-{number}" for number in range(1, 100))):
            path = out / f"{name}{ending}.toml"
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


def read_calibration(path: Path, file_type: type[F], kind: str) -> F:
    """Read a calibration file of this kind, whose class is `file_type`.

    Raises ConfigError if it is missing, of another kind, or of a later format.
    """
    table = read_toml(path)
    if table.get("kind") != kind:
        raise ConfigError(
            f"{path}: kind {table.get('kind')!r}, not {kind!r}",
            "the file belongs to another key of [calibration]",
            f"give a file that `polysight calibrate {kind.replace('_', '-')}` wrote",
            code=ErrorCode.FILE_FOREIGN,
        )
    if table.get("format", FORMAT) > FORMAT:
        raise ConfigError(
            f"{path}: format {table['format']}, this program reads up to {FORMAT}",
            "it was written by a later release",
            "install that release, or calibrate again",
            code=ErrorCode.VERSION_UNSUPPORTED,
        )
    return decode(table, file_type, str(path))


def write_metal(reference: PlaneReference, sources: list[SourceScan], out: Path, bands: Sequence[SubBand] = ()) -> Path:
    """Write the gains of a metal plate and their calibration file; return the path of the latter.

    The gains lie in the same folder under the same name (.npz). `bands` are the sub-bands of `reference.bands`.

    Raises
    ------
    DataError
        if the echo is too weak to be metal.
    DeviceError
        if the files cannot be written.
    """
    facts = msgspec.structs.asdict(reference.facts())
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
        **make_header("metal", sources),
        images="",
        images_crc32="",
        share_of_plane=facts["share_of_plane"],
        **{name: value for name, value in facts.items() if "_variation_" in name},
        spread=reference.spread,
        how=reference.how,
        imaged_with=reference.made_with,
        tilt_deg=facts["tilt_deg"],
        bands=[
            MetalBand(band.first_hz, band.last_hz, part.spread, part.how)
            for band, part in zip(bands, reference.bands, strict=True)
        ],
    )
    # The file without images reserves the name; it is written again when the images are complete.
    path = write_calibration(file, out)
    images = path.with_suffix(".npz")
    try:
        arrays = {name: getattr(reference, name) for name in IMAGE_ARRAYS}
        if reference.bands:
            arrays |= {f"band_{n}": np.stack([getattr(part, n) for part in reference.bands]) for n in IMAGE_ARRAYS}
        if reference.dispersion is not None:
            arrays["dispersion"] = np.array(reference.dispersion)
        np.savez_compressed(images, x_m=reference.x_m, y_m=reference.y_m, **arrays)
        digest = _compute_crc32(images)
        path.unlink()
    except OSError as e:
        path.unlink(missing_ok=True)
        images.unlink(missing_ok=True)
        raise DeviceError(
            f"{images}: {e.strerror}", "the disk is full, or permission is missing", "free space"
        ) from None
    return write_calibration(msgspec.structs.replace(file, images=images.name, images_crc32=digest), out)


def _compute_crc32(path: Path) -> str:
    """Return the digest of a file, eight hexadecimal digits."""
    return f"{zlib.crc32(path.read_bytes()):08x}"


def read_metal(file: MetalFile, images: Path) -> PlaneReference:
    """Read the metal reference from a calibration file and its images, with sub-bands.

    Raises DataError if the images are missing or do not belong to the file.
    """
    if not images.is_file() or _compute_crc32(images) != file.images_crc32:
        raise DataError(
            f"{images}: missing, or other images than those of the calibration file",
            "one of the two files was moved or replaced",
            "copy both, or calibrate again",
            code=ErrorCode.FILE_DAMAGED,
        )
    with open_npz(images) as f:
        arrays: dict[str, NDArray[Any]] = dict(f)
    dispersion = None
    # Files of earlier releases have no dispersion.
    if "dispersion" in arrays:
        dispersion_h, dispersion_v = arrays["dispersion"].tolist()
        dispersion = (dispersion_h, dispersion_v)
    reference = PlaneReference(
        *(arrays[name] for name in IMAGE_ARRAYS),
        x_m=arrays["x_m"],
        y_m=arrays["y_m"],
        spread=file.spread,
        how=file.how,
        made_with=file.imaged_with,
        dispersion=dispersion,
        rise=(float(np.radians(file.tilt_deg[0])), float(np.radians(file.tilt_deg[1]))),
    )
    band_references = (
        replace(reference, spread=band.spread, how=band.how, **{n: arrays[f"band_{n}"][k] for n in IMAGE_ARRAYS})
        for k, band in enumerate(file.bands)
    )
    return replace(reference, bands=tuple(band_references))


@dataclass(frozen=True)
class Calibration:
    """Calibration files of a rig; None for uncalibrated parts. `paths` are their paths by kind."""

    places: PlacesFile | None = None
    filters: FilterFile | None = None
    metal: MetalFile | None = None
    sphere: SphereFile | None = None
    paths: dict[str, Path] | None = None

    def rig(self, rig: Instrument) -> Instrument:
        """Return the rig with boards and object plane at their measured positions.

        Raises ConfigError if mounts, antennas, object distance or filters of the rig file have changed since the
        calibration.
        """
        self._check_filters(rig)
        if self.places is None:
            return rig
        if places_crc32(rig) != self.places.rig_crc32:
            raise ConfigError(
                f"{self.path('direct_path')}: made for other mounts, antennas or another object distance",
                "the rig file was changed after the calibration",
                "calibrate again with this rig file, or empty calibration.direct_path",
                code=ErrorCode.MISMATCH,
            )
        boards = tuple(self._shift_board(b, self.places) for b in rig.boards)
        geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=self.places.object_distance_mm)
        return msgspec.structs.replace(rig, boards=boards, geometry=geometry)

    def _check_filters(self, rig: Instrument) -> None:
        """Raise ConfigError if filters were measured with other programmed corners, or not for every receiver."""
        if self.filters is None:
            return
        programmed = [khz for khz in (rig.chirp.hpf1_khz, rig.chirp.hpf2_khz) if khz]
        for board in rig.receivers:
            board_filter = self.filters.boards.get(board.name)
            if board_filter is None:
                difference = "is not in it"
            elif [float(khz) for khz in board_filter.programmed_khz if khz] != programmed:
                difference = f"was measured with {board_filter.programmed_khz} kHz programmed"
            else:
                continue
            raise ConfigError(
                f"{self.path('hpf')}: {board.name} {difference}, the rig file says {programmed}",
                "the boards or chirp.hpf1_khz, hpf2_khz were changed after the calibration",
                "calibrate again with this rig file, or empty calibration.hpf",
                code=ErrorCode.MISMATCH,
            )

    @staticmethod
    def _shift_board(board: Board, places: PlacesFile) -> Board:
        """Return a board at its measured position: a shift is added after the steps of its mount."""
        board_place = places.boards.get(board.name)
        if board_place is None:
            return board
        return msgspec.structs.replace(board, mount=(*board.mount, MountStep(shift_mm=board_place.shift_mm)))

    def high_pass(self, board: str) -> HighPass | None:
        """Return the measured filter of a board; None: as programmed."""
        board_filter = None if self.filters is None else self.filters.boards.get(board)
        if board_filter is None:
            return None
        return HighPass(tuple(1e3 * corner for corner in board_filter.corners_khz))

    def reference(self) -> PlaneReference | None:
        """Return the metal reference, pixel by pixel; None without one. Raises DataError if its images have changed."""
        if self.metal is None:
            return None
        return read_metal(self.metal, self.path("metal").parent / self.metal.images)

    def high_passes(self, rig: Instrument) -> dict[str, HighPass | None]:
        """Return the measured filter of every receiver, by name; None: as programmed."""
        return {board.name: self.high_pass(board.name) for board in rig.receivers}

    def metal_plane(
        self, rig: Instrument, chosen: PlaneReference | None, in_scene: bool, bands: int
    ) -> PlaneReference | None:
        """Return the metal plate that images are referenced to; None: use metal in the scene.

        Order of precedence: `chosen` by the user, metal in the scene (`in_scene`: the user gave its position), the
        calibrated metal reference. `rig` is the calibrated rig of the images, `bands` the number of sub-bands needed.

        Raises DataError if the metal plate was imaged with another rig, or without these sub-bands.
        """
        plane = chosen
        name = "the metal reference"
        if plane is None and not in_scene:
            plane = self.reference()
            name = str(self.path("metal"))
        if plane is not None:
            plane.check_rig(self.describe_imaging(rig), name)
            plane.check_bands(bands, name)
        return plane

    def describe_imaging(self, placed: Instrument) -> ImagedWith:
        """Return the settings that the gains of images depend on; `placed` is a rig that :meth:`rig` returned."""
        return ImagedWith.from_rig(placed, self.high_passes(placed))

    def list_sources(self) -> dict[str, CalibrationSource]:
        """Return path, date and origin of the active files, by kind, for quality.json."""
        return {
            kind: CalibrationSource(str(self.path(kind)), file.made_utc, file.simulated)
            for kind, file in self.files().items()
        }

    def files(self) -> dict[str, CalibrationFile]:
        """Return the active calibration files by kind."""
        files = {"direct_path": self.places, "hpf": self.filters, "metal": self.metal, "sphere": self.sphere}
        return {kind: file for kind, file in files.items() if file is not None}

    def path(self, kind: str) -> Path:
        """Return the path of an active file of this kind; the kind itself if no path is known."""
        return (self.paths or {}).get(kind, Path(kind))


def load_calibration(paths: dict[str, Path]) -> Calibration:
    """Load calibration files, kind to path. Raises ConfigError or DataError for an invalid file."""

    def load(kind: str, file_type: type[F]) -> F | None:
        return read_calibration(paths[kind], file_type, kind) if kind in paths else None

    metal = load("metal", MetalFile)
    if metal is not None and Path(metal.images).name != metal.images:
        raise DataError(
            f"{paths['metal']}: the images {metal.images!r} are not in the same folder",
            "the file was changed, or written by another program",
            "calibrate again: `polysight calibrate metal`",
            code=ErrorCode.PATH_OUTSIDE,
        )
    return Calibration(
        places=load("direct_path", PlacesFile),
        filters=load("hpf", FilterFile),
        metal=metal,
        sphere=load("sphere", SphereFile),
        paths=dict(paths),
    )


def load_rig_calibration(rig: Instrument) -> Calibration:
    """Load the calibration files that a rig file names. Raises ConfigError or DataError for an invalid file."""
    return load_calibration({kind: Path(name) for kind, name in to_builtins(rig.calibration).items() if name})


def load_scan_calibration(scan: Source) -> Calibration:
    """Load the calibration of a scan: the copies in its folder, or without copies the files that its rig file names.

    If the scan is a scan folder, those files have to lie in it.

    Raises ConfigError or DataError if a file is invalid, or a copy is missing or was changed.
    """
    if not isinstance(scan, ScanFolder):
        return load_rig_calibration(scan.instrument)
    recorded = scan.started.calibration
    if recorded is None:
        names_by_kind = {kind: name for kind, name in to_builtins(scan.instrument.calibration).items() if name}
        return load_calibration({kind: check_inside(scan.path, name) for kind, name in names_by_kind.items()})
    paths: dict[str, Path] = {}
    for kind, entry in _read_manifest_entries(scan, recorded).items():
        path = check_inside(scan.path, entry["file"])
        paths[kind] = path
        if not path.is_file() or _compute_crc32(path) != entry["crc32"]:
            raise DataError(
                f"{path}: missing, or changed since the scan was recorded",
                "the calibration file was removed or edited",
                f"restore it from a copy, or from {entry['copied_from']}",
                code=ErrorCode.FILE_DAMAGED,
            )
    return load_calibration(paths)


def _read_manifest_entries(scan: ScanFolder, recorded: Any) -> dict[str, dict[str, str]]:
    """Return the manifest's entries for the scan's copies, by kind. Raises DataError if they are invalid."""
    try:
        return msgspec.convert(recorded, dict[str, dict[str, str]])
    except msgspec.ValidationError as e:
        raise DataError(
            f"{scan.path / MANIFEST}: invalid entry for the calibration: {e}",
            "the manifest was written by another program, or changed",
            "restore it from a copy",
            code=ErrorCode.FILE_DAMAGED,
        ) from None


def load_checked_calibration(rig: Instrument, simulated: bool) -> Calibration:
    """Load the calibration files that a rig file names, and check that they can be used for a new scan.

    Raises ConfigError or DataError if a file is invalid, belongs to another rig, or comes from simulated data while the
    scan is not `simulated`.
    """
    calibration = load_rig_calibration(rig)
    measured_rig = calibration.rig(rig)
    reference = calibration.reference()
    if reference is not None:
        reference.check_rig(calibration.describe_imaging(measured_rig), str(calibration.path("metal")))
        grid = image_grid(measured_rig)
        reference.check_axes(grid.x_m, grid.y_m)
    for kind, file in calibration.files().items():
        if file.simulated and not simulated:
            raise ConfigError(
                f"{calibration.path(kind)}: made from simulated data",
                "simulated data do not describe a real rig",
                f"calibrate with the rig, or empty calibration.{kind}",
                code=ErrorCode.MISMATCH,
            )
    return calibration


def copy_into_scan(rig: Instrument, folder: Path, simulated: bool) -> dict[str, Any]:
    """Copy the active calibration files into a new scan's folder; return the entry for its manifest, by kind.

    Nothing is copied into a folder that holds a scan already: creating the scan will raise the error. Raises like
    :func:`load_checked_calibration`, before anything is copied.
    """
    calibration = load_checked_calibration(rig, simulated)
    holds_scan = (folder / MANIFEST).exists() and manifest.read(folder / MANIFEST).length > 0
    paths = calibration.paths or {}
    names = [path.name for path in paths.values()]
    entries = {}
    for kind, path in paths.items():
        name = path.name if names.count(path.name) == 1 else f"{kind}-{path.name}"
        copy = folder / COPIES_FOLDER / name
        if not holds_scan:
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
            if kind == "metal" and calibration.metal is not None:
                shutil.copyfile(path.parent / calibration.metal.images, copy.parent / calibration.metal.images)
        entries[kind] = {
            "file": f"{COPIES_FOLDER}/{name}",
            "crc32": _compute_crc32(path),
            "copied_from": str(path),
        }
    return entries


def open_raw(folder: Path, rig: Instrument | None = None) -> RawSource:
    """Open a recorded scan with raw data; `rig` is for recordings without a rig file.

    Raises DataError if it has no raw data, or no complete row.
    """
    source = raw_source(open_source(folder, rig), folder)
    if next(iter(source.rows()), None) is None:
        raise DataError(
            f"{folder}: no complete row",
            "the scan was stopped in its first row, or files are missing",
            f"`polysight resume {quote(folder)}` records the missing rows",
            code=ErrorCode.NO_DATA,
        )
    return source


def make_source_entry(source: RawSource, folder: Path) -> SourceScan:
    """Return the entry of a scan in the `sources` of a calibration file."""
    return SourceScan(source.scan_id, str(folder), source.simulated, len(list(source.rows())))


def read_board_rows(
    source: RawSource, board: str, limit: int | None = None
) -> Iterator[tuple[int, NDArray[np.int16], NDArray[np.bool_]]]:
    """Yield index, words int16 [chirp, sample, 2, rx] (I before Q) and valid bool [chirp] of a board's rows.

    With a `limit`, at most this number of rows is read, evenly spaced.
    """
    rows = list(source.rows())
    if limit is not None and len(rows) > limit:
        evenly_spaced = np.linspace(0, len(rows) - 1, limit).round().astype(int)
        rows = [rows[i] for i in evenly_spaced]
    for row in rows:
        recorded = source.read_row(board, row)
        samples = source.instrument.chirp.samples
        rx = len(source.instrument.antennas.rx_mm)
        yield row, *view_row_words(recorded.payload, recorded.missing, recorded.frames_expected, samples, rx)
