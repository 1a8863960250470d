"""Write simulated scans: as scan folders, and in the two layouts of the published data set.

The published layouts are `unsynced/<scan>` folders of raw data, and `raw/` cubes, which are echoes after ideal
synchronisation. Byte formats follow docs/spec/scan-folder.md and the description of the data set; they are implemented
here independently of the host.
"""

import json
import math
import re
from collections.abc import Collection, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any, Protocol
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from polysight_shared import __version__
from polysight_shared.config import Board, Instrument
from polysight_shared.errors import DataError, ErrorCode
from polysight_shared.files import name_in_errors
from polysight_shared.messages import AnyEvent, Capture, RowFinished, RowStarted, RunStarted, RunStopped, pack_with_crc
from polysight_shared.raster import FIRST_PULSE_DELAY_S, RasterPlan, Row, burst_duration_s
from polysight_shared.tables import to_builtins
from polysight_shared.units import NS_PER_S, SPEED_OF_LIGHT_M_S, us_to_ns
from polysight_simulators.scene.cubes import reference_cube
from polysight_simulators.scene.optics import antennas, direct_factor
from polysight_simulators.scene.radar import sample_frequencies_hz
from polysight_simulators.scene.scene_file import Scene, apply_scene

# Ranges of lost bytes in a row's payload: the first byte of each, and the one after its last.
Gaps = list[tuple[int, int]]
# Sequence number and byte count, before each payload.
_HEADER_BYTES = 10


class Layout(Protocol):
    """Writer of simulated rows."""

    def start(self) -> None:
        """Start the scan."""
        ...

    def write_row(self, row: Row, payloads: dict[str, NDArray[np.int16]], gaps: dict[str, Gaps]) -> None:
        """Write a row: by board, int16 [frames, samples, 8] (I of four RX, then Q) and the lost byte ranges."""
        ...

    def end(self) -> None:
        """End the scan."""
        ...


def versions() -> dict[str, str]:
    """Return the release of this program, for the manifest."""
    return {"polysight": __version__}


def packet_payload_bytes(rig: Instrument) -> int:
    """Return the payload of a full data packet: configured size without header, at most 1456 (DCA1000)."""
    # The card's setting counts 4 bytes more than header and payload: 1470 makes the 1456 of a full packet.
    return min(rig.card.packet_bytes - _HEADER_BYTES - 4, 1456)


def blank_gaps(payload: NDArray[np.int16], gaps: Gaps) -> bytes:
    """Return the bytes of a payload with zeros in lost packets."""
    raw = bytearray(payload.astype("<i2", copy=False).tobytes())
    for start, stop in gaps:
        raw[start:stop] = bytes(stop - start)
    return bytes(raw)


def make_scan_id(name: str) -> str:
    """Return a scene's name as the id of a scan: Latin letters, digits and hyphens, 120 at most."""
    return re.sub("[^A-Za-z0-9]", "-", name)[:120].strip("-") or "scene"


def require_empty(path: Path) -> None:
    """Raise DataError if this folder has files."""
    if path.exists() and any(path.iterdir()):
        raise DataError(
            f"{path}: the folder is not empty",
            "an earlier run wrote it",
            "choose another --out, or empty it",
            code=ErrorCode.FILE_EXISTS,
        )


def new_folder(path: Path) -> None:
    """Create an empty folder. Raises DataError if it is not empty."""
    require_empty(path)
    path.mkdir(parents=True, exist_ok=True)


def _copy_calibration(rig: Instrument, path: Path) -> dict[str, dict[str, dict[str, str]]]:
    """Copy the files that `[calibration]` names into the scan; return the entry for the manifest.

    Raises DataError if one cannot be copied.
    """
    entries = {}
    for kind, name in to_builtins(rig.calibration).items():
        if not name:
            continue
        source = Path(name)
        copy = Path("calibration") / f"{kind}-{Path(name).name}"
        try:
            (path / copy).parent.mkdir(exist_ok=True)
            (path / copy).write_bytes(source.read_bytes())
            # The gains of a metal reference lie in a second file.
            images = source.with_suffix(".npz")
            if images.exists():
                (path / "calibration" / images.name).write_bytes(images.read_bytes())
        except OSError as e:
            raise DataError(
                f"{source}: cannot be copied: {e.strerror}", f"calibration.{kind} names it", "correct or empty that key"
            ) from None
        entries[kind] = {
            "file": str(copy),
            "crc32": f"{crc32(source.read_bytes()):08x}",
            "copied_from": str(source),
        }
    if not entries:
        return {}
    return {"calibration": entries}


class OwnLayout:
    """Writer of a scan folder: manifest.jsonl, events.msgpack, raw/<board>/<row>.bin and .idx.

    Parameters
    ----------
    path, rig, plan
        Folder, rig, and the rows to come.
    scan_id, started_utc
        Name and start of the scan, for the manifest and the events.
    """

    def __init__(self, path: Path, rig: Instrument, plan: RasterPlan, scan_id: str, started_utc: str) -> None:
        self.folder = path
        self._rig = rig
        self._plan = plan
        self._scan_id = scan_id
        self._started_utc = started_utc
        # Number of the last event, and the time of the Pi's monotonic clock.
        self._seq = 0
        self._now_ns = NS_PER_S
        # Number of lines of the manifest, digest of its last line, and number of rows that were written.
        self._lines = 0
        self._digest = ""
        self._rows = 0

    def start(self) -> None:
        """Create the folder, start manifest and events. Raises DataError if it is not empty."""
        new_folder(self.folder)
        self._write_fact(
            "scan_started",
            format=1,
            scan_id=self._scan_id,
            simulated=True,
            started_utc=self._started_utc,
            instrument=to_builtins(self._rig),
            plan=to_builtins(self._plan),
            versions=versions(),
            **_copy_calibration(self._rig, self.folder),
        )
        self._write_event(RunStarted(plan=self._plan, **self._stamp()))

    def write_row(self, row: Row, payloads: dict[str, NDArray[np.int16]], gaps: dict[str, Gaps]) -> None:
        """Write a committed row and the events of the Pi."""
        pulses = self._rig.burst.pulses
        frame_bytes = self._rig.frame_bytes
        boards = {}
        for name, payload in payloads.items():
            raw = blank_gaps(payload, gaps[name])
            file = Path("raw") / name / f"{row.index:04d}.bin"
            (self.folder / file).parent.mkdir(parents=True, exist_ok=True)
            with name_in_errors(self.folder / file):
                (self.folder / file).write_bytes(raw)
            missing_bytes = sum(stop - start for start, stop in gaps[name])
            incomplete_frames: set[int] = set()
            for start, stop in gaps[name]:
                incomplete_frames.update(range(start // frame_bytes, math.ceil(stop / frame_bytes)))
            facts = {
                "frames_expected": row.points * pulses,
                "bytes": len(raw),
                "missing": gaps[name],
            }
            index = _make_index(facts)
            (self.folder / file.with_suffix(".idx")).write_bytes(index)
            boards[name] = {
                "file": str(file),
                "bytes": len(raw),
                "frames_expected": row.points * pulses,
                "frames_received": row.points * pulses - len(incomplete_frames),
                "missing_bytes": missing_bytes,
                "crc32": f"{crc32(raw):08x}",
                "index_crc32": f"{crc32(index):08x}",
            }
        self._write_row_events(row)
        self._write_fact(
            "row_committed", row=row.index, take=1, direction=row.direction, boards=boards, pulses=row.points * pulses
        )
        self._rows += 1

    def end(self) -> None:
        """Write the end of the scan to manifest and events."""
        self._write_event(RunStopped(exit_status="success", **self._stamp()))
        self._write_fact("scan_ended", exit_status="success", reason="", rows_committed=self._rows)

    def _write_fact(self, fact: str, **content: Any) -> None:
        """Append a line to the manifest, with its number, the digest of the line before, and a CRC-32."""
        record = {"fact": fact, **content, "count": self._lines, "previous": self._digest}
        line_text = json.dumps(record, sort_keys=True, separators=(",", ":"))
        record["crc"] = f"{crc32(line_text.encode()):08x}"
        line = json.dumps(record, sort_keys=True, separators=(",", ":"))
        path = self.folder / "manifest.jsonl"
        with name_in_errors(path), path.open("a", encoding="utf-8") as f:
            f.write(line + "\n")
        self._lines = self._lines + 1
        self._digest = sha256(line.encode()).hexdigest()[:16]

    def _write_event(self, *events: AnyEvent) -> None:
        """Append events, as the Pi sends them, to the file of events."""
        path = self.folder / "events.msgpack"
        with name_in_errors(path), path.open("ab") as f:
            f.write(b"".join(map(pack_with_crc, events)))

    def _stamp(self) -> dict[str, Any]:
        """Return the common fields of the next event, and count it."""
        self._seq += 1
        return {"scan_id": self._scan_id, "seq": self._seq, "t_mono_ns": self._now_ns}

    def _write_row_events(self, row: Row) -> None:
        """Write the events that the Pi would send in a row at the stage's speed: start, a capture per point, end.

        One second passes before the first point and one after the last; chosen.
        """
        burst = self._rig.burst
        stage = self._rig.stage
        events: list[AnyEvent] = [RowStarted(row=row, take=1, **self._stamp())]
        between_ns = round(abs(row.step_mm) / stage.speed_mm_s * NS_PER_S)
        first_ns = self._now_ns + NS_PER_S
        for i in range(row.points):
            edge_ns = first_ns + i * between_ns
            pulse_ns = edge_ns + round(FIRST_PULSE_DELAY_S * NS_PER_S)
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
        self._write_event(*events)


def _make_index(facts: dict[str, Any]) -> bytes:
    """Return the index of a row: one JSON line, without packet arrivals after it."""
    return json.dumps({**facts, "arrivals": 0}, sort_keys=True, separators=(",", ":")).encode() + b"\n"


# Points of a row, by board name and row, at which the radar did not start.
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
        self._rig = rig
        self._by_columns = by_columns
        self._skipped = skipped or {}
        self._now_s = started_s
        self._zero_filling = zero_filling

    def start(self) -> None:
        """Create the folder and write the three JSON files. Raises DataError if it is not empty."""
        new_folder(self.folder)
        write_settings(self.folder, self._rig, self._zero_filling, self._by_columns)

    def write_row(self, row: Row, payloads: dict[str, NDArray[np.int16]], gaps: dict[str, Gaps]) -> None:
        """Write one file per board, named by the grid index of the row's start, and its packet log."""
        step_s = abs(row.step_mm) / self._rig.stage.speed_mm_s
        start = row.column(0)
        if self._by_columns:
            stem = f"{row.index}_{start}"
        else:
            stem = f"{start}_{row.index}"
        for name, payload in payloads.items():
            skipped = self._skipped.get((name, row.index), frozenset())
            points = [i for i in range(row.points) if i not in skipped]
            sent_payload = payload.reshape(row.points, -1, *payload.shape[1:])[points]
            # Bytes that were not sent cannot be lost.
            lost_ranges = [(a, min(b, sent_payload.nbytes)) for a, b in gaps[name] if a < sent_payload.nbytes]
            folder = self.folder / name
            folder.mkdir(exist_ok=True)
            raw = blank_gaps(sent_payload, lost_ranges)
            if not self._zero_filling:
                # The received pieces lie between the end of one lost range and the start of the next.
                starts = [0, *(stop for _, stop in lost_ranges)]
                stops = [*(start for start, _ in lost_ranges), len(raw)]
                pieces = [raw[start:stop] for start, stop in zip(starts, stops, strict=True)]
            else:
                pieces = [raw]
            with name_in_errors(folder / f"{stem}.bin"):
                (folder / f"{stem}.bin").write_bytes(b"".join(pieces))
            packet_log = self._format_packet_log(len(raw), lost_ranges, points, step_s)
            (folder / f"{stem}_log.csv").write_text(packet_log, encoding="ascii")
        # The next row begins two seconds after the late packet; chosen.
        self._now_s += row.points * step_s + LATE_S + 2.0

    def end(self) -> None:
        """Write nothing more."""

    def _format_packet_log(self, size: int, lost_ranges: Gaps, points: list[int], step_s: float) -> str:
        """Return a line for each packet received: sequence number, payload bytes, Unix time.

        `size`: number of bytes sent; `lost_ranges`: lost ranges of these; `points`: numbers of the points sent;
        `step_s`: time between points. The last, incomplete packet is late, because the card sends it after a timeout;
        the authors' decoder expects that.
        """
        full_bytes = packet_payload_bytes(self._rig)
        frame_bytes = self._rig.frame_bytes
        pulses = self._rig.burst.pulses
        period_s = self._rig.burst.period_us * 1e-6
        lost_packets: set[int] = set()
        for lost_start, lost_stop in lost_ranges:
            lost_packets.update(range(lost_start // full_bytes, math.ceil(lost_stop / full_bytes)))
        lines = []
        for packet, start in enumerate(range(0, size, full_bytes)):
            if packet in lost_packets:
                continue
            stop = min(start + full_bytes, size)
            # The packet is received 0.2 ms (chosen) after the trigger of the chirp that its last byte belongs to.
            position, chirp = divmod((stop - 1) // frame_bytes, pulses)
            received_s = self._now_s + points[position] * step_s + chirp * period_s + 2e-4
            if stop - start < full_bytes:
                received_s += LATE_S
            lines.append(f"{packet + 1},{stop - start},{received_s:.6f}\n")
        return "".join(lines)


def write_settings(folder: Path, rig: Instrument, zero_filling: bool, by_columns: bool) -> None:
    """Write the three JSON files of a scan."""
    for name, content in (
        ("data_collection_cfg", _describe_collection(rig, folder.name, zero_filling, by_columns)),
        ("devices_comm_cfg", _describe_devices(rig)),
        ("radar_id", _describe_radars(rig)),
    ):
        (folder / f"{name}.json").write_text(json.dumps(content, indent=4) + "\n", encoding="utf-8")


def _describe_collection(rig: Instrument, scan: str, zero_filling: bool, by_columns: bool) -> dict[str, Any]:
    """Return the scan's settings with the keys of the published data set."""
    h, v = rig.receivers
    # The last shift of a mount is its board's origin; the one before it is the offset of the tilted board.
    tilt_offset_mm = [step.shift_mm for step in h.mount if step.shift_mm is not None][-2]
    # V's mount has a turn of its own first, and then the turns that it shares with H.
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
        "board_dist": (_find_last_shift(h) - _find_last_shift(rig.transmitter)) / 1e3,
        "txboard_angle_y": _find_turn_deg(rig.transmitter, "y", -1),
        "rxboard_v_angle_y": _find_turn_deg(v, "y", 0),
        "rxboard_angle_y": _find_turn_deg(h, "y", -1),
        "rxboard_angle_z": _find_turn_deg(h, "z", -1),
        "rxboard_tilt_offset": list(tilt_offset_mm),
        "description": f"simulated: {scan}",
    }


def _describe_devices(rig: Instrument) -> dict[str, Any]:
    """Return chirp and radars as in the published JSON file of devices; hertz and seconds."""
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


def _describe_radars(rig: Instrument) -> dict[str, Any]:
    """Return the boards' network settings, by index, as in the published JSON file."""
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


def _find_turn_deg(board: Board, axis: str, turn_number: int) -> float:
    """Return one of a mount's rotations about an axis (0: the first, -1: the last), degrees; 0 without any."""
    turns_deg = [step.turn_deg for step in board.mount if step.about == axis and step.turn_deg is not None]
    if not turns_deg:
        return 0.0
    return turns_deg[turn_number]


def _find_last_shift(board: Board) -> float:
    """Return the last shift of a mount along x, mm: the origin of the board."""
    shifts_mm = [step.shift_mm[0] for step in board.mount if step.shift_mm is not None]
    if not shifts_mm:
        return 0.0
    return shifts_mm[-1]


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
    """Write the echoes of all positions, a cube of each receiving board, in `out`/raw/<scan>; return the folder.

    Parameters
    ----------
    rig, scene, out
        Rig and scene (its overrides are applied, its disturbances ignored), and the output folder.
    keep_direct
        Include the direct path.
    from_transmitter
        Phases are 2 pi f tau; otherwise 2 pi f (tau - tau_direct) with the direct path of each RX.
    common_reference
        Use the direct path of RX1 for all RX.
    conjugate
        Phases have the opposite sign.
    by_columns
        Write this into the settings; the stage still moves along x during a burst.
    """
    name = make_scan_id(scene.name)
    folder = out / "raw" / name
    new_folder(folder)
    rig = apply_scene(rig, scene)
    write_settings(folder, rig, zero_filling=True, by_columns=by_columns)
    f = sample_frequencies_hz(rig)
    # Cubes are complex [rx, row, column, sample].
    for board_name, cube in reference_cube(rig, scene).items():
        board = rig.by_name(board_name)
        direct_m = antennas(rig, board).direct_m
        if keep_direct:
            cube += (direct_factor(board, scene) * direct_m[0] / direct_m).astype(np.complex64)[:, None, None, None]
        # Phases of the cube are relative to the direct path of each RX; `added_m` of that path is added again.
        if from_transmitter:
            added_m = direct_m
        elif common_reference:
            added_m = direct_m - direct_m[0]
        else:
            added_m = 0 * direct_m
        cube *= np.exp(2j * np.pi / SPEED_OF_LIGHT_M_S * np.outer(added_m, f)).astype(np.complex64)[:, None, None]
        np.save(folder / f"{board_name}_synced.npy", cube.conj() if conjugate else cube)
    return folder
