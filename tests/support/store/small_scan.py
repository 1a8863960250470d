"""A scan in the tests' own process, which takes some milliseconds.

The host's functions that run and resume scans, the Pi's journal and the functions that write files are those of the
instrument. Only the wires, the sockets and the time between events are missing, and the samples are simulated.
"""

import hashlib
import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polysight.acquisition import scan as host_run
from polysight.acquisition.progress import ScanProgress, ScanResult
from polysight.acquisition.scan import resume_scan, run_scan
from polysight.capture.dca1000 import PacketLog
from polysight.capture.placement import EarlierRecords, Evidence, Losses, PacketCounts, place_record
from polysight.capture.receiver import RowCapture
from polysight.capture.row_files import PACKETS_SUFFIX, Segment, write_index, write_packets
from polysight.store import manifest
from polysight.store.scan_folder import MANIFEST, PART_SUFFIX, ScanFolder
from polysight_pi.journal import Journal, JournalFullError, NewEvent
from polysight_shared import messages as m
from polysight_shared.config import Instrument
from polysight_shared.errors import PolysightError
from polysight_shared.faults import PiFault
from polysight_shared.raster import plan_raster
from polysight_shared.tables import decode, to_builtins
from polysight_simulators.scene import SimulatedRig, load_scene, row_offsets_mm
from tests.support.capture.records import encode_packets
from tests.support.pipelines import make_pipeline
from tests.support.rigs import load_published_rig
from tests.support.scenes import write_small_scene

SCENE = write_small_scene(columns=3, rows=3, step_mm=(20.0, 20.0), pixels=12)


class Samples:
    """Simulated samples of every row; each take of a row has the same ones."""

    def __init__(self, folder: Path) -> None:
        (folder / "scene.toml").write_text(SCENE)
        radar = SimulatedRig(load_published_rig(), load_scene(folder / "scene.toml"))
        table = to_builtins(radar.rig)
        table["limits"] |= {"free_disk_bytes": 0}
        self.instrument = decode(table, Instrument, "small scan")
        self._rows: dict[tuple[str, int], bytes] = {}
        for row in plan_raster(radar.rig.grid):
            x, y = row_offsets_mm(radar, row)
            for board in radar.rig.recorded:
                self._rows[board.name, row.index] = radar.chirps(board.name, x, y, row.index * len(x)).tobytes()

    def get_payload(self, board: str, row: int) -> bytes:
        """Payload of one row."""
        return self._rows[board, row]


class SmallPi:
    """Stands in for the host's client of the Pi: it writes the Pi's journal itself, and a row ends immediately."""

    def __init__(self, instrument: Instrument, folder: Path) -> None:
        self._instrument = instrument
        self.published: list[bytes] = []
        self._journal = Journal(folder, self.published.extend)
        self._plan = plan_raster(instrument.grid)
        self._scan_id = ""
        self._seen = 0
        self._take: Any = None
        self.state: m.State = "ready"
        self.fault = ""
        self.gaps_filled = 0
        # The host waits until it can read from this descriptor: always.
        self.event_socket = os.eventfd(1)

    def follow(self, scan_id: str, last_seq: int, on_event: Any) -> None:
        self._scan_id = scan_id
        self._seen = last_seq
        self._take = on_event

    def _commit(self, kind: type[m.AnyEvent], *events: dict[str, Any]) -> None:
        """Write events as the Pi's executor does: it goes into the state `fault` if the journal cannot be written."""
        try:
            self._journal.write([NewEvent.now(kind, **event) for event in events])
        except JournalFullError as e:
            self.state = "fault"
            self.fault = str(e)

    def begin_run(self, run: m.BeginRun) -> None:
        try:
            resumed, lost_events = self._journal.open(run.scan_id, run.plan, run.last_seq)
        except PolysightError as e:
            raise host_run.ScanError(f"the Pi refused BeginRun: {e.what}", e.why, e.remedy) from None
        self._commit(m.RunStarted, {"plan": run.plan, "resumed": resumed, "lost_events": lost_events})

    def status(self) -> m.StatusReply:
        number = PiFault.JOURNAL_FULL if self.state == "fault" else 0
        return m.StatusReply(
            state=self.state, homed=True, x_mm=0, y_mm=0, scan_id=self._scan_id, row_index=-1, take=0, points=0,
            pulses=0, last_seq=self._journal.last_seq, fault=number, reason=self.fault,
        )  # fmt: skip

    def run_row(self, scan_id: str, row_index: int, take: int) -> None:
        """Write all events of a row to the journal; their times are placeholders."""
        assert scan_id == self._scan_id
        row = self._plan.row(row_index)
        n = self._instrument.burst.pulses
        self._commit(m.RowStarted, {"row": row, "take": take})
        points = [
            dict[str, Any](
                row_index=row.index, take=take, point=i, column=row.column(i), edge_ns=i, first_pulse_ns=i,
                last_pulse_ns=i, pulses=n, width_max_ns=1, jitter_ns=1,
            )
            for i in range(row.points)
        ]  # fmt: skip
        self._commit(m.Capture, *points)
        end = dict[str, Any](
            row_index=row.index, take=take, status="done", points=row.points, edges=row.points,
            bursts=row.points, pulses=row.points * n,
        )  # fmt: skip
        if self.state != "fault":
            self._commit(m.RowFinished, end)

    def events(self) -> list[m.AnyEvent]:
        """Return the events that were written to the journal since the last call."""
        unpacked = [m.unpack_event(raw) for raw in self._journal.read(self._scan_id, self._seen + 1, 10000)[0]]
        for event in unpacked:
            assert event.seq == self._seen + 1, "the sequence has a gap"
            self._seen = event.seq
            self._take(event)
        return unpacked

    def drain(self) -> None:
        """Do nothing: no events are waiting in a socket."""

    def end_run(self, scan_id: str, exit_status: m.ExitStatus, reason: str) -> None:
        assert scan_id == self._scan_id
        self._commit(m.RunStopped, {"exit_status": exit_status, "reason": reason})
        self.events()

    def home(self) -> None:
        self.state = "ready"
        self.fault = ""
        self._journal.broken = False

    def come_to_rest(self, reason: str) -> None:
        """Do nothing: there is no stage."""

    def abort(self, reason: str) -> None:
        raise AssertionError(f"nothing asks for an abort here: {reason}")

    def lose(self) -> None:
        """End the Pi's program as a power cut would: only its files remain."""
        os.close(self.event_socket)
        os.close(self._journal._lock)


class SmallRig:
    """Stands in for CaptureRig: every byte of the cards arrives, and rows are written as its receivers write them."""

    def __init__(self, samples: Samples) -> None:
        self._samples = samples
        self.warnings: list[str] = []
        self.receivers: dict[str, Any] = {}
        self.cards: dict[str, Any] = {}
        self.complete = True
        self._segments: dict[str, Segment] = {}
        self._row = (0, 0)

    def begin_row(self, row: int, take: int, points: int, folder: Path) -> None:
        del points
        self._row = (row, take)
        for board in self._samples.instrument.recorded:
            path = folder / "raw" / board.name / f"{row:04d}{PART_SUFFIX}"
            self._segments[board.name] = Segment(path, self._samples.instrument.row_bytes)

    def statuses(self) -> dict[str, Any]:
        return {}

    def reports(self) -> dict[str, Any]:
        return {}

    def discard_before(self, not_before_ns: int) -> None:
        """Do nothing: there are no packets of an earlier row."""

    def end_row(self, not_before_ns: int = 0) -> dict[str, RowCapture]:
        del not_before_ns
        return {name: self._end(name, segment) for name, segment in self._segments.items()}

    def _end(self, name: str, segment: Segment) -> RowCapture:
        """Write the packets of one board's row to its files, as the receiver does."""
        row, take = self._row
        data = self._samples.get_payload(name, row)
        log = PacketLog(len(data))
        evidence = Evidence(len(data), self._samples.instrument.frame_bytes, past=EarlierRecords.after_reset())
        for k, packet in enumerate(encode_packets(data, sequence=1, byte_count=0)):
            log.add(np.frombuffer(packet, dtype=np.uint8)[None, :], np.array([len(packet)]), k + 1)
        placed, out = place_record(log, evidence.frame_bytes)
        crc = segment.finish(out)
        index = write_index(segment.path.with_suffix(".idx"), placed.facts(), placed.arrivals)
        packets = write_packets(segment.path.with_suffix(PACKETS_SUFFIX), log, evidence, placed)
        return RowCapture(
            row=row, take=take, expected=len(data), bytes=len(data), missing=[], located=True, reason="",
            counts=PacketCounts(placed=1), losses=Losses(), strangers=0, stale=0, kernel_drops=0,
            first_arrival_ns=0, last_arrival_ns=0, crc32=crc, index_crc32=index, packets_crc32=packets,
        )  # fmt: skip

    def close(self) -> None:
        """Close the row's files."""
        for segment in self._segments.values():
            segment.close()


class SmallScan:
    """A scan in `folder`/scan, and the Pi's journal in `folder`/journal; `run` starts or resumes it."""

    def __init__(self, samples: Samples, folder: Path) -> None:
        self._samples = samples
        self.path = folder / "scan"
        self.journals = folder / "journal"
        self.messages: list[str] = []
        self.acknowledged: set[int] = set()

    @contextmanager
    def _connect_pi(self) -> Iterator[None]:
        """Replace the connections to Pi and cards by stand-ins; the Pi continues its journal if there is one."""
        instrument = self._samples.instrument
        with ExitStack() as stack:
            pi = SmallPi(instrument, self.journals)
            stack.callback(pi.lose)
            rig = SmallRig(self._samples)
            stack.callback(rig.close)
            hello = m.HelloReply(pi_release="t", firmware="t", backend="wires", state="homed", scan_id="", last_seq=0)
            patch = stack.enter_context(pytest.MonkeyPatch.context())
            patch.setattr(host_run, "_connect", lambda *_: (pi, rig, hello))
            yield

    def run(self) -> ScanResult:
        """Start or resume the scan."""
        with self._connect_pi():
            if self.begun:
                return resume_scan(self.path, progress=self._on_progress)
            return run_scan(self._samples.instrument, self.path, progress=self._on_progress)

    @property
    def begun(self) -> bool:
        """True once the scan's manifest has its first line."""
        path = self.path / MANIFEST
        return path.exists() and manifest.read(path).length > 0

    def _on_progress(self, progress: ScanProgress) -> None:
        self.messages.append(progress.message)
        if progress.phase == "committed":
            self.acknowledged.add(progress.row)

    def rows(self) -> dict[str, str]:
        """Return the SHA-256 of the payload of every committed row, by file."""
        committed = ScanFolder.load(self.path).committed_rows().values()
        files = [self.path / board.file for row in committed for board in row.boards.values()]
        return {str(f.relative_to(self.path)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}

    def image(self) -> bytes:
        """Return the bytes of the final image: both channels and their mask."""
        images = make_pipeline(ScanFolder.load(self.path)).form_images()
        return b"".join(part.tobytes() for part in (images.h, images.v, images.valid))


NEW: dict[str, Any] = {"scan_id": "", "seq": 0, "t_mono_ns": 0}
