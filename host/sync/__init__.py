"""Synchronisation of one row of one board: filter compensation, burst alignment, direct-path reference.

`synchronise_row` does it for raw chirps with a board's `BoardSetup`; `RowSynchroniser` for every row of a source,
published cubes included.
"""

from polysight.host.sync.chain import BoardSetup, SyncedRow, synchronise_row
from polysight.host.sync.rows import RowSynchroniser

__all__ = ["BoardSetup", "RowSynchroniser", "SyncedRow", "synchronise_row"]
