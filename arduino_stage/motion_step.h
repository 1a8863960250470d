// The part of Motion that runs in the step interrupt, inlined there for speed.
#pragma once
#include "motion.h"

#ifdef __AVR__
#pragma GCC optimize("O2")
#define IN_INTERRUPT inline __attribute__((always_inline))
#else
#define IN_INTERRUPT inline
#endif

// TICK_HZ / v in 16 turns; the compiler's division needs 32, which takes longer than a step.
// Exact for MIN_RATE <= v < 32768: the quotient has 16 bits, and the doubled remainder too.
IN_INTERRUPT uint16_t ticks_of(uint16_t v) {
  static_assert(board::TICK_HZ >> 16 < board::MIN_RATE && board::MAX_RATE < 32768, "the quotient must fit 16 bits");
  uint16_t rest = (uint16_t)(board::TICK_HZ >> 16), quotient = (uint16_t)board::TICK_HZ;
#ifdef __AVR__  // the same turn in at most 10 cycles
#define TURN                                                                                                 \
  "lsl %A0\n\t rol %B0\n\t rol %A1\n\t rol %B1\n\t cp %A1, %A2\n\t cpc %B1, %B2\n\t brcs .+6\n\t" \
  "sub %A1, %A2\n\t sbc %B1, %B2\n\t inc %A0\n\t"
#define FOUR_TURNS TURN TURN TURN TURN
  asm(FOUR_TURNS FOUR_TURNS FOUR_TURNS FOUR_TURNS : "+r"(quotient), "+r"(rest) : "r"(v));
#undef FOUR_TURNS
#undef TURN
#else
  for (uint8_t i = 16; i; i--) {
    rest = (uint16_t)(rest << 1 | quotient >> 15);
    quotient = (uint16_t)(quotient << 1);
    if (rest >= v) {
      rest -= v;
      quotient |= 1;
    }
  }
#endif
  return quotient;
}

// The switches change after board::DEBOUNCING_READINGS equal readings in a row.
IN_INTERRUPT void Motion::look(uint8_t inputs) {
  if (inputs == stable_) {
    looks_ = 0;
  } else if (++looks_ >= board::DEBOUNCING_READINGS) {
    stable_ = inputs;
    looks_ = 0;
  }
}

IN_INTERRUPT uint8_t Motion::step(uint8_t inputs) {
  if (!stepping_ || left_ == 0) return 0;
  look(inputs);
  inputs = stable_;
  if (inputs & EMERGENCY) {
    fault_ = ERROR_EMERGENCY_STOP;
  } else if (!until_ && (inputs & SWITCHES)) {
    fault_ = ERROR_LIMIT_SWITCH;
  }
  if (fault_ != ERROR_NONE) {
    left_ = 0;
    return 0;
  }
  if (until_ && !reached_ && ((inputs & until_) != 0) != until_open_) {
    reached_ = true;
    left_ = ramp_;  // slow down and end
    if (left_ == 0) return 0;
  }

  left_--;
  uint8_t out = x_major_ ? STEP_X : STEP_Y;
  if (minor_) {
    error_ += minor_;
    if (error_ >= major_) {
      error_ -= major_;
      out = STEP_X | STEP_Y;
    }
  }
  if (out & STEP_X) x_ += x_direction_;
  if (out & STEP_Y) y_ += y_direction_;
  if (points_left_ && --to_trigger_ == 0) {
    out |= TRIGGER;
    to_trigger_ = pitch_;
    points_left_--;
    passed_++;
  }
  return out;
}

IN_INTERRUPT uint16_t Motion::interval() {
  if (!stepping_ || left_ == 0 || (hold_ && ramp_ == 0)) {
    stepping_ = cruise_ = false;
    return 0;
  }
  if (hold_ || (ramp_ && left_ <= ramp_)) {  // slow down
    cruise_ = false;
    ramp_--;
    const uint32_t change = (uint32_t)ticks_ * accel_q20_ >> 4;
    const uint32_t slowest = (uint32_t)slowest_ << 16;
    speed_q16_ = speed_q16_ > slowest + change ? speed_q16_ - change : slowest;
  } else if (cruise_ || ramp_ == ramp_full_) {
    if (!cruise_) {
      cruise_ = true;
      carry_ = 0;
      speed_q16_ = (uint32_t)rate_ << 16;
    }
    carry_ += remainder_;
    if (carry_ >= rate_) {
      carry_ -= rate_;
      return ticks_ = base_ + 1;
    }
    return ticks_ = base_;
  } else if (left_ > ramp_ + 1) {  // speed up
    if (ramp_++ == 0) {
      speed_q16_ = (uint32_t)slowest_ << 16;
    } else {
      speed_q16_ += (uint32_t)ticks_ * accel_q20_ >> 4;
    }
    const uint32_t fastest = (uint32_t)rate_ << 16;
    if (speed_q16_ > fastest) speed_q16_ = fastest;
  } else if (ramp_ == 0) {  // a single step
    speed_q16_ = (uint32_t)slowest_ << 16;
  }
  return ticks_ = ticks_of((uint16_t)(speed_q16_ >> 16));
}
