"""Laws of the journal: after any cut or damage, the records that are read are the first of the written ones.

The file is `MAGIC` and then records: each has a head of 12 bytes and its payload, one event.
"""

import errno
import os
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from hypothesis import given, settings, strategies as st
from tests.support.refusals import expect_refusal

from polysight_pi import journal as journal_module
from polysight_pi.client import replay_events
from polysight_pi.journal import (
    CAPTURE_BYTES,
    DAMAGED_SUFFIX,
    MAGIC,
    SPARE_BYTES,
    Journal,
    JournalFile,
    JournalFullError,
    JournalThread,
    NewEvent,
)
from polysight_shared import messages as m
from polysight_shared.errors import ErrorCode
from polysight_shared.faults import PiFault
from polysight_shared.messages import RunStopped, unpack_event
from polysight_shared.raster import RasterPlan

# Bytes of a record before its payload.
HEAD_BYTES = 12
# Any plan: the journal stores it as it is.
PLAN = RasterPlan(columns=2, rows=2, step_x_mm=1.0, step_y_mm=1.0)
payloads = st.lists(st.binary(max_size=40), max_size=12)


def write_records(path, records):
    """Write a new journal; return the bytes of its file."""
    path.unlink(missing_ok=True)
    journal = JournalFile(path)
    journal.write(records)
    journal.close()
    return path.read_bytes()


def read_all(journal):
    return journal.read(from_seq=1, limit=10**6)


def read_again(path):
    """Open the journal as the next program does; return its records."""
    journal = JournalFile(path)
    events = read_all(journal)
    journal.close()
    return events


@pytest.fixture(autouse=True, scope="module")
def no_waiting_for_the_disk():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(journal_module.os, "fsync", lambda _: None)
        yield


@given(records=payloads)
@settings(max_examples=20, deadline=None)
def test_cut_at_every_byte_leaves_the_whole_records_before_it(tmp_path_factory, records):
    path = tmp_path_factory.mktemp("j") / "a.journal"
    raw = write_records(path, records)
    # Lengths of the file after the magic, and after each record.
    ends = [len(MAGIC)]
    for record in records:
        ends.append(ends[-1] + HEAD_BYTES + len(record))
    for cut in range(len(raw) + 1):
        path.write_bytes(raw[:cut])
        complete_records = sum(end <= cut for end in ends[1:])
        assert read_again(path) == records[:complete_records]
        assert path.stat().st_size == ends[complete_records]


@given(records=st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=8), data=st.data())
@settings(max_examples=60, deadline=None)
def test_a_damaged_byte_loses_only_the_events_after_it(tmp_path_factory, records, data):
    path = tmp_path_factory.mktemp("j") / "a.journal"
    raw = bytearray(write_records(path, records))
    position = data.draw(st.integers(len(MAGIC), len(raw) - 1))
    raw[position] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(raw)
    events = read_again(path)
    assert events == records[: len(events)]
    # The records that are left end before the damaged byte.
    assert len(MAGIC) + sum(HEAD_BYTES + len(event) for event in events) <= position


def test_a_batch_is_neither_stored_nor_published_until_committed(tmp_path):
    published = []
    journal = Journal(tmp_path, published.extend)
    journal.open("s", PLAN, host_seq=0)
    # The thread is not started: the test runs its jobs.
    thread = JournalThread(journal)
    for _ in range(2):
        thread.add(RunStopped, exit_status="abort")
    stored, _ = journal.read("s", from_seq=1, limit=9)
    assert journal.last_seq == 0
    assert stored == []
    assert published == []
    thread.commit(then=lambda _: None)
    thread.do_waiting()
    stored, _ = journal.read("s", from_seq=1, limit=9)
    assert [unpack_event(raw).seq for raw in stored] == [1, 2]
    assert [unpack_event(raw).seq for raw in published] == [1, 2]
    journal.close()


# Bytes that the disk still accepts. Each of the two records has a head of 12 bytes and a payload of 6. The disk becomes
# full before the first head, within it, within the first payload, and within the second head.
@pytest.mark.parametrize("room", [0, 1, 13, 25])
def test_a_full_disk_leaves_the_journal_as_it_was(tmp_path, monkeypatch, room):
    journal = JournalFile(tmp_path / "a.journal")
    journal.write([b"kept"])
    pwrite = os.pwrite
    bytes_left = room

    def fill_disk(fd, data, offset):
        nonlocal bytes_left
        if not bytes_left:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written_bytes = pwrite(fd, data[:bytes_left], offset)
        bytes_left -= written_bytes
        return written_bytes

    monkeypatch.setattr(journal_module.os, "pwrite", fill_disk)
    with expect_refusal(ErrorCode.DISK_FULL, journal.path, "No space left"):
        journal.write([b"lost 1", b"lost 2"])
    assert journal.last_seq == 1
    assert read_all(journal) == [b"kept"]
    monkeypatch.undo()
    journal.write([b"again"])
    assert journal.last_seq == 2
    journal.close()
    assert read_again(tmp_path / "a.journal") == [b"kept", b"again"]


def test_a_file_of_another_program_is_refused_and_kept(tmp_path):
    path = tmp_path / "a.journal"
    path.write_bytes(b"somebody's notes")
    with expect_refusal(ErrorCode.FILE_FOREIGN, path):
        JournalFile(path)
    assert path.read_bytes() == b"somebody's notes"


def test_only_one_process_uses_a_folder_of_journals(tmp_path):
    folder = Journal(tmp_path / "j")
    with expect_refusal(ErrorCode.BUSY, tmp_path / "j"):
        Journal(tmp_path / "j")
    folder.close()
    Journal(tmp_path / "j").close()
    (tmp_path / "file").write_text("")
    with expect_refusal(ErrorCode.FILE_UNREADABLE, tmp_path / "file" / "j"):
        Journal(tmp_path / "file" / "j")


@given(first=payloads, last_seq=st.integers(0, 40), second=payloads, seq=st.integers(1, 60), limit=st.integers(1, 30))
@settings(max_examples=40, deadline=None)
def test_numbers_continue_after_the_hosts_last_event(tmp_path_factory, first, last_seq, second, seq, limit):
    """No number is used twice, even if the journal has lost events that the host has; replay works from any number.

    The journal has the events `first`, the host those up to number `last_seq`; then the events `second` are written.
    """
    path = tmp_path_factory.mktemp("j") / "a.journal"
    write_records(path, first)
    journal = JournalFile(path)
    assert journal.continue_after(last_seq) == max(0, last_seq - len(first))
    journal.write(second)
    journal.close()

    first_new_seq = max(last_seq, len(first)) + 1
    record_of_seq = dict(enumerate(first, start=1)) | dict(enumerate(second, start=first_new_seq))
    newest_seq = max(record_of_seq, default=0)
    expected = [record for number, record in record_of_seq.items() if number >= seq][:limit]
    journal = JournalFile(path)
    assert journal.last_seq == newest_seq
    assert journal.read(seq, limit) == expected
    journal.close()
    folder = Journal(path.parent)
    assert folder.read("a", seq, limit) == (expected, newest_seq)
    folder.close()


@pytest.mark.parametrize(
    "remaining_bytes", [b"", MAGIC[:3], MAGIC[:3] + bytes(5), MAGIC[:1] + bytes(1), bytes(8), bytes(4096)]
)
def test_a_new_journal_torn_by_a_power_cut_is_empty(tmp_path, remaining_bytes):
    path = tmp_path / "a.journal"
    path.write_bytes(remaining_bytes)
    journal = JournalFile(path)
    assert journal.last_seq == 0
    assert path.read_bytes() == MAGIC
    journal.write([b"x"])
    assert journal.last_seq == 1
    journal.close()
    assert read_again(path) == [b"x"]


def test_damage_in_the_middle_is_reported_and_the_original_kept(tmp_path):
    path = tmp_path / "a.journal"
    raw = write_records(path, [b"one", b"two", b"three", b"four"])
    # The copy of a file that is damaged again has another name.
    for damaged, number in ((b"0wo", ""), (b"t0o", "2")):
        damaged_content = raw.replace(b"two", damaged)
        path.write_bytes(damaged_content)
        journal = JournalFile(path)
        copy = path.with_name(path.name + DAMAGED_SUFFIX + number)
        assert journal.last_seq == 1
        assert read_all(journal) == [b"one"]
        assert copy.read_bytes() == damaged_content
        assert str(copy) in journal.damage
        journal.close()


@given(records=st.lists(st.binary(min_size=1, max_size=40), min_size=1, max_size=6), data=st.data())
@settings(max_examples=40, deadline=None)
def test_an_incomplete_last_record_is_not_damage(tmp_path_factory, records, data):
    """A power cut may leave a file short, or with zeros at its end."""
    path = tmp_path_factory.mktemp("j") / "a.journal"
    raw = write_records(path, records)
    length = data.draw(st.integers(0, len(raw)))
    added_zeros = data.draw(st.sampled_from([0, 1, 4096]))
    path.write_bytes(raw[:length] + bytes(added_zeros))
    journal = JournalFile(path)
    assert journal.damage == ""
    journal.close()
    assert not list(path.parent.glob("*" + DAMAGED_SUFFIX + "*"))


def test_a_damaged_journal_is_logged(tmp_path):
    warnings: list[str] = []
    journal = Journal(tmp_path, warn=warnings.append)
    journal.open("s", PLAN, host_seq=0)
    journal.close()
    path = journal.journal_path("s")
    raw = write_records(path, [b"one", b"two", b"three"]).replace(b"one", b"0ne")
    path.write_bytes(raw)
    journal = Journal(tmp_path, warn=warnings.append)
    journal.open("s", PLAN, host_seq=0)
    assert len(warnings) == 1
    assert DAMAGED_SUFFIX in warnings[0]
    journal.close()


def test_no_scan_begins_without_space_for_its_journal(tmp_path, monkeypatch):
    folder = Journal(tmp_path)
    folder.check_room("scan", 70_000)
    # Exactly the space that a scan of 70,000 positions needs.
    free = SPARE_BYTES + 70_000 * CAPTURE_BYTES
    monkeypatch.setattr(journal_module.shutil, "disk_usage", lambda _: SimpleNamespace(free=free))
    folder.check_room("scan", 70_000)
    with expect_refusal(ErrorCode.DISK_FULL, "26.6 MB free", "26.6 MB needed", 70_001):
        folder.check_room("scan", 70_001)
    folder.journal_path("there").write_bytes(bytes(69_000 * CAPTURE_BYTES))
    free = SPARE_BYTES + 1_000 * CAPTURE_BYTES
    # A scan that has a journal needs space only for the rest of it.
    folder.check_room("there", 70_000)
    with expect_refusal(ErrorCode.DISK_FULL):
        folder.check_room("another", 70_000)
    folder.close()


def refuse_to_write(*_):
    """Fail as on a full disk."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


ROW_DONE: dict[str, Any] = {
    "row_index": 0,
    "take": 1,
    "status": "done",
    "points": 3,
    "edges": 3,
    "bursts": 3,
    "pulses": 6,
}


def test_a_row_that_is_not_journalled_is_not_done(tmp_path, monkeypatch):
    """A row that ends after the disk was full, before the run is stopped, is a fault, too."""
    published = []
    folder = Journal(tmp_path, published.extend)
    folder.open("scan", PLAN, host_seq=0)
    end = NewEvent.now(m.RowFinished, **ROW_DONE)
    published.clear()
    monkeypatch.setattr(journal_module.os, "pwrite", refuse_to_write)
    with pytest.raises(JournalFullError):
        folder.write([end])
    folder.write([end])
    ends = [unpack_event(packed) for packed in published]
    assert [(e.status, e.fault) for e in ends] == [("fault", PiFault.JOURNAL_FULL)] * 2
    monkeypatch.undo()
    folder.broken = False
    folder.write([end])
    assert unpack_event(published[-1]).status == "done"
    folder.close()


def test_a_full_disk_stops_the_row(host_in_row, stage, monkeypatch):
    host = host_in_row
    capture_seq = host.list_events(m.Capture)[0].seq
    monkeypatch.setattr(journal_module.os, "pwrite", refuse_to_write)
    # The stage goes on, but not to the end of the row: a slow disk might report too late that it is full.
    stage.stays_after = 4
    fault = host.wait_for_event(m.Fault)
    row_finished = host.wait_for_event(m.RowFinished)
    stage.stays_after = None
    monkeypatch.undo()
    assert fault.number == row_finished.fault == PiFault.JOURNAL_FULL
    assert row_finished.status == "fault"
    assert host.wait_for_state("fault").fault == PiFault.JOURNAL_FULL
    # Neither event was stored: both have the number of the last event that was.
    last_stored_seq = host.ask(m.Hello()).last_seq
    assert fault.seq == row_finished.seq == last_stored_seq
    assert last_stored_seq >= capture_seq
    host.home()
    assert host.run_row(0, take=2).status == "done"
    replayed = host.replay()
    assert [e.seq for e in replayed] == list(range(1, len(replayed) + 1))


def test_a_full_disk_refuses_the_beginning_and_the_end_of_a_run(pi, monkeypatch):
    """`Accepted` means that the event is on the disk."""
    host = pi.host
    stop = m.EndRun(scan_id="scan", exit_status="success")

    def check_is_refused_when_full(command):
        monkeypatch.setattr(journal_module.os, "pwrite", refuse_to_write)
        assert host.must_refuse(command) == PiFault.JOURNAL_FULL
        monkeypatch.undo()
        assert host.ask(m.Status()).fault == PiFault.JOURNAL_FULL

    host.must_accept(host.make_begin())
    host.must_accept(stop)
    check_is_refused_when_full(host.make_begin(last_seq=2))
    assert not host.ask(m.Hello()).in_run
    host.must_accept(m.Home())
    host.wait_for_state("homed")
    host.must_accept(host.make_begin())
    check_is_refused_when_full(stop)
    assert host.ask(m.Hello()).in_run
    host.must_accept(stop)
    assert [type(e) for e in host.replay()] == [m.RunStarted, m.RunStopped] * 2


def test_the_pis_client_prints_each_event_once_even_after_a_lost_journal(pi, instrument):
    host = pi.host
    stop = m.EndRun(scan_id="scan", exit_status="success")
    for seq in (0, 5000):
        host.must_accept(host.make_begin(last_seq=seq))
        host.must_accept(stop)
    pi_settings = msgspec.structs.replace(instrument.pi, command_address=pi.service.server.command_address)
    printed = replay_events(msgspec.structs.replace(instrument, pi=pi_settings), "scan", 1)
    assert [e["seq"] for e in printed] == [1, 2, 5001, 5002]
