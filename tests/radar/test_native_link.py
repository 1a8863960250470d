"""A radar whose USB link goes away, or that fails while it is armed, costs a take and not the scan."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from polysight.host.radar.interface import RadarState
from polysight.host.radar.native import NativeRadars, radar_board
from polysight.host.radar.trace import ReplayedWords, read_trace
from polysight.shared.errors import DeviceError
from polysight.simulators.radars import RadarBoard, make_image
from tests.support.radar.boards import BoardWords

FRAMES = 24


class Words(BoardWords):
    """A link that can be pulled; what was opened before stays dead."""

    dead = False

    def _look(self) -> None:
        if self.dead or self.closed:
            raise DeviceError("the USB device is gone")

    def write(self, words):
        self._look()
        super().write(words)

    def read(self, count):
        self._look()
        return super().read(count)

    def interrupt(self):
        self._look()
        return super().interrupt()

    def reset(self, held):
        self._look()
        super().reset(held)


class Usb:
    """The bus: chips by serial number; an absent one cannot be opened until `back_at`."""

    def __init__(self, rig, clock) -> None:
        self.clock = clock
        self.boards = {
            n.usb_serial: RadarBoard(lambda: clock.time, flash=make_image(), die=k)
            for k, n in enumerate(rig.radar.native.values(), 1)
        }
        self.links: dict[str, list[Words]] = {serial: [] for serial in self.boards}
        self.back_at = 0.0

    def open(self, serial: str) -> Words:
        if serial == "FTRH" and self.clock.now() < self.back_at:
            raise DeviceError("no such USB device")
        self.links[serial].append(Words(self.boards[serial], self.clock))
        return self.links[serial][-1]

    def pull(self, for_s: float) -> None:
        self.links["FTRH"][-1].dead = True
        self.back_at = self.clock.now() + for_s


@pytest.fixture
def usb(rig, clock):
    return Usb(rig, clock)


@pytest.fixture
def radars(rig, usb, clock):
    with NativeRadars(rig, usb.open, clock) as made:
        yield made


def run_row(radars, usb) -> dict[str, RadarState]:
    radars.arm(FRAMES)
    for _ in range(FRAMES):
        for board in usb.boards.values():
            board.trigger()
        usb.clock.sleep(1.5e-3)
    return {name: s.state for name, s in radars.states().items()}


def traces(radars) -> list[dict[str, str]]:
    told = radars.report()["traces"]
    assert isinstance(told, list)
    return told


ALL_DONE = dict.fromkeys(("LS", "RH", "RV"), RadarState.DONE)


@pytest.mark.parametrize("for_s", [0.0, 2.0])
def test_a_link_that_comes_back_is_opened_anew(radars, usb, for_s):
    assert run_row(radars, usb) == ALL_DONE
    usb.pull(for_s)
    assert radars.states()["RH"].state is RadarState.FAULT
    assert run_row(radars, usb) == ALL_DONE
    assert [len(usb.links[s]) for s in ("FTLS", "FTRH", "FTRV")] == [1, 2, 1]
    assert usb.links["FTRH"][0].closed


def test_a_link_that_stays_away_is_a_fault_of_that_board_until_it_is_back(radars, usb):
    usb.pull(for_s=20.0)
    radars.arm(FRAMES)
    told = radars.states()
    assert (told["RH"].state, told["RV"].state) == (RadarState.FAULT, RadarState.ARMED)
    assert "USB" in told["RH"].detail
    usb.clock.sleep(20.0)
    assert run_row(radars, usb) == ALL_DONE


def test_every_link_of_a_scan_is_traced_and_replays(rig, usb, clock, tmp_path):
    kept = msgspec.structs.replace(rig, radar=msgspec.structs.replace(rig.radar, trace_dir=str(tmp_path / "traces")))
    with NativeRadars(kept, usb.open, clock) as radars:
        assert run_row(radars, usb) == ALL_DONE
        usb.pull(0.0)
        assert run_row(radars, usb) == ALL_DONE
        told = traces(radars)
    files = sorted((tmp_path / "traces").iterdir())
    assert sorted(t["file"] for t in told) == [str(f) for f in files]
    assert [read_trace(f)[0]["board"] for f in files] == ["LS", "RH", "RH", "RV"]
    assert any("error" in record for record in read_trace(files[1])[1] + read_trace(files[2])[1])
    # The first link's trace brings the host through the same bring-up again, without the board.
    replayed = ReplayedWords(files[0])
    made = radar_board(rig, "LS", replayed, replayed, None)
    made.configure()
    made.arm(FRAMES)


def test_a_disk_that_fills_up_ends_a_trace_and_no_row(rig, usb, clock, tmp_path, monkeypatch):
    monkeypatch.setattr("polysight.host.radar.native.new_trace", lambda *_: Path("/dev/full"))
    kept = msgspec.structs.replace(rig, radar=msgspec.structs.replace(rig.radar, trace_dir=str(tmp_path)))
    with NativeRadars(kept, usb.open, clock) as radars:
        assert run_row(radars, usb) == ALL_DONE
        told = traces(radars)
    assert len(told) == 3
    assert all("No space" in t["ended"] for t in told)


def test_a_fatal_event_while_arming_is_no_error_of_the_scan(radars, usb, monkeypatch):
    """The board faults as it is told to start; told a second time it does what it should."""
    from polysight.host.radar import board as boards

    arm, failed = boards.RadarBoard.arm, []

    def once(board, frames) -> None:
        if board.name == "RV" and not failed:
            failed.append(board.name)
            board.fail("RF core fault")
            raise DeviceError("RV: RF core fault")
        arm(board, frames)

    monkeypatch.setattr(boards.RadarBoard, "arm", once)
    assert run_row(radars, usb) == ALL_DONE
    assert failed == ["RV"]
