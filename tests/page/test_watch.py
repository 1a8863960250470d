"""The page's events describe the content of a growing folder, also for viewers that come late."""

import json
import shutil
import socket
import subprocess

import msgspec
import pytest
from hypothesis import given, settings, strategies as st
from msgspec.structs import replace
from tests.support.page.live_view import GrowingScan
from tests.support.processes import wait_for
from tests.support.products import REASON, write_judged_products
from tests.support.store.facts import parse_fact

from polysight.acquisition.control import ALIVE_FILE, CONTROL_FOLDER, SignOfLife, read_start_ticks
from polysight.page.watch import EventTail, ManifestTail, Motion, ProductsTail, Versioned, Watch, draw
from polysight.pipeline import Pipeline
from polysight.products import SCAN, write_json
from polysight.results import ScanFacts
from polysight.store import manifest
from polysight.store.logs import read_events
from polysight.store.scan_folder import EVENTS, MANIFEST, ScanFolder

# Time after which a program without a sign of life counts as ended, so long that no test reaches it.
NEVER_LAPSES_S = 1e6


def read_state(watch: Watch) -> dict:
    """The newest snapshot, as a viewer gets it."""
    return json.loads(watch.state.data)


def has_rows(rows: int):
    """Function that is true of a state whose pictures have this number of rows."""

    def has_these_rows(state: dict) -> bool:
        pictures = state.get("pictures")
        return pictures is not None and pictures["rows"] == rows

    return has_these_rows


@pytest.fixture(scope="module")
def truth(finished_scan):
    """The finished scan, its pipeline, and the pictures of the pipeline's images."""
    scan = ScanFolder.load(finished_scan)
    pipeline = Pipeline(scan, live=True)
    for row in scan.rows():
        pipeline.add_row(row)
    return scan, pipeline, draw(pipeline.builder.current())


def test_each_content_that_differs_is_a_new_version():
    first = Versioned(0, b"").publish(Motion(now_s=1))
    second = first.publish(Motion(now_s=2))
    third = second.publish(Motion(now_s=1))
    assert [first.version, second.version, third.version] == [1, 2, 3]
    assert third.publish(Motion(now_s=1)) is third


def test_a_finished_folder_is_shown_unchanged(finished_scan, truth, watching):
    scan, pipeline, pictures = truth
    watch = watching(finished_scan)
    watch.wait_for(has_rows(scan.plan.rows))
    state = read_state(watch)
    # One letter for each row: c is committed.
    assert (state["status"]["level"], state["scan"]["marks"]) == ("done", "ccc")
    assert (state["scan"]["rows"], state["scan"]["committed"]) == (3, 3)
    assert state["scan"]["simulated"] is True
    for board in state["boards"]:
        summary = pipeline.quality.boards[board["name"]].summary()
        assert board["frames_received"] == summary.frames_received
        assert board["masked"] == summary.positions_masked
    assert watch.shown.pictures.keys() == pictures.keys()
    for name, picture in pictures.items():
        assert watch.shown.pictures[name].png == picture.png, name
    picture_names = {f"{channel}_{part}" for channel in "hvp" for part in ("amplitude", "phase")}
    assert set(state["pictures"]["scales"]) == picture_names
    assert state["profile"]["row"] == 2
    for board in state["sync"].values():
        assert list(board) == ["0", "1", "2"]
    assert state["notices"] == []


def test_rows_grow_as_they_are_committed(growing: GrowingScan, watching):
    watch = watching(growing.path, lapse_s=NEVER_LAPSES_S)
    assert read_state(watch)["scan"] is None
    growing.touch_alive()
    growing.grow_until("scan_started")
    watch.wait_for(lambda s: s["scan"] is not None)
    assert read_state(watch)["scan"]["marks"] == "..."
    revision = 0
    for row in range(3):
        growing.grow_until("row_committed")
        watch.wait_for(has_rows(row + 1))
        state = read_state(watch)
        committed = row + 1
        assert state["scan"]["marks"] == "c" * committed + "." * (3 - committed)
        assert state["pictures"]["revision"] > revision
        assert state["profile"]["row"] == row
        revision = state["pictures"]["revision"]
    assert read_state(watch)["status"]["level"] == "good"
    growing.grow_until("scan_ended")
    watch.wait_for(lambda s: s["status"]["key"] == "finishing")
    shutil.rmtree(growing.path / CONTROL_FOLDER)
    watch.wait_for(lambda s: s["status"]["level"] == "done")


def test_a_scan_that_becomes_silent_is_reported_as_ended(growing, watching):
    watch = watching(growing.path, lapse_s=2.0)
    growing.grow_until("row_committed")

    def is_alive() -> bool:
        growing.touch_alive()
        state = read_state(watch)
        return state["status"]["level"] == "good" and state["running"]

    wait_for(is_alive, "that the scan is shown as running")
    watch.wait_for(lambda s: s["status"]["key"] in ("frozen", "killed"))
    state = read_state(watch)
    assert not state["running"]
    assert "polysight resume" in state["status"]["do"]
    wait_for(lambda: json.loads(watch.motion.data)["left_s"] is None, "that no time is left")
    wait_for(is_alive, "that the scan is shown as running again")


def test_a_killed_program_is_reported_immediately_however_long_its_timeout_is(growing, watching):
    growing.grow_until("row_committed")
    program = subprocess.Popen(["sleep", "600"])
    life = SignOfLife(program.pid, read_start_ticks(program.pid) or 0, socket.gethostname())
    growing.touch_alive()
    (growing.path / CONTROL_FOLDER / ALIVE_FILE).write_bytes(msgspec.json.encode(life))
    watch = watching(growing.path, lapse_s=NEVER_LAPSES_S)
    watch.wait_for(lambda s: s["running"])
    program.kill()
    program.wait()
    watch.wait_for(lambda s: s["status"]["key"] == "killed")
    assert read_state(watch)["status"]["level"] == "bad"
    assert read_state(watch)["status"]["press"] == ["resume", "repeat"]


def test_an_unfinished_folder_without_a_program_is_reported_immediately(growing, watching):
    growing.grow_until("row_committed")
    assert read_state(watching(growing.path))["status"]["key"] in ("frozen", "killed")


def test_a_damaged_row_is_named_and_the_others_are_shown(growing, watching):
    raw = next((growing.path / "raw" / "RV").glob("0001.bin"))
    content = raw.read_bytes()
    raw.write_bytes(content[:-1] + b"\x55")
    # All facts are written.
    while growing.grow():
        pass
    watch = watching(growing.path)
    watch.wait_for(has_rows(2))
    watch.wait_for(lambda s: len(s["notices"]) == 1)
    assert "0001.bin" in read_state(watch)["notices"][0]["what"]


def test_another_scan_in_the_same_place_begins_afresh(growing, finished_scan, watching):
    growing.grow_until("row_committed")
    watch = watching(growing.path, lapse_s=NEVER_LAPSES_S)
    watch.wait_for(has_rows(1))
    shutil.rmtree(growing.path)
    shutil.copytree(finished_scan, growing.path)
    watch.wait_for(has_rows(3))
    assert read_state(watch)["status"]["level"] == "done"


def test_a_new_scan_of_an_old_name_has_nothing_of_the_old_one(growing, watching):
    growing.grow_until("row_committed")
    watch = watching(growing.path, lapse_s=NEVER_LAPSES_S)
    watch.wait_for(has_rows(1))
    shutil.rmtree(growing.path)
    watch.wait_for(lambda s: s["status"]["key"] == "folder_gone")
    # Its program has not written a manifest yet.
    growing.path.mkdir()
    watch.wait_for(lambda s: s["status"]["key"] == "empty")
    assert read_state(watch)["scan"] is None


def test_looking_on_changes_nothing_in_the_folder(finished_scan, watching, tmp_path):
    folder = tmp_path / "copy"
    shutil.copytree(finished_scan, folder)

    def read_file_times():
        return {p: (p.stat().st_mtime_ns, p.stat().st_size) for p in sorted(folder.rglob("*"))}

    content_before = read_file_times()
    watch = watching(folder, control=True)
    watch.wait_for(has_rows(3))
    watch.close()
    assert read_file_times() == content_before


def test_a_manifest_of_another_release_is_not_taken_for_none(growing, watching):
    growing.write({"fact": "scan_started", "scan_id": "s", "simulated": True, "instrument": {"new": 1}})
    watch = watching(growing.path)
    status = read_state(watch)["status"]
    assert (status["level"], status["headline"]) == ("bad", "This scan cannot be shown")
    assert "polysight validate" in status["do"]


# --- files as they grow ---

# Where a file is cut, as shares of its length.
CUTS = st.lists(st.floats(0, 1), max_size=12)


@pytest.mark.parametrize(("name", "tail"), [(MANIFEST, ManifestTail), (EVENTS, EventTail)])
def test_a_file_that_grows_in_any_pieces_gives_all_its_facts(finished_scan, tmp_path_factory, name, tail):
    raw = (finished_scan / name).read_bytes()
    if name == MANIFEST:
        all_facts = manifest.parse(raw).facts
    else:
        all_facts = read_events(finished_scan / name).events
    # The file is long enough to be cut into several pieces.
    assert len(all_facts) > 4

    @settings(max_examples=20)
    @given(CUTS)
    def check_pieces(cuts: list[float]) -> None:
        path = tmp_path_factory.mktemp("pieces") / name
        reader = tail(path)
        collected = []
        ends = sorted({int(share * len(raw)) for share in cuts} | {len(raw)})
        starts = [0, *ends[:-1]]
        for start, end in zip(starts, ends, strict=True):
            with path.open("ab") as f:
                f.write(raw[start:end])
            collected += reader.look()
            assert collected == all_facts[: len(collected)]
        assert collected == all_facts
        assert reader.look() == []

    check_pieces()


def test_another_file_in_its_place_is_read_from_the_beginning(finished_scan, tmp_path):
    path = tmp_path / MANIFEST
    raw = (finished_scan / MANIFEST).read_bytes()
    path.write_bytes(raw)
    tail = ManifestTail(path)
    first = tail.look()
    path.unlink()
    assert tail.look() == []
    first_line = raw.splitlines(keepends=True)[0]
    (tmp_path / "new").write_bytes(first_line)
    (tmp_path / "new").rename(path)
    assert tail.look() == first[:1]
    assert tail.file.replaced


def test_another_and_longer_file_is_found_after_a_single_look(finished_scan, tmp_path):
    """The file was read once, and then replaced by another before anything was appended to it."""
    path = tmp_path / MANIFEST
    raw = (finished_scan / MANIFEST).read_bytes()
    other_items = [{"fact": "scan_ended", "reason": "another scan" * 50} for _ in raw.splitlines()]
    path.write_bytes(raw)
    tail = ManifestTail(path)
    assert len(tail.look()) == len(other_items)
    (tmp_path / "new").write_bytes(b"".join(map(manifest.encode_line, other_items)))
    (tmp_path / "new").rename(path)
    assert tail.look() == [parse_fact(fact) for fact in other_items]
    assert tail.file.replaced


# --- the verdict ---


def test_the_verdict_follows_the_products(tmp_path):
    tail = ProductsTail(tmp_path)
    # `look` is given the time when the scan was begun; "" is before all products.
    assert tail.look("") is None
    for level in ("care", "none", None, "good"):
        shutil.rmtree(tmp_path / "products", ignore_errors=True)
        write_judged_products(tmp_path / "products", level)
        verdict = tail.look("")
        assert (verdict.level if verdict else None) == level
    (tmp_path / "products" / "materials.json").write_text("{", encoding="utf-8")
    assert tail.look("") is None


def test_images_before_materials_and_earlier_products_are_not_a_result(tmp_path):
    write_judged_products(tmp_path / "products", "good")
    facts = ScanFacts.read(tmp_path / "products" / SCAN)
    write_json(tmp_path / "products" / SCAN, replace(facts, processed_utc="2026-01-01T00:00:00+00:00"))
    tail = ProductsTail(tmp_path)
    assert tail.look("2000-01-01T00:00:00+00:00") is not None
    assert tail.look("2999-01-01T00:00:00+00:00") is None
    (tmp_path / "products" / "materials.json").unlink()
    assert tail.look("") is None


def test_a_verdict_is_shown_when_the_scan_has_ended(growing: GrowingScan, watching):
    growing.grow_until("row_committed")
    write_judged_products(growing.path / "products", "care")
    watch = watching(growing.path)
    watch.wait_for(lambda s: s["scan"] is not None)
    # The products are those of an earlier run of the scan.
    assert read_state(watch)["verdict"] is None
    growing.grow_until("scan_ended")
    watch.wait_for(lambda s: s["verdict"] is not None)
    verdict = read_state(watch)["verdict"]
    assert verdict["level"] == "care"
    assert [{key: r[key] for key in REASON} for r in verdict["reasons"]] == [REASON]
