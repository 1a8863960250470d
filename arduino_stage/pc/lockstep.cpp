#include "lockstep.h"

#include <inttypes.h>
#include <stdio.h>
#include <string.h>

namespace {

constexpr uint64_t TICKS_PER_MS = board::TICK_HZ / 1000;

uint32_t virtual_ms(const Machine& machine) { return (uint32_t)(machine.tick() / TICKS_PER_MS); }

void run(Machine& machine, uint64_t ticks, bool until_rest) {
  const uint64_t end = machine.tick() + ticks;
  while (machine.tick() < end && !(until_rest && machine.at_rest())) {
    const uint64_t next = machine.tick() + TICKS_PER_MS < end ? machine.tick() + TICKS_PER_MS : end;
    machine.advance(next, (uint32_t)(next / TICKS_PER_MS));
  }
}

// Bytes from the host, two hexadecimal digits each.
void feed(Machine& machine, const char* hex) {
  unsigned byte;
  for (; sscanf(hex, "%2x", &byte) == 1; hex += 2) machine.receive((uint8_t)byte);
}

}  // namespace

int lockstep(Machine& machine) {
  machine.reset(virtual_ms(machine));
  char line[4096];
  do {
    fputs(machine.wires().c_str(), stdout);
    if (!machine.replies().empty()) {
      fputs("T ", stdout);
      for (unsigned char c : machine.replies()) printf("%02x", c);
      fputs("\n", stdout);
    }
    machine.wires().clear();
    machine.replies().clear();
    printf("R %" PRIu64 "\n", machine.tick() * (uint64_t)(1000000000 / board::TICK_HZ));
    fflush(stdout);
    if (!fgets(line, sizeof line, stdin)) return 0;
    uint64_t ticks;
    unsigned mask;
    int32_t dx, dy;
    if (strncmp(line, "rx ", 3) == 0) {
      feed(machine, line + 3);
    } else if (sscanf(line, "run %" SCNu64, &ticks) == 1) {
      run(machine, ticks, false);
    } else if (sscanf(line, "rest %" SCNu64, &ticks) == 1) {
      run(machine, ticks, true);
    } else if (sscanf(line, "inputs %u", &mask) == 1) {
      machine.press((uint8_t)mask);
    } else if (sscanf(line, "slip %" SCNd32 " %" SCNd32, &dx, &dy) == 2) {
      machine.slip(dx, dy);
    } else if (strncmp(line, "reset", 5) == 0) {
      machine.reset(virtual_ms(machine));
    } else {
      fprintf(stderr, "lockstep: unknown command %s", line);
      return 2;
    }
  } while (true);
}
