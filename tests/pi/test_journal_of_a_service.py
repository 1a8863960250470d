"""The journal as the host sees it: a full disk, a lost journal, and the Pi's own client that reads it."""

import errno
import os

import msgspec

from polysight_pi import journal as journal_module
from polysight_pi.client import replay_events
from polysight_shared import messages as m
from polysight_shared.faults import PiFault


def full(*_):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_stops_the_row(host_in_row, stage, monkeypatch):
    host = host_in_row
    good = host.of(m.Capture)[0].seq
    monkeypatch.setattr(journal_module.os, "pwrite", full)
    fault = host.wait(m.Fault)
    done = host.wait(m.RowFinished)
    monkeypatch.undo()
    assert fault.number == done.fault == PiFault.JOURNAL_FULL
    assert done.status == "fault"
    assert host.until_state("fault").fault == PiFault.JOURNAL_FULL
    last = host.ask(m.Hello()).last_seq
    assert fault.seq == done.seq == last >= good
    host.home()
    stage.pace_s = 0.0
    assert host.row(0, take=2).status == "done"
    kept = host.replay()
    assert [e.seq for e in kept] == list(range(1, len(kept) + 1))


def test_a_full_disk_refuses_the_beginning_and_the_end_of_a_run(pi, monkeypatch):
    """`Accepted` says that the event is on the disk."""
    host, stop = pi.host, m.EndRun(scan_id="scan", exit_status="success")

    def refused_when_full(command):
        monkeypatch.setattr(journal_module.os, "pwrite", full)
        assert host.refused(command) == PiFault.JOURNAL_FULL
        monkeypatch.undo()
        assert host.ask(m.Status()).fault == PiFault.JOURNAL_FULL

    host.accepted(host.begin())
    host.accepted(stop)
    refused_when_full(host.begin(last_seq=2))
    assert not host.ask(m.Hello()).in_run
    host.accepted(m.Home())
    host.until_state("homed")
    host.accepted(host.begin())
    refused_when_full(stop)
    assert host.ask(m.Hello()).in_run
    host.accepted(stop)
    assert [type(e) for e in host.replay()] == [m.RunStarted, m.RunStopped] * 2


def test_the_pis_client_prints_each_event_once_also_behind_a_lost_journal(pi, instrument):
    host = pi.host
    stop = m.EndRun(scan_id="scan", exit_status="success")
    for seq in (0, 5000):
        host.accepted(host.begin(last_seq=seq))
        host.accepted(stop)
    where = msgspec.structs.replace(instrument.pi, command_address=pi.service.server.command_address)
    printed = replay_events(msgspec.structs.replace(instrument, pi=where), "scan", 1)
    assert [e["seq"] for e in printed] == [1, 2, 5001, 5002]
