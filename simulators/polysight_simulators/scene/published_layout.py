"""Write the layouts of the published data set: `unsynced/<scan>` folders, and `raw/` cubes.

The byte formats follow the description of the data set, implemented independently of the host. Cubes are simulated
echoes after ideal synchronisation.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight_shared.config import Board, Instrument
from polysight_shared.files import named
from polysight_shared.raster import Row
from polysight_shared.units import SPEED_OF_LIGHT_M_S
from polysight_simulators.scene.cubes import reference_cube
from polysight_simulators.scene.layouts import Gaps, blank, new_folder, packet_payload_bytes
from polysight_simulators.scene.optics import antennas, direct_factor
from polysight_simulators.scene.radar import sample_frequencies_hz
from polysight_simulators.scene.scene_file import Scene, apply_scene

Complex = NDArray[np.complexfloating]
Skipped = Mapping[tuple[str, int], Collection[int]]
LATE_S = 2.0
"""Delay after which a card sends the last, incomplete packet (observed on a DCA1000)."""


class AuthorsLayout:
    """Writer of the published raw layout: `unsynced/<scan>/<board>/<x>_<y>.bin`, packet logs and three JSON files.

    Parameters
    ----------
    path, rig, scan_id, started_s
        Folder, rig, name of the scan, and Unix time of the first packet.
    zero_filling
        Write zeros for lost packets; otherwise leave them out.
    by_columns
        The stage runs along y: rows are columns of the grid.
    skipped
        Points of a row, by board name and row, at which the radar did not start; the file has no data of them.
    """

    def __init__(
        self,
        path: Path,
        rig: Instrument,
        scan_id: str,
        started_s: float,
        zero_filling: bool = True,
        by_columns: bool = False,
        skipped: Skipped | None = None,
    ) -> None:
        self.folder = path / "unsynced" / scan_id
        self._rig, self._by_columns, self._skipped = rig, by_columns, skipped or {}
        self._now_s, self._zero_filling = started_s, zero_filling

    def start(self) -> None:
        """Create the folder and write the three JSON files. Raises DataError if it is not empty."""
        new_folder(self.folder)
        write_settings(self.folder, self._rig, self._zero_filling, self._by_columns)

    def write_row(self, row: Row, payloads: dict[str, NDArray[np.int16]], gaps: dict[str, Gaps]) -> None:
        """Write one file per board, named by the grid index of the row's start, and its packet log."""
        step_s = abs(row.step_mm) / self._rig.stage.speed_mm_s
        start = row.column(0)
        stem = f"{row.index}_{start}" if self._by_columns else f"{start}_{row.index}"
        for name, payload in payloads.items():
            skipped = self._skipped.get((name, row.index), frozenset())
            points = [i for i in range(row.points) if i not in skipped]
            sent = payload.reshape(row.points, -1, *payload.shape[1:])[points]
            lost = [(a, min(b, sent.nbytes)) for a, b in gaps[name] if a < sent.nbytes]
            folder = self.folder / name
            folder.mkdir(exist_ok=True)
            raw = blank(sent, lost)
            if not self._zero_filling:
                ends = [0, *(e for gap in lost for e in gap), len(raw)]
                kept = [raw[a:b] for a, b in zip(ends[::2], ends[1::2], strict=True)]
            else:
                kept = [raw]
            with named(folder / f"{stem}.bin"):
                (folder / f"{stem}.bin").write_bytes(b"".join(kept))
            (folder / f"{stem}_log.csv").write_text(self._log(len(raw), lost, points, step_s), encoding="ascii")
        self._now_s += row.points * step_s + LATE_S + 2.0

    def end(self) -> None:
        """Write nothing more."""

    def _log(self, size: int, lost: Gaps, points: list[int], step_s: float) -> str:
        """Return a line for each packet received: sequence number, payload bytes, Unix time.

        The last, incomplete packet is late, for the card sends it after a timeout; the authors' decoder needs that.
        """
        full, frame = packet_payload_bytes(self._rig), self._rig.frame_bytes
        pulses, period_s = self._rig.burst.pulses, self._rig.burst.period_us * 1e-6
        gone = {start // full for a, b in lost for start in range(a - a % full, b, full)}
        lines = []
        for k, start in enumerate(range(0, size, full)):
            if k in gone:
                continue
            stop = min(start + full, size)
            position, chirp = divmod((stop - 1) // frame, pulses)
            at_s = self._now_s + points[position] * step_s + chirp * period_s + 2e-4
            if stop - start < full:
                at_s += LATE_S
            lines.append(f"{k + 1},{stop - start},{at_s:.6f}\n")
        return "".join(lines)


def write_settings(folder: Path, rig: Instrument, zero_filling: bool, by_columns: bool) -> None:
    """Write the three JSON files of a scan."""
    for name, content in (
        ("data_collection_cfg", _collection(rig, folder.name, zero_filling, by_columns)),
        ("devices_comm_cfg", _devices(rig)),
        ("radar_id", _radars(rig)),
    ):
        (folder / f"{name}.json").write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")


def _collection(rig: Instrument, scan: str, zero_filling: bool, by_columns: bool) -> dict[str, Any]:
    h, v = rig.receivers
    tilt = [s.shift_mm for s in h.mount if s.shift_mm is not None][-2]
    return {
        "dx": rig.grid.step_x_mm,
        "dy": rig.grid.step_y_mm,
        "total_x": rig.grid.columns,
        "total_y": rig.grid.rows,
        "moving_direction": "col" if by_columns else "row",
        "num_trigger": rig.burst.pulses,
        "period_frame": rig.burst.period_us / 1e3,
        "num_frame": rig.burst.pulses,
        "num_chirp": 1,
        "num_config": 1,
        "num_adc": rig.chirp.samples,
        "num_ch": len(rig.antennas.rx_mm),
        "packet_zero_filling": zero_filling,
        "object_distance": rig.geometry.object_distance_mm,
        "board_dist": (_last_shift(h) - _last_shift(rig.transmitter)) / 1e3,
        "txboard_angle_y": _turn(rig.transmitter, "y", -1),
        "rxboard_v_angle_y": _turn(v, "y", 0),
        "rxboard_angle_y": _turn(h, "y", -1),
        "rxboard_angle_z": _turn(h, "z", -1),
        "rxboard_tilt_offset": list(tilt),
        "description": f"simulated: {scan}",
    }


def _devices(rig: Instrument) -> dict[str, Any]:
    c = rig.chirp
    chirp = {
        "f0": c.start_hz,
        "slope": c.slope_hz_per_s,
        "ramp_time": c.ramp_end_us * 1e-6,
        "adc_start_time": c.adc_start_us * 1e-6,
        "num_adc": c.samples,
        "Fs": c.sample_rate_hz,
        "activated_tx": [rig.transmitter.tx_antenna],
    }
    return {"activated_radar": list(range(len(rig.boards))), "chirp_configs": [chirp]}


def _radars(rig: Instrument) -> dict[str, Any]:
    return {
        str(i): {
            "idx": i,
            "name": b.name,
            "ip": b.card_address,
            "cfg_port": b.command_port,
            "data_port": b.data_port,
        }
        for i, b in enumerate(rig.boards)
    }


def _turn(board: Board, axis: str, which: int) -> float:
    """Return a mount's rotation about an axis, degrees; 0 without one."""
    turns = [s.turn_deg for s in board.mount if s.about == axis and s.turn_deg is not None]
    return turns[which] if turns else 0.0


def _last_shift(board: Board) -> float:
    """Return the last shift of a mount along x, mm: the origin of the board."""
    shifts = [s.shift_mm[0] for s in board.mount if s.shift_mm is not None]
    return shifts[-1] if shifts else 0.0


def write_cube(
    rig: Instrument,
    scene: Scene,
    out: Path,
    keep_direct: bool = True,
    from_transmitter: bool = False,
    conjugate: bool = False,
    common_reference: bool = False,
    by_columns: bool = False,
) -> Path:
    """Write a cube in `out`/raw/<scan> and return the folder.

    Parameters
    ----------
    rig, scene, out
        Rig and scene (its overrides are applied, its disturbances ignored), and the output folder.
    keep_direct
        Include the direct path.
    from_transmitter
        Phases are 2 pi f tau; otherwise 2 pi f (tau - tau_direct) with each RX's own direct path.
    common_reference
        Use the direct path of RX1 for all RX.
    conjugate
        Phases have the opposite sign.
    by_columns
        Write this into the settings; the travel in a burst is still along x.
    """
    name = "".join(c if c.isalnum() else "-" for c in scene.name).strip("-") or "scene"
    folder = out / "raw" / name
    new_folder(folder)
    rig = apply_scene(rig, scene)
    write_settings(folder, rig, zero_filling=True, by_columns=by_columns)
    f = sample_frequencies_hz(rig)
    for board_name, cube in reference_cube(rig, scene).items():
        board = rig.by_name(board_name)
        direct_m = antennas(rig, board).direct_m
        if keep_direct:
            cube += (direct_factor(board, scene) * direct_m[0] / direct_m).astype(np.complex64)[:, None, None, None]
        away = direct_m if from_transmitter else direct_m - direct_m[0] if common_reference else 0 * direct_m
        cube *= np.exp(2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(away, f)).astype(np.complex64)[:, None, None]
        np.save(folder / f"{board_name}_synced.npy", cube.conj() if conjugate else cube)
    return folder
