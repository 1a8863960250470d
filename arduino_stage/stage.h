// The commands of the stage: homing, moves and rows as sequences of legs; hold, stop, heartbeat, alarms, soft limits.
#pragma once
#include <stdint.h>

#include "motion.h"
#include "stage_errors.h"

// Second word of SET; shared/polysight_shared/stage_line.py has the same list.
enum Parameter : uint8_t {
  PARAMETER_ACCEL = 0,
  PARAMETER_HEARTBEAT = 1,
  PARAMETER_TRIGGER = 2,
  PARAMETER_TRAVEL_X = 3,
  PARAMETER_TRAVEL_Y = 4,
  PARAMETER_TRAVEL_SPEED = 5,
  PARAMETER_BACKLASH = 6,
  PARAMETER_PINS = 7,
};

// Bytes that act at once; shared/polysight_shared/stage_line.py has the same list.
enum Immediate : uint8_t {
  IMMEDIATE_HOLD = 0x81,
  IMMEDIATE_RESUME = 0x9D,  // twice; three bits away from every other byte of the line
  IMMEDIATE_STATUS = 0x84,
  IMMEDIATE_STOP = 0x88,
};

// What service() reports: a motion has ended as commanded, or an alarm was raised.
enum Event : uint8_t { EVENT_NONE, EVENT_DONE, EVENT_ALARM };

class Stage {
 public:
  explicit Stage(Motion& motion) : motion_(motion) { reset(); }
  // As after power-on: motors off, not homed, default settings.
  void reset();

  // Commands; docs/spec/stage-line.md has the units of their arguments. Each returns ERROR_NONE or why it is refused.
  // A motion command returns at once; service() reports its end.
  StageError set(int32_t parameter, int32_t value);
  StageError enable(int32_t on);
  StageError home();
  StageError move(int32_t x, int32_t y, int32_t rate);
  StageError row(int32_t x0, int32_t pitch, int32_t points, int32_t y, int32_t rate);
  StageError buzz(int32_t axis);
  StageError clear();

  // Process any received byte; true if it was one of Immediate. Safe in the receive interrupt.
  bool immediate(uint8_t byte);
  // True once after a status was requested.
  bool take_status_request();
  void heard() { heard_ = true; }  // the host is alive

  // Start the next leg, check heartbeat and switches. Call often.
  Event service(uint32_t now_ms);

  // Word for the status line: idle, alarm, move, row, home or hold.
  const char* state() const;
  bool busy() const { return activity_ != IDLE; }
  bool homed() const { return homed_; }
  bool held() const { return held_; }  // the row was interrupted by HOLD
  bool in_row() const { return row_command_; }  // the last motion command was a row
  StageError alarm() const { return alarm_; }
  bool homing() const { return homing_command_; }  // the last motion command was a homing
  int32_t lost_x() const { return lost_x_; }  // steps lost since the previous homing
  int32_t lost_y() const { return lost_y_; }
  const Motion& motion() const { return motion_; }

 private:
  enum Activity : uint8_t { IDLE, MOVE, TRAVEL, ROW, HOMING, BUZZ };  // TRAVEL: to the beginning of a row
  // ERROR_NONE if a motion may begin, else why not.
  StageError ready() const;
  // End all motion and latch an alarm; an emergency stop also switches the motors off.
  Event raise(StageError alarm, bool position_lost);
  // Start what follows a finished leg, or report the end.
  Event next_leg();
  Event next_homing_leg();
  Event next_buzz_leg();
  // True if the place is within the travel.
  bool within(int32_t x, int32_t y) const;
  // Reset what belongs to the motion before.
  void begin(Activity activity);
  // Start a leg to a place.
  void go(int32_t x, int32_t y, uint16_t rate);
  // Read the switches of a stage at rest, once a millisecond.
  void look_at_switches(uint32_t now_ms);
  // Note when the last byte and the last sign of life came.
  void listen(uint32_t now_ms);

  Motion& motion_;
  // Also written by the receive interrupt. heard_: the host gave a sign of life.
  volatile bool heard_, status_requested_, resume_requested_, stop_requested_;
  volatile bool byte_seen_, quiet_;  // quiet_: no byte came for QUIET_MS
  volatile bool resume_begun_;       // the byte before was a RESUME
  Activity activity_;
  StageError alarm_, stopping_;  // stopping_: alarm to raise when the stage has slowed down
  bool enabled_, homed_, held_, row_command_, homing_command_;
  bool started_, knew_;  // started_: a leg of this phase of homing has begun; knew_: was homed before this homing
  uint8_t phase_;  // of homing and of a buzz
  uint8_t found_;  // switches that homing has reached since the reset: bits of Input
  bool buzz_x_;  // the buzz is along x
  int32_t searched_;  // steps of the search in short legs
  Leg row_;  // the leg of the row that the stage travels to
  int32_t row_y_, travel_x_, travel_y_, backlash_;  // steps
  uint16_t travel_rate_, heartbeat_ms_, trigger_us_;  // travel_rate_: steps/s
  uint32_t heard_ms_, byte_ms_, looked_ms_;  // times of the last sign of life, byte, and reading of the switches
  uint32_t accel_;  // steps/s^2, of all motions but homing and buzz
  int32_t lost_x_, lost_y_;  // steps
};
