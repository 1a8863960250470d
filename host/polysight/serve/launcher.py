"""A small process that starts programs for the server; it imports nothing of this package.

The server runs with low priority, and its children would inherit that; a scan must not. So this process is started
before and forks for the server. Each line of stdin is a request (`words`, `cwd`, `base`): the program runs in a session
of its own, with its output in `base`.log, its process number in `base`.json and finally its exit status in
`base`.status. A line of stdout answers. This process ends with the server; the programs go on.
"""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

SHELL = '"$@" >> "$0.log" 2>&1 < /dev/null; echo $? > "$0.status"'
POLL_S = 2.0


@dataclass(frozen=True)
class Record:
    """Content of `base`.json: a program's process number and start time (:func:`read_start_ticks`), and its command."""

    pid: int
    ticks: int
    words: list[str]
    started_utc: str


def read_start_ticks(pid: int) -> int | None:
    """Start time of a running process in clock ticks since boot, or None; it tells reused process numbers apart."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    fields = text.rpartition(")")[2].split()
    if fields[0] == "Z":
        return None
    return int(fields[19])


def launch(words: list[str], cwd: str, base: str) -> subprocess.Popen[bytes]:
    """Start one program, and record its process number and start time."""
    place = Path(base)
    place.parent.mkdir(parents=True, exist_ok=True)
    for suffix in (".status", ".json"):
        Path(base + suffix).unlink(missing_ok=True)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    with Path(base + ".log").open("a", encoding="utf-8") as log:
        log.write(f"--- {now} {' '.join(words)}\n")
    program = subprocess.Popen(["/bin/sh", "-c", SHELL, base, *words], cwd=cwd, start_new_session=True)
    record = Record(program.pid, read_start_ticks(program.pid) or 0, words, now)
    part = Path(base + ".part")
    part.write_text(json.dumps(asdict(record)) + "\n", encoding="utf-8")
    part.replace(base + ".json")
    return program


def main() -> int:
    """Handle requests until stdin is closed."""
    os.set_blocking(0, True)
    running: list[subprocess.Popen[bytes]] = []
    with selectors.DefaultSelector() as selector:
        selector.register(0, selectors.EVENT_READ)
        while True:
            # `poll` also reaps the programs that have ended.
            running = [program for program in running if program.poll() is None]
            if not selector.select(POLL_S):
                continue
            line = sys.stdin.readline()
            if not line:
                return 0
            try:
                running.append(launch(**json.loads(line)))
                answer = ""
            except OSError as e:
                # The error of a full disk has no file name.
                answer = f"{e.filename or json.loads(line)['base']}: {e.strerror or e}"
            except (ValueError, TypeError) as e:
                answer = str(e)
            sys.stdout.write(json.dumps(answer) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
