"""The receiver processes that this test's scan has started, by board."""

from __future__ import annotations

import threading
from pathlib import Path


def receivers() -> list[int]:
    """Their process ids, in the order of the recorded boards."""
    children = Path(f"/proc/self/task/{threading.main_thread().native_id}/children").read_text().split()
    return sorted(
        int(pid)
        for pid in children
        if b"polysight.host.capture.receiver_process" in Path(f"/proc/{pid}/cmdline").read_bytes()
    )


def receiver_of(board: str) -> int:
    """Process id of a board's receiver, of the boards RH and RV."""
    return receivers()[["RH", "RV"].index(board)]
