/* The lines of the stand-in chip: times, outputs sent to the simulated wires, and edges received from them. */
#include "gpioshim.h"
#include <errno.h>
#include <poll.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>
#include <sys/eventfd.h>
#include <sys/socket.h>

unsigned n_lines = 28;
int wires = -1, wire_clock;
volatile sig_atomic_t gone;
pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
struct line lines[MAX_LINES];
struct shared *shared;
__thread uint64_t thread_ns;

/* ---- time ---- */
#define ROW_GAP_NS 250000000ULL /* between edges of the wires; then wire time is synchronised with the clock again */
#define CALL_NS 200             /* what looking at the clock takes in wire time */

static uint64_t to_ns(const struct timespec *t) { return t->tv_sec * 1000000000ULL + t->tv_nsec; }

int clock_gettime(clockid_t clock, struct timespec *t) {
  if (clock != CLOCK_MONOTONIC || !thread_ns) return REAL(clock_gettime)(clock, t);
  thread_ns += CALL_NS;
  *t = (struct timespec){ thread_ns / 1000000000, thread_ns % 1000000000 };
  return 0;
}

int clock_nanosleep(clockid_t clock, int flags, const struct timespec *t, struct timespec *left) {
  if (clock != CLOCK_MONOTONIC || !thread_ns) return REAL(clock_nanosleep)(clock, flags, t, left);
  const uint64_t end = to_ns(t) + (flags & TIMER_ABSTIME ? 0 : thread_ns);
  if (end > thread_ns) thread_ns = end;
  return 0;
}

uint64_t now_ns(clockid_t clock) {
  struct timespec t;
  clock_gettime(clock, &t);
  return to_ns(&t);
}

void sleep_until(uint64_t ns) {
  const struct timespec t = { ns / 1000000000, ns % 1000000000 };
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, 0) == EINTR) {
  }
}

/* The time that an edge carries: now; in wire time that of the edge before plus what lies between them on the wires. After
 * ROW_GAP_NS it begins at the clock again, unless that has not come so far. The mutex is held. */
static uint64_t edge_ns(clockid_t clock, uint64_t wire_ns) {
  static uint64_t last_wire, last;
  const uint64_t now = now_ns(clock);
  if (!wire_clock) return now;
  const uint64_t since = last + (wire_ns - last_wire);
  last = wire_ns < last_wire + ROW_GAP_NS || since > now ? since : now;
  last_wire = wire_ns;
  return last;
}

/* ---- outputs ---- */
void set_output(unsigned n, int value) { set_output_at(n, value, 0); }

void set_output_at(unsigned n, int value, uint64_t ns) { /* 0: now */
  if (shared->high[n] == value) return;
  if (wires < 0) {
    shared->high[n] = value;
    return;
  }
  const uint32_t head = shared->head;
  while (head - shared->tail >= RING) usleep(100); /* nothing is dropped */
  shared->ring[head % RING] = (struct change){ ns ? ns : now_ns(CLOCK_MONOTONIC), n, value };
  shared->high[n] = value;
  shared->head = head + 1;
}

static void report(uint64_t ns, unsigned line, unsigned value) {
  char text[64];
  const int n = snprintf(text, sizeof text, "S %llu %u %u\n", (unsigned long long)ns, line, value);
  if (wires >= 0 && send(wires, text, n, MSG_NOSIGNAL) != n) wires = -1;
}

/* The second process. `alive` ends with the program; what it left high then goes low, as its lines are released. */
void carry(int alive) {
  struct pollfd end = { alive, POLLIN, 0 };
  for (int ended = 0; !ended;) {
    ended = poll(&end, 1, 1) > 0;
    for (; shared->tail != shared->head; shared->tail++) {
      const struct change *c = &shared->ring[shared->tail % RING];
      report(c->ns, c->line, c->value);
    }
  }
  for (unsigned n = 0; n < n_lines; n++)
    if (shared->high[n]) report(now_ns(CLOCK_MONOTONIC), n, 0);
  _exit(0);
}

/* ---- inputs ---- */
int level(const struct line *l) {
  return l->driven ? l->outside : !!(l->flags & GPIO_V2_LINE_FLAG_BIAS_PULL_UP);
}

/* Set the level of an input, and add an event if its request watches this edge. The mutex is held. */
static void changed(unsigned n, int value, uint64_t wire_ns) {
  struct line *l = &lines[n];
  const int before = level(l);
  l->driven = 1;
  l->outside = value;
  const int active = value ^ !!(l->flags & GPIO_V2_LINE_FLAG_ACTIVE_LOW);
  struct request *r = l->owner;
  const clockid_t clock = l->flags & GPIO_V2_LINE_FLAG_EVENT_CLOCK_REALTIME ? CLOCK_REALTIME : CLOCK_MONOTONIC;
  if (before == value || !r || gone) return;
  if (!(l->flags & (active ? GPIO_V2_LINE_FLAG_EDGE_RISING : GPIO_V2_LINE_FLAG_EDGE_FALLING))) return;
  if (r->head - r->tail == r->capacity) r->tail++;
  r->events[r->head++ % r->capacity] = (struct gpio_v2_line_event){
    .timestamp_ns = edge_ns(clock, wire_ns),
    .id = active ? GPIO_V2_LINE_EVENT_RISING_EDGE : GPIO_V2_LINE_EVENT_FALLING_EDGE,
    .offset = n, .seqno = ++r->seqno, .line_seqno = ++l->seqno };
  eventfd_write(l->owner_fd, 1);
}

/* Take a level from the wires; a debounced line changes only when it has stayed. The mutex is held. */
static void debounced(unsigned n, int value, uint64_t wire_ns) {
  struct line *l = &lines[n];
  if (l->flags & GPIO_V2_LINE_FLAG_OUTPUT) return;
  if (!l->debounce_ns) return changed(n, value, wire_ns);
  if (l->pending && wire_ns >= l->pending_wire_ns + l->debounce_ns) {
    l->pending = 0;
    changed(n, l->pending_value, l->pending_wire_ns);
  }
  l->pending = value != level(l);
  l->pending_value = value;
  l->pending_wire_ns = wire_ns;
  l->pending_due_ns = now_ns(CLOCK_MONOTONIC) + l->debounce_ns;
}

static int settle(void) { /* reports what stayed; returns for how many ms poll may sleep. The mutex is held */
  const uint64_t now = now_ns(CLOCK_MONOTONIC);
  int sleep_ms = -1;
  for (unsigned n = 0; n < n_lines; n++) {
    if (lines[n].pending && now >= lines[n].pending_due_ns) {
      lines[n].pending = 0;
      changed(n, lines[n].pending_value, lines[n].pending_wire_ns);
    }
    if (lines[n].pending) sleep_ms = 1;
  }
  return sleep_ms;
}

void *listen_to_wires(void *unused) {
  char text[8192];
  size_t length = 0;
  struct pollfd p = { wires, POLLIN, 0 };
  while (1) {
    pthread_mutex_lock(&mutex);
    const int sleep_ms = settle();
    pthread_mutex_unlock(&mutex);
    if (poll(&p, 1, sleep_ms) <= 0) continue;
    const ssize_t n = recv(p.fd, text + length, sizeof text - length, 0);
    if (n <= 0) return unused;
    length += n;
    char *line = text, *end;
    pthread_mutex_lock(&mutex);
    for (; (end = memchr(line, '\n', text + length - line)); line = end + 1) {
      unsigned long long ns;
      unsigned number, value;
      *end = 0;
      if (sscanf(line, "S %llu %u %u", &ns, &number, &value) == 3 && number < n_lines) debounced(number, !!value, ns);
    }
    pthread_mutex_unlock(&mutex);
    length -= line - text;
    memmove(text, line, length);
  }
}
