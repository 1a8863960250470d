"""The Raspberry Pi half of the instrument. Imports no numpy.

`cli` has the commands. `service` is `polysight-pi run`: it creates these parts, each with a thread of its own,

* `server`: the two ZeroMQ sockets; `keys` decides which clients may connect;
* `executor`: commands and runs. It uses the state machine (`machine`: table of the states, `row_machine`: actions on
  the stage and the running row), whose events the `journal` stores and publishes;
* `trigger`: answers each trigger edge with a burst (`bursts`) on `lines` (GPIO, SPI) or `sim_lines` (simulated wires);
* `stage_link`: the serial port of the stage; `stage` is the driver in millimetres.

`checks` and `client` serve the commands that do not need, or that use, the running service. `system` has real-time
scheduling, systemd notifications and the memory limit.
"""

PROGRAM = "/opt/polysight/venv/bin/polysight-pi"  # where install.sh puts it
AS_THE_SERVICE = f"as the service's user: `sudo -u polysight {PROGRAM} ...`"
