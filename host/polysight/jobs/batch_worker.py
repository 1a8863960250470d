"""`python -m polysight.jobs.batch_worker`: process the job on standard input, and mark it as finished."""

from __future__ import annotations

import os
import resource
import sys
import threading
import time
from pathlib import Path

import msgspec

from polysight.jobs.batch import ALIVE, Job
from polysight.jobs.process import process
from polysight.products import FINISHED, write_json
from polysight.results import NoResult
from polysight_shared.errors import PolysightError


def end_with(pipe: str | None) -> None:
    """Exit when the other end of a pipe closes, so that a killed worker leaves nothing running."""
    if pipe is None:
        return

    def wait() -> None:
        os.read(int(pipe), 1)
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def main() -> int:
    """Process one job; returns the exit status. Output goes to stdout and stderr."""
    end_with(os.environ.get(ALIVE))
    job = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=Job)
    began = time.monotonic()
    try:
        (job.out / FINISHED).unlink(missing_ok=True)
        status = process(Path(job.data), job.out, job.settings, job.threads)
    except PolysightError as e:
        sys.stderr.write(f"{e}\n")
        return e.exit_status
    except OSError as e:
        sys.stderr.write(f"{e.filename or job.out}: {e.strerror or e}\n")
        return 1
    if status == NoResult.exit_status:
        status = 0  # the scan is processed: its products say that nothing can be named
    if status == 0:
        used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
        seconds = round(time.monotonic() - began, 1)
        write_json(job.out / FINISHED, {"made_with": job.made_with, "seconds": seconds, "memory_gb": used / 1e9})
    return status


if __name__ == "__main__":
    sys.exit(main())
