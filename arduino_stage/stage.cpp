#include "stage.h"

void Stage::reset() {
  heard_ = status_requested_ = resume_requested_ = stop_requested_ = false;
  byte_seen_ = resume_begun_ = false;
  quiet_ = true;
  activity_ = IDLE;
  alarm_ = stopping_ = ERROR_NONE;
  enabled_ = homed_ = held_ = row_command_ = homing_command_ = started_ = knew_ = false;
  phase_ = found_ = 0;
  buzz_x_ = true;
  searched_ = 0;
  row_ = Leg();
  row_y_ = 0;
  backlash_ = board::DEFAULT_BACKLASH;
  travel_x_ = board::DEFAULT_TRAVEL_X;
  travel_y_ = board::DEFAULT_TRAVEL_Y;
  travel_rate_ = board::DEFAULT_TRAVEL_RATE;
  heartbeat_ms_ = board::DEFAULT_HEARTBEAT_MS;
  trigger_us_ = board::DEFAULT_TRIGGER_US;
  heard_ms_ = byte_ms_ = looked_ms_ = 0;
  accel_ = board::DEFAULT_ACCEL;
  lost_x_ = lost_y_ = 0;
}

StageError Stage::set(int32_t parameter, int32_t value) {
  if (busy()) return ERROR_BUSY;
  if (value < 0) return ERROR_OUT_OF_RANGE;
  const uint32_t v = (uint32_t)value;
  switch (parameter) {
    case PARAMETER_ACCEL:
      if (v < board::MIN_ACCEL || v > board::MAX_ACCEL) return ERROR_OUT_OF_RANGE;
      accel_ = v;
      motion_.set_accel(v);
      return ERROR_NONE;
    case PARAMETER_HEARTBEAT:
      if (v < 50 || v > 60000) return ERROR_OUT_OF_RANGE;
      heartbeat_ms_ = (uint16_t)v;
      return ERROR_NONE;
    case PARAMETER_TRIGGER:
      if (v < 1 || v > 10000) return ERROR_OUT_OF_RANGE;
      trigger_us_ = (uint16_t)v;
      hal_trigger_width(trigger_us_);
      return ERROR_NONE;
    case PARAMETER_TRAVEL_X:
    case PARAMETER_TRAVEL_Y:
      if (v < 1 || v > (uint32_t)board::MAX_TRAVEL) return ERROR_OUT_OF_RANGE;
      (parameter == PARAMETER_TRAVEL_X ? travel_x_ : travel_y_) = value;
      return ERROR_NONE;
    case PARAMETER_TRAVEL_SPEED:
      if (v < board::MIN_RATE) return ERROR_OUT_OF_RANGE;
      if (v > board::MAX_RATE) return ERROR_TOO_FAST;
      travel_rate_ = (uint16_t)v;
      return ERROR_NONE;
    case PARAMETER_BACKLASH:
      if (v > (uint32_t)board::MAX_BACKLASH) return ERROR_OUT_OF_RANGE;
      backlash_ = value;
      return ERROR_NONE;
    case PARAMETER_PINS:
      if (v > 127) return ERROR_OUT_OF_RANGE;
      hal_pins((uint8_t)v);
      hal_enable(enabled_);
      return ERROR_NONE;
    default:
      return ERROR_OUT_OF_RANGE;
  }
}

StageError Stage::enable(int32_t on) {
  if (busy()) return ERROR_BUSY;
  if (on != 0 && on != 1) return ERROR_OUT_OF_RANGE;
  enabled_ = on == 1;
  if (!enabled_) homed_ = false;  // without current the motors may be turned
  hal_enable(enabled_);
  return ERROR_NONE;
}

StageError Stage::ready() const {
  if (busy()) return ERROR_BUSY;
  if (alarm_ != ERROR_NONE || stop_requested_) return ERROR_IN_ALARM;
  if (!enabled_) return ERROR_DISABLED;
  return ERROR_NONE;
}

bool Stage::within(int32_t x, int32_t y) const { return x >= 0 && x <= travel_x_ && y >= 0 && y <= travel_y_; }

void Stage::begin(Activity activity) {
  activity_ = activity;
  held_ = started_ = false;
  row_command_ = activity == TRAVEL;
  homing_command_ = activity == HOMING;
  motion_.abandon();
  motion_.clear_counts();
  heard_ = true;
}

void Stage::go(int32_t x, int32_t y, uint16_t rate) {
  Leg leg = Leg();
  leg.dx = x - motion_.x();
  leg.dy = y - motion_.y();
  leg.rate = rate;
  motion_.start(leg);
}

StageError Stage::home() {
  const StageError refused = ready();
  if (refused != ERROR_NONE) return refused;
  begin(HOMING);
  motion_.set_accel(board::HOME_ACCEL);
  knew_ = homed_;
  homed_ = false;
  phase_ = 0;
  searched_ = 0;
  return ERROR_NONE;
}

// 1 mm each way, slowly, also before the first homing: the direction and the driver can be seen without risk.
StageError Stage::buzz(int32_t axis) {
  const StageError refused = ready();
  if (refused != ERROR_NONE) return refused;
  if (axis != 0 && axis != 1) return ERROR_OUT_OF_RANGE;
  begin(BUZZ);
  motion_.set_accel(board::HOME_ACCEL);
  buzz_x_ = axis == 0;
  phase_ = 0;
  return ERROR_NONE;
}

Event Stage::next_buzz_leg() {
  if (phase_ == 3) {
    motion_.set_accel(accel_);
    activity_ = IDLE;
    motion_.abandon();
    return EVENT_DONE;
  }
  const int32_t distance = phase_ == 1 ? -2 * (int32_t)board::STEPS_PER_MM : board::STEPS_PER_MM;
  Leg leg = Leg();
  (buzz_x_ ? leg.dx : leg.dy) = distance;
  leg.rate = board::CREEP_RATE;
  phase_++;
  motion_.start(leg);
  return EVENT_NONE;
}

StageError Stage::move(int32_t x, int32_t y, int32_t rate) {
  const StageError refused = ready();
  if (refused != ERROR_NONE) return refused;
  if (!homed_) return ERROR_NOT_HOMED;
  if (rate < board::MIN_RATE) return ERROR_OUT_OF_RANGE;
  if (rate > board::MAX_RATE) return ERROR_TOO_FAST;
  if (!within(x, y)) return ERROR_SOFT_LIMIT;
  begin(MOVE);
  go(x, y, (uint16_t)rate);
  return ERROR_NONE;
}

StageError Stage::row(int32_t x0, int32_t pitch, int32_t points, int32_t y, int32_t rate) {
  const StageError refused = ready();
  if (refused != ERROR_NONE) return refused;
  if (!homed_) return ERROR_NOT_HOMED;
  if (points < 1 || points > board::MAX_POINTS || pitch == 0 || rate < board::MIN_RATE) return ERROR_OUT_OF_RANGE;
  if (rate > board::MAX_RATE) return ERROR_TOO_FAST;
  if (!within(x0, y)) return ERROR_SOFT_LIMIT;
  const int32_t widest = points > 1 ? board::MAX_TRAVEL / (points - 1) : board::MAX_TRAVEL;
  if (pitch > widest || pitch < -widest) return ERROR_SOFT_LIMIT;
  const int32_t last = x0 + pitch * (points - 1);
  if (!within(last, y)) return ERROR_SOFT_LIMIT;
  const uint32_t spacing = (uint32_t)(pitch < 0 ? -pitch : pitch);
  // A trigger pulse has to end before the next begins: width < spacing / rate.
  if ((uint32_t)trigger_us_ * (uint32_t)rate >= (spacing < 4000 ? spacing : 4000) * 1000000UL) {
    return ERROR_OUT_OF_RANGE;
  }
  // One pitch at constant speed before the first and after the last point: the vibration of the ramp has decayed, and
  // the burst of the last point is sent at the same speed as all others.
  const uint32_t ramp = motion_.ramp_steps((uint16_t)rate);
  if (ramp > (uint32_t)board::MAX_TRAVEL) return ERROR_NO_RUN_UP;
  // The run-up also takes up the backlash of x; that of y is taken up by approaching from below.
  const uint32_t lead = ramp + (spacing > (uint32_t)backlash_ ? spacing : (uint32_t)backlash_);
  const int32_t run_up = pitch < 0 ? -(int32_t)lead : (int32_t)lead;
  if (!within(x0 - run_up, y) || !within(last + run_up, y) || y < backlash_) return ERROR_NO_RUN_UP;

  row_ = Leg();
  row_.dx = last - x0 + 2 * run_up;
  row_.rate = (uint16_t)rate;
  row_.lead = lead;
  row_.pitch = spacing;
  row_.points = (uint16_t)points;
  row_y_ = y;
  begin(TRAVEL);
  go(x0 - run_up, motion_.y() > y - backlash_ ? y - backlash_ : y, travel_rate_);
  return ERROR_NONE;
}

StageError Stage::clear() {
  if (busy()) return ERROR_BUSY;
  if ((hal_inputs() | motion_.inputs()) & EMERGENCY) return ERROR_EMERGENCY_STOP;
  alarm_ = ERROR_NONE;
  return ERROR_NONE;
}

bool Stage::immediate(uint8_t byte) {
  const bool alone = quiet_, confirmed = resume_begun_;
  quiet_ = false;
  byte_seen_ = true;
  resume_begun_ = byte == IMMEDIATE_RESUME;
  switch (byte) {
    case IMMEDIATE_HOLD:
      motion_.hold();
      resume_requested_ = false;
      break;
    case IMMEDIATE_RESUME:
      if (confirmed) {
        resume_begun_ = false;
        resume_requested_ = true;
      }
      break;
    case IMMEDIATE_STATUS:
      status_requested_ = true;
      break;
    case IMMEDIATE_STOP:
      motion_.hold();
      stop_requested_ = true;
      break;
    default:
      return false;
  }
  if (alone) heard_ = true;
  return true;
}

void Stage::listen(uint32_t now_ms) {
  if (byte_seen_) {
    byte_seen_ = false;
    byte_ms_ = now_ms;
  } else if (now_ms - byte_ms_ >= board::QUIET_MS) {
    quiet_ = true;
  }
  if (heard_) {
    heard_ = false;
    heard_ms_ = now_ms;
  }
}

void Stage::look_at_switches(uint32_t now_ms) {
  if (now_ms == looked_ms_ || motion_.stepping()) return;
  looked_ms_ = now_ms;
  motion_.look_at_switches();
}

bool Stage::take_status_request() {
  const bool requested = status_requested_;
  if (requested) status_requested_ = false;
  return requested;
}

Event Stage::raise(StageError alarm, bool position_lost) {
  motion_.abandon();
  motion_.set_accel(accel_);
  activity_ = IDLE;
  stopping_ = ERROR_NONE;
  stop_requested_ = resume_requested_ = false;
  alarm_ = alarm;
  if (position_lost) homed_ = false;
  if (alarm == ERROR_EMERGENCY_STOP) {  // the brake closes with the drivers
    enabled_ = false;
    hal_enable(false);
  }
  return EVENT_ALARM;
}

Event Stage::service(uint32_t now_ms) {
  listen(now_ms);
  look_at_switches(now_ms);
  // The step interrupt sets the fault before it stops: read in the opposite order, or a fault looks like a normal end.
  const bool stepping = motion_.stepping(), finished = motion_.finished();
  const StageError fault = motion_.fault();
  if (fault != ERROR_NONE) return raise(fault, true);
  if ((motion_.inputs() & EMERGENCY) && alarm_ != ERROR_EMERGENCY_STOP) return raise(ERROR_EMERGENCY_STOP, true);

  if (!busy()) {
    if (stop_requested_) {
      if (alarm_ == ERROR_NONE) return raise(ERROR_STOPPED, false);
      stop_requested_ = false;
    }
    resume_requested_ = false;
    motion_.abandon();  // a hold at rest has no effect
    return EVENT_NONE;
  }

  if (stop_requested_ && stopping_ == ERROR_NONE) stopping_ = ERROR_STOPPED;
  if (stepping && stopping_ == ERROR_NONE && now_ms - heard_ms_ > heartbeat_ms_) {
    stopping_ = ERROR_HEARTBEAT_LOST;
  }
  if (stopping_ != ERROR_NONE) {
    motion_.hold();
    return stepping ? EVENT_NONE : raise(stopping_, stopping_ == ERROR_HEARTBEAT_LOST);
  }
  if (motion_.holding() && activity_ == ROW) held_ = true;
  if (resume_requested_) {
    InterruptLock lock;  // against a HOLD byte in between
    resume_requested_ = false;
    motion_.resume();
  }
  return finished ? next_leg() : EVENT_NONE;
}

Event Stage::next_leg() {
  switch (activity_) {
    case TRAVEL:
      if (motion_.y() != row_y_) {
        go(motion_.x(), row_y_, travel_rate_);
        return EVENT_NONE;
      }
      activity_ = ROW;
      motion_.start(row_);
      return EVENT_NONE;
    case HOMING:
      return next_homing_leg();
    case BUZZ:
      return next_buzz_leg();
    default:
      activity_ = IDLE;
      motion_.abandon();
      return EVENT_DONE;
  }
}

// Per axis, x first: seek the switch, creep back until it opens, pull off to the zero. phase_ counts these six steps;
// the seek has several legs while the axis has not found its switch since the reset.
Event Stage::next_homing_leg() {
  if (board::HAS_SWITCHES) {
    const uint8_t step = phase_ % 3;
    const uint8_t its_switch = phase_ < 3 ? SWITCH_X : SWITCH_Y;
    const int32_t travel = phase_ < 3 ? travel_x_ : travel_y_;
    const int32_t farthest = travel + travel / 10 + board::PULL_OFF;
    if (started_ && step == 0 && motion_.reached()) found_ |= its_switch;
    const bool searches_on = step == 0 && !(found_ & its_switch) && searched_ < farthest;
    if (started_ && !searches_on) {
      const bool as_wanted = motion_.reached() == (step != 2);
      if (!as_wanted) return raise(ERROR_HOMING_FAILED, true);
      if (phase_ == 2) {
        lost_x_ = knew_ ? -motion_.x() : 0;
        motion_.set_x(0);
      } else if (phase_ == 5) {
        lost_y_ = knew_ ? -motion_.y() : 0;
        motion_.set_y(0);
      }
      phase_++;
      searched_ = 0;
      started_ = false;
      return next_homing_leg();
    }
    if (phase_ < 6) {
      const bool along_x = phase_ < 3;
      int32_t distance;
      Leg leg = Leg();
      leg.until = along_x ? SWITCH_X : SWITCH_Y;
      switch (phase_ % 3) {
        case 0:
          distance = -farthest;
          leg.rate = board::HOME_RATE;
          if (searches_on) {
            distance = -board::FIRST_LEG;
            leg.rate = board::FIRST_RATE;
            searched_ += board::FIRST_LEG;
          }
          break;
        case 1:
          distance = board::MAX_RELEASE;
          leg.rate = board::CREEP_RATE;
          leg.until_open = true;
          break;
        default:
          distance = board::PULL_OFF;
          leg.rate = board::HOME_RATE;
      }
      (along_x ? leg.dx : leg.dy) = distance;
      started_ = true;
      motion_.start(leg);
      return EVENT_NONE;
    }
  } else {
    motion_.set_x(0);
    motion_.set_y(0);
  }
  motion_.set_accel(accel_);
  homed_ = true;
  activity_ = IDLE;
  motion_.abandon();
  return EVENT_DONE;
}

const char* Stage::state() const {
  if (busy() && motion_.holding() && !motion_.stepping()) return "hold";
  switch (activity_) {
    case MOVE:
    case BUZZ:
      return "move";
    case TRAVEL:
    case ROW:
      return "row";
    case HOMING:
      return "home";
    default:
      return alarm_ == ERROR_NONE ? "idle" : "alarm";
  }
}
