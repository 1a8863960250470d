"""Process rows, or the boards of a row, on several threads: the compiled synchronisation releases the interpreter."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

MAX_ROWS = 8
"""Rows in flight: each takes some 60 MB on the published grid, and memory bandwidth limits more threads."""


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def map_rows(add: Callable[[int], object], rows: Sequence[int], threads: int | None = None) -> Iterator[int]:
    """Call `add` for every row, on `threads` threads (None: one per core); yield each finished row, in order.

    The first error is raised, and rows that were not started are cancelled.
    """
    count = min(threads or cores(), MAX_ROWS, len(rows))
    if count <= 1:
        for row in rows:
            add(row)
            yield row
        return
    with ThreadPoolExecutor(count) as pool:
        try:
            futures = [pool.submit(add, row) for row in rows]
            for row, future in zip(rows, futures, strict=True):
                future.result()
                yield row
        finally:
            pool.shutdown(cancel_futures=True)


def map_boards(names: Iterable[str], function: Callable[[str], Result], parallel: bool) -> dict[str, Result]:
    """Return `function(name)` for each board, by name; on one thread per core if `parallel`."""
    names = list(names)
    count = min(cores(), len(names)) if parallel else 1
    if count <= 1:
        return {name: function(name) for name in names}
    with ThreadPoolExecutor(count) as pool:
        return dict(zip(names, pool.map(function, names), strict=True))
