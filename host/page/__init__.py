"""`polysight preview`: looks on at a scan, and never stands in its way (docs/decisions/0007-live-view.md).

`preview` serves one scan folder. A `Watch` follows its files (`watch`) and the Pi's events (`listener`), forms images
of the committed rows (`images`), tells the scan's story and its faults (`story`), judges it (`verdict`), shows the
verdict of its products when it was processed (`result`) and keeps the newest snapshot for every page (`snapshot`,
`server`).
"""

from polysight.host.page.server import preview

__all__ = [
    "preview",
]
