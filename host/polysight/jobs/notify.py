"""Tell somebody that a scan has ended: one command, or one message to a web address, from `[notify]` of the rig file.

It comes last and costs the scan nothing: what goes wrong with it is a note on the terminal.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from urllib.error import URLError
from urllib.request import Request, urlopen

from polysight_shared.config import Notify

TIMEOUT_S = 20.0


def notify(settings: Notify, folder: Path, state: str, text: str) -> None:
    """Run the command with the text as its last argument, and send `{"scan", "state", "text"}` to the address.

    `state` is `finished`, `stopped` or `failed`.
    """
    message = f"{folder.name}: {text}"
    if settings.command:
        _try(lambda: _run([*shlex.split(settings.command), message]), "notify.command")
    if settings.url:
        content = json.dumps({"scan": folder.name, "state": state, "text": message}).encode()
        _try(lambda: _post(settings.url, content), "notify.url")


def _run(words: list[str]) -> None:
    subprocess.run(words, check=True, timeout=TIMEOUT_S, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL)


def _post(url: str, content: bytes) -> None:
    with urlopen(Request(url, content, {"Content-Type": "application/json"}), timeout=TIMEOUT_S):
        pass


def _try(send: Callable[[], None], name: str) -> None:
    try:
        send()
    except (OSError, ValueError, subprocess.SubprocessError, URLError) as e:
        with suppress(OSError):
            sys.stderr.write(f"note: {name} of the rig file did not work: {type(e).__name__}\n")
