// The step engine: one straight leg at a time, trapezoidal speed, triggers at exact step counts. All integers.
//
// A leg of N steps (of the axis with more steps) is counted down. `ramp_` is the number of steps needed to stop from
// the current speed: accelerating adds one, decelerating removes one, and decelerating begins when as many are left.
// In the ramp dv = a dt; at constant speed the interval is exact: the remainder of TICK_HZ / rate is carried over, so
// that step k comes floor(k TICK_HZ / rate) ticks after the ramp.
#pragma once
#include <stdint.h>

#include "board.h"
#include "hal.h"
#include "stage_errors.h"

// Pins to pulse in a step.
enum Output : uint8_t { STEP_X = 1, STEP_Y = 2, TRIGGER = 4 };

// A straight motion from rest to rest.
struct Leg {
  int32_t dx, dy;   // steps
  uint16_t rate;    // steps/s of the axis with more steps
  uint32_t lead;    // steps before the first trigger; the leg moves x alone when points > 0
  uint32_t pitch;   // steps from trigger to trigger
  uint16_t points;  // triggers; 0 = none
  uint8_t until;    // bits of Input that end the leg (homing); 0 = a pressed switch is a fault
  bool until_open;  // end when the switch opens instead of when it closes
};

class Motion {
 public:
  Motion() { reset(); }
  // At rest at (0, 0), no fault, default acceleration.
  void reset();
  // Acceleration of the next legs; it also sets the speed with which the stage starts and stops.
  void set_accel(uint32_t steps_s2);

  // Steps from rest to `rate`, and from there to rest.
  uint32_t ramp_steps(uint16_t rate) const;

  // Plan a leg and start the step timer.
  void start(const Leg& leg);

  // Read and debounce the switches (board::DEBOUNCING_READINGS). step() does this too; the main program does it each millisecond
  // while the stage is at rest.
  void look_at_switches();
  // The debounced switches: bits of Input.
  uint8_t inputs() const { return seen(stable_); }

  // In the step interrupt: make the step that is due. Returns the pins to pulse: bits of Output.
  uint8_t step(uint8_t inputs);

  // In the step interrupt, after step(): ticks until the next step; 0 = the stage is at rest.
  uint16_t interval();

  // Slow down to a stop within the leg and wait for resume(). Safe in an interrupt.
  void hold() { hold_ = true; }
  // Go on with the leg after a hold.
  void resume();
  // Drop the rest of the leg. Only at rest, or if the position no longer matters.
  void abandon();

  bool stepping() const { return seen(stepping_); }  // steps are due
  bool holding() const { return seen(hold_); }       // hold() was called, resume() not yet
  bool finished() const { return !seen(stepping_) && left_ == 0; }  // no leg, or it has ended
  bool reached() const { return seen(reached_); }  // ended by Leg::until
  StageError fault() const { return seen(fault_); }  // ended by a switch
  bool cruising() const { return seen(stepping_) && seen(cruise_); }  // at the leg's exact rate
  int32_t x_rate() const;                              // steps/s of x now, signed

  // Position, steps.
  int32_t x() const;
  int32_t y() const;
  void set_x(int32_t x);
  void set_y(int32_t y);
  uint16_t points() const;  // trigger points passed in this row
  uint16_t pulses() const;  // trigger pulses given in this row
  void count_pulse() { pulses_++; }
  void clear_counts();

 private:
  void resume_leg();
  void look(uint8_t inputs);  // debounce one reading

  // Read a variable that the step interrupt writes, from memory. More than a byte needs a lock.
  template <class T>
  static T seen(const T& value) {
    return *static_cast<const volatile T*>(&value);
  }

  // Used by the step interrupt while stepping_, else by the main program. The AVR accesses the first ones fastest.
  uint8_t stable_, looks_;  // the debounced switches; readings that differ from them in a row
  uint32_t left_;  // steps to the end of the leg
  uint32_t ramp_;  // steps to a stop from the present speed
  uint32_t speed_q16_, accel_q20_;  // steps/s x 2^16; steps/s per tick x 2^20
  // Ticks of the current step and the leg's rate. At constant speed a step has base_ ticks, and one more each time that
  // the carried remainder_ / rate_ amounts to one.
  uint16_t ticks_, rate_, base_, remainder_, carry_;
  uint16_t points_left_;
  uint32_t ramp_full_, to_trigger_, pitch_;  // steps of the whole ramp, to the next trigger, from trigger to trigger
  uint32_t major_, minor_, error_;  // Bresenham: steps of the axis with more and of the one with fewer, and the error
  int32_t x_, y_;
  uint16_t passed_, pulses_, slowest_;  // trigger points and pulses in this row; speed of the first step, steps/s
  int8_t x_direction_, y_direction_;  // -1, 0 or 1
  uint8_t until_;
  bool x_major_, until_open_;  // x_major_: x is the axis with more steps
  bool stepping_, cruise_, reached_;  // cruise_: at constant speed
  volatile bool hold_;
  StageError fault_;

  uint32_t accel_;  // steps/s^2
};
