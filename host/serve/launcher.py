"""Starts programs for the server, from a small process of its own, which loads nothing else of this package.

The server has stepped back (low priority, first to go when memory runs out), and whatever it started would inherit
that; a scan must not. So this is started before, and forks for it. Each line of stdin is a request (`words`, `cwd`,
`base`): the program runs in a session of its own, its output in `base`.log, its number in `base`.json, its exit status,
when it has ended, in `base`.status. A line of stdout answers. When the server is gone, this ends; the programs go on.
"""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

_SHELL = '"$@" >> "$0.log" 2>&1 < /dev/null; echo $? > "$0.status"'
_LOOK_S = 2.0


def started_ticks(pid: int) -> int | None:
    """When a living process began, in ticks since the machine did: with the number it names it for good."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    fields = text.rpartition(")")[2].split()
    return None if fields[0] == "Z" else int(fields[19])


def launch(words: list[str], cwd: str, base: str) -> subprocess.Popen[bytes]:
    """Start one program, and write down which it is."""
    place = Path(base)
    place.parent.mkdir(parents=True, exist_ok=True)
    for suffix in (".status", ".json"):
        Path(base + suffix).unlink(missing_ok=True)
    now = datetime.now(UTC).isoformat(timespec="seconds")
    with Path(base + ".log").open("a", encoding="utf-8") as log:
        log.write(f"--- {now} {' '.join(words)}\n")
    program = subprocess.Popen(["/bin/sh", "-c", _SHELL, base, *words], cwd=cwd, start_new_session=True)
    told: dict[str, Any] = {"pid": program.pid, "ticks": started_ticks(program.pid), "words": words, "started_utc": now}
    part = Path(base + ".part")
    part.write_text(json.dumps(told) + "\n", encoding="utf-8")
    part.replace(base + ".json")
    return program


def main() -> int:
    """Serve until the other end of stdin is gone."""
    os.set_blocking(0, True)
    running: list[subprocess.Popen[bytes]] = []
    with selectors.DefaultSelector() as selector:
        selector.register(0, selectors.EVENT_READ)
        while True:
            running = [program for program in running if program.poll() is None]  # those that ended are taken leave of
            if not selector.select(_LOOK_S):
                continue
            line = sys.stdin.readline()
            if not line:
                return 0
            try:
                running.append(launch(**json.loads(line)))
                answer = ""
            except (OSError, ValueError, TypeError) as e:
                answer = f"{type(e).__name__}: {e}"
            sys.stdout.write(json.dumps(answer) + "\n")
            sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
