"""Synchronisation of the rows of a board: from raw chirps to samples referenced to the direct path.

`synchronise_row` processes a row of raw chirps with a board's `BoardSetup`: compensate the high-pass filter, align the
chirps of each burst and average them (`align_row`), find the direct path and remove its frequency and phase
(`reference`). The result is a `SyncedRow`, with the residual errors after each stage. `RowSynchroniser` does this for
every row of a source, and converts cubes that another program has synchronised. The loops run compiled (C) if possible,
otherwise in NumPy with equal results; `cis` is exp(i x). `estimate_backlash` measures the backlash of the stage from
the echoes.
"""

from polysight.sync.backlash import estimate_backlash, object_filter
from polysight.sync.chain import PUBLISHED_STD, STAGES, BoardSetup, RowSynchroniser, synchronise_row
from polysight.sync.decimate import FOLD, block_frequencies_hz, decimation, sample_frequencies_hz, whole_blocks
from polysight.sync.direct_path import DirectPath, prepare
from polysight.sync.high_pass_filter import HighPass, fit_high_pass, high_pass
from polysight.sync.loops import cis
from polysight.sync.offsets import (
    AlignedRow,
    SyncedRow,
    align_row,
    reference,
)
from polysight.sync.rx_order import find_rx_order, judge_rx_order
