/* unosim - the firmware's machine code on an emulated Arduino UNO (libsimavr), in exact time, with the stage around it.
 *
 *   unosim [--pty LINK] [--start X,Y] [--watch PINS] FIRMWARE.hex                      lockstep: time advances by command
 *   unosim --pty LINK --speed X [--wires SOCKET] [--line N] [--boot-ms N] ... FIRMWARE.hex         at X times real time
 *
 * The stage: PUL and DIR pins turn motors (counted), motors press switches, the trigger pin is reported. Without --pty
 * the serial line is part of the commands, else it is a pseudo terminal. --parent PID: end when that process ends.
 *
 * Lockstep commands on standard input; each is answered by what happened and then `R <cycle> <x> <left> <right> <sent>`:
 *   feed HEX     bytes to the serial line, paced at its rate      run CYCLES   let time go on
 *   settle [N]   until nothing is on the serial line (with --pty: and N bytes in all were read from it)
 *   rest CYCLES  ... until no motor has stepped for 50 ms         inputs MASK  press switches (1 x, 2 y, 4 emergency)
 *   slip DX DY   lose steps                                       reset        the reset button
 *   hang         the main program stops until a reset; interrupts go on
 *   watch PINS   edges to report from now on                      cost         figures so far, below
 * R tells the motors' positions and how many bytes went to the pseudo terminal. What happened:
 *   T <cycle> <hex>                                     a byte from the board, at the end of its stop bit
 *   E <cycle> <pin> <0|1> <x> <left> <right> <step>     an edge; the motors' positions and the cycle of the last step
 *   X <cycle> <word>                                    reset, watchdog (its reset), overrun (a byte lost in the USART), crash
 *   C <vector> <count> <most cycles>                    per interrupt, entry to end of reti
 *   W <cycles> <cycles> <cycles>                        shortest: step pulse, direction set-up, direction hold
 * At real time standard input is not read; trigger edges and motion go to the wires (docs/spec/simulated-rig.md), in
 * stage coordinates: --zero X,Y says how many steps from the switches' closing the stage homes to, --um-per-step their
 * length.
 */
#include "unosim.h"

#include <errno.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

avr_t *avr;
volatile sig_atomic_t ended;
int lockstep = 1;

void say(const char *format, ...) {
  va_list values;
  if (!lockstep) return;
  va_start(values, format);
  vprintf(format, values);
  va_end(values);
}

/* ---- in lockstep: a command returns false when nothing can follow ---- */
/* Wait for at most 5 s of real time until `bytes` came through the pseudo terminal, then until the line was idle for 4 ms of
 * the board's time (chosen), at most 2 s beyond the bytes on their way. */
static int settle(uint64_t bytes) {
  for (int waits = 0; pty >= 0 && pty_bytes < bytes; waits++) {
    if (waits == 500) { say("X %llu nothing came through the pseudo terminal\n", (u64)avr->cycle); break; }
    read_pty(10);
  }
  const uint64_t start = avr->cycle, limit = start + 2000 * MS + line_backlog();
  while (avr->cycle < limit) {
    const uint64_t since = line_idle_since() > start ? line_idle_since() : start;
    if (line_idle() && avr->cycle >= since + 4 * MS) return 1;
    if (!run_to(avr->cycle + MS / 4)) return 0;
  }
  return 1;
}

static int rest(uint64_t most) {
  const uint64_t start = avr->cycle;
  while (avr->cycle < start + most) {
    const uint64_t since = last_step > start ? last_step : start;
    if (avr->cycle >= since + 50 * MS && line_idle()) return 1;
    if (!run_to(avr->cycle + MS)) return 0;
  }
  return 1;
}

static int command(char *s) {
  u64 n = 0;
  unsigned v;
  int dx, dy;
  if (!strncmp(s, "feed ", 5)) {
    for (s += 5; sscanf(s, "%2x", &v) == 1; s += 2) feed(v);
  } else if (sscanf(s, "run %llu", &n) == 1) {
    return run_to(avr->cycle + n);
  } else if (!strncmp(s, "settle", 6)) {
    sscanf(s, "settle %llu", &n);
    return settle(n);
  } else if (sscanf(s, "rest %llu", &n) == 1) {
    return rest(n);
  } else if (sscanf(s, "inputs %u", &v) == 1) {
    press(v);
  } else if (sscanf(s, "slip %d %d", &dx, &dy) == 2) {
    slip(dx, dy);
  } else if (!strncmp(s, "watch ", 6)) {
    watch(s + 6);
  } else if (!strncmp(s, "reset", 5)) {
    reset();
  } else if (!strncmp(s, "hang", 4)) {
    return hang();
  } else if (!strncmp(s, "cost", 4)) {
    tell_interrupt_costs();
    tell_pin_costs();
  } else {
    fprintf(stderr, "unosim: unknown command %s\n", s);
    return 0;
  }
  return 1;
}

static int serve_lockstep(void) {
  static char line[1 << 17];
  while (1) {
    printf("R %llu", (u64)avr->cycle);
    tell_position();
    printf(" %llu\n", (u64)pty_sent);
    fflush(stdout);
    if (!fgets(line, sizeof line, stdin)) return 0;
    line[strcspn(line, "\n")] = 0;
    if (!command(line)) return !ended;
  }
}

/* ---- at real time ---- */
#define SLICE (HZ / 4000) /* 250 us: how long the board runs between looks at the clock and the pseudo terminal */
static uint64_t anchor_ns, anchor_cycle;

static uint64_t wall_ns(void) {
  struct timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return t.tv_sec * 1000000000ULL + t.tv_nsec;
}

/* Sleep until the wall clock has come to where the board is. */
static void keep_pace(double speed) {
  const uint64_t due = anchor_ns + (uint64_t)(NS(avr->cycle - anchor_cycle) / speed), now = wall_ns();
  if (now < due) {
    struct timespec t = { due / 1000000000, due % 1000000000 };
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, 0);
  } else if (now - due > 20000000) { /* 20 ms behind: starved; slow the simulated world down rather than racing */
    anchor_ns = now, anchor_cycle = avr->cycle;
  }
}

static int serve_real_time(double speed, uint64_t boot_cycles) {
  anchor_ns = wall_ns();
  while (!ended) {
    if (pty_opened()) { /* the boot loader ignores bytes until it ends */
      reset();
      for (const uint64_t boots_at = avr->cycle + boot_cycles; avr->cycle < boots_at && !ended;) {
        avr->cycle += SLICE;
        keep_pace(speed);
      }
      tcflush(pty, TCIOFLUSH);
    }
    read_pty(0);
    if (!run_to(avr->cycle + SLICE)) return !ended;
    report_motion_if_due();
    keep_pace(speed);
  }
  return 0;
}

/* ---- start ---- */
static void on_signal(int number) { (void)number; ended = 1; }

int main(int argc, char **argv) {
  const char *hex = 0, *link = 0, *wires = 0;
  char watched[256] = "2";
  double speed = 0, boot_ms = 200;
  int parent = getppid();
  for (int i = 1; i < argc; i++) {
    const char *name = argv[i], *value = i + 1 < argc ? argv[i + 1] : "";
    if (*name != '-') { hex = name; continue; }
    i++;
    if (!strcmp(name, "--pty")) link = value;
    else if (!strcmp(name, "--wires")) wires = value;
    else if (!strcmp(name, "--line")) rig.trigger_line = atoi(value);
    else if (!strcmp(name, "--speed")) speed = atof(value);
    else if (!strcmp(name, "--boot-ms")) boot_ms = atof(value);
    else if (!strcmp(name, "--um-per-step")) rig.um_per_step = atof(value);
    else if (!strcmp(name, "--parent")) parent = atoi(value);
    else if (!strcmp(name, "--watch")) snprintf(watched, sizeof watched, "%s", value);
    else if (!strcmp(name, "--start") && sscanf(value, "%d,%d", &rig.x, &rig.y) == 2) continue;
    else if (!strcmp(name, "--zero") && sscanf(value, "%d,%d", &rig.zero_x, &rig.zero_y) == 2) continue;
    else hex = 0, i = argc;
  }
  if (!hex) {
    fprintf(stderr, "usage: unosim [--pty LINK] [--speed X] [--wires SOCKET] [--line N] [--boot-ms N] [--um-per-step X]"
                    " [--parent PID] [--start X,Y] [--zero X,Y] [--watch PINS] FIRMWARE.hex\n");
    return 2;
  }
  prctl(PR_SET_PDEATHSIG, SIGTERM); /* never outlive the program that started it */
  if (getppid() != parent) return 0; /* it ended before that */
  signal(SIGTERM, on_signal);
  signal(SIGINT, on_signal);
  signal(SIGPIPE, SIG_IGN);
  lockstep = speed <= 0;
  if (chip_begin(hex)) { fprintf(stderr, "unosim: %s is no image of a firmware\n", hex); return 1; }
  rig_begin();
  serial_begin();
  watch(watched);
  if (link && make_pty(link)) { fprintf(stderr, "unosim: %s: %s\n", link, strerror(errno)); return 1; }
  if (wires && (rig.wires = connect_wires(wires)) < 0) { fprintf(stderr, "unosim: nobody listens at %s\n", wires); return 1; }
  if (!lockstep) {
    printf("ready %s\n", link ? link : "");
    fflush(stdout);
  }
  const int status = lockstep ? serve_lockstep() : serve_real_time(speed, (uint64_t)(boot_ms * MS));
  if (link) unlink(link);
  return status;
}
