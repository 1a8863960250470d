"""Progress of commands that do one thing after another, each of it for seconds or minutes."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from typing import TypeVar

T = TypeVar("T")


def steps(things: Sequence[T], called: Sequence[str]) -> Iterator[T]:
    """The things one by one; on stderr what each is `called` before it begins, and how long it took when it is done."""
    for k, (thing, name) in enumerate(zip(things, called, strict=True), 1):
        sys.stderr.write(f"[{k}/{len(things)}] {name} ...")
        sys.stderr.flush()
        began = time.monotonic()
        yield thing
        sys.stderr.write(f" {time.monotonic() - began:.0f} s\n")
