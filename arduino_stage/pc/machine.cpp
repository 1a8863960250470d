#include "machine.h"

#include <math.h>

#include "../motion_step.h"

namespace {
Machine* machine;
constexpr uint64_t NS_PER_TICK = 1000000000ull / board::TICK_HZ;
constexpr uint64_t REPORT_TICKS = board::TICK_HZ / 100;  // interval of motion messages while the speed changes: 10 ms
}  // namespace

InterruptLock::InterruptLock() : saved_(0) {}
InterruptLock::~InterruptLock() { (void)saved_; }
uint8_t hal_inputs() { return machine->inputs(); }
void hal_start_steps(uint16_t ticks) { machine->arm(ticks); }
void hal_directions(bool x_positive, bool y_positive) { machine->set_directions(x_positive, y_positive); }
void hal_enable(bool) {}
void hal_pins(uint8_t) {}  // wired as the settings say
void hal_trigger_width(uint16_t us) { machine->set_trigger_width(us); }
void hal_write(const char* text, uint8_t length) { machine->replies_.append(text, length); }
uint8_t hal_room() { return 255; }
uint16_t hal_steps_per_mm() { return machine->steps_per_mm(); }

Machine::Machine(const Rig& rig) : rig_(rig), stage_(motion_), protocol_(stage_), x_(rig.x), y_(rig.y) {
  machine = this;
}

void Machine::reset(uint32_t now_ms) {
  now_ms_ = now_ms;
  const bool moved = armed_;
  armed_ = false;
  motion_.reset();
  stage_.reset();
  protocol_.reset();
  width_ = 2u * board::DEFAULT_TRIGGER_US;
  was_homed_ = false;
  if (trigger_high_) edge(tick_, false);
  if (moved) report_motion();
  protocol_.banner();
}

void Machine::receive(uint8_t byte) {
  if (!stage_.immediate(byte)) protocol_.receive(byte);
  settle();
}

void Machine::advance(uint64_t tick, uint32_t now_ms) {
  now_ms_ = now_ms;
  settle();
  while (armed_ && next_ <= tick) {
    end_trigger(next_);
    tick_ = next_;
    step();
  }
  end_trigger(tick);
  tick_ = tick;
  settle();
}

void Machine::arm(uint16_t ticks) {
  next_ = tick_ + ticks;
  armed_ = true;
  if (motion_.cruising()) report_motion();  // a leg without a ramp
}

void Machine::step() {
  const bool cruised = motion_.cruising();
  const uint8_t out = motion_.step(inputs());
  if (out & STEP_X) x_ += x_sign_;
  if (out & STEP_Y) y_ += y_sign_;
  if (out & TRIGGER) {
    report_motion();
    if (!trigger_high_) {
      edge(tick_, true);
      fall_ = tick_ + width_;
      motion_.count_pulse();
    }
  }
  const uint16_t ticks = motion_.interval();
  if (ticks == 0) {
    armed_ = false;
    report_motion();
    settle();
    return;
  }
  next_ = tick_ + ticks;
  if (motion_.cruising() != cruised || (!cruised && tick_ - told_ >= REPORT_TICKS)) report_motion();
}

// The main loop of the sketch, until it has nothing more to do at this moment.
void Machine::settle() {
  do {
    protocol_.poll(now_ms_);
  } while (stage_.busy() && motion_.finished());
  if (stage_.homed() && !was_homed_) {
    zero_x_ = x_ - motion_.x();
    zero_y_ = y_ - motion_.y();
    report_motion();
  }
  was_homed_ = stage_.homed();
}

uint8_t Machine::inputs() const {
  return (uint8_t)(pressed_ | (x_ <= 0 ? SWITCH_X : 0) | (y_ <= 0 ? SWITCH_Y : 0));
}

void Machine::edge(uint64_t tick, bool high) {
  trigger_high_ = high;
  wires_ += "S " + std::to_string(tick * NS_PER_TICK) + " " + std::to_string(rig_.trigger_line) + (high ? " 1\n" : " 0\n");
}

void Machine::end_trigger(uint64_t until) {
  if (trigger_high_ && fall_ <= until) edge(fall_, false);
}

void Machine::report_motion() {
  told_ = tick_;
  const double um = 1000.0 / rig_.steps_per_mm;
  const double values[] = {(double)(x_ - zero_x_), (double)(y_ - zero_y_), (double)motion_.x_rate()};
  wires_ += "M " + std::to_string(tick_ * NS_PER_TICK);
  for (double v : values) wires_ += " " + std::to_string((int64_t)floor(v * um + 0.5));
  wires_ += "\n";
}
