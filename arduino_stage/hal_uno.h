// The Arduino UNO: pins, step timer, serial line.
#pragma once
#include <stdint.h>

#include "motion.h"
#include "stage.h"

extern Motion motion;
extern Stage stage;

// Set up pins, timer 1 and the serial line.
void uno_begin();

// The main program lives: without this for 250 ms the watchdog resets the board, which stops the motors.
void uno_alive();

// The next received byte that is not an immediate one; false when there is none.
bool uno_read(uint8_t& byte);

// True once after received bytes found no room.
bool uno_lost();
