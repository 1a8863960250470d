"""A burst as the bits of one SPI transfer: MOSI is SYNC_IN, one set bit a pulse, clocked out by hardware.

Every Pi has an SPI controller with DMA. Its clock makes the widths and the spacing of all pulses of a burst, whatever
the program and the kernel do meanwhile: one bit is one width, and a pulse lies within half a bit of its place.
"""

from __future__ import annotations

from typing import NamedTuple

from polysight.shared.errors import ConfigError

FASTEST_HZ, SLOWEST_HZ = 2_000_000, 500_000  # pulses of 0.5 .. 2 us: within what the radar takes, 25 ns .. 4 us
LEAD_BITS = 8  # low bits before the first pulse, and at least so many behind the last: the line idles as the last bit
SHORTEST_BYTES = 96  # below it spi-bcm2835 writes byte by byte, with gaps; from it on it uses DMA
LONGEST_PART = 65_535
DEFAULT_BUFSIZ = 4096


class SpiBurst(NamedTuple):
    """One burst.

    Attributes
    ----------
    data
        Bytes of the transfer, most significant bit first.
    clock_hz
        Bit clock.
    bits
        Place of each pulse in the transfer.
    """

    data: bytes
    clock_hz: int
    bits: tuple[int, ...]

    @property
    def bit_ns(self) -> float:
        """Length of a bit, and of a pulse."""
        return 1e9 / self.clock_hz

    @property
    def duration_ns(self) -> float:
        """Length of the transfer."""
        return 8 * len(self.data) * self.bit_ns


def spi_burst(pulses: int, period_ns: int, width_ns: int, bufsiz: int = DEFAULT_BUFSIZ) -> SpiBurst:
    """The transfer that is a burst.

    Parameters
    ----------
    pulses, period_ns, width_ns
        The burst. The clock is one bit a width, within SLOWEST_HZ .. FASTEST_HZ; slower, down to SLOWEST_HZ, where the
        burst would not fit.
    bufsiz
        Longest transfer that spidev takes, bytes.

    Raises
    ------
    ConfigError
        when it does not fit even at the slowest clock, with the bufsiz that it needs and where to set it.
    """
    wanted_hz = min(max(round(1e9 / width_ns), SLOWEST_HZ), FASTEST_HZ)
    for clock_hz in (wanted_hz, SLOWEST_HZ):
        bits = tuple(LEAD_BITS + round(k * period_ns * clock_hz / 1e9) for k in range(pulses))
        n = max(SHORTEST_BYTES, (bits[-1] + LEAD_BITS) // 8 + 1)
        if n <= bufsiz:
            data = bytearray(n)
            for bit in bits:
                data[bit // 8] |= 0x80 >> bit % 8
            return SpiBurst(bytes(data), clock_hz, bits)
    room = 4096
    while room < n:
        room *= 2
    raise ConfigError(
        f"a burst of {pulses} pulses every {period_ns / 1e3:g} us takes an SPI transfer of {n} bytes, spidev {bufsiz}",
        "its buffer is 4096 bytes unless it is told otherwise",
        f"write `options spidev bufsiz={room}` into /etc/modprobe.d/spidev.conf (a kernel with spidev built in:"
        f" `spidev.bufsiz={room}` in /boot/firmware/cmdline.txt), and start the Pi again; or fewer pulses",
    )


def longest_pause_ns(burst: SpiBurst) -> int:
    """Largest distance of a pulse from its ideal place: half a bit."""
    return round(burst.bit_ns / 2)
