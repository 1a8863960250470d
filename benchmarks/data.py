"""Simulated data of the published rig: a few recorded rows, whole scans made of them, synchronised cubes."""

import itertools
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from polysight.imaging.geometry import Antennas, find_scene_gate_m, image_grid, row_offsets_m
from polysight.store.source import RowData, allocate_pages
from polysight.sync import SyncedRow, sample_frequencies_hz
from polysight_shared.config import Board, Instrument, load_instrument
from polysight_shared.findings import Finding
from polysight_shared.raster import RasterPlan, Row, plan_raster
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene import OwnLayout, Scene, SimulatedRig, apply_scene, load_scene, row_offsets_mm

ROOT = Path(__file__).parents[1]
RIG = ROOT / "instrument.toml"
SCENE = ROOT / "examples" / "nine-materials.toml"
# Rows that are simulated; all others repeat them. Even, so that rows keep their direction.
DISTINCT = 4
# Grid of `--quick`; chosen.
QUICK = {"columns": 40, "rows": 20}


def published_scene(quick: bool = False, **grid: Any) -> tuple[Instrument, Scene]:
    """Return the published rig and grid in front of nine plates; `grid` changes keys of the grid.

    `quick`: a grid and an image that are too small for the figures to mean anything.
    """
    image = {}
    if quick:
        image = {"columns": 30, "rows": 30}
        grid = {**QUICK, **grid}
    scene = msgspec.structs.replace(load_scene(SCENE), grid=grid, image=image)
    return apply_scene(load_instrument(RIG), scene), scene


@contextmanager
def temporary(parent: Path | None) -> Iterator[Path]:
    """Yield a folder for the data, removed afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="polysight-bench-", dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def recorded_rows(rig: Instrument, scene: Scene, count: int = DISTINCT) -> dict[str, list[NDArray[np.int16]]]:
    """Return rows about the middle of the grid as both receivers record them, by board.

    int16 [chirp, sample, 8]: I of the four RX, then their Q.
    """
    radar = SimulatedRig(rig, scene)
    plan = plan_raster(rig.grid)
    # An even row, which runs towards +x.
    first = (plan.rows - count) // 4 * 2
    rows: dict[str, list[NDArray[np.int16]]] = {b.name: [] for b in rig.receivers}
    for row in itertools.islice(plan, first, first + count):
        x, y = row_offsets_mm(radar, row)
        for name, board_rows in rows.items():
            board_rows.append(radar.chirps(name, x, y, first_chirp=row.index * len(x)))
    return rows


def write_scan(folder: Path, rig: Instrument, rows: dict[str, list[NDArray[np.int16]]], count: int) -> None:
    """Write a scan folder of `count` rows, the given ones again and again."""
    plan = plan_raster(rig.grid)
    layout = OwnLayout(folder, rig, plan, "benchmark", "2000-01-01T00:00:00+00:00")
    layout.start()
    for row in itertools.islice(plan, count):
        payloads = {name: board_rows[row.index % len(board_rows)] for name, board_rows in rows.items()}
        layout.write_row(row, payloads, gaps={name: [] for name in payloads})
    layout.end()


@dataclass(frozen=True)
class RepeatedRows:
    """A scan of any size, for `Pipeline`, whose rows all come from a few short files: only its size is real.

    `files` names each board's files of one row each; a row that is longer than the file repeats its positions. All else
    is what :class:`polysight.store.source.Source` asks for.
    """

    instrument: Instrument
    files: dict[str, list[Path]]
    simulated: bool = True
    scan_id: str = "benchmark"
    mirrored: bool = False
    synchronised: bool = False
    manifest_faults: tuple[Finding, ...] = ()

    def recording_facts(self) -> dict[str, Any]:
        return {}

    @property
    def plan(self) -> RasterPlan:
        return plan_raster(self.instrument.grid)

    def rows(self) -> Iterator[int]:
        return iter(range(self.plan.rows))

    def read_row(self, board_name: str, row: int) -> RowData:
        """Return a row of a board."""
        files = self.files[board_name]
        chirps = self.plan.columns * self.instrument.burst.chirps_a_position
        pieces = partial(_read_repeatedly, files[row % len(files)], self.instrument.row_bytes)
        return RowData(pieces, missing=[], frames_expected=chirps)


def _read_repeatedly(path: Path, wanted_bytes: int, size: int) -> Iterator[NDArray[np.uint8]]:
    """Yield pieces of a file of at most `size` bytes (0: one piece), `wanted_bytes` in all; at its end begin again.

    All pieces share their memory.
    """
    memory = allocate_pages(min(size, wanted_bytes) or wanted_bytes)
    with path.open("rb") as file:
        while wanted_bytes:
            piece = memory[:wanted_bytes]
            filled = 0
            while filled < piece.size:
                filled += file.readinto(piece[filled:].data)
                if filled < piece.size:
                    file.seek(0)
            yield piece
            wanted_bytes -= piece.size


def point_row(
    rig: Instrument,
    antennas: Antennas,
    row: Row,
    points_m: NDArray[np.float64],
    frequencies_hz: NDArray[np.float64],
    chosen: NDArray[np.bool_] | None = None,
) -> NDArray[np.complex128]:
    """Return the summed echoes of equal points [n, 3] at the positions of a row, [rx, position, frequency].

    Positions are in the order of the stage; `chosen` is a mask of them. The phase is +2 pi f d / c with d the excess
    path (beyond that of the direct path from TX to RX), as after perfect synchronisation.
    """
    offsets = row_offsets_m(rig, row)
    if chosen is not None:
        offsets = offsets[chosen]
    shift = np.pad(offsets, ((0, 0), (0, 1)))
    offset_m = points_m[None] - shift[:, None]
    path = antennas.excess_m(offset_m[..., 0], offset_m[..., 1], offset_m[..., 2])
    return np.exp(2j * np.pi / SPEED_OF_LIGHT_M_S * path[..., None] * frequencies_hz).sum(axis=2)


def write_point_cube(path: Path, rig: Instrument, board: Board) -> None:
    """Write a synchronised cube of nine points over the image, complex64 [rx, row, column, sample], columns ascending.

    The points' echoes are made at 24 frequencies and interpolated to the chirp's, by a matrix fitted to the echoes of
    200 paths: both chosen, the error is 1e-6.
    """
    grid = image_grid(rig)
    chirp = rig.chirp
    plan = plan_raster(rig.grid)
    antennas = Antennas.from_rig(rig, board)
    quarters = [np.linspace(axis[0], axis[-1], 5)[1:-1] for axis in (grid.x_m, grid.y_m)]
    points = np.array([(x, y, float(np.mean(grid.z_m))) for x in quarters[0] for y in quarters[1]])
    sweep = chirp.first_sample_hz + chirp.hz_per_sample * np.arange(chirp.samples)
    nodes = np.linspace(sweep[0], sweep[-1], 24)
    low, high = find_scene_gate_m((antennas,), plan, grid)
    # An echo's exponent per hertz, [path, 1]; `expand` [node, sample] takes echoes at the nodes to those of the chirp.
    exponent = 2j * np.pi / SPEED_OF_LIGHT_M_S * np.linspace(low, high, 200)[:, None]
    expand = np.linalg.lstsq(np.exp(exponent * nodes), np.exp(exponent * sweep), rcond=1e-9)[0].astype(np.complex64)
    shape = len(antennas.rx_m), plan.rows, plan.columns, chirp.samples
    cube = np.lib.format.open_memmap(path, "w+", np.complex64, shape)
    for row in plan:
        samples = point_row(rig, antennas, row, points, nodes).astype(np.complex64) @ expand
        cube[:, row.index] = samples[:, :: row.direction]
    cube.flush()


def make_synced_row(
    rig: Instrument, samples: NDArray[np.complex64], valid: NDArray[np.bool_] | None = None
) -> SyncedRow:
    """Return the part of a synchronised row that imagers read: samples [rx, position, sample], valid [position].

    Without `turn` the stage's motion in a burst is not undone.
    """
    if valid is None:
        valid = np.ones(samples.shape[1], bool)
    return cast(
        SyncedRow, SimpleNamespace(samples=samples, sweep_hz=sample_frequencies_hz(rig.chirp), valid=valid, turn=None)
    )
