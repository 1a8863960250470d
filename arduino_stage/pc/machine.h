// The board, the motors and the switches on a PC: the sketch's own code in virtual time.
//
// Time is counted in ticks of the step timer (500 ns), as on the board; wire time is its nanoseconds. Steps and edges
// get their exact times however late this process is.
#pragma once
#include <stdint.h>

#include <string>

#include "../protocol.h"

// What differs between simulated rigs.
struct Rig {
  double steps_per_mm = board::STEPS_PER_MM;
  int trigger_line = 26;
  int32_t x = 2000, y = 1500;  // steps the stage stands clear of its switches when it is switched on
};

class Machine {
 public:
  explicit Machine(const Rig& rig);

  // The reset button. The motors keep their position.
  void reset(uint32_t now_ms);
  // A byte from the host.
  void receive(uint8_t byte);
  // Advance the time to `tick`, with every step and edge that is due; `now_ms` is what millis() says then.
  void advance(uint64_t tick, uint32_t now_ms);

  uint64_t tick() const { return tick_; }
  bool stepping() const { return armed_; }
  bool at_rest() const { return !armed_ && !trigger_high_; }
  std::string& wires() { return wires_; }      // lines for the hub, in time order
  std::string& replies() { return replies_; }  // bytes for the host

  // Faults: inputs that are pressed besides the modelled switches, and steps the motors lose.
  void press(uint8_t inputs) { pressed_ = inputs; }
  void slip(int32_t dx, int32_t dy) { x_ += dx, y_ += dy; }

  // Called by the hal functions.
  uint8_t inputs() const;
  void arm(uint16_t ticks);
  void set_directions(bool x, bool y) { x_sign_ = x ? 1 : -1, y_sign_ = y ? 1 : -1; }
  void set_trigger_width(uint16_t us) { width_ = 2u * us; }
  uint16_t steps_per_mm() const { return (uint16_t)(rig_.steps_per_mm + 0.5); }

 private:
  void step();                          // the step interrupt
  void settle();                        // the main loop
  void edge(uint64_t tick, bool high);  // of the trigger line
  void report_motion();                 // position and speed, to the wires
  void end_trigger(uint64_t until);     // the trigger pulse's end, if it is due

  Rig rig_;
  Motion motion_;
  Stage stage_;
  Protocol protocol_;
  std::string wires_, replies_;
  uint64_t tick_ = 0, next_ = 0, fall_ = 0, told_ = 0;  // now, next step, trigger's end, last report of motion
  uint32_t now_ms_ = 0;
  bool armed_ = false, trigger_high_ = false, was_homed_ = false;  // armed_: a step is due at next_
  uint32_t width_ = 2u * board::DEFAULT_TRIGGER_US;  // ticks
  uint8_t pressed_ = 0;
  int x_sign_ = 1, y_sign_ = 1;
  int64_t x_, y_;                    // true position of the stage: steps from the closing point of its switches
  int64_t zero_x_ = 0, zero_y_ = 0;  // where homing found the zero

  friend void hal_write(const char* text, uint8_t length);
};
