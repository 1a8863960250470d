// The machine under the command of its standard input: time goes on only when told. For tests.
#pragma once
#include "machine.h"

// Commands, one a line; each is answered by what happened and then `R <t_ns>`:
//   rx HEX      bytes from the host          run TICKS    let time go on
//   rest TICKS  ... until at rest            inputs MASK  press switches
//   slip DX DY  lose steps                   reset        the reset button
// What happened: `T HEX` bytes to the host, and the wire lines S and M.
int lockstep(Machine& machine);
