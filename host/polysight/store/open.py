"""Open recorded data of any layout, recognised by the folder's files."""

from __future__ import annotations

from pathlib import Path

from polysight.store.manifest import MANIFEST
from polysight.store.published import SYNCED, PublishedCubes, PublishedScan
from polysight.store.published_rig import COLLECTION
from polysight.store.raw import require_raw
from polysight.store.scan_folder import ScanFolder
from polysight.store.source import Source
from polysight_shared.config import Instrument, load_instrument
from polysight_shared.errors import DataError, ErrorCode, make_missing_path_error


def is_source(path: Path) -> bool:
    """True if the folder is a scan folder, or `unsynced/<scan>` or `raw/<scan>` of the published data."""
    names = (MANIFEST, COLLECTION)
    return path.is_dir() and (any((path / name).exists() for name in names) or any(path.glob("*" + SYNCED)))


def open_source(path: Path, base: Instrument | Path | None = None, dropped: bool = False) -> Source:
    """Open a recorded scan.

    Parameters
    ----------
    path
        A scan folder, or the authors' `unsynced/<scan>` or `raw/<scan>`.
    base
        Rig, or rig file, with the geometry, stage and limits of an authors' scan, which their files lack.
    dropped
        Accept a scan whose raw data was dropped.

    Raises
    ------
    DataError
        if it is not one of them, its raw rows were dropped, or an authors' scan is opened without `base`.
    ConfigError
        if the rig file is wrong.
    """
    if (path / MANIFEST).exists():
        scan = ScanFolder.load(path)
        if not dropped:
            require_raw(scan)
        return scan
    if not path.exists():
        raise make_missing_path_error(path)
    if not is_source(path):
        raise DataError(
            f"{path}: not a scan: contains no {MANIFEST}, {COLLECTION} or *{SYNCED}",
            "the path is wrong, or the download is not complete",
            "give a scan folder, or a folder unsynced/<scan> or raw/<scan> of the published data (polysight process:"
            " also labels/<scan>, or a folder of such folders)",
            code=ErrorCode.FILE_FOREIGN,
        )
    if base is None:
        raise DataError(
            f"{path}: the published data does not contain the rig's geometry",
            "no rig file was given",
            "give the instrument.toml of the published rig (on the command line --config FILE)",
            code=ErrorCode.KEY_MISSING,
        )
    if isinstance(base, Path):
        rig = load_instrument(base)
    else:
        rig = base
    if any(path.glob("*" + SYNCED)):
        return PublishedCubes(path, rig)
    return PublishedScan(path, rig)
