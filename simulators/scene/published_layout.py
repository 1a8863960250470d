"""Write the layouts of the published data set: `unsynced/<scan>` folders, `raw/` cubes, `labels/` and `materials/`.

The byte formats follow the description of the data set, implemented independently of the host. Cubes are simulated
echoes after ideal synchronisation. The images of `labels/` and the pixels of `materials/` are not imaged but drawn:
Fresnel reflection of each box with speckle and phase errors. They are test files of the exact format with known truth.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polysight.shared.config import Board, Instrument
from polysight.shared.files import named
from polysight.shared.raster import Row
from polysight.shared.units import SPEED_OF_LIGHT_M_S
from polysight.simulators.scene.cubes import reference_cube
from polysight.simulators.scene.layouts import Gaps, blank, new_folder, packet_payload_bytes
from polysight.simulators.scene.optics import antennas, direct_factor, half_space
from polysight.simulators.scene.radar import sample_frequencies_hz
from polysight.simulators.scene.scene_file import Scene, apply_scene

Complex = NDArray[np.complexfloating]
Skipped = Mapping[tuple[str, int], Collection[int]]
PIXELS = 150  # per side of an image
METAL = "copper"
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


@dataclass(frozen=True)
class Material:
    """A material of drawn files; without permittivity it is metal."""

    name: str
    permittivity: complex | None
    thickness_mm: float | None = None

    def reflection(self, angle_deg: float) -> tuple[complex, complex]:
        """Return r_s and r_p."""
        if self.permittivity is None:
            return -1.0 + 0j, -1.0 + 0j
        r_s, r_p = half_space(self.permittivity, np.radians(angle_deg))
        return complex(r_s), complex(r_p)


@dataclass(frozen=True)
class Errors:
    """Errors of a drawn pixel: relative amplitude and phase (rad); half of the variance is common to a box.

    `leakage` is the amplitude of p in H and of s in V.
    """

    amplitude: float = 0.009
    phase_rad: float = 0.022
    leakage: float = 0.0


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


def draw_pixels(
    material: Material, angle_deg: float, n: int, errors: Errors, rng: np.random.Generator
) -> tuple[Complex, Complex]:
    """Draw H and V of n pixels of a box, complex64 [n], with unit gain."""
    r_s, r_p = material.reflection(angle_deg)
    out = []
    for signal in (r_s + errors.leakage * r_p, r_p + errors.leakage * r_s):
        parts = [
            std * np.sqrt(0.5) * (rng.standard_normal() + rng.standard_normal(n))
            for std in (errors.amplitude, errors.phase_rad)
        ]
        out.append((signal * (1 + parts[0]) * np.exp(1j * parts[1])).astype(np.complex64))
    return out[0], out[1]


def write_material(
    folder: Path, material: Material, angle_deg: float, scan: str, pixels: int, errors: Errors, seed: int
) -> Path:
    """Write `folder`/<name>_<angle>.pkl with its own metal reference; further files are numbered."""
    rng = np.random.default_rng(seed)
    gain_h, gain_v = (rng.uniform(0.5, 2.0) * np.exp(2j * np.pi * rng.uniform()) for _ in range(2))
    values = []
    for what in (material, Material(METAL, None)):
        h, v = draw_pixels(what, angle_deg, pixels, errors, rng)
        h, v = (h * gain_h).astype(np.complex64), (v * gain_v).astype(np.complex64)
        values.append([h / v, h, v])
    content = {
        "name": material.name,
        "thickness": material.thickness_mm,
        "collection_name": scan,
        "incident_angle": round(angle_deg),
        "ref_name": METAL,
        "ref_thickness": 1.0,
        "values": values[0],
        "ref_values": values[1],
        "simulated": True,
    }
    folder.mkdir(parents=True, exist_ok=True)
    safe = "".join(c if c.isalnum() or c in "-." else "-" for c in material.name).strip("-")
    path = folder / f"{safe}_{angle_deg:.0f}.pkl"
    for number in range(2, 1000):
        if not path.exists():
            break
        path = folder / f"{safe}_{angle_deg:.0f}_{number}.pkl"
    path.write_bytes(pickle.dumps(content))
    return path


def write_labels(
    folder: Path,
    scan: str,
    boxes: Mapping[str, Sequence[int]],
    materials: Mapping[str, Material],
    angle_deg: float,
    errors: Errors,
    seed: int,
    upside_down: bool = False,
) -> Path:
    """Write `folder`/<scan> with sar_h.npy, sar_v.npy and <scan>.json; return the folder.

    Parameters
    ----------
    folder, scan
        Output folder, and name of the scan.
    boxes, materials
        Name to pixel corners [x0, y0, x1, y1] (half-open), and name to material.
    angle_deg, errors, seed
        Incidence angle, errors, and their seed.
    upside_down
        The images' rows run opposite to the boxes' y.
    """
    rng = np.random.default_rng(seed)
    path = folder / scan
    path.mkdir(parents=True)
    images = [
        0.001 * (rng.standard_normal((PIXELS, PIXELS)) + 1j * rng.standard_normal((PIXELS, PIXELS))) for _ in "hv"
    ]
    gains = [rng.uniform(0.5, 2.0) * np.exp(2j * np.pi * rng.uniform()) for _ in "hv"]
    distance = np.exp(2j * np.pi * np.add.outer(*2 * [np.arange(PIXELS) / 31.0]))  # a phase common to both channels
    for name, (x0, y0, x1, y1) in boxes.items():
        h, v = draw_pixels(materials[name], angle_deg, (x1 - x0) * (y1 - y0), errors, rng)
        for image, pixels in zip(images, (h, v), strict=True):
            image[y0:y1, x0:x1] += pixels.reshape(y1 - y0, x1 - x0)
    for key, image, gain in zip(("sar_h", "sar_v"), images, gains, strict=True):
        whole = (gain * image * distance).astype(np.complex64)
        np.save(path / f"{key}.npy", whole[::-1] if upside_down else whole)
    content = {
        "description": f"simulated: {scan}, incidence {angle_deg:.0f} deg",
        "labels": {name: list(box) for name, box in boxes.items()},
        "sar_config": _sar_config(),
    }
    (path / f"{scan}.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return path


def _sar_config() -> dict[str, Any]:
    """Return the keys of the published files."""
    focus = {"alignment_configs": {}, "sar_focuse_center": [0.0, 0.0, 0.0]}
    return {
        "numX": 350,
        "numY": 200,
        "dx": 2,
        "dy": 2,
        "output_size_x": 2 * PIXELS,
        "output_size_y": 2 * PIXELS,
        "chirp_configs": [],
        "ant_locs": {},
        "tx_idx": 1,
        "RH_config": focus,
        "RV_config": focus,
    }
