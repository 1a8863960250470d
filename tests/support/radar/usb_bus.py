# ruff: noqa: ARG002 - pyusb names the arguments
"""An emulated USB bus with FT4232H chips. It is a backend of pyusb, so that the real pyftdi and pyusb run on it.

It follows the descriptors of USB 2.0, FTDI's vendor requests (as pyftdi and libftdi send them) and the chip's data
sheet. A chip has four interfaces with packets of 512 bytes. Each packet from the chip begins with two status bytes, and
a read without data returns these alone. After a chip was unplugged, all transfers of handles that were opened before
fail. When it is plugged in again it has another address.
"""

import errno
import os
from array import array
from types import SimpleNamespace

from usb.backend import IBackend
from usb.core import USBError

from polysight_simulators.radars import UsbChip

# USB numbers of the boards
VENDOR = 0x0451
PRODUCT = 0xFD03
_PACKET_BYTES = 512
# Status bytes before the data of a packet: the modem lines, and the empty transmitter.
_STATUS = b"\x31\x60"
_INTERFACES = 4
# USB's request for a descriptor, such as a string
_GET_DESCRIPTOR = 6
# Bit of a request's type: the device sends data to the host.
_TO_HOST = 0x80
# FTDI's requests, and the modes of a channel
_RESET = 0x00
_SET_BITMODE = 0x0B
_SET_LATENCY = 0x09
BIT_BANG = 1
MPSSE = 2


def _name_channel(number: int) -> str:
    """Letter of a channel, which counts from 1."""
    return "ABCD"[number - 1]


class Chip:
    """A chip that is plugged into a port of the bus; `path` has the numbers of the ports from the root."""

    def __init__(self, chip: UsbChip, serial: str, path: tuple[int, ...] = (1,), bus: int = 1) -> None:
        self.chip = chip
        self.serial = serial
        self.path = path
        self.bus = bus
        self.address = 0
        self.plugged = False
        self.modes: dict[int, tuple[int, int]] = {}
        self.latency_ms: dict[int, int] = {}
        self.errors: list[str] = []
        self.transfers = 0
        # Number of the transfer at which the chip is unplugged; None: never.
        self.pull_at: int | None = None


class Bus(IBackend):
    """The bus.

    Attributes
    ----------
    packet
        Largest number of data bytes that a read returns. Tests set it to cut answers at any byte.
    refuses
        Error number (errno) with which a claim of an interface is refused; 0: it is accepted.
    """

    def __init__(self) -> None:
        self.chips: list[Chip] = []
        self.packet = _PACKET_BYTES - len(_STATUS)
        self._addresses = 1
        self.refuses = 0

    def plug(self, chip: Chip) -> None:
        """Plug a chip in, at an address that no chip had before."""
        self._addresses += 1
        chip.address = self._addresses
        chip.plugged = True
        chip.pull_at = None
        chip.modes.clear()
        if chip not in self.chips:
            self.chips.append(chip)

    def pull(self, chip: Chip) -> None:
        """Unplug a chip."""
        chip.plugged = False

    # --- methods that pyusb calls ---

    def enumerate_devices(self):
        return iter([(chip, chip.address) for chip in self.chips if chip.plugged])

    def get_device_descriptor(self, dev):
        chip, address = dev
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x200, bDeviceClass=0, bDeviceSubClass=0, bDeviceProtocol=0,
            bMaxPacketSize0=64, idVendor=VENDOR, idProduct=PRODUCT, bcdDevice=0x0800, iManufacturer=1, iProduct=2,
            iSerialNumber=3, bNumConfigurations=1, address=address, bus=chip.bus, port_number=chip.path[-1],
            port_numbers=chip.path, speed=3,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev, config):
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=9, bNumInterfaces=_INTERFACES, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0x80, bMaxPower=50, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev, intf, alt, config):
        if intf >= _INTERFACES or alt:
            raise IndexError("no such interface")
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=intf, bAlternateSetting=0, bNumEndpoints=2,
            bInterfaceClass=0xFF, bInterfaceSubClass=0xFF, bInterfaceProtocol=0xFF, iInterface=2, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev, ep, intf, alt, config):
        # An interface has an endpoint to the host and one from the host. Those of interface 0 are 0x81 and 0x02.
        addresses = (0x81 + 2 * intf, 0x02 + 2 * intf)
        if ep >= len(addresses):
            raise IndexError("no such endpoint")
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=addresses[ep], bmAttributes=2,
            wMaxPacketSize=_PACKET_BYTES, bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev):
        self._check(dev)
        return dev

    def close_device(self, dev_handle) -> None: ...

    def set_configuration(self, dev_handle, config_value) -> None:
        self._check(dev_handle)

    def get_configuration(self, dev_handle) -> int:
        self._check(dev_handle)
        return 1

    def claim_interface(self, dev_handle, intf) -> None:
        self._check(dev_handle)
        if self.refuses:
            raise USBError(os.strerror(self.refuses), -6, self.refuses)

    def release_interface(self, dev_handle, intf) -> None:
        self._check(dev_handle)

    def is_kernel_driver_active(self, dev_handle, intf) -> bool:
        self._check(dev_handle)
        return False

    def attach_kernel_driver(self, dev_handle, intf) -> None:
        self._check(dev_handle)

    def ctrl_transfer(self, dev_handle, bmRequestType, bRequest, wValue, wIndex, data, timeout):
        chip = self._check(dev_handle)
        if bmRequestType & _TO_HOST:
            if bRequest == _GET_DESCRIPTOR:
                return self._string(chip, wValue & 0xFF, data)
            return self._fill(data, _STATUS)
        channel = wIndex & 0xFF
        if bRequest == _SET_BITMODE:
            mode = wValue >> 8
            output_lines = wValue & 0xFF
            chip.modes[channel] = (mode, output_lines)
        elif bRequest == _SET_LATENCY:
            chip.latency_ms[channel] = wValue
        elif bRequest == _RESET and wValue in (0, 1, 2):
            # All data that waits for the host is dropped.
            chip.chip.send_to_host(_name_channel(channel), 1 << 20)
        return len(data)

    def bulk_write(self, dev_handle, ep, intf, data, timeout) -> int:
        chip = self._check(dev_handle)
        channel = (ep + 1) // 2
        # Only the first two channels of the chip have MPSSE.
        expected_mode = MPSSE if channel <= 2 else BIT_BANG
        mode, _ = chip.modes.get(channel, (0, 0))
        if mode != expected_mode:
            chip.errors.append(f"written to channel {channel} in mode {chip.modes.get(channel)}")
        chip.chip.receive_from_host(_name_channel(channel), bytes(data))
        return len(data)

    def bulk_read(self, dev_handle, ep, intf, buff, timeout) -> int:
        chip = self._check(dev_handle)
        channel = (ep - 0x81) // 2 + 1
        max_bytes = min(self.packet, _PACKET_BYTES - len(_STATUS), len(buff) - len(_STATUS))
        return self._fill(buff, _STATUS + chip.chip.send_to_host(_name_channel(channel), max_bytes))

    def _check(self, dev) -> Chip:
        """Count a transfer, and return the chip of a handle; raises USBError if it has been unplugged."""
        chip, address = dev
        chip.transfers += 1
        if chip.pull_at is not None and chip.transfers >= chip.pull_at:
            chip.plugged = False
        if not chip.plugged or chip.address != address:
            raise USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)
        return chip

    def _string(self, chip: Chip, number: int, data: array) -> int:
        """Answer the request for a string: manufacturer, product or serial number."""
        text = {1: "TI", 2: "AR-DevPack-EVM-012", 3: chip.serial}.get(number)
        if text is None:
            # String 0 lists the languages: 0x0409 is American English.
            raw = b"\x04\x03\x09\x04"
        else:
            # Length, and the type of a string descriptor
            raw = bytes((2 + 2 * len(text), 3)) + text.encode("utf-16-le")
        return self._fill(data, raw)

    @staticmethod
    def _fill(data: array, raw: bytes) -> int:
        """Copy as many bytes as fit into the caller's buffer; return their number."""
        count = min(len(data), len(raw))
        data[:count] = array("B", raw[:count])
        return count


BUS = Bus()


def get_backend() -> Bus:
    """Return the backend; pyftdi calls this function of a backend module."""
    return BUS
