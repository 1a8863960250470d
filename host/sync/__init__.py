"""Synchronisation of one row of one board: filter compensation, burst alignment, direct-path reference.

`synchronise_row` does it for raw chirps with a board's `BoardSetup`; `RowSynchroniser` for every row of a source,
published cubes included.
"""

from polysight.host.sync.align import AlignedRow, align_row, whole_blocks
from polysight.host.sync.backlash import echo_of_row, estimate_backlash, object_filter
from polysight.host.sync.chain import BoardSetup, SyncedRow, synchronise_row
from polysight.host.sync.direct_path import reference
from polysight.host.sync.high_pass_filter import HighPass, fit_high_pass, high_pass
from polysight.host.sync.numpy_passes import FOLD
from polysight.host.sync.residuals import STAGES, noise_power
from polysight.host.sync.rows import RowSynchroniser
from polysight.host.sync.tone import cis

__all__ = [
    "FOLD",
    "STAGES",
    "AlignedRow",
    "BoardSetup",
    "HighPass",
    "RowSynchroniser",
    "SyncedRow",
    "align_row",
    "cis",
    "echo_of_row",
    "estimate_backlash",
    "fit_high_pass",
    "high_pass",
    "noise_power",
    "object_filter",
    "reference",
    "synchronise_row",
    "whole_blocks",
]
