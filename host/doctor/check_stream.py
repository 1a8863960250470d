"""SYNC_IN and the radars: a few pulses at rest, and the frames that must follow.

Nothing moves. Radars that are armed transmit for as long as the pulses last, some tens of milliseconds.
"""

from __future__ import annotations

from polysight.host.acquisition.pi_client import RefusedError
from polysight.host.capture.network import silent_radar
from polysight.host.doctor.bench import Bench
from polysight.host.doctor.finding import Finding, error, not_checked, ok, warning
from polysight.host.radar.interface import RadarState
from polysight.shared.config import Board
from polysight.shared.faults import PiFault, explain
from polysight.shared.messages import MOST_PULSES, MOST_PULSES_S


def check_pulses(bench: Bench) -> Finding:
    """Capture a few bursts; the Pi sends every pulse, none of them too long."""
    if not bench.wanted.pulse:
        return not_checked("--no-pulse: no SYNC_IN pulse is sent", "leave it out; nothing moves")
    if not bench.sound:
        return not_checked("no card can be used")
    from polysight.host.doctor.capture import capture, only

    rig, burst = only(bench.rig, bench.sound), bench.rig.burst
    period_s = burst.period_us * 1e-6
    try:
        bursts = min(bench.wanted.bursts, MOST_PULSES // burst.pulses, int(MOST_PULSES_S / (burst.pulses * period_s)))
        if not bursts:
            return not_checked(
                f"a burst of {burst.pulses} pulses every {burst.period_us:g} us is longer than the Pi sends at rest",
                f"`polysight scan` can use it; here at most {MOST_PULSES} pulses or {MOST_PULSES_S:g} s",
            )
        bench.captured, sent = capture(rig, bench.pi, bursts)
    except RefusedError as e:
        if e.number != PiFault.BAD_REQUEST:
            raise
        return error(e.what, "the Pi's release does not know this command", "install the same release on both")
    told = (
        f"{sent.pulses} sent at rest, at most {sent.width_max_ns / 1e3:.2f} us long,"
        f" at most {sent.jitter_ns / 1e3:.2f} us late"
    )
    facts = {k: getattr(sent, k) for k in ("pulses", "width_max_ns", "jitter_ns", "fault")}
    if sent.fault:
        e = explain(sent.fault)
        return error(f"{told}: {e.what}", e.why, e.remedy, **facts)
    return ok(told, **facts)


def check_radar(bench: Bench, board: Board) -> Finding:
    """Every pulse made a frame, and every frame came."""
    got = bench.captured.get(board.name)
    if got is None:
        return not_checked("nothing was captured")
    row, frames, whole = got.row, len(got.valid), int(got.valid.sum())
    facts = {"frames_expected": frames, "frames": whole, "bytes": row.bytes, "packets": row.packets}
    if got.radar is not None and got.radar.state is RadarState.FAULT:
        return error(
            f"the radar stopped by itself: {got.radar.detail}",
            "see there",
            "`python -m polysight.host.radar check`",
            **facts,
        )
    if row.packets == 0:
        e = silent_radar(board, row)
        return error(e.what, e.why, e.remedy, **facts)
    told = f"{whole} of {frames} frames, {row.packets} packets"
    if row.slipped or (row.bytes < row.expected and not row.gap_bytes):
        return error(
            f"{told}: {row.reason or 'the record ended early'}",
            "the radar missed pulses: the level or the width of SYNC_IN, or it was armed for fewer frames",
            "look at SYNC_IN with an oscilloscope at the board (0..3.3 V, 25 ns..4 us)",
            **facts,
        )
    if row.lost_before_packets:
        return error(
            f"{told}; the card reports {row.lost_before_packets.name}",
            "the card dropped data before it was numbered: it sends more slowly than the radar measures",
            "shorten card.packet_delay_us",
            **facts,
        )
    if row.missing:
        return warning(
            f"{told}; {row.missing_bytes} bytes are missing, {row.kernel_drops} packets dropped by this machine",
            "packets are lost on the way",
            "check cable, switch and the receive buffer above; a scan takes such rows again",
            **facts,
        )
    if row.strangers:
        return warning(
            f"{told}; {row.strangers} packets from other addresses",
            "two cards have the same data port",
            "`polysight card program` gives each its own",
            **facts,
        )
    return ok(told, **facts)
