"""Checks of the rig, from its rig file to the trigger skew. A check is a function of a `CheckContext`.

Checks of host, Pi and stage come first: rig file, clocks, keys, calibration, library, receivers, disk, trigger line.
The trigger line is checked with a short row in which every point must give an edge. Only this check moves the stage,
and only with `--move`. Then come those of the capture: capture cards, network, SYNC_IN pulses, radars, level, direct
path, trigger skew; the last three are in `signal_checks.py`. `check_pulses` captures a few bursts at rest, in which
armed radars transmit for tens of ms; the checks after it use these bursts.
"""

from __future__ import annotations

import os
import shutil
import time
from datetime import UTC, datetime
from pathlib import Path

import msgspec

from polysight.acquisition import RefusedError, StopRequest, list_stage_differences, make_begin_run, make_ready
from polysight.calibration import load_checked_calibration
from polysight.capture import PACKET_TIME_US, PRIORITY_REMEDY, RowCapture, explain_silent_radar, route_interface
from polysight.doctor.context import (
    CheckContext,
    NetworkInterface,
    capture_frames,
    card_rates,
    error,
    not_checked,
    ok,
    read_interface,
    select_boards,
    warning,
)
from polysight.materials import SIMULATED_LIBRARY, Library
from polysight.planning import scan_time
from polysight.process import explain_unnamed
from polysight.radar import RadarState, check_constraints
from polysight.settings import DEFAULT
from polysight.store import make_scan_id
from polysight_shared import __version__
from polysight_shared.config import Board, load_instrument
from polysight_shared.errors import ConfigError, DeviceError
from polysight_shared.faults import PiFault, explain
from polysight_shared.findings import LEVELS, Finding
from polysight_shared.geometry import incidence_deg
from polysight_shared.messages import MAX_PULSES_AT_REST, MAX_PULSES_AT_REST_S, RowFinished, is_simulated
from polysight_shared.raster import RasterPlan, check_burst_fits
from polysight_shared.sockets import HOST_KEYS, is_loopback

# Least speed of the disk relative to the data rate of a scan; chosen.
_SPEED_MARGIN = 2.0
# Difference of the clocks of host and Pi above which there is a warning; chosen.
_MAX_CLOCK_OFFSET_S = 1.0
# Difference of the clocks above which there is an error, because one of them is not set; chosen. It is also an error if
# the host's clock is earlier than this program's files by more than this.
_CLOCK_LOST_S = 60.0
_CLOCK_REMEDY = "`timedatectl set-ntp true`, or set it by hand; a Pi has no battery for its clock"
# Hops of the network survey that concern a card.
_CARD_HOPS = ("host", "route", "link", "card")
# Least MTU of the interface to a card: as large as a card's packets.
_MIN_MTU = 1500
# Least speed of the interface to a card.
_MIN_SPEED_MBIT = 1000
# Least number of receive descriptors of the interface to a card; chosen.
_MIN_RING = 512


def check_config(context: CheckContext) -> Finding:
    """Load the rig file; check that a burst fits between two points, and the settings of natively controlled radars."""
    options = context.options
    rig = load_instrument(options.config)
    check_burst_fits(rig.grid, rig.burst, rig.stage)
    if rig.radar.control == "native":
        check_constraints(rig, rig.grid.columns * rig.burst.pulses)
    context.loaded_rig = rig
    boards = ", ".join(b.name for b in rig.recorded)
    return ok(
        f"{options.config}: {rig.name}, {rig.grid.columns} x {rig.grid.rows} positions, records {boards},"
        f" radar control {rig.radar.control!r}"
    )


def check_host_clock(context: CheckContext) -> Finding:
    """Check that the clock is later than this program's files, and synchronised."""
    now_s = context.system.wall_ns() * 1e-9
    observed = f"{datetime.fromtimestamp(now_s, UTC):%Y-%m-%d %H:%M:%S} UTC"
    if now_s < Path(__file__).stat().st_mtime - _CLOCK_LOST_S:
        return error(f"{observed}: earlier than this program's installation", "the clock lost its time", _CLOCK_REMEDY)
    if context.system.clock_is_synchronised() is False:
        return warning(f"{observed}, not synchronised", "no time server is reachable", _CLOCK_REMEDY)
    return ok(observed)


def check_pi_clock(context: CheckContext) -> Finding:
    """Compare the clocks of Pi and host; the uncertainty is half the duration of the request."""
    if context.hello is None or context.hello.t_unix_ns == 0:
        return not_checked("the Pi does not report its time", "install the same release on both")
    offset_s = (context.hello.t_unix_ns - context.hello_at_ns) * 1e-9
    uncertainty_s = context.hello_took_ns * 0.5e-9
    observed = f"the Pi's clock minus this machine's: {offset_s:+z.3f} s (+- {uncertainty_s:.3f} s)"
    facts = {"offset_s": offset_s, "uncertainty_s": uncertainty_s}
    if abs(offset_s) - uncertainty_s > _CLOCK_LOST_S:
        return error(observed, "one clock is wrong: times in logs and scans cannot be compared", _CLOCK_REMEDY, **facts)
    if abs(offset_s) - uncertainty_s > _MAX_CLOCK_OFFSET_S:
        return warning(observed, "one of the two clocks is not synchronised", _CLOCK_REMEDY, **facts)
    return ok(observed, **facts)


def check_calibration(context: CheckContext) -> Finding:
    """Check the calibration files that a scan would copy into its folder."""
    simulated = context.hello is not None and is_simulated(context.hello.backend)
    facts = load_checked_calibration(context.rig, simulated).list_sources()
    if not facts:
        return ok("no calibration file is configured: geometry, filters and metal as in the rig file and the scene")
    observed = "; ".join(f"{kind} of {file.made_utc[:10]}" for kind, file in facts.items())
    return ok(observed, **{kind: msgspec.to_builtins(file) for kind, file in facts.items()})


def check_library(context: CheckContext) -> Finding:
    """Compare the rig's incidence angle with those of the default library; without a match no material is named."""
    angle = incidence_deg(context.rig, context.rig.receivers[0])
    angles = Library.load(SIMULATED_LIBRARY).angles_deg
    library_angles = " and ".join(f"{a:g}" for a in angles)
    facts = {"incidence_deg": angle, "library_deg": list(angles)}
    observed = f"incidence angle of the rig {angle:.1f} degrees, of {SIMULATED_LIBRARY.name} {library_angles} degrees"
    if not explain_unnamed(DEFAULT, context.rig):
        return ok(observed, **facts)
    return warning(
        observed,
        "|P| changes by about 10 % per degree, so no material of this rig's scans will be named",
        "train a library at this angle (docs/how-to/add-a-material.md) and scan with --library; or --model none",
        **facts,
    )


def check_receivers(context: CheckContext) -> Finding:
    """Measure the receivers' packet loss under load; loss at a rate that this rig's cards reach is a warning."""
    rates = card_rates(context.rig)
    results, scheduling = context.system.measure_receivers(context.rig, rates)
    losses = []
    for result in results:
        loss = "no loss"
        if result.lost:
            loss = f"{100 * result.lost / result.sent:.1f} % lost"
        losses.append(f"{result.mbit_s:.0f} Mbit/s a card: {loss}")
    observed = f"receivers ({scheduling}) with all cores busy: {'; '.join(losses)}"
    facts = {"held": [vars(result) for result in results], "scheduling": scheduling}
    # The rate of this rig's cards is one of the ascending `rates`; losses at higher rates are only for information.
    card_rate = 1e6 / (context.rig.card.packet_delay_us + PACKET_TIME_US)
    rates_of_cards = results[: rates.index(card_rate) + 1]
    if any(result.lost for result in rates_of_cards):
        remedy = PRIORITY_REMEDY
        if "real-time" in scheduling:
            remedy = "use a faster machine"
        return warning(observed, "other programs take processor time from the receivers", remedy, **facts)
    return ok(observed, **facts)


def check_disk(context: CheckContext) -> Finding:
    """Check for free space for a scan and the reserve, and for a disk twice as fast as the scan's data."""
    rig = context.rig
    folder = _find_existing_parent(context.options.out)
    need = rig.scan_bytes
    reserve = rig.limits.free_disk_bytes
    free_bytes = shutil.disk_usage(folder).free
    observed = (
        f"{folder}: {free_bytes / 1e9:.1f} GB free, a scan needs {need / 1e9:.2f} GB and {reserve / 1e9:.1f} GB reserve"
    )
    facts: dict[str, float] = {"free_bytes": free_bytes, "need_bytes": need}
    if free_bytes < need + reserve:
        return error(observed, "the disk is too full for a scan", "free space, or give another --out", **facts)
    speed = context.system.write_speed(folder)
    rate = need / scan_time(rig).total_s
    observed += f"; durable write speed {speed / 1e6:.0f} MB/s, data rate of a scan {rate / 1e6:.2f} MB/s"
    facts |= {"write_bytes_s": speed, "scan_bytes_s": rate}
    if speed < rate:
        return error(observed, "the disk is too slow: a network share or a worn card", "scan to a local disk", **facts)
    if speed < _SPEED_MARGIN * rate:
        return warning(observed, "the disk is hardly fast enough", "scan to a faster disk", **facts)
    return ok(observed, **facts)


def _find_existing_parent(folder: Path) -> Path:
    """Return the folder, or the nearest one above it that exists. Raises ConfigError if that is a file."""
    existing = folder.resolve()
    while not existing.exists():
        existing = existing.parent
    if not existing.is_dir():
        raise ConfigError(f"--out {folder}: {existing} is a file", "a scan needs a folder", "give another --out")
    return existing


def check_time(context: CheckContext) -> Finding:
    """Estimate the duration of a scan of the configured grid."""
    rig = context.rig
    seconds = scan_time(rig).total_s
    hours, minutes = divmod(round(seconds / 60), 60)
    duration = f"{seconds / 60:.1f} min"
    if hours:
        duration = f"{hours} h {minutes:02d} min"
    return ok(
        f"a scan of {rig.grid.rows} rows takes about {duration}: {seconds / rig.grid.rows:.1f} s a row,"
        f" {rig.scan_bytes / 1e9:.2f} GB",
        seconds=seconds,
        bytes=rig.scan_bytes,
    )


SIMULATED_NOTE = "simulated wires: no hardware is driven"
# Points of the row that checks the trigger line; chosen.
_POINTS = 8
# Time limit of the row that checks the trigger line; chosen.
_ROW_TIMEOUT_S = 120.0
# Longest wait for an event of the row before the time limit is checked; chosen.
_POLL_MS = 100


def check_keys(context: CheckContext) -> Finding:
    """Check that the CURVE keys are readable, the secret one by this user only; loopback addresses need none."""
    pi = context.rig.pi
    if is_loopback(pi.command_address) and is_loopback(pi.event_address):
        return ok("not needed: both addresses are loopback")
    folder = Path(pi.key_dir)
    if missing := [name for name in HOST_KEYS if not os.access(folder / name, os.R_OK)]:
        return error(
            f"{folder}: {', '.join(missing)} cannot be read",
            "the Pi's keys were not copied here, or belong to another user",
            f"copy the Pi's {' and '.join(HOST_KEYS)} here (docs/how-to/install.md); pi.key_dir is {folder}",
        )
    _, secret_name = HOST_KEYS
    secret = folder / secret_name
    mode = secret.stat().st_mode
    if mode & 0o077:
        return warning(
            f"{secret} can be read by others ({mode & 0o777:o})",
            "every user of this machine could drive the stage",
            f"`chmod 600 {secret}`",
        )
    return ok(f"the keys are in {folder}")


def check_pi(context: CheckContext) -> Finding:
    """Check that the Pi answers, has this release, and the same stage settings."""
    sent_ns = context.system.wall_ns()
    hello = context.pi.hello()
    answered_ns = context.system.wall_ns()
    context.hello = hello
    context.hello_at_ns = (sent_ns + answered_ns) // 2
    context.hello_took_ns = answered_ns - sent_ns
    backend = f"GPIO backend {hello.backend}"
    if is_simulated(hello.backend):
        backend = SIMULATED_NOTE
    observed = f"{context.rig.pi.command_address} answers: release {hello.pi_release}, {backend}, state {hello.state}"
    facts = {"release": hello.pi_release, "backend": hello.backend, "state": hello.state}
    if hello.pi_release != __version__:
        return error(
            observed,
            f"this host has release {__version__}",
            "install the same release on both: `make pi-install HOST=...`",
            **facts,
        )
    if differing := list_stage_differences(context.rig.stage, hello):
        return error(
            f"{observed}; {'; '.join(differing)}",
            "host and Pi have different rig files, so the Pi would refuse a scan",
            "copy the right [stage] to the other machine, `sudo systemctl restart polysight-pi`",
            **facts,
        )
    return ok(observed, **facts)


def check_free(context: CheckContext) -> Finding:
    """Check that no scan is running; the doctor must not use its cards."""
    hello = context.hello
    if hello is not None and (hello.in_run or hello.state in ("ready", "running", "held", "done")):
        return error(
            f"scan {hello.scan_id} is in progress, state {hello.state}",
            "a scan is running, or the program that started it was terminated",
            "wait for its end, or continue it with `polysight resume`; a restart of polysight-pi discards it",
        )
    return ok("no scan is in progress")


def check_trigger(context: CheckContext) -> Finding:
    """Run a short row at the scan's speed, after homing if necessary; compare points, trigger edges and pulses."""
    if not context.options.move:
        return not_checked(
            "only a moving stage gives trigger edges",
            f"`polysight doctor --move` homes it and runs {_POINTS} points: keep clear of the stage",
        )
    # A scan may have started since `check_free`, and `begin_run` would end that scan.
    context.hello = context.pi.hello()
    if (busy := check_free(context)).level == "error":
        return busy
    row = _run_row(context)
    facts = {"points": row.points, "edges": row.edges, "pulses": row.pulses, "fault": row.fault}
    observed = f"{row.points} points passed, {row.edges} edges detected, {row.pulses} pulses sent"
    expected = _POINTS * context.rig.burst.pulses
    if row.points and not row.edges:
        return error(
            observed,
            "the trigger line is stuck: no edge reaches the Pi",
            f"check the wire and its ground from the stage's trigger pin to GPIO {context.rig.pi.trigger_in}, the level"
            " shifter, and pi.trigger_in; with the Pi's service stopped, `polysight-pi check` there reports which"
            " program uses the line",
            **facts,
        )
    if row.status != "done" or row.edges != _POINTS or row.pulses != expected:
        explanation = explain(row.fault)
        return error(
            f"{observed}, {_POINTS} and {expected} expected: {row.reason or explanation.problem}",
            explanation.cause,
            explanation.remedy,
            **facts,
        )
    if row.fault or row.reason:
        return warning(f"{observed}; {row.reason}", "", "watch the stage during a row", **facts)
    return ok(observed, **facts)


def _run_row(context: CheckContext) -> RowFinished:
    """Run one row of `_POINTS` points as a separate run, and return the event that ends the row."""
    rig = context.rig
    pi = context.pi
    plan = RasterPlan(_POINTS, 1, rig.grid.step_x_mm, rig.grid.step_y_mm)
    scan_id = f"doctor-{make_scan_id()}"
    pi.follow(scan_id, last_seq=0, on_event=lambda _event: None)
    pi.begin_run(make_begin_run(rig, scan_id, plan))
    try:
        make_ready(pi, StopRequest(), lambda _phase, _message: None)
        pi.run_row(scan_id, row_index=0, take=1)
        return _wait_for_row_end(context)
    finally:
        pi.come_to_rest("end of polysight doctor")
        pi.end_run(scan_id, "success", "polysight doctor --move")


def _wait_for_row_end(context: CheckContext) -> RowFinished:
    """Wait for the event that ends the row. Raises DeviceError after `_ROW_TIMEOUT_S`."""
    deadline = time.monotonic() + _ROW_TIMEOUT_S
    while time.monotonic() < deadline:
        context.pi.event_socket.poll(_POLL_MS)
        for event in context.pi.events():
            if isinstance(event, RowFinished):
                return event
    raise DeviceError(
        f"timeout: a row of {_POINTS} points did not end within {_ROW_TIMEOUT_S:.0f} s",
        "the stage does not move",
        "look at the stage",
    )


def check_stage(context: CheckContext) -> Finding:
    """Check that the stage has no fault and that its sketch, the firmware, is of this release."""
    status = context.pi.status()
    if status.fault and status.state == "fault":
        explanation = explain(status.fault)
        return error(
            f"fault {status.fault}: {explanation.problem}; {status.reason}",
            explanation.cause,
            f"{explanation.remedy}; on the Pi, with its service stopped, run `polysight-pi check` for port and board",
            fault=status.fault,
        )
    firmware = "" if context.hello is None else context.hello.firmware
    position = "not homed yet"
    if status.homed:
        position = f"at {status.x_mm:.1f}, {status.y_mm:.1f} mm"
    observed = f"answers, sketch {firmware or 'unknown'}, {position}"
    facts = {"firmware": firmware, "homed": status.homed}
    if firmware != __version__:
        return error(
            observed,
            f"this release needs sketch {__version__}; the board was flashed with another",
            "`make flash PORT=/dev/ttyACM0` with the board on this machine",
            **facts,
        )
    if status.fault:
        explanation = explain(status.fault)
        return warning(
            f"{observed}; its last row ended with fault {status.fault}: {explanation.problem}",
            explanation.cause,
            explanation.remedy,
            **facts,
        )
    return ok(observed, **facts)


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
    """Judge the settings of a network interface; the first fault is the finding."""
    name = interface.name
    ring = interface.ring
    observed = f"{name}: MTU {interface.mtu or 'unknown'}, {interface.speed_mbit or 'unknown'} Mbit/s"
    if ring is not None:
        observed += f", ring {ring} of {interface.ring_max}"
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
    """Check that the receiving process starts and gets its receive buffer; without an error, the card is usable."""
    hops = {h.where: h for h in context.surveys[board.name].hops}
    receiver = hops["receiver"]
    buffer = hops["buffer"]
    worst_finding = max((buffer, receiver), key=lambda hop: LEVELS.index(hop.level))
    if worst_finding.level != "error":
        context.usable_cards.add(board.name)
    if worst_finding.level in ("error", "warning"):
        return worst_finding
    return ok(f"{buffer.what}; {receiver.what}")


def check_pulses(context: CheckContext) -> Finding:
    """Capture a few bursts; check that the Pi reports no fault of their pulses (seen: counted at the connector)."""
    if not context.options.pulse:
        return not_checked("--no-pulse: no SYNC_IN pulse is sent", "omit --no-pulse; nothing moves")
    if not context.usable_cards:
        return not_checked("no capture card is usable")
    rig = select_boards(context.rig, context.usable_cards)
    burst = context.rig.burst
    burst_s = burst.pulses * burst.period_us * 1e-6
    bursts = min(context.options.bursts, MAX_PULSES_AT_REST // burst.pulses, int(MAX_PULSES_AT_REST_S / burst_s))
    if not bursts:
        return not_checked(
            f"a burst of {burst.pulses} pulses every {burst.period_us:g} us is longer than the Pi sends at rest",
            f"`polysight scan` can use it; the limit here is {MAX_PULSES_AT_REST} pulses or {MAX_PULSES_AT_REST_S:g} s",
        )
    try:
        context.captured, sent_pulses = capture_frames(rig, context.pi, bursts)
    except RefusedError as explanation:
        if explanation.number != PiFault.BAD_REQUEST:
            raise
        return error(
            explanation.what, "the Pi's release does not know this command", "install the same release on both"
        )
    counted = "seen" if sent_pulses.pulses_seen else "sent, not seen,"
    observed = (
        f"{sent_pulses.pulses} {counted} at rest, at most {sent_pulses.width_max_ns / 1e3:.2f} us long,"
        f" at most {sent_pulses.jitter_ns / 1e3:.2f} us late"
    )
    facts = {k: getattr(sent_pulses, k) for k in ("pulses", "pulses_seen", "width_max_ns", "jitter_ns", "fault")}
    if sent_pulses.fault:
        explanation = explain(sent_pulses.fault)
        return error(f"{observed}: {explanation.problem}", explanation.cause, explanation.remedy, **facts)
    return ok(f"{observed} ({context.rig.pi.pulse_source})", **facts)


def check_radar(context: CheckContext, board: Board) -> Finding:
    """Check that every pulse gave a frame and that every frame was received complete."""
    captured = context.captured.get(board.name)
    if captured is None:
        return not_checked("nothing was captured")
    is_complete = captured.valid.reshape(-1, context.rig.burst.chirps).all(axis=1)
    complete = int(is_complete.sum())
    row = captured.row
    facts = {"frames_expected": is_complete.size, "frames": complete, "bytes": row.bytes, "packets": row.counts.placed}
    if captured.radar is not None and captured.radar.state is RadarState.FAULT:
        observed = f"the radar stopped: {captured.radar.detail}"
        return error(observed, "the radar reported a fault", "`polysight radar check BOARD`", **facts)
    text = f"{complete} of {is_complete.size} frames, {row.counts.placed} packets"
    return msgspec.structs.replace(_judge_frames(board, row, text), facts=facts)


def _judge_frames(board: Board, row: RowCapture, observed: str) -> Finding:
    """Judge if all frames of a row came to this machine; return the first fault that is found.

    `row.slipped` means that only whole frames are missing.
    """
    if row.counts.placed == 0:
        e = explain_silent_radar(board, row)
        return error(e.what, e.why, e.remedy)
    if row.slipped or (row.bytes < row.expected and not row.losses.gap_bytes):
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
