#include "motion.h"

#include "motion_step.h"

namespace {

// Largest integer whose square is at most n, bit by bit.
uint16_t square_root(uint32_t n) {
  uint32_t root = 0;
  for (uint32_t bit = 1UL << 30; bit; bit >>= 2) {
    if (n >= root + bit) {
      n -= root + bit;
      root = (root >> 1) + bit;
    } else {
      root >>= 1;
    }
  }
  return (uint16_t)root;
}

uint32_t magnitude(int32_t v) { return v < 0 ? -(uint32_t)v : (uint32_t)v; }

int8_t sign(int32_t v) { return v > 0 ? 1 : v < 0 ? -1 : 0; }

}  // namespace

void Motion::reset() {
  stepping_ = hold_ = reached_ = cruise_ = false;
  x_ = y_ = 0;
  stable_ = looks_ = 0;
  left_ = ramp_ = ramp_full_ = 0;
  major_ = minor_ = error_ = 0;
  points_left_ = 0;
  until_ = 0;
  until_open_ = false;
  x_direction_ = y_direction_ = 0;
  x_major_ = true;
  to_trigger_ = pitch_ = 0;
  rate_ = base_ = remainder_ = carry_ = ticks_ = 0;
  speed_q16_ = 0;
  fault_ = ERROR_NONE;
  clear_counts();
  set_accel(board::DEFAULT_ACCEL);
}

void Motion::set_accel(uint32_t steps_s2) {
  accel_ = steps_s2;
  // a / TICK_HZ x 2^20, with 2^20 / 2e6 = 8192 / 15625 in lowest terms.
  accel_q20_ = steps_s2 / 15625 * 8192 + steps_s2 % 15625 * 8192 / 15625;
  // The first step from rest takes sqrt(2 / a), which is a speed of sqrt(a / 2).
  slowest_ = square_root(steps_s2 / 2);
  if (slowest_ < board::MIN_RATE) slowest_ = board::MIN_RATE;
}

uint32_t Motion::ramp_steps(uint16_t rate) const {
  if (rate <= slowest_) return 0;
  return ((uint32_t)rate * rate + 2 * accel_ - 1) / (2 * accel_);
}

// The axis with more steps (major) steps each time; Bresenham's error tells when the other one (minor) steps with it.
void Motion::start(const Leg& leg) {
  const uint32_t nx = magnitude(leg.dx), ny = magnitude(leg.dy);
  x_major_ = nx >= ny;
  major_ = x_major_ ? nx : ny;
  minor_ = x_major_ ? ny : nx;
  error_ = major_ / 2;
  x_direction_ = sign(leg.dx);
  y_direction_ = sign(leg.dy);
  left_ = major_;
  rate_ = leg.rate;
  base_ = (uint16_t)(board::TICK_HZ / rate_);
  remainder_ = (uint16_t)(board::TICK_HZ % rate_);
  ramp_ = 0;
  ramp_full_ = ramp_steps(rate_);
  to_trigger_ = leg.lead;
  pitch_ = leg.pitch;
  points_left_ = leg.points;
  until_ = leg.until;
  until_open_ = leg.until_open;
  reached_ = cruise_ = false;
  if (left_ == 0) return;
  hal_directions(leg.dx >= 0, leg.dy >= 0);
  resume_leg();
}

void Motion::look_at_switches() {
  InterruptLock lock;
  look(hal_inputs());
}

void Motion::resume() {
  hold_ = false;
  if (!stepping_ && left_ != 0) resume_leg();
}

// Start from rest: the first interval is that of the slowest speed, or the exact one if there is no ramp.
void Motion::resume_leg() {
  InterruptLock lock;
  if (hold_) return;
  stepping_ = true;
  hal_start_steps(interval());
}

void Motion::abandon() {
  InterruptLock lock;
  stepping_ = hold_ = cruise_ = false;
  left_ = ramp_ = 0;
  points_left_ = 0;
  fault_ = ERROR_NONE;
}

int32_t Motion::x_rate() const {
  if (!stepping_ || major_ == 0) return 0;
  const uint32_t rate = speed_q16_ >> 16;
  return x_direction_ * (int32_t)(x_major_ ? rate : (uint64_t)rate * minor_ / major_);
}

uint16_t Motion::points() const {
  InterruptLock lock;
  return seen(passed_);
}

uint16_t Motion::pulses() const {
  InterruptLock lock;
  return seen(pulses_);
}

int32_t Motion::x() const {
  InterruptLock lock;
  return seen(x_);
}

int32_t Motion::y() const {
  InterruptLock lock;
  return seen(y_);
}

void Motion::set_x(int32_t x) {
  InterruptLock lock;
  x_ = x;
}

void Motion::set_y(int32_t y) {
  InterruptLock lock;
  y_ = y;
}

void Motion::clear_counts() {
  InterruptLock lock;
  passed_ = pulses_ = 0;
}
