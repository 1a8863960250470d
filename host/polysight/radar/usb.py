"""Words between host and board: the FT4232H of a DCA1000 over USB, or its four channels over TCP.

`UsbWords` translates words, interrupt, reset and sense lines to MPSSE commands on the chip's four channels. `open_usb`
opens them by serial number or USB path with pyftdi (the extra `radar`), `open_tcp` those of a TCP server. Not run on
hardware yet.
"""

from __future__ import annotations

import errno
import socket
import struct
import time
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, NamedTuple, Protocol

from polysight_shared.errors import ConfigError, DeviceError, ErrorCode

# The FT4232H over USB.
VENDOR = 0x0451
PRODUCT = 0xFD03
# A place begins with this prefix if it is a path, such as "usb:1-4.2"; without it, it is a serial number.
PATH_PREFIX = "usb:"
# Longest wait for the answer to a command, and after how long the chip sends a packet that is not full; chosen.
_READ_TIMEOUT_S = 0.5
_LATENCY_MS = 1
_CHECK_REMEDY = "check the cable and the board's power; `lsusb -v -d 0451:fd03 | grep iSerial` lists the chips"

# Channels over TCP: a request has channel, W or R, and the number of bytes. The timeout is chosen.
TCP_PREFIX = "tcp://"
_HEAD = struct.Struct("<ccH")
_TIMEOUT_S = 30.0

# Pins and MPSSE commands (FTDI AN_108). A direction has a 1 for each output. The other values are levels of the pins:
# of channel A while a word is written, while one is read, and between words (chip select, bit 3, is low for a word).
# Channel A: clock, data out, chip select and PMIC reset are outputs.
SPI_DIRECTION = 0b0100_1011
SELECTED_WRITE = 0xC0
SELECTED_READ = 0xC2
IDLE = 0xC8
# Channel B: bit 5, the interrupt, is an input.
INTERRUPT_DIRECTION = 0b0101_1011
INTERRUPT_IDLE = 0b0001_0011
INTERRUPT_BIT = 5
# Channel C: both resets are low when active.
RESET_DIRECTION = 0b1111_1001
RESET_PIN = 6
WARM_RESET_PIN = 7
# Channel D: the lines that select the mode in which the board starts.
SENSE_DIRECTION = 0b1111_1111
# Sense-on-power mode 4: D4 = 1, D3 = D2 = 0.
FUNCTIONAL_MODE = 0b0001_0000
# Directions of channels A to D, and True for bit-bang mode.
_CHANNELS = ((SPI_DIRECTION, False), (INTERRUPT_DIRECTION, False), (RESET_DIRECTION, True), (SENSE_DIRECTION, True))
# MPSSE commands: set or read pins, shift bytes, answer immediately, and the settings of the clock.
_SET_PINS = 0x80
_READ_PINS = 0x81
# Before the bytes: their number less one, 16 bits, the lower byte first.
_WRITE_BYTES = 0x11
_READ_BYTES = 0x20
_SEND_IMMEDIATELY = 0x87
_FULL_SPEED = 0x8A
_NO_ADAPTIVE = 0x97
_NO_THREE_PHASE = 0x8D
_THREE_PHASE = 0x8C
_DIVISOR = 0x86
_NO_LOOPBACK = 0x85
# The clock is 60 MHz / (2 x (divisor + 1)): 10 MHz, and 1 MHz for a slow link.
SPI_DIVISOR = 2
SLOW_DIVISOR = 29
# One pin command holds its pins for 0.2 us (FTDI AN_114), two clocks at 10 MHz; TI's ICD, 3.2.4, requires at least two.
_SELECT_COMMANDS = 2
_IDLE_COMMANDS = 3
# Pause between two words of a slow link; chosen.
_SLOW_GAP_S = 100e-6
_DESELECT = bytes((_SET_PINS, IDLE, SPI_DIRECTION)) * _IDLE_COMMANDS
# For how long the reset line is left to settle; chosen.
_RESET_S = 0.01


class WordLink(Protocol):
    """Connection to one board: 16-bit words, its host interrupt, its reset and sense lines."""

    def write(self, words: Sequence[int]) -> None:
        """Shift words out, each with its own chip select. Raises DeviceError if the link is lost."""
        ...

    def read(self, count: int) -> list[int]:
        """Shift words in. Raises DeviceError if the link is lost."""
        ...

    def interrupt(self) -> bool:
        """Return True if the host interrupt is high. Raises DeviceError if the link is lost."""
        ...

    def reset(self, held: bool) -> None:
        """Hold the board in reset, or release it in functional mode (sense-on-power mode 4)."""
        ...

    def close(self) -> None:
        """Close the connection; may be called twice."""
        ...


class Clock(Protocol):
    """Clock of a link; tests use a virtual one."""

    def now(self) -> float:
        """Return the time, seconds."""
        ...

    def sleep(self, seconds: float) -> None:
        """Wait."""
        ...


class SystemClock:
    """Monotonic clock of this machine."""

    def now(self) -> float:
        """Return the time, seconds."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait."""
        time.sleep(seconds)


class Port(Protocol):
    """One open channel of the chip."""

    def write(self, data: bytes) -> None:
        """Send bytes. Raises DeviceError if the chip is lost."""
        ...

    def read(self, size: int) -> bytes:
        """Receive up to `size` bytes. Raises DeviceError if the chip is lost."""
        ...

    def close(self) -> None:
        """Close the channel."""
        ...


def encode_spi_setup(divisor: int = SPI_DIVISOR) -> bytes:
    """Return the initial commands of channel A."""
    clock = bytes((_FULL_SPEED, _NO_ADAPTIVE, _NO_THREE_PHASE, _DIVISOR, divisor, 0))
    return clock + bytes((_SET_PINS, IDLE, SPI_DIRECTION, _NO_LOOPBACK))


def encode_interrupt_setup() -> bytes:
    """Return the initial commands of channel B."""
    return bytes(
        (_FULL_SPEED, _NO_ADAPTIVE, _THREE_PHASE, _SET_PINS, INTERRUPT_IDLE, INTERRUPT_DIRECTION, _NO_LOOPBACK)
    )


def encode_writes(words: Sequence[int]) -> bytes:
    """Return commands that shift words out: for each, chip select low, two bytes on the falling edge, select high."""
    select = bytes((_SET_PINS, SELECTED_WRITE, SPI_DIRECTION)) * _SELECT_COMMANDS
    parts = bytearray()
    for word in words:
        parts += select + bytes((_WRITE_BYTES, 1, 0, word >> 8, word & 0xFF)) + _DESELECT
    return bytes(parts) + bytes((_SEND_IMMEDIATELY,))


def encode_reads(count: int) -> bytes:
    """Return commands that shift words in: for each, chip select low, two bytes on the rising edge, select high."""
    select = bytes((_SET_PINS, SELECTED_READ, SPI_DIRECTION)) * _SELECT_COMMANDS
    return (select + bytes((_READ_BYTES, 1, 0)) + _DESELECT) * count + bytes((_SEND_IMMEDIATELY,))


class UsbWords:
    """Word link through the four channels of a chip.

    `slow`: one word in each USB transfer, at least 0.1 ms apart, at 1 MHz.
    """

    def __init__(
        self,
        spi: Port,
        interrupt: Port,
        reset: Port,
        sense: Port,
        sleep: Callable[[float], None] = time.sleep,
        slow: bool = False,
    ) -> None:
        self._spi = spi
        self._interrupt = interrupt
        self._reset = reset
        self._sense = sense
        self._sleep = sleep
        self._slow = slow
        divisor = SLOW_DIVISOR if slow else SPI_DIVISOR
        self._spi.write(encode_spi_setup(divisor))
        self._interrupt.write(encode_interrupt_setup())

    def write(self, words: Sequence[int]) -> None:
        """Shift words out. Raises DeviceError."""
        parts = [words]
        if self._slow:
            parts = [[word] for word in words]
        for part in parts:
            self._spi.write(encode_writes(part))
            self._pause()

    def read(self, count: int) -> list[int]:
        """Shift words in. Raises DeviceError."""
        counts = [count]
        if self._slow:
            counts = [1] * count
        words: list[int] = []
        for part_count in counts:
            self._spi.write(encode_reads(part_count))
            data = _read_exactly(self._spi, 2 * part_count)
            words += struct.unpack(f">{part_count}H", data)
            self._pause()
        return words

    def _pause(self) -> None:
        """Wait between two words of a slow link."""
        if self._slow:
            self._sleep(_SLOW_GAP_S)

    def interrupt(self) -> bool:
        """Return True if the host interrupt is high. Raises DeviceError."""
        self._interrupt.write(bytes((_READ_PINS, _SEND_IMMEDIATELY)))
        return bool(_read_exactly(self._interrupt, 1)[0] >> INTERRUPT_BIT & 1)

    def reset(self, held: bool) -> None:
        """Set the sense lines to functional mode, then hold or release the reset. Raises DeviceError."""
        self._sense.write(bytes((FUNCTIONAL_MODE,)))
        pins = 1 << WARM_RESET_PIN
        if not held:
            pins |= 1 << RESET_PIN
        self._reset.write(bytes((pins,)))
        self._sleep(_RESET_S)

    def close(self) -> None:
        """Close the channels."""
        for port in (self._spi, self._interrupt, self._reset, self._sense):
            port.close()


def _read_exactly(port: Port, size: int) -> bytes:
    """Read `size` bytes. Raises DeviceError after the timeout of the port."""
    data = port.read(size)
    if len(data) != size:
        raise DeviceError(
            f"timeout: received {len(data)} of {size} bytes over USB",
            "the cable is loose",
            "check the USB cable",
            code=ErrorCode.NO_ANSWER,
        )
    return data


class FtdiPort:
    """One channel of a chip over USB, in MPSSE or bit-bang mode; errors of the USB library become DeviceError."""

    def __init__(self, place: str, chip: Any, interface: int, direction: int, bit_bang: bool) -> None:
        self._library = _library()
        ftdi = self._library.ftdi
        self._place = place
        self._ftdi = ftdi()
        try:
            if VENDOR not in ftdi.PRODUCT_IDS:
                ftdi.add_custom_vendor(VENDOR, "ti")
                ftdi.add_custom_product(VENDOR, PRODUCT, "devpack")
            self._ftdi.open_from_device(self._library.share(chip), interface)
            self._ftdi.set_bitmode(0, ftdi.BitMode.RESET)
            self._ftdi.set_latency_timer(_LATENCY_MS)
            self._ftdi.purge_buffers()
            mode = ftdi.BitMode.BITBANG if bit_bang else ftdi.BitMode.MPSSE
            self._ftdi.set_bitmode(direction, mode)
        except self._library.errors as e:
            self.close()
            message = f"{place}, channel {'ABCD'[interface - 1]}: cannot be opened: {e}"
            raise _usb_error(message, e, "it was unplugged, or libusb is missing") from None

    def write(self, data: bytes) -> None:
        """Send bytes. Raises DeviceError."""
        try:
            self._ftdi.write_data(data)
        except self._library.errors as e:
            raise _usb_error(f"{self._place}: {e}", e, _PULLED_CAUSE) from None

    def read(self, size: int) -> bytes:
        """Receive up to `size` bytes within half a second, by 4 reads in a row (chosen). Raises DeviceError."""
        received = bytearray()
        deadline = time.monotonic() + _READ_TIMEOUT_S
        try:
            while len(received) < size and time.monotonic() < deadline:
                received += self._ftdi.read_data_bytes(size - len(received), attempt=4)
        except self._library.errors as e:
            raise _usb_error(f"{self._place}: {e}", e, _PULLED_CAUSE) from None
        return bytes(received)

    def close(self) -> None:
        """Close the channel, also of a lost chip; the pins keep their levels."""
        device = self._ftdi.usb_dev
        try:
            self._ftdi.close(freeze=True)
        except (*self._library.errors, TypeError):
            # The chip is lost, or was not opened completely. Without this call pyftdi would count it as open.
            self._library.tools.release_device(device)


# Usual cause of an error while the link is in use.
_PULLED_CAUSE = "the cable was pulled, or the board lost power"
# Causes of an error of libusb by its number.
_CAUSES = {
    errno.EBUSY: "another program uses this chip: mmWave Studio, or a second polysight; end it",
    errno.EACCES: "no permission: the udev rule for 0451:fd03 (docs/how-to/install.md)",
    errno.EPERM: "no permission: the udev rule for 0451:fd03 (docs/how-to/install.md)",
    errno.ETIMEDOUT: "the chip does not answer: a loose cable, or a hub without power",
}


def _usb_error(what: str, e: BaseException | None, otherwise: str) -> DeviceError:
    """Return an error with the likely cause by errno; `otherwise` is the cause for any other number."""
    # pyftdi raises errors of its own; the number is that of libusb's error behind them.
    while e is not None and getattr(e, "errno", None) not in _CAUSES:
        e = e.__cause__ or e.__context__
    number = getattr(e, "errno", 0)
    code = ErrorCode.BUSY if number == errno.EBUSY else ErrorCode.NO_ANSWER
    return DeviceError(f"radar USB {what}", _CAUSES.get(number, otherwise), _CHECK_REMEDY, code=code)


def open_usb(place: str, slow: bool = False) -> UsbWords:
    """Open a board by the serial number of its USB chip, or by `usb:` and its path; scans the bus each time.

    Raises
    ------
    ConfigError
        if pyftdi is not installed.
    DeviceError
        if the chip cannot be opened.
    """
    library = _library()
    library.tools.flush_cache()
    chip = library.find_chip(place)
    ports: list[FtdiPort] = []
    try:
        for interface, (direction, bit_bang) in enumerate(_CHANNELS, start=1):
            ports.append(FtdiPort(place, chip, interface, direction, bit_bang))
        spi, interrupt, reset, sense = ports
        return UsbWords(spi, interrupt, reset, sense, slow=slow)
    except (ConfigError, DeviceError):
        for port in ports:
            port.close()
        raise


class _Library(NamedTuple):
    """The parts of pyftdi and pyusb that are used here."""

    ftdi: Any
    tools: Any
    errors: tuple[type[Exception], ...]
    find: Callable[..., Any]

    def find_chip(self, place: str) -> Any:
        """Return the chip with this serial number or path. Raises DeviceError if there is none, or more than one."""
        name = place.removeprefix(PATH_PREFIX)
        try:
            # The backends of pyftdi, in its order of preference.
            backends = (import_module(name).get_backend() for name in self.tools.BACKENDS)
            backend = next((b for b in backends if b is not None), None)
            chips = list(self.find(find_all=True, idVendor=VENDOR, idProduct=PRODUCT, backend=backend))
            paths = {f"{d.bus}-{'.'.join(map(str, d.port_numbers or ()))}": d for d in chips}
            is_path = place.startswith(PATH_PREFIX)
            if is_path:
                matching = [path for path in paths if path == name]
            else:
                matching = [path for path, chip in paths.items() if self._read_serial(chip) == name]
        except self.errors as e:
            raise _usb_error(f"{place}: {e}", e, "libusb is missing, or the chip was unplugged") from None
        on_the_bus = "no chip on the bus"
        if paths:
            on_the_bus = f"chips at {', '.join(sorted(paths))}"
        if not matching:
            kind_of_place = "at this path" if is_path else "with this serial number"
            raise DeviceError(
                f"radar USB {place}: cannot be opened: no chip 0451:fd03 {kind_of_place}; {on_the_bus}",
                "unplugged, another serial number or path, or no permission (a udev rule for 0451:fd03)",
                _CHECK_REMEDY,
                code=ErrorCode.NO_ANSWER,
            )
        if len(matching) > 1:
            raise DeviceError(
                f"radar USB {place}: {len(matching)} chips have this serial number, at {', '.join(sorted(matching))}",
                "the serial number does not identify the board; none was opened",
                f'use its path instead of usb_serial: usb_path = "{min(matching)}", or another one',
                code=ErrorCode.VALUES_CONFLICT,
            )
        return paths[matching[0]]

    def _read_serial(self, chip: Any) -> str | None:
        """Return a chip's serial number; None if it has none or cannot be read."""
        try:
            if chip.iSerialNumber:
                return self.tools.get_string(chip, chip.iSerialNumber)
            return None
        except self.errors:
            return None

    def share(self, chip: Any) -> Any:
        """Return a chip for one more channel, and count it in pyftdi's list.

        pyftdi's own search by bus and address alone returns any chip.
        """
        with self.tools.Lock:
            opened = self.tools.Devices.setdefault((chip.bus, chip.address, VENDOR, PRODUCT), [chip, 0])
            opened[1] += 1
        return opened[0]


def _library() -> _Library:
    """Import pyftdi, which only this backend needs. Raises ConfigError."""
    try:
        from pyftdi.ftdi import Ftdi
        from pyftdi.usbtools import UsbTools, UsbToolsError
        from usb.core import find
    except ImportError:
        raise ConfigError(
            'radar.control = "native" needs pyftdi, which is not installed',
            "it comes with the host's extra `radar`",
            "pip install pyftdi",
            code=ErrorCode.PACKAGE_MISSING,
        ) from None
    # FtdiError and USBError are OSErrors.
    return _Library(Ftdi, UsbTools, (OSError, ValueError, UsbToolsError), find)


class _TcpPort:
    """One channel over TCP; all four share a connection."""

    def __init__(self, address: str, connection: socket.socket, channel: bytes) -> None:
        self._address = address
        self._connection = connection
        self._channel = channel

    def write(self, data: bytes) -> None:
        """Send bytes. Raises DeviceError."""
        self._send(_HEAD.pack(self._channel, b"W", len(data)) + data)

    def read(self, size: int) -> bytes:
        """Receive up to `size` bytes. Raises DeviceError."""
        self._send(_HEAD.pack(self._channel, b"R", size))
        (count,) = struct.unpack("<H", self._receive(2))
        return self._receive(count)

    def close(self) -> None:
        """Close the connection of all channels."""
        self._connection.close()

    def _send(self, data: bytes) -> None:
        """Send bytes. Raises DeviceError if the connection is lost."""
        try:
            self._connection.sendall(data)
        except OSError as e:
            raise self._make_lost_error(e.strerror or str(e)) from None

    def _receive(self, size: int) -> bytes:
        """Receive exactly `size` bytes. Raises DeviceError if the connection ends before."""
        data = b""
        try:
            while len(data) < size:
                part = self._connection.recv(size - len(data))
                if not part:
                    raise self._make_lost_error("closed by the other side")
                data += part
        except OSError as e:
            raise self._make_lost_error(e.strerror or str(e)) from None
        return data

    def _make_lost_error(self, what: str) -> DeviceError:
        return DeviceError(
            f"radar at {self._address}: {what}",
            "its USB cable was pulled, or its program ended",
            "check that machine",
            code=ErrorCode.NO_ANSWER,
        )


def open_tcp(address: str, slow: bool = False) -> UsbWords:
    """Open a board by `tcp://address:port`. Raises DeviceError if there is no server."""
    host, _, port = address.removeprefix(TCP_PREFIX).rpartition(":")
    try:
        connection = socket.create_connection((host, int(port)), _TIMEOUT_S)
    except (OSError, ValueError) as e:
        raise DeviceError(
            f"radar at {address}: cannot be reached: {e}",
            "no server for a USB chip at this address",
            "start it, or correct the address",
            code=ErrorCode.NO_ANSWER,
        ) from None
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    spi, interrupt, reset, sense = (_TcpPort(address, connection, c) for c in (b"A", b"B", b"C", b"D"))
    return UsbWords(spi, interrupt, reset, sense, slow=slow)
