"""The rules of the state machine: the events of each state, their actions and the next states, and time limits.

machine.py applies them. docs/spec/wire.md, "State machine", has the same tables.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from polysight_shared import messages as m
from polysight_shared.stage_line import HOMING_TIMEOUT_S

# `idle`: not homed. `homed`: at rest outside a run; `ready`: at rest in a run. `held`: a row that slows down or rests
# on request. `stopping`: STOP was sent and the stage slows down. `done`: the stage has reached the row's end, and the
# last burst is still awaited. `ending`: the stage rests, and bursts in the queue are still to be journalled.
State = Literal["idle", "homing", "jogging", "homed", "ready", "running", "held", "stopping", "done", "ending", "fault"]


class Rule(NamedTuple):
    """Action and next state of an event in the listed states. Names of states are separated by spaces."""

    # Name of a command, or of what has happened to stage, lines, host or time.
    event: str
    # States in which the rule applies.
    states: str
    # The possible next states, the default first; the action may return one of the others. "same": no change.
    leads_to: str
    # Method of `Machine` that is called, without its leading underscore.
    action: str = "do_nothing"


# A pair of event and state has at most one rule.
RULES = (
    # Commands; refused in all other states.
    Rule("Home", "idle homed ready fault", "homing", "home"),
    Rule("Home", "homing", "same"),
    Rule("Jog", "homed ready", "jogging", "jog"),
    Rule("BeginRun", "homed", "ready", "begin_run"),
    Rule("BeginRun", "idle homing jogging ready fault", "same", "begin_run"),
    Rule("EndRun", "ready", "homed", "end_run"),
    Rule("EndRun", "idle homing jogging homed fault", "same", "end_run"),
    Rule("RunRow", "ready", "running", "start_row"),
    Rule("Hold", "running", "held", "hold"),
    Rule("Hold", "held", "same"),
    Rule("Resume", "held", "running", "resume"),
    Rule("Resume", "running", "same"),
    Rule("Abort", "running held", "stopping ending", "abort"),
    Rule("Abort", "done", "ending", "abort"),
    Rule("Abort", "homing", "same", "stop"),
    Rule("Abort", "jogging", "same", "abort_jog"),
    Rule("Abort", "idle homed ready stopping ending fault", "same"),
    # Only permitted here: the executor passes the burst to the trigger loop.
    Rule("Pulse", "idle homed fault", "same"),
    # Replies of the stage; ignored in all other states. `homed`, `moved`, `passed`: homing, jog or row came to its end.
    # `stopped`: the alarm that STOP latches. `stage lost`: no link, a reset, or another alarm.
    Rule("homed", "homing", "homed ready fault", "note_homed"),
    Rule("moved", "jogging", "homed ready fault", "note_moved"),
    Rule("passed", "running held", "done ending", "note_passed"),
    Rule("passed", "stopping", "ending", "note_stopped"),
    Rule("stopped", "running held stopping done", "ending", "note_stopped"),
    Rule("stopped", "homing", "idle", "clear_alarm"),
    Rule("stopped", "jogging", "homed ready idle", "note_jog_stopped"),
    Rule("stopped", "idle homed ready ending fault", "same", "clear_alarm"),
    Rule("not homed", "homed ready", "idle", "lose_position"),
    Rule("stage lost", "idle homing jogging homed ready", "fault", "lose_stage"),
    Rule("stage lost", "running held stopping done", "ending", "lose_stage"),
    Rule("stage lost", "ending fault", "same", "lose_stage"),
    # Trigger line, host, journal, time. A `row fault` ends the row or jog, a `lasting fault` leads to `fault`. `all
    # sent`: the row's last burst was sent. `settled`: the bursts in the queue when the row ended are journalled.
    Rule("row fault", "running held", "stopping ending", "fail_row"),
    Rule("row fault", "done", "ending", "fail_row"),
    Rule("row fault", "jogging", "same", "fail_jog"),
    Rule("lasting fault", "idle homing jogging homed ready", "fault", "fail"),
    Rule("lasting fault", "running held", "stopping ending", "fail"),
    Rule("lasting fault", "done", "ending", "fail"),
    Rule("lasting fault", "stopping ending", "same", "fail"),
    Rule("all sent", "done", "ending"),
    Rule("timeout", "homing jogging", "fault", "time_out"),
    Rule("timeout", "running stopping", "ending", "time_out"),
    Rule("timeout", "done", "ending", "disarm"),
    Rule("settled", "ending", "ready idle fault", "finish_row"),
)
# Longest time in a state, seconds; the event `timeout` follows. The limit of `running` is set when a row begins
# (`Machine.row_timeout_s`); the other states have none.
TIMEOUTS_S: dict[State, float] = {
    "homing": HOMING_TIMEOUT_S,
    # The longest jog, and 5 s (chosen) for ramps and a busy machine.
    "jogging": m.MAX_JOG_S + 5.0,
    # Time from STOP to standstill; chosen.
    "stopping": 3.0,
    # Time from the stage's `done` to the last burst; chosen.
    "done": 1.0,
}
# Longest time from STOP to standstill when the program is being ended, seconds; chosen, systemd waits 5 s for the end.
END_TIMEOUT_S = 0.5
# Names in messages of states that hosts do not know; the other states have the same name there.
WIRE_STATE: dict[State, m.State] = {"stopping": "running", "ending": "done"}
# States in which the stage moves.
MOVING = ("homing", "jogging", "running", "held", "stopping")
