// Every pin, ratio and limit of this stage. The only file to edit for another rig.
#pragma once
#include <stdint.h>

namespace board {

// Pins (Arduino UNO numbers). PUL steps a motor driver on its rising edge, DIR chooses the direction.
constexpr uint8_t PIN_TRIGGER = 2;  // to the Pi's trigger_in, through a divider: 5 V here, 3.3 V there
constexpr uint8_t PIN_LEFT_PUL = 3, PIN_LEFT_DIR = 8;    // vertical, left motor
constexpr uint8_t PIN_RIGHT_PUL = 4, PIN_RIGHT_DIR = 9;  // vertical, right motor
constexpr uint8_t PIN_X_PUL = 5, PIN_X_DIR = 10;         // horizontal
constexpr uint8_t PIN_ENABLE = 7;                        // LOW switches the drivers on
constexpr uint8_t PIN_BRAKE = 12;                        // HIGH while the drivers are on: releases the brake of y
constexpr uint8_t PIN_X_SWITCH = 14, PIN_Y_SWITCH = 15, PIN_EMERGENCY = 16;  // A0, A1, A2

// Switches close to ground and are normally closed: a pressed switch and a broken wire both read HIGH.
// Without switches (false), HOME takes the present position as the corner (0, 0): push the stage there by hand first.
constexpr bool HAS_SWITCHES = true;
constexpr bool HAS_EMERGENCY_STOP = true;

// The Pi's [stage] inverted (SET PINS) inverts these levels without compiling.
// Level of DIR for motion towards larger coordinates.
constexpr bool X_POSITIVE_HIGH = true, LEFT_POSITIVE_HIGH = true, RIGHT_POSITIVE_HIGH = true;

constexpr uint16_t STEP_PULSE_US = 4;  // shortest PUL pulse the motor drivers take

constexpr uint16_t STEPS_PER_MM = 200;
constexpr int32_t MAX_TRAVEL = 999999;  // steps; also bounds the length of a status line

// Step timer: a 16-bit counter at this rate, so that one step takes at most 65535 ticks.
constexpr uint32_t TICK_HZ = 2000000UL;
constexpr uint16_t MIN_RATE = 31;     // steps/s: a slower step would take more than 65535 ticks
constexpr uint16_t MAX_RATE = 20000;  // steps/s: the step interrupt (hal_uno.cpp) must fit between two steps
constexpr uint32_t MIN_ACCEL = 100, MAX_ACCEL = 1000000UL;  // steps/s^2
constexpr int32_t MAX_BACKLASH = 20000;  // steps
constexpr uint16_t MAX_POINTS = 9999;

// Debouncing: an input changes after this many equal readings, one per step, at rest one per millisecond. A glitch of
// 100 us is read at most four times at MAX_RATE; a real switch closes for milliseconds.
constexpr uint8_t DEBOUNCING_READINGS = 5;
// An immediate byte counts as a heartbeat only after this much silence, so that continuous chatter never does.
constexpr uint8_t QUIET_MS = 4;  // chosen: 46 bytes at BAUD

// Homing: towards the switch, back until it opens, then PULL_OFF steps further, which is the zero.
constexpr uint16_t HOME_RATE = 4000;   // steps/s
constexpr uint16_t CREEP_RATE = 400;   // steps/s
constexpr uint32_t HOME_ACCEL = 40000UL;  // steps/s^2, independent of SET ACCEL: overruns the switch by 1 mm
// Until the axis has found its switch once since the last reset, its direction may be wrong: slowly, in short legs.
constexpr uint16_t FIRST_RATE = 2000;  // steps/s
constexpr int32_t FIRST_LEG = 2000;    // steps
constexpr uint16_t PULL_OFF = 400;     // steps from the switch's opening to the zero
constexpr int32_t MAX_RELEASE = 4000;  // steps within which a pressed switch must open (20 mm, chosen)

constexpr uint32_t BAUD = 115200UL;

// Values until SET changes them.
constexpr uint32_t DEFAULT_ACCEL = 40000UL;       // steps/s^2
constexpr uint16_t DEFAULT_HEARTBEAT_MS = 500;
constexpr uint16_t DEFAULT_TRIGGER_US = 20;
constexpr int32_t DEFAULT_TRAVEL_X = 160000L, DEFAULT_TRAVEL_Y = 100000L;  // steps
constexpr uint16_t DEFAULT_TRAVEL_RATE = 8000;    // steps/s
constexpr int32_t DEFAULT_BACKLASH = 0;           // steps; 0 = rows come from either side

}  // namespace board
