// The stage as a process: the sketch behind a pseudo terminal, its trigger and its motion on the simulated wires.
// Start it with `python -m polysight_simulators.stage`, which compiles it.
#include <errno.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <time.h>
#include <unistd.h>

#include "lockstep.h"
#include "serial_port.h"

namespace {

volatile sig_atomic_t stop_signal;

constexpr uint64_t MS = 1000000;            // ns
constexpr uint64_t CONNECT_LIMIT = 10000 * MS;
constexpr int STEP_POLL_MS = 2, REST_POLL_MS = 20;  // longest wait of a turn while the stage moves, and at rest
// A process without CPU time slows the simulated world down: the longest advance at once, wall time.
constexpr uint64_t LONGEST_LEAP = 20 * MS;

uint64_t wall_ns() {
  timespec t;
  clock_gettime(CLOCK_MONOTONIC, &t);
  return (uint64_t)t.tv_sec * 1000000000ull + (uint64_t)t.tv_nsec;
}

void nap(int ms) {
  const timespec t = {0, ms * 1000000L};
  nanosleep(&t, nullptr);
}

int connect_wires(const char* path) {
  sockaddr_un address = {};
  address.sun_family = AF_UNIX;
  if (strlen(path) >= sizeof address.sun_path) {
    errno = ENAMETOOLONG;
    return -1;
  }
  strcpy(address.sun_path, path);
  const uint64_t limit = wall_ns() + CONNECT_LIMIT;
  while (true) {
    const int fd = socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0);
    if (connect(fd, (const sockaddr*)&address, sizeof address) == 0) return fd;
    const int reason = errno;
    close(fd);
    errno = reason;
    if (wall_ns() > limit || stop_signal) return -1;
    nap(20);
  }
}

bool send_all(int fd, const std::string& bytes) {
  for (size_t sent = 0; sent < bytes.size();) {
    const ssize_t n = send(fd, bytes.data() + sent, bytes.size() - sent, MSG_NOSIGNAL);
    if (n < 0 && errno == EINTR && !stop_signal) continue;
    if (n <= 0) return false;
    sent += (size_t)n;
  }
  return true;
}

// Command line; `wires`: the hub's socket, or none.
struct Options {
  const char *link = nullptr, *wires = nullptr;
  double time_scale = 1.0;
  int boot_ms = 200;
  bool lockstep = false;
  Rig rig;
};

bool parse(int argc, char** argv, Options& o) {
  for (int i = 1; i < argc; i++) {
    const char* name = argv[i];
    if (!strcmp(name, "--lockstep")) {
      o.lockstep = true;
      continue;
    }
    if (i + 1 >= argc) return false;
    const char* value = argv[++i];
    if (!strcmp(name, "--link")) o.link = value;
    else if (!strcmp(name, "--wires")) o.wires = value;
    else if (!strcmp(name, "--time-scale")) o.time_scale = atof(value);
    else if (!strcmp(name, "--boot-ms")) o.boot_ms = atoi(value);
    else if (!strcmp(name, "--trigger-line")) o.rig.trigger_line = atoi(value);
    else if (!strcmp(name, "--steps-per-mm")) o.rig.steps_per_mm = atof(value);
    else return false;
  }
  return (o.lockstep || o.link) && o.time_scale > 0 && o.rig.steps_per_mm > 0;
}

// Let the machine's time follow the wall clock (times the scale) until a signal comes; 1 after the wires are lost.
int serve(const Options& o, SerialPort& port, int wires) {
  Machine machine(o.rig);
  const uint64_t started = wall_ns();
  uint64_t wall = started, boots_at = 0;
  double ticks = 0;  // wire time
  bool running = false;
  while (!stop_signal) {
    pollfd p[3] = {{wires, POLLRDHUP, 0}, {port.watch_fd(), POLLIN, 0}, {port.fd(), POLLIN, 0}};
    poll(p, port.is_open() ? 3 : 2, machine.stepping() ? STEP_POLL_MS : REST_POLL_MS);
    if (wires >= 0 && p[0].revents & (POLLRDHUP | POLLHUP | POLLERR)) {
      fprintf(stderr, "stage: the simulated wires were closed\n");
      return 1;
    }
    const uint64_t now = wall_ns();
    uint64_t leap = now - wall;
    wall = now;
    if (machine.stepping() && leap > LONGEST_LEAP) leap = LONGEST_LEAP;
    ticks += (double)leap * o.time_scale * (board::TICK_HZ * 1e-9);
    const uint32_t now_ms = (uint32_t)((now - started) / MS);

    if (port.opened()) {  // opening the port resets the board; its boot loader ignores bytes until it ends
      boots_at = now + (uint64_t)o.boot_ms * MS;
      running = false;
    }
    const bool open = port.is_open();

    // Read bytes first, so that a late process does not detect a silent host.
    if (!machine.stepping()) machine.advance((uint64_t)ticks, now_ms);
    if (open && !running && now >= boots_at) {
      port.flush();
      machine.reset(now_ms);
      running = true;
    } else if (open && running) {
      unsigned char bytes[512];
      const int n = port.read(bytes, sizeof bytes);
      for (int i = 0; i < n; i++) machine.receive(bytes[i]);
    }
    if (machine.stepping()) machine.advance((uint64_t)ticks, now_ms);

    if (wires >= 0 && !send_all(wires, machine.wires()) && !stop_signal) {
      fprintf(stderr, "stage: the simulated wires broke: %s\n", strerror(errno));
      return 1;
    }
    machine.wires().clear();
    if (open && !machine.replies().empty()) port.write(machine.replies());
    machine.replies().clear();
  }
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  Options o;
  if (!parse(argc, argv, o)) {
    fprintf(stderr,
            "usage: stage --link PATH [--wires PATH] [--time-scale X] [--boot-ms N] [--trigger-line N]"
            " [--steps-per-mm X]\n       stage --lockstep [--trigger-line N] [--steps-per-mm X]\n");
    return 2;
  }
  prctl(PR_SET_PDEATHSIG, SIGTERM);
  if (o.lockstep) {
    Machine machine(o.rig);
    return lockstep(machine);
  }
  struct sigaction action = {};
  action.sa_handler = [](int) { stop_signal = 1; };
  sigaction(SIGTERM, &action, nullptr);
  sigaction(SIGINT, &action, nullptr);
  int wires = -1;
  if (o.wires && (wires = connect_wires(o.wires)) < 0) {
    fprintf(stderr, "stage: simulated wires: nobody listens at %s: %s\n", o.wires, strerror(errno));
    return stop_signal ? 0 : 1;
  }
  SerialPort port(o.link);
  if (!port.error().empty()) {
    fprintf(stderr, "stage: %s\n", port.error().c_str());
    return 1;
  }
  printf("ready %s\n", o.link);
  fflush(stdout);
  return serve(o, port, wires);
}
