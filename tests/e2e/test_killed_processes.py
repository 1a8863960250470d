"""SIGKILL of the host, the Pi, or both, at any point: the scan resumes, and its image is that of an undisturbed scan.

The programs are real processes on a simulated rig. Each kill has a number, which determines when it comes: after a
random time, or at an exact operation on a file (killed_at.py), in the scan or in the resume after it. With `--long`
there are 50 kills. Scans without kills count these operations: a kind of operation that no program executes would test
nothing.
"""

from __future__ import annotations

import hashlib
import json
import random
import signal
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from tests.support.paths import REPO
from tests.support.products import skip_rendering
from tests.support.scenes import write_small_scene
from tests.support.store.facts import load_facts

from polysight.pipeline import Pipeline
from polysight.results.verdict import NoResult
from polysight.store import manifest
from polysight.store.logs import read_events
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared.errors import DeviceError, ScanError
from polysight_shared.messages import RowStarted

pytestmark = pytest.mark.slow
KILLED_AT = REPO / "tests/support/killed_at.py"
ROWS = 4
SCENE = write_small_scene(columns=6, rows=ROWS, step_mm=(20.0, 20.0), pulses=4, seed=4)
# Simulated seconds per second.
TIME_SCALE = 50.0
# Options of a scan: without processing, or with the box of the metal plate, which is not found with so few positions.
NO_PROCESSING = ("--no-process",)
METAL = ("--metal", "0,0,50,50")
# A row has one data file (.bin) of each of the two receivers RH and RV.
DATA_FILES = 2 * ROWS
# Longest wait before a kill. Before the first row it includes the program's start, about a second.
LONGEST_WAIT_S = 0.4
LONGEST_WAIT_AT_START_S = 2.0
# Number of kills. Six are one of each kind, see `Kill.draw`.
KILLS = 6
KILLS_LONG = 50


class Place(NamedTuple):
    """A place in a program: its `nth` call of `os.<operation>` for a path that ends in `suffix`, counted from 1.

    A write (pwrite) is killed when half of it is written, any other operation before it is executed; see killed_at.py.
    """

    operation: str
    suffix: str
    nth: int


def list_places(operation: str, suffix: str, last: int, first: int = 1) -> list[Place]:
    """Return the places of the operations from the `first` to the `last`."""
    return [Place(operation, suffix, nth) for nth in range(first, last + 1)]


# How often a scan executes an operation need not be known: a place that it does not reach kills nothing. A manifest has
# a first line, one for each row, and a few others, hence the numbers above ROWS.
HOST_PLACES = [
    # The data of a row are on the disk, and none of its two files, or only the first one, has its final name.
    *list_places("rename", ".bin", last=DATA_FILES),
    # Both files have their names. RV comes last: its folder is flushed, and the row is not in the manifest yet.
    *list_places("fsync", "raw/RV", last=ROWS),
    # Half a line is in the manifest.
    *list_places("pwrite", "manifest.jsonl", last=ROWS + 2),
    # A whole line is in the manifest, not yet flushed. The first line is left to the writes above.
    *list_places("fsync", "manifest.jsonl", first=2, last=ROWS + 4),
    # Half a record is in the file of events.
    *list_places("pwrite", "events.msgpack", last=ROWS + 2),
]
# The Pi's journal gets a record for the beginning and end of the run and of each row, and for each position: 34 in this
# scan. Several are written and flushed together, so that there are fewer operations.
PI_PLACES = [
    # Half of the records is in the journal.
    *list_places("pwrite", ".journal", last=29),
    *list_places("fsync", ".journal", last=11),
    # The journal is being opened.
    Place("ftruncate", ".journal", 1),
]
RESUME_PLACES = [
    # The torn end of the file is being cut off.
    Place("ftruncate", "manifest.jsonl", 1),
    Place("ftruncate", "events.msgpack", 1),
    Place("pwrite", "manifest.jsonl", 1),
    Place("pwrite", "events.msgpack", 1),
    Place("rename", ".bin", 1),
    Place("rename", ".bin", 2),
    Place("fsync", "manifest.jsonl", 3),
]


@dataclass
class Kill:
    """One kill: which programs are killed and when, and at which places the resumes after it are killed.

    Programs are killed at `place`; without one, `wait_s` seconds after `rows` rows are committed (-1: after the start,
    when the scan has possibly not begun).
    """

    number: int
    host: bool
    pi: bool
    rows: int = 0
    wait_s: float = 0.0
    place: Place | None = None
    resumes: list[Place] = field(default_factory=list)

    @staticmethod
    def draw(number: int) -> Kill:
        """Draw the kill with this number; of six in succession two kill the host, two the Pi, and two both.

        Of the two that kill one program the first is at a place. Kills of both programs come after a time, because a
        place is in one program only.
        """
        rng = random.Random(number)
        pair, number_in_pair = divmod(number % 6, 2)
        host = pair in (0, 2)
        pi = pair in (1, 2)
        kill = Kill(number, host, pi)
        if number_in_pair == 1 or (host and pi):
            kill.rows = rng.randrange(-1, ROWS)
            longest_wait_s = LONGEST_WAIT_AT_START_S if kill.rows < 0 else LONGEST_WAIT_S
            kill.wait_s = rng.uniform(0.0, longest_wait_s)
        else:
            kill.place = rng.choice(HOST_PLACES if host else PI_PLACES)
        # Half of the scans whose host was killed are killed again, once or twice, while they resume.
        if host and rng.random() < 0.5:
            kill.resumes = rng.choices(RESUME_PLACES, k=rng.randint(1, 2))
        return kill


class KillableRig:
    """A simulated rig whose programs can be killed, with the data of an undisturbed scan for comparison."""

    def __init__(self, rig: Any) -> None:
        self.rig = rig
        # How often programs reached each kind of place, by the name of the program and the kind.
        self.reached_kinds: Counter[str] = Counter()
        # Number of commands started so far, which is in the name of their files of reached places.
        self.commands_started = 0
        # Files of reached places of the newest command of the host, and of the running Pi.
        self.host_hits = Path()
        self.pi_hits = Path()
        undisturbed = rig.folder / "undisturbed"
        self.restart_pi(list_kinds(PI_PLACES))
        assert self.scan(undisturbed, list_kinds(HOST_PLACES)).wait().status == 0
        self.add_reached_kinds("host", self.host_hits)
        self.add_reached_kinds("Pi", self.pi_hits)
        self.restart_pi()
        self.true_digests = compute_row_digests(undisturbed)
        self.true_image = form_image_bytes(undisturbed)

    def start(self, places: Sequence[Place], *command: str | Path) -> tuple[Any, Path]:
        """Start a command that kills itself at the first of these places; return it and its file of reached places."""
        self.commands_started += 1
        hits = self.rig.folder / f"hits-{self.commands_started}"
        hits.touch()
        if places:
            places_text = ",".join(f"{place.operation}:{place.suffix}:{place.nth}" for place in places)
            command = ("python", KILLED_AT, hits, places_text, *command)
        return self.rig.start(*command), hits

    def scan(self, folder: Path, places: Sequence[Place] = (), options: Sequence[str] = NO_PROCESSING) -> Any:
        """Start a scan, or resume it if its manifest has a first line."""
        if has_begun(folder):
            command = ("resume", folder)
        else:
            command = ("scan", "--config", self.rig.config, "--out", folder)
        program, self.host_hits = self.start(places, "polysight", *command, *options)
        return program

    def restart_pi(self, places: Sequence[Place] = ()) -> None:
        """Restart the program of the Pi, as systemd does. With places, it kills itself there in its next scan."""
        self.rig.pi.kill()
        wires = self.rig.folder / "rig" / "wires.sock"
        run = ("polysight-pi", "run", "--config", self.rig.config, "--wires", wires)
        self.rig.pi, self.pi_hits = self.start(places, *run)
        self.rig.pi.wait_ready()

    def add_reached_kinds(self, program: str, hits: Path) -> None:
        """Remember the places that a program reached."""
        self.reached_kinds.update(f"{program} {kind}" for kind in hits.read_text().splitlines())

    def list_kinds_not_reached(self, program: str, places: Sequence[Place]) -> list[Place]:
        """Return the kinds of these places that the program reached in no scan so far."""
        kinds = list_kinds(places)
        return [kind for kind in kinds if not self.reached_kinds[f"{program} {kind.operation}:{kind.suffix}"]]

    @staticmethod
    def check_died(status: int | None, place: Place, hits: Path) -> None:
        """Check that a program died if it reached its place, and only then."""
        operations_done = hits.read_text().splitlines().count(f"{place.operation}:{place.suffix}")
        was_killed = status == -signal.SIGKILL
        assert was_killed == (operations_done >= place.nth), (
            f"{place}: {operations_done} times there, exit status {status}"
        )

    def begin_and_kill(self, kill: Kill, folder: Path) -> None:
        """Begin a scan, kill its programs as given, and wait until the host has ended. The Pi is restarted."""
        places = [kill.place] if kill.place else []
        if kill.pi and places:
            self.restart_pi(places)
        host = self.scan(folder, places if kill.host else ())

        def has_rows_or_ended() -> bool:
            return host.process.poll() is not None or len(list_committed(folder)) >= kill.rows

        def pi_or_host_ended() -> bool:
            return self.rig.pi.process.poll() is not None or host.process.poll() is not None

        if kill.place is None:
            self.rig.wait_for(has_rows_or_ended, f"{kill.rows} rows")
            time.sleep(kill.wait_s)
            if kill.host:
                host.kill()
        elif kill.pi:
            self.rig.wait_for(pi_or_host_ended, "the Pi at its place, or the scan's end")
            self.check_died(self.rig.pi.process.poll(), kill.place, self.pi_hits)
        if kill.pi:
            self.restart_pi()
        ended = host.wait()
        if kill.place and kill.host:
            self.check_died(ended.status, kill.place, self.host_hits)
        if kill.host:
            # 0: the scan ended before the kill.
            assert ended.status in (-signal.SIGKILL, 0), ended.err
        else:
            # Without its Pi the host reports a lost device or an incomplete scan, unless all rows were complete.
            assert ended.status in (0, DeviceError.exit_status, ScanError.exit_status), ended.err

    def check(self, kill: Kill) -> list[int]:
        """Kill a scan, resume it, and check that its data and image are those of the undisturbed scan.

        Returns the number of rows that each resume has scanned again.
        """
        folder = self.rig.folder / f"scan-{kill.number}"
        self.begin_and_kill(kill, folder)
        retaken_rows = []
        # The last resume is not killed.
        for place in [*kill.resumes, None]:
            digests_before = check_committed_rows(folder, self.true_digests)
            if place is None:
                resumed = self.scan(folder, list_kinds(RESUME_PLACES)).wait()
                assert resumed.status == 0, f"{kill}\n{resumed.err}"
            else:
                resumed = self.scan(folder, [place]).wait()
                assert resumed.status in (0, -signal.SIGKILL), f"{kill}\n{resumed.err}"
                self.check_died(resumed.status, place, self.host_hits)
            self.add_reached_kinds("resume", self.host_hits)
            digests_after = check_committed_rows(folder, self.true_digests)
            assert digests_before.items() <= digests_after.items(), kill
            retaken_rows.append(len(list_retaken_rows(folder)))
        assert validate(folder) == [], kill
        assert compute_row_digests(folder) == self.true_digests, kill
        assert form_image_bytes(folder) == self.true_image, kill
        # Only the row that ran at the kill is lost.
        assert max(retaken_rows) <= 1, kill
        starts = [event for event in read_events(folder / "events.msgpack").events if isinstance(event, RowStarted)]
        takes = {(event.row.index, event.take) for event in starts}
        assert len(takes) == len(starts), "each attempt to scan a row has a number of its own"
        return retaken_rows


def list_kinds(places: Sequence[Place]) -> list[Place]:
    """Every kind of these places once, with number 0: a program counts it, and never kills itself there."""
    kinds = dict.fromkeys((place.operation, place.suffix) for place in places)
    return [Place(operation, suffix, 0) for operation, suffix in kinds]


def has_begun(folder: Path) -> bool:
    """True if the manifest of the scan has a whole first line."""
    path = folder / "manifest.jsonl"
    return path.exists() and manifest.read(path).length > 0


def list_committed(folder: Path) -> list[int]:
    """Committed rows of a scan; none if it is not begun."""
    if not has_begun(folder):
        return []
    return list(ScanFolder.load(folder).committed_rows())


def compute_row_digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every committed row of every board."""
    digests = {}
    for row in ScanFolder.load(folder).committed_rows().values():
        for board in row.boards.values():
            content = (folder / board.file).read_bytes()
            digests[board.file] = hashlib.sha256(content).hexdigest()
    return digests


def check_committed_rows(folder: Path, true_digests: dict[str, str]) -> dict[str, str]:
    """SHA-256 of the committed rows of an interrupted scan; all must be good. Empty if the scan is not begun."""
    if not has_begun(folder):
        return {}
    assert [finding for finding in validate(folder) if finding.level == "error"] == []
    digests = compute_row_digests(folder)
    assert digests.items() <= true_digests.items()
    return digests


def list_retaken_rows(folder: Path) -> set[int]:
    """Rows that the last resume had to scan again because they were being scanned when the scan was killed.

    In the manifest the first attempt ("take") at such a row after the resume has a number above 1. A row that this
    resume scans twice, because it rejects its own first attempt, has number 1 first and does not count.
    """
    if not has_begun(folder):
        return set()
    has_resumed = False
    first_takes: dict[int, int] = {}
    for fact in load_facts(folder):
        if fact["fact"] == "scan_resumed":
            has_resumed = True
            first_takes.clear()
        elif has_resumed and fact["fact"] in ("row_committed", "row_rejected"):
            first_takes.setdefault(fact["row"], fact["take"])
    return {row for row, take in first_takes.items() if take > 1}


def form_image_bytes(folder: Path) -> bytes:
    """The final image's bytes, both channels and their mask."""
    pipeline = Pipeline(ScanFolder.load(folder))
    for row in pipeline.source.rows():
        pipeline.add_row(row)
    images = pipeline.form_images()
    return b"".join(part.tobytes() for part in (images.h, images.v, images.valid))


@pytest.fixture(scope="module")
def killable_rig(running_rig, tmp_path_factory: pytest.TempPathFactory) -> Iterator[KillableRig]:
    with running_rig(tmp_path_factory.mktemp("killed"), time_scale=TIME_SCALE, scene=SCENE) as rig:
        yield KillableRig(rig)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Give each test with an argument `number` the numbers of the kills."""
    count = KILLS_LONG if metafunc.config.getoption("--long") else KILLS
    if "number" in metafunc.fixturenames:
        metafunc.parametrize("number", range(count))


def test_a_killed_scan_resumes_to_the_undisturbed_image(killable_rig: KillableRig, number: int, record_property):
    kill = Kill.draw(number)
    retaken_rows = killable_rig.check(kill)
    record_property("kill", f"{kill}; rows retaken by each resume: {retaken_rows}")
    print(f"{kill}: rows retaken by each resume {retaken_rows}")  # noqa: T201 - shown with -s


def test_programs_reach_every_kind_of_place(killable_rig: KillableRig):
    """A kind that no program reaches kills nothing: its file was renamed, or is written by another operation."""
    # Two more kills leave an incomplete last line in the manifest and an incomplete last event, which the resume cuts
    # off. They are needed if this test runs alone, or if the random kills left neither.
    torn_manifest = Kill(number=100, host=True, pi=False, place=Place("pwrite", "manifest.jsonl", 4))
    torn_events = Kill(number=101, host=True, pi=False, place=Place("pwrite", "events.msgpack", 3))
    for kill in (torn_manifest, torn_events):
        if killable_rig.list_kinds_not_reached("resume", RESUME_PLACES):
            killable_rig.check(kill)
    for program, places in (("host", HOST_PLACES), ("Pi", PI_PLACES), ("resume", RESUME_PLACES)):
        not_reached = killable_rig.list_kinds_not_reached(program, places)
        assert not_reached == [], f"{program}: {killable_rig.reached_kinds}"


def test_products_of_a_killed_scan_are_those_of_the_undisturbed_scan(killable_rig: KillableRig):
    """Rows are processed during a scan, which is killed and resumed; the other scan is processed after its end.

    Both have no result: the only plate is the metal reference, so that no patch is left whose material could be named.
    """
    folder = killable_rig.rig.folder / "live"
    # The data files of two rows have their names, and the first one of the third row gets its own.
    scan = killable_rig.scan(folder, [Place("rename", ".bin", 5)], METAL)
    assert scan.wait().status == -signal.SIGKILL
    resumed = killable_rig.scan(folder, options=METAL).wait()
    assert resumed.status == NoResult.exit_status, resumed.err
    out = killable_rig.rig.folder / "products"
    undisturbed = killable_rig.rig.folder / "undisturbed"
    with skip_rendering():
        processed = killable_rig.rig.run_here("process", undisturbed, "--out", out, *METAL)
    assert processed.status == NoResult.exit_status, processed.err
    with np.load(folder / "products" / "image.npz") as live_image, np.load(out / "image.npz") as true_image:
        assert live_image.files == true_image.files
        for name in live_image.files:
            np.testing.assert_array_equal(live_image[name], true_image[name])
    live_materials = json.loads((folder / "products" / "materials.json").read_bytes())
    true_materials = json.loads((out / "materials.json").read_bytes())
    assert live_materials.pop("scan_id") != true_materials.pop("scan_id")
    assert live_materials == true_materials


def test_a_scan_without_its_pi_fails_and_resumes_with_a_pi_whose_journal_is_lost(killable_rig: KillableRig):
    """A Pi that has lost its journal (by an exchanged SD card) continues after the last event that the host has."""
    folder = killable_rig.rig.folder / "lost"
    # The Pi kills itself: on a busy machine the scan might end before the test sees its rows and kills it. At the sixth
    # flush of the journal some of the rows are committed, and not all.
    killable_rig.restart_pi([Place("fsync", ".journal", 6)])
    ended = killable_rig.scan(folder).wait()
    assert ended.status == DeviceError.exit_status
    assert 0 < len(list_committed(folder)) < ROWS
    assert ended.message.startswith("polysight scan: the Pi at tcp://")
    assert "polysight-pi" in ended.message
    digests_before = check_committed_rows(folder, killable_rig.true_digests)
    refused = killable_rig.scan(folder).wait()
    assert refused.status == DeviceError.exit_status
    assert "the Pi at tcp://" in refused.message
    known_events = len(read_events(folder / "events.msgpack").events)
    scan_id = ScanFolder.load(folder).scan_id
    (killable_rig.rig.folder / "rig" / "journal" / f"{scan_id}.journal").unlink()
    killable_rig.restart_pi()
    resumed = killable_rig.scan(folder).wait()
    assert resumed.status == 0, resumed.err
    assert f"journal of this scan ends {known_events} events before" in " ".join(resumed.err.split())
    digests_after = compute_row_digests(folder)
    assert digests_before.items() <= digests_after.items()
    assert validate(folder) == []
    assert digests_after == killable_rig.true_digests
    assert len(list_retaken_rows(folder)) <= 1
