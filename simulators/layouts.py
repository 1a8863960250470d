"""Writers of simulated scans: this project's scan folder, and the authors' `unsynced/<scan>` folder.

The byte formats are docs/spec/scan-folder.md and the published data set's description; written here independently
of the host that reads them.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Protocol
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from shared import __version__
from shared.config import Board, Instrument, to_builtins
from shared.errors import DataError
from shared.messages import AnyEvent, Capture, RowFinished, RowStarted, RunStarted, RunStopped, pack_kept
from shared.raster import RasterPlan, Row, burst_duration_s
from shared.units import NS_PER_S, us_to_ns

Gaps = list[tuple[int, int]]
_HEADER_BYTES = 10  # sequence and byte count before each packet's payload


class Layout(Protocol):
    """Where simulated rows go."""

    def start(self) -> None:
        """Begin the scan."""
        ...

    def write_row(self, row: Row, payloads: dict[str, NDArray[np.int16]], gaps: dict[str, Gaps]) -> None:
        """One row: int16 [frames, samples, 8] and the lost byte ranges of each board."""
        ...

    def end(self) -> None:
        """End the scan."""
        ...


def versions() -> dict[str, str]:
    """Release that made the data; the distributions are released together."""
    return {"polysight": __version__}


def packet_payload_bytes(rig: Instrument) -> int:
    """Payload of a full data packet: what the card is told, less the header, at most 1456 (DCA1000)."""
    return min(rig.card.packet_bytes - _HEADER_BYTES - 4, 1456)


def _blank(payload: NDArray[np.int16], gaps: Gaps) -> bytes:
    raw = bytearray(payload.astype("<i2", copy=False).tobytes())
    for start, stop in gaps:
        raw[start:stop] = bytes(stop - start)
    return bytes(raw)


def _new_folder(path: Path) -> None:
    if path.exists() and any(path.iterdir()):
        raise DataError(f"{path}: the folder is not empty", "an earlier run", "choose another --out, or empty it")
    path.mkdir(parents=True, exist_ok=True)


class OwnLayout:
    """A scan folder of this project: manifest.jsonl, events.msgpack, raw/<board>/<row>.bin and .idx."""

    def __init__(self, path: Path, rig: Instrument, plan: RasterPlan, scan_id: str, started_utc: str) -> None:
        self._path, self._rig, self._plan = path, rig, plan
        self._scan_id, self._started_utc = scan_id, started_utc
        self._seq, self._now_ns = 0, NS_PER_S

    def start(self) -> None:
        """Make the folder; note the start in manifest and events. Raises DataError when it is not empty."""
        _new_folder(self._path)
        self._fact(
            "scan_started",
            format=1,
            scan_id=self._scan_id,
            simulated=True,
            started_utc=self._started_utc,
            instrument=to_builtins(self._rig),
            plan=to_builtins(self._plan),
            versions=versions(),
        )
        self._event(RunStarted(plan=self._plan, **self._stamp()))

    def write_row(self, row: Row, payloads: dict[str, NDArray[np.int16]], gaps: dict[str, Gaps]) -> None:
        """Write one committed row and the events the Pi would have sent."""
        pulses = self._rig.burst.pulses
        boards = {}
        for name, payload in payloads.items():
            raw = _blank(payload, gaps[name])
            file = Path("raw") / name / f"{row.index:04d}.bin"
            (self._path / file).parent.mkdir(parents=True, exist_ok=True)
            (self._path / file).write_bytes(raw)
            missing = sum(stop - start for start, stop in gaps[name])
            partial = {
                f for a, b in gaps[name] for f in range(a // self._rig.frame_bytes, -(-b // self._rig.frame_bytes))
            }
            facts = {
                "frames_expected": row.points * pulses,
                "bytes": len(raw),
                "missing": gaps[name],
            }
            index = _index(facts)
            (self._path / file.with_suffix(".idx")).write_bytes(index)
            boards[name] = {
                "file": str(file),
                "bytes": len(raw),
                "frames_expected": row.points * pulses,
                "frames_received": row.points * pulses - len(partial),
                "missing_bytes": missing,
                "crc32": f"{crc32(raw):08x}",
                "index_crc32": f"{crc32(index):08x}",
            }
        self._row_events(row)
        self._fact(
            "row_committed", row=row.index, take=1, direction=row.direction, boards=boards, pulses=row.points * pulses
        )

    def end(self) -> None:
        """Note the end."""
        self._event(RunStopped(exit_status="success", **self._stamp()))
        self._fact("scan_ended", exit_status="success", reason="")

    def _fact(self, fact: str, **content: Any) -> None:
        record = {"fact": fact, **content}
        plain = json.dumps(record, sort_keys=True, separators=(",", ":"))
        record["crc"] = f"{crc32(plain.encode()):08x}"
        with (self._path / "manifest.jsonl").open("a", encoding="utf-8") as f:
            f.write(json.dumps(record, sort_keys=True, separators=(",", ":")) + "\n")

    def _event(self, *events: AnyEvent) -> None:
        with (self._path / "events.msgpack").open("ab") as f:
            f.write(b"".join(map(pack_kept, events)))

    def _stamp(self) -> dict[str, Any]:
        self._seq += 1
        return {"scan_id": self._scan_id, "seq": self._seq, "t_mono_ns": self._now_ns}

    def _row_events(self, row: Row) -> None:
        burst, stage = self._rig.burst, self._rig.stage
        events: list[AnyEvent] = [RowStarted(row=row, take=1, **self._stamp())]
        between_ns = round(abs(row.step_mm) / stage.speed_mm_s * NS_PER_S)
        first_ns = self._now_ns + NS_PER_S
        for i in range(row.points):
            edge_ns = first_ns + i * between_ns
            pulse_ns = edge_ns + us_to_ns(20.0)
            self._now_ns = pulse_ns + round(burst_duration_s(burst) * NS_PER_S)
            events.append(
                Capture(
                    row_index=row.index,
                    take=1,
                    point=i,
                    column=row.column(i),
                    edge_ns=edge_ns,
                    first_pulse_ns=pulse_ns,
                    last_pulse_ns=self._now_ns,
                    pulses=burst.pulses,
                    width_max_ns=us_to_ns(burst.width_us),
                    jitter_ns=0,
                    **self._stamp(),
                )
            )
        self._now_ns += NS_PER_S
        events.append(
            RowFinished(
                row_index=row.index,
                take=1,
                status="done",
                points=row.points,
                edges=row.points,
                bursts=row.points,
                pulses=row.points * burst.pulses,
                **self._stamp(),
            )
        )
        self._event(*events)


def _index(facts: dict[str, Any]) -> bytes:
    """A row's index: one JSON line, then as many (arrival ns, bytes) pairs as it says: none, nothing arrived."""
    return json.dumps({**facts, "arrivals": 0}, sort_keys=True, separators=(",", ":")).encode() + b"\n"


class AuthorsLayout:
    """The published data set's raw folder: `unsynced/<scan>/<board>/<x>_<y>.bin`, packet logs and three JSON files.

    With `zero_filling` lost packets are zeros in the file, otherwise they are absent from it.
    """

    def __init__(
        self, path: Path, rig: Instrument, plan: RasterPlan, scan_id: str, started_s: float, zero_filling: bool = True
    ) -> None:
        self.folder = path / "unsynced" / scan_id
        self._rig, self._plan = rig, plan
        self._now_s, self._zero_filling = started_s, zero_filling

    def start(self) -> None:
        """Make the folder and write the three JSON files. Raises DataError when it is not empty."""
        _new_folder(self.folder)
        for name, content in (
            ("data_collection_cfg", self._collection()),
            ("devices_comm_cfg", self._devices()),
            ("radar_id", self._radars()),
        ):
            (self.folder / f"{name}.json").write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")

    def write_row(self, row: Row, payloads: dict[str, NDArray[np.int16]], gaps: dict[str, Gaps]) -> None:
        """One file for each board, named by the grid index where the row starts, and its packet log."""
        step_s = abs(row.step_mm) / self._rig.stage.speed_mm_s
        for name, payload in payloads.items():
            lost = gaps[name]
            folder = self.folder / name
            folder.mkdir(exist_ok=True)
            stem = f"{row.column(0)}_{row.index}"
            raw = _blank(payload, lost)
            if not self._zero_filling:
                ends = [0, *(e for gap in lost for e in gap), len(raw)]
                kept = [raw[a:b] for a, b in zip(ends[::2], ends[1::2], strict=True)]
            else:
                kept = [raw]
            (folder / f"{stem}.bin").write_bytes(b"".join(kept))
            (folder / f"{stem}_log.csv").write_text(self._log(len(raw), lost, step_s), encoding="ascii")
        self._now_s += row.points * step_s + 2.0

    def end(self) -> None:
        """Nothing more is written."""

    def _log(self, size: int, lost: Gaps, step_s: float) -> str:
        """One line for each packet that arrived: sequence number, payload bytes, unix time."""
        full, frame = packet_payload_bytes(self._rig), self._rig.frame_bytes
        pulses, period_s = self._rig.burst.pulses, self._rig.burst.period_us * 1e-6
        gone = {start // full for a, b in lost for start in range(a - a % full, b, full)}
        lines = []
        for k, start in enumerate(range(0, size, full)):
            if k in gone:
                continue
            stop = min(start + full, size)
            position, chirp = divmod((stop - 1) // frame, pulses)
            at_s = self._now_s + position * step_s + chirp * period_s + 2e-4
            lines.append(f"{k + 1},{stop - start},{at_s:.6f}\n")
        return "".join(lines)

    def _collection(self) -> dict[str, Any]:
        rig, h, v = self._rig, *self._rig.receivers
        tilt = [s.shift_mm for s in h.mount if s.shift_mm is not None][-2]
        return {
            "dx": rig.grid.step_x_mm,
            "dy": rig.grid.step_y_mm,
            "total_x": rig.grid.columns,
            "total_y": rig.grid.rows,
            "moving_direction": "row",
            "num_trigger": rig.burst.pulses,
            "period_frame": rig.burst.period_us / 1e3,
            "num_frame": rig.burst.pulses,
            "num_chirp": 1,
            "num_config": 1,
            "num_adc": rig.chirp.samples,
            "num_ch": len(rig.antennas.rx_mm),
            "packet_zero_filling": self._zero_filling,
            "object_distance": rig.geometry.object_distance_mm,
            "board_dist": (_last_shift(h) - _last_shift(rig.transmitter)) / 1e3,
            "txboard_angle_y": _turn(rig.transmitter, "y", -1),
            "rxboard_v_angle_y": _turn(v, "y", 0),
            "rxboard_angle_y": _turn(h, "y", -1),
            "rxboard_angle_z": _turn(h, "z", -1),
            "rxboard_tilt_offset": list(tilt),
            "description": f"simulated: {self.folder.name}",
        }

    def _devices(self) -> dict[str, Any]:
        c = self._rig.chirp
        chirp = {
            "f0": c.start_hz,
            "slope": c.slope_hz_per_s,
            "ramp_time": c.ramp_end_us * 1e-6,
            "adc_start_time": c.adc_start_us * 1e-6,
            "num_adc": c.samples,
            "Fs": c.sample_rate_hz,
            "activated_tx": [self._rig.transmitter.tx_antenna],
        }
        return {"activated_radar": list(range(len(self._rig.boards))), "chirp_configs": [chirp]}

    def _radars(self) -> dict[str, Any]:
        return {
            str(i): {
                "idx": i,
                "name": b.name,
                "ip": b.card_address,
                "cfg_port": b.command_port,
                "data_port": b.data_port,
            }
            for i, b in enumerate(self._rig.boards)
        }


def _turn(board: Board, axis: str, which: int) -> float:
    """A mount's turn about an axis, degrees; 0 when it has none."""
    turns = [s.turn_deg for s in board.mount if s.about == axis and s.turn_deg is not None]
    return turns[which] if turns else 0.0


def _last_shift(board: Board) -> float:
    """Last shift of a mount along x, mm: where the board's origin is."""
    shifts = [s.shift_mm[0] for s in board.mount if s.shift_mm is not None]
    return shifts[-1] if shifts else 0.0
