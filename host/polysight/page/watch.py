"""Follow one scan in threads: its newest snapshot for all pages, and the images of its committed rows.

Manifest, event log and products are read as they change (`ManifestTail`, `EventTail`, `ProductsTail`); `PiListener`
receives the Pi's events. A snapshot is serialised once, so that a page costs only its transmission, and all pages see
the same. `RowViewer` makes images and range profiles with the instrument's own pipeline, in a thread that may be slow,
and replaces its results as a whole (`ShownResults`).
"""

from __future__ import annotations

import math
import os
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray

from polysight.acquisition import LAPSE_S, read_life
from polysight.catalogue import Picture, Program, draw, explain_failure, find_program, read_generation
from polysight.imaging import Antennas, find_scene_gate_m, image_grid
from polysight.page.history import PiState, ScanHistory, make_error_notice, make_fault_notice
from polysight.page.status import (
    Inputs,
    LifeSigns,
    Motion,
    Profile,
    RowSync,
    ShownResults,
    Snapshot,
    cut_fraction,
    make_motion,
    make_snapshot,
)
from polysight.pipeline import Pipeline
from polysight.products import QUALITY, find_products
from polysight.results import Verdict
from polysight.store import EVENTS, MANIFEST, Fact, Manifest, OtherFact, ScanFolder, ScanStarted, parse_events
from polysight.sync import SyncedRow
from polysight_shared import messages as m
from polysight_shared.config import Chirp, Instrument
from polysight_shared.errors import PolysightError, ProtocolError
from polysight_shared.findings import Finding
from polysight_shared.raster import plan_raster
from polysight_shared.sockets import create_observer
from polysight_shared.units import SPEED_OF_LIGHT_M_S

# Number of points of the Fourier transform of a range profile, number of its points that are shown, and its lowest
# level; chosen.
FFT_POINTS = 2048
PROFILE_POINTS = 240
PROFILE_FLOOR_DB = -70.0
# Excess path that a profile shows before the direct path and beyond the scene; chosen.
BEFORE_M = 0.25
BEYOND_M = 0.35
# Shortest time between two pictures while several rows wait to be processed; chosen.
PICTURE_INTERVAL_S = 0.5
# Time between two looks for committed rows; chosen.
POLL_S = 0.1

# Bytes at the beginning of a file by which a replaced file is recognised; chosen.
HEAD_BYTES = 256
# Time between two readings of the files; chosen.
TURN_S = 0.2
# Timeout of waiting for an event of the Pi; chosen.
LISTEN_MS = 200
# Number of faults of the current row that are kept for the page; chosen.
MAX_FAULTS = 20
# Longest time from a manifest's first line to the first sign of life of its program; chosen.
GRACE_S = 6.0
# Timeout of the Pi's heartbeat; chosen.
PI_LIMIT_S = 6.0
# A scan whose program gives no signs of life counts as alive until no row has come for the time of this many rows.
UNATTENDED_ROWS = 3.0


def scene_m(rig: Instrument) -> tuple[float, float]:
    """Return the smallest and the largest excess path that the scene can have, metres."""
    antennas = tuple(Antennas.from_rig(rig, board) for board in rig.receivers)
    return find_scene_gate_m(antennas, plan_raster(rig.grid), image_grid(rig))


def compute_range_profile_db(row: SyncedRow, chirp: Chirp, excess_m: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the mean power over RX and positions against excess path, relative to the direct path at 0.

    An echo with the excess path d is exp(+j 2 pi f d / c) (sync/chain.py). A Fourier transform of N = `FFT_POINTS`
    points over the linear samples, which have the spacing df and a Hann window, has this echo at the bin d N df / c,
    modulo N if d < 0. Returns dB, float64 [n] as `excess_m`, at least `PROFILE_FLOOR_DB`, which is also returned if no
    position is valid.
    """
    first, last = (chirp.first_sample_hz + chirp.hz_per_sample * n for n in chirp.linear_samples)
    linear = (row.sweep_hz >= first) & (row.sweep_hz < last)
    # [RX, position, frequency]
    samples = row.samples[:, row.valid][..., linear]
    if not samples.size:
        return np.full(excess_m.size, PROFILE_FLOOR_DB)
    spectrum = np.fft.fft(samples * np.hanning(samples.shape[-1]), FFT_POINTS, axis=-1)
    power = (spectrum.real**2 + spectrum.imag**2).mean(axis=(0, 1))
    bins = excess_m * FFT_POINTS * (row.sweep_hz[1] - row.sweep_hz[0]) / SPEED_OF_LIGHT_M_S
    level = np.interp(bins % FFT_POINTS, np.arange(FFT_POINTS + 1), np.append(power, power[0]))
    relative = np.maximum(level / max(power[0], 1e-30), 1e-30)
    return np.maximum(10 * np.log10(relative), PROFILE_FLOOR_DB)


class RowViewer:
    """Forms images of committed rows of one scan in a thread; `content` has the facts, and grows as the scan runs."""

    def __init__(self, path: Path, content: Manifest) -> None:
        self.shown = ShownResults()
        self._source = ScanFolder(path, content)
        # Row to its take: rows to show, rows that are in the images, and rows that failed.
        self._to_show: dict[int, int] = {}
        self._done: dict[int, int] = {}
        self._failed: dict[int, int] = {}
        self._sync: dict[str, dict[int, RowSync]] = {}
        self._problem: Finding | None = None
        self._drawn_at = 0.0
        self._ended = threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="rows", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def show_rows(self, takes: dict[int, int]) -> None:
        """Set the rows and takes to show, in this order."""
        with self._lock:
            self._to_show = dict(takes)

    def close(self) -> None:
        """Stop after the current row."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()

    def _list_waiting(self) -> list[tuple[int, int]]:
        """Return the rows and takes that are not processed yet."""
        with self._lock:
            takes = self._to_show.items()
            return [(row, take) for row, take in takes if take not in (self._done.get(row), self._failed.get(row))]

    def _run(self) -> None:
        """Process waiting rows until closed; a row that fails is shown as a problem, and not tried again."""
        pipeline: Pipeline | None = None
        while not self._ended.is_set():
            waiting = self._list_waiting()
            if not waiting:
                self._ended.wait(POLL_S)
                continue
            row, take = waiting[0]
            try:
                # With "read", samples that processing has kept are used, and none are written.
                pipeline = pipeline or Pipeline(self._source, live=True, samples="read")
                self._add(pipeline, row, take, draws=len(waiting) == 1)
            except PolysightError as e:
                self._fail(row, take, make_error_notice(e))
            except Exception as e:  # noqa: BLE001  the page shows it; the scan is not concerned
                row_problem = f"Row {row} cannot be shown: {type(e).__name__}: {e}"
                self._fail(row, take, Finding("warning", row_problem, "A defect of the live view", "Report it"))

    def _add(self, pipeline: Pipeline, row: int, take: int, draws: bool) -> None:
        """Process a row; draw and publish pictures if `draws`, or if the last ones are old."""
        pipeline.add_row(row)
        self._done[row] = take
        for name, board in pipeline.quality.boards.items():
            figures = board.rows[row].figures
            # `residuals` has for each stage the standard deviations of frequency (Hz), phase (rad), relative amplitude.
            phases = {stage: phase_rad for stage, (_, phase_rad, _) in figures.residuals.items()}
            object_rad = phases.get("referenced", math.nan)
            direct_rad = phases.get("averaged", math.nan)
            _, _, scatter = figures.residuals.get("averaged", (math.nan,) * 3)
            sync = RowSync(object_rad, direct_rad, figures.positions_masked, dead_rx=tuple(figures.dead_rx))
            if scatter > 0:
                sync = sync._replace(snr_db=-20 * math.log10(scatter))
            self._sync.setdefault(name, {})[row] = sync
        if draws or time.monotonic() - self._drawn_at > PICTURE_INTERVAL_S:
            self._publish(draw(pipeline.builder.current()), self._compute_profile(pipeline, row))
            self._drawn_at = time.monotonic()

    def _compute_profile(self, pipeline: Pipeline, row: int) -> Profile:
        """Return the profile of a row, which is synchronised again: kept samples do not contain the direct path."""
        rig = pipeline.source.instrument
        nearest, farthest = scene_m(rig)
        excess = np.linspace(-BEFORE_M, farthest + BEYOND_M, PROFILE_POINTS)
        boards = {
            name: compute_range_profile_db(synced, rig.chirp, excess).round(1).tolist()
            for name, synced in pipeline.synchronise_row(row).items()
        }
        return Profile(row, excess.round(4).tolist(), boards, (round(nearest, 3), round(farthest, 3)))

    def _fail(self, row: int, take: int, problem: Finding) -> None:
        """Note that a take of a row cannot be shown, and publish the problem."""
        self._failed[row] = take
        self._problem = problem
        self._publish(self.shown.pictures, self.shown.profile)

    def _publish(self, pictures: dict[str, Picture], profile: Profile | None) -> None:
        """Replace `shown` by the rows so far with these pictures and this profile."""
        sync = {name: dict(sorted(rows.items())) for name, rows in self._sync.items()}
        rows = tuple(sorted(self._done))
        self.shown = ShownResults(self.shown.revision + 1, rows, pictures, profile, sync, self._problem)


class GrowingFile:
    """Bytes that were appended to a file since the last read.

    Attributes
    ----------
    replaced
        True if the last :meth:`look` found another file; it is then read from the beginning.
    modified_s
        Time of the last change by the file system, seconds since 1970; 0 before the file exists.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.replaced = False
        self.modified_s = 0.0
        self._position = 0
        self._head = b""
        self._stamp = (0, -1, -1)

    def look(self) -> bytes:
        """Return the bytes after those taken so far; empty if nothing has changed or the file cannot be read."""
        self.replaced = False
        try:
            with self.path.open("rb") as f:
                status = os.fstat(f.fileno())
                stamp = (status.st_ino, status.st_size, status.st_mtime_ns)
                if stamp == self._stamp:
                    return b""
                self._stamp = stamp
                self.modified_s = status.st_mtime
                # A new file may have the inode number of the old one; the CRC in its first record is different.
                if status.st_size < self._position or f.read(len(self._head)) != self._head:
                    self.replaced = True
                    self._position = 0
                f.seek(0)
                self._head = f.read(HEAD_BYTES)
                f.seek(self._position)
                return f.read()
        except OSError:
            return b""

    def take(self, count: int) -> None:
        """Mark the next `count` bytes, those of whole records, as read."""
        self._position += count


class ManifestTail:
    """Facts appended to a manifest."""

    def __init__(self, path: Path) -> None:
        self.file = GrowingFile(path)
        self.content = Manifest()

    def look(self) -> list[Fact]:
        """Return the facts since the last look."""
        raw = self.file.look()
        if self.file.replaced:
            self.content = Manifest()
        length_before = self.content.length
        facts = self.content.feed(raw)
        self.file.take(self.content.length - length_before)
        return facts


class EventTail:
    """Events appended to an event log, up to the first damage, which `resume` repairs."""

    def __init__(self, path: Path) -> None:
        self.file = GrowingFile(path)

    def look(self) -> list[m.AnyEvent]:
        """Return the events since the last look."""
        log = parse_events(self.file.look())
        self.file.take(log.length)
        return log.events


class ProductsTail:
    """The verdict of the products of a scan folder, read again when they change.

    Images are published before materials are computed, with a verdict on the recording alone, and a resumed scan has
    the products of its earlier runs: neither is a result of this scan.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._generation = ""
        self._verdict: Verdict | None = None
        self._processed_utc = ""

    def look(self, last_row_utc: str) -> Verdict | None:
        """Return the verdict of products that were made after the last row; None if there are none."""
        products = find_products(self._folder, QUALITY)
        if products is None:
            return None
        generation = read_generation(products.folder)
        if generation != self._generation:
            verdict = None
            processed_utc = ""
            # Damaged products have no verdict.
            with suppress(PolysightError):
                processed_utc = products.facts.processed_utc or ""
                verdict = products.verdict if products.materials is not None else None
            if read_generation(products.folder) != generation:
                # The products were replaced meanwhile: the next look reads the new ones.
                return None
            self._generation = generation
            self._verdict = verdict
            self._processed_utc = processed_utc
        # Products of earlier releases have no time.
        if self._processed_utc and cut_fraction(self._processed_utc) < cut_fraction(last_row_utc):
            return None
        return self._verdict


def find_newest_program(folder: Path) -> Program | None:
    """Return the program of a scan (`scan` or `process`) that a page started last; None without any."""
    programs = [find_program(folder, kind) for kind in ("scan", "process")]
    return max((p for p in programs if p is not None), key=lambda p: p.started_utc, default=None)


class PiListener:
    """Receives the Pi's events of one scan in a thread of its own.

    There is no command socket here, so the live view cannot command the Pi.
    """

    def __init__(self, instrument: Instrument, scan_id: str) -> None:
        self.state = PiState()
        self._instrument = instrument
        self._scan_id = scan_id
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="listener", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        """Receive events until closed; `state.receive_error` says why if that is not possible."""
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        try:
            pi = self._instrument.pi
            socket = create_observer(context, pi.event_address, Path(pi.key_dir))
            while not self._ended.is_set():
                if socket.poll(LISTEN_MS):
                    self._receive(socket.recv_multipart()[-1])
        except PolysightError as e:
            self.state = replace(self.state, receive_error=make_error_notice(e, "note"))
        finally:
            context.destroy(linger=0)

    def _receive(self, raw: bytes) -> None:
        """Replace `state` by the one after an event."""
        try:
            event = m.unpack_event(raw)
        except ProtocolError as e:
            self.state = replace(self.state, receive_error=make_error_notice(e, "note"))
            return
        state = replace(self.state, heard_s=time.monotonic(), heard_utc_s=int(time.time()), receive_error=None)
        if isinstance(event, m.Heartbeat):
            state = replace(state, state=event.state)
        elif isinstance(event, m.StageStatus):
            stage = self._instrument.stage
            state = replace(state, x_mm=event.x_mm - stage.centre_x_mm, y_mm=event.y_mm - stage.centre_y_mm)
        elif event.scan_id == self._scan_id:
            state = _follow_row(state, event)
        self.state = state

    def close(self) -> None:
        """Stop the thread."""
        self._ended.set()
        self._thread.join()


def _follow_row(state: PiState, event: m.AnyEvent) -> PiState:
    """Return the state after an event of the scan's rows."""
    if isinstance(event, m.RowStarted):
        return replace(state, row=event.row.index, take=event.take, point=0, state="running")
    if isinstance(event, m.Capture):
        return replace(state, row=event.row_index, take=event.take, point=event.point + 1)
    if isinstance(event, m.RowFinished):
        faults = state.faults
        if event.status == "done":
            faults = ()
        return replace(state, row=-1, point=0, faults=faults)
    if isinstance(event, m.Fault):
        return replace(state, faults=(*state.faults, make_fault_notice(event))[-MAX_FAULTS:])
    return state


class Versioned(NamedTuple):
    """Published JSON with its version number."""

    version: int
    data: bytes

    def publish(self, content: Snapshot | Motion) -> Versioned:
        """Publish the next version if the content differs."""
        data = msgspec.json.encode(content)
        if data == self.data:
            return self
        return Versioned(self.version + 1, data)


class Watch:
    """Follows a scan folder, which may not exist yet, in a thread of its own, and writes nothing.

    With `control` pages may offer to pause and stop the scan. `lapse_s` is the timeout of the scan program's signs of
    life. `state` (a `Snapshot`: status, rows, boards) and `motion` (place of the stage, point, time left) are sent to
    pages as JSON; `shown` has the pictures.
    """

    def __init__(self, folder: Path, control: bool = False, lapse_s: float = LAPSE_S) -> None:
        self.folder = folder
        self.control = control
        self.state = Versioned(0, b"{}")
        self.motion = Versioned(0, b"{}")
        self.shown = ShownResults()
        self._lapse_s = lapse_s
        self._ended = threading.Event()
        self._looked = False
        # True once the folder existed: if it is missing later, it was moved or deleted.
        self._existed = False
        self._begin()
        self._turn()
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def _begin(self) -> None:
        """Reset all state: another scan may be in the folder now."""
        self._manifest = ManifestTail(self.folder / MANIFEST)
        self._events = EventTail(self.folder / EVENTS)
        self._products = ProductsTail(self.folder)
        self._history: ScanHistory | None = None
        self._viewer: RowViewer | None = None
        self._listener: PiListener | None = None
        self._problem = ""
        # Time of the last sign of life by its file, seconds since 1970.
        self._life_s: float | None = None
        # Time at which it was first seen here, on the monotonic clock.
        self._life_at = float("-inf")
        # Time at which the manifest last grew, on the monotonic clock.
        self._grown_at = float("-inf")

    def _run(self) -> None:
        """Take a turn every `TURN_S`; a turn that fails becomes the status."""
        while not self._ended.wait(TURN_S):
            try:
                self._turn()
            except Exception as e:  # noqa: BLE001  a view that has failed must not show "All is well"
                self._problem = f"the live view fails: {type(e).__name__}: {e}"
                nothing = Inputs(self.folder, None, self._read_life_signs(PiState()), problem=self._problem)
                self.state = self.state.publish(make_snapshot(nothing))

    def _turn(self) -> None:
        """Read everything once, and publish what has changed."""
        self._read()
        self._update_tasks()
        if self._viewer is not None:
            self.shown = self._viewer.shown
        pi = PiState() if self._listener is None else self._listener.state
        exists = self.folder.is_dir()
        self._existed |= exists
        program = find_newest_program(self.folder)
        last_row_utc = ""
        if self._history is not None:
            last_row_utc = self._history.last_row_utc
        inputs = Inputs(
            folder=self.folder,
            history=self._history,
            signs=self._read_life_signs(pi),
            pi=pi,
            shown=self.shown,
            control=self.control,
            problem=self._problem,
            program=program,
            failure=explain_failure(program),
            gone=self._existed and not exists,
            verdict=self._products.look(last_row_utc),
        )
        self.state = self.state.publish(make_snapshot(inputs))
        self.motion = self.motion.publish(make_motion(inputs))

    def _read(self) -> None:
        """Read what was appended to the files."""
        facts = self._manifest.look()
        # A missing folder may come back under its name, if it was renamed for a while. A folder without a manifest is a
        # new one.
        is_new_folder = self._history is not None and self.folder.is_dir() and not self._manifest.file.path.exists()
        if self._manifest.file.replaced or is_new_folder:
            self._close_parts()
            self._begin()
            self.shown = ShownResults()
            facts = self._manifest.look()
        # Content that is read at the first look may be old: it is not a sign that the scan's program is alive.
        if facts and self._looked:
            self._grown_at = time.monotonic()
        self._looked = True
        for fact in facts:
            try:
                if self._history is None and isinstance(fact, ScanStarted):
                    self._history = ScanHistory(self._manifest.content, fact)
                elif isinstance(fact, OtherFact) and fact.problem:
                    self._problem = f"{self.folder / MANIFEST}: unreadable {fact.kind}: {fact.problem}"
                elif self._history is not None:
                    self._history.add_fact(fact)
            except (PolysightError, ValueError) as e:
                self._problem = f"{self.folder / MANIFEST}: unreadable {type(fact).__name__}: {e}"
        if self._history is not None:
            self._history.add_events(self._events.look())

    def _update_tasks(self) -> None:
        """Start and stop the row viewer and the listener as needed."""
        history = self._history
        if history is None:
            return
        if self._viewer is None:
            self._viewer = RowViewer(self.folder, self._manifest.content)
            self._viewer.start()
        self._viewer.show_rows(history.takes)
        if history.ended is None and self._listener is None:
            self._listener = PiListener(history.instrument, history.scan_id)
        elif history.ended is not None and self._listener is not None:
            self._listener.close()
            self._listener = None

    def _read_life_signs(self, pi: PiState) -> LifeSigns:
        """Return the signs of life of the scan program and the Pi."""
        now = time.monotonic()
        wall_s = time.time()
        life = read_life(self.folder)
        life_s = None if life is None else life.written_s
        if life_s is not None and life_s != self._life_s:
            # The first sign of life that is read here may be old: its age is the difference of two clocks. Each later
            # one is new when it is found, even if the file system's clock differs from this one.
            age_s = 0.0
            if self._life_s is None:
                age_s = max(0.0, wall_s - life_s)
            self._life_s = life_s
            self._life_at = now - age_s
        killed = life is not None and life.killed
        if life is None:
            patience_s = GRACE_S
            if self._history is not None and self._history.row_seconds is not None:
                row_s, _ = self._history.row_seconds
                patience_s = max(GRACE_S, UNATTENDED_ROWS * row_s)
            is_alive = now - self._grown_at < patience_s
        else:
            is_alive = not killed and now - self._life_at < self._lapse_s
        # Time of the last sign of life, seconds since 1970; it is shown only if the program is not alive.
        alive_s = 0
        if not is_alive:
            alive_s = round(life_s or self._manifest.file.modified_s)
        return LifeSigns(
            life=life,
            alive=is_alive,
            killed=killed,
            alive_s=alive_s,
            pi_silent_s=now - pi.heard_s if pi.heard_s else None,
            pi_limit_s=PI_LIMIT_S,
            now_s=wall_s,
        )

    def _close_parts(self) -> None:
        """Stop the row viewer and the listener, if there are any."""
        for part in (self._viewer, self._listener):
            if part is not None:
                part.close()

    def close(self) -> None:
        """Stop all threads."""
        self._ended.set()
        if self._thread.is_alive():
            self._thread.join()
        self._close_parts()
