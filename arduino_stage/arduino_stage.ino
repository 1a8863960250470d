// The stage of the instrument: two axes, trigger pulses at exact step counts, commands over the serial line.
// Pins and limits: board.h. Protocol: docs/spec/stage-line.md. Everything else is plain C++ that also runs on a PC.
#include "hal_uno.h"
#include "protocol.h"

static Protocol protocol(stage);

void setup() {
  uno_begin();
  protocol.banner();
}

void loop() {
  uno_alive();
  // At most one line per turn, and none without space for its answer, so that input never delays poll().
  uint8_t byte;
  bool line = false;
  while (!line && Protocol::ready() && uno_read(byte)) line = protocol.receive(byte);
  if (Protocol::ready() && uno_lost()) protocol.lost();
  protocol.poll(millis());
}
