"""Checks of the capture side: network, cards, SYNC_IN pulses, radars, and the signal itself.

First each card's link, the card and its receive buffer. Then a few pulses at rest and the frames that must follow, and
from these frames level, direct path and the receivers' skew. Nothing moves. Radars that are armed transmit for as long
as the pulses last, some tens of milliseconds.
"""

from __future__ import annotations

import numpy as np

from polysight.host.acquisition import RefusedError
from polysight.host.calibration import FULL_SCALE, DirectSignal, band_hz, find_direct, jitter_hz, unwrapped
from polysight.host.capture import HopFinding, route_interface, silent_radar
from polysight.host.doctor.bench import Bench, Finding, error, nic, not_checked, ok, warning
from polysight.host.radar import RadarState
from polysight.shared.config import Board, Instrument
from polysight.shared.faults import PiFault, explain
from polysight.shared.messages import MOST_PULSES, MOST_PULSES_S

# Network card: what it must carry.
MTU = 1500
SPEED_MBIT = 1000
RING = 512
_BEFORE_DATA = ("host", "route", "link", "card")  # hops of the survey

# Direct path.
HEARD = 0.9  # part of the chirps in which it must be found
APART_S = 10e-9  # 5 ns of trigger, and some ppm of crystals

# Level.
CLIPPED = 0.01  # part of the chirps that may be clipped
WEAK = 4.0  # counts

# Skew of two receivers.
MUCH_S = 10e-9
TOO_MUCH_S = 20e-9
JITTER_S = 4e-9  # two clocks of 5 ns each make 2 ns


def check_pulses(bench: Bench) -> Finding:
    """Capture a few bursts; the Pi sends every pulse, none of them too long."""
    if not bench.wanted.pulse:
        return not_checked("--no-pulse: no SYNC_IN pulse is sent", "leave it out; nothing moves")
    if not bench.sound:
        return not_checked("no card can be used")
    from polysight.host.doctor.bench import capture, only

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
            "`polysight radar check BOARD`",
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


def check_network(bench: Bench, board: Board) -> Finding:
    """A gigabit link that carries whole packets. What the kernel does not tell is left out."""
    if board.card_address.startswith("127."):
        return ok("loopback: no network card is involved")
    name = route_interface(board.card_address, bench.system.root)
    if not name:
        return warning(
            f"no interface is in the subnet of {board.card_address}",
            "it has no address there, or this system does not tell",
            f"`ip address add {board.host_address}/24 dev <interface>`",
        )
    found = nic(name, bench.system.root)
    told = [f"{name}: MTU {found.mtu or 'unknown'}", f"{found.speed_mbit or 'unknown'} Mbit/s"]
    told += [f"ring {found.ring} of {found.ring_max}"] if found.ring is not None else []
    facts, text = vars(found), ", ".join(told)
    if found.mtu is not None and found.mtu < MTU:
        return warning(
            text, f"packets of a card fill frames of {MTU} bytes", f"`ip link set {name} mtu {MTU}`", **facts
        )
    if found.speed_mbit is not None and found.speed_mbit < SPEED_MBIT:
        return warning(
            text,
            "a DCA1000 sends at gigabit speed: a slower link drops packets of each burst",
            "a cable of category 5e or better, and a gigabit port; no 100 Mbit switch between",
            **facts,
        )
    if found.ring is not None and found.ring < min(RING, found.ring_max or RING):
        return warning(
            text,
            "few receive descriptors: a pause of this machine loses packets before the socket's buffer",
            f"`ethtool -G {name} rx {found.ring_max}`",
            **facts,
        )
    if found.lost:
        return warning(
            f"{text}; {found.lost} packets lost since it came up",
            "the interface or the kernel dropped them before any program could take them",
            f"`ethtool -S {name}`; does the number grow during a scan?",
            **facts,
        )
    return ok(text, **facts)


def check_card(bench: Bench, board: Board) -> Finding:
    """The card answers at its address; what does not, is the first hop that is silent."""
    survey = bench.surveys[board.name]
    wrong = next((h for h in survey.hops if h.hop in _BEFORE_DATA and h.verdict == "error"), None)
    if wrong is not None:
        return _as(wrong)
    return ok(
        f"{board.card_address}:{board.command_port} answers, FPGA {survey.version}; data to"
        f" {board.host_address}:{board.data_port}",
        fpga=survey.version,
    )


def check_buffer(bench: Bench, board: Board) -> Finding:
    """The receiving process starts as in a scan, and the kernel grants it the buffer that was asked for."""
    hops = {h.hop: h for h in bench.surveys[board.name].hops}
    receiver, buffer = hops["receiver"], hops["buffer"]
    for verdict in ("error", "warning"):
        for hop in (buffer, receiver):
            if hop.verdict == verdict:
                return _as(hop)
    bench.sound.add(board.name)
    return ok(f"{buffer.found}; {receiver.found}")


def _as(hop: HopFinding) -> Finding:
    return Finding(hop.verdict, hop.found, hop.why, hop.remedy)


def check_direct_path(bench: Bench, board: Board) -> Finding:
    """Found in most chirps, within the band, and where geometry and start frequencies say."""
    got = bench.captured.get(board.name)
    if board.role == "transmit":
        return not_checked("the transmitter hears only itself")
    if got is None or not got.valid.any():
        return not_checked("no whole frame was captured")
    signal = find_direct(bench.rig, board, got.words, got.valid)
    finding = judge(bench.rig, board, signal)
    if signal.found:
        bench.signals[board.name] = signal
    return finding


def better_offset_hz(rig: Instrument, board: Board, if_hz: float) -> float:
    """The `start_offset_hz` that moves a direct path at this true IF to the middle of the band."""
    return board.start_offset_hz + sum(band_hz(rig)) / 2 - if_hz


def judge(rig: Instrument, board: Board, signal: DirectSignal) -> Finding:
    """What is to be said of a board's direct path."""
    low, high = band_hz(rig)
    expected, spread = signal.expected_hz, jitter_hz(rig)
    predicted = f"{expected / 1e3:.0f} kHz by the rig file"
    facts = {"expected_hz": expected, "band_hz": [low, high], "chirps": signal.chirps, "heard": signal.if_hz.size}
    remedy = f"start_offset_hz = {better_offset_hz(rig, board, expected):.0f} for {board.name}"
    outside = not low <= expected <= high
    if not signal.found:
        return error(
            f"no direct path in {signal.chirps - signal.if_hz.size} of {signal.chirps} chirps; expected at {predicted}",
            "its IF lies outside the receiver's band, so it is filtered away or aliased"
            if outside
            else "the transmitter is off or not armed, something stands between the boards, or the start frequencies"
            " differ by more than the rig file says",
            remedy
            if outside
            else "free the line of sight from TX to RX, check that the transmitting board is armed too, and the start"
            " frequencies of both",
            **facts,
        )
    if_hz = unwrapped(signal.if_hz, rig)
    middle, std = float(np.median(if_hz)), float(if_hz.std())
    told = f"at {middle / 1e3:.0f} kHz, std {std / 1e3:.0f} kHz, {signal.if_hz.size} of {signal.chirps} chirps"
    facts |= {"if_hz": middle, "std_hz": std, "amplitude": float(np.sqrt(np.median(signal.power)))}
    if outside:
        return error(
            f"{told}; {predicted} is outside {low / 1e3:.0f}..{high / 1e3:.0f} kHz",
            "what is seen is an alias: the anti-aliasing filter weakens it, and the high-pass filter is undone wrongly",
            remedy,
            **facts,
        )
    offset = better_offset_hz(rig, board, middle)
    if middle - spread < low or middle + spread > high or signal.if_hz.size < HEARD * signal.chirps:
        return error(
            f"{told}: too near the edge of {low / 1e3:.0f}..{high / 1e3:.0f} kHz",
            f"the start frequencies put it there; 5 ns of trigger are {spread / 1e3:.0f} kHz, so some chirps are lost",
            f"start_offset_hz = {offset:.0f} for {board.name}",
            **facts,
        )
    apart = -signal.start_delay_s(rig)[0]  # what the crystals explain is taken off
    if abs(apart) > APART_S:
        return warning(
            f"{told}; {predicted}, {apart * 1e9:+.1f} ns away",
            "start_offset_hz in the rig file is not what the board was programmed with, the geometry is wrong, or the"
            " board is triggered at another time than the transmitter",
            "if the board was programmed so: start_offset_hz ="
            f" {board.start_offset_hz + apart * rig.chirp.slope_hz_per_s:.0f} for {board.name}",
            **facts,
        )
    return ok(f"{told}; {predicted}", **facts)


def check_level(bench: Bench, board: Board) -> Finding:
    """Chirps with a sample at full scale are useless to synchronisation; a level of a few counts drowns in steps."""
    got = bench.captured.get(board.name)
    if got is None or not got.valid.any():
        return not_checked("no whole frame was captured")
    words = got.words[got.valid]
    high = (words >= FULL_SCALE) | (words <= -FULL_SCALE)
    clipped = int(high.any(axis=(1, 2, 3)).sum())
    rms = np.sqrt(np.mean(words.astype(np.float64) ** 2, axis=(0, 1, 2)) * 2)  # I and Q together, of each RX
    peak = int(np.abs(words.astype(np.int32)).max())
    told = f"rms {rms.min():.0f}..{rms.max():.0f} counts over the RX, peak {peak} of {FULL_SCALE}"
    facts = {"clipped_chirps": clipped, "chirps": len(words), "rms": [round(float(r), 1) for r in rms], "peak": peak}
    if clipped:
        told += f"; {clipped} of {len(words)} chirps are clipped"
        found = error if clipped > CLIPPED * len(words) else warning
        return found(
            told,
            "something reflects straight into the receiver, or its gain is too high",
            "lower the RX gain (radar.rx_gain_db, or the profile in mmWave Studio), or move the reflector away",
            **facts,
        )
    if rms.min() < WEAK:
        return error(
            told,
            "an RX is off, or the radar sends zeros",
            "check the RX mask of the profile; `polysight card reset --radar`, and arm it again",
            **facts,
        )
    return ok(told, **facts)


def check_skew(bench: Bench) -> Finding:
    """Both receivers start together; the transmitter's start is known as well as the start frequencies are."""
    if any(b.name not in bench.signals for b in bench.rig.receivers):
        return not_checked("the direct path of both receivers is needed")
    return judge_skew(bench.rig, bench.signals)


def judge_skew(rig: Instrument, signals: dict[str, DirectSignal]) -> Finding:
    """What is to be said of two receivers' direct paths."""
    h, v = rig.receivers
    later = {b.name: signals[b.name].start_delay_s(rig) for b in (h, v)}
    skew = later[v.name][0] - later[h.name][0]
    unsure = float(np.hypot(later[h.name][1], later[v.name][1]))
    jitter = max(float(unwrapped(signals[b.name].if_hz, rig).std()) for b in (h, v)) / rig.chirp.slope_hz_per_s
    ppm = {b.name: signals[b.name].crystal_ppm(rig) for b in (h, v)}
    told = f"{v.name} starts {skew * 1e9:+.2f} +- {unsure * 1e9:.2f} ns after {h.name}; " + ", ".join(
        f"{name} {mean * 1e9:+.1f} ns after the transmitter, crystal {ppm[name]:+.2f} ppm"
        for name, (mean, _) in later.items()
    )
    facts = {
        "skew_ns": skew * 1e9,
        "standard_error_ns": unsure * 1e9,
        "jitter_ns": jitter * 1e9,
        "later_ns": {name: mean * 1e9 for name, (mean, _) in later.items()},
        "crystal_ppm": ppm,
    }
    lines = "several GPIO lines, written one after another" if len(rig.pi.sync_out) > 1 else "cables of unequal length"
    why = f"{lines}, a slow edge, or start_offset_hz that one board does not have"
    remedy = "one line and a clock buffer (docs/how-to/wiring.md); compare SYNC_IN at the boards with an oscilloscope"
    if abs(skew) > TOO_MUCH_S:
        return error(told, why, remedy, **facts)
    if abs(skew) > MUCH_S:
        return warning(told, why, remedy, **facts)
    if jitter > JITTER_S:
        return warning(
            f"{told}; {jitter * 1e9:.1f} ns from chirp to chirp",
            "more than two clocks of 5 ns explain: noise or slow edges on SYNC_IN",
            remedy,
            **facts,
        )
    return ok(told, **facts)
