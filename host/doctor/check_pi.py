"""The Pi: keys to reach it, whether it answers, its release, and whether the rig is free."""

from __future__ import annotations

import os
from pathlib import Path

import shared
from host.doctor.bench import Bench
from host.doctor.finding import Finding, error, ok, warning
from shared.sockets import is_loopback

SIMULATED = "simulated wires: no hardware is driven"
_FILES = ("host.key_secret", "host.key", "pi.key")


def check_keys(bench: Bench) -> Finding:
    """CURVE keys are there and secret, where the addresses need them."""
    pi = bench.rig.pi
    if is_loopback(pi.command_address) and is_loopback(pi.event_address):
        return ok("not needed: both addresses are loopback")
    folder = Path(pi.key_dir)
    if missing := [name for name in _FILES if not os.access(folder / name, os.R_OK)]:
        return error(
            f"{folder}: {', '.join(missing)} cannot be read",
            "the Pi's keys were not copied here, or belong to another user",
            "on the Pi `polysight-pi keys`; copy its folder to pi.key_dir",
        )
    mode = (folder / _FILES[0]).stat().st_mode
    if mode & 0o077:
        return warning(
            f"{folder / _FILES[0]} can be read by others ({mode & 0o777:o})",
            "whoever reads it may drive the stage",
            f"`chmod 600 {folder / _FILES[0]}`",
        )
    return ok(f"{folder} holds them")


def check_pi(bench: Bench) -> Finding:
    """It answers, and is of this release."""
    before = bench.system.wall_ns()
    hello = bench.pi.hello()
    after = bench.system.wall_ns()
    bench.hello, bench.hello_at_ns, bench.hello_took_ns = hello, (before + after) // 2, after - before
    lines = SIMULATED if hello.backend == "wires" else f"lines by {hello.backend}"
    told = f"{bench.rig.pi.command_address} answers: release {hello.pi_release}, {lines}, state {hello.state}"
    facts = {"release": hello.pi_release, "backend": hello.backend, "state": hello.state}
    if hello.pi_release != shared.__version__:
        return error(
            told,
            f"this host is of release {shared.__version__}",
            "install the same release on both: `make pi-install HOST=...`",
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
