// Hardware interface of motion and protocol: hal_uno.cpp on the board, pc/machine.cpp on a PC.
#pragma once
#include <stdint.h>

// Bits of the switches' state.
enum Input : uint8_t { SWITCH_X = 1, SWITCH_Y = 2, EMERGENCY = 4 };

// Bits of the value of SET PINS: pins whose level is inverted.
// shared/polysight_shared/raster.py has the same order in INVERTIBLE.
enum Pin : uint8_t {
  PIN_BIT_X_DIR = 1,
  PIN_BIT_LEFT_DIR = 2,
  PIN_BIT_RIGHT_DIR = 4,
  PIN_BIT_ENABLE = 8,
  PIN_BIT_PUL = 16,
  PIN_BIT_SWITCHES = 32,
  PIN_BIT_EMERGENCY = 64,
};

constexpr uint8_t SWITCHES = SWITCH_X | SWITCH_Y;

// State of the switches: bits of Input, set = pressed.
uint8_t hal_inputs();

// Call Motion::step() after this many ticks, then again after each Motion::interval() until that is 0.
void hal_start_steps(uint16_t ticks);

// Invert the levels of these pins: bits of Pin.
void hal_pins(uint8_t inverted);

// Set the direction pins: true = towards larger coordinates.
void hal_directions(bool x_positive, bool y_positive);

// Switch the motor drivers on and release the brake, or the reverse.
void hal_enable(bool on);
// Set the width of the next trigger pulses.
void hal_trigger_width(uint16_t us);
// Free bytes of the send buffer; a hal_write() that fits returns at once.
uint8_t hal_room();
// Send bytes over the serial line.
void hal_write(const char* text, uint8_t length);
// Motor steps per millimetre, for the greeting.
uint16_t hal_steps_per_mm();

// Disables the step and receive interrupts during its lifetime.
class InterruptLock {
 public:
  InterruptLock();
  ~InterruptLock();

 private:
  uint8_t saved_;
};
