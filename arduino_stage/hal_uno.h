// The Arduino UNO: pins, step timer, serial line.
#pragma once
#include <stdint.h>

#include "motion.h"
#include "stage.h"

extern Motion motion;
extern Stage stage;

// Set up pins, timer 1 and the serial line.
void uno_begin();

// Feed the watchdog: without this call for 250 ms it resets the board, which stops the motors.
void uno_alive();

// Take the next received byte that is not an immediate one; false if there is none.
bool uno_read(uint8_t& byte);

// True once after received bytes were lost because the buffer was full.
bool uno_lost();
