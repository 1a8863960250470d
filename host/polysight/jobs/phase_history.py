"""`polysight export SCAN --cphd`: the scan's rows, synchronised and reduced, as CPHD for SAR processors."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from polysight.imaging import scan_offsets_m
from polysight.jobs.process import processed_rows
from polysight.pipeline import Pipeline
from polysight.products import scan_folder_of
from polysight.store import ScanFolder, open_source
from polysight_shared.config import Instrument
from polysight_shared.errors import ConfigError, DataError
from polysight_shared.raster import plan_raster

if TYPE_CHECKING:
    from polysight.report import PhaseHistory

FILE = "phase-history.cphd"


def export_cphd(folder: Path, out: Path | None) -> int:
    """Write `phase-history.cphd` of a scan, or of the scan that products lie in; prints the file.

    Raises
    ------
    DataError
        when there is no scan, or its rows cannot be read.
    ConfigError
        when sarkit is not installed.
    """
    from polysight.report import export_folder, write_cphd

    scan = scan_folder_of(folder)
    if scan is None:
        raise DataError(
            f"{folder}: no rows of a scan",
            "a phase history is made of the rows, not of the images",
            "give the scan folder itself",
        )
    sys.stderr.write(f"writing {FILE}: rows of {scan} ...\n")
    sys.stderr.flush()
    pipeline = processed_rows(open_source(scan, None, dropped=True), scan)
    file = export_folder(folder, out) / FILE
    write_cphd(file, phase_history(pipeline))
    sys.stdout.write(f"{file}\n")
    return 0


def phase_history(pipeline: Pipeline) -> PhaseHistory:
    """The phase history of all rows: gains of the receivers removed, no taper over the aperture.

    Raises
    ------
    ConfigError
        for a mirrored source: x and y of its frame are exchanged, and CPHD knows no such frame.
    """
    from polysight.report import CphdChannel, PhaseHistory

    source, builder = pipeline.source, pipeline.images
    if source.mirrored:
        raise ConfigError(
            f"{source.scan_id}: scanned by columns, in a frame that is mirrored",
            "CPHD describes places on the Earth, and that has no mirror image",
            "export a scan that was taken by rows",
        )
    rig, grid = builder.rig, builder.grid
    offsets, time_s, speed = _met(rig)
    channels, tx_m = [], np.zeros(3)
    for polarisation, board in zip("HV", builder.boards.values(), strict=True):
        antennas, tx_m = board.aperture.antennas, board.aperture.antennas.tx_m
        samples = _in_time(rig, np.moveaxis(board.calibrated(), 1, -1))  # [rx, vector, frequency]
        valid = _in_time(rig, board.valid[None])[0]
        for k, rx_m in enumerate(antennas.rx_m):
            name = f"{board.board.name}-{k + 1}"
            direct_m = float(antennas.direct_m[k])
            channels.append(CphdChannel(name, polarisation, samples[k], rx_m + offsets, direct_m, valid))
    middle = np.array([grid.x_m.mean(), grid.y_m.mean(), float(np.mean(grid.z_m))])
    return PhaseHistory(
        scan_id=source.scan_id,
        simulated=bool(source.simulated),
        started_utc=_started(source),
        channels=channels,
        time_s=time_s,
        tx_m=tx_m + offsets,
        velocity_m_s=speed,
        frequencies_hz=next(iter(builder.boards.values())).aperture.frequencies_hz,
        gate_m=builder.gate_m,
        centre_m=middle,
        shape=grid.shape,
        pixel_m=grid.pixel_m,
    )


def _started(source: object) -> str:
    """Start of the scan; empty if unknown."""
    return source.started.started_utc if isinstance(source, ScanFolder) else ""


def _met(rig: Instrument) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stage offsets [vector, 3], nominal times [vector] and velocities [vector, 3], in the order of time.

    Times are those of a stage that goes from row to row at once, at the speed of a row.
    """
    offsets = scan_offsets_m(rig)
    forward = np.array([row.direction for row in plan_raster(rig.grid)], np.float64)
    offsets = _in_time(rig, np.moveaxis(offsets, -1, 0)).T
    speed = rig.stage.speed_mm_s / 1e3
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(offsets, axis=0), axis=1)])
    velocity = np.zeros_like(offsets)
    velocity[:, 0] = np.repeat(forward * speed, rig.grid.columns)
    return offsets, np.cumsum(way) / speed, velocity


def _in_time(rig: Instrument, values: np.ndarray) -> np.ndarray:
    """Of [any, row, column, ...], columns from the smallest x: [any, vector, ...] in the order of time."""
    out = values.copy()
    for row in plan_raster(rig.grid):
        out[:, row.index] = values[:, row.index][:, :: row.direction]
    return out.reshape(len(out), -1, *values.shape[3:])
