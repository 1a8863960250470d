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
  uint8_t byte;
  while (uno_read(byte)) protocol.receive(byte);
  if (uno_lost()) protocol.lost();
  protocol.poll(millis());
}
