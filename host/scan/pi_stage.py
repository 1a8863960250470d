"""Whether the Pi places rows as this host's rig file does: its `[stage]` is its own, on another machine."""

from __future__ import annotations

from polysight.host.store.manifest import Fact
from polysight.shared.config import Stage
from polysight.shared.errors import ScanError
from polysight.shared.messages import HelloReply

UNTOLD = "the Pi does not tell its [stage], so nobody compares it with this rig file's: install this release on the Pi"


def pi_fact(hello: HelloReply) -> Fact:
    """What a manifest keeps of the Pi that drives a scan."""
    return {"release": hello.pi_release, "firmware": hello.firmware, "backend": hello.backend, "stage": hello.stage}


def differences(stage: Stage, hello: HelloReply) -> list[str]:
    """Each placing key of `[stage]` that the Pi has otherwise, with both values; [] for a Pi that does not tell."""
    own = stage.placing
    return [
        f"stage.{key} is {own[key]:.10g} here and {hello.stage[key]:.10g} on the Pi"
        for key in own
        if hello.stage.get(key, own[key]) != own[key]
    ]


def check_same_stage(stage: Stage, hello: HelloReply, source: str) -> list[str]:
    """Refuse a Pi that would place the rows elsewhere; `source` is where `stage` is from.

    Returns
    -------
    list of str
        Warnings: that the Pi is of a release that does not tell.

    Raises
    ------
    ScanError
        naming each key with both values.
    """
    if differing := differences(stage, hello):
        raise ScanError(
            f"host and Pi place rows differently: {'; '.join(differing)}",
            f"the rig file of the Pi is not that of {source}; rows of both would be two coordinate systems in one scan",
            "copy the right [stage] to the other machine and `sudo systemctl restart polysight-pi`; rows taken with"
            " other values belong to another scan",
        )
    return [] if hello.stage else [UNTOLD]
