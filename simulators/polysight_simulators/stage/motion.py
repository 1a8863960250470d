"""The step engine of the Python stand-in of the stage: the firmware's integer arithmetic (arduino_stage/motion.cpp).

Names and numbers are those of the firmware on purpose: both make the same steps at the same ticks, which the tests
compare; arduino_stage/motion.h explains the arithmetic. Here the steps at constant speed between two events are taken
together (:meth:`StepEngine.skip`), because Python is too slow to make each.
"""

import math
from typing import NamedTuple

from polysight_shared.faults import StageError

# Ticks of the sketch's step timer, 0.5 us (docs/spec/stage-line.md, timing).
TICK_HZ = 2_000_000
NS_PER_TICK = 1_000_000_000 // TICK_HZ
# Slowest and fastest step rate, steps/s. A 16-bit timer cannot wait longer than 65,536 ticks: 1 / 30.5 s.
MIN_RATE = 31
MAX_RATE = 20_000
# Bits of the switch inputs.
SWITCH_X = 1
SWITCH_Y = 2
EMERGENCY = 4
SWITCHES = SWITCH_X | SWITCH_Y
# A switch counts as changed after this many successive readings that differ from the old state (debouncing).
DEBOUNCING_READINGS = 5


class Leg(NamedTuple):
    """One straight line of the stage."""

    dx: int
    """Signed steps of x; `dy` those of y."""
    dy: int
    rate: int
    """Steps/s of the axis with more steps."""
    lead: int = 0
    """Steps before the first trigger."""
    pitch: int = 0
    """Steps from trigger to trigger."""
    points: int = 0
    """Number of triggers; 0: none."""
    until: int = 0
    """Switch inputs that end the leg (homing); 0: a pressed switch is a fault."""
    until_open: bool = False
    """End the leg when the switch opens instead of when it closes."""


class StepEngine:
    """One leg at a time with trapezoidal speed. Positions are steps, times are ticks of 500 ns."""

    def __init__(self) -> None:
        # Position, steps.
        self.x = 0
        self.y = 0
        # Trigger points that were passed in this row.
        self.points = 0
        # Trigger pulses that were sent. They are counted by the caller, which knows when a pulse ends.
        self.pulses = 0
        # True if a hold is requested.
        self.hold = False
        # True while steps are due.
        self.stepping = False
        # True at constant speed.
        self.cruise = False
        # True if `Leg.until` has ended the leg.
        self.reached = False
        # Why the leg ended early: emergency stop or limit switch; None if it did not.
        self.fault: StageError | None = None
        # Steps left in the leg.
        self.left = 0
        # Steps to a stop from the present speed, and from the leg's rate.
        self.ramp = 0
        self.ramp_full = 0
        # Bresenham's line: steps of the axis with more steps, those of the other axis, and the error term.
        self.major = 0
        self.minor = 0
        self.error = 0
        self.x_major = True
        self.x_direction = 0
        self.y_direction = 0
        # Steps to the next trigger, triggers left.
        self.to_trigger = 0
        self.points_left = 0
        # Speed, steps/s x 2^16.
        self.speed_q16 = 0
        # Ticks of the present step.
        self.ticks = 0
        # Remainder of the division into ticks, which the next step at constant speed takes over.
        self.carry = 0
        # The debounced inputs, as bits.
        self.stable = 0
        # Number of successive readings that differed from them.
        self._differing_readings = 0
        self.leg = Leg(0, 0, MIN_RATE)
        # The firmware starts with this acceleration; the host sets another one.
        self.set_accel(40_000)

    def set_accel(self, steps_s2: int) -> None:
        """Set the acceleration, steps/s^2."""
        self.accel = steps_s2
        # Steps/s gained per tick, in units of 2^-20: a 2^20 / TICK_HZ = a 8192 / 15625. Speeds have units of 2^-16, so
        # that `interval` shifts by 4 bits.
        self._accel_q20 = steps_s2 * 8192 // 15625
        # Mean speed of the first step from rest: half its final speed sqrt(2 a), so sqrt(2 a) / 2 = sqrt(a / 2).
        self._slowest = max(MIN_RATE, math.isqrt(steps_s2 // 2))

    def ramp_steps(self, rate: int) -> int:
        """Return the steps from rest to `rate`: v^2 / 2a, rounded up."""
        if rate <= self._slowest:
            return 0
        return -(-rate * rate // (2 * self.accel))

    @property
    def finished(self) -> bool:
        """True at rest with no step left."""
        return not self.stepping and self.left == 0

    @property
    def x_rate(self) -> int:
        """Steps/s of x now, signed."""
        if not self.stepping or self.major == 0:
            return 0
        rate = self.speed_q16 >> 16
        return self.x_direction * (rate if self.x_major else rate * self.minor // self.major)

    def start(self, leg: Leg) -> int:
        """Plan a leg; return the ticks to its first step, or 0 if there is none now."""
        nx = abs(leg.dx)
        ny = abs(leg.dy)
        self.leg = leg
        self.x_major = nx >= ny
        self.major = max(nx, ny)
        self.minor = min(nx, ny)
        self.error = self.major // 2
        self.x_direction = (leg.dx > 0) - (leg.dx < 0)
        self.y_direction = (leg.dy > 0) - (leg.dy < 0)
        self.left = self.major
        self.ramp = 0
        self.ramp_full = self.ramp_steps(leg.rate)
        self.to_trigger = leg.lead
        self.points_left = leg.points
        self.reached = False
        self.cruise = False
        return self._start_from_rest()

    def resume(self) -> int:
        """End a hold; return the ticks to the next step if the stage was at rest, else 0."""
        self.hold = False
        if self.stepping:
            return 0
        return self._start_from_rest()

    def _start_from_rest(self) -> int:
        """Return the ticks to the first step, or 0 if there is no step or the stage is held."""
        if self.left == 0 or self.hold:
            return 0
        self.stepping = True
        return self.interval()

    def abandon(self) -> None:
        """Drop the rest of the leg."""
        self.stepping = False
        self.hold = False
        self.cruise = False
        self.left = 0
        self.ramp = 0
        self.points_left = 0
        self.fault = None

    def look(self, inputs: int) -> None:
        """Debounce the switches: `stable` changes after `DEBOUNCING_READINGS` successive differing readings."""
        if inputs == self.stable:
            self._differing_readings = 0
        else:
            self._differing_readings += 1
        if self._differing_readings >= DEBOUNCING_READINGS:
            self.stable = inputs
            self._differing_readings = 0

    def step(self, inputs: int) -> tuple[int, int, bool]:
        """Make the step that is due; return the steps of x and y (signed), and True if the trigger is raised."""
        leg = self.leg
        if not self.stepping or self.left == 0:
            return 0, 0, False
        self.look(inputs)
        inputs = self.stable
        if inputs & EMERGENCY:
            self.fault = StageError.EMERGENCY_STOP
        elif not leg.until and inputs & SWITCHES:
            self.fault = StageError.LIMIT_SWITCH
        if self.fault is not None:
            self.left = 0
            return 0, 0, False
        switch_is_closed = bool(inputs & leg.until)
        state_to_reach = not leg.until_open
        if leg.until and not self.reached and switch_is_closed == state_to_reach:
            # The homing switch has changed: brake to a stop.
            self.reached = True
            self.left = self.ramp
            if self.left == 0:
                return 0, 0, False
        return self._advance(1)

    def skip(self, wait_ticks: int, clear_x: int, clear_y: int) -> tuple[int, int, int, int]:
        """Skip the steps at constant speed that have no event.

        Parameters
        ----------
        wait_ticks
            Ticks from the next step's due time to the end of the time that may be simulated.
        clear_x, clear_y
            Steps each axis may make before its switch changes.

        Returns
        -------
        n, dx, dy, ticks
            Steps of the longer axis (0: steps cannot be taken together), of x and of y, and the ticks from the first of
            them to the step after the last.
        """
        if not self.cruise or self.hold or self.leg.until or self.stable:
            return 0, 0, 0, 0
        rate = self.leg.rate
        if self.x_major:
            clear_major = clear_x
            clear_minor = clear_y
        else:
            clear_major = clear_y
            clear_minor = clear_x
        steps_before_braking = self.left - self.ramp - 1
        # Step k after the next one is due (k TICK_HZ + carry) // rate ticks after it, which is at most `wait_ticks` if
        # k TICK_HZ + carry < (wait_ticks + 1) rate. With the next step itself these are the largest such k, plus 1.
        steps_in_time = ((wait_ticks + 1) * rate - 1 - self.carry) // TICK_HZ + 1
        n = min(steps_before_braking, steps_in_time, clear_major)
        if self.points_left:
            n = min(n, self.to_trigger - 1)
        if self.minor:
            # Over n steps of the longer axis the other makes at most n minor / major + 1, which may be `clear_minor`.
            n = min(n, (clear_minor - 1) * self.major // self.minor)
        # A single step is left to `step`.
        if n < 2:
            return 0, 0, 0, 0
        self._differing_readings = 0
        dx, dy, _ = self._advance(n)
        # `interval` uses the duration of the last step.
        ticks_before = ((n - 1) * TICK_HZ + self.carry) // rate
        ticks, self.carry = divmod(n * TICK_HZ + self.carry, rate)
        self.ticks = ticks - ticks_before
        return n, dx, dy, ticks

    def _advance(self, n: int) -> tuple[int, int, bool]:
        """Move by `n` steps of the longer axis; return the steps of x and y, and True if the trigger is raised."""
        self.left -= n
        minor_steps, self.error = divmod(self.error + n * self.minor, self.major)
        if self.x_major:
            nx = n
            ny = minor_steps
        else:
            nx = minor_steps
            ny = n
        dx = nx * self.x_direction
        dy = ny * self.y_direction
        self.x += dx
        self.y += dy
        trigger = False
        if self.points_left:
            self.to_trigger -= n
            if self.to_trigger == 0:
                trigger = True
                self.to_trigger = self.leg.pitch
                self.points_left -= 1
                self.points += 1
        return dx, dy, trigger

    def interval(self) -> int:
        """Choose the speed of the next step and return the ticks until it; 0: the stage is at rest."""
        rate = self.leg.rate
        held_at_rest = self.hold and self.ramp == 0
        must_brake = self.ramp > 0 and self.left <= self.ramp
        if not self.stepping or self.left == 0 or held_at_rest:
            self.stepping = False
            self.cruise = False
            return 0
        if self.hold or must_brake:
            # Brake.
            self.cruise = False
            self.ramp -= 1
            slowest = self._slowest << 16
            self.speed_q16 = max(slowest, self.speed_q16 - (self.ticks * self._accel_q20 >> 4))
        elif self.cruise or self.ramp == self.ramp_full:
            # Constant speed: the remainder of the division is carried over, so that the mean rate is exact.
            if not self.cruise:
                self.cruise = True
                self.carry = 0
                self.speed_q16 = rate << 16
            self.ticks, self.carry = divmod(TICK_HZ + self.carry, rate)
            return self.ticks
        elif self.left > self.ramp + 1:
            # Accelerate: braking from one step more on the ramp needs one step more. Otherwise the speed is kept.
            if self.ramp == 0:
                self.speed_q16 = self._slowest << 16
            else:
                self.speed_q16 += self.ticks * self._accel_q20 >> 4
            self.ramp += 1
            self.speed_q16 = min(self.speed_q16, rate << 16)
        elif self.ramp == 0:
            # The only step of a leg.
            self.speed_q16 = self._slowest << 16
        self.ticks = TICK_HZ // (self.speed_q16 >> 16)
        return self.ticks
