"""Opening the USB chip: the extra that is missing, the chip that is not there, and the four channels' modes."""

from __future__ import annotations

import sys
from enum import IntEnum
from types import ModuleType

import pytest

from polysight.host.radar.usb import PRODUCT, VENDOR, open_usb, set_up_interrupt, set_up_spi
from polysight.shared.errors import ConfigError, DeviceError


class FakeFtdi:
    """What is used of pyftdi's class."""

    class BitMode(IntEnum):
        RESET = 0
        BITBANG = 1
        MPSSE = 2

    PRODUCT_IDS: dict = {}  # noqa: RUF012
    opened: list = []  # noqa: RUF012
    missing = 0

    def __init__(self) -> None:
        self.modes, self.sent, self.closed = [], b"", False
        FakeFtdi.opened.append(self)

    @classmethod
    def add_custom_vendor(cls, vid: int, name: str) -> None:
        assert vid not in cls.PRODUCT_IDS
        del name

    @classmethod
    def add_custom_product(cls, vid: int, pid: int, name: str) -> None:
        cls.PRODUCT_IDS[vid] = {name: pid}

    def open(self, vendor: int, product: int, *, serial: str, interface: int) -> None:
        if interface == FakeFtdi.missing:
            raise OSError("no such device")
        self.where = (vendor, product, serial, interface)

    def set_bitmode(self, mask: int, mode: IntEnum) -> None:
        self.modes.append((mask, mode))

    def set_latency_timer(self, ms: int) -> None:
        self.latency = ms

    def purge_buffers(self) -> None:
        self.purged = True

    def write_data(self, data: bytes) -> int:
        self.sent += data
        return len(data)

    def read_data_bytes(self, size: int, attempt: int) -> bytes:
        del attempt
        return b"\x20"[:size]

    def close(self, freeze: bool) -> None:
        self.closed = freeze


@pytest.fixture
def ftdi(monkeypatch):
    library, tools, package = ModuleType("pyftdi.ftdi"), ModuleType("pyftdi.usbtools"), ModuleType("pyftdi")
    library.Ftdi = FakeFtdi  # type: ignore[attr-defined]
    tools.UsbToolsError = type("UsbToolsError", (Exception,), {})  # type: ignore[attr-defined]
    for name, module in (("pyftdi", package), ("pyftdi.ftdi", library), ("pyftdi.usbtools", tools)):
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(FakeFtdi, "PRODUCT_IDS", {})
    monkeypatch.setattr(FakeFtdi, "opened", [])
    monkeypatch.setattr(FakeFtdi, "missing", 0)
    return FakeFtdi


def test_four_channels_of_one_serial_number_in_their_modes(ftdi):
    words = open_usb("FT1234")
    assert [f.where for f in ftdi.opened] == [(VENDOR, PRODUCT, "FT1234", n) for n in (1, 2, 3, 4)]
    assert [f.modes[-1][1] for f in ftdi.opened] == [2, 2, 1, 1]
    assert [f.modes[-1][0] for f in ftdi.opened] == [0x4B, 0x5B, 0xF9, 0xFF]
    assert ftdi.opened[0].sent == set_up_spi()
    assert ftdi.opened[1].sent == set_up_interrupt()
    assert words.interrupt()
    words.reset(held=True)
    words.reset(held=False)
    assert ftdi.opened[2].sent == b"\x80\xc0"
    assert ftdi.opened[3].sent == b"\x10\x10"
    words.close()
    assert all(f.closed for f in ftdi.opened)


def test_a_second_board_needs_no_second_registration(ftdi):
    open_usb("FT1")
    open_usb("FT2")
    assert len(ftdi.opened) == 8


def test_a_chip_that_is_not_there_is_named_and_what_was_opened_is_closed(ftdi, monkeypatch):
    monkeypatch.setattr(FakeFtdi, "missing", 3)
    with pytest.raises(DeviceError, match="serial FT9, channel C: cannot be opened: no such device"):
        open_usb("FT9")
    assert [f.closed for f in ftdi.opened] == [True, True, False]


def test_a_pulled_cable_is_an_error_that_names_the_chip(ftdi):
    words = open_usb("FT1")

    def gone(*_: object, **__: object) -> None:
        raise OSError("no such device")

    ftdi.opened[0].write_data = gone
    ftdi.opened[1].read_data_bytes = gone
    with pytest.raises(DeviceError, match="radar USB serial FT1: no such device"):
        words.write([1])
    with pytest.raises(DeviceError, match="FT1"):
        words.interrupt()


def test_without_pyftdi_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyftdi", None)
    monkeypatch.setitem(sys.modules, "pyftdi.ftdi", None)
    with pytest.raises(ConfigError, match="pyftdi") as caught:
        open_usb("FT1")
    assert "polysight[radar]" in str(caught.value)
