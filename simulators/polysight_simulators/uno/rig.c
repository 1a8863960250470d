/* The stage around the board: PUL and DIR pins turn motors, motors press switches; trigger and motion go to the wires.
 * Pins are those of arduino_stage/board.h. */
#include "unosim.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>
#include <simavr/avr_ioport.h>

enum { TRIGGER = 2, LEFT_PUL = 3, RIGHT_PUL = 4, X_PUL = 5, DRIVERS_OFF = 7, BRAKE = 12, LEFT_DIR = 8, RIGHT_DIR = 9, X_DIR = 10,
       X_SWITCH = 14, Y_SWITCH = 15, EMERGENCY_STOP = 16 };

struct rig rig = { 2000, 1500, 0, 0, 5.0, 26, -1 };
uint64_t last_step;
static struct pin { char port; uint8_t bit, value, watched; } pins[N_PINS];
/* Pins, steps, and the cycles of the last edge of DIR and the last rising edge of PUL. */
static struct motor { int pul, dir; int32_t position; uint64_t dir_changed, risen; } motors[3] = {
  { X_PUL, X_DIR, 0, 0, 0 }, { LEFT_PUL, LEFT_DIR, 0, 0, 0 }, { RIGHT_PUL, RIGHT_DIR, 0, 0, 0 } };
static uint64_t shortest_pulse = ~0ULL, shortest_setup = ~0ULL, shortest_hold = ~0ULL;
static unsigned pressed;

static avr_irq_t *pin_irq(int pin) {
  return avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(pins[pin].port), pins[pin].bit);
}

/* ---- the wires ---- */
#define REPORT_EVERY (5 * MS)
#define SPEED_OVER (10 * MS) /* a step that waited 16 us for another interrupt is 0.2 % of it */
#define STANDSTILL (40 * MS) /* the slowest step takes 32 ms */
static uint64_t reported_at;

static void send_wires(const char *text, int length) {
  if (send(rig.wires, text, length, MSG_NOSIGNAL) != length) ended = 1;
}

/* Report the stage's motion: always at a trigger, else when it differs from the prediction of the last line. */
static void report_motion(int at_trigger) {
  static uint64_t from_step, last_ns;
  static int32_t from_x;
  static double speed; /* of x, steps per cycle, between two of its steps */
  static long long last[3];
  const struct motor *x = &motors[0];
  const uint64_t took = x->risen - from_step;
  if (took >= SPEED_OVER) {
    speed = took < 2 * STANDSTILL ? (double)(x->position - from_x) / (double)took : 0;
    from_step = x->risen;
    from_x = x->position;
  }
  if (avr->cycle - x->risen > STANDSTILL) speed = 0;
  reported_at = avr->cycle;
  const long long now[3] = {
    llround((x->position - rig.zero_x + speed * (double)(reported_at - x->risen)) * rig.um_per_step),
    llround((motors[1].position - rig.zero_y) * rig.um_per_step), llround(speed * HZ * rig.um_per_step) };
  const double expected = last[0] + last[2] * 1e-9 * (double)(NS(reported_at) - last_ns);
  const int as_told = fabs(now[0] - expected) < rig.um_per_step && now[1] == last[1] && !now[2] == !last[2];
  if (as_told && !at_trigger) return;
  memcpy(last, now, sizeof now);
  last_ns = NS(reported_at);
  char text[96];
  send_wires(text, snprintf(text, sizeof text, "M %llu %lld %lld %lld\n", (u64)NS(reported_at), now[0], now[1], now[2]));
}

void report_motion_if_due(void) {
  if (rig.wires >= 0 && avr->cycle >= reported_at + REPORT_EVERY) report_motion(0);
}

static void tell_trigger(int value) {
  char text[64];
  if (value) report_motion(1); /* where the stage is at this very step */
  send_wires(text, snprintf(text, sizeof text, "S %llu %d %d\n", (u64)NS(avr->cycle), rig.trigger_line, value));
}

int connect_wires(const char *path) {
  struct sockaddr_un a = { .sun_family = AF_UNIX };
  strncpy(a.sun_path, path, sizeof a.sun_path - 1);
  for (int i = 0; i < 500 && !ended; i++) { /* the hub may start later: 10 s, 20 ms apart */
    const int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (connect(fd, (struct sockaddr *)&a, sizeof a) == 0) return fd;
    close(fd);
    const struct timespec nap = { 0, 20000000 };
    nanosleep(&nap, 0);
  }
  return -1;
}

/* ---- switches ---- */
static void drive(int pin, int value) {
  static uint8_t mask[3], level[3]; /* of ports B, C, D: the pins that are driven from outside, and their levels */
  const int k = pins[pin].port - 'B';
  const uint8_t bit = 1 << pins[pin].bit;
  if (mask[k] & bit && !(level[k] & bit) == !value) return;
  mask[k] |= bit;
  level[k] = value ? level[k] | bit : level[k] & ~bit;
  avr_ioport_external_t e = { .name = pins[pin].port, .mask = mask[k], .value = level[k] }; /* else a PORT write undoes it */
  avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL(pins[pin].port), &e);
  avr_raise_irq(pin_irq(pin), !!value);
}

/* Normally closed to ground: a pressed switch lets its pin go high. */
static void drive_switches(void) {
  drive(X_SWITCH, motors[0].position <= 0 || pressed & 1);
  drive(Y_SWITCH, motors[1].position <= 0 || pressed & 2);
  drive(EMERGENCY_STOP, pressed & 4);
}

void press(unsigned mask) {
  pressed = mask;
  drive_switches();
}

/* ---- motors ---- */
static uint64_t least(uint64_t a, uint64_t b) { return a < b ? a : b; }

static void motor_edge(int pin, int value) {
  for (int i = 0; i < 3; i++) {
    struct motor *m = &motors[i];
    if (pin == m->dir) {
      m->dir_changed = avr->cycle;
      if (m->risen) shortest_hold = least(shortest_hold, avr->cycle - m->risen);
    }
    if (pin != m->pul) continue;
    if (!value) {
      shortest_pulse = least(shortest_pulse, avr->cycle - m->risen);
      return;
    }
    if (m->dir_changed) shortest_setup = least(shortest_setup, avr->cycle - m->dir_changed);
    m->risen = last_step = avr->cycle;
    if (!pins[DRIVERS_OFF].value) m->position += pins[m->dir].value ? 1 : -1;
    drive_switches();
  }
}

void slip(int dx, int dy) {
  motors[0].position += dx;
  motors[1].position += dy;
  motors[2].position += dy;
  drive_switches();
}

/* ---- pins ---- */
static void pin_changed(avr_irq_t *irq, uint32_t value, void *param) {
  struct pin *p = param;
  (void)irq;
  value = !!(value & 0xff);
  if (p->value == value) return;
  p->value = value;
  const int pin = p - pins;
  motor_edge(pin, value);
  if (p->watched)
    say("E %llu %d %u %d %d %d %llu\n", (u64)avr->cycle, pin, value, motors[0].position, motors[1].position,
        motors[2].position, (u64)last_step);
  if (pin == TRIGGER && rig.wires >= 0) tell_trigger(value);
}

void watch(char *list) {
  for (int i = 0; i < N_PINS; i++) pins[i].watched = 0;
  for (char *t = strtok(list, ","); t; t = strtok(0, ",")) {
    const int pin = *t == 'A' ? 14 + atoi(t + 1) : atoi(t);
    if (pin >= 0 && pin < N_PINS) pins[pin].watched = 1;
  }
}

void rig_begin(void) {
  motors[0].position = rig.x;
  motors[1].position = motors[2].position = rig.y;
  for (int i = 0; i < N_PINS; i++) {
    pins[i].port = i < 8 ? 'D' : i < 14 ? 'B' : 'C';
    pins[i].bit = i < 8 ? i : i < 14 ? i - 8 : i - 14;
    avr_irq_register_notify(pin_irq(i), pin_changed, &pins[i]);
  }
  drive_switches();
}

void rig_reset(void) { /* the board lets its outputs go */
  for (int i = 0; i < X_SWITCH; i++) if (pins[i].value) avr_raise_irq(pin_irq(i), 0);
}

void tell_position(void) { printf(" %d %d %d", motors[0].position, motors[1].position, motors[2].position); }

void tell_pin_costs(void) {
  say("W %llu %llu %llu\n", (u64)shortest_pulse, (u64)shortest_setup, (u64)shortest_hold);
}
