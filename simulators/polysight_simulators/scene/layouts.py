"""Write simulated scans as scan folders; functions common to all writers of simulated scans.

Byte format: docs/spec/scan-folder.md, implemented here independently of the host.
"""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path
from typing import Any, Protocol
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from polysight_shared import __version__
from polysight_shared.config import Instrument
from polysight_shared.error_codes import ErrorCode
from polysight_shared.errors import DataError
from polysight_shared.files import named
from polysight_shared.messages import AnyEvent, Capture, RowFinished, RowStarted, RunStarted, RunStopped, pack_with_crc
from polysight_shared.raster import FIRST_PULSE_DELAY_S, RasterPlan, Row, burst_duration_s
from polysight_shared.tables import to_builtins
from polysight_shared.units import NS_PER_S, us_to_ns

Gaps = list[tuple[int, int]]
_HEADER_BYTES = 10  # sequence number and byte count before each payload


class Layout(Protocol):
    """Writer of simulated rows."""

    def start(self) -> None:
        """Start the scan."""
        ...

    def write_row(self, row: Row, payloads: dict[str, NDArray[np.int16]], gaps: dict[str, Gaps]) -> None:
        """Write a row: int16 [frames, samples, 8] and the lost byte ranges of each board."""
        ...

    def end(self) -> None:
        """End the scan."""
        ...


def versions() -> dict[str, str]:
    """Return the release that makes the data."""
    return {"polysight": __version__}


def packet_payload_bytes(rig: Instrument) -> int:
    """Return the payload of a full data packet: configured size without header, at most 1456 (DCA1000)."""
    return min(rig.card.packet_bytes - _HEADER_BYTES - 4, 1456)


def blank(payload: NDArray[np.int16], gaps: Gaps) -> bytes:
    """Return the bytes of a payload with zeros in lost packets."""
    raw = bytearray(payload.astype("<i2", copy=False).tobytes())
    for start, stop in gaps:
        raw[start:stop] = bytes(stop - start)
    return bytes(raw)


def new_folder(path: Path) -> None:
    """Create an empty folder. Raises DataError if it is not empty."""
    if path.exists() and any(path.iterdir()):
        raise DataError(
            f"{path}: the folder is not empty",
            "an earlier run wrote it",
            "choose another --out, or empty it",
            code=ErrorCode.FILE_EXISTS,
        )
    path.mkdir(parents=True, exist_ok=True)


def _calibration(rig: Instrument, path: Path) -> dict[str, dict[str, dict[str, str]]]:
    """Copy the files that `[calibration]` names into the scan; return the entry for the manifest."""
    facts = {}
    for kind, name in to_builtins(rig.calibration).items():
        if not name:
            continue
        source, copy = Path(name), Path("calibration") / f"{kind}-{Path(name).name}"
        try:
            (path / copy).parent.mkdir(exist_ok=True)
            (path / copy).write_bytes(source.read_bytes())
            images = source.with_suffix(".npz")  # gains of a metal reference
            if images.exists():
                (path / "calibration" / images.name).write_bytes(images.read_bytes())
        except OSError as e:
            raise DataError(
                f"{source}: cannot be copied: {e.strerror}", f"calibration.{kind} names it", "correct or empty that key"
            ) from None
        facts[kind] = {
            "file": str(copy),
            "crc32": f"{crc32(source.read_bytes()):08x}",
            "copied_from": str(source),
        }
    return {"calibration": facts} if facts else {}


class OwnLayout:
    """Writer of a scan folder: manifest.jsonl, events.msgpack, raw/<board>/<row>.bin and .idx."""

    def __init__(self, path: Path, rig: Instrument, plan: RasterPlan, scan_id: str, started_utc: str) -> None:
        self._path, self._rig, self._plan = path, rig, plan
        self._scan_id, self._started_utc = scan_id, started_utc
        self._seq, self._now_ns = 0, NS_PER_S
        self._lines, self._digest, self._rows = 0, "", 0

    def start(self) -> None:
        """Create the folder, start manifest and events. Raises DataError if it is not empty."""
        new_folder(self._path)
        self._fact(
            "scan_started",
            format=1,
            scan_id=self._scan_id,
            simulated=True,
            started_utc=self._started_utc,
            instrument=to_builtins(self._rig),
            plan=to_builtins(self._plan),
            versions=versions(),
            **_calibration(self._rig, self._path),
        )
        self._event(RunStarted(plan=self._plan, **self._stamp()))

    def write_row(self, row: Row, payloads: dict[str, NDArray[np.int16]], gaps: dict[str, Gaps]) -> None:
        """Write a committed row and the events of the Pi."""
        pulses = self._rig.burst.pulses
        boards = {}
        for name, payload in payloads.items():
            raw = blank(payload, gaps[name])
            file = Path("raw") / name / f"{row.index:04d}.bin"
            (self._path / file).parent.mkdir(parents=True, exist_ok=True)
            with named(self._path / file):
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
        self._rows += 1

    def end(self) -> None:
        """Write the end of the scan to manifest and events."""
        self._event(RunStopped(exit_status="success", **self._stamp()))
        self._fact("scan_ended", exit_status="success", reason="", rows_committed=self._rows)

    def _fact(self, fact: str, **content: Any) -> None:
        record = {"fact": fact, **content, "count": self._lines, "previous": self._digest}
        plain = json.dumps(record, sort_keys=True, separators=(",", ":"))
        record["crc"] = f"{crc32(plain.encode()):08x}"
        line = json.dumps(record, sort_keys=True, separators=(",", ":"))
        path = self._path / "manifest.jsonl"
        with named(path), path.open("a", encoding="utf-8") as f:
            f.write(line + "\n")
        self._lines, self._digest = self._lines + 1, sha256(line.encode()).hexdigest()[:16]

    def _event(self, *events: AnyEvent) -> None:
        path = self._path / "events.msgpack"
        with named(path), path.open("ab") as f:
            f.write(b"".join(map(pack_with_crc, events)))

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
        self._event(*events)


def _index(facts: dict[str, Any]) -> bytes:
    """Return the index of a row: one JSON line, followed by no packet arrivals."""
    return json.dumps({**facts, "arrivals": 0}, sort_keys=True, separators=(",", ":")).encode() + b"\n"
