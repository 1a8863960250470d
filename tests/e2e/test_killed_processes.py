"""SIGKILL of the host, the Pi, or both, at any point: the scan resumes, and its image is that of an undisturbed scan.

Real processes on a simulated rig. The number of a kill determines its point: some come after a drawn time, others at
an exact operation on a file (killed_at.py), in the scan or in the resume after it. `--long` takes 50 of them. Scans
without kills count these operations: a kind of operation that no program executes would test nothing.
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
from typing import Any

import numpy as np
import pytest
from tests.support.paths import REPO
from tests.support.products import skip_rendering
from tests.support.scenes import write_small_scene
from tests.support.store.facts import load_facts

from polysight.pipeline import Pipeline
from polysight.store import manifest
from polysight.store.logs import read_events
from polysight.store.scan_folder import ScanFolder
from polysight.store.validation import validate
from polysight_shared.messages import RowStarted

pytestmark = pytest.mark.slow
KILLED_AT = REPO / "tests/support/killed_at.py"
NO_RESULT = 7
SCENE = write_small_scene(6, 4, step_mm=(20.0, 20.0), pulses=4, seed=4)
# The aperture is too small for the plate to be found by itself
METAL = ["--metal", "0,0,50,50"]
ROWS = 4
FILES = 8
Place = tuple[str, str, int]
HOST_PLACES = [
    *(("rename", ".bin", n) for n in range(1, FILES + 1)),  # rows durable, not named: before, and between two boards
    *(("fsync", "raw/RV", n) for n in range(1, ROWS + 1)),  # named, not committed
    *(("pwrite", "manifest.jsonl", n) for n in range(1, ROWS + 3)),  # half a line
    *(("fsync", "manifest.jsonl", n) for n in range(2, ROWS + 5)),  # a line not synced
    *(("pwrite", "events.msgpack", n) for n in range(1, ROWS + 3)),
]
PI_PLACES = [
    *(("pwrite", ".journal", n) for n in range(1, 30)),  # half a record
    *(("fsync", ".journal", n) for n in range(1, 12)),
    ("ftruncate", ".journal", 1),  # while the journal is opened
]
RESUME_PLACES = [
    ("ftruncate", "manifest.jsonl", 1),  # while the torn end is cut off
    ("ftruncate", "events.msgpack", 1),
    ("pwrite", "manifest.jsonl", 1),
    ("pwrite", "events.msgpack", 1),
    ("rename", ".bin", 1),
    ("rename", ".bin", 2),
    ("fsync", "manifest.jsonl", 3),
]


@dataclass
class Kill:
    """One trial: which programs are killed, where, and how its resumes are killed.

    Either after `rows` committed rows (-1: none, and possibly before the scan is begun) and `wait_s` seconds, or at
    a place.
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
        rng = random.Random(number)
        kind = number % 6
        host, pi = [(True, False), (False, True), (True, True)][kind // 2]
        kill = Kill(number, host, pi)
        if kind % 2 or (host and pi):
            kill.rows = rng.randrange(-1, ROWS)
            kill.wait_s = rng.uniform(0.0, 2.0 if kill.rows < 0 else 0.4)
        else:
            kill.place = rng.choice(HOST_PLACES if host else PI_PLACES)
        if host and rng.random() < 0.5:
            kill.resumes = rng.choices(RESUME_PLACES, k=rng.randint(1, 2))
        return kill


class Killed:
    """The rig, its undisturbed scan, and the check of each kill."""

    def __init__(self, rig: Any) -> None:
        self.rig = rig
        # Kinds of places that programs reached, with the name of the program
        self.met: Counter[str] = Counter()
        self.armed = 0
        self.restart_pi(list_kinds(PI_PLACES))
        assert self.scan(rig.folder / "undisturbed", list_kinds(HOST_PLACES)).wait().status == 0
        self.note("host", self.hits)
        self.note("Pi", self.pi_hits)
        self.restart_pi()
        self.rows = compute_row_digests(rig.folder / "undisturbed")
        self.image = image(rig.folder / "undisturbed")

    def start(self, places: Sequence[Place], *command: str | Path) -> tuple[Any, Path]:
        """Start a command that kills itself at the first of these places; return it and its file of reached places."""
        self.armed += 1
        hits = self.rig.folder / f"hits-{self.armed}"
        hits.touch()
        words = ",".join(f"{operation}:{suffix}:{nth}" for operation, suffix, nth in places)
        return self.rig.start(*(["python", KILLED_AT, hits, words] if places else []), *command), hits

    def scan(self, folder: Path, places: Sequence[Place] = (), *more: str) -> Any:
        """Start a scan, or resume it if its manifest has a first line."""
        if has_begun(folder):
            command = ("resume", folder)
        else:
            command = ("scan", "--config", self.rig.config, "--out", folder)
        program, self.hits = self.start(places, "polysight", *command, *(more or ["--no-process"]))
        return program

    def restart_pi(self, places: Sequence[Place] = ()) -> None:
        """Restart the Pi, as systemd does. With places, its next scan kills it there."""
        self.rig.pi.kill()
        wires = self.rig.folder / "rig" / "wires.sock"
        run = ("polysight-pi", "run", "--config", self.rig.config, "--wires", wires)
        self.rig.pi, self.pi_hits = self.start(places, *run)
        self.rig.pi.wait_ready()

    def note(self, who: str, hits: Path) -> None:
        """Remember the places that a program reached."""
        self.met.update(f"{who} {kind}" for kind in hits.read_text().splitlines())

    @staticmethod
    def check_died(status: int | None, place: Place, hits: Path) -> None:
        """Check that a program died if it reached its place, and only then."""
        operation, suffix, nth = place
        matching_hits = hits.read_text().splitlines().count(f"{operation}:{suffix}")
        assert (status == -signal.SIGKILL) == (matching_hits >= nth), (
            f"{place}: {matching_hits} times there, exit status {status}"
        )

    def strike(self, kill: Kill, folder: Path) -> None:
        """Begin a scan, kill its processes as given, and wait until none of them runs any more."""
        places = [kill.place] if kill.place else []
        if kill.pi and places:
            self.restart_pi(places)
        host = self.scan(folder, places if kill.host else ())
        if kill.place is None:
            has_ended = lambda: host.process.poll() is not None or len(list_committed(folder)) >= kill.rows  # noqa: E731
            self.rig.wait_for(has_ended, f"{kill.rows} rows")
            time.sleep(kill.wait_s)
            if kill.host:
                host.kill()
        elif kill.pi:
            ended = lambda: self.rig.pi.process.poll() is not None or host.process.poll() is not None  # noqa: E731
            self.rig.wait_for(ended, "the Pi at its place, or the scan's end")
            self.check_died(self.rig.pi.process.poll(), kill.place, self.pi_hits)
        if kill.pi:
            self.restart_pi()
        ended = host.wait()
        if kill.place and kill.host:
            self.check_died(ended.status, kill.place, self.hits)
        assert ended.status in ((-signal.SIGKILL, 0) if kill.host else (0, 5, 6)), ended.err

    def check(self, kill: Kill) -> list[int]:
        """Kill, resume, compare. Returns the number of rows that each resume has retaken."""
        folder = self.rig.folder / f"scan-{kill.number}"
        self.strike(kill, folder)
        retaken_rows = []
        for place in [*kill.resumes, None]:
            safe_before = check_committed_rows(folder, self.rows)
            ended = self.scan(folder, [place] if place else list_kinds(RESUME_PLACES)).wait()
            assert ended.status == 0 or (place and ended.status == -signal.SIGKILL), f"{kill}\n{ended.err}"
            if place:
                self.check_died(ended.status, place, self.hits)
            self.note("resume", self.hits)
            assert safe_before.items() <= check_committed_rows(folder, self.rows).items(), kill
            retaken_rows.append(len(list_retaken_rows(folder)))
        assert validate(folder) == [], kill
        assert compute_row_digests(folder) == self.rows, kill
        assert image(folder) == self.image, kill
        assert max(retaken_rows) <= 1, kill
        started = [e for e in read_events(folder / "events.msgpack").events if isinstance(e, RowStarted)]
        assert len({(e.row.index, e.take) for e in started}) == len(started), "a take was used twice"
        return retaken_rows


def list_kinds(places: Sequence[Place]) -> list[Place]:
    """Every kind of these places once, with number 0: it is counted, but never kills."""
    return [(operation, suffix, 0) for operation, suffix in dict.fromkeys(place[:2] for place in places)]


def has_begun(folder: Path) -> bool:
    path = folder / "manifest.jsonl"
    return path.exists() and manifest.read(path).length > 0


def compute_row_digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every committed row of every board."""
    files = [b.file for row in ScanFolder.load(folder).committed_rows().values() for b in row.boards.values()]
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in files}


def check_committed_rows(folder: Path, truth: dict[str, str]) -> dict[str, str]:
    """SHA-256 of the committed rows of an interrupted scan; all must be good. Empty if the scan is not begun."""
    if not has_begun(folder):
        return {}
    assert [f for f in validate(folder) if f.level == "error"] == []
    row_states = compute_row_digests(folder)
    assert row_states.items() <= truth.items()
    return row_states


def list_retaken_rows(folder: Path) -> set[int]:
    """Rows that the last resume has retaken, by the manifest, without those that it rejected itself."""
    if not has_begun(folder):
        return set()
    facts = load_facts(folder)
    since = max((i for i, f in enumerate(facts) if f["fact"] == "scan_resumed"), default=len(facts))
    first_takes: dict[int, int] = {}
    for fact in facts[since:]:
        if fact["fact"] in ("row_committed", "row_rejected"):
            first_takes.setdefault(fact["row"], fact["take"])
    return {row for row, take in first_takes.items() if take > 1}


def image(folder: Path) -> bytes:
    """The final image's bytes, both channels and their mask."""
    pipeline = Pipeline(ScanFolder.load(folder))
    for row in pipeline.source.rows():
        pipeline.add_row(row)
    images = pipeline.form_images()
    return b"".join(part.tobytes() for part in (images.h, images.v, images.valid))


@pytest.fixture(scope="module")
def killed_rig(running_rig, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Killed]:
    with running_rig(tmp_path_factory.mktemp("killed"), time_scale=50.0, scene=SCENE) as rig:
        yield Killed(rig)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    count = 50 if metafunc.config.getoption("--long") else 6
    if "number" in metafunc.fixturenames:
        metafunc.parametrize("number", range(count))


def test_killed(killed_rig: Killed, number: int, record_property):
    kill = Kill.draw(number)
    retaken_rows = killed_rig.check(kill)
    record_property("kill", f"{kill}; rows retaken by each resume: {retaken_rows}")
    print(f"{kill}: rows retaken by each resume {retaken_rows}")  # noqa: T201 - shown with -s


def test_every_kind_of_place_is_reached(killed_rig: Killed):
    """Otherwise nothing is killed: a file has another name by now, or is written in another way."""

    def never(program: str, places: Sequence[Place]) -> list[Place]:
        return [place for place in list_kinds(places) if not killed_rig.met[f"{program} {place[0]}:{place[1]}"]]

    for number, place in ((100, ("pwrite", "manifest.jsonl", 4)), (101, ("pwrite", "events.msgpack", 3))):
        # Needed if this test runs alone, or the kills above left no torn manifest or torn events
        if never("resume", RESUME_PLACES):
            killed_rig.check(Kill(number, host=True, pi=False, place=place))
    for program, places in (("host", HOST_PLACES), ("Pi", PI_PLACES), ("resume", RESUME_PLACES)):
        assert never(program, places) == [], f"{program}: {killed_rig.met}"


def test_products_of_a_killed_scan(killed_rig: Killed):
    """Products of processing during a scan that was killed and resumed are those of the undisturbed scan."""
    folder = killed_rig.rig.folder / "live"
    scan = killed_rig.scan(folder, [("rename", ".bin", 5)], *METAL)
    assert scan.wait().status == -signal.SIGKILL
    resumed = killed_rig.scan(folder, (), *METAL).wait()
    assert resumed.status == NO_RESULT, resumed.err  # one plate only: all rows are there, and no patch is named
    out = killed_rig.rig.folder / "products"
    with skip_rendering():
        processed = killed_rig.rig.run_here("process", killed_rig.rig.folder / "undisturbed", "--out", out, *METAL)
    assert processed.status == NO_RESULT, processed.err
    with np.load(folder / "products" / "image.npz") as live, np.load(out / "image.npz") as undisturbed:
        assert live.files == undisturbed.files
        for name in live.files:
            np.testing.assert_array_equal(live[name], undisturbed[name])
    documents = [json.loads((products / "materials.json").read_bytes()) for products in (folder / "products", out)]
    assert documents[0].pop("scan_id") != documents[1].pop("scan_id")
    assert documents[0] == documents[1]


def test_pi_is_lost_with_its_journal(killed_rig: Killed):
    """Without a Pi the error says so; a Pi with an empty card continues after the host's last event, with a notice."""
    folder = killed_rig.rig.folder / "lost"
    # It kills itself: on a busy machine the scan might end before the test sees its rows and kills it.
    killed_rig.restart_pi([("fsync", ".journal", 6)])
    ended = killed_rig.scan(folder).wait()
    assert ended.status == 5
    assert 0 < len(list_committed(folder)) < ROWS
    assert ended.message.startswith("polysight scan: the Pi at tcp://")
    assert "polysight-pi" in ended.message
    safe_before = check_committed_rows(folder, killed_rig.rows)
    refused = killed_rig.scan(folder).wait()
    assert refused.status == 5
    assert "the Pi at tcp://" in refused.message
    known_events = len(read_events(folder / "events.msgpack").events)
    scan_id = ScanFolder.load(folder).scan_id
    (killed_rig.rig.folder / "rig" / "journal" / f"{scan_id}.journal").unlink()
    killed_rig.restart_pi()
    resumed = killed_rig.scan(folder).wait()
    assert resumed.status == 0, resumed.err
    assert f"journal of this scan ends {known_events} events before" in " ".join(resumed.err.split())
    assert safe_before.items() <= compute_row_digests(folder).items()
    assert (validate(folder), compute_row_digests(folder)) == ([], killed_rig.rows)
    assert len(list_retaken_rows(folder)) <= 1


def list_committed(folder: Path) -> list[int]:
    """Committed rows of a scan; none if it is not begun."""
    return list(ScanFolder.load(folder).committed_rows()) if has_begun(folder) else []
