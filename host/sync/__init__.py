"""Synchronisation of one row of one board: filter compensation, burst alignment, direct-path reference."""

from polysight.host.sync.chain import BoardSetup, SyncedRow, synchronise_row

__all__ = ["BoardSetup", "SyncedRow", "synchronise_row"]
