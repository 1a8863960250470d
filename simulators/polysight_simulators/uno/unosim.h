/* Shared by the parts of the emulator (see unosim.c). Times are cycles of the 16 MHz clock. */
#pragma once
#define _GNU_SOURCE
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <simavr/sim_avr.h>

#define HZ 16000000ULL
#define MS (HZ / 1000)
#define NS(cycle) ((cycle) * 125 / 2)
#define N_PINS 20
typedef unsigned long long u64;

extern avr_t *avr;
extern volatile sig_atomic_t ended;
extern int lockstep; /* time advances by command; else at a multiple of real time */

void say(const char *format, ...); /* in lockstep: to standard output */

/* rig.c: motors, switches, wires */
struct rig {
  int x, y;           /* motor steps the stage stands clear of its switches when it is switched on */
  int zero_x, zero_y; /* motor steps from where the switches close to the zero of stage coordinates */
  double um_per_step;
  int trigger_line; /* of the Pi, for the wires */
  int wires;        /* socket of the hub, -1 without one */
};
extern struct rig rig;
extern uint64_t last_step;
void rig_begin(void);
void rig_reset(void);
void press(unsigned mask);
void slip(int dx, int dy);
void watch(char *pins);
void tell_position(void);
void report_motion_if_due(void); /* to the wires */
void tell_pin_costs(void);
int connect_wires(const char *path);

/* serial.c: the serial line, and the pseudo terminal at its end */
extern int pty;                      /* -1 without one */
extern uint64_t pty_bytes, pty_sent; /* read from it, written to it */
void serial_begin(void);
void serial_reset(void);
int make_pty(const char *link);
void feed(uint8_t byte);
int line_idle(void);
uint64_t line_idle_since(void);
uint64_t line_backlog(void); /* duration of the bytes still on their way to the board */
int pty_opened(void);        /* true if DTR rose since the last call: that resets the board */
void read_pty(int wait_ms);

/* chip.c: the microcontroller */
int chip_begin(const char *hex);
void reset(void);
int hang(void);             /* until the next reset */
int run_to(uint64_t cycle); /* false if the program has crashed, or a signal ends the emulator */
void tell_interrupt_costs(void);
