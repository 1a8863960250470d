"""The live view of one scan: looks on, and never stands in its way (docs/decisions/0007-live-view.md).

A `Watch` follows a scan folder's files (`watch`) and the Pi's events (`listener`), forms images of the committed rows
(`images`), tells the scan's story and its faults (`story`), judges it (`verdict`), shows the verdict of its products
when it was processed (`result`) and keeps the newest snapshot for every page (`snapshot`). `host/serve` serves it.
"""

from polysight.host.page.watch import Watch

__all__ = [
    "Watch",
]
