"""Run a program of the instrument that kills itself (SIGKILL) at one given file operation.

    python killed_at.py HITS OPERATION:SUFFIX:NTH,... polysight scan --out DIR

The process kills itself before the NTH `OPERATION` (fsync, rename or ftruncate) on a file whose name ends in SUFFIX. A
write (pwrite) first writes half of its bytes. A kill at a random time would hardly ever hit these moments. With 0 for
NTH the process is not killed. Every such operation adds the line OPERATION:SUFFIX to the file HITS, so that a test can
count them.
"""

import os
import signal
import sys
from pathlib import Path
from typing import Any


def kill_at(hits: Path, operation: str, suffix: str, nth: int) -> None:
    """Replace a function of `os` by one that kills this process at its `nth` call for a file with this suffix."""
    function = getattr(os, operation)
    calls = 0

    def count_and_call(first_argument: Any, *more: Any, **named: Any) -> Any:
        nonlocal calls
        # The first argument is a descriptor; that of a rename is the old name, and the second one is the new name.
        if isinstance(first_argument, int):
            name = str(Path(f"/proc/self/fd/{first_argument}").readlink())
        else:
            name = str(more[0])
        if name.endswith(suffix):
            with hits.open("a", encoding="utf-8") as f:
                f.write(f"{operation}:{suffix}\n")
            calls += 1
            if calls == nth:
                if operation == "pwrite":
                    data, offset = more
                    first_half = bytes(data)[: len(data) // 2]
                    function(first_argument, first_half, offset)
                os.kill(os.getpid(), signal.SIGKILL)
        return function(first_argument, *more, **named)

    setattr(os, operation, count_and_call)


def main(words: list[str]) -> int:
    """Run `polysight` or `polysight-pi` with the remaining arguments."""
    hits, operations, program, *arguments = words
    for operation_text in operations.split(","):
        operation, suffix, nth = operation_text.split(":")
        kill_at(Path(hits), operation, suffix, int(nth))
    sys.argv = [str(Path(sys.executable).with_name(program)), *arguments]
    if program == "polysight":
        from polysight.cli.main import main as run
    else:
        from polysight_pi.cli import main as run
    return run()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
