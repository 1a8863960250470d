"""The live view of one scan, which only reads (docs/decisions/0007-live-view.md).

A `Watch` follows the files of a scan folder (`watch`) and the Pi's events (`listener`), forms images of the committed
rows (`images`), collects rows, counts and faults (`history`), derives the status and what to do (`status`), and keeps
the newest snapshot for all pages (`snapshot`). `host/polysight/serve` serves it.
"""

from polysight.page.watch import Watch

__all__ = [
    "Watch",
]
