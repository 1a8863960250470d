"""The real pyftdi opens the USB chips of boards on a simulated bus, also if they were unplugged or plugged in late."""

import errno
import sys

import pytest
from pyftdi.ftdi import Ftdi
from pyftdi.usbtools import UsbTools
from tests.support.radar import usb_bus
from tests.support.refusals import expect_refusal

from polysight.radar.control import NativeRadars, RadarState
from polysight.radar.usb import open_usb
from polysight_shared.errors import DeviceError, ErrorCode
from polysight_simulators.radars import RadarBoard, UsbChip, make_image

FRAMES = 4


@pytest.fixture
def bus(monkeypatch):
    """An empty simulated USB bus in place of the real one, with pyftdi's caches as they are in a new process."""
    usb = usb_bus.Bus()
    monkeypatch.setattr(usb_bus, "BUS", usb)
    monkeypatch.setattr(UsbTools, "BACKENDS", ("tests.support.radar.usb_bus",))
    for name in ("Devices", "UsbDevices"):
        monkeypatch.setattr(UsbTools, name, {})
    monkeypatch.setattr(Ftdi, "VENDOR_IDS", dict(Ftdi.VENDOR_IDS))
    monkeypatch.setattr(Ftdi, "PRODUCT_IDS", dict(Ftdi.PRODUCT_IDS))
    return usb


def make_chip(board: RadarBoard, serial: str, path: tuple[int, ...] = (1,)) -> usb_bus.Chip:
    return usb_bus.Chip(UsbChip(board), serial, path)


@pytest.fixture
def plugged_chip(bus, board) -> usb_bus.Chip:
    usb_chip = make_chip(board, "FT1234", (4, 2))
    bus.plug(usb_chip)
    return usb_chip


def test_opening_a_chip_sets_the_mode_of_its_four_channels(plugged_chip):
    words = open_usb("FT1234")
    # Mode and directions of each channel: 2 is the serial engine (MPSSE), 1 sets pins directly; a 1 is an output.
    assert plugged_chip.modes == {1: (2, 0x4B), 2: (2, 0x5B), 3: (1, 0xF9), 4: (1, 0xFF)}
    assert set(plugged_chip.latency_ms.values()) == {1}
    assert not words.interrupt()
    words.close()
    assert plugged_chip.errors == []
    assert plugged_chip.chip.errors == []


# Bytes of a USB packet: 510 is the most that the chip sends in one.
@pytest.mark.parametrize("packet", [1, 2, 3, 7, 61, 510])
@pytest.mark.usefixtures("plugged_chip")
def test_an_answer_in_several_usb_packets_is_joined(bus, clock, packet):
    bus.packet = packet
    words = open_usb("FT1234")
    words.reset(held=True)
    words.reset(held=False)
    clock.sleep(0.1)
    assert words.interrupt()
    # The host asks to read; the board's message begins with its sync word.
    words.write([0x5678, 0x8765] + [0xFFFF] * 6)
    clock.sleep(0.1)
    assert words.read(2) == [0xDCBA, 0xABCD]
    words.close()


def test_slow_mode_is_one_word_a_transfer(plugged_chip):
    words = open_usb("FT1234", slow=True)
    assert plugged_chip.chip.spi_hz == 1e6
    transfers_before = plugged_chip.transfers
    words.write([1, 2, 3])
    assert plugged_chip.transfers == transfers_before + 3
    assert plugged_chip.chip.words_written == [1, 2, 3]
    words.close()


def test_a_usb_path_finds_the_board_with_any_serial_number(bus, plugged_chip):
    """With a bus address alone pyftdi would open any of these chips."""
    other_chips = [make_chip(RadarBoard(lambda: 0.0), "FT1234", (4, n)) for n in (1, 3, 4, 5, 6)]
    for other_chip in other_chips:
        bus.plug(other_chip)

    open_usb("usb:1-4.2").write([0x1234])
    assert plugged_chip.chip.words_written == [0x1234]
    assert all(other_chip.chip.words_written == [] and other_chip.modes == {} for other_chip in other_chips)

    with expect_refusal(ErrorCode.NO_ANSWER, "usb:1-7", "1-4.1, 1-4.2"):
        open_usb("usb:1-7")


def test_a_serial_number_of_two_chips_opens_neither_and_lists_their_paths(bus, plugged_chip):
    second_chip = make_chip(RadarBoard(lambda: 0.0), "FT1234", (4, 3))
    bus.plug(second_chip)
    with expect_refusal(ErrorCode.VALUES_CONFLICT, "1-4.2, 1-4.3") as caught:
        open_usb("FT1234")
    assert "usb_path" in caught.value.remedy
    assert plugged_chip.modes == {}
    assert second_chip.modes == {}


@pytest.mark.parametrize(
    ("number", "code", "cause"),
    [(errno.EBUSY, ErrorCode.BUSY, "another program"), (errno.EACCES, ErrorCode.NO_ANSWER, "udev rule")],
)
@pytest.mark.usefixtures("plugged_chip")
def test_a_chip_that_cannot_be_claimed_is_an_error_with_the_cause(bus, number, code, cause):
    bus.refuses = number
    with expect_refusal(code, "FT1234", cause):
        open_usb("FT1234")


@pytest.mark.usefixtures("plugged_chip")
def test_a_missing_chip_is_an_error_with_its_serial_number():
    with expect_refusal(ErrorCode.NO_ANSWER, "FT9"):
        open_usb("FT9")


def test_a_chip_that_is_plugged_in_later_is_found(bus, board):
    """pyftdi keeps the list of chips that it has found, even an empty one."""
    with pytest.raises(DeviceError):
        open_usb("FT7")
    bus.plug(make_chip(board, "FT7"))
    open_usb("FT7").close()


@pytest.mark.parametrize("closed", ["before", "after"])
def test_a_replugged_chip_is_found_and_the_old_one_closed(bus, plugged_chip, closed):
    words = open_usb("FT1234")
    if closed == "before":
        words.close()
    bus.pull(plugged_chip)
    if closed == "after":
        with expect_refusal(ErrorCode.NO_ANSWER, "FT1234", "No such device"):
            words.write([1])
        words.close()
    assert UsbTools.Devices == {}
    bus.plug(plugged_chip)
    reopened = open_usb("FT1234")
    reopened.write([0x4321])
    assert plugged_chip.chip.words_written == [0x4321]
    reopened.close()
    assert UsbTools.Devices == {}


def test_a_chip_that_is_unplugged_while_it_is_opened_can_be_opened_later(bus, plugged_chip):
    """At each transfer of an opening, the error names the chip, no handle stays open, and a chip opens again."""
    words = open_usb("FT1234")
    transfers = plugged_chip.transfers
    words.close()
    for position in range(1, transfers + 1):
        bus.plug(plugged_chip)
        plugged_chip.transfers = 0
        plugged_chip.pull_at = position
        with expect_refusal(ErrorCode.NO_ANSWER, "FT1234"):
            open_usb("FT1234")
        assert UsbTools.Devices == {}
    bus.plug(plugged_chip)
    open_usb("FT1234").close()


def test_a_scan_survives_a_replug_of_one_board(bus, rig, clock):
    boards = {}
    chips = {}
    for number, native in enumerate(rig.radar.native.values(), 1):
        board = RadarBoard(lambda: clock.time, flash=make_image(), die_number=number)
        boards[native.place] = board
        chips[native.place] = make_chip(board, serial=native.place, path=(number,))
        bus.plug(chips[native.place])

    def row(radars: NativeRadars) -> set[RadarState]:
        radars.arm(FRAMES)
        for _ in range(FRAMES):
            for board in boards.values():
                board.trigger()
            clock.sleep(1.5e-3)
        return {s.state for s in radars.states().values()}

    with NativeRadars(rig, open_usb, clock) as radars:
        assert row(radars) == {RadarState.DONE}
        bus.pull(chips["FTRH"])
        assert radars.states()["RH"].state is RadarState.FAULT
        bus.plug(chips["FTRH"])
        assert row(radars) == {RadarState.DONE}
    assert [c.errors + c.chip.errors for c in chips.values()] == [[], [], []]


def test_missing_pyftdi_is_an_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyftdi", None)
    monkeypatch.setitem(sys.modules, "pyftdi.ftdi", None)
    with expect_refusal(ErrorCode.PACKAGE_MISSING, "pyftdi") as caught:
        open_usb("FT1")
    assert "pip install pyftdi" in str(caught.value)
