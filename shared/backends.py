"""The Pi's trigger lines by name, as `HelloReply.backend` tells them, and whether they drive hardware."""

from __future__ import annotations

GPIOD = "gpiod"  # through the kernel
GPIOMEM = "gpiomem"  # the same lines, set by the chip's registers
WIRES = "wires"  # simulated
_HARDWARE = (GPIOD, GPIOMEM)


def is_simulated(backend: str) -> bool:
    """Whether nothing real is driven. A name that is not known counts as simulated: nothing is called measured then."""
    return backend not in _HARDWARE
