/* Shared by gpioshim.c (replaced system calls), lines.c (levels, edges, times) and spidev.c (transfers). */
#ifndef GPIOSHIM_H
#define GPIOSHIM_H
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <signal.h>
#include <stdatomic.h>
#include <stdint.h>
#include <time.h>
#include <linux/gpio.h>

#define MAX_LINES GPIO_V2_LINES_MAX
#define RING 4096 /* changes of outputs that may wait for the second process */
/* The C library's function of a name that this file replaces. */
#define REAL(f) ({ static __typeof__(&f) real; if (!real) real = (__typeof__(&f))dlsym(RTLD_NEXT, #f); real; })

#pragma GCC visibility push(hidden) /* the program may have the same names */

struct request { /* lines had together, by their file descriptor: an eventfd that is readable while there are events */
  int n;
  uint32_t offsets[MAX_LINES], seqno, capacity, head, tail;
  struct gpio_v2_line_event *events;
};
struct line {
  struct request *owner;
  /* A change that must last for debounce_ns: its level, when it came by the wires' clock, and when it counts. */
  int owner_fd, pending, pending_value;
  uint64_t flags, debounce_ns, pending_wire_ns, pending_due_ns;
  uint32_t seqno;
  uint8_t driven, outside; /* whether the wires have given it a level, and which */
  char consumer[GPIO_MAX_NAME_SIZE];
};
/* Shared with the second process, which outlives this one for a moment. */
struct shared {
  _Atomic uint32_t head, tail; /* numbers of the changes put into the ring and taken from it */
  struct change { uint64_t ns; uint32_t line, value; } ring[RING];
  _Atomic uint8_t high[MAX_LINES]; /* levels of the outputs */
};

extern unsigned n_lines; /* of the chip */
extern int wires, wire_clock; /* the hub's socket, -1: none; whether edges carry their wire time */
extern volatile sig_atomic_t gone;
extern pthread_mutex_t mutex;
extern struct line lines[MAX_LINES];
extern struct shared *shared;
extern __thread uint64_t thread_ns; /* of a thread that lives in wire time */

uint64_t now_ns(clockid_t clock);
void sleep_until(uint64_t ns); /* CLOCK_MONOTONIC, or wire time in a thread that lives in it */
int level(const struct line *line);
void set_output(unsigned line, int value);
void set_output_at(unsigned line, int value, uint64_t ns);
void read_spi_settings(void);
int ask_spi(unsigned long what, void *arg); /* bytes transferred, or an error number below 0 */
int shown_bufsiz(char *text, int size); /* writes what sysfs shows as spidev's buffer; returns its length */
void carry(int alive);                  /* the second process: outputs to the wires until `alive` ends */
void *listen_to_wires(void *unused);    /* a thread: edges from the wires to the inputs */

#pragma GCC visibility pop
#endif
