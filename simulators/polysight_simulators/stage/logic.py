"""Commands of the Python stand-in of the stage: legs, homing, hold, stop, alarms (as arduino_stage/stage.cpp)."""

from collections.abc import Callable
from enum import Enum

from polysight_shared.faults import StageError
from polysight_shared.stage_line import Immediate, Parameter
from polysight_simulators.stage.motion import (
    DEBOUNCING_READINGS,
    EMERGENCY,
    MAX_RATE,
    MIN_RATE,
    SWITCH_X,
    SWITCH_Y,
    Leg,
    StepEngine,
)

# Limits of arguments, and the sequence of homing, as in arduino_stage/board.h: lengths in steps.
MAX_TRAVEL = 999_999
MAX_POINTS = 9_999
MAX_BACKLASH = 20_000
# Homing: rates in steps/s. Until an axis has found its switch since the last reset, its direction may be wrong: it
# searches slowly, in legs of FIRST_LEG. Then it goes back until the switch opens, at most MAX_RELEASE, and by PULL_OFF.
HOME_RATE = 4000
CREEP_RATE = 400
FIRST_RATE = 2000
FIRST_LEG = 2000
STEPS_PER_MM = 200
PULL_OFF = 400
MAX_RELEASE = 4000
# Acceleration of homing, steps/s^2.
HOME_ACCEL = 40_000
# A byte that comes this long after the one before stands alone: a heartbeat, no part of a noisy line.
QUIET_MS = 4
_RANGES = {
    Parameter.ACCEL: (100, 1_000_000),
    Parameter.HEARTBEAT: (50, 60_000),
    Parameter.TRIGGER: (1, 10_000),
    Parameter.TRAVEL_X: (1, MAX_TRAVEL),
    Parameter.TRAVEL_Y: (1, MAX_TRAVEL),
    Parameter.TRAVEL_SPEED: (MIN_RATE, 2**31),
    Parameter.BACKLASH: (0, MAX_BACKLASH),
    Parameter.PINS: (0, 127),
}
# Number of arguments of each command, and the commands that move the stage.
ARGUMENTS = {"HELLO": 0, "SET": 2, "ENABLE": 1, "HOME": 0, "MOVE": 3, "ROW": 5, "BUZZ": 1, "CLEAR": 0}
MOTION_VERBS = ("HOME", "MOVE", "ROW", "BUZZ")


class RefusedCommand(Exception):  # noqa: N818 - the answer to a command, not a failure of this program
    """A command is refused with this number."""

    def __init__(self, number: StageError) -> None:
        super().__init__(number.name)
        self.number = number


class Event(Enum):
    """Result of :meth:`StageLogic.service`."""

    NONE = 0
    DONE = 1
    ALARM = 2


def count_steps_to_zero() -> int:
    """Return the steps from the closing point of a switch to the zero of homing.

    The creep sees the switch open after DEBOUNCING_READINGS readings (one a step), takes the steps of its ramp to stop,
    and pulls off. Homing has to begin at least the ramp of the search away from the switch.
    """
    engine = StepEngine()
    engine.set_accel(HOME_ACCEL)
    return DEBOUNCING_READINGS + engine.ramp_steps(CREEP_RATE) + PULL_OFF


def _require(ok: bool, number: StageError) -> None:
    """Raise Refused with this number unless `ok`."""
    if not ok:
        raise RefusedCommand(number)


class StageLogic:
    """The sequences of legs behind the commands.

    Parameters
    ----------
    engine
        Moves the stage.
    arm
        Called with the ticks to the next step when the engine starts stepping; 0 when it does not.
    inputs
        The switches that are pressed now.
    """

    def __init__(self, engine: StepEngine, arm: Callable[[int], None], inputs: Callable[[], int]) -> None:
        self._engine = engine
        self._arm = arm
        self._inputs = inputs
        self.parameters = {
            Parameter.ACCEL: 40_000,
            Parameter.HEARTBEAT: 500,
            Parameter.TRIGGER: 20,
            Parameter.TRAVEL_X: 160_000,
            Parameter.TRAVEL_Y: 100_000,
            Parameter.TRAVEL_SPEED: 8_000,
            Parameter.BACKLASH: 0,
            Parameter.PINS: 0,
        }
        # "idle", "move", "travel" (to the start of a row), "row", "home" or "buzz".
        self.activity = "idle"
        self.alarm: StageError | None = None
        self.homed = False
        # True if a HOLD came during the last row; its `done` line says so.
        self.held = False
        # True if the last motion command was ROW or HOME, whose `done` line has further fields.
        self.row_command = False
        self.homing_command = False
        # True if a STATUS byte has not been answered yet.
        self.status_requested = False
        # A byte that counts as a heartbeat came; cleared when its time is noted.
        self.heard = False
        # Why the motion is to end once the stage rests.
        self._stopping: StageError | None = None
        self._enabled = False
        # True if `service` still has to obey a STOP, or a RESUME that was confirmed.
        self._stop = False
        self._resume = False
        # RESUME counts only when it comes twice in a row; True after the first.
        self._resume_begun = False
        self._byte_seen = False
        self._quiet = True
        # True if the stage was homed when the present homing began.
        self._was_homed = False
        # Switches that were found since the last reset, as bits.
        self._found_switches = 0
        # Steps of the present search for a switch.
        self._searched_steps = 0
        # True if a leg of the present phase of homing was made.
        self._homing_leg_made = False
        self._buzz_x = True
        # Leg of a homing (0 to 2 of x, 3 to 5 of y: search, release, pull off; 6: end), or of a buzz (0 to 2, 3: end).
        self._phase = 0
        self._heard_ms = 0
        self._byte_ms = 0
        self._looked_ms = 0
        # Steps lost since the previous homing.
        self.lost_x = 0
        self.lost_y = 0
        self._row_leg = Leg(0, 0, MIN_RATE)
        self._row_y = 0

    @property
    def busy(self) -> bool:
        """True while a motion command is active."""
        return self.activity != "idle"

    @property
    def state(self) -> str:
        """The state as in a status reply."""
        if self.busy and self._engine.hold and not self._engine.stepping:
            return "hold"
        if self.busy:
            return {"travel": "row", "buzz": "move"}.get(self.activity, self.activity)
        return "alarm" if self.alarm else "idle"

    def execute(self, verb: str, args: tuple[int, ...]) -> None:
        """Execute a command; HELLO changes nothing here, the caller answers it. Raises Refused."""
        _require(verb in ARGUMENTS, StageError.UNKNOWN_COMMAND)
        _require(len(args) == ARGUMENTS[verb], StageError.ARGUMENT_COUNT)
        if verb == "HELLO":
            return
        _require(not self.busy, StageError.BUSY)
        if verb in MOTION_VERBS:
            _require(self.alarm is None and not self._stop, StageError.IN_ALARM)
            _require(self._enabled, StageError.DISABLED)
            _require(self.homed or verb in ("HOME", "BUZZ"), StageError.NOT_HOMED)
        handlers: dict[str, Callable[..., None]] = {
            "SET": self._set,
            "ENABLE": self._enable,
            "CLEAR": self._clear,
            "HOME": self._home,
            "MOVE": self._move,
            "ROW": self._start_row,
            "BUZZ": self._buzz,
        }
        handlers[verb](*args)

    def _set(self, index: int, value: int) -> None:
        """Set a parameter."""
        _require(index in _RANGES, StageError.OUT_OF_RANGE)
        parameter = Parameter(index)
        low, high = _RANGES[parameter]
        _require(low <= value <= high, StageError.OUT_OF_RANGE)
        _require(parameter != Parameter.TRAVEL_SPEED or value <= MAX_RATE, StageError.TOO_FAST)
        self.parameters[parameter] = value
        if parameter == Parameter.ACCEL:
            self._engine.set_accel(value)

    def _enable(self, on: int) -> None:
        _require(on in (0, 1), StageError.OUT_OF_RANGE)
        self._enabled = on == 1
        self.homed = self.homed and self._enabled

    def _clear(self) -> None:
        _require(not (self._inputs() | self._engine.stable) & EMERGENCY, StageError.EMERGENCY_STOP)
        self.alarm = None

    def _home(self) -> None:
        """Begin homing; positions are not known until its end."""
        self._begin("home")
        self._engine.set_accel(HOME_ACCEL)
        self._was_homed = self.homed
        self.homed = False
        self._phase = 0
        self._searched_steps = 0

    def _buzz(self, axis: int) -> None:
        """Begin a buzz of an axis (0: x, 1: y): 1 mm forward, 2 mm back, 1 mm forward."""
        _require(axis in (0, 1), StageError.OUT_OF_RANGE)
        self._begin("buzz")
        self._engine.set_accel(HOME_ACCEL)
        self._buzz_x = axis == 0
        self._phase = 0

    def _plan_buzz_leg(self) -> Event:
        """Start the next leg of a buzz, or end it."""
        if self._phase == 3:
            self._engine.set_accel(self.parameters[Parameter.ACCEL])
            return self._end()
        distance = STEPS_PER_MM
        if self._phase == 1:
            distance = -2 * STEPS_PER_MM
        self._phase += 1
        if self._buzz_x:
            leg = Leg(distance, 0, CREEP_RATE)
        else:
            leg = Leg(0, distance, CREEP_RATE)
        self._arm(self._engine.start(leg))
        return Event.NONE

    def _move(self, x: int, y: int, rate: int) -> None:
        """Begin a move to a place (steps) at a rate (steps/s), if both are allowed."""
        _require(rate >= MIN_RATE, StageError.OUT_OF_RANGE)
        _require(rate <= MAX_RATE, StageError.TOO_FAST)
        _require(self._is_within(x, y), StageError.SOFT_LIMIT)
        self._begin("move")
        self._start_straight_leg(x, y, rate)

    def _start_row(self, x0: int, pitch: int, points: int, y: int, rate: int) -> None:
        """Begin a row of `points` triggers from `x0` on, signed `pitch` steps apart, at `y`.

        The stage first travels to the start of the run-up, and to `y` from below, so that backlash is taken up.
        """
        _require(1 <= points <= MAX_POINTS and pitch != 0 and rate >= MIN_RATE, StageError.OUT_OF_RANGE)
        _require(rate <= MAX_RATE, StageError.TOO_FAST)
        last = x0 + pitch * (points - 1)
        spacing = abs(pitch)
        _require(self._is_within(x0, y) and self._is_within(last, y) and spacing <= MAX_TRAVEL, StageError.SOFT_LIMIT)
        width_us = self.parameters[Parameter.TRIGGER]
        # A trigger pulse ends before the next begins. The sketch limits the spacing so that its product fits 32 bits.
        _require(width_us * rate < min(spacing, 4000) * 1_000_000, StageError.OUT_OF_RANGE)
        backlash = self.parameters[Parameter.BACKLASH]
        lead = self._engine.ramp_steps(rate) + max(spacing, backlash)
        if pitch > 0:
            run_up = lead
        else:
            run_up = -lead
        _require(self._is_within(x0 - run_up, y) and self._is_within(last + run_up, y), StageError.NO_RUN_UP)
        _require(y >= backlash, StageError.NO_RUN_UP)
        self._row_leg = Leg(last - x0 + 2 * run_up, 0, rate, lead, spacing, points)
        self._begin("travel")
        self._row_y = y
        if self._engine.y > y - backlash:
            approach_y = y - backlash
        else:
            approach_y = y
        self._start_straight_leg(x0 - run_up, approach_y, self.parameters[Parameter.TRAVEL_SPEED])

    def _is_within(self, x: int, y: int) -> bool:
        return 0 <= x <= self.parameters[Parameter.TRAVEL_X] and 0 <= y <= self.parameters[Parameter.TRAVEL_Y]

    def _begin(self, activity: str) -> None:
        """Begin a motion command: clear the counters of the last one. It counts as a heartbeat."""
        self.activity = activity
        self.held = False
        self._homing_leg_made = False
        self.row_command = activity == "travel"
        self.homing_command = activity == "home"
        self._engine.abandon()
        self._engine.points = 0
        self._engine.pulses = 0
        self.heard = True

    def _start_straight_leg(self, x: int, y: int, rate: int) -> None:
        self._arm(self._engine.start(Leg(x - self._engine.x, y - self._engine.y, rate)))

    def immediate(self, byte: int) -> bool:
        """Obey HOLD, RESUME, STATUS or STOP, which count without a line; return False for any other byte."""
        is_alone = self._quiet
        confirmed = self._resume_begun
        self._quiet = False
        self._byte_seen = True
        self._resume_begun = byte == Immediate.RESUME
        if byte == Immediate.HOLD:
            self._engine.hold = True
            self._resume = False
        elif byte == Immediate.RESUME:
            self._resume |= confirmed
            self._resume_begun = not confirmed
        elif byte == Immediate.STATUS:
            self.status_requested = True
        elif byte == Immediate.STOP:
            self._engine.hold = True
            self._stop = True
        else:
            return False
        self.heard |= is_alone
        return True

    def _listen(self, now_ms: int) -> None:
        """Note the time of bytes and heartbeats, and read the switches once a millisecond at rest."""
        if self._byte_seen:
            self._byte_seen = False
            self._byte_ms = now_ms
        elif now_ms - self._byte_ms >= QUIET_MS:
            self._quiet = True
        if self.heard:
            self.heard = False
            self._heard_ms = now_ms
        if now_ms != self._looked_ms and not self._engine.stepping:
            self._looked_ms = now_ms
            self._engine.look(self._inputs())

    def _raise_alarm(self, alarm: StageError, position_lost: bool) -> Event:
        """End all motion and latch an alarm; an emergency stop also switches the motors off."""
        self._engine.abandon()
        self._engine.set_accel(self.parameters[Parameter.ACCEL])
        self.activity = "idle"
        self._stopping = None
        self._stop = False
        self._resume = False
        self.alarm = alarm
        self.homed = self.homed and not position_lost
        self._enabled = self._enabled and alarm != StageError.EMERGENCY_STOP
        return Event.ALARM

    def service(self, now_ms: int) -> Event:
        """Check heartbeat and switches, end a stopped motion, or start the next leg. Call often."""
        engine = self._engine
        self._listen(now_ms)
        if engine.fault is not None:
            return self._raise_alarm(engine.fault, position_lost=True)
        if engine.stable & EMERGENCY and self.alarm != StageError.EMERGENCY_STOP:
            return self._raise_alarm(StageError.EMERGENCY_STOP, position_lost=True)
        if not self.busy:
            if self._stop and self.alarm is None:
                return self._raise_alarm(StageError.STOPPED, position_lost=False)
            self._stop = False
            self._resume = False
            engine.abandon()
            return Event.NONE
        if self._stop and self._stopping is None:
            self._stopping = StageError.STOPPED
        silent_ms = now_ms - self._heard_ms
        if engine.stepping and self._stopping is None and silent_ms > self.parameters[Parameter.HEARTBEAT]:
            self._stopping = StageError.HEARTBEAT_LOST
        if self._stopping is not None:
            engine.hold = True
            if engine.stepping:
                return Event.NONE
            return self._raise_alarm(self._stopping, self._stopping == StageError.HEARTBEAT_LOST)
        if self._resume:
            self._resume = False
            self._arm(engine.resume())
        if engine.hold and self.activity == "row":
            self.held = True
        if engine.finished:
            return self._plan_leg()
        return Event.NONE

    def _plan_leg(self) -> Event:
        """Start what follows a finished leg, or report the end."""
        if self.activity == "travel" and self._engine.y != self._row_y:
            self._start_straight_leg(self._engine.x, self._row_y, self.parameters[Parameter.TRAVEL_SPEED])
            return Event.NONE
        if self.activity == "travel":
            self.activity = "row"
            self._arm(self._engine.start(self._row_leg))
            return Event.NONE
        if self.activity == "home":
            return self._plan_homing_leg()
        if self.activity == "buzz":
            return self._plan_buzz_leg()
        return self._end()

    def _end(self) -> Event:
        self.activity = "idle"
        self._engine.abandon()
        return Event.DONE

    def _plan_homing_leg(self) -> Event:
        """Start the next leg of homing, or end it; the alarm HOMING_FAILED if a switch did not change as it should.

        At the end of its pull off an axis is at 0; if the stage was homed before, what it counted there are lost steps.
        """
        along_x = self._phase < 3
        # 0: search, 1: release, 2: pull off.
        step = self._phase % 3
        its_switch = SWITCH_X if along_x else SWITCH_Y
        travel = self.parameters[Parameter.TRAVEL_X if along_x else Parameter.TRAVEL_Y]
        farthest = travel + travel // 10 + PULL_OFF
        if self._homing_leg_made and step == 0 and self._engine.reached:
            self._found_switches |= its_switch
        # A first search moves leg by leg, until it has found the switch or has moved over the whole travel.
        was_found = bool(self._found_switches & its_switch)
        still_searches = step == 0 and not was_found and self._searched_steps < farthest
        if self._homing_leg_made and not still_searches:
            # Search and release end at the switch; the leg that pulls off does not meet it.
            ends_at_switch = step != 2
            if self._engine.reached != ends_at_switch:
                return self._raise_alarm(StageError.HOMING_FAILED, position_lost=True)
            if self._phase == 2:
                if self._was_homed:
                    self.lost_x = -self._engine.x
                else:
                    self.lost_x = 0
                self._engine.x = 0
            if self._phase == 5:
                if self._was_homed:
                    self.lost_y = -self._engine.y
                else:
                    self.lost_y = 0
                self._engine.y = 0
            self._phase += 1
            self._searched_steps = 0
            self._homing_leg_made = False
            return self._plan_homing_leg()
        if self._phase == 6:
            self._engine.set_accel(self.parameters[Parameter.ACCEL])
            self.homed = True
            return self._end()
        # To the switch, slowly off it until it opens, and away from it.
        distance = (-farthest, MAX_RELEASE, PULL_OFF)[step]
        rate = CREEP_RATE if step == 1 else HOME_RATE
        if still_searches:
            distance = -FIRST_LEG
            rate = FIRST_RATE
            self._searched_steps += FIRST_LEG
        if along_x:
            leg = Leg(distance, 0, rate, until=SWITCH_X, until_open=step == 1)
        else:
            leg = Leg(0, distance, rate, until=SWITCH_Y, until_open=step == 1)
        self._homing_leg_made = True
        self._arm(self._engine.start(leg))
        return Event.NONE
