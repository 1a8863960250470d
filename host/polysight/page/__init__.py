"""The live view of one scan, which only reads (docs/decisions/0007-live-view.md).

A `Watch` follows the files of a scan folder and the Pi's events, and forms images of the committed rows (`watch`). It
collects rows, counts and faults (`history`), derives the status and what to do (`status`), and keeps the newest
snapshot for all pages. `polysight.serve` serves it.
"""

from polysight.page.watch import Watch
