"""The receiver processes of this test's scan, by board."""

from __future__ import annotations

import os
from pathlib import Path

from polysight.capture import receiver_process
from tests.support.processes import processes_naming


def receivers() -> list[int]:
    """Process ids of the receivers of this test's scan, in the order of the recorded boards."""
    return sorted(pid for pid in processes_naming(receiver_process.__name__) if _parent(pid) == os.getpid())


def _parent(pid: int) -> int:
    """Process id of the parent, see proc(5)."""
    return int(Path(f"/proc/{pid}/stat").read_text(encoding="ascii").rpartition(")")[2].split()[1])


def find_receiver(board: str) -> int:
    """Process id of the receiver of RH or RV."""
    return receivers()[["RH", "RV"].index(board)]
