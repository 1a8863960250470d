"""The calibration in force: read from the files a rig file names, copied into each scan, applied by processing.

A scan keeps copies of what it was taken with, in `<scan>/calibration`, named with their digests in its manifest; its
processing uses these, whatever the rig file says later.
"""

from __future__ import annotations

import shutil
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from polysight.host.calibration.files import FilterFile, MetalFile, PlacesFile, places_crc32, read
from polysight.host.imaging import ImagedWith, image_grid
from polysight.host.store import MANIFEST, ScanFolder, inside, manifest
from polysight.shared.config import Board, Instrument, MountStep
from polysight.shared.errors import ConfigError, DataError
from polysight.shared.tables import to_builtins

if TYPE_CHECKING:
    from polysight.host.polarimetry import PlaneReference
    from polysight.host.sync import HighPass

FOLDER = "calibration"
FACT = "calibration"


@dataclass(frozen=True)
class Calibration:
    """What is known better than the rig file says; None where nothing is. `paths` are where it was read."""

    places: PlacesFile | None = None
    filters: FilterFile | None = None
    metal: MetalFile | None = None
    paths: dict[str, Path] | None = None

    def rig(self, rig: Instrument) -> Instrument:
        """The rig with boards and object plane where they were found to be.

        Raises
        ------
        ConfigError
            when the rig file's own places are not those that the calibration counts from, or its filters not those
            that were measured.
        """
        self._check_filters(rig)
        if self.places is None:
            return rig
        if places_crc32(rig) != self.places.rig_crc32:
            raise ConfigError(
                f"{self._path('direct_path')}: made for other mounts, antennas or another object distance",
                "the rig file was changed after the calibration",
                "calibrate again with this rig file, or empty calibration.direct_path",
            )
        boards = tuple(self._shifted(b, self.places) for b in rig.boards)
        geometry = msgspec.structs.replace(rig.geometry, object_distance_mm=self.places.object_distance_mm)
        return msgspec.structs.replace(rig, boards=boards, geometry=geometry)

    def _check_filters(self, rig: Instrument) -> None:
        """Refuse filters that were measured with other corners programmed, or not on every receiver."""
        programmed = [khz for khz in (rig.chirp.hpf1_khz, rig.chirp.hpf2_khz) if khz]
        for board in rig.receivers if self.filters is not None else ():
            found = self.filters.boards.get(board.name) if self.filters else None
            if found is None or [float(khz) for khz in found.programmed_khz if khz] != programmed:
                what = "is not in it" if found is None else f"was measured with {found.programmed_khz} kHz programmed"
                raise ConfigError(
                    f"{self._path('hpf')}: {board.name} {what}, the rig file says {programmed}",
                    "the boards or chirp.hpf1_khz, hpf2_khz were changed after the calibration",
                    "calibrate again with this rig file, or empty calibration.hpf",
                )

    @staticmethod
    def _shifted(board: Board, places: PlacesFile) -> Board:
        found = places.boards.get(board.name)
        if found is None:
            return board
        return msgspec.structs.replace(board, mount=(*board.mount, MountStep(shift_mm=found.shift_mm)))

    def high_pass(self, board: str) -> HighPass | None:
        """A board's filter as measured; None: as programmed."""
        from polysight.host.sync import HighPass

        found = None if self.filters is None else self.filters.boards.get(board)
        return None if found is None else HighPass(tuple(1e3 * corner for corner in found.corners_khz))

    def reference(self) -> PlaneReference | None:
        """Metal over the plane, pixel by pixel. Raises DataError when its images are not what the file names."""
        if self.metal is None:
            return None
        from polysight.host.calibration.metal import read_metal

        return read_metal(self.metal, self._path("metal").parent / self.metal.images)

    def high_passes(self, rig: Instrument) -> dict[str, HighPass | None]:
        """Every receiver's filter as measured; None: as programmed."""
        return {board.name: self.high_pass(board.name) for board in rig.receivers}

    def metal_plane(
        self, rig: Instrument, chosen: PlaneReference | None, in_scene: bool, bands: int
    ) -> PlaneReference | None:
        """Metal scanned on its own that images of a rig are referenced to; None: metal in the scene is.

        Parameters
        ----------
        rig
            Of the images, calibrated.
        chosen
            The scan of metal that was asked for.
        in_scene
            Metal in the scene was named (a box): it comes before the calibration, and after `chosen`.
        bands
            Sub-bands that are imaged.

        Raises
        ------
        DataError
            when the metal was imaged with another rig, or without these sub-bands.
        """
        plane, name = chosen, "the metal reference"
        if plane is None and not in_scene:
            plane, name = self.reference(), self.name_of("metal")
        if plane is not None:
            plane.check_rig(self.imaged_with(rig), name)
            plane.check_bands(bands, name)
        return plane

    def imaged_with(self, placed: Instrument) -> ImagedWith:
        """What the gains of images depend on; `placed` is a rig that :meth:`rig` made."""
        return ImagedWith.of(placed, self.high_passes(placed))

    def facts(self) -> dict[str, Any]:
        """The active files by kind: path, when each was made, and whether from simulated data."""
        kinds = {"direct_path": self.places, "hpf": self.filters, "metal": self.metal}
        return {
            kind: {"file": str(self._path(kind)), "made_utc": file.made_utc, "simulated": file.simulated}
            for kind, file in kinds.items()
            if file is not None
        }

    def quality_facts(self) -> dict[str, Any]:
        """For quality.json: :meth:`facts` as `calibration`; empty when there are none."""
        active = self.facts()
        return {"calibration": active} if active else {}

    def name_of(self, kind: str) -> str:
        """The file of a kind, for messages."""
        return str(self._path(kind))

    def _path(self, kind: str) -> Path:
        return (self.paths or {}).get(kind, Path(kind))


def load_calibration(paths: dict[str, Path]) -> Calibration:
    """Read the files, by kind. Raises ConfigError naming the one that is not what it should be."""
    kinds = {"direct_path": PlacesFile, "hpf": FilterFile, "metal": MetalFile}
    found = {kind: read(path, kinds[kind], kind) for kind, path in paths.items()}
    metal = found.get("metal")
    if metal is not None and Path(metal.images).name != metal.images:
        raise DataError(
            f"{paths['metal']}: its images are {metal.images!r}, which is no file beside it",
            "it was changed, or made by another program",
            "calibrate again: `polysight calibrate metal`",
        )
    return Calibration(found.get("direct_path"), found.get("hpf"), found.get("metal"), dict(paths))


def of_rig(rig: Instrument) -> Calibration:
    """What a rig file names. Raises ConfigError."""
    return load_calibration({kind: Path(name) for kind, name in to_builtins(rig.calibration).items() if name})


def of_scan(scan: Any) -> Calibration:
    """What a scan was taken with: its own copies, or where it has none, what its rig file names.

    Raises
    ------
    ConfigError, DataError
        when a file is not what it should be, or a copy was changed.
    """
    facts = scan.facts("scan_started") if isinstance(scan, ScanFolder) else []
    recorded = facts[0].get(FACT) if facts else None
    if not isinstance(scan, ScanFolder):
        return of_rig(scan.instrument)
    if recorded is None:
        named = {kind: name for kind, name in to_builtins(scan.instrument.calibration).items() if name}
        return load_calibration({kind: inside(scan.path, name) for kind, name in named.items()})
    paths: dict[str, Path] = {}
    for kind, fact in _recorded(scan, recorded).items():
        path = paths[kind] = inside(scan.path, fact["file"])
        if not path.is_file() or f"{zlib.crc32(path.read_bytes()):08x}" != fact["crc32"]:
            raise DataError(
                f"{path}: absent, or not the calibration that the scan was taken with",
                "the file was removed or changed",
                f"restore it from a copy, or from {fact['copied_from']}",
            )
    return load_calibration(paths)


def _recorded(scan: ScanFolder, recorded: Any) -> dict[str, dict[str, str]]:
    """The fact of a manifest that names a scan's own copies. Raises DataError when it has another form."""
    try:
        return msgspec.convert(recorded, dict[str, dict[str, str]])
    except msgspec.ValidationError as e:
        raise DataError(
            f"{scan.path / MANIFEST}: what it says of the calibration has another form: {e}",
            "the manifest was made by another program or changed",
            "restore it from a copy",
        ) from None


def checked(rig: Instrument, simulated: bool) -> Calibration:
    """What a rig file names, ready to be used by a scan that is simulated or not.

    Raises
    ------
    ConfigError, DataError
        when a file is not what it should be, is of another rig, or comes from simulated data and the scan does not.
    """
    calibration = of_rig(rig)
    placed, reference = calibration.rig(rig), calibration.reference()
    if reference is not None:
        reference.check_rig(calibration.imaged_with(placed), calibration.name_of("metal"))
        grid = image_grid(placed)
        reference.check_axes(grid.x_m, grid.y_m)
    for kind, fact in calibration.facts().items():
        if fact["simulated"] and not simulated:
            raise ConfigError(
                f"{fact['file']}: made from simulated data",
                "it says nothing about a real rig",
                f"calibrate with the rig, or empty calibration.{kind}",
            )
    return calibration


def keep_in_scan(rig: Instrument, folder: Path, simulated: bool) -> dict[str, Any]:
    """Copy what is in force into a new scan's folder; returns the fact for its manifest, by kind.

    A folder that holds a scan already is left alone: making the scan will refuse it. Raises as :func:`checked`, before
    anything is copied.
    """
    calibration = checked(rig, simulated)
    taken = (folder / MANIFEST).exists() and manifest.read(folder / MANIFEST).length > 0
    paths = calibration.paths or {}
    names = [path.name for path in paths.values()]
    facts = {}
    for kind, path in paths.items():
        name = path.name if names.count(path.name) == 1 else f"{kind}-{path.name}"
        copy = folder / FOLDER / name
        if not taken:
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
