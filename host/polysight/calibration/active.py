"""The active calibration: loaded from the files that a rig file names, copied into each scan, used by processing.

A scan keeps copies of its calibration files in `<scan>/calibration`; the manifest lists them with their digests.
Processing uses the copies, even if the rig file names other files later.
"""

from __future__ import annotations

import shutil
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from polysight.calibration.files import (
    CalibrationFile,
    FilterFile,
    MetalFile,
    PlacesFile,
    places_crc32,
    read_calibration,
    read_metal,
)
from polysight.imaging import ImagedWith, image_grid
from polysight.polarimetry import PlaneReference
from polysight.store import MANIFEST, ScanFolder, Source, inside, manifest
from polysight.sync import HighPass
from polysight_shared.config import Board, Instrument, MountStep
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import ConfigError, DataError
from polysight_shared.tables import to_builtins

FOLDER = "calibration"
FACT = "calibration"


@dataclass(frozen=True)
class Calibration:
    """Measured properties of the rig, by kind; None: not calibrated. `paths` are the files by kind."""

    places: PlacesFile | None = None
    filters: FilterFile | None = None
    metal: MetalFile | None = None
    paths: dict[str, Path] | None = None

    def rig(self, rig: Instrument) -> Instrument:
        """Return the rig with boards and object plane at their measured positions.

        Raises
        ------
        ConfigError
            if mounts, antennas, object distance or filters of the rig file have changed since the calibration.
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
        boards = tuple(self._shifted(b, self.places) for b in rig.boards)
        geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=self.places.object_distance_mm)
        return msgspec.structs.replace(rig, boards=boards, geometry=geometry)

    def _check_filters(self, rig: Instrument) -> None:
        """Raise ConfigError if filters were measured with other programmed corners, or not for every receiver."""
        programmed = [khz for khz in (rig.chirp.hpf1_khz, rig.chirp.hpf2_khz) if khz]
        for board in rig.receivers if self.filters is not None else ():
            found = self.filters.boards.get(board.name) if self.filters else None
            if found is None or [float(khz) for khz in found.programmed_khz if khz] != programmed:
                what = "is not in it" if found is None else f"was measured with {found.programmed_khz} kHz programmed"
                raise ConfigError(
                    f"{self.path('hpf')}: {board.name} {what}, the rig file says {programmed}",
                    "the boards or chirp.hpf1_khz, hpf2_khz were changed after the calibration",
                    "calibrate again with this rig file, or empty calibration.hpf",
                    code=ErrorCode.MISMATCH,
                )

    @staticmethod
    def _shifted(board: Board, places: PlacesFile) -> Board:
        found = places.boards.get(board.name)
        if found is None:
            return board
        return msgspec.structs.replace(board, mount=(*board.mount, MountStep(shift_mm=found.shift_mm)))

    def high_pass(self, board: str) -> HighPass | None:
        """Return the measured filter of a board; None: as programmed."""
        found = None if self.filters is None else self.filters.boards.get(board)
        return None if found is None else HighPass(tuple(1e3 * corner for corner in found.corners_khz))

    def reference(self) -> PlaneReference | None:
        """Return the metal reference, pixel by pixel; None without one. Raises DataError if its images have changed."""
        return None if self.metal is None else read_metal(self.metal, self.path("metal").parent / self.metal.images)

    def high_passes(self, rig: Instrument) -> dict[str, HighPass | None]:
        """Return the measured filter of every receiver, by name; None: as programmed."""
        return {board.name: self.high_pass(board.name) for board in rig.receivers}

    def metal_plane(
        self, rig: Instrument, chosen: PlaneReference | None, in_scene: bool, bands: int
    ) -> PlaneReference | None:
        """Return the metal plate that images are referenced to; None: use metal in the scene.

        Order of precedence: `chosen`, metal in the scene, the calibrated metal reference.

        Parameters
        ----------
        rig
            Calibrated rig of the images.
        chosen
            Reference that the user gave.
        in_scene
            The user gave the position of metal in the scene.
        bands
            Number of imaged sub-bands.

        Raises
        ------
        DataError
            if the metal plate was imaged with another rig, or without these sub-bands.
        """
        plane, name = chosen, "the metal reference"
        if plane is None and not in_scene:
            plane, name = self.reference(), str(self.path("metal"))
        if plane is not None:
            plane.check_rig(self.imaged_with(rig), name)
            plane.check_bands(bands, name)
        return plane

    def imaged_with(self, placed: Instrument) -> ImagedWith:
        """Return the settings that the gains of images depend on; `placed` is a rig that :meth:`rig` returned."""
        return ImagedWith.of(placed, self.high_passes(placed))

    def facts(self) -> dict[str, Any]:
        """Return path, date and origin of the active files, by kind."""
        return {
            kind: {"file": str(self.path(kind)), "made_utc": file.made_utc, "simulated": file.simulated}
            for kind, file in self.files().items()
        }

    def quality_facts(self) -> dict[str, Any]:
        """Return :meth:`facts` as the entry `calibration` of quality.json; empty without files."""
        return {"calibration": self.facts()} if self.files() else {}

    def files(self) -> dict[str, CalibrationFile]:
        """Return the active calibration files by kind."""
        files = {"direct_path": self.places, "hpf": self.filters, "metal": self.metal}
        return {kind: file for kind, file in files.items() if file is not None}

    def path(self, kind: str) -> Path:
        """Return the path of an active file."""
        return (self.paths or {}).get(kind, Path(kind))


def load_calibration(paths: dict[str, Path]) -> Calibration:
    """Load calibration files by kind. Raises ConfigError or DataError for an invalid file."""
    kinds = {"direct_path": PlacesFile, "hpf": FilterFile, "metal": MetalFile}
    found = {kind: read_calibration(path, kinds[kind], kind) for kind, path in paths.items()}
    metal = found.get("metal")
    if metal is not None and Path(metal.images).name != metal.images:
        raise DataError(
            f"{paths['metal']}: the images {metal.images!r} are not in the same folder",
            "the file was changed, or written by another program",
            "calibrate again: `polysight calibrate metal`",
            code=ErrorCode.PATH_OUTSIDE,
        )
    return Calibration(found.get("direct_path"), found.get("hpf"), found.get("metal"), dict(paths))


def calibration_of_rig(rig: Instrument) -> Calibration:
    """Load the calibration files that a rig file names. Raises ConfigError."""
    return load_calibration({kind: Path(name) for kind, name in to_builtins(rig.calibration).items() if name})


def calibration_of_scan(scan: Source) -> Calibration:
    """Load the calibration of a scan: its own copies, or without copies the files that its rig file names.

    Raises
    ------
    ConfigError, DataError
        if a file is invalid, or a copy is missing or was changed.
    """
    if not isinstance(scan, ScanFolder):
        return calibration_of_rig(scan.instrument)
    recorded = scan.started.calibration
    if recorded is None:
        named = {kind: name for kind, name in to_builtins(scan.instrument.calibration).items() if name}
        return load_calibration({kind: inside(scan.path, name) for kind, name in named.items()})
    paths: dict[str, Path] = {}
    for kind, fact in _recorded(scan, recorded).items():
        path = paths[kind] = inside(scan.path, fact["file"])
        if not path.is_file() or f"{zlib.crc32(path.read_bytes()):08x}" != fact["crc32"]:
            raise DataError(
                f"{path}: missing, or changed since the scan was recorded",
                "the calibration file was removed or edited",
                f"restore it from a copy, or from {fact['copied_from']}",
                code=ErrorCode.FILE_DAMAGED,
            )
    return load_calibration(paths)


def _recorded(scan: ScanFolder, recorded: Any) -> dict[str, dict[str, str]]:
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


def checked_calibration(rig: Instrument, simulated: bool) -> Calibration:
    """Load the calibration files that a rig file names, and check that they can be used for a new scan.

    Raises
    ------
    ConfigError, DataError
        if a file is invalid, belongs to another rig, or comes from simulated data while the scan is not `simulated`.
    """
    calibration = calibration_of_rig(rig)
    placed, reference = calibration.rig(rig), calibration.reference()
    if reference is not None:
        reference.check_rig(calibration.imaged_with(placed), str(calibration.path("metal")))
        grid = image_grid(placed)
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
    :func:`checked_calibration`, before anything is copied.
    """
    calibration = checked_calibration(rig, simulated)
    existing = (folder / MANIFEST).exists() and manifest.read(folder / MANIFEST).length > 0
    paths = calibration.paths or {}
    names = [path.name for path in paths.values()]
    facts = {}
    for kind, path in paths.items():
        name = path.name if names.count(path.name) == 1 else f"{kind}-{path.name}"
        copy = folder / FOLDER / name
        if not existing:
            copy.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, copy)
            if kind == "metal" and calibration.metal is not None:
                shutil.copyfile(path.parent / calibration.metal.images, copy.parent / calibration.metal.images)
        facts[kind] = {
            "file": f"{FOLDER}/{name}",
            "crc32": f"{zlib.crc32(path.read_bytes()):08x}",
            "copied_from": str(path),
        }
    return facts
