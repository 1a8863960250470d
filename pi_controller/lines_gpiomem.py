"""Several SYNC_IN lines with one store: the set and clear registers of a Raspberry Pi 1 to 4, through /dev/gpiomem.

Not run on hardware. Register offsets: "BCM2835 ARM Peripherals", section 6.1, and "BCM2711 ARM Peripherals", section
5.2, which agree in them.
"""

from __future__ import annotations

import mmap
import os
from typing import Any

from polysight.pi_controller.lines_gpiod import GpiodLines
from polysight.pi_controller.trigger_lines import Clock
from polysight.shared.config import Pi
from polysight.shared.errors import DeviceError
from polysight.shared.messages import GPIOMEM

GPFSEL0, GPSET0, GPCLR0 = 0x00, 0x1C, 0x28  # bytes from the start of the block
FUNCTION_OUTPUT = 0b001
_BLOCK_BYTES = 4096


class GpioRegisters:
    """The GPIO register block.

    Parameters
    ----------
    path
        /dev/gpiomem, or a file in its place.

    Raises
    ------
    DeviceError
        when it cannot be mapped.
    """

    def __init__(self, path: str) -> None:
        try:
            fd = os.open(path, os.O_RDWR | os.O_SYNC | os.O_CLOEXEC)
            try:
                self._block = mmap.mmap(fd, _BLOCK_BYTES)
            finally:
                os.close(fd)
        except (OSError, ValueError) as e:
            raise DeviceError(
                f"{path} cannot be mapped: {e}",
                "not a Raspberry Pi 1 to 4, or no permission (group gpio)",
                'correct pi.gpiomem, or use wiring = "fanout"',
            ) from None
        self._words = memoryview(self._block).cast("I")  # an item is written by one aligned 32-bit store

    def set(self, mask: int) -> None:
        """Lines 0..31 in `mask` go high, at once."""
        self._words[GPSET0 // 4] = mask

    def clear(self, mask: int) -> None:
        """Lines 0..31 in `mask` go low, at once."""
        self._words[GPCLR0 // 4] = mask

    def function(self, line: int) -> int:
        """What a line is: 0 input, 1 output, others peripherals. Ten lines a word, three bits each."""
        return self._words[GPFSEL0 // 4 + line // 10] >> line % 10 * 3 & 0b111

    def close(self) -> None:
        """Unmap."""
        self._words.release()
        self._block.close()


class GpiomemLines(GpiodLines):
    """Lines that the kernel holds as outputs for this program, and whose level is written past it.

    The kernel's request keeps others away, sets the direction, and frees the lines when this program dies.

    Raises
    ------
    DeviceError
        when a line cannot be had, or the registers do not show it as an output: they are not this chip's.
    """

    name: str = GPIOMEM

    def __init__(self, pi: Pi, gpiod: Any, chip_path: str | None = None, clock: Clock | None = None) -> None:
        self._registers = GpioRegisters(pi.gpiomem)
        self._mask = sum(1 << n for n in pi.sync_out)
        try:
            super().__init__(pi, gpiod, chip_path, clock)
        except DeviceError:
            self._registers.close()
            raise
        wrong = [n for n in pi.sync_out if self._registers.function(n) != FUNCTION_OUTPUT]
        if wrong:
            self.close()
            raise DeviceError(
                f"{pi.gpiomem} shows GPIO line {wrong[0]} as no output, though the kernel made it one",
                "another chip than pi.gpio_chip, or another Pi than 1 to 4",
                'use wiring = "fanout"',
            )

    def set_output(self, active: bool) -> None:
        """Set all SYNC_IN lines with one store."""
        if active:
            self._registers.set(self._mask)
        else:
            self._registers.clear(self._mask)

    def close(self) -> None:
        """Outputs low, lines released."""
        try:
            super().close()
        finally:
            self._registers.close()
