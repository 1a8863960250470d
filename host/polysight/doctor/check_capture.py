"""Checks of the capture side: capture cards, network, SYNC_IN pulses, radars, level, direct path, trigger skew.

The checks from `check_pulses` on use a few bursts captured at rest. Armed radars transmit during these pulses, for some
tens of milliseconds.
"""

from __future__ import annotations

import msgspec
import numpy as np

from polysight.acquisition import RefusedError
from polysight.calibration import FULL_SCALE, DirectSignal, band_hz, find_direct, jitter_hz, unwrapped
from polysight.capture import RowCapture, route_interface, silent_radar
from polysight.doctor.context import CheckContext, capture_frames, error, not_checked, ok, warning, with_boards
from polysight.doctor.machine import NetworkInterface, read_interface
from polysight.radar import RadarState
from polysight_shared.config import Board, Instrument
from polysight_shared.faults import PiFault, explain
from polysight_shared.findings import Finding
from polysight_shared.messages import MAX_PULSES_AT_REST, MAX_PULSES_AT_REST_S

_CARD_HOPS = ("host", "route", "link", "card")  # of the network survey
_MIN_MTU = 1500
_MIN_SPEED_MBIT = 1000
_MIN_RING = 512
_MAX_CLIPPED = 0.01  # of the chirps
_MIN_RMS = 4.0  # counts
_MIN_DETECTED = 0.9  # of the chirps, for the direct path
_MAX_DELAY_S = 10e-9  # 5 ns trigger clock and some ppm of the crystals
_SKEW_WARNING_S = 10e-9
_SKEW_ERROR_S = 20e-9
_MAX_JITTER_S = 4e-9  # two trigger clocks of 5 ns give a standard deviation of 2 ns


def check_card(context: CheckContext, board: Board) -> Finding:
    """Check that the card replies; otherwise report the first hop that does not."""
    survey = context.surveys[board.name]
    for hop in survey.hops:
        if hop.where in _CARD_HOPS and hop.level == "error":
            return hop
    return ok(
        f"{board.card_address}:{board.command_port} answers, FPGA {survey.version}; data to"
        f" {board.host_address}:{board.data_port}",
        fpga=survey.version,
    )


def check_network(context: CheckContext, board: Board) -> Finding:
    """Check the network interface to the card: MTU, speed, receive ring, dropped packets. Unknown values pass."""
    if board.card_address.startswith("127."):
        return ok("loopback: no network interface is used")
    name = route_interface(board.card_address, context.system.root)
    if not name:
        return warning(
            f"no interface is in the subnet of {board.card_address}",
            "no interface has an address there, or this system does not list its routes",
            f"`ip address add {board.host_address}/24 dev <interface>`",
        )
    interface = read_interface(name, context.system.root)
    return msgspec.structs.replace(_judge_interface(interface), facts=vars(interface))


def _judge_interface(interface: NetworkInterface) -> Finding:
    name = interface.name
    ring = interface.ring
    observed = f"{name}: MTU {interface.mtu or 'unknown'}, {interface.speed_mbit or 'unknown'} Mbit/s"
    observed += f", ring {ring} of {interface.ring_max}" if ring is not None else ""
    if interface.mtu is not None and interface.mtu < _MIN_MTU:
        return warning(observed, f"a card sends frames of {_MIN_MTU} bytes", f"`ip link set {name} mtu {_MIN_MTU}`")
    if interface.speed_mbit is not None and interface.speed_mbit < _MIN_SPEED_MBIT:
        return warning(
            observed,
            "a DCA1000 sends at gigabit speed; a slower link drops packets of every burst",
            "use a cable of category 5e or better and a gigabit port, without a 100 Mbit switch",
        )
    if ring is not None and ring < min(_MIN_RING, interface.ring_max or _MIN_RING):
        return warning(
            observed,
            "few receive descriptors: packets are lost while this machine is busy",
            f"`ethtool -G {name} rx {interface.ring_max}`",
        )
    if interface.lost:
        return warning(
            f"{observed}; {interface.lost} packets dropped since it came up",
            "the interface or the kernel dropped packets before a program received them",
            f"`ethtool -S {name}`: check if the number increases during a scan",
        )
    return ok(observed)


def check_buffer(context: CheckContext, board: Board) -> Finding:
    """Check that the receiving process starts and that the kernel grants its receive buffer."""
    hops = {h.where: h for h in context.surveys[board.name].hops}
    receiver = hops["receiver"]
    buffer = hops["buffer"]
    for level in ("error", "warning"):
        for hop in (buffer, receiver):
            if hop.level == level:
                return hop
    context.usable_cards.add(board.name)
    return ok(f"{buffer.what}; {receiver.what}")


def check_pulses(context: CheckContext) -> Finding:
    """Capture a few bursts; check that the Pi sent every pulse and that none was too long."""
    if not context.options.pulse:
        return not_checked("--no-pulse: no SYNC_IN pulse is sent", "omit --no-pulse; nothing moves")
    if not context.usable_cards:
        return not_checked("no capture card is usable")
    rig = with_boards(context.rig, context.usable_cards)
    burst = context.rig.burst
    burst_s = burst.pulses * burst.period_us * 1e-6
    bursts = min(context.options.bursts, MAX_PULSES_AT_REST // burst.pulses, int(MAX_PULSES_AT_REST_S / burst_s))
    if not bursts:
        return not_checked(
            f"a burst of {burst.pulses} pulses every {burst.period_us:g} us is longer than the Pi sends at rest",
            f"`polysight scan` can use it; the limit here is {MAX_PULSES_AT_REST} pulses or {MAX_PULSES_AT_REST_S:g} s",
        )
    try:
        context.captured, sent = capture_frames(rig, context.pi, bursts)
    except RefusedError as e:
        if e.number != PiFault.BAD_REQUEST:
            raise
        return error(e.what, "the Pi's release does not know this command", "install the same release on both")
    observed = (
        f"{sent.pulses} sent at rest, at most {sent.width_max_ns / 1e3:.2f} us long,"
        f" at most {sent.jitter_ns / 1e3:.2f} us late"
    )
    facts = {k: getattr(sent, k) for k in ("pulses", "width_max_ns", "jitter_ns", "fault")}
    if sent.fault:
        e = explain(sent.fault)
        return error(f"{observed}: {e.what}", e.why, e.remedy, **facts)
    return ok(observed, **facts)


def check_radar(context: CheckContext, board: Board) -> Finding:
    """Check that every pulse gave a frame and that every frame was received complete."""
    captured = context.captured.get(board.name)
    if captured is None:
        return not_checked("nothing was captured")
    frames = len(captured.valid)
    complete = int(captured.valid.sum())
    facts = {"frames_expected": frames, "frames": complete, "bytes": captured.row.bytes}
    facts["packets"] = captured.row.packets
    if captured.radar is not None and captured.radar.state is RadarState.FAULT:
        observed = f"the radar stopped: {captured.radar.detail}"
        return error(observed, "the radar reported a fault", "`polysight radar check BOARD`", **facts)
    text = f"{complete} of {frames} frames, {captured.row.packets} packets"
    return msgspec.structs.replace(_judge_frames(board, captured.row, text), facts=facts)


def _judge_frames(board: Board, row: RowCapture, observed: str) -> Finding:
    if row.packets == 0:
        e = silent_radar(board, row)
        return error(e.what, e.why, e.remedy)
    if row.slipped or (row.bytes < row.expected and not row.gap_bytes):
        return error(
            f"{observed}: {row.reason or 'the record ended early'}",
            "the radar missed pulses: wrong level or width of SYNC_IN, or it was armed for fewer frames",
            "check SYNC_IN at the board with an oscilloscope (0..3.3 V, 25 ns..4 us)",
        )
    if row.lost_before_packets:
        return error(
            f"{observed}; the card reports {row.lost_before_packets.name}",
            "the card dropped data before it was numbered: it sends more slowly than the radar measures",
            "shorten card.packet_delay_us",
        )
    if row.missing:
        return warning(
            f"{observed}; {row.missing_bytes} bytes are missing, {row.kernel_drops} packets dropped by this machine",
            "packets were lost between card and program",
            "check cable, switch and the receive buffer above; a scan retakes such rows",
        )
    if row.strangers:
        return warning(
            f"{observed}; {row.strangers} packets from other addresses",
            "two cards have the same data port",
            "give each card its own port with `polysight card program`",
        )
    return ok(observed)


def check_level(context: CheckContext, board: Board) -> Finding:
    """Check for clipped chirps, which cannot be synchronised, and for an RX without a signal."""
    captured = context.captured.get(board.name)
    if captured is None or not captured.valid.any():
        return not_checked("no complete frame was captured")
    words = captured.words[captured.valid]
    clipped = int(((words >= FULL_SCALE) | (words <= -FULL_SCALE)).any(axis=(1, 2, 3)).sum())
    rms = np.sqrt(np.mean(words.astype(np.float64) ** 2, axis=(0, 1, 2)) * 2)  # of I and Q together, for each RX
    peak = int(np.abs(words.astype(np.int32)).max())
    observed = f"rms {rms.min():.0f}..{rms.max():.0f} counts over the RX, peak {peak} of {FULL_SCALE}"
    facts = {"clipped_chirps": clipped, "chirps": len(words), "rms": [round(float(r), 1) for r in rms], "peak": peak}
    if clipped:
        fault = error if clipped > _MAX_CLIPPED * len(words) else warning
        return fault(
            f"{observed}; {clipped} of {len(words)} chirps are clipped",
            "a strong reflection reaches the receiver, or its gain is too high",
            "lower the RX gain (radar.rx_gain_db, or the profile in mmWave Studio), or move the reflector away",
            **facts,
        )
    if rms.min() < _MIN_RMS:
        remedy = "check the RX mask of the profile; `polysight card reset --radar`, and arm it again"
        return error(observed, "an RX is off, or the radar sends zeros", remedy, **facts)
    return ok(observed, **facts)


def check_direct_path(context: CheckContext, board: Board) -> Finding:
    """Check that the direct path is detected, lies within the band, and at the IF that the rig file predicts."""
    captured = context.captured.get(board.name)
    if board.role == "transmit":
        return not_checked("the transmitter has no direct path to itself")
    if captured is None or not captured.valid.any():
        return not_checked("no complete frame was captured")
    signal = find_direct(context.rig, board, captured.words, captured.valid)
    if signal.found:
        context.signals[board.name] = signal
    return judge_direct_path(context.rig, board, signal)


def judge_direct_path(rig: Instrument, board: Board, signal: DirectSignal) -> Finding:
    """Judge a board's direct path."""
    low, high = band_hz(rig)
    expected = signal.expected_hz
    outside = not low <= expected <= high
    predicted = f"{expected / 1e3:.0f} kHz expected from the rig file"
    facts = {"expected_hz": expected, "band_hz": [low, high], "chirps": signal.chirps, "heard": signal.if_hz.size}
    if not signal.found:
        missed = signal.chirps - signal.if_hz.size
        observed = f"no direct path in {missed} of {signal.chirps} chirps; {predicted}"
        if outside:
            why = "its IF is outside the receiver's band, so it is filtered out or aliased"
            return error(observed, why, _better_start(rig, board, expected), **facts)
        return error(
            observed,
            "the transmitter is off or not armed, something stands between the boards, or the start frequencies"
            " differ by more than in the rig file",
            "clear the line of sight from TX to RX; check that the transmitting board is armed, and the start"
            " frequencies of both boards",
            **facts,
        )
    if_hz = unwrapped(signal.if_hz, rig)
    spread = jitter_hz(rig)
    median = float(np.median(if_hz))
    std = float(if_hz.std())
    observed = f"at {median / 1e3:.0f} kHz, std {std / 1e3:.0f} kHz, {signal.if_hz.size} of {signal.chirps} chirps"
    facts |= {"if_hz": median, "std_hz": std, "amplitude": float(np.sqrt(np.median(signal.power)))}
    if outside:
        return error(
            f"{observed}; {predicted}, outside {low / 1e3:.0f}..{high / 1e3:.0f} kHz",
            "this is an alias: the anti-aliasing filter attenuates it, and the high-pass filter is inverted at the"
            " wrong frequency",
            _better_start(rig, board, expected),
            **facts,
        )
    if median - spread < low or median + spread > high or signal.if_hz.size < _MIN_DETECTED * signal.chirps:
        return error(
            f"{observed}: too near the edge of {low / 1e3:.0f}..{high / 1e3:.0f} kHz",
            f"5 ns of trigger jitter move it by {spread / 1e3:.0f} kHz, so that some chirps are lost",
            _better_start(rig, board, median),
            **facts,
        )
    delay_s = -signal.start_delay_s(rig)[0]  # without the crystals' share
    if abs(delay_s) > _MAX_DELAY_S:
        start = board.start_offset_hz + delay_s * rig.chirp.slope_hz_per_s
        return warning(
            f"{observed}; {predicted}, {delay_s * 1e9:+.1f} ns away",
            "start_offset_hz in the rig file is not the programmed one, the geometry is wrong, or the board is"
            " triggered at another time than the transmitter",
            f"if the board was programmed so: start_offset_hz = {start:.0f} for {board.name}",
            **facts,
        )
    return ok(f"{observed}; {predicted}", **facts)


def _better_start(rig: Instrument, board: Board, if_hz: float) -> str:
    """Remedy: the start offset that moves a direct path with this true IF to the middle of the band."""
    return f"start_offset_hz = {board.start_offset_hz + sum(band_hz(rig)) / 2 - if_hz:.0f} for {board.name}"


def check_skew(context: CheckContext) -> Finding:
    """Check that both receivers start their chirps at the same time."""
    if any(b.name not in context.signals for b in context.rig.receivers):
        return not_checked("the direct path of a receiver is missing")
    return judge_skew(context.rig, context.signals)


def judge_skew(rig: Instrument, signals: dict[str, DirectSignal]) -> Finding:
    """Judge the receivers' start times. Relative to the transmitter they are as exact as the start frequencies."""
    h, v = rig.receivers
    delay = {b.name: signals[b.name].start_delay_s(rig) for b in (h, v)}  # mean and standard error, s
    skew = delay[v.name][0] - delay[h.name][0]
    uncertainty = float(np.hypot(delay[h.name][1], delay[v.name][1]))
    jitter = max(float(unwrapped(signals[b.name].if_hz, rig).std()) for b in (h, v)) / rig.chirp.slope_hz_per_s
    ppm = {b.name: signals[b.name].crystal_ppm(rig) for b in (h, v)}
    observed = f"{v.name} starts {skew * 1e9:+.2f} +- {uncertainty * 1e9:.2f} ns after {h.name}; " + ", ".join(
        f"{name} {mean * 1e9:+.1f} ns after the transmitter, crystal {ppm[name]:+.2f} ppm"
        for name, (mean, _) in delay.items()
    )
    facts = {
        "skew_ns": skew * 1e9,
        "standard_error_ns": uncertainty * 1e9,
        "jitter_ns": jitter * 1e9,
        "later_ns": {name: mean * 1e9 for name, (mean, _) in delay.items()},
        "crystal_ppm": ppm,
    }
    wiring = (
        "several GPIO lines, switched one after another" if len(rig.pi.sync_out) > 1 else "cables of unequal length"
    )
    why = f"{wiring}, a slow edge, or a start_offset_hz that differs from the programmed one"
    remedy = (
        "use one line and a clock buffer (docs/how-to/wiring.md); compare SYNC_IN at the boards with an oscilloscope"
    )
    if abs(skew) > _SKEW_WARNING_S:
        return (error if abs(skew) > _SKEW_ERROR_S else warning)(observed, why, remedy, **facts)
    if jitter > _MAX_JITTER_S:
        return warning(
            f"{observed}; {jitter * 1e9:.1f} ns from chirp to chirp",
            "more jitter than two clocks of 5 ns cause: noise or slow edges on SYNC_IN",
            remedy,
            **facts,
        )
    return ok(observed, **facts)
