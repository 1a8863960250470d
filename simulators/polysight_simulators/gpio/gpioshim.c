/* gpioshim - a stand-in GPIO chip for one program, preloaded: the unmodified libgpiod v2 bindings talk to it as to a kernel
 * (GPIO character device uAPI v2, <linux/gpio.h>). Everything it does is simulated.
 *
 *   GPIOSHIM_CHIP=PATH     the device; made here, a link to /dev/null
 *   GPIOSHIM_WIRES=SOCKET  hub of the simulated wires (shared/polysight_shared/wires.py): S lines in are levels on inputs, S lines out are
 *                          changes of outputs, with the time (CLOCK_MONOTONIC) at which they were made
 *   GPIOSHIM_LABEL, GPIOSHIM_LINES                                    label and size of the chip
 *   GPIOSHIM_FAULTS=LIST   faults from the start: denied (the device cannot be opened), no-edges (no line can watch edges),
 *                          busy:LINE (another program has it), slow:US (setting lines takes that much longer), stuck (a call
 *                          that sets a line high never returns)
 *   GPIOSHIM_SPI=PATH      a spidev device beside it: spidev.c
 *   GPIOSHIM_CLOCK=wires   edges carry their wire time, which the thread that reads them uses: a sleep returns at once and
 *                          takes exactly its duration. So a burst is exact even on a busy machine. The chip reports a
 *                          hardware timestamp engine: its clock is not the program's
 *   SIGUSR1                                                           the chip vanishes, as when a driver is unloaded
 *
 * As the kernel does: a request's event buffer drops its oldest event when it is full, and line_seqno tells; edges are
 * stamped when they arrive; a debounced line reports what stayed; lines go low when their request is released, also by
 * death of the program, however sudden. The last is the work of a second process, which also carries changes of outputs
 * to the wires, so that a pulse costs no system call.
 * Not as a Raspberry Pi: several lines change at exactly the same time. Never let it prove simultaneity. */
#include "gpioshim.h"
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
#include <sys/eventfd.h>
#include <sys/ioctl.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/un.h>

#define MAX_FD 1024
#define EDGES (GPIO_V2_LINE_FLAG_EDGE_RISING | GPIO_V2_LINE_FLAG_EDGE_FALLING)
#define MAX_EVENTS (GPIO_V2_LINES_MAX * 16) /* the kernel's limit */

#define BUFSIZ_FILE "/sys/module/spidev/parameters/bufsiz"

static char chip[200], spi[200];
static int no_edges, denied, slow_us, stuck;
static uint8_t is_chip[MAX_FD], is_spi[MAX_FD];
static struct request *by_fd[MAX_FD];

/* ---- requests: each returns an error number, 0 for none; the mutex is held ---- */
static int configure(struct request *r, int fd, const struct gpio_v2_line_config *c) {
  for (int i = 0; i < r->n; i++) {
    struct line *l = &lines[r->offsets[i]];
    uint64_t flags = c->flags, value = 0, debounce_us = 0;
    for (unsigned a = 0; a < c->num_attrs; a++) {
      if (!(c->attrs[a].mask >> i & 1)) continue;
      const struct gpio_v2_line_attribute *t = &c->attrs[a].attr;
      if (t->id == GPIO_V2_LINE_ATTR_ID_FLAGS) flags = t->flags;
      if (t->id == GPIO_V2_LINE_ATTR_ID_OUTPUT_VALUES) value = t->values >> i & 1;
      if (t->id == GPIO_V2_LINE_ATTR_ID_DEBOUNCE) debounce_us = t->debounce_period_us;
    }
    if (flags & EDGES && flags & GPIO_V2_LINE_FLAG_OUTPUT) return EINVAL;
    if (flags & EDGES && no_edges) return ENXIO;
    l->flags = flags | GPIO_V2_LINE_FLAG_USED;
    l->debounce_ns = debounce_us * 1000;
    l->owner = r;
    l->owner_fd = fd;
    if (flags & GPIO_V2_LINE_FLAG_OUTPUT) set_output(r->offsets[i], value ^ !!(flags & GPIO_V2_LINE_FLAG_ACTIVE_LOW));
  }
  return 0;
}

static void release(struct request *r) {
  for (int i = 0; i < r->n; i++) {
    struct line *l = &lines[r->offsets[i]];
    if (l->owner != r) continue;
    set_output(r->offsets[i], 0); /* an input again, pulled down */
    l->owner = 0;
    l->flags = l->debounce_ns = l->pending = 0;
    l->consumer[0] = 0;
  }
  free(r->events);
  free(r);
}

static int request_lines(struct gpio_v2_line_request *q) {
  if (q->num_lines == 0 || q->num_lines > MAX_LINES) return EINVAL;
  for (unsigned i = 0; i < q->num_lines; i++) {
    if (q->offsets[i] >= n_lines) return EINVAL;
    if (lines[q->offsets[i]].flags & GPIO_V2_LINE_FLAG_USED) return EBUSY;
  }
  const int fd = eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK);
  if (fd < 0 || fd >= MAX_FD) return EMFILE;
  struct request *r = calloc(1, sizeof *r);
  r->n = q->num_lines;
  memcpy(r->offsets, q->offsets, sizeof r->offsets);
  r->capacity = q->event_buffer_size ? q->event_buffer_size : 16 * q->num_lines;
  if (r->capacity > MAX_EVENTS) r->capacity = MAX_EVENTS;
  r->events = calloc(r->capacity, sizeof *r->events);
  const int error = configure(r, fd, &q->config);
  if (error) {
    release(r);
    REAL(close)(fd);
    return error;
  }
  for (int i = 0; i < r->n; i++) {
    struct line *l = &lines[r->offsets[i]];
    l->seqno = 0;
    snprintf(l->consumer, sizeof l->consumer, "%s", q->consumer);
  }
  by_fd[fd] = r;
  q->fd = fd;
  return 0;
}

static int describe_line(struct gpio_v2_line_info *i) {
  const unsigned n = i->offset;
  if (n >= n_lines) return EINVAL;
  memset(i, 0, sizeof *i);
  i->offset = n;
  i->flags = lines[n].flags ? lines[n].flags : GPIO_V2_LINE_FLAG_INPUT;
  if (wire_clock) i->flags |= GPIO_V2_LINE_FLAG_EVENT_CLOCK_HTE; /* a clock of the chip's own */
  snprintf(i->name, sizeof i->name, "GPIO%u", n);
  snprintf(i->consumer, sizeof i->consumer, "%s", lines[n].consumer);
  if (lines[n].debounce_ns) {
    i->num_attrs = 1;
    i->attrs[0].id = GPIO_V2_LINE_ATTR_ID_DEBOUNCE;
    i->attrs[0].debounce_period_us = lines[n].debounce_ns / 1000;
  }
  return 0;
}

static int ask_chip(unsigned long what, void *arg) {
  struct gpiochip_info *info = arg;
  switch (what) {
  case GPIO_GET_CHIPINFO_IOCTL:
    memset(info, 0, sizeof *info);
    snprintf(info->name, sizeof info->name, "gpiochip0");
    snprintf(info->label, sizeof info->label, "%s", getenv("GPIOSHIM_LABEL") ?: "gpioshim");
    info->lines = n_lines;
    return 0;
  case GPIO_V2_GET_LINEINFO_IOCTL: return describe_line(arg);
  case GPIO_V2_GET_LINE_IOCTL: return request_lines(arg);
  }
  return ENOTTY;
}

static int ask_lines(struct request *r, int fd, unsigned long what, void *arg) {
  struct gpio_v2_line_values *v = arg;
  if (what == GPIO_V2_LINE_SET_CONFIG_IOCTL) return configure(r, fd, arg);
  if (what != GPIO_V2_LINE_GET_VALUES_IOCTL && what != GPIO_V2_LINE_SET_VALUES_IOCTL) return ENOTTY;
  if (what == GPIO_V2_LINE_GET_VALUES_IOCTL) v->bits = 0;
  for (int i = 0; i < r->n; i++) {
    const struct line *l = &lines[r->offsets[i]];
    const int low = !!(l->flags & GPIO_V2_LINE_FLAG_ACTIVE_LOW), output = !!(l->flags & GPIO_V2_LINE_FLAG_OUTPUT);
    if (!(v->mask >> i & 1)) continue;
    if (what == GPIO_V2_LINE_GET_VALUES_IOCTL)
      v->bits |= (uint64_t)((output ? shared->high[r->offsets[i]] : level(l)) ^ low) << i;
    else if (!output) return EPERM;
    else set_output(r->offsets[i], (v->bits >> i & 1) ^ low);
  }
  return 0;
}

/* ---- the replaced system calls ---- */
static int show_bufsiz(void) {
  char text[16];
  const int length = shown_bufsiz(text, sizeof text), fd = memfd_create("bufsiz", MFD_CLOEXEC);
  if (fd >= 0 && (write(fd, text, length) != length || lseek(fd, 0, SEEK_SET))) errno = EIO;
  return fd;
}

static int open_one(const char *path, int flags, int mode) {
  if (spi[0] && !strcmp(path, BUFSIZ_FILE)) return show_bufsiz();
  const int ours = chip[0] && !strcmp(path, chip);
  if (ours && (denied || gone)) {
    errno = gone ? ENODEV : EACCES;
    return -1;
  }
  const int fd = REAL(open)(path, flags, mode);
  if (ours && fd >= 0 && fd < MAX_FD) is_chip[fd] = 1;
  if (spi[0] && !strcmp(path, spi) && fd >= 0 && fd < MAX_FD) is_spi[fd] = 1;
  return fd;
}

#define OPEN(name) \
  int name(const char *path, int flags, ...) { \
    va_list more; \
    va_start(more, flags); \
    const int mode = va_arg(more, int); \
    va_end(more); \
    return open_one(path, flags, mode); \
  }
OPEN(open)
OPEN(open64)

int ioctl(int fd, unsigned long what, ...) {
  va_list more;
  va_start(more, what);
  void *arg = va_arg(more, void *);
  va_end(more);
  if (fd < 0 || fd >= MAX_FD || !(is_chip[fd] || is_spi[fd] || by_fd[fd])) return REAL(ioctl)(fd, what, arg);
  what = (uint32_t)what; /* some callers extend the sign */
  if (is_spi[fd]) { /* not under the mutex: the call lasts as long as the transfer */
    const int done = ask_spi(what, arg);
    if (done < 0) errno = -done;
    return done < 0 ? -1 : done;
  }
  pthread_mutex_lock(&mutex);
  const int error = gone ? ENODEV : is_chip[fd] ? ask_chip(what, arg) : ask_lines(by_fd[fd], fd, what, arg);
  pthread_mutex_unlock(&mutex);
  if (slow_us && what == GPIO_V2_LINE_SET_VALUES_IOCTL) usleep(slow_us);
  while (stuck && what == GPIO_V2_LINE_SET_VALUES_IOCTL && ((struct gpio_v2_line_values *)arg)->bits) pause();
  errno = error;
  return error ? -1 : 0;
}

ssize_t read(int fd, void *buffer, size_t size) {
  if (fd < 0 || fd >= MAX_FD || !by_fd[fd]) return REAL(read)(fd, buffer, size);
  struct request *r = by_fd[fd];
  struct gpio_v2_line_event *events = buffer;
  size_t n = 0;
  if (wire_clock && size > sizeof *events) size = sizeof *events; /* time stands still at each edge until it is answered */
  while (!n && !gone) {
    struct pollfd p = { fd, POLLIN, 0 };
    poll(&p, 1, -1);
    pthread_mutex_lock(&mutex);
    for (; n < size / sizeof *events && r->tail != r->head; n++) events[n] = r->events[r->tail++ % r->capacity];
    uint64_t count;
    if (r->tail == r->head && !gone) (void)!REAL(read)(fd, &count, sizeof count);
    pthread_mutex_unlock(&mutex);
  }
  if (wire_clock && n && events[n - 1].timestamp_ns > thread_ns) thread_ns = events[n - 1].timestamp_ns;
  if (!n) errno = ENODEV;
  return n ? (ssize_t)(n * sizeof *events) : -1;
}

int close(int fd) {
  if (fd >= 0 && fd < MAX_FD) {
    pthread_mutex_lock(&mutex);
    is_chip[fd] = is_spi[fd] = 0;
    if (by_fd[fd]) release(by_fd[fd]);
    by_fd[fd] = 0;
    pthread_mutex_unlock(&mutex);
  }
  return REAL(close)(fd);
}

char *realpath(const char *path, char *buffer) { /* libgpiod asks sysfs whether /dev/null (1:3) is a GPIO chip */
  if (!chip[0] || strncmp(path, "/sys/dev/char/1:3/", 18)) return REAL(realpath)(path, buffer);
  return buffer ? strcpy(buffer, "/sys/bus/gpio") : strdup("/sys/bus/gpio");
}

/* ---- start ---- */
static void vanish(int number) {
  (void)number;
  gone = 1;
  for (int fd = 0; fd < MAX_FD; fd++)
    if (by_fd[fd]) eventfd_write(fd, 1);
}

static void give_up(const char *what) {
  fprintf(stderr, "gpioshim: %s: %s\n", what, strerror(errno));
  _exit(3);
}

static void connect_wires(const char *path) {
  struct sockaddr_un a = { .sun_family = AF_UNIX };
  char text[512] = "L", answer[2];
  int n = 1;
  strncpy(a.sun_path, path, sizeof a.sun_path - 1);
  wires = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
  if (connect(wires, (struct sockaddr *)&a, sizeof a)) give_up(path);
  for (unsigned i = 0; i < n_lines; i++) n += snprintf(text + n, sizeof text - n, " %u", i);
  text[n++] = '\n';
  if (send(wires, text, n, MSG_NOSIGNAL) != n || recv(wires, answer, 2, MSG_WAITALL) != 2 || *answer != 'K') give_up(path);
}

static void read_faults(char *list) {
  unsigned n;
  for (char *word = strtok(list, ","); word; word = strtok(0, ",")) {
    if (!strcmp(word, "denied")) denied = 1;
    else if (!strcmp(word, "no-edges")) no_edges = 1;
    else if (!strcmp(word, "stuck")) stuck = 1;
    else if (sscanf(word, "slow:%d", &slow_us) == 1) continue;
    else if (sscanf(word, "busy:%u", &n) == 1 && n < n_lines) {
      lines[n].flags = GPIO_V2_LINE_FLAG_USED | GPIO_V2_LINE_FLAG_OUTPUT;
      strcpy(lines[n].consumer, "another-program");
    } else {
      errno = EINVAL;
      give_up(word);
    }
  }
}

__attribute__((constructor)) static void start(void) {
  const char *path = getenv("GPIOSHIM_CHIP"), *count = getenv("GPIOSHIM_LINES"), *faults = getenv("GPIOSHIM_FAULTS");
  if (!path) return;
  unsetenv("LD_PRELOAD"); /* this program, not its children */
  snprintf(chip, sizeof chip, "%s", path);
  if (count) n_lines = atoi(count) < MAX_LINES ? atoi(count) : MAX_LINES;
  if (faults) read_faults(strdup(faults));
  wire_clock = getenv("GPIOSHIM_CLOCK") && !strcmp(getenv("GPIOSHIM_CLOCK"), "wires");
  unlink(chip);
  if (symlink("/dev/null", chip)) give_up(chip);
  if (getenv("GPIOSHIM_SPI")) {
    snprintf(spi, sizeof spi, "%s", getenv("GPIOSHIM_SPI"));
    read_spi_settings();
    unlink(spi);
    if (symlink("/dev/null", spi)) give_up(spi);
  }
  shared = mmap(0, sizeof *shared, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
  if (shared == MAP_FAILED) give_up("mmap");
  signal(SIGUSR1, vanish);
  if (!getenv("GPIOSHIM_WIRES")) return;
  connect_wires(getenv("GPIOSHIM_WIRES"));
  int alive[2];
  if (pipe2(alive, O_CLOEXEC)) give_up("pipe");
  const pid_t second = fork();
  if (second < 0) give_up("fork");
  if (second == 0) {
    setsid(); /* signals to the program's group are not meant for it */
    wires = dup2(wires, 100); /* above all descriptors that are closed below */
    const int end = dup2(alive[0], 101);
    close_range(0, 99, 0); /* whoever reads the program's output sees its end, and `alive` ends with the program */
    carry(end);
  }
  REAL(close)(alive[0]); /* alive[1] stays open as long as this program lives */
  sigset_t all, before;
  pthread_t thread;
  sigfillset(&all);
  pthread_sigmask(SIG_SETMASK, &all, &before); /* signals are for the program's own threads */
  pthread_create(&thread, 0, listen_to_wires, 0);
  pthread_sigmask(SIG_SETMASK, &before, 0);
}
