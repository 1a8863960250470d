"""Stand-ins for everything that is not there. Their physics is their own: nothing here imports host code.

Programs: `rig` starts a whole simulated rig, from `wires` (the hub all of it talks through), `stage` or `uno` (the
motion stage), and `cards` (radars and capture cards); `replay` sends recorded files; `polysight.simulators` itself
writes the raw data of a scene without sockets. Packages: `scene` (physics and file layouts), `cards`, `radars`,
`stage`, `uno` (the firmware on an emulated board), `gpio` (a GPIO chip for the Pi's program).
"""
