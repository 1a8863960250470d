// The machine in lockstep with its standard input, for tests: time advances only by command.
#pragma once
#include "machine.h"

// Commands, one a line; each is answered by what happened and then `R <t_ns>`:
//   rx HEX      bytes from the host          run TICKS    advance the time
//   rest TICKS  ... until at rest            inputs MASK  press switches
//   slip DX DY  lose steps                   reset        the reset button
// What happened: `T HEX` bytes to the host, and the wire lines S and M.
int lockstep(Machine& machine);
