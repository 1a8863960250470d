"""Table of numbered faults: stage errors 1..99, also used by the firmware, and Pi faults from 100.

`python -m polysight_shared.faults` prints the C++ header `arduino_stage/stage_errors.h`.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class Explanation(NamedTuple):
    """Meaning of a number, likely cause, and remedy."""

    problem: str
    cause: str
    remedy: str


class StageError(IntEnum):
    """Numbers of `error:N` and `alarm:N` on the stage line."""

    BAD_CRC = 1
    MALFORMED = 2
    LINE_TOO_LONG = 3
    UNKNOWN_COMMAND = 4
    ARGUMENT_COUNT = 5
    OUT_OF_RANGE = 6
    BUSY = 7
    NOT_HOMED = 8
    SOFT_LIMIT = 9
    IN_ALARM = 10
    HEARTBEAT_LOST = 11
    LIMIT_SWITCH = 12
    HOMING_FAILED = 13
    EMERGENCY_STOP = 14
    STOPPED = 15
    TOO_FAST = 16
    NO_RUN_UP = 17
    SEQUENCE = 18
    DISABLED = 19


class PiFault(IntEnum):
    """Numbers of the Pi's fault events and refusals."""

    STAGE_LOST = 101
    STAGE_ALARM = 102
    EDGE_LOST = 103
    EDGE_DURING_BURST = 104
    PULSE_TOO_LONG = 105
    PERIOD_TOO_SHORT = 106
    TRIGGER_LINE_LOST = 107
    HOST_LOST = 108
    JOURNAL_FULL = 109
    POINTS_MISMATCH = 110
    NOT_READY = 111
    BAD_REQUEST = 112
    ABORTED = 113
    VERSION = 114
    NOT_OWNER = 115
    PROGRAM = 116
    PROGRAM_LATE = 117
    EDGE_TIME = 118
    POSITION = 119
    PULSES_UNSEEN = 120


EXPLANATIONS: dict[int, Explanation] = {
    StageError.BAD_CRC: Explanation(
        "the line's checksum is wrong",
        "noise on the serial line, or a lost byte",
        "retried automatically; check the USB cable if it happens again",
    ),
    StageError.MALFORMED: Explanation(
        "the line does not follow the protocol",
        "another program talks to the stage",
        "close other programs on this port",
    ),
    StageError.LINE_TOO_LONG: Explanation(
        "the line is longer than the stage accepts", "a lost line end", "retried automatically"
    ),
    StageError.UNKNOWN_COMMAND: Explanation(
        "the stage does not know this command",
        "firmware and host are of different versions",
        "flash the sketch of this release",
    ),
    StageError.ARGUMENT_COUNT: Explanation(
        "wrong number of arguments", "firmware and host are of different versions", "flash the sketch of this release"
    ),
    StageError.OUT_OF_RANGE: Explanation(
        "an argument is out of range", "the plan does not fit the stage", "check [grid] and [stage] in instrument.toml"
    ),
    StageError.BUSY: Explanation(
        "the stage is moving", "a command was sent before the last one ended", "wait, or stop the stage first"
    ),
    StageError.NOT_HOMED: Explanation(
        "the stage is not homed", "it was switched on, or stopped abruptly", "polysight-pi home"
    ),
    StageError.SOFT_LIMIT: Explanation(
        "the target is outside the travel",
        "grid, centre or travel are wrong",
        "check [grid] and [stage] in instrument.toml",
    ),
    StageError.IN_ALARM: Explanation(
        "an alarm is latched", "an earlier fault", "remove its cause, then polysight-pi home"
    ),
    StageError.HEARTBEAT_LOST: Explanation(
        "the Pi was silent while the stage moved",
        "the Pi program crashed or got no processor time",
        "look at the Pi's log, then polysight-pi home",
    ),
    StageError.LIMIT_SWITCH: Explanation(
        "a limit switch was hit",
        "lost steps, or a wrong centre",
        "polysight-pi home; homing moves the stage away from the switch",
    ),
    StageError.HOMING_FAILED: Explanation(
        "homing did not find the switch",
        "switch, wiring or direction",
        "check the switch, and the direction (polysight-pi buzz)",
    ),
    StageError.EMERGENCY_STOP: Explanation(
        "the emergency stop is pressed", "somebody pressed it", "release it, then polysight-pi home"
    ),
    StageError.STOPPED: Explanation(
        "the stage was stopped by command", "abort", "polysight-pi home, then resume the scan"
    ),
    StageError.TOO_FAST: Explanation(
        "the speed exceeds the firmware's step rate", "stage.speed_mm_s x steps_per_mm is too high", "lower the speed"
    ),
    StageError.NO_RUN_UP: Explanation(
        "no space to accelerate before the first point",
        "the grid reaches the end of the travel",
        "narrow the grid, or raise accel_mm_s2",
    ),
    StageError.SEQUENCE: Explanation("the sequence number is not the next one", "a line was lost", "send HELLO again"),
    StageError.DISABLED: Explanation(
        "the motors are switched off", "the stage was reset, or has just been switched on", "polysight-pi home"
    ),
    PiFault.STAGE_LOST: Explanation(
        "the stage does not answer",
        "cable unplugged, board reset or wrong port",
        "check the USB cable and stage.port, then polysight-pi home",
    ),
    PiFault.STAGE_ALARM: Explanation(
        "the stage raised an alarm",
        "see the stage error that is shown with this fault",
        "remove its cause, then polysight-pi home",
    ),
    PiFault.EDGE_LOST: Explanation(
        "a trigger edge was lost",
        "the kernel's edge buffer overflowed, or a glitch",
        "the row is retaken; check the load of the Pi",
    ),
    PiFault.EDGE_DURING_BURST: Explanation(
        "the next trigger came before the end of the burst",
        "the stage is too fast for burst x period",
        "lower stage.speed_mm_s or burst.pulses, and make a new scan",
    ),
    PiFault.PULSE_TOO_LONG: Explanation(
        "a SYNC_IN pulse may have been longer than 4 us",
        "the Pi was interrupted inside a pulse",
        'use wiring = "spi", or fit a one-shot after the line; see docs/how-to/wiring.md',
    ),
    PiFault.PERIOD_TOO_SHORT: Explanation(
        "two SYNC_IN pulses came closer than the radar allows",
        "the Pi was late and tried to catch up",
        "the row is retaken; check the load of the Pi",
    ),
    PiFault.TRIGGER_LINE_LOST: Explanation(
        "the trigger line is not available",
        "another program uses the line, or the GPIO chip disappeared",
        "stop polysight-pi on the Pi, run `polysight-pi check` there, then start polysight-pi again",
    ),
    PiFault.HOST_LOST: Explanation(
        "the host sends no heartbeat", "the host's program or the network is down", "polysight resume SCAN on the host"
    ),
    PiFault.JOURNAL_FULL: Explanation(
        "the journal cannot be written", "disk full or read-only", "free space on the Pi"
    ),
    PiFault.POINTS_MISMATCH: Explanation(
        "the numbers of points passed, edges detected and bursts sent differ",
        "a lost or spurious trigger edge",
        "the row is retaken; check the trigger wire",
    ),
    PiFault.NOT_READY: Explanation(
        "the Pi is not ready for this command",
        "see the state in this refusal",
        "home the stage, end the running row, or clear the fault first",
    ),
    PiFault.BAD_REQUEST: Explanation(
        "the request cannot be carried out",
        "host and Pi have different rig files",
        "use the same instrument.toml on both",
    ),
    PiFault.ABORTED: Explanation("the row was aborted", "the host or a signal requested it", "resume the scan"),
    PiFault.VERSION: Explanation(
        "the peer uses another major version of the protocol",
        "host and Pi are of different releases",
        "install the same release on both",
    ),
    PiFault.NOT_OWNER: Explanation(
        "the run belongs to another program",
        "only the program that started the run may send commands",
        "use that program, or `polysight-pi take-over` at the Pi",
    ),
    PiFault.PROGRAM: Explanation(
        "the Pi's program failed to execute this command",
        "a defect of this program, or it hangs",
        "see `journalctl -u polysight-pi` and report it; systemd restarts a program that hangs",
    ),
    PiFault.PROGRAM_LATE: Explanation(
        "a part of the Pi's program does not answer, so motion was stopped",
        "a disk or SD card that hangs, or too many connections",
        "see `dmesg` on the Pi for errors of the card, then retake the row",
    ),
    PiFault.EDGE_TIME: Explanation(
        "a trigger edge came at a wrong time",
        "a lost or spurious edge: noise on the trigger wire, a loose plug",
        "the row is retaken; check the trigger wire and its ground",
    ),
    PiFault.POSITION: Explanation(
        "the stage ended the row at another position than commanded",
        "the sketch lost count, or answered another command",
        "polysight-pi home, then retake the row; flash the sketch of this release",
    ),
    PiFault.PULSES_UNSEEN: Explanation(
        "the pulses seen at the connector differ from those sent",
        "buffer or one-shot without supply, a broken SYNC_IN cable, or the return wire is off",
        "the row is retaken; check the pulse board and the return wire (docs/how-to/wiring.md)",
    ),
}


def explain(number: int) -> Explanation:
    """Return the entry of a number, or a general one if it is unknown."""
    return EXPLANATIONS.get(
        number, Explanation(f"unknown fault {number}", "a newer peer", "install the same release everywhere")
    )


def format_c_header() -> str:
    """Return the stage errors as a C++ header for the firmware."""
    lines = [
        "// Generated by `python -m polysight_shared.faults`; do not edit. The table is polysight_shared/faults.py.",
        "#pragma once",
        "#include <stdint.h>",
        "",
        "enum StageError : uint8_t {",
        "  ERROR_NONE = 0,",
        *(f"  ERROR_{e.name} = {int(e)},  // {EXPLANATIONS[e].problem}" for e in StageError),
        "};",
        "",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    import sys

    sys.stdout.write(format_c_header())
