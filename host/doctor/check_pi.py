"""The Pi: keys to reach it, whether it answers, its release, and whether the rig is free."""

from __future__ import annotations

import os
from pathlib import Path

from polysight.host.acquisition.ready import differences
from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, error, ok, warning
from polysight.shared import __version__
from polysight.shared.backends import is_simulated
from polysight.shared.sockets import HOST_KEYS, is_loopback

SIMULATED = "simulated wires: no hardware is driven"


def check_keys(bench: Bench) -> Finding:
    """CURVE keys are there and secret, where the addresses need them."""
    pi = bench.rig.pi
    if is_loopback(pi.command_address) and is_loopback(pi.event_address):
        return ok("not needed: both addresses are loopback")
    folder = Path(pi.key_dir)
    if missing := [name for name in HOST_KEYS if not os.access(folder / name, os.R_OK)]:
        return error(
            f"{folder}: {', '.join(missing)} cannot be read",
            "the Pi's keys were not copied here, or belong to another user",
            f"copy the Pi's {' and '.join(HOST_KEYS)} here (docs/how-to/install.md); pi.key_dir is {folder}",
        )
    secret = folder / HOST_KEYS[-1]
    mode = secret.stat().st_mode
    if mode & 0o077:
        return warning(
            f"{secret} can be read by others ({mode & 0o777:o})",
            "whoever reads it may drive the stage",
            f"`chmod 600 {secret}`",
        )
    return ok(f"{folder} holds them")


def check_pi(bench: Bench) -> Finding:
    """It answers, and is of this release."""
    before = bench.system.wall_ns()
    hello = bench.pi.hello()
    after = bench.system.wall_ns()
    bench.hello, bench.hello_at_ns, bench.hello_took_ns = hello, (before + after) // 2, after - before
    lines = SIMULATED if is_simulated(hello.backend) else f"lines by {hello.backend}"
    told = f"{bench.rig.pi.command_address} answers: release {hello.pi_release}, {lines}, state {hello.state}"
    facts = {"release": hello.pi_release, "backend": hello.backend, "state": hello.state}
    if hello.pi_release != __version__:
        return error(
            told,
            f"this host is of release {__version__}",
            "install the same release on both: `make pi-install HOST=...`",
            **facts,
        )
    if differing := differences(bench.rig.stage, hello):
        return error(
            f"{told}; {'; '.join(differing)}",
            "host and Pi have different rig files: a scan is refused",
            "copy the right [stage] to the other machine, `sudo systemctl restart polysight-pi`",
            **facts,
        )
    return ok(told, **facts)


def check_free(bench: Bench) -> Finding:
    """No scan is running: the doctor must not take its cards away."""
    if bench.hello is not None and (bench.hello.in_run or bench.hello.state in ("ready", "running", "held", "done")):
        return error(
            f"scan {bench.hello.scan_id} is begun, the state is {bench.hello.state}",
            "a scan runs, or the host that began it died",
            "wait for its end, or end it with `polysight resume`; restarting polysight-pi forgets it",
        )
    return ok("no scan is begun")
