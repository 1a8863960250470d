"""The Raspberry Pi half of the instrument. Imports no numpy.

`cli` has the commands. `service` is `polysight-pi run`: it has the two ZeroMQ sockets (`keys` decides which clients may
connect) and creates the other parts, each with a thread of its own:

* `executor`: commands and runs. It uses the state machine of stage, run and row (`machine`), whose events the `journal`
  stores and publishes;
* `trigger`: answers each trigger edge with a burst on `lines` (GPIO, SPI, simulated wires);
* `stage`: the serial link to the stage, and the driver in millimetres.

`checks` and `client` serve the commands that do not need, or that use, the running service. `system` has real-time
scheduling, systemd notifications and the memory limit.
"""

import shlex
from collections.abc import Sequence

# Path at which install.sh installs the program.
PROGRAM = "/opt/polysight/venv/bin/polysight-pi"
# Rig file that install.sh installs.
RIG_FILE = "/etc/polysight/instrument.toml"


def advise_as_service(words: Sequence[str]) -> str:
    """Return the advice to run `polysight-pi` with these words as the user of the service."""
    return f"as the service's user: `sudo -u polysight {PROGRAM} {shlex.join(words)}`"
