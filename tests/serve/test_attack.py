"""Abort during concurrent requests: streams, live views, readers, wrong tokens, connections without a request.

The server runs as its command. The duration of each abort is printed (`-s` shows it); only its success is asserted.
"""

import os
import random
import shutil
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tests.serve.test_processes import Server, run_server
from tests.support.page.asking import post
from tests.support.page.live_view import open_control
from tests.support.paths import REPO
from tests.support.processes import wait_for


class Attack(NamedTuple):
    """Numbers of clients of each kind, in the order of the arguments of `attackers.py`."""

    # Clients that follow a live view.
    streams: int
    # Clients that request one page after another.
    readers: int
    # Clients that send the abort of a scan with a wrong token.
    wrong_tokens: int
    # Connections that are opened each second, and closed without a request.
    connections: int
    # Aborts with the right token that the test sends meanwhile.
    aborts: int


# The brief one shows in a few seconds that the test works. In the long one the server has more work than a laboratory's
# pages make, and there are so many aborts that a rare failure is seen.
BRIEF = Attack(streams=4, readers=10, wrong_tokens=4, connections=50, aborts=3)
LONG = Attack(streams=48, readers=250, wrong_tokens=90, connections=1000, aborts=100)
# Each of these scans has a live view.
VIEWS = 4


@contextmanager
def run_attack(port: int, attack: Attack, folder: Path) -> Iterator[subprocess.Popen[bytes]]:
    """Run the clients in a process of their own during the block."""
    command = [sys.executable, "-m", "tests.serve.attackers", str(port), *map(str, attack), str(VIEWS)]
    with (folder / "attackers.txt").open("wb") as output_file:
        clients = subprocess.Popen(command, cwd=REPO, stdout=output_file)
        try:
            yield clients
            assert clients.poll() is None, "the attackers have ended"
        finally:
            clients.terminate()
            clients.wait()


def abort_once(server: Server, folder: Path) -> float:
    """Abort a running scan; return the seconds until the answer."""
    with open_control(folder) as stop:
        begun_s = time.monotonic()
        status, answer = post(server, f"/api/control/abort?scan={folder.name}", token=server.token)
        took_s = time.monotonic() - begun_s
        assert status == 200, answer
        assert stop.now
    return took_s


def test_an_abort_is_accepted_whatever_other_clients_request(
    processed_scans: Path, tmp_path: Path, request, record_property
):
    attack = LONG if request.config.getoption("--long") else BRIEF
    # The last of the scans has no live view; it is the one that the test aborts.
    for k in range(VIEWS + 1):
        shutil.copytree(processed_scans / "one", tmp_path / "scans" / f"s{k}", ignore=shutil.ignore_patterns("figures"))
    (tmp_path / "state").mkdir()
    took_s = []
    with run_server(tmp_path / "scans", tmp_path / "state") as server, run_attack(server.port, attack, tmp_path):
        # The clients report once a second; after the first report all are running.
        wait_for(lambda: "answers" in (tmp_path / "attackers.txt").read_text(), "the attack")
        for _ in range(attack.aborts):
            took_s.append(abort_once(server, tmp_path / "scans" / f"s{VIEWS}"))
            time.sleep(random.uniform(0, 0.2))
    record_property("median_s", statistics.median(took_s))
    record_property("longest_s", max(took_s))
    record_property("load", os.getloadavg()[0])
    # Reported only: a busy machine may be slow.
    late = sum(seconds >= 1 for seconds in took_s)
    sys.stdout.write(f"median {statistics.median(took_s):.3f} s, longest {max(took_s):.3f} s, {late} of {len(took_s)}")
    sys.stdout.write(f" took 1 s or more; load {os.getloadavg()[0]:.1f}\n{(tmp_path / 'attackers.txt').read_text()}")
