"""The step engine of the Python stand-in of the stage: the firmware's integer arithmetic (arduino_stage/motion.cpp).

Same numbers on purpose: both make the same steps at the same ticks, which the tests compare. Here runs of steps at
constant speed between two events are taken at once, because Python is too slow to make each.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from polysight_shared.faults import StageError

TICK_HZ = 2_000_000
NS_PER_TICK = 1_000_000_000 // TICK_HZ
MIN_RATE = 31
MAX_RATE = 20_000
SWITCH_X = 1
SWITCH_Y = 2
EMERGENCY = 4
SWITCHES = SWITCH_X | SWITCH_Y
# Equal readings after which a switch changes (debouncing)
LOOKS = 5


class Leg(NamedTuple):
    """One straight line: signed steps, steps/s of the longer axis, triggers, and inputs that end it (homing)."""

    dx: int
    dy: int
    rate: int
    lead: int = 0
    pitch: int = 0
    points: int = 0
    until: int = 0
    until_open: bool = False


class StepEngine:
    """One leg at a time with trapezoidal speed. Positions are steps, times are ticks of 500 ns."""

    def __init__(self) -> None:
        self.x = self.y = self.points = self.pulses = 0
        self.hold = self.stepping = self.cruise = self.reached = False
        self.fault: StageError | None = None
        self.left = self.ramp = self.ramp_full = self.major = self.minor = self.error = 0
        self.x_major = True
        self.x_direction = self.y_direction = 0
        self.to_trigger = self.carry = self.ticks = self.speed_q16 = 0
        self.points_left = 0
        self.stable = self._looks = 0
        self.leg = Leg(0, 0, MIN_RATE)
        self.set_accel(40_000)

    def set_accel(self, steps_s2: int) -> None:
        """Set the acceleration, steps/s^2."""
        self.accel = steps_s2
        self._accel_q20 = steps_s2 * 8192 // 15625
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
        self.reached = self.cruise = False
        return self._start_from_rest()

    def resume(self) -> int:
        """End a hold; return the ticks to the next step if the stage was at rest, else 0."""
        self.hold = False
        if self.stepping:
            return 0
        return self._start_from_rest()

    def _start_from_rest(self) -> int:
        if self.left == 0 or self.hold:
            return 0
        self.stepping = True
        return self.interval()

    def abandon(self) -> None:
        """Drop the rest of the leg."""
        self.stepping = self.hold = self.cruise = False
        self.left = self.ramp = self.points_left = 0
        self.fault = None

    def look(self, inputs: int) -> None:
        """Read and debounce the switches: a change counts after :data:`LOOKS` equal readings."""
        if inputs == self.stable:
            self._looks = 0
        else:
            self._looks += 1
        if self._looks >= LOOKS:
            self.stable = inputs
            self._looks = 0

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
        if leg.until and not self.reached and bool(inputs & leg.until) != leg.until_open:
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
            Ticks from the next step's due time to the end of what may be done.
        clear_x, clear_y
            Steps each axis may make before its switch changes.

        Returns
        -------
        n, dx, dy, ticks
            Steps of the longer axis (0: nothing can be taken at once), of x and of y, and the ticks from the first of
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
        n = min(self.left - self.ramp - 1, ((wait_ticks + 1) * rate - 1 - self.carry) // TICK_HZ + 1, clear_major)
        if self.points_left:
            n = min(n, self.to_trigger - 1)
        if self.minor:
            # Over n steps of the longer axis the other makes at most n minor / major + 1.
            n = min(n, (clear_minor - 1) * self.major // self.minor)
        if n < 2:
            return 0, 0, 0, 0
        self._looks = 0
        dx, dy, _ = self._advance(n)
        ticks_before = ((n - 1) * TICK_HZ + self.carry) // rate
        ticks, self.carry = divmod(n * TICK_HZ + self.carry, rate)
        self.ticks = ticks - ticks_before
        return n, dx, dy, ticks

    def _advance(self, n: int) -> tuple[int, int, bool]:
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
        """Return the ticks until the next step; 0: the stage is at rest."""
        rate = self.leg.rate
        if not self.stepping or self.left == 0 or (self.hold and self.ramp == 0):
            self.stepping = self.cruise = False
            return 0
        if self.hold or (self.ramp and self.left <= self.ramp):
            self.cruise = False
            self.ramp -= 1
            slowest = self._slowest << 16
            self.speed_q16 = max(slowest, self.speed_q16 - (self.ticks * self._accel_q20 >> 4))
        elif self.cruise or self.ramp == self.ramp_full:
            if not self.cruise:
                self.cruise = True
                self.carry = 0
                self.speed_q16 = rate << 16
            self.ticks, self.carry = divmod(TICK_HZ + self.carry, rate)
            return self.ticks
        elif self.left > self.ramp + 1:
            if self.ramp == 0:
                self.speed_q16 = self._slowest << 16
            else:
                self.speed_q16 += self.ticks * self._accel_q20 >> 4
            self.ramp += 1
            self.speed_q16 = min(self.speed_q16, rate << 16)
        elif self.ramp == 0:
            self.speed_q16 = self._slowest << 16
        self.ticks = TICK_HZ // (self.speed_q16 >> 16)
        return self.ticks
