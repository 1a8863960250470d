"""Rows of one scan, or boards of a row, on all cores: the passes of synchronisation release the interpreter."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Result = TypeVar("Result")

MOST = 8
"""Rows at a time: each holds some 60 MB of the published grid, and memory is slower than so many cores."""


def cores() -> int:
    """Cores that this program may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def each_row(add: Callable[[int], object], rows: Sequence[int], threads: int | None = None) -> Iterator[int]:
    """Call `add` for every row, several at a time; gives each row back when it is done, in order.

    `threads` None: one a core. The first error ends it: rows that were not begun are left out.
    """
    count = min(threads or cores(), MOST, len(rows))
    if count <= 1:
        for row in rows:
            add(row)
            yield row
        return
    with ThreadPoolExecutor(count) as pool:
        try:
            begun = [(row, pool.submit(add, row)) for row in rows]
            for row, done in begun:
                done.result()
                yield row
        finally:
            pool.shutdown(cancel_futures=True)


def of_each(names: Iterable[str], make: Callable[[str], Result], at_once: bool) -> dict[str, Result]:
    """What `make` returns for each name; `at_once`: on as many cores as there are."""
    names = list(names)
    count = min(cores(), len(names)) if at_once else 1
    if count <= 1:
        return {name: make(name) for name in names}
    with ThreadPoolExecutor(count) as pool:
        return dict(zip(names, pool.map(make, names), strict=True))
