"""Run a program of the instrument that kills itself (SIGKILL) at one exact file operation.

    python killed_at.py HITS OPERATION:SUFFIX:NTH,... polysight scan --out DIR

At the NTH `OPERATION` (pwrite, fsync, rename, ftruncate) on a file whose name ends in SUFFIX the process is killed:
before the operation, but within a write. Random kills would hardly ever hit these moments. Every such operation adds
its line OPERATION:SUFFIX to the file HITS; with NTH 0 nothing else happens.
"""

import os
import signal
import sys
from pathlib import Path
from typing import Any


def kill_at(hits: Path, operation: str, suffix: str, nth: int) -> None:
    """Have this process killed at the `nth` `operation` of `os` on a file whose name ends in `suffix` (0: never)."""
    function = getattr(os, operation)
    hits_left = nth

    def count_and_call(what: Any, *more: Any, **named: Any) -> Any:
        nonlocal hits_left
        # The first argument is a descriptor, except for a rename, whose second one is the new name.
        if isinstance(what, int):
            name = str(Path(f"/proc/self/fd/{what}").readlink())
        else:
            name = str(more[0])
        if name.endswith(suffix):
            with hits.open("a", encoding="utf-8") as f:
                f.write(f"{operation}:{suffix}\n")
            hits_left -= 1
            if not hits_left:
                # Half of the data is written.
                if operation == "pwrite":
                    data, offset = more
                    function(what, bytes(data)[: len(data) // 2], offset)
                os.kill(os.getpid(), signal.SIGKILL)
        return function(what, *more, **named)

    setattr(os, operation, count_and_call)


def main(words: list[str]) -> int:
    """Run `polysight` or `polysight-pi` with the remaining arguments."""
    hits, places, program, *arguments = words
    for place in places.split(","):
        operation, suffix, nth = place.split(":")
        kill_at(Path(hits), operation, suffix, int(nth))
    sys.argv = [str(Path(sys.executable).with_name(program)), *arguments]
    if program == "polysight":
        from polysight.cli.main import main as run
    else:
        from polysight_pi.cli import main as run
    return run()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
