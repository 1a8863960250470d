"""When a record has ended: the card itself only knows start and stop, so the host decides, and never hangs."""

from __future__ import annotations

from enum import Enum

from polysight.host.capture.dca1000 import Status
from polysight.host.capture.receiver import Progress

TAIL_S = 2.0
"""Silence after which a card sends what does not fill a packet (seen)."""
GRACE_NS = 200_000_000
"""Silence after which nothing comes any more, once the card said so: status and data come on different ports."""


class Ending(Enum):
    """Why a record counts as ended."""

    BYTES = "every expected byte is there"
    STATUS = "the card reports the record as completed"
    TAIL = "the record's short last packet came"
    SILENCE = "nothing came any more"


def record_ending(progress: Progress, status: Status, since_ns: int, now_ns: int, silence_ns: int) -> Ending | None:
    """Why one board's record has ended, or None while it has not; whichever is first.

    Parameters
    ----------
    progress
        What its receiver said last.
    status
        What its card reported by itself since the record started.
    since_ns, now_ns
        When the last pulse was sent, and now, on the monotonic clock.
    silence_ns
        Silence that ends a record by itself. The card sends its short last packet after 2 s of it (seen).
    """
    if progress.complete:
        return Ending.BYTES
    silent_ns = now_ns - max(progress.last_arrival_ns, since_ns)
    if silent_ns >= GRACE_NS and Status.RECORD_COMPLETED in status:
        return Ending.STATUS
    if silent_ns >= GRACE_NS and progress.ended:
        return Ending.TAIL
    return Ending.SILENCE if silent_ns >= silence_ns else None
